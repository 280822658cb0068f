"""The photographs from which a map is made: a folder's images with their cameras."""

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

from spherloc.cameras.base import Camera
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.principal_point import about_principal_point
from spherloc.datasets.asl import asl_cameras, image_times
from spherloc.datasets.asl_layout import DATA, SENSOR, AslSequence, asl_sequence, of_all_cameras
from spherloc.datasets.given_path import images_in_folders
from spherloc.errors import InputError, shorten
from spherloc.files import is_folder, is_image, names_in
from spherloc.frontend.masks import Masks
from spherloc.frontend.view import View
from spherloc.images import DamagedImageError, check_image, is_turned
from spherloc.mapping.advice import advice
from spherloc.mapping.images.found_calibrations import FoundCalibrations, calibrations_in, calibrations_of
from spherloc.mapping.images.frames import MAX_IMAGES, FrameChoice, ImageFolder, chosen
from spherloc.mapping.images.full_panorama import full_panoramas, near_two_to_one
from spherloc.mapping.images.left_out import (
    MAX_NAMED,
    about_damaged,
    about_deeper,
    about_raw,
    about_refused,
    about_subfolders,
    about_turned,
    about_unread,
    counted,
    known_otherwise,
    some_of,
    without_photographs,
)
from spherloc.mapping.images.lens import for_colmap
from spherloc.trajectory import NS_PER_S

MIN_IMAGES = 2


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
class Photographs:
    """Images with their cameras, in the order of names, and remarks on the others."""

    views: tuple[View, ...]
    remarks: tuple[str, ...]
    cameras: Mapping[str, Camera]
    """The calibrations that were given or found, by name or by the folder of their images."""
    calibrated: Mapping[str, CalibratedLens] = field(default_factory=dict)
    """Those that the images themselves told, by their folder in that of the map; empty for that itself."""
    others: int = 0
    """Number of images that were not looked at, since enough others were chosen."""


def photographs(
    folder: Path,
    cameras: Mapping[str, Camera],
    masks: Masks | None = None,
    panorama: bool = False,
    find_lens: LensFinder | None = None,
    choice: FrameChoice = FrameChoice(),  # noqa: B008 -- frozen
) -> Photographs:
    """The images from which a map can be made: ``with_cameras``, without the pixels that ``masks`` leave out.

    Raises ``InputError`` as that does, and if there are fewer than two images or too many, or if no image has a mask.
    """
    found = with_cameras(folder, cameras, panorama, find_lens, choice=choice)
    found = replace(found, remarks=(*_about_other_cameras(folder), *found.remarks))
    views, remarks = found.views, found.remarks
    if len(views) < MIN_IMAGES:
        raise InputError(
            f"{folder}: has {counted(len(views), 'photograph')} with a known camera; a map needs {MIN_IMAGES} or "
            f"more, better ten. {' '.join(remarks)}".rstrip()
        )
    if len(views) > MAX_IMAGES:
        raise InputError(
            f"{folder}: {len(views)} photographs of all cameras are too many for a map, {MAX_IMAGES} at "
            f'most; {advice("fewer images")}, or map them with COLMAP and open its model as kind = "colmap".'
        )
    if masks is None:
        return found
    masked, without = masks.on(views)
    return replace(found, views=tuple(masked), remarks=(*remarks, *without))


