"""Records runs beside the work: one thread, a bounded queue, and errors as sentences."""

import contextlib
import logging
import queue
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Self, TypeVar

from spherloc.diagnosis import Diagnosis
from spherloc.errors import RecordingError
from spherloc.trace import Trace
from spherloc_viz.recording.index.run_index import RunIndex
from spherloc_viz.recording.origin import Origin
from spherloc_viz.recording.storage.room import KEEP_BYTES
from spherloc_viz.recording.storage.store import RecordingStore, SweepStore

log = logging.getLogger(__name__)

QUEUE_LENGTH = 16
"""Runs that may wait; at about 50 ms each they take less than a second."""
UPKEEP_LIMIT_S = 5.0
"""How long closing waits for files that are being deleted or recovered."""

T = TypeVar("T")
Ended = Callable[[RecordingError | None], None]
"""Is told that a run is written, or why it is not."""
Known = Callable[[Path], None]
"""Is told which recording has the very same run."""
_Job = tuple[Trace, Path, Origin | None, Diagnosis | None, Ended, Known | None, Path | None]


class _StoppedError(Exception):
    """The upkeep is told to end."""


class Recorder:
    """Writes the runs that it is given into ``folder``, one after another, in the background.

    At its start a second thread, which ends when it is done, puts the folder right: what killed processes left is
    recovered or deleted, the list of runs is made to agree with the files, and old successes make room.
    """

    def __init__(
        self,
        folder: Path,
        on_error: Callable[[RecordingError], None],
        on_notice: Callable[[str], None] = lambda sentence: None,
        full: bool = False,
        keep_bytes: int = KEEP_BYTES,
        on_recovery: Callable[[str], None] | None = None,
    ) -> None:
        """``on_error`` is told of every run that cannot be written; ``on_notice`` of recovered and deleted recordings;
        ``on_recovery``, or else ``on_notice``, of the first run that is written after some were not. All are called in
        threads of the recorder."""
        self._on_error, self._on_notice = _safe(on_error), _safe(on_notice)
        self._on_recovery = _safe(on_recovery or on_notice)
        self._store = RecordingStore(folder, self._on_notice, full, keep_bytes)
        self._queue: queue.Queue[_Job | None] = queue.Queue(QUEUE_LENGTH)
        self._lock = threading.Lock()
        self._waiting = self._lost = 0
        self._closed = False
        self._thread = threading.Thread(target=self._work, name="spherloc-recorder", daemon=True)
        self._thread.start()
        self._upkeep = self._start(self._put_right)

    @property
    def folder(self) -> Path:
        """Where the recordings are."""
        return self._store.folder

    @property
    def index(self) -> RunIndex:
        """The list of the folder's runs. Raises ``RecordingError`` if it cannot be opened."""
        return self._store.index

    @property
    def waiting(self) -> int:
        """Runs that are not on the disk yet, with the one that is being written."""
        return self._waiting

    @property
    def overload(self) -> str:
        """How many runs wait, in a sentence; empty if it is none but the one that is being written."""
        count = self._waiting
        return f"{count} runs wait to be recorded." if count > 1 else ""

    def submit(
        self,
        trace: Trace,
        origin: Origin | None = None,
        diagnosis: Diagnosis | None = None,
        ended: Ended = lambda error: None,
        known: Known | None = None,
        instead_of: Path | None = None,
    ) -> Path:
        """Have a run recorded and return the path that its file will have. Never waits.

        A run without ``diagnosis`` is diagnosed in the background. ``ended`` is told in a thread of the recorder when
        the run is written and listed, or why it is not written. With ``known``, a run whose very same is recorded from
        the same source is not written once more: ``known`` is told of that recording before ``ended``. A run
        ``instead_of`` an earlier recording has that deleted, once it is written, unless it has labels or a note.

        Raises ``RecordingError`` if too many runs wait
        already, or after ``close``.
        """
        path = self._store.path_of(trace)
        with self._lock:
            if self._closed:
                raise RecordingError(f"{path.name}: not recorded, since recording has ended.")
            try:
                self._queue.put_nowait((trace, path, origin, diagnosis, _safe(ended), known, instead_of))
            except queue.Full:
                raise RecordingError(
                    f"{path.name}: not recorded, since {QUEUE_LENGTH} runs wait to be recorded."
                ) from None
            self._waiting += 1
        return path

    def sweep_store(self) -> SweepStore:
        """What records the runs of a sweep into this folder, in the processes that do them."""
        return SweepStore(self.folder.resolve())

    def make_room(self) -> None:
        """Have old successes deleted if other processes have written too much. Never waits."""
        with self._lock:
            if not self._closed and not self._upkeep.is_alive():
                self._upkeep = self._start(self._prune)

    def close(self) -> None:
        """Finish what waits, then end the threads."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
        self._store.end_reading()  # which a hostile file can keep up for a minute
        self._queue.put(None)
        self._thread.join()
        self._upkeep.join(UPKEEP_LIMIT_S)
        self._store.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _work(self) -> None:
        while (job := self._queue.get()) is not None:
            self._record(*job)
            del job
            with self._lock:
                self._waiting -= 1

    def _record(
        self,
        trace: Trace,
        path: Path,
        origin: Origin | None,
        diagnosis: Diagnosis | None,
        ended: Ended,
        known: Known | None,
        instead_of: Path | None,
    ) -> None:
        try:
            before = None if known is None or origin is None else self._store.known(trace, origin.source)
            if known is not None and before is not None:
                known(before)
            else:
                self._store.record(trace, origin, diagnosis, path)
                self._replace(instead_of, path)
        except RecordingError as error:
            self._lose(error, ended)
        except Exception as error:  # a bug in drawing one run must not end the recording of the others
            self._lose(RecordingError(f"{path}: the run cannot be recorded: {error!r}."), ended)
        else:
            ended(None)
            lost, self._lost = self._lost, 0
            if lost:
                self._on_recovery(f"Runs are recorded again; {lost} {'was' if lost == 1 else 'were'} not.")

    def _replace(self, before: Path | None, path: Path) -> None:
        """Delete a recording whose run was made anew and is recorded at ``path``."""
        if before is None:
            return
        why = ", since it has labels or a note, or is not listed"
        try:
            if self._store.delete(before):
                return
        except RecordingError as error:
            why = f": {error}"
        self._on_notice(f"{before.name} stays{why}; {path.name} is of the same query, which was tried anew.")

    def _lose(self, error: RecordingError, ended: Ended) -> None:
        self._lost += 1
        ended(error)
        self._on_error(error)

    def _start(self, upkeep: Callable[[], None]) -> threading.Thread:
        thread = threading.Thread(target=upkeep, name="spherloc-upkeep", daemon=True)
        thread.start()
        return thread

    def _put_right(self) -> None:
        with contextlib.suppress(_StoppedError):
            try:
                self._store.tidy()
                if self.folder.is_dir():
                    self._go_on()
                    self.index.refresh(progress=self._go_on)
            except (RecordingError, OSError) as error:
                self._complain(f"The list of runs may not be complete: {error}")
                return
            self._prune()

    def _prune(self) -> None:
        if not self.folder.is_dir():
            return
        try:
            self._store.prune()
        except RecordingError as error:
            self._complain(f"Old successes cannot be deleted: {error}")

    def _complain(self, sentence: str) -> None:
        if not self._closed:
            self._on_notice(sentence)

    def _go_on(self, *progress: int) -> None:
        if self._closed:
            raise _StoppedError


def _safe(tell: Callable[[T], None]) -> Callable[[T], None]:
    """``tell`` with its errors caught, for threads that must go on."""

    def safe(what: T) -> None:
        try:
            tell(what)
        except Exception:
            log.exception("a notice could not be shown: %s", what)

    return safe
