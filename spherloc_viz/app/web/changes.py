"""Numbers of what a person changes on a page, so that no older value of the server is put in place of a newer one.

The page (``changes.js``) numbers every change of a widget: 1, 2, 3, ... All of them arrive in this order. Whatever the
server sets in answer carries the number of the newest change that was known when it was decided. A widget that the
person has changed since keeps what it has, here (``Changes.writing``) and on the page.
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar


class Changes:
    """Which change of a widget is its newest. One for each page."""

    def __init__(self) -> None:
        self._hearing = threading.RLock()
        """Held while a change is taken over. A thread that calls ``now`` must hold no other lock."""
        self._lock = threading.Lock()
        self._newest = 0
        self._numbers: dict[str, int] = {}
        """By name of the changed thing: the number of its change, or of the change to which it was set as an answer."""
        self.gesture = 0
        """Counts the presses and keys on the page: changes of one drag have the same."""

    def now(self) -> int:
        """The number of the newest change; everything that was changed by then can be read."""
        with self._hearing:
            return self._newest

    def of(self, name: str) -> int:
        """The number of the newest change of this widget; 0 if it never was changed."""
        with self._lock:
            return self._numbers.get(name, 0)

    @contextmanager
    def as_of(self, number: int) -> Iterator[None]:
        """What this thread sets meanwhile answers the changes up to that number and knows no later ones."""
        token = _MOMENT.set((self, number))
        try:
            yield
        finally:
            _MOMENT.reset(token)

    def moment(self) -> int:
        """The number up to which the changes are known to what this thread does: all of them, unless it said so."""
        moment = _MOMENT.get()
        return moment[1] if moment is not None and moment[0] is self else self._newest

    @contextmanager
    def hearing(self, name: str, number: int | None) -> Iterator[None]:
        """A change arrives, with its number if the page gave one; ``name`` is empty for a press that is no widget's.

        The widget gets its value within, and what is done at once is done within: only then is the change known.
        """
        with self._hearing:
            following = self._newest + 1
            number = following if number is None else max(number, following)
            with self._lock:
                self._numbers[name] = number
            try:
                with self.as_of(number):
                    yield
            finally:
                self._newest = number

    @contextmanager
    def writing(self, name: str) -> Iterator[int | None]:
        """The number that a new value of this widget answers; None if it must be left, since it has a newer change."""
        number = self.moment()
        with self._lock:
            if self._numbers.get(name, 0) > number:
                yield None
            else:
                self._numbers[name] = number
                yield number


_MOMENT: ContextVar[tuple[Changes, int] | None] = ContextVar("moment", default=None)
