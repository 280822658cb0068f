"""Untrusted recordings: their names, and their content, which another process reads first.

A recording may be hostile: made so that reading it takes gigabytes, minutes, or down the process that reads it. So what
comes from elsewhere is read by a child first (``spherloc_viz.recording.sandbox.child``) whose memory and time are
limited. What has passed is safe to be read here.
"""

import atexit
import contextlib
import json
import queue
import re
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Self

from spherloc.errors import InputError, RecordingError, show
from spherloc_viz.recording.rerun_program import rerun_environment
from spherloc_viz.recording.reviews import UNREADABLE, Review, checked_review, has_review, review_path
from spherloc_viz.recording.run_row import RunRow
from spherloc_viz.recording.sandbox.row_checks import row_from_table

LINE_LIMIT_BYTES = 1 << 22
"""Longest answer: it has up to ``AT_ONCE`` rows, each with a thumbnail of some kilobytes."""
AT_ONCE = 100
"""Files that are asked for with one question."""
FRUGAL = ("OPENBLAS_NUM_THREADS", "RAYON_NUM_THREADS", "TOKIO_WORKER_THREADS", "MALLOC_ARENA_MAX")
"""How many threads there are; they reserve address space, which the child has little of."""


class ExaminerError(RecordingError):
    """No fault of a file: the process that reads it cannot be started, or was ended meanwhile."""


def cannot_start(reason: str) -> ExaminerError:
    """What to raise, and why."""
    return ExaminerError(
        f"recordings cannot be examined: the process that reads them does not start ({reason}); "
        "'python -m spherloc_viz.recording.sandbox.child' says more."
    )


class Child:
    """One child process."""

    def __init__(self) -> None:
        """Raises ``RecordingError`` if it does not start."""
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "spherloc_viz.recording.sandbox.child"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                # In a session of its own, so that a Ctrl-C meant for us does not look like a bad file.
                start_new_session=True,
                env=rerun_environment() | dict.fromkeys(FRUGAL, "1"),
            )
        except OSError as error:
            raise cannot_start(error.strerror or str(error)) from error
        assert self._process.stdin is not None and self._process.stdout is not None
        self._questions: IO[bytes] = self._process.stdin
        self._answers: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._listener = threading.Thread(target=self._listen, args=(self._process.stdout,), daemon=True)
        self._listener.start()

    def begin(self, question: dict[str, Any], limit_s: float) -> bool:
        """Ask for a file; whether it is being read."""
        try:
            self._questions.write(json.dumps(question).encode() + b"\n")
            self._questions.flush()
        except OSError:
            return False
        return self.answer(limit_s) == {"begun": True}

    def answer(self, limit_s: float) -> dict[str, Any] | None:
        """The next thing that it says; None if it died, hangs or talks nonsense."""
        try:
            answer = json.loads(self._answers.get(timeout=limit_s))
        except (queue.Empty, ValueError, RecursionError):
            return None
        return answer if isinstance(answer, dict) else None

    def kill(self) -> None:
        """Kill the child, on any thread; a thread that waits for its answer gets none."""
        self._process.kill()

    def end(self) -> None:
        """Kill it and wait until it is gone."""
        self.kill()
        self._process.wait()
        self._listener.join()
        with contextlib.suppress(OSError):  # what it did not read
            self._questions.close()

    def _listen(self, answers: IO[bytes]) -> None:
        with answers:
            while line := answers.readline(LINE_LIMIT_BYTES):
                self._answers.put(line)
        self._answers.put(b"")


FILE_LIMIT_S = 60.0
"""A good file takes a hundredth of a second; the child gives up sooner, by the processor time that it used."""
BEGIN_LIMIT_S = 10.0
"""A child that has nothing to do begins in a millisecond."""
START_LIMIT_S = 120.0
"""The child starts in two seconds."""
ENDED = "recordings are examined no more, since the program ends."

_NAME = re.compile(r"(gallery/)?[A-Za-z0-9._-]+\.[Rr][Rr][Dd]", re.ASCII)
_NAME_LIMIT = 255


