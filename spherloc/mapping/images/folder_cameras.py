"""The images of one folder with their cameras: those that were given, those of files beside the images, or the lens
that the images tell."""

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from spherloc.cameras.base import Camera
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.principal_point import about_principal_point
from spherloc.errors import InputError, shorten
from spherloc.files import is_image
from spherloc.frontend.view import View
from spherloc.images import DamagedImageError, check_image, orientation_of
from spherloc.mapping.advice import advice
from spherloc.mapping.images.found_calibrations import FoundCalibrations
from spherloc.mapping.images.frames import ImageFolder
from spherloc.mapping.images.full_panorama import full_panoramas, near_two_to_one
from spherloc.mapping.images.left_out import (
    MAX_NAMED,
    about_damaged,
    about_raw,
    about_refused,
    about_turned,
    about_unread,
    some_of,
    without_photographs,
)
from spherloc.mapping.images.lens import for_colmap
from spherloc.trajectory import NS_PER_S

Sizes = Mapping[tuple[int, int], Sequence[str]]
"""Names of images by their size (width, height)."""
SIDEWAYS = 5
"""From this orientation tag on, programs show an image turned by 90 degrees, one way or the other."""


class CalibratedLens(NamedTuple):
    """A lens that was calibrated by the images that it took."""

    camera: Camera
    how: str
    """How it was, in sentences."""
    untold: str = ""
    """A part of a sentence that says why pairs of the images do not tell it, so that only their map may; empty if they
    do."""


LensFinder = Callable[[Sequence[Path], tuple[int, int]], CalibratedLens]
"""Calibrates a lens by images, all of a size (width, height); raises ``InputError`` with a part of a sentence if they
do not tell it."""


@dataclass(frozen=True)
class CameraSources:
    """Where the cameras of a folder's images may be from."""

    given: Mapping[str, Camera]
    """What the user gave, by name."""
    beside: FoundCalibrations
    """Files beside the images."""
    panorama: bool
    """Whether the user says that images of about 2 to 1 are panoramas."""
    find_lens: LensFinder | None
    """What calibrates a lens of which no camera is known."""
    of_map: Mapping[str, Camera] | None
    """The cameras of the map in which the images are to be localized; None if a map is made of them."""

    @property
    def calibrations(self) -> Mapping[str, Camera]:
        """What was given, else what lies beside the images and is not of panoramas."""
        return self.given or {
            name: camera
            for name, camera in self.beside.cameras.items()
            if not (self.panorama and near_two_to_one((camera.width, camera.height)))
        }


class FolderImages(NamedTuple):
    """The images of a folder, remarks on others, and the lens that ``find_lens`` found, if it was needed."""

    views: list[View]
    remarks: list[str]
    lens: CalibratedLens | None


def images_of_folder(root: Path, place: ImageFolder, sources: CameraSources) -> FolderImages:
    """The images of a folder in ``root``, or of ``root`` itself.

    Raises ``InputError`` if it has no images, or if their camera is unknown or, where a map is made of them, has no
    model in COLMAP.
    """
    folder, of_map = root / place.inside, sources.of_map
    sizes, remarks = _by_size(folder, place.names)
    if not sizes:
        raise InputError(without_photographs(folder, remarks, of_map is not None))
    known = _known(folder, sizes, sources)
    unused = [*known.unused, *known.shapes]
    remarks += [*known.remarks, *known.unused, *about_raw(known.raw), *known.shapes]
    camera_of = known.camera_of
    lensed = {size: plain for size, names in sizes.items() if (plain := [one for one in names if one in known.lensed])}
    if not lensed and not camera_of:
        is_raw = f"its photographs are raw images of two lenses; {advice('two circles')}."
        raise InputError(f"{folder}: {' '.join([*([is_raw] if known.raw else []), *known.shapes])}")
    lens: CalibratedLens | None = None
    if lensed and not camera_of and not sources.given:
        lens = _by_lens(folder, lensed, sources, unused, bool(known.unused))
        camera_of = dict.fromkeys(max(lensed.values(), key=len), lens.camera)
        remarks.append(lens.how)
    remarks += _about_rest(lensed, camera_of, sources)
    full = [name for name, camera in camera_of.items() if isinstance(camera, Equirectangular)]
    remarks += about_turned(sorted(name for name in full if orientation_of(folder / name) > 1))
    for_model: dict[str, Camera] = {}
    for camera in camera_of.values():
        if repr(camera) not in for_model:
            for_model[repr(camera)], about_lens = for_colmap(camera) if of_map is None else (camera, "")
            remarks += [about_lens] if about_lens else []
    views = []
    for name in sorted(camera_of):
        time_ns = place.times_ns.get(name)
        time_s = None if time_ns is None else time_ns / NS_PER_S
        camera = for_model[repr(camera_of[name])]
        views.append(View(place.name_of(name), camera, folder / name, timestamp_s=time_s))
    return FolderImages(views, remarks, lens)


