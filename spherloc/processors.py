"""How many processors there are to work on."""

import os


def processor_count() -> int:
    """Processors that this process may use, at least one."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
