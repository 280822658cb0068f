"""Cameras that are fixed to each other: what a calibration says of it, and which images they took together."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from spherloc.cameras.base import Camera
from spherloc.cameras.calibration import load_camera
from spherloc.cameras.rig_files import RigCalibration, read_rig
from spherloc.cameras.scaling import scaled
from spherloc.datasets.asl_layout import asl_sequence, camera_of_folder
from spherloc.datasets.query_gravity import time_of
from spherloc.errors import CalibrationError, shorten
from spherloc.files import is_folder
from spherloc.frontend.view import View
from spherloc.mapping.alignment.sequence import shots_of_sequence
from spherloc.mapping.images.folder_cameras import is_called
from spherloc.mapping.images.found_calibrations import (
    CALLED_CALIBRATION,
    calibration_files,
    own_files,
)
from spherloc.mapping.images.lens import for_colmap
from spherloc.mapping.rig import Key, camera_and_key, taken_together
from spherloc.types import FloatArray

MIN_TIMES = 2
"""Least number of times at which two cameras took images together."""
MIN_BASELINE_M = 1e-3
"""Cameras that are closer are in one place."""
SAME_MOMENT_NS = 5e6
"""Images whose times differ by more are not of one moment: a head turns by half a degree meanwhile, a car goes 5 cm."""


@dataclass(frozen=True, eq=False)
class FixedImages:
    """Images of cameras that are fixed to each other, as a calibration says."""

    source: str
    """The calibration, in a word."""
    body_from_camera: Mapping[str, FloatArray]
    """(4, 4), metres, by the name of the image."""
    times: Mapping[int, Sequence[str]]
    """Names of the images that were taken together, those of one camera first, by a number of their time; none if it is
    not known which these are."""
    moments: Sequence[Sequence[str]] = ()
    """Names of those of them that were taken at the same moment: two or more each."""
    one_moment: bool = False
    """Whether all images are of one moment, each of another camera: then nothing else tells how they stand to each
    other."""


def fixed_images(folder: Path, views: Sequence[View], given: Path | None) -> tuple[FixedImages | None, list[str]]:
    """How the cameras of ``views``, photographs in ``folder``, are fixed to each other, None if no calibration says it
    or if the images are of one camera; and remarks on what cannot be used.

    The calibration is ``given``, a file or a folder of them, else that of a sequence in the ASL layout, else one of
    each image, else a file in ``folder``.
    """
    sequence = None if given is not None else asl_sequence(folder)
    if sequence is not None:
        placed, files = {}, set[str]()
        for shot in shots_of_sequence(sequence, views):
            if shot.calibrated is not None and shot.calibrated.body_from_camera is not None:
                placed[shot.name] = (shot.camera, shot.calibrated.body_from_camera)
                files.add(sequence.called(shot.calibrated.file))
        return _together(views, placed, " and ".join(sorted(files))), []
    file = given if given is not None and not is_folder(given) else None
    placed, remarks = _placed_by_own_files(views, given) if file is None else ({}, [])
    if placed:
        several = len({camera for camera, _ in placed.values()}) > 1
        return _together(views, placed, "the calibration of each image") if several else None, remarks
    alone: dict[str, FloatArray] = {}  # of files with one camera, by their names, fixed to the same body
    for path in calibration_files(given or folder, ()) if file is None else [file]:
        try:
            rig = read_rig(path)
        except CalibrationError as error:  # beside the photographs may lie anything
            if file is not None or CALLED_CALIBRATION.search(path.stem.lower()):
                remarks.append(f"{error} It is not used for the scale.")
            continue
        if len(rig.body_from_camera) > 1 and (found := _together(views, _placed(path, rig, views), shorten(path.name))):
            return found, remarks
        if len(rig.body_from_camera) == 1:
            (alone[path.stem],) = rig.body_from_camera.values()
    placed = {}
    for view in views:
        if called := sorted((name for name in alone if _says(view.name, name)), key=len)[-1:]:
            placed[view.name] = (called[0], alone[called[0]])
    files = sorted({camera for camera, _ in placed.values()})
    if len(files) > 1:
        return _together(views, placed, f"the calibration of {' and of '.join(map(shorten, files))}"), remarks
    return None, remarks


def _placed_by_own_files(
    views: Sequence[View], given: Path | None
) -> tuple[dict[str, tuple[str, FloatArray]], list[str]]:
    """The camera's name and ``body_from_camera`` (4, 4) of the images whose own calibrations say it, in the folder
    ``given`` if there is one, and the first remark on those that cannot be used."""
    folders: dict[Path, dict[str, str]] = {}
    for view in views:
        folders.setdefault(view.path.parent, {})[view.path.name] = view.name
    placed: dict[str, tuple[str, FloatArray]] = {}
    remarks: list[str] = []
    for folder, names in folders.items():
        for image, path in own_files(folder, list(names), given).items():
            try:
                rig = read_rig(path).body_from_camera
            except CalibrationError as error:
                remarks.append(f"{error} It is not used for the scale.")
                continue
            if len(rig) == 1:
                ((camera, matrix),) = rig.items()
                placed[names[image]] = (camera or camera_and_key(image)[0], matrix)
    return placed, remarks[:1] if placed else []


def _placed(path: Path, rig: RigCalibration, views: Sequence[View]) -> dict[str, tuple[str, FloatArray]]:
    """The camera's name and ``body_from_camera`` (4, 4) of the images that have one of a file's cameras; where several
    have the same lens, the one whose name is in that of the image or of its folder."""
    names: dict[str, list[str]] = {}
    for size in {(view.camera.width, view.camera.height) for view in views}:
        for name in rig.body_from_camera:
            camera = _for_images(path, name, size)
            if camera is not None:
                names.setdefault(repr(camera), []).append(name)
    found = {}
    for view in views:
        called = names.get(repr(view.camera), [])
        if len(called) > 1:
            called = sorted((name for name in called if _says(view.name, name)), key=len)[-1:]
        if len(called) == 1:
            found[view.name] = (called[0], rig.body_from_camera[called[0]])
    wrong = _of_several(found)
    return {name: one for name, one in found.items() if name not in wrong}


def _of_several(placed: Mapping[str, tuple[str, FloatArray]]) -> set[str]:
    """Names of images that have the camera of images which, by their names, another camera took: at most one of the two
    is that camera, the one that is called so."""
    takers: dict[str, dict[str, list[str]]] = {}
    for image, (camera, _) in placed.items():
        takers.setdefault(camera, {}).setdefault(camera_and_key(image)[0], []).append(image)
    wrong = set[str]()
    for camera, images in takers.items():
        if sum(len(names) >= MIN_TIMES for names in images.values()) > 1:
            wrong |= {name for names in images.values() for name in names if not _says(name, camera)}
    return wrong


def _says(image: str, camera: str) -> bool:
    """Whether the name of an image, or that of its folder, has that of a camera."""
    return is_called(camera, image) or camera_of_folder(Path(image).parent) == camera


def _for_images(path: Path, name: str, size: tuple[int, int]) -> Camera | None:
    """A camera of a file as photographs of a size have it; None if they cannot have it."""
    try:
        camera: Camera | None = load_camera(path, name, size)
        if camera is not None and (camera.width, camera.height) != size:
            camera = scaled(camera, *size)
        return None if camera is None else for_colmap(camera)[0]
    except CalibrationError:
        return None


def _together(views: Sequence[View], placed: Mapping[str, tuple[str, FloatArray]], source: str) -> FixedImages | None:
    """The images that were taken together, of those with a camera's name and ``body_from_camera`` (4, 4)."""
    if _of_one_moment(views, placed):
        bodies = {name: matrix for name, (_, matrix) in placed.items()}
        return FixedImages(source, bodies, {0: sorted(bodies)}, [sorted(bodies)], one_moment=True)
    keys: dict[str, dict[str, Key]] = {}
    for view in views:
        if view.name in placed:
            keys.setdefault(placed[view.name][0], {})[view.name] = camera_and_key(view.name, time_of(view))[1]
    times: dict[int, list[str]] = {}
    for name, (_, step) in sorted(taken_together(keys, MIN_TIMES).items()):
        times.setdefault(step, []).append(name)
    times = {step: names for step, names in times.items() if len(names) > 1}
    if not times and len(_takers(views)) < 2:
        return None
    bodies = {name: placed[name][1] for names in times.values() for name in names}
    every = {name: key for images in keys.values() for name, key in images.items()}
    moments = [moment for names in times.values() for moment in _moments(names, every) if len(moment) > 1]
    return FixedImages(source, bodies, times, moments)