def _by_size(folder: Path, names: Sequence[str]) -> tuple[dict[tuple[int, int], list[str]], list[str]]:
    """The images of a folder by their size, and remarks on what is none that can be used."""
    sizes: dict[tuple[int, int], list[str]] = {}
    damaged, refused, others = [], [], []
    for name in names:
        if not is_image(name):
            others.append(name)
            continue
        try:
            sizes.setdefault(check_image(folder / name), []).append(name)
        except DamagedImageError:
            damaged.append(name)
        except InputError as error:
            refused.append(str(error))
    return sizes, [*about_damaged(damaged), *about_refused(refused), *about_unread(others)]


class _Known(NamedTuple):
    """The cameras that are known of a folder's images."""

    camera_of: dict[str, Camera]
    remarks: list[str]
    unused: list[str]
    """Why no calibration beside the images is used, a sentence each."""
    raw: list[str]
    """Images of two lenses beside each other that are not stitched."""
    shapes: list[str]
    """Remarks on images that are nearly panoramas."""
    lensed: set[str]
    """Images that may be of an unknown lens, and those whose camera is known."""


def _known(folder: Path, sizes: Sizes, sources: CameraSources) -> _Known:
    """The cameras of images as calibrations and shapes tell them."""
    given, beside, of_map, cameras = sources.given, sources.beside, sources.of_map, sources.calibrations
    camera_of: dict[str, Camera] = {}
    remarks: list[str] = []
    raw, resized, shapes = list[str](), list[str](), list[str]()
    for size, names in sizes.items():
        own = {} if given else _own_cameras(names, size, beside, cameras)
        found, about = _with_cameras([name for name in names if name not in own], size, cameras)
        found |= own
        if of_map:
            others_of_map, about_them = _with_cameras([name for name in names if name not in found], size, of_map)
            found, about = found | others_of_map, about + about_them
        if not given and not found and near_two_to_one(size):
            panoramas = full_panoramas(folder, names, size, stated=sources.panorama)
            found = dict.fromkeys(panoramas.names, Equirectangular(*size))
            raw += panoramas.raw
            resized += panoramas.resized
            shapes += panoramas.remarks
        camera_of |= found
        remarks += about
    used = [name for name, camera in cameras.items() if any(camera is one for one in camera_of.values())]
    if used and not given:
        remarks.append(f"The calibration found beside them: {', '.join(map(shorten, used))}.")
        remarks += [f"{shorten(name)}: {beside.concluded[name]}" for name in used if name in beside.concluded]
        remarks += beside.of_image_refused[:MAX_NAMED]
    remarks += [about for name in used if (about := about_principal_point(name, cameras[name]))]
    unused = [] if given or used or sources.panorama else beside.unused(sizes)
    lensed = {name for names in sizes.values() for name in names} - {*raw, *resized}
    return _Known(camera_of, remarks, unused, raw, shapes, lensed)


def _by_lens(
    folder: Path, sizes: Sizes, sources: CameraSources, unused: Sequence[str], unusable: bool
) -> CalibratedLens:
    """The lens of images without a known camera, those of the most frequent size; raises ``InputError`` if they do not
    tell it, with the sentences ``unused`` on calibrations, which are ``unusable``, and shapes."""
    lying = [name for size, names in sizes.items() if near_two_to_one((size[1], size[0])) for name in names]
    if lying and all(orientation_of(folder / name) >= SIDEWAYS for name in lying):
        raise InputError(
            f"{folder}: its photographs, {_told(sizes)}, are panoramas that are stored on their side, with an "
            "orientation tag, which is not used; save them turned, so that they are twice as wide as high."
        )
    if sources.panorama and sources.of_map is None:
        raise InputError(
            f"{folder}: its photographs, {_told(sizes)}, are no full panoramas, which are twice as wide as high; "
            f"{advice('no panoramas')}."
        )
    size = max(sizes, key=lambda size: len(sizes[size]))
    files = "their calibration" if len(sizes) == 1 else "a file with the calibrations of all of them"
    put_it = advice("calibration").format(files=files)
    unknown = f"{folder}: its photographs, {_told(sizes)}, are not full panoramas (2 to 1)"
    if sources.of_map is not None:
        lenses = [camera for camera in sources.of_map.values() if not isinstance(camera, Equirectangular)]
        nor = f" and of no camera of the map ({_sizes(lenses)} pixels)" if lenses else ""
        raise InputError(" ".join((f"{unknown}{nor}; put {files} into that folder.", *unused)))
    if sources.find_lens is None:
        raise InputError(" ".join((f"{unknown}; {put_it}.", *unused)))
    try:
        return sources.find_lens([folder / name for name in sizes[size]], size)
    except InputError as error:
        none = "have no calibration that can be used" if unusable else "have no calibration"
        raise InputError(" ".join((f"{unknown} and {none}, and {error}. Or {put_it}.", *unused))) from None


