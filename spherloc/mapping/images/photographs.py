"""The photographs from which a map is made: a folder's images with their cameras."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from spherloc.cameras.base import Camera
from spherloc.datasets.asl import asl_cameras, image_times
from spherloc.datasets.asl_layout import DATA, SENSOR, AslSequence, asl_sequence, of_all_cameras
from spherloc.datasets.given_path import images_in_folders
from spherloc.errors import InputError, shorten
from spherloc.files import is_folder, is_image, names_in
from spherloc.frontend.masks import Masks
from spherloc.frontend.view import View
from spherloc.mapping.advice import advice
from spherloc.mapping.images.folder_cameras import CalibratedLens, CameraSources, LensFinder, images_of_folder
from spherloc.mapping.images.found_calibrations import FoundCalibrations, calibrations_in, calibrations_of
from spherloc.mapping.images.frames import MAX_IMAGES, FrameChoice, ImageFolder, chosen
from spherloc.mapping.images.left_out import (
    about_deeper,
    about_subfolders,
    counted,
    known_otherwise,
    some_of,
)

MIN_IMAGES = 2


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
        sources = CameraSources(cameras, beside, panorama, find_lens, of_map)
        views, about, lens = images_of_folder(folder, places[0], sources)
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
            found, about, lens = images_of_folder(
                folder, place, CameraSources(given, beside, panorama, find_lens, mapped)
            )
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