def check_name(name: str) -> str:
    """Check and return the name of a recording in its folder, which may come from a page, an index or an archive.

    It has letters, digits, ".", "_" and "-", ends with ".rrd" in any case, and may be in the folder "gallery".
    Raises ``RecordingError`` otherwise.
    """
    if len(name) > _NAME_LIMIT or not _NAME.fullmatch(name):
        raise RecordingError(
            f"{show(name)}: not the name of a recording, which has letters, digits, '.', '_' and '-' and ends with "
            ".rrd; rename the file."
        )
    return name


def resolve_inside(folder: Path, name: str) -> Path:
    """The path of the recording ``name`` in ``folder``.

    Raises ``RecordingError`` if it is no such name, if there is no such file, or if it is a link that leads out.
    """
    path = folder / check_name(name)
    try:
        inside = path.resolve().is_relative_to(folder.resolve()) and path.is_file()
    except (OSError, RuntimeError):  # a loop of links
        inside = False
    if not inside:
        raise RecordingError(f"{name}: no such recording in {folder}; list what is there with 'spherloc runs'.")
    return path


class Examiner:
    """Reads recordings in a child process and replaces it when a file kills or stalls it. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._child: Child | None = None
        self._closed = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the child for good, also in the middle of a file: threads that wait for it get an ``ExaminerError``."""
        self._closed = True  # first, since a child that is just being started is not there yet, but looks at this
        child = self._child
        if child is not None:
            child.kill()
        with self._lock:
            self._end()

    def examine(self, path: Path) -> RunRow:
        """The row of a recording that can be read wholly and is safe to be read in this process.

        Raises ``RecordingError``, in one sentence, if it cannot or is not.
        """
        path = path.absolute()  # the child stays in the folder in which it was started
        with self._lock:
            answer = self._ask({"path": str(path), "want": "row"})
            if answer is None and has_review(path):
                # It may be the labels beside it that the child died of.
                answer = self._ask({"path": str(path), "want": "bare row"})
        return row_from_table(_wanted(answer, path, "row"), path)

    def told(self, paths: Sequence[Path]) -> list[RunRow | None]:
        """What recordings say of themselves at the start of their files; None for those that must be examined.

        Fifty times as fast as ``examine``: a row has the right form, but nothing says that the rest of its file is
        whole, fits it, or is safe to be read. Raises ``ExaminerError`` only.
        """
        with self._lock:
            answer = self._ask({"paths": [str(path.absolute()) for path in paths], "want": "rows"})
        tables = (answer or {}).get("rows")
        if not isinstance(tables, list) or len(tables) != len(paths):
            return [None] * len(paths)  # it died of one of them
        rows: list[RunRow | None] = []
        for table, path in zip(tables, paths, strict=True):
            rows.append(None)
            with contextlib.suppress(RecordingError):
                rows[-1] = row_from_table(table, path.absolute())
        return rows

    def examine_review(self, path: Path) -> Review:
        """Labels and note of a recording, whose file is safe to be read in this process.

        Raises ``RecordingError``, in one sentence, if it is not.
        """
        path = path.absolute()
        with self._lock:
            answer = self._ask({"path": str(path), "want": "review"})
        table = _wanted(answer, review_path(path), "review")
        try:
            return checked_review(table["labels"], table["note"])
        except (InputError, TypeError, LookupError, AttributeError):
            raise RecordingError(f"{review_path(path)}: {UNREADABLE}") from None

    def _ask(self, question: dict[str, Any]) -> dict[str, Any] | None:
        """What the child says; None if it dies or hangs of it."""
        if self._child is not None and not self._child.begin(question, BEGIN_LIMIT_S):
            self._end()  # it had nothing to do for a minute
        if self._child is None:
            self._start()
            if self._child is None or not self._child.begin(question, START_LIMIT_S):
                self._end()
                raise self._ended() or cannot_start("it ended at once")
        answer = self._child.answer(FILE_LIMIT_S)
        if answer is None:
            self._end()
            if (ended := self._ended()) is not None:
                raise ended
        return answer

    def _start(self) -> None:
        if (ended := self._ended()) is not None:
            raise ended
        self._child = Child()
        if self._closed or self._child.answer(START_LIMIT_S) != {"ready": True}:
            self._end()
            raise self._ended() or cannot_start("it does not get ready")

    def _ended(self) -> "ExaminerError | None":
        """What to raise once this is closed."""
        return ExaminerError(ENDED) if self._closed else None

    def _end(self) -> None:
        child, self._child = self._child, None
        if child is not None:
            child.end()


