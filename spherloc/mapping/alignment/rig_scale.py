"""The scale of a map by cameras that are fixed to each other, as their calibration says: a stereo pair, a headset or a
car with several fisheyes.

Images that were taken together stand to each other as their cameras do, so that the distance of two of them in the map
is known in metres. A single distance is as inexact as the two poses; many of them are not, but for what is off by the
same at all times, such as the calibration.

To turn a camera a little looks in its image nearly as if it were shifted. Where a map has two cameras turned against
each other otherwise than they are fixed, it has them shifted, too: by the cross product of that turn with where the
points are that they see. This lever is fitted with the scale, as else a tenth of a degree may falsify it by per cents.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from spherloc.cameras.base import Camera
from spherloc.cameras.calibration import load_camera
from spherloc.cameras.rig_files import RigCalibration, read_rig
from spherloc.cameras.scaling import scaled
from spherloc.datasets.asl_layout import asl_sequence, camera_of_folder
from spherloc.datasets.query_gravity import time_of
from spherloc.errors import CalibrationError, InputError, shorten
from spherloc.files import is_folder
from spherloc.frontend.view import View
from spherloc.geometry import camera_centre
from spherloc.mapping.advice import advice
from spherloc.mapping.alignment.positions import MAX_SCALE_SD, NEAR_SD
from spherloc.mapping.alignment.sequence import shots_of_sequence
from spherloc.mapping.alignment.upright import MapScale
from spherloc.mapping.images.found_calibrations import (
    CALLED_CALIBRATION,
    calibration_files,
    own_files,
)
from spherloc.mapping.images.lens import for_colmap
from spherloc.mapping.images.photographs import is_called
from spherloc.mapping.rig import TURNED_RAD, Key, camera_and_key, taken_together
from spherloc.types import FloatArray

MIN_TIMES = 3
"""Least number of times at which two cameras took images together."""
MIN_BASELINE_M = 1e-3
"""Cameras that are closer do not tell a scale."""
MAX_BASELINE_M = 20.0
"""Cameras that are fixed to each other are not farther apart: such numbers are of other units."""
PER_SD = 1.54
"""Median length of a vector of three normal numbers, in their standard deviations."""
ALIKE = 1.2
"""A scale that differs by a larger factor is in doubt."""
MAX_OFF = 3.0
"""A relative standard deviation that is larger tells nothing."""
MIN_FOR_LEVER = 6
"""Least number of times from which on a lever is fitted."""
LEVER_SD = 100.0
"""What is known of the lever: a standard deviation in distances of the cameras."""
ROUNDS = 10
"""Number of times that the scale is fitted to what fits it."""


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
    return FixedImages(source, bodies, times)


def _takers(views: Sequence[View]) -> set[str]:
    """The cameras that took two images or more each, by their names."""
    images = Counter(camera_and_key(view.name)[0] for view in views)
    return {camera for camera, count in images.items() if count > 1}


def scale_by_rig(poses: Mapping[str, FloatArray], fixed: FixedImages) -> MapScale:
    """The scale at which images that were taken together are as far apart as their cameras.

    ``poses`` (3, 4) are those of the map, by name. Raises ``InputError`` if there are too few such images in it, or if
    these do not fix the scale to ``MAX_SCALE_SD``.
    """
    times = [[name for name in names if name in poses] for names in fixed.times.values()]
    times = [names for names in times if len(names) > 1]
    none = f"{fixed.source}, which says how the cameras are fixed to each other, gave no scale"
    if len(times) < MIN_TIMES:
        if len(fixed.times) < MIN_TIMES:
            told = "as far as names of images and folders tell its cameras, and numbers or times in them the moment"
            raise InputError(f"{none}: two cameras took images together at fewer than {MIN_TIMES} times, {told}.")
        raise InputError(f"{none}: at {len(times)} times images of two cameras are in the map, {MIN_TIMES} are needed.")
    pairs = [pair for names in times for pair in combinations(names, 2)]
    between = [_between(poses, fixed.body_from_camera, pair) for pair in pairs]
    stated, mapped, turns = (np.array([one[k] for one in between]) for k in range(3))
    turned_rad = np.linalg.norm(turns, axis=1)
    lengths_m = np.linalg.norm(stated, axis=1)
    if lengths_m.max() > MAX_BASELINE_M:
        metres = "give the positions in its transforms in metres, not in millimetres"
        raise InputError(f"{none}: it says that cameras are {lengths_m.max():.0f} m apart; {metres}.")
    alike = (turned_rad <= TURNED_RAD) & (lengths_m > MIN_BASELINE_M)
    if 2 * np.count_nonzero(alike) < len(alike):
        off_deg = np.degrees(np.median(turned_rad))
        otherwise = f"in the map the cameras are turned against each other {off_deg:.0f}° otherwise than it says"
        raise InputError(f"{none}: {otherwise}, or it has them in one place; {advice('other scale')}.")
    stated, mapped, turns = stated[alike], mapped[alike], turns[alike]
    units, scattered, steady = _units_per_metre(stated, mapped, turns if len(times) >= MIN_FOR_LEVER else None)
    # Of three images that were taken together the third distance tells nothing new, and few times tell little.
    free = sum(len(names) - 1 for names in times)
    relative = float(np.sqrt(len(pairs) / free)) * max(scattered * (1.0 + 5.0 / (len(times) - 1)), steady)
    lengths_m = np.linalg.norm(stated, axis=1)
    shortest, longest = (f"{length_m:.2g}" for length_m in (lengths_m.min(), lengths_m.max()))
    apart = f"{shortest} m" if shortest == longest else f"{shortest} to {longest} m"
    seen = f"images that cameras {apart} apart took together, at {len(times)} times"
    if not relative <= MAX_SCALE_SD:
        off = f"uncertain by {relative:.0%}" if relative < MAX_OFF else "not known"
        raise InputError(f"{none}: by {seen}, the scale is {off}; {advice('other scale')}.")
    return MapScale(1.0 / units, f"{fixed.source}: {seen}; the scale is good to {max(relative, 5e-4):.1%}")


def doubt_of_scale(poses: Mapping[str, FloatArray], scale: MapScale, fixed: FixedImages) -> str:
    """A part of a sentence if a scale of a map of ``poses`` (3, 4) is clearly not that of ``scale_by_rig``; empty if it
    is, or if that is not known."""
    try:
        by_rig = scale_by_rig(poses, fixed)
    except InputError:
        return ""
    times = by_rig.metres_per_unit / scale.metres_per_unit
    if max(times, 1.0 / times) <= ALIKE:
        return ""
    return (
        f"whether the scale is right: by the distances of the cameras in {fixed.source} the map is {times:.2g} times "
        "as large; one of the two is wrong or has another unit"
    )


def _between(
    poses: Mapping[str, FloatArray], body_from_camera: Mapping[str, FloatArray], pair: tuple[str, str]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The second image's position from the first one's in the frame of the body: as the calibration states it (3,), m,
    and in the map (3,), in its units; and the turn (3,), rad, between the frames of the body that the images tell."""
    (first, second), (here, there) = ([known[name] for name in pair] for known in (body_from_camera, poses))
    turns = first[:3, :3] @ here[:, :3], second[:3, :3] @ there[:, :3]
    way = camera_centre(there) - camera_centre(here)
    return (
        second[:3, 3] - first[:3, 3],
        0.5 * (turns[0] + turns[1]) @ way,
        Rotation.from_matrix(turns[1] @ turns[0].T).as_rotvec(),
    )


