"""A selection of recordings as one zip file: the recordings, what a reviewer said, a table, and a page to read."""

import io
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from spherloc.errors import RecordingError
from spherloc_viz.app.review import words
from spherloc_viz.app.review.summary_page import summary_html
from spherloc_viz.recording.index.run_text import rows_text
from spherloc_viz.recording.review.notes import review_path
from spherloc_viz.recording.run_row import RunRow
from spherloc_viz.recording.strangers.examiner import resolve_inside

MOST_RUNS = 500
MOST_BYTES = 200_000_000
"""Of all files together; a page gets them through its browser's memory."""


@dataclass(frozen=True)
class Bundle:
    """A zip file."""

    content: bytes
    runs: int
    """How many it has."""
    sentence: str
    """What it has, and what was left out."""


def bundle(folder: Path, rows: Sequence[RunRow], total: int, now: datetime, closed: Callable[[], bool]) -> Bundle:
    """Pack recordings of a folder; ``total`` is how many were asked for, of which ``rows`` are the first.

    Files that are gone are left out, and so is what goes beyond ``MOST_RUNS`` and ``MOST_BYTES``. Raises
    ``RecordingError`` if nothing is left, or if ``closed`` says that nobody waits for it any more.
    """
    packed: list[RunRow] = []
    out = io.BytesIO()
    size, gone = 0, 0
    with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as archive:  # recordings are compressed inside
        for row in rows[:MOST_RUNS]:
            if closed():
                raise RecordingError("the export was given up, since its page was closed.")
            files = _files(folder, row.file, MOST_BYTES - size)
            if files is None:
                break
            size += sum(map(len, files.values()))
            gone += not files
            packed += [row] if files else []
            for name, content in files.items():
                archive.writestr(f"recordings/{name}", content)
        left = total - len(packed) - gone
        remark = _remark(left, gone)
        page = summary_html(packed, remark, now)
        archive.writestr("index.html", page, compress_type=zipfile.ZIP_DEFLATED)
        archive.writestr("runs.csv", rows_text(folder, packed, "csv"), compress_type=zipfile.ZIP_DEFLATED)
    if not packed:
        raise RecordingError("there is nothing to export: the recordings are gone or too large.")
    plural = "s" if len(packed) != 1 else ""
    content = out.getvalue()
    return Bundle(content, len(packed), f"{len(packed):,} run{plural}, {words.size(len(content))}. {remark}".strip())


def _files(folder: Path, name: str, most_bytes: int) -> dict[str, bytes] | None:
    """A recording and its review by their names; empty if the recording is gone, None if they are larger than that."""
    try:
        path = resolve_inside(folder, name)
        sources = {name: path}
        review = review_path(path)
        if review.is_file() and not review.is_symlink():
            sources[review_path(Path(name)).as_posix()] = review
        # Asked before anything is read: a file may have become a huge one since it was listed.
        if sum(source.stat().st_size for source in sources.values()) > most_bytes:
            return None
        return {name: source.read_bytes() for name, source in sources.items()}
    except (RecordingError, OSError):
        return {}


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