def _wanted(answer: dict[str, Any] | None, path: Path, want: str) -> Any:
    """What was wanted of a file; raises ``RecordingError`` if it is not in the answer."""
    if answer is None or not answer.keys() & {want, "error"}:
        raise RecordingError(
            f"{path}: cannot be read, since reading it takes too long or too much memory or ends the reader; "
            "delete it or make it again."
        )
    if "error" in answer:
        raise RecordingError(str(answer["error"]))
    return answer[want]


_shared = Examiner()


def end_examining() -> None:
    """End what ``examine`` and ``examine_review`` are reading: callers that wait for it get an ``ExaminerError``.

    For a server that ends, whose threads would be waited for. Another call of them starts another child.
    """
    global _shared
    ending, _shared = _shared, Examiner()
    ending.close()


atexit.register(lambda: _shared.close())


def examine(path: Path) -> RunRow:
    """The row of a recording that can be read wholly and is safe to be read in this process.

    The first call takes two seconds and leaves a child behind for those to come, which ends a minute after the last.
    Raises ``RecordingError``, in one sentence, if the file cannot be read or is not safe.
    """
    return _shared.examine(Path(path))


def examine_review(path: Path) -> Review:
    """Labels and note of a recording, whose file is then safe to be read in this process; empty if it has none.

    Raises ``RecordingError``, in one sentence, if the file cannot be read or is not safe.
    """
    return _shared.examine_review(Path(path))


@dataclass(frozen=True)
class Told:
    """A row that a recording says of itself, while the rest of the file is still to be examined."""

    row: RunRow
    """The row, after its form was checked."""


Result = RunRow | Told | RecordingError
"""The row of an examined recording, one that is only told, or what is wrong with the file."""


def examine_all(paths: Sequence[Path], examiner: Examiner) -> list[tuple[Path, RunRow | RecordingError]]:
    """Examine recordings one after another: their rows, or what is wrong with them. Raises ``ExaminerError`` only."""
    return [(path, _result(path, examiner)) for path in paths]


def list_all(paths: Sequence[Path], examiner: Examiner) -> list[tuple[Path, Result]]:
    """What recordings tell of themselves; those that tell nothing are examined. Raises ``ExaminerError`` only."""
    told = zip(paths, examiner.told(paths), strict=True)
    return [(path, _result(path, examiner) if row is None else Told(row)) for path, row in told]


def _result(path: Path, examiner: Examiner) -> RunRow | RecordingError:
    try:
        return examiner.examine(path)
    except ExaminerError:
        raise
    except RecordingError as error:
        return error


class Examiners:
    """All that read for one owner, who can end them together. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._open: set[Examiner] = set()
        self._closed = False

    @contextlib.contextmanager
    def start(self, count: int) -> Iterator[list[Examiner]]:
        """So many examiners, which end with the context. Raises ``ExaminerError`` after ``close``."""
        started = [Examiner() for _ in range(count)]
        with self._lock:
            if self._closed:
                raise ExaminerError(ENDED)
            self._open.update(started)
        try:
            yield started
        finally:
            for examiner in started:
                examiner.close()
            with self._lock:
                self._open.difference_update(started)

    def close(self) -> None:
        """End them for good, also in the middle of a file."""
        with self._lock:
            self._closed, started = True, tuple(self._open)
        for examiner in started:
            examiner.close()
