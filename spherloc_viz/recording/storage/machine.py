"""What computes here, as recordings tell it: the same software on another processor may round differently."""

import os
import platform
from functools import cache
from pathlib import Path


@cache
def machine() -> str:
    """The system and the processor, such as "Linux x86_64, AMD EPYC 7763 64-Core Processor"."""
    return f"{platform.system()} {platform.machine()}, {_processor()}"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    named = (line.partition(":")[2].strip() for line in lines if line.startswith(("model name", "Model", "Hardware")))
    name = next(named, "") or platform.processor() or os.environ.get("PROCESSOR_IDENTIFIER", "")
    return " ".join(name.split()) or "unknown processor"
