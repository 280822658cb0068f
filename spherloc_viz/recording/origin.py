"""Where a recorded run came from, so that it can be opened and changed again."""

import os
import platform
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Literal

from spherloc.datasets.variation import Variation

Source = Literal["page", "command", "sweep", "sequence", "gallery", "unknown"]


@dataclass(frozen=True)
class Origin:
    """What was asked for; together with estimator, options and seed it describes the run."""

    source: Source = "unknown"
    """Who ran it."""
    scene_path: str | None = None
    """Absolute path of the scene file; None if there was none."""
    scene_seed: int | None = None
    """Seed that the scene's problem was drawn with; None for the scene's own."""
    query: str | None = None
    """Name of the query image, for scenes made of images; None for the first."""
    variation: Variation = field(default_factory=Variation)
    """What was changed about the scene."""
    title: str = ""
    """Title of a curated case; empty for other runs."""
    story: str = ""
    """What a curated case shows, in a few sentences; empty for others."""


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
