"""A process that reads recordings which may be hostile, as its parent sees it."""

import contextlib
import json
import queue
import subprocess
import sys
import threading
from typing import IO, Any

from spherloc.errors import RecordingError
from spherloc_viz.recording.viewing.rerun_program import rerun_environment

LINE_LIMIT_BYTES = 1 << 21
"""Of an answer: a row has a thumbnail of some kilobytes."""
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
        """Kill it, on any thread; whoever waits for an answer gets none."""
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
