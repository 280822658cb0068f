"""A simulation that is small and quick to solve, as a scene file."""

import json
from pathlib import Path

TEXT = """
kind = "synthetic"
name = {name}
[camera]
model = "equirectangular"
width = 512
height = 256
[simulation]
correspondences = 20
outlier_rate = 0.25
noise_px = 0.5
seed = 1
"""


def write_tiny_scene(folder: Path, name: str = "tiny") -> Path:
    """Writes tiny.toml into the folder; returns its path."""
    path = folder / "tiny.toml"
    path.write_text(TEXT.format(name=json.dumps(name)))
    return path
