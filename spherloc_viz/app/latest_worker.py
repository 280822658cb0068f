"""A thread that always works on the newest request."""

import threading
import time
from collections.abc import Callable

Job = Callable[[bool], float | None]
"""Called with whether somebody asked (else its own alarm rang); returns seconds to its next alarm, or None."""


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
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def ask(self) -> None:
        """Have the job called as soon as it is free. Never waits."""
        with self._wake:
            self._asked = True
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
        alarm: float | None = None
        while True:
            with self._wake:
                left = None if alarm is None else max(0.0, alarm - time.monotonic())
                self._wake.wait_for(lambda: self._asked or self._closed, left)
                if self._closed:
                    return
                asked, self._asked = self._asked, False
            pause = self._job(asked)
            alarm = None if pause is None else time.monotonic() + pause