def with_cameras(
    folder: Path,
    cameras: Mapping[str, Camera],
    panorama: bool = False,
    find_lens: LensFinder | None = None,
    of_map: Mapping[str, Camera] | None = None,
    choice: FrameChoice = FrameChoice(),  # noqa: B008 -- frozen
) -> Photographs:
    """The images of a folder or, if it has none, of the folders in it, with their cameras; of a sequence in the ASL
    layout those of its cameras. Where they are many, those that ``chosen`` takes by ``choice``.

    ``cameras`` are those of a calibration file, by name; without them, calibrations beside the images are taken, and
    for a folder in ``folder`` also one beside it that has its name, or a file there with several cameras. A single
    camera is that of all images. Of several with the size of an image it is the one whose name is in the image's name,
    or that of its folder; a camera that has only a number is that of the folder with this number. Images of about
    2 to 1 count as panoramas where no camera has their size, if they show the whole sphere (``are_full_panoramas``) or
    with ``panorama``. If no camera is known of the images of a folder, ``find_lens`` calibrates that of those of one
    size, the most frequent.

    Of images that are to be localized in a map, ``of_map`` are the cameras of that, by name; they count for sizes for
    which there is no calibration. Those images may have any camera model, not only one of COLMAP's.

    Raises ``InputError`` if the folder has no photographs, if their camera is unknown, or if it has no model in COLMAP.
    """
    if not is_folder(folder):
        raise InputError(known_otherwise(folder) or f"{folder}: is not a folder; give the folder of the photographs.")
    there = names_in(folder)
    sequence = asl_sequence(folder)
    inside = {} if sequence else images_in_folders(folder, [name for name in there if not is_image(name)])
    remarks: list[str] = []
    own: dict[str, FoundCalibrations] = {}
    if sequence is not None:
        places, own, remarks = _of_sequence(folder, sequence)
    elif any(is_image(name) for name in there) or not inside:
        places = [ImageFolder("", "", tuple(there))]
    else:
        places = [ImageFolder(name, name, tuple(names_in(folder / name))) for name in sorted(inside)]
    there_are = sum(len(place.names) for place in places)
    places, about_choice = chosen(folder, places, choice)
    others = there_are - sum(len(place.names) for place in places)
    remarks += about_choice
    known = dict(cameras)
    views: list[View] = []
    calibrated: dict[str, CalibratedLens] = {}
    if sequence is None and not places[0].inside:
        beside = calibrations_in(folder, images=_images_of(places[0]))
        known = known or dict(beside.cameras)
        views, about, lens = _of_folder(folder, places[0], cameras, beside, panorama, find_lens, of_map)
        calibrated |= {} if lens is None else {"": lens}
        remarks += [*about, *about_subfolders(inside)]
        return Photographs(tuple(views), tuple(remarks), known, calibrated, others)
    folders = [place.camera for place in places]
    shared = {} if sequence else calibrations_of([folder / name for name in there], least=2).cameras
    for place in places:
        try:
            given, common = (_belonging(some, place.camera, folders) for some in (cameras, shared))
            mapped = None if of_map is None else _belonging(of_map, place.camera, folders)
            beside = own[place.camera] if sequence else calibrations_in(folder, place.camera, _images_of(place))
            if not beside.cameras:
                beside = replace(beside, cameras=common)
            found, about, lens = _of_folder(folder, place, given, beside, panorama, find_lens, mapped)
            calibrated |= {} if lens is None else {place.camera if place.inside else "": lens}
        except InputError as error:
            found, about = [], [f"It is left out: {error}"]
        else:
            about = [*about, *_about_another(found, given or beside.cameras, place.camera, folders)]
        views += found
        if len(cameras_of(found)) == 1:
            known[place.camera] = found[0].camera
        remarks += [f"{shorten(place.camera)}: {remark}" for remark in about]
    remarks += [] if sequence else about_deeper(folder, [name for name in there if name not in inside])
    return Photographs(tuple(views), tuple(remarks), known, calibrated, others)


def _of_sequence(
    root: Path, sequence: AslSequence
) -> tuple[list[ImageFolder], dict[str, FoundCalibrations], list[str]]:
    """The image folders of a sequence in ``root``, their calibrations by the name of the camera, and remarks."""
    known = asl_cameras(sequence)
    places, calibrations, remarks = [], {}, list(known.remarks)
    if sequence.empty:
        remarks.append(f"Without images in a folder {DATA}, and left out: {some_of(sequence.empty)}.")
    for name, images in sequence.cameras.items():
        times = image_times(images)
        inside = "" if images == root else images.relative_to(root).as_posix()
        places.append(ImageFolder(inside, name, tuple(names_in(images)), times.times_ns))
        own = known.by_name.get(name)
        if own is None:
            others = [place / file for place in (images, images.parent) for file in names_in(place) if file != SENSOR]
            calibrations[name] = calibrations_of(others)
        else:
            calibrations[name] = FoundCalibrations({sequence.called(own.file): own.camera})
        remarks += times.remarks
    return places, calibrations, remarks


