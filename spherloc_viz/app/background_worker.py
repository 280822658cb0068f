"""Does what takes its time aside from the page, on a thread that lives only while there is something to do."""

import contextvars
import logging
import threading
from collections.abc import Callable
from functools import partial

from spherloc.errors import SpherlocError

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

        The job knows no more of what was changed on the page (``Changes.as_of``) than who asks for it.
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
