"""An image with its camera: what it refuses, and which of its pixels may be used."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from spherloc.cameras.base import Camera
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.errors import InputError
from spherloc.frontend.view import View, seen_pixels

FISHEYE = KannalaBrandt(640, 480, 150.0, 150.0, 320.0, 240.0, (0.05, -0.02, 0.0, 0.0))


@pytest.mark.parametrize("camera", [FISHEYE, Equirectangular(1500, 300)], ids=["fisheye", "panorama"])
def test_seen_pixels_are_those_with_a_bearing(camera: Camera) -> None:
    """Worked out in blocks of rows, they must be those of the whole image at once."""
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    _, valid = camera.unproject(np.column_stack([columns.ravel(), rows.ravel()]))
    seen = seen_pixels(camera)
    assert np.array_equal(seen, valid.reshape(camera.height, camera.width)) and not seen.flags.writeable
    assert seen.all() == isinstance(camera, Equirectangular)


def test_a_mask_narrows_what_is_seen(tmp_path: Path) -> None:
    mask = np.zeros((480, 640), dtype=bool)
    mask[:, 300:] = True
    view = View("a", FISHEYE, tmp_path / "a.png", mask=lambda: mask)
    assert np.array_equal(view.usable_pixels(), mask & seen_pixels(FISHEYE))
    wrong = View("a", FISHEYE, tmp_path / "a.png", mask=lambda: mask[:-1])
    with pytest.raises(InputError, match="a: its mask is 640 x 479 pixels, the image 640 x 480"):
        wrong.usable_pixels()


def test_an_image_of_another_size_is_refused(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((100, 200), np.uint8))
    with pytest.raises(InputError, match=r"a\.png: is 200 x 100 pixels, but its calibration is for 640 x 480"):
        View("a", FISHEYE, tmp_path / "a.png").read()
