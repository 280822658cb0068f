"""Lets whoever waits for a run see how far it is, and end it.

The run and its kernels share a small array with the watch, the ``board``: kernels run for seconds without the
interpreter, so they read there whether to stop and write there how far they are. A kernel that is told to stop returns
at once, with whatever it has; the function that called it then raises ``Cancelled`` by ``Watch.check``.
"""

import threading
import time

import numpy as np
from numba.core import event
from numpy.typing import NDArray

from spherloc.errors import SpherlocError
from spherloc.kernel_cache import kernel

STOP, DONE, TOTAL = 0, 1, 2
"""Places of the board: not 0 once the run is cancelled; work done of the stage at hand, and all of its work (0 if
nobody can know), in units of the stage's own.
"""
SLOTS = 8
"""The board fills a line of the processor's cache."""
MAX_WORK = int(np.iinfo(np.int64).max)
"""What the board can count."""
SELDOM = (1 << 16) - 1
"""Loops of some nanoseconds a turn look at the board where these bits of their counter are 0: it costs nothing then."""


class Cancelled(SpherlocError):  # noqa: N818
    """The run was ended by its watch; it has no result."""


class Watch:
    """Follows one run from any thread; every run takes a new one.

    The run itself tells it what it begins (``begin``), how much that will be (``expect``) and how far it came
    (``reach``), and asks whether it shall go on (``check``).
    """

    def __init__(self) -> None:
        self.board: NDArray[np.int64] = np.zeros(SLOTS, np.int64)
        self._lock = threading.Lock()
        self._stage = ""
        self._start, self._end, self._highest = 0.0, 0.0, 0.0

    def cancel(self) -> None:
        """End the run: ``estimate`` raises ``Cancelled`` within some hundredths of a second, or at once if it has not
        begun. A run that has ended is left as it is.
        """
        self.board[STOP] = 1

    @property
    def cancelled(self) -> bool:
        """Whether somebody called ``cancel``."""
        return bool(self.board[STOP])

    @property
    def stage(self) -> str:
        """What the run is at, in a word; empty before it begins."""
        return self._stage

    @property
    def fraction(self) -> float:
        """How far the run is, 0 to 1; it never falls, and is 1 when the run has ended with a result.

        Each stage has a fixed share, about its share of the time of a large problem, and within it counts work done
        over all work that may be needed: samples, pairs, bins of yaw. So it is no clock. It jumps where a search ends
        before its limit, as RANSAC with a confidence and mc-exact mostly do.
        """
        with self._lock:
            done, total = int(self.board[DONE]), int(self.board[TOTAL])
            within = min(1.0, done / total) if total > 0 else 0.0
            self._highest = max(self._highest, self._start + within * (self._end - self._start))
            return self._highest

    def check(self) -> None:
        """Raise ``Cancelled`` if the run shall end."""
        if self.board[STOP]:
            raise Cancelled("The run was cancelled.")

    def begin(self, stage: str, until: float | None = None) -> None:
        """Go on to a stage at whose end ``fraction`` will be ``until``, or as it is now; raises ``Cancelled``."""
        self.check()
        with self._lock:
            self._stage, self._start = stage, self._end
            self._end = self._start if until is None else max(self._start, until)
            self.board[DONE] = self.board[TOTAL] = 0

    def expect(self, total: int) -> None:
        """Say how much work the stage is."""
        self.board[TOTAL] = min(total, MAX_WORK)

    def reach(self, done: int) -> None:
        """Say how much of it is done; raises ``Cancelled``."""
        self.board[DONE] = min(done, MAX_WORK)
        self.check()

    def finish(self) -> None:
        """The run has its result; raises ``Cancelled`` if nobody wants it any more."""
        self.begin(self._stage, 1.0)
        self.expect(1)
        self.reach(1)


@kernel()
def stopped(board):
    """Whether a kernel shall return. A kernel that nobody watches has None for a board."""
    return board is not None and board[STOP] != 0


_compiling = event.TimingListener()
event.register("numba:compile", _compiling)


def working_s() -> float:
    """Seconds of some fixed origin, which stand still while a kernel is compiled (and not merely loaded)."""
    return time.perf_counter() - (_compiling.duration if _compiling.done else 0.0)
