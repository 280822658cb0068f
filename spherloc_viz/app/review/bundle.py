"""A selection of recordings as one zip file: the recordings, what a reviewer said, a table, and a page to read."""

import os
import stat
import zipfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import BinaryIO

from spherloc.errors import RecordingError
from spherloc_viz.app.review import words
from spherloc_viz.app.review.summary_page import summary_html
from spherloc_viz.recording.index.run_text import rows_text
from spherloc_viz.recording.review.notes import review_path
from spherloc_viz.recording.run_row import RunRow
from spherloc_viz.recording.sandbox.examiner import resolve_inside

MOST_RUNS = 500
MOST_BYTES = 200_000_000
"""Of all files together."""


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
    goes beyond ``MOST_RUNS`` and ``MOST_BYTES``. Raises ``RecordingError`` if nothing is left, if the file cannot be
    written, or if ``closed`` says that nobody waits for it any more; there may be a part of the file then.
    """
    packed: list[RunRow] = []
    size, gone = 0, 0
    try:
        with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:  # recordings are compressed inside
            for row in rows[:MOST_RUNS]:
                if closed():
                    raise RecordingError("the export was given up, since its page was closed.")
                with ExitStack() as stack:
                    files = _files(folder, row.file, stack)
                    # Asked before anything is copied: a file may have become a huge one since it was listed.
                    size += sum(count for _, count in files.values())
                    if size > MOST_BYTES:
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
        parts.append(
            f"{left:,} more were left out: an export has at most {MOST_RUNS} runs and {words.size(MOST_BYTES)}."
        )
    if gone:
        parts.append(f"{gone:,} were left out, since their files are gone.")
    return " ".join(parts)
