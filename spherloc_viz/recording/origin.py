"""Where a recorded run came from, so that it can be opened and changed again."""

from dataclasses import dataclass, field
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
    """Of a curated case; empty for others."""
    story: str = ""
    """What a curated case shows, in a few sentences; empty for others."""
