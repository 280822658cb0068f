"""Tests wait until something is so; the limit only ends what hangs, however busy the machine is."""

import time
from collections.abc import Callable
from typing import TypeVar

LIMIT_S = 600.0
"""How long a test waits for a thread, a process or a page before it fails."""
T = TypeVar("T")


def until(found: Callable[[], T], going: Callable[[], bool] = lambda: True) -> T:
    """What ``found`` returns as soon as that is something; fails when what it waits for is no longer ``going``."""
    end = time.monotonic() + LIMIT_S
    while not (something := found()):
        assert going() and time.monotonic() < end
        time.sleep(0.01)
    return something
