"""The photographs from which a map is made: a folder's images with their camera, or the sharpest frames of a video."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import ceil
from pathlib import Path

import cv2
import numpy as np

from spherloc.cameras.base import Camera
from spherloc.cameras.calibration import load_camera
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.datasets.given_path import SCENE, images_in_folders, what_it_is
from spherloc.errors import InputError, SpherlocError, shorten
from spherloc.files import IMAGES, is_file, is_folder, is_image, names_in
from spherloc.frontend.masks import Masks
from spherloc.frontend.view import View
from spherloc.images import check_image, grey
from spherloc.mapping.lens import for_colmap
from spherloc.types import ByteArray

MIN_IMAGES = 2
MAX_IMAGES = 500
"""Largest number of images of a map: the features of each take 4 MB."""
MIN_PANORAMA_PX = 200
"""Least length of the longer side of a panorama."""
UNREAD = {".arw", ".avif", ".cr2", ".cr3", ".dng", ".gpr", ".heic", ".heif", ".insp", ".nef", ".orf", ".raf", ".rw2"}
"""Endings of photographs that OpenCV does not read."""
MAX_NAMED = 3
"""Largest number of names in a remark."""
CALIBRATIONS = (".yaml", ".yml", ".json", ".toml", ".txt")
MAX_CALIBRATIONS = 20
"""Largest number of files beside the photographs that are tried as a calibration."""
SHARPNESS_PX = 512
"""Frames are scaled to this longer side before their sharpness is compared."""


@dataclass(frozen=True)
class Photographs:
    """The images that can be mapped, in the order of names, and remarks on the others."""

    views: tuple[View, ...]
    remarks: tuple[str, ...]


def photographs(folder: Path, cameras: Mapping[str, Camera], masks: Masks | None = None) -> Photographs:
    """The images of a folder or, if it has none, of the folders in it, each of which has one camera.

    ``cameras`` are those of a calibration file, by name: a single one is the camera of all images, one of several that
    of the folder with its name, and the first one that of a folder of images. Where no camera is given, images of 2 to
    1 count as panoramas, and for others a calibration of their size is sought beside them, and beside their folder
    under its name. Pixels that ``masks`` leave out give no features.

    Raises ``InputError`` if there are fewer than two images with a camera or too many, if no image has a mask, or if
    a camera has no model in COLMAP.
    """
    if not is_folder(folder):
        raise InputError(what_it_is(folder) or f"{folder}: is not a folder; give the folder of the photographs.")
    there = names_in(folder)
    inside = images_in_folders(folder, [name for name in there if not is_image(name)])
    views: list[View] = []
    remarks: list[str] = []
    if any(is_image(name) for name in there) or not inside:
        views, remarks = _of_one_camera(folder, "", next(iter(cameras.values()), None))
        if len(cameras) > 1:
            first, *others = cameras
            given = f"The calibration file has {len(cameras)} cameras, of which {first} is taken"
            remarks.append(f"{given}; --camera-name gives {' or '.join(others)}.")
        remarks += _about_subfolders(inside)
    else:
        for name in sorted(inside):
            camera = next(iter(cameras.values())) if len(cameras) == 1 else cameras.get(name)
            try:
                found, about = _of_one_camera(folder, name, camera)
            except InputError as error:
                named = f" The calibration file's cameras are {' and '.join(cameras)}." if len(cameras) > 1 else ""
                remarks.append(f"The folder {shorten(name)} is left out: {error}{named}")
                continue
            views += found
            remarks += [f"{shorten(name)}: {remark}" for remark in about]
    if len(views) < MIN_IMAGES:
        raise InputError(
            f"{folder}: has {_counted(len(views), 'photograph')} with a known camera; a map needs {MIN_IMAGES} or "
            f"more, better ten. {' '.join(remarks)}".rstrip()
        )
    if len(views) > MAX_IMAGES:
        raise InputError(
            f"{folder}: has {len(views)} photographs, more than {MAX_IMAGES}; take every n-th of them, or map "
            'them with COLMAP and open its model as kind = "colmap".'
        )
    if masks is not None:
        masked, without = masks.on(views)
        views, remarks = list(masked), [*remarks, *without]
    return Photographs(tuple(views), tuple(remarks))


def _of_one_camera(root: Path, inside: str, camera: Camera | None) -> tuple[list[View], list[str]]:
    """The images of the folder ``inside`` of ``root``, or of ``root`` itself if that is empty, and remarks on others.

    Raises ``InputError`` if it has none, or if their camera is unknown or has no model in COLMAP.
    """
    folder = root / inside
    sizes: dict[tuple[int, int], list[str]] = {}
    damaged, others = [], []
    for name in names_in(folder):
        if not is_image(name):
            others.append(name)
            continue
        try:
            sizes.setdefault(check_image(folder / name), []).append(name)
        except InputError:
            damaged.append(name)
    remarks = [*_about_damaged(damaged), *_about_unread(others)]
    if not sizes:
        raise InputError(_without_photographs(folder, remarks))
    if camera is None:
        camera, about_calibration = _camera_of(root, inside, sorted(sizes, key=lambda key: -len(sizes[key])))
        remarks += about_calibration
    width, height = camera.width, camera.height
    names = sizes.pop((width, height), [])
    rest = sorted(name for same in sizes.values() for name in same)
    if rest:
        remarks.append(
            f"{len(rest)} of {len(rest) + len(names)} images were left out, as they are not {width} x {height} "
            f"pixels; the first is {shorten(rest[0])}."
        )
    camera, about_lens = for_colmap(camera)
    if about_lens:
        remarks.append(about_lens)
    views = [View((Path(inside) / name).as_posix(), camera, folder / name) for name in sorted(names)]
    return views, remarks


def _about_damaged(names: Sequence[str]) -> list[str]:
    if not names:
        return []
    return [f"{_were(len(names), 'image')} left out, damaged or empty: {_some(names)}; copy again what is needed."]


def _about_unread(names: Sequence[str]) -> list[str]:
    unread = [name for name in names if Path(name).suffix.lower() in UNREAD and not name.startswith(".")]
    if not unread:
        return []
    kinds = ", ".join(sorted({Path(name).suffix.lower() for name in unread}))
    return [f"{_were(len(unread), 'photograph')} left out: {_some(unread)}; convert {kinds} to JPEG or PNG."]


def _about_subfolders(inside: Mapping[str, int]) -> list[str]:
    if not inside:
        return []
    left = f"{_were(sum(inside.values()), 'image')} left out, in subfolders: {_some(list(inside))}"
    return [f"{left}; put each camera's images into a folder of its own to have them too."]


def _without_photographs(folder: Path, remarks: Sequence[str]) -> str:
    """Why a folder has nothing to map, and what to do."""
    if remarks:
        return f"{folder}: has no photographs that can be read. {' '.join(remarks)}"
    known = what_it_is(folder)
    if known and SCENE not in known:
        return known
    return f"{folder}: has no photographs ({', '.join(sorted(IMAGES))}); give the folder that has them."


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


def _were(count: int, what: str) -> str:
    return f"{_counted(count, what)} {'was' if count == 1 else 'were'}"


def _some(names: Sequence[str]) -> str:
    return f"{', '.join(shorten(name) for name in names[:MAX_NAMED])}{', …' if len(names) > MAX_NAMED else ''}"


def _camera_of(root: Path, inside: str, sizes: Sequence[tuple[int, int]]) -> tuple[Camera, list[str]]:
    """A camera for the first of the sizes that is a panorama's or has a calibration, and remarks."""
    folder = root / inside
    for size in sizes:
        width, height = size
        if width == 2 * height and width >= MIN_PANORAMA_PX:
            return Equirectangular(width, height), []
        camera, name = _calibration_in(folder, size)
        if camera is not None:
            return camera, [f"The calibration is {shorten(name)}, which lies beside the photographs."]
        camera, name = _calibration_in(root, size, inside) if inside else (None, "")
        if camera is not None:
            return camera, [f"The calibration is {shorten(name)}, which lies beside the folder."]
    width, height = sizes[0]
    raise InputError(
        f"{folder}: its photographs are {width} x {height} pixels, so they are not full panoramas (2 to 1); "
        f"give their calibration with --camera FILE{f', which calls it {inside}' if inside else ''}."
    )


def _calibration_in(folder: Path, size: tuple[int, int], stem: str = "") -> tuple[Camera | None, str]:
    """The first camera of that width and height among the files of a folder, and the file's name; only of files that
    are called ``stem``, if that is not empty."""
    names = [name for name in names_in(folder) if Path(name).suffix.lower() in CALIBRATIONS]
    names = [name for name in names if not stem or Path(name).stem == stem]
    for name in names[:MAX_CALIBRATIONS]:
        try:
            camera = load_camera(folder / name)
        except SpherlocError:  # not a calibration
            continue
        if (camera.width, camera.height) == size:
            return camera, name
    return None, ""


def frames_of(video: Path, folder: Path, count: int, advance: Callable[[str], None]) -> int:
    """Write about ``count`` frames of a video into ``folder`` and return their number.

    The video is divided into equal pieces, of which the sharpest frame each is written. ``advance`` is called after
    each frame with its file name. Existing frames are not written again. Raises ``InputError`` if the video cannot be
    read or the folder cannot be written.
    """
    if not is_file(video):
        raise InputError(f"{video}: is not a file; give a video.")
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
