"""How images that were taken together must stand to each other, as a calibration says of cameras that are fixed to each
other: what stands otherwise in a map was placed by structure that looks alike, such as paving stones."""

from collections.abc import Mapping, Sequence
from itertools import combinations

from spherloc.errors import InputError
from spherloc.geometry import camera_centre, pose, rotation_angle
from spherloc.mapping.alignment.fixed_images import FixedImages
from spherloc.mapping.alignment.rig_scale import scale_by_rig
from spherloc.mapping.rig import TURNED_RAD
from spherloc.types import FloatArray


def turned_otherwise(poses: Mapping[str, FloatArray], fixed: FixedImages) -> set[str]:
    """Names of images of a map of ``poses`` (3, 4) that are turned against those which were taken together with them
    otherwise than their cameras are: where more of these speak against an image than for it.

    None of them if the map agrees with less than half of what the calibration says, which then is another rig's.
    """
    return {name for name, balance in _balances(poses, fixed).items() if balance < 0}


def _balances(poses: Mapping[str, FloatArray], fixed: FixedImages) -> dict[str, int]:
    """How many more images of its time speak for an image of the map than against it, by name; empty if the map agrees
    with no more than half of what the calibration says."""
    found: dict[str, int] = {}
    for names in fixed.times.values():
        found |= _balances_of_time(poses, fixed, names)
    return found if sum(found.values()) > 0 else {}


def _balances_of_time(poses: Mapping[str, FloatArray], fixed: FixedImages, names: Sequence[str]) -> dict[str, int]:
    """``_balances`` of the images of one time."""
    bodies = {name: _body_from_map(fixed, name, poses[name]) for name in names if name in poses}
    balances = dict.fromkeys(bodies, 0)
    for one, other in combinations(bodies, 2):
        agree = 1 if rotation_angle(bodies[one] @ bodies[other].T) <= TURNED_RAD else -1
        balances[one] += agree
        balances[other] += agree
    return balances


def _body_from_map(fixed: FixedImages, name: str, cam_from_map: FloatArray) -> FloatArray:
    """The rotation (3, 3) from the map to the body to which the cameras are fixed."""
    return fixed.body_from_camera[name][:3, :3] @ cam_from_map[:, :3]


def expected_by_calibration(poses: Mapping[str, FloatArray], fixed: FixedImages) -> dict[str, FloatArray]:
    """Poses (3, 4) that images which are not in a map of ``poses`` (3, 4) should have, by one of those that were taken
    together with each; none if the map does not agree with the calibration. Where nothing tells the scale of the map,
    cameras are taken to be in one place."""
    if not _balances(poses, fixed):
        return {}
    try:
        units = 1.0 / scale_by_rig(poses, fixed).metres_per_unit
    except InputError:
        units = 0.0
    found: dict[str, FloatArray] = {}
    for names in fixed.times.values():
        inside = [name for name in names if name in poses]
        if not inside:
            continue
        first = inside[0]
        body_from_map, body = _body_from_map(fixed, first, poses[first]), fixed.body_from_camera[first]
        for name in names:
            if name not in poses:
                there = fixed.body_from_camera[name]
                centre = camera_centre(poses[first]) + units * body_from_map.T @ (there[:3, 3] - body[:3, 3])
                rotation = there[:3, :3].T @ body_from_map
                found[name] = pose(rotation, -rotation @ centre)
    return found