def _moments(names: Sequence[str], keys: Mapping[str, Key]) -> list[list[str]]:
    """Images that were taken together, parted where their times differ by more than ``SAME_MOMENT_NS``."""
    if not all(keys[name].is_time for name in names):
        return [list(names)]
    found: list[list[str]] = []
    for name in sorted(names, key=lambda name: keys[name].number):
        if found and keys[name].number - keys[found[-1][0]].number <= SAME_MOMENT_NS:
            found[-1].append(name)
        else:
            found.append([name])
    return found


def _of_one_moment(views: Sequence[View], placed: Mapping[str, tuple[str, FloatArray]]) -> bool:
    """Whether each image is of another camera, and names or times tell no different moments."""
    cameras = {placed[view.name][0] for view in views if view.name in placed}
    if not len(cameras) == len(views) > 1:
        return False
    keys = [_moment(view, placed[view.name][0]) for view in views]
    numbers = [key.number for key in keys]
    same = SAME_MOMENT_NS if all(key.is_time for key in keys) else 0.0
    return max(numbers) - min(numbers) <= same


def _moment(view: View, camera: str) -> Key:
    """The number or time in an image's name, without that of its camera."""
    rest = re.sub(re.escape(camera), "", view.name, flags=re.IGNORECASE) if camera else view.name
    return camera_and_key(rest, time_of(view))[1]


def _takers(views: Sequence[View]) -> set[str]:
    """The cameras that took two images or more each, by their names."""
    images = Counter(camera_and_key(view.name)[0] for view in views)
    return {camera for camera, count in images.items() if count > 1}
