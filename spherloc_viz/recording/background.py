"""Records runs beside the work: one thread, a bounded queue, and errors as sentences."""

import queue
import re
import threading
import unicodedata
import uuid
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Self

from spherloc.errors import RecordingError
from spherloc.trace import Trace
from spherloc_viz.recording.writer import sweep, write_recording

QUEUE_LENGTH = 16
"""Runs that may wait; at about 50 ms each they take less than a second."""


class Recorder:
    """Writes the runs that it is given into ``folder``, one after another, in the background."""

    def __init__(self, folder: Path, on_error: Callable[[RecordingError], None]) -> None:
        """``on_error`` is called in the recorder's thread, once for every run that could not be written."""
        self._folder = Path(folder)
        self._on_error = on_error
        self._queue: queue.Queue[tuple[Trace, Path] | None] = queue.Queue(QUEUE_LENGTH)
        self._closed = False
        sweep(self._folder)
        self._thread = threading.Thread(target=self._work, name="spherloc-recorder", daemon=True)
        self._thread.start()

    def submit(self, trace: Trace) -> Path:
        """Have a run recorded and return the path that its file will have. Never waits.

        Raises ``RecordingError`` if too many runs wait already, or after ``close``.
        """
        path = self._folder / file_name(trace, datetime.now(UTC))
        if self._closed:
            raise RecordingError(f"{path.name}: not recorded, since recording has ended.")
        try:
            self._queue.put_nowait((trace, path))
        except queue.Full:
            waiting = f"{QUEUE_LENGTH} runs wait to be recorded"
            raise RecordingError(f"{path.name}: not recorded, since {waiting}.") from None
        return path

    def close(self) -> None:
        """Finish what waits, then end the thread."""
        if not self._closed:
            self._closed = True
            self._queue.put(None)
            self._thread.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _work(self) -> None:
        while (job := self._queue.get()) is not None:
            trace, path = job
            try:
                write_recording(trace, path)
            except RecordingError as error:
                self._on_error(error)
            except Exception as error:  # a bug in drawing one run must not end the recording of the others
                self._on_error(RecordingError(f"{path}: the run cannot be recorded: {error!r}."))
            del job, trace


def file_name(trace: Trace, now: datetime) -> str:
    """``<UTC time>_<scene>_<estimator>_<seed>_<id>.rrd``: sorts by time, is unique, and is safe in any file system."""
    when = now.strftime("%Y%m%dT%H%M%SZ")
    return f"{when}_{_slug(trace.problem.name)}_{_slug(trace.estimator)}_{trace.seed}_{uuid.uuid4().hex[:8]}.rrd"


def _slug(text: str) -> str:
    ascii_text = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode()
    return re.sub(r"[^a-z0-9]+", "-", ascii_text.lower()).strip("-")[:60] or "run"
