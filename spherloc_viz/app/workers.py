"""Threads of a page: one always works on the latest request, one lives only while there is something to do."""

import contextvars
import logging
import threading
import time
from collections.abc import Callable
from functools import partial

from spherloc.errors import SpherlocError

Job = Callable[[bool], float | None]
"""Called with true if it was asked for, false if its own timer ran out; returns seconds for the timer, or None."""


class LatestWorker:
    """Calls one job on one thread, once more if asked while it works; requests never queue.

    viser runs callbacks on a pool, several at once and out of order. So they only ``ask``, and the job reads
    the state of the page when it acts.
    """

    def __init__(self, name: str, job: Job) -> None:
        self._job = job
        self._wake = threading.Condition()
        self._asked = False
        self._closed = False
        self._alarm_s: float | None = None
        """When the timer runs out."""
        self._sleeps_until_s: float | None = None
        """When the thread wakes, whatever the timer says; None if it does not wait or waits for ever."""
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def ask(self) -> None:
        """Have the job called as soon as it is free. Never waits."""
        with self._wake:
            self._asked = True
            self._wake.notify()

    def after(self, pause_s: float) -> None:
        """Set the timer, in place of what it was set to. Never waits.

        The thread is woken only if it would sleep longer: who puts a job off again and again disturbs nobody.
        """
        with self._wake:
            self._alarm_s = time.monotonic() + pause_s
            if self._sleeps_until_s is None or self._alarm_s < self._sleeps_until_s:
                self._wake.notify()

    def close(self) -> None:
        """End the thread after the call that it is in; does not wait for it."""
        with self._wake:
            self._closed = True
            self._wake.notify()

    def join(self, timeout_s: float) -> None:
        """Wait for the end."""
        self._thread.join(timeout_s)

    def _work(self) -> None:
        while True:
            with self._wake:
                while not (self._asked or self._closed or self._left_s() == 0.0):
                    self._sleeps_until_s = self._alarm_s
                    self._wake.wait(self._left_s())
                self._sleeps_until_s = None
                if self._closed:
                    return
                asked, self._asked, self._alarm_s = self._asked, False, None
            pause_s = self._job(asked)
            with self._wake:
                if pause_s is not None and self._alarm_s is None:  # else it was set meanwhile
                    self._alarm_s = time.monotonic() + pause_s

    def _left_s(self) -> float | None:
        """Seconds until the timer runs out; None if it is not set."""
        return None if self._alarm_s is None else max(0.0, self._alarm_s - time.monotonic())


log = logging.getLogger(__name__)


class BackgroundWorker:
    """Does one job at a time; of those that are asked for meanwhile the newest is next, and the others are dropped."""

    def __init__(self, name: str, failed: Callable[[str], None]) -> None:
        """``failed`` is called with a sentence if a job cannot be done."""
        self._name, self._failed = name, failed
        self._lock = threading.Lock()
        self._next: Callable[[], None] | None = None
        self._busy = self._closed = False

    def ask(self, job: Callable[[], None]) -> None:
        """Have a job done as soon as the one at hand is. Never waits.

        The job knows the same changes of the page as the caller (``Changes.as_of``).
        """
        with self._lock:
            if self._closed:
                return
            self._next = partial(contextvars.copy_context().run, job)
            if self._busy:
                return
            self._busy = True
        threading.Thread(target=self._work, name=self._name, daemon=True).start()

    def forget(self) -> None:
        """Drop the job that waits, if any."""
        with self._lock:
            self._next = None

    def close(self) -> None:
        """Do nothing more after the job at hand; does not wait."""
        with self._lock:
            self._closed, self._next = True, None

    def _work(self) -> None:
        while True:
            with self._lock:
                job, self._next = self._next, None
                if job is None:
                    self._busy = False
                    return
            try:
                job()
            except SpherlocError as error:
                self._failed(str(error))
            except Exception as error:
                log.exception("%s", self._name)
                self._failed(f"This is a bug in the playground ({error!r}); try something else or reload the page.")
