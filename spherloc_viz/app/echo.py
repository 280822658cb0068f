"""When a page must be told what its widgets are."""

import threading

NEAR_S = 0.5
"""Of changes that follow each other so closely the page may have lost one: it sends only the last of several within
50 ms, whichever widgets they are of."""
AFTER_S = 1.0
"""A change so soon after the page was told may have crossed it on its way, and the page shows what was before."""


class Echo:
    """Remembers whether a page may show what Python does not have.

    Telling it all the time would be worse: whatever a hand changes in that moment would jump back.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._heard_s = self._told_s = -AFTER_S
        self._due = False

    def hear(self, now_s: float) -> None:
        """A widget was changed by a hand on the page."""
        with self._lock:
            self._due = self._due or now_s - self._heard_s < NEAR_S or now_s - self._told_s < AFTER_S
            self._heard_s = now_s

    def take(self, now_s: float) -> bool:
        """Whether the page must be told now; it then counts as told."""
        with self._lock:
            due, self._due = self._due, False
            if due:
                self._told_s = now_s
            return due
