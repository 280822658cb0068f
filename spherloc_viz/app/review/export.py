"""A selection of recordings as one zip file: the recordings, what a reviewer said, a table, and a page to read."""

import os
import stat
import threading
import zipfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime
from html import escape
from pathlib import Path
from typing import BinaryIO

import viser

from spherloc.errors import RecordingError
from spherloc_viz.app.desk.report import summary_html
from spherloc_viz.app.review import words
from spherloc_viz.app.review.run_library import RunLibrary
from spherloc_viz.app.review.run_list import RunList
from spherloc_viz.app.text import box
from spherloc_viz.app.web.downloads import Download, Downloads
from spherloc_viz.app.web.touch import Touches
from spherloc_viz.app.workers import BackgroundWorker
from spherloc_viz.recording.index.run_text import rows_text
from spherloc_viz.recording.reviews import review_path
from spherloc_viz.recording.run_row import RunRow
from spherloc_viz.recording.sandbox.examiner import resolve_inside

MAX_RUNS = 500
MAX_BYTES = 200_000_000
"""Largest size of all files together."""


PIECE_BYTES = 1 << 18


@dataclass(frozen=True)
class Bundle:
    """What a zip file has."""

    runs: int
    """How many."""
    sentence: str
    """What it has, and what was left out."""


def bundle(
    path: Path, folder: Path, rows: Sequence[RunRow], total: int, now: datetime, closed: Callable[[], bool]
) -> Bundle:
    """Pack recordings of a folder into a zip file; ``total`` is how many were asked for, of which ``rows`` come first.

    They are copied in pieces, so that memory does not grow with them. Files that are gone are left out, and so is what
    goes beyond ``MAX_RUNS`` and ``MAX_BYTES``. Raises ``RecordingError`` if nothing is left, if the file cannot be
    written, or if ``closed`` says that it is no longer wanted; there may be a part of the file then.
    """
    packed: list[RunRow] = []
    size, gone = 0, 0
    try:
        with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:  # recordings are compressed inside
            for row in rows[:MAX_RUNS]:
                if closed():
                    raise RecordingError("the export was given up, since its page was closed.")
                with ExitStack() as stack:
                    files = _files(folder, row.file, stack)
                    # Asked before anything is copied: a file may have become a huge one since it was listed.
                    size += sum(count for _, count in files.values())
                    if size > MAX_BYTES:
                        break
                    for name, (file, count) in files.items():
                        _copy(archive, f"recordings/{name}", file, count)
                gone += not files
                packed += [row] if files else []
            left = total - len(packed) - gone
            remark = _remark(left, gone)
            page = summary_html(packed, remark, now)
            archive.writestr("index.html", page, compress_type=zipfile.ZIP_DEFLATED)
            archive.writestr("runs.csv", rows_text(folder, packed, "csv"), compress_type=zipfile.ZIP_DEFLATED)
        packed_bytes = path.stat().st_size
    except OSError as error:
        reason = error.strerror or error
        raise RecordingError(f"the export cannot be written ({reason}); make room for temporary files.") from error
    if not packed:
        raise RecordingError("there is nothing to export: the recordings are gone or too large.")
    plural = "s" if len(packed) != 1 else ""
    return Bundle(len(packed), f"{len(packed):,} run{plural}, {words.size(packed_bytes)}. {remark}".strip())


def _files(folder: Path, name: str, stack: ExitStack) -> dict[str, tuple[BinaryIO, int]]:
    """A recording and its review by their names, open, with their sizes in bytes; none if the recording is gone."""
    try:
        path = resolve_inside(folder, name)
        sources = {name: path}
        review = review_path(path)
        if review.is_file() and not review.is_symlink():
            sources[review_path(Path(name)).as_posix()] = review
        files = {name: stack.enter_context(source.open("rb")) for name, source in sources.items()}
        status = {name: os.fstat(file.fileno()) for name, file in files.items()}
        if not all(stat.S_ISREG(state.st_mode) for state in status.values()):
            return {}
        return {name: (file, status[name].st_size) for name, file in files.items()}
    except (RecordingError, OSError):
        return {}


def _copy(archive: zipfile.ZipFile, name: str, file: BinaryIO, size_bytes: int) -> None:
    info = zipfile.ZipInfo(name)
    info.file_size = size_bytes
    with archive.open(info, "w") as out:
        left = size_bytes
        while left and (piece := file.read(min(left, PIECE_BYTES))):
            out.write(piece)
            left -= len(piece)


def _remark(left: int, gone: int) -> str:
    """What is not there, in sentences."""
    parts = []
    if left:
        parts.append(f"{left:,} more were left out: an export has at most {MAX_RUNS} runs and {words.size(MAX_BYTES)}.")
    if gone:
        parts.append(f"{gone:,} were left out, since their files are gone.")
    return " ".join(parts)


class Exporter:
    """Packs what is marked or, if nothing is, the whole list."""

    def __init__(
        self,
        gui: viser.GuiApi,
        name: str,
        touches: Touches,
        library: RunLibrary,
        downloads: Downloads,
        runs: RunList,
        say: Callable[[str], None],
        complain: Callable[[str], None],
    ) -> None:
        """``name`` tells its thread from those of other pages."""
        self._library, self._downloads, self._runs, self._say = library, downloads, runs, say
        self._link = gui.add_html("", visible=False)
        self._offered: Download | None = None
        self._lock = threading.Lock()
        self._closed = False
        self._background = BackgroundWorker(f"spherloc-zip-{name}", complain)
        touches.on("runs-export", lambda touch: self._background.ask(self._export))

    def close(self) -> None:
        """Export nothing more, and offer nothing; does not wait."""
        self._closed = True
        self._background.close()
        self._offer(None)

    def _export(self) -> None:
        marked = self._runs.marked
        if marked:
            rows, total = self._library.rows(marked[:MAX_RUNS]), len(marked)
        else:
            found = self._library.all(self._runs.look, MAX_RUNS)
            rows, total = found.rows, found.total
        self._offer(None)
        about = sum(row.size_bytes for row in rows)
        self._say(f"Packing {len(rows):,} runs, {words.size(about)} …")
        now = datetime.now(UTC)
        download = self._downloads.room(f"spherloc-runs-{now:%Y%m%dT%H%M%SZ}.zip")
        try:
            packed = bundle(download.path, self._library.folder, rows, total, now, lambda: self._closed)
        except RecordingError:
            self._downloads.withdraw(download)
            raise
        self._offer(download)
        self._say(f"{download.name}: {packed.sentence}")

    def _offer(self, download: Download | None) -> None:
        """Serve this file and not the one before; the page fetches it by itself once."""
        with self._lock:
            if self._offered is not None:
                self._downloads.withdraw(self._offered)
            self._offered = download
            if download is not None and not self._closed:
                self._downloads.offer(download)
            elif download is not None:
                self._downloads.withdraw(download)
        if self._closed:
            return
        if download is not None:
            link = f'<a data-fetch href="{escape(download.address)}" download>{escape(download.name)}</a>'
            self._link.content = box(f"Your browser saves it; if it does not: {link}", "font-size:12px")
        self._link.visible = download is not None