def _about_other_cameras(folder: Path) -> list[str]:
    """That a folder has the images of one camera of a sequence with several, and where all of them are."""
    sequence = asl_sequence(folder)
    if sequence is None or (whole := of_all_cameras(sequence)).cameras.keys() == sequence.cameras.keys():
        return []
    return [
        f"These are the images of {some_of(tuple(sequence.cameras))} of a recorded sequence; for a map of all of its "
        f"cameras, {some_of(tuple(whole.cameras))}, {advice('all cameras').format(folder=whole.folder)}."
    ]


def _images_of(place: ImageFolder) -> list[str]:
    return [name for name in place.names if is_image(name)]


def cameras_of(views: Sequence[View]) -> dict[str, Camera]:
    """The different cameras of the views, by how they are described."""
    return {repr(view.camera): view.camera for view in views}


def _belonging(cameras: Mapping[str, Camera], folder: str, folders: Sequence[str]) -> Mapping[str, Camera]:
    """The camera that has the name of a folder, or its number if every folder has that of one; else all."""
    called = next((name for name in cameras if name.lower() == folder.lower()), None)
    if called is not None:
        return {called: cameras[called]}
    of_number = {int(name): name for name in cameras if name.isdigit()}
    numbers = {name: int(found[0]) for name in folders if len(found := re.findall(r"[0-9]+", name)) == 1}
    if len(set(numbers.values()) & of_number.keys()) == len(folders):
        name = of_number[numbers[folder]]
        return {name: cameras[name]}
    return cameras


def _about_another(
    views: Sequence[View], cameras: Mapping[str, Camera], folder: str, folders: Sequence[str]
) -> list[str]:
    """That the images of a folder have the only camera of their size, but another folder is called as that camera."""
    sizes = {(view.camera.width, view.camera.height) for view in views}
    fitting = [name for name, camera in cameras.items() if (camera.width, camera.height) in sizes]
    others = {name.lower() for name in folders if name.lower() != folder.lower()}
    if len(fitting) != 1 or fitting[0].lower() not in others:
        return []
    return [
        f"Camera {shorten(fitting[0])} is taken for its images, which have that size, but another folder is called so; "
        "put the calibration of this one's camera beside them if it differs."
    ]


