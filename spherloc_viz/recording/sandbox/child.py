"""The child that reads recordings which may be hostile: ``python -m spherloc_viz.recording.sandbox.child``.

It reads questions, one a line, ``{"path": "...", "want": "row"}``, and answers each with two lines of JSON:
``{"begun": true}``, then ``{"row": {...}}`` or ``{"error": "..."}``. What can be wanted is a row with labels and note,
a ``bare row`` without, or only the ``review``. ``{"paths": [...], "want": "rows"}`` asks what many files say of
themselves: ``{"rows": [...]}`` has null for those that must be asked for one by one. Its memory, its processor time a
question and what it may write are limited where the system can do that; it may die of a file.
"""

import json
import os
import signal
import stat
import sys
import tempfile
import warnings
from dataclasses import asdict, replace
from pathlib import Path
from typing import IO, Any

from rerun.chunk import Chunk, LazyChunkStream, RrdReader
from rerun.error_utils import RerunWarning

from spherloc.errors import RecordingError, SpherlocError
from spherloc_viz.recording.content.data import check_recording, read_recording
from spherloc_viz.recording.content.head import read_head
from spherloc_viz.recording.content.names import APPLICATION_ID
from spherloc_viz.recording.review_file import read_review
from spherloc_viz.recording.reviews import has_review
from spherloc_viz.recording.run_row import RunRow
from spherloc_viz.recording.sandbox.content_checks import check_content, check_run
from spherloc_viz.recording.sandbox.row_checks import row_from_table, table_from_row

try:
    import resource
except ImportError:  # Windows
    resource = None

FILE_LIMIT_BYTES = 512 << 20
MEMORY_LIMIT_BYTES = 640 << 20
"""Beyond what the child takes before the first file."""
TIME_LIMIT_S = 20
"""Processor time a question; a good file takes a hundredth of a second."""
IDLE_LIMIT_S = 60
"""After so long without a question it ends."""


def main() -> None:
    """Answer questions until there are no more."""
    answers = _own_answers()
    _warm_up()
    _limit_process()
    _say(answers, {"ready": True})
    _wait_for_questions(True)
    for line in sys.stdin.buffer:
        _wait_for_questions(False)
        _say(answers, {"begun": True})
        _limit_time()
        _say(answers, _answer(json.loads(line)))
        _wait_for_questions(True)


def _own_answers() -> IO[str]:
    """A stream for answers; what libraries print goes elsewhere."""
    answers = os.fdopen(os.dup(1), "w", encoding="ascii")
    os.dup2(2, 1)
    return answers


def _say(answers: IO[str], answer: dict[str, Any]) -> None:
    answers.write(json.dumps(answer) + "\n")
    answers.flush()


def _answer(question: dict[str, Any]) -> dict[str, Any]:
    if question["want"] == "rows":
        return {"rows": [_told(Path(path)) for path in question["paths"]]}
    path = Path(question["path"])
    try:
        if question["want"] == "review":
            return {"review": asdict(read_review(path))}
        return {"row": _examined(path, with_review=question["want"] == "row")}
    except SpherlocError as error:
        return {"error": str(error)}
    except MemoryError:
        return {"error": f"{path}: takes too much memory to read; delete it or record the run again."}
    except Exception as error:
        # Whatever a file can make a library raise is the file's fault here, and must not cost the others.
        reason = str(error).replace(str(path), "the file")[:160]
        return {"error": str(RecordingError(f"{path}: not a whole recording ({reason}); record the run again."))}


def _examined(path: Path, with_review: bool) -> dict[str, Any]:
    _check_file(path)
    with warnings.catch_warnings():
        # rerun only warns where a file has no index at its end.
        warnings.simplefilter("error", RerunWarning)
        check_recording(path)
        check_content(path)
        run = read_recording(path)
    check_run(run, path)
    table = table_from_row(_reviewed(run.row, path) if with_review else run.row)
    row_from_table(table, path)
    return table


def _told(path: Path) -> dict[str, Any] | None:
    """The row as the start of the file tells it, with labels and note; None where more of it must be read."""
    try:
        _check_file(path)
        row = read_head(path)
        if row is None or not has_review(path):
            return None if row is None else table_from_row(row)
        review = read_review(path)
        return table_from_row(replace(row, labels=review.labels, note=review.note))
    except Exception:  # what is wrong with it is said when it is asked for alone
        return None


def _reviewed(row: RunRow, path: Path) -> RunRow:
    """The row with its labels and note, if they can be read: without them a run is still a run."""
    try:
        review = read_review(path)
    except RecordingError:
        return row
    return replace(row, labels=review.labels, note=review.note)


def _check_file(path: Path) -> None:
    try:
        status = path.stat()
    except OSError as error:
        raise RecordingError(f"{path}: cannot be opened ({error.strerror or error}); check its path.") from error
    if not stat.S_ISREG(status.st_mode):
        raise RecordingError(f"{path}: not a file; give the path of a recording (.rrd).")
    if status.st_size > FILE_LIMIT_BYTES:
        raise RecordingError(f"{path}: larger than {FILE_LIMIT_BYTES:,} bytes, which no recording is; delete it.")
    if not os.access(path, os.R_OK):
        raise RecordingError(f"{path}: may not be read; change its permissions.")


def _warm_up() -> None:
    """Read a recording, after which rerun's threads and memory are there and can be told from what a file takes."""
    with tempfile.TemporaryDirectory(prefix="spherloc-") as folder:
        path = Path(folder) / "small.rrd"
        chunk = Chunk.from_columns("/a", [], [])
        LazyChunkStream.from_iter([chunk]).write_rrd(path, application_id=APPLICATION_ID, recording_id="1")
        RrdReader(path).stream().to_chunks()


def _limit_process() -> None:
    if resource is None:
        return
    for name in (resource.RLIMIT_CORE, resource.RLIMIT_FSIZE):
        resource.setrlimit(name, (0, 0))
    memory = Path("/proc/self/statm")
    if memory.exists():  # other systems count memory in ways of their own
        taken = int(memory.read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (taken + MEMORY_LIMIT_BYTES, taken + MEMORY_LIMIT_BYTES))


def _limit_time() -> None:
    if resource is not None:
        used = resource.getrusage(resource.RUSAGE_SELF)
        limit = int(used.ru_utime + used.ru_stime) + TIME_LIMIT_S
        resource.setrlimit(resource.RLIMIT_CPU, (limit, resource.RLIM_INFINITY))


def _wait_for_questions(begin: bool) -> None:
    if hasattr(signal, "alarm"):
        signal.alarm(IDLE_LIMIT_S if begin else 0)


if __name__ == "__main__":
    main()
