"""Synthetic pictures with known content, and views of them."""

from pathlib import Path

import cv2
import numpy as np

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.frontend.view import View


def texture(rng, height, width):
    """(H, W) bytes full of corners and blobs of all sizes; its left border continues its right one."""
    spectrum = np.fft.rfft2(rng.normal(size=(height, width)))
    rate = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None])
    band = np.where(rate > 0.0, np.minimum(1.0, 0.02 / np.maximum(rate, 1e-9)), 0.0) * (rate < 0.1)
    noise = np.fft.irfft2(spectrum * band, s=(height, width))
    return np.clip(128.0 + 40.0 * noise / max(noise.std(), 1e-9), 0, 255).astype(np.uint8)


def blobs(height, width, centres, sigma_px, periodic=False):
    """(H, W) bytes: bright Gaussian blobs at pixels (N, 2), whose first pixel has its centre at (0.5, 0.5)."""
    u, v = np.arange(width) + 0.5, np.arange(height) + 0.5
    image = np.full((height, width), 40.0)
    for x, y in centres:
        along = u - x
        if periodic:
            along = (along + width / 2) % width - width / 2
        image += 180.0 * np.exp(-0.5 * ((along[None] / sigma_px) ** 2 + ((v[:, None] - y) / sigma_px) ** 2))
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


def disc(side, radius_px):
    """(H, W): the pixels of a square image within a circle about its centre."""
    offset = np.arange(side) + 0.5 - side / 2
    return np.hypot(offset[:, None], offset[None]) < radius_px


def fisheye(side):
    """An equidistant fisheye: 180 degrees fill the width of the image."""
    return fisheye_of(side, side)


def fisheye_of(width, height):
    """An equidistant fisheye that sees all of an image: 180 degrees fill its longer side."""
    focal = max(width, height) / np.pi
    return KannalaBrandt(width, height, focal, focal, width / 2, height / 2, (0.0, 0.0, 0.0, 0.0))


def view_of(folder, image, camera=None, name="picture.png", **known):
    """A view of a picture that is written into ``folder``; without a camera, of a panorama."""
    path = Path(folder) / name
    assert cv2.imwrite(str(path), image)
    height, width = image.shape[:2]
    return View(name, camera or Equirectangular(width, height), path, **known)