def _of_folder(
    root: Path,
    place: ImageFolder,
    given: Mapping[str, Camera],
    beside: FoundCalibrations,
    panorama: bool,
    find_lens: LensFinder | None,
    of_map: Mapping[str, Camera] | None,
) -> tuple[list[View], list[str], CalibratedLens | None]:
    """The images of a folder in ``root``, or of ``root`` itself, remarks on others, and the camera that ``find_lens``
    found, if it was needed.

    ``given`` are the cameras that the user gave, ``beside`` those of files beside the images, ``of_map`` those of the
    map in which the images are to be localized, else None. Raises ``InputError`` if it has no images, or if their
    camera is unknown or, without ``of_map``, has no model in COLMAP.
    """
    folder = root / place.inside
    sizes: dict[tuple[int, int], list[str]] = {}
    damaged, refused, others = [], [], []
    for name in place.names:
        if not is_image(name):
            others.append(name)
            continue
        try:
            sizes.setdefault(check_image(folder / name), []).append(name)
        except DamagedImageError:
            damaged.append(name)
        except InputError as error:
            refused.append(str(error))
    remarks = [*about_damaged(damaged), *about_refused(refused), *about_unread(others)]
    if not sizes:
        raise InputError(without_photographs(folder, remarks, of_map is not None))
    cameras = given or {
        name: camera
        for name, camera in beside.cameras.items()
        if not (panorama and near_two_to_one((camera.width, camera.height)))
    }
    camera_of: dict[str, Camera] = {}
    raw: list[str] = []
    resized: list[str] = []
    shapes: list[str] = []
    for size, names in sizes.items():
        own = {} if given else _own_cameras(names, size, beside, cameras)
        found, about = _with_cameras([name for name in names if name not in own], size, cameras)
        found |= own
        if of_map:
            others_of_map, about_them = _with_cameras([name for name in names if name not in found], size, of_map)
            found, about = found | others_of_map, about + about_them
        if not given and not found and near_two_to_one(size):
            panoramas = full_panoramas(folder, names, size, stated=panorama)
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
    unused = [] if given or used or panorama else beside.unused(sizes)
    remarks += unused
    unusable = bool(unused)
    remarks += [*about_raw(raw), *shapes]
    unused = [*unused, *shapes]
    no_lens = {*raw, *resized}
    sizes = {size: plain for size, names in sizes.items() if (plain := [name for name in names if name not in no_lens])}
    if not sizes and not camera_of:
        is_raw = f"its photographs are raw images of two lenses; {advice('two circles')}."
        raise InputError(f"{folder}: {' '.join([*([is_raw] if raw else []), *shapes])}")
    rest = sorted(name for names in sizes.values() for name in names if name not in camera_of)
    lens: CalibratedLens | None = None
    if rest and panorama and of_map is None and not camera_of and not given:
        raise InputError(
            f"{folder}: its photographs, {_told(sizes)}, are no full panoramas, which are twice as wide as high; "
            f"{advice('no panoramas')}."
        )
    if rest and not camera_of and not given:
        order = sorted(sizes, key=lambda size: -len(sizes[size]))
        files = "their calibration" if len(sizes) == 1 else "a file with the calibrations of all of them"
        put_it = advice("calibration").format(files=files)
        unknown = f"{folder}: its photographs, {_told(sizes)}, are not full panoramas (2 to 1)"
        if of_map is not None:
            lenses = [camera for camera in of_map.values() if not isinstance(camera, Equirectangular)]
            nor = f" and of no camera of the map ({_sizes(lenses)} pixels)" if lenses else ""
            raise InputError(" ".join((f"{unknown}{nor}; put {files} into that folder.", *unused)))
        if find_lens is None:
            raise InputError(" ".join((f"{unknown}; {put_it}.", *unused)))
        try:
            lens = find_lens([folder / name for name in sizes[order[0]]], order[0])
        except InputError as error:
            none = "have no calibration that can be used" if unusable else "have no calibration"
            raise InputError(" ".join((f"{unknown} and {none}, and {error}. Or {put_it}.", *unused))) from None
        camera_of = dict.fromkeys(sizes[order[0]], lens.camera)
        rest = [name for name in rest if name not in camera_of]
        remarks.append(lens.how)
    if rest:
        width, height = next(size for size, names in sizes.items() if rest[0] in names)
        of_another_size = bool(given) and all((one.width, one.height) != (width, height) for one in given.values())
        and_so = f", but the calibration is for {_sizes(given.values())}." if of_another_size else "."
        if of_map is not None:
            and_so = "; put its calibration into that folder."
        if near_two_to_one((width, height)) and not given and width != 2 * height:
            and_so = f"{and_so[:-1]}; full panoramas are twice as wide as high."
        if any((one.height, one.width) == (width, height) for one in camera_of.values()):
            and_so = ", on its side: orientation tags are not used, so store it as the others are."
        remarks.append(
            f"{len(rest)} of {len(rest) + len(camera_of)} images were left out, as their camera is not known; the "
            f"first is {shorten(rest[0])} with {width} x {height} pixels{and_so}"
        )
    full = [name for name, camera in camera_of.items() if isinstance(camera, Equirectangular)]
    remarks += about_turned(sorted(name for name in full if is_turned(folder / name)))
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
    return views, remarks, lens


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
