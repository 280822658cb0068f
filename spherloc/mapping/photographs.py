"""The photographs that a map is made of: a folder's images with their camera, or the sharpest frames of a video."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import ceil
from pathlib import Path

import cv2
import numpy as np

from spherloc.cameras.base import Camera
from spherloc.cameras.calibration import load_camera
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.datasets.given_path import what_it_is
from spherloc.errors import InputError, SpherlocError, shorten
from spherloc.files import IMAGES, is_file, is_folder, names_in
from spherloc.frontend.masks import Masks
from spherloc.frontend.view import View
from spherloc.images import grey, read_size
from spherloc.mapping.lens import for_colmap
from spherloc.types import ByteArray

MIN_IMAGES = 2
MAX_IMAGES = 500
"""Their features take 4 MB each."""
MIN_PANORAMA_PX = 200
"""Of the longer side."""
CALIBRATIONS = (".yaml", ".yml", ".json", ".toml")
MAX_CALIBRATIONS = 20
"""Files beside the photographs that are tried as one."""
SHARPNESS_PX = 512
"""Frames are compared at this longer side."""


@dataclass(frozen=True)
class Photographs:
    """What can be mapped, in the order of names, and what is said of the rest."""

    views: tuple[View, ...]
    remarks: tuple[str, ...]


def photographs(folder: Path, camera: Camera | None, masks: Masks | None = None) -> Photographs:
    """The images of a folder, all of ``camera``; without one they are taken for panoramas if they are 2 to 1.

    Other images without one are of the camera whose calibration lies in the folder, if one of their size does. What
    ``masks`` leave out gives no features.

    Raises ``InputError`` if there are fewer than two of one size or too many, if there is no mask for any of them, or
    if their camera is not known or none that COLMAP can have.
    """
    if not is_folder(folder):
        raise InputError(what_it_is(folder) or f"{folder}: is no folder; give the folder of the photographs.")
    sizes: dict[tuple[int, int], list[str]] = {}
    remarks = []
    for name in (name for name in names_in(folder) if Path(name).suffix.lower() in IMAGES):
        try:
            sizes.setdefault(read_size(folder / name), []).append(name)
        except InputError as error:
            remarks.append(f"{shorten(name)} was left out: {error}")
    if not sizes:
        raise InputError(f"{folder}: has no photographs ({', '.join(sorted(IMAGES))}); give the folder that has them.")
    size = (camera.width, camera.height) if camera else max(sizes, key=lambda key: len(sizes[key]))
    width, height = size
    if camera is None and width == 2 * height and width >= MIN_PANORAMA_PX:
        camera = Equirectangular(width, height)
    if camera is None:
        camera, name = _calibration_in(folder, size)
        if camera is None:
            raise InputError(
                f"{folder}: its photographs are {width} x {height} pixels, so they are no full panoramas (2 to 1); "
                "give their calibration with --camera FILE."
            )
        remarks.append(f"The calibration is {shorten(name)}, which lies beside the photographs.")
    names = sizes.pop(size, [])
    others = sorted(name for rest in sizes.values() for name in rest)
    if others:
        remarks.append(
            f"{len(others)} of {len(others) + len(names)} images were left out, as they are not {width} x {height} "
            f"pixels; the first is {shorten(others[0])}."
        )
    if len(names) < MIN_IMAGES:
        raise InputError(
            f"{folder}: has {len(names)} photographs of {width} x {height} pixels; a map needs {MIN_IMAGES} or more, "
            "better ten."
        )
    if len(names) > MAX_IMAGES:
        raise InputError(
            f"{folder}: has {len(names)} photographs, of {MAX_IMAGES} that are mapped at once; take every n-th of "
            'them, or map them with COLMAP and open its model as kind = "colmap".'
        )
    camera, about_lens = for_colmap(camera)
    if about_lens:
        remarks.append(about_lens)
    views = tuple(View(name, camera, folder / name) for name in sorted(names))
    if masks is not None:
        views, without = masks.on(views)
        remarks += without
    return Photographs(views, tuple(remarks))


def _calibration_in(folder: Path, size: tuple[int, int]) -> tuple[Camera | None, str]:
    """The first camera of that width and height among the files of a folder, and the file's name."""
    names = [name for name in names_in(folder) if Path(name).suffix.lower() in CALIBRATIONS]
    for name in names[:MAX_CALIBRATIONS]:
        try:
            camera = load_camera(folder / name)
        except SpherlocError:  # something else
            continue
        if (camera.width, camera.height) == size:
            return camera, name
    return None, ""


def frames_of(video: Path, folder: Path, count: int, advance: Callable[[str], None]) -> int:
    """Write some ``count`` frames of a video into ``folder``, the sharpest of each stretch; how many were written.

    ``advance`` is called after each with its name. Frames that are there are not written again. Raises ``InputError``
    if the video cannot be read or the folder cannot be written.
    """
    if not is_file(video):
        raise InputError(f"{video}: is no file; give a video.")
    reader = cv2.VideoCapture(str(video))
    total = int(reader.get(cv2.CAP_PROP_FRAME_COUNT)) if reader.isOpened() else 0
    if total <= 0:
        raise InputError(f"{video}: OpenCV cannot read it as a video; convert it, to MP4 with H.264 for instance.")
    stretch = max(1, ceil(total / count))
    written = 0
    for number, frame in _sharpest(reader, stretch):
        name = f"frame_{number:06d}.jpg"
        path = folder / name
        if not is_file(path):
            done, content = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, 95])
            try:
                path.write_bytes(content.tobytes() if done else b"")
            except OSError as error:
                raise InputError(f"{path}: cannot be written ({error.strerror}); give another --output.") from None
        written += 1
        advance(name)
    return written


def _sharpest(reader: cv2.VideoCapture, stretch: int) -> Iterator[tuple[int, ByteArray]]:
    """Number and pixels of the sharpest frame of each ``stretch`` frames."""
    best: tuple[float, int, ByteArray] | None = None
    number = 0
    while True:
        there, frame = reader.read()
        if best is not None and (not there or number % stretch == 0):
            yield best[1], best[2]
            best = None
        if not there:
            return
        sharpness = _sharpness(np.asarray(frame, np.uint8))
        if best is None or sharpness > best[0]:
            best = sharpness, number, np.asarray(frame, np.uint8)
        number += 1


def _sharpness(frame: ByteArray) -> float:
    """Variance of the Laplacian at ``SHARPNESS_PX``."""
    scale = min(1.0, SHARPNESS_PX / max(frame.shape[:2]))
    small = cv2.resize(grey(frame), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(small, cv2.CV_32F).var())
