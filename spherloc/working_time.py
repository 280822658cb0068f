"""Seconds of work, without those in which numba compiled: a run's time budget must not depend on a cold cache."""

import time

from numba.core import event

_compiling = event.TimingListener()
event.register("numba:compile", _compiling)


def working_s() -> float:
    """Seconds of some fixed origin, which stand still while a kernel is compiled (and not merely loaded)."""
    return time.perf_counter() - (_compiling.duration if _compiling.done else 0.0)
