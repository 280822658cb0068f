"""A simulation that is small and quick to solve, and sweeps over it."""

from pathlib import Path
from typing import Any

from spherloc.datasets.variation import Variation
from spherloc.experiments.sweep import Entrant, SweepPlan, planned

SCENE = """
kind = "synthetic"
name = "tiny"
[camera]
model = "equirectangular"
width = 1024
height = 512
[simulation]
correspondences = 30
outlier_rate = 0.25
noise_px = 0.5
seed = 1
"""
QUICK = (Entrant("ransac-2p", (("iterations", 20),)), Entrant("mc-exact"))


def write_scene(folder: Path) -> Path:
    path = folder / "tiny.toml"
    path.write_text(SCENE)
    return path


def small_plan(folder: Path, **changes: Any) -> SweepPlan:
    """Two estimators, at outlier rates that one of them does not always survive."""
    given: dict[str, Any] = {
        "over": "outlier_rate",
        "values": (0.5, 0.8),
        "entrants": QUICK,
        "runs": 4,
        "variation": Variation(noise_px=1.0),
        "first_seed": 3,
    }
    return planned(write_scene(folder), **(given | changes))