def _units_per_metre(stated: FloatArray, mapped: FloatArray, turns: FloatArray | None) -> tuple[float, float, float]:
    """The factor by which ``mapped`` (K, 3) are longer than ``stated`` (K, 3), and its relative standard deviation: by
    errors that differ between times, and by what is left of them in the mean of each pair of cameras, as errors that
    are alike at all times leave it; infinite if it is not positive.

    Lengths would make it too large where positions are noisy, so that it is that of the parts along ``stated``. It is
    fitted to those that fit the median, with a lever of the ``turns`` (K, 3), rad, if these are given.
    """
    squares = np.sum(stated**2, axis=1)
    found = np.array([np.median(np.sum(stated * mapped, axis=1) / squares)])  # and the lever, in units of the map
    parts = stated[:, :, None]
    if turns is not None:
        found = np.append(found, np.zeros(3))
        parts = np.dstack([stated, np.cross(turns[:, None], np.eye(3)).transpose(0, 2, 1)])
    known = np.zeros(len(found))  # what is known of each, as the weight of a measurement
    for _ in range(ROUNDS):
        off = np.linalg.norm(mapped - parts @ found, axis=1)
        near = off <= NEAR_SD * np.median(off)
        sd = float(np.median(off)) / PER_SD
        known[1:] = (sd / (LEVER_SD * abs(found[0]) * np.sqrt(np.median(squares)))) ** 2 if found[0] else 0.0
        inverse = np.linalg.pinv(np.einsum("kij,kil->jl", parts[near], parts[near]) + np.diag(known))
        found = inverse @ np.einsum("kij,ki->j", parts[near], mapped[near])
    factor = float(found[0])
    if factor <= 0.0:
        return factor, np.inf, np.inf
    cameras, pair = np.unique(stated[near], axis=0, return_inverse=True)  # a row for each pair of cameras
    left = (mapped - parts @ found)[near]
    means = np.array([left[pair == k].mean(axis=0) for k in range(len(cameras))])
    steady_sd = float(np.sqrt(np.sum(means**2) / (means.size - 1) / np.sum(cameras**2)))
    return factor, sd * float(np.sqrt(inverse[0, 0])) / factor, steady_sd / factor
