"""A selection of recordings as one zip file: the recordings, what a reviewer said, a table, and a page to read."""

import os
import stat
import threading
import zipfile
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime
from html import escape
from pathlib import Path
from typing import BinaryIO

import viser

from spherloc.errors import RecordingError
from spherloc_viz import style
from spherloc_viz.app.review import words
from spherloc_viz.app.review.rows import badge_html, label_html, picture_html
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

CSS = """
:root{color-scheme:light dark}
body{font:14px/1.45 system-ui,sans-serif;margin:0 auto;max-width:76em;padding:1.5em;
background:light-dark(#fff,#16181c);color:light-dark(#1c1e22,#e4e6ea)}
h1{font-size:1.5em;margin:0 0 .2em}h2{font-size:1.05em;margin:1.4em 0 .3em}
.dim{opacity:.65}table{border-collapse:collapse;width:100%;font-variant-numeric:tabular-nums}
th,td{text-align:left;vertical-align:top;padding:.45em .7em .45em 0;border-top:1px solid rgba(128,140,160,.25)}
th{font-weight:600;white-space:nowrap;border-top:0}code{font:12px ui-monospace,Menlo,Consolas,monospace}
td code{overflow-wrap:anywhere}.name{font-weight:600}.wide{min-width:15em}.num{white-space:nowrap}
.counts>span{display:inline-block;margin:0 1.4em .3em 0}
.bar{display:inline-block;height:.6em;border-radius:.3em;margin-right:.5em;vertical-align:.02em}
"""
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
"""The page has what it needs in itself; nothing that a recording says can load or run anything."""
PICTURE_PX = 152, 104


def summary_html(rows: Sequence[RunRow], remark: str, now: datetime) -> str:
    """A page about the runs, beside whose file the folder ``recordings`` has theirs."""
    plural = "s" if len(rows) != 1 else ""
    title = f"{len(rows):,} recorded run{plural}"
    made = now.astimezone(UTC).strftime("%Y-%m-%d %H:%M UTC")
    body = "".join(_row(row) for row in rows)
    heads = ("", "run", "result", "diagnosis", "review")
    table = f"<table><tr>{''.join(f'<th>{head}</th>' for head in heads)}</tr>{body}</table>"
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{CSS}</style></head><body>"
        f'<h1>{escape(title)}</h1><p class="dim">Exported by spherloc, {made}. {escape(remark)}</p>'
        f"{_counts(rows)}{table}{_how()}</body></html>\n"
    )


def _counts(rows: Sequence[RunRow]) -> str:
    """How many there are of each outcome, and of each diagnosis with a bar."""
    outcomes = Counter(row.outcome for row in rows).most_common()
    causes = Counter(row.diagnosis or "not diagnosed" for row in rows).most_common()
    first = "".join(f"<span>{badge_html(outcome)} {count:,}</span>" for outcome, count in outcomes)
    most = max((count for _, count in causes), default=1)
    color = style.css(style.ESTIMATE)
    second = "".join(
        f'<div><span class="bar" style="width:{max(1.0, 160.0 * count / most):.0f}px;background:{color}"></span>'
        f'{escape(cause)} <span class="dim">{count:,}</span></div>'
        for cause, count in causes
    )
    return f'<div class="counts">{first}</div><h2>Diagnoses</h2>{second}<h2>Runs</h2>'


def _row(row: RunRow) -> str:
    about = [f"{row.estimator}, seed {row.seed}", words.clock(row.created)]
    result = [
        f"{row.inliers} of {row.correspondences} inliers",
        f"outliers {words.percent(row.outlier_rate)}",
        f"{words.angle(row.rotation_error_deg)} · {words.distance(row.translation_error_m)}",
        words.duration(row.time_ms),
    ]
    review = "".join(map(label_html, row.labels)) + _note(row.note)
    cells = (
        picture_html(row.thumbnail, *PICTURE_PX),
        f'<div class="name">{escape(words.title_of(row))}</div><div class="dim">{escape(" · ".join(about))}</div>'
        f"<code>recordings/{escape(row.file)}</code>",
        f"{badge_html(row.outcome)}<div>{'<br>'.join(map(escape, result))}</div>",
        f'{escape(row.diagnosis)}<div class="dim">{escape(row.summary)}</div>',
        review,
    )
    classes = ("", "wide", "num", "wide", "")
    return (
        "<tr>" + "".join(f'<td class="{name}">{cell}</td>' for name, cell in zip(classes, cells, strict=True)) + "</tr>"
    )


def _note(note: str) -> str:
    return f'<div style="white-space:pre-wrap">{escape(note)}</div>' if note else ""


def _how() -> str:
    ways = (
        ("spherloc view FILE.rrd", "opens a run in the Rerun viewer, at the step where it was decided"),
        ("spherloc repeat FILE.rrd", "repeats a run and says whether it comes out the same"),
        ("spherloc run FILE.rrd", "solves the recorded problem again, with other options if you like"),
        ("spherloc play --recordings recordings", "reviews all of them on the playground's page"),
    )
    rows = "".join(f"<tr><td><code>{escape(code)}</code></td><td>{escape(what)}</td></tr>" for code, what in ways)
    return (
        f"<h2>How to open them</h2><table>{rows}</table>"
        '<p class="dim">Any Rerun viewer opens the files too. Labels and notes are in the files that end with '
        ".review.rrd; runs.csv has this table for other programs.</p>"
    )


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
            rows, total = self._library.rows(marked[:MOST_RUNS]), len(marked)
        else:
            found = self._library.all(self._runs.look, MOST_RUNS)
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
