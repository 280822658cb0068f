"""Images and calibrations that tests of maps write."""

import json
from pathlib import Path

import cv2
import numpy as np

from spherloc.cameras.base import Camera


def camera_file(camera: Camera) -> str:
    """What a calibration of the project's own format says."""
    rows = camera.to_dict().items()
    return "[camera]\n" + "\n".join(f"{key} = {json.dumps(value)}" for key, value in rows)


def picture(path: Path, width: int, height: int, rng: np.random.Generator) -> None:
    """Write an image of noise."""
    assert cv2.imwrite(str(path), rng.integers(0, 255, (height, width), np.uint8))