def _about_rest(sizes: Sizes, camera_of: Mapping[str, Camera], sources: CameraSources) -> list[str]:
    """That images are left out since their camera is not known, and why."""
    rest = sorted(name for names in sizes.values() for name in names if name not in camera_of)
    if not rest:
        return []
    given = sources.given
    width, height = next(size for size, names in sizes.items() if rest[0] in names)
    of_another_size = bool(given) and all((one.width, one.height) != (width, height) for one in given.values())
    and_so = f", but the calibration is for {_sizes(given.values())}." if of_another_size else "."
    if sources.of_map is not None:
        and_so = "; put its calibration into that folder."
    if near_two_to_one((width, height)) and not given and width != 2 * height:
        and_so = f"{and_so[:-1]}; full panoramas are twice as wide as high."
    if any((one.height, one.width) == (width, height) for one in camera_of.values()):
        and_so = ", on its side: orientation tags are not used, so store it as the others are."
    return [
        f"{len(rest)} of {len(rest) + len(camera_of)} images were left out, as their camera is not known; the "
        f"first is {shorten(rest[0])} with {width} x {height} pixels{and_so}"
    ]


def _told(sizes: Mapping[tuple[int, int], Sequence[str]]) -> str:
    """How many images there are of each size, the most frequent first."""
    order = sorted(sizes, key=lambda size: -len(sizes[size]))
    return ", ".join(f"{len(sizes[size])} of {size[0]} x {size[1]} pixels" for size in order[:MAX_NAMED])


def _sizes(cameras: Collection[Camera]) -> str:
    """The different sizes of cameras: "400 x 300 and 640 x 480"."""
    sizes = sorted({(camera.width, camera.height) for camera in cameras})
    return " and ".join(f"{width} x {height}" for width, height in sizes[:MAX_NAMED])


def _own_cameras(
    names: Sequence[str], size: tuple[int, int], beside: FoundCalibrations, cameras: Mapping[str, Camera]
) -> dict[str, Camera]:
    """Those of ``cameras`` of images of one size whose own files hold them, by the image's name."""
    found = {name: beside.of_image[name] for name in names if name in beside.of_image}
    usable = {id(camera) for camera in cameras.values() if (camera.width, camera.height) == size}
    return {name: camera for name, camera in found.items() if id(camera) in usable}


def _with_cameras(
    names: Sequence[str], size: tuple[int, int], cameras: Mapping[str, Camera]
) -> tuple[dict[str, Camera], list[str]]:
    """The cameras of images of one size, by the image's name, and remarks."""
    if not names:
        return {}, []
    fitting = {name: camera for name, camera in cameras.items() if (camera.width, camera.height) == size}
    if not fitting:
        return {}, []
    if len({repr(camera) for camera in fitting.values()}) == 1:
        return dict.fromkeys(names, next(iter(fitting.values()))), []
    found = {}
    for name in names:
        called = [camera for camera in fitting if is_called(camera, name)]
        if called:
            found[name] = fitting[max(called, key=len)]
    if found:
        return found, []
    first, *others = fitting
    taken = f"Camera {shorten(first)} is taken for all images of {size[0]} x {size[1]} pixels"
    choice = f"but {some_of(others)} would fit, too; {advice('which camera')}."
    return dict.fromkeys(names, fitting[first]), [f"{taken}, {choice}"]


def is_called(camera: str, image: str) -> bool:
    """Whether the name of a camera is a part of an image's name; COLMAP's numbers of cameras are not looked for there,
    where a digit may mean anything."""
    if not camera or camera.isdigit():
        return False
    plain, word = (name.lower().replace("_", "-") for name in (image, camera))
    after = "0-9" if word[-1].isdigit() else "a-z"
    return re.search(f"(?<![a-z0-9]){re.escape(word)}(?![{after}])", plain) is not None
