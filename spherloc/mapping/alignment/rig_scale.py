"""The scale of a map by cameras that are fixed to each other, as their calibration says: a stereo pair, a headset or a
car with several fisheyes.

Images that were taken together stand to each other as their cameras do, so that the distance of two of them in the map
is known in metres. A single distance is as inexact as the two poses; many of them are not, but for what is off by the
same at all times, such as the calibration.

To turn a camera a little looks in its image nearly as if it were shifted. Where a map has two cameras turned against
each other otherwise than they are fixed, it has them shifted, too: by the cross product of that turn with where the
points are that they see. This lever is fitted with the scale, as else a tenth of a degree may falsify it by per cents.
"""

from collections.abc import Mapping
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from spherloc.errors import InputError
from spherloc.geometry import camera_centre
from spherloc.mapping.advice import advice
from spherloc.mapping.alignment.fixed_images import MIN_BASELINE_M, MIN_TIMES, FixedImages
from spherloc.mapping.alignment.positions import MAX_SCALE_SD, NEAR_SD
from spherloc.mapping.alignment.upright import MapScale
from spherloc.mapping.rig import TURNED_RAD
from spherloc.types import FloatArray

NONE = "{}, which says how the cameras are fixed to each other, gave no scale"
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
SAME, OFF_IF_FIXED = 1e-4, 2.0
"""Where the mapper had the cameras fixed to each other, all times say the same, to the first share of a distance; the
scale then is off by the second number times as much as they tell (``benchmarks.headset``: 1.8)."""
ROUNDS = 10
"""Number of times that the scale is fitted to what fits it."""


def scale_by_rig(poses: Mapping[str, FloatArray], fixed: FixedImages) -> MapScale:
    """The scale at which images that were taken together are as far apart as their cameras.

    ``poses`` (3, 4) are those of the map, by name. Raises ``InputError`` if there are too few such images in it, or if
    these do not fix the scale to ``MAX_SCALE_SD``.
    """
    if fixed.one_moment:
        return _scale_of_one_moment(poses, fixed)
    times = [[name for name in names if name in poses] for names in fixed.times.values()]
    times = [names for names in times if len(names) > 1]
    none = NONE.format(fixed.source)
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
    _check_metres(none, lengths_m)
    alike = (turned_rad <= TURNED_RAD) & (lengths_m > MIN_BASELINE_M)
    if 2 * np.count_nonzero(alike) < len(alike):
        raise InputError(_otherwise(none, turned_rad))
    stated, mapped, turns = stated[alike], mapped[alike], turns[alike]
    same = _always_the_same(stated, mapped)
    # Two cameras that the mapper had fixed are one measurement of three numbers: a lever would fit two of them, and
    # leave the scale to the part of their distance along the axis of the turn, which may be nearly nothing.
    levered = len(times) >= MIN_FOR_LEVER and not (same and len(np.unique(stated, axis=0)) == 1)
    units, scattered, steady = _units_per_metre(stated, mapped, turns if levered else None)
    # Of three images that were taken together the third distance tells nothing new, and few times tell little.
    free = sum(len(names) - 1 for names in times)
    relative = float(np.sqrt(len(pairs) / free)) * max(scattered * (1.0 + 5.0 / (len(times) - 1)), steady)
    if same:
        relative *= OFF_IF_FIXED
    apart = _range_m(np.linalg.norm(stated, axis=1))
    seen = f"images that cameras {apart} apart took together, at {len(times)} times"
    if not relative <= MAX_SCALE_SD:
        off = f"uncertain by {relative:.0%}" if relative < MAX_OFF else "not known"
        raise InputError(f"{none}: by {seen}, the scale is {off}; {advice('other scale')}.")
    return MapScale(1.0 / units, f"{fixed.source}: {seen}; the scale is good to {max(relative, 5e-4):.1%}")


def _scale_of_one_moment(poses: Mapping[str, FloatArray], fixed: FixedImages) -> MapScale:
    """The scale of a map of images of one moment, which has them as the calibration does, but for a factor.

    Raises ``InputError`` if it has them otherwise, or fewer than two.
    """
    none = NONE.format(fixed.source)
    inside = [name for name in fixed.body_from_camera if name in poses]
    if len(inside) < 2:
        raise InputError(f"{none}: fewer than two of its images are in the map.")
    between = [_between(poses, fixed.body_from_camera, pair) for pair in combinations(inside, 2)]
    stated_m, mapped, turned_rad = (np.array([np.linalg.norm(one[k]) for one in between], np.float64) for k in range(3))
    _check_metres(none, stated_m)
    if stated_m.max() <= MIN_BASELINE_M or np.median(turned_rad) > TURNED_RAD:
        raise InputError(_otherwise(none, turned_rad))
    source = f"{fixed.source}, which places the images of a single moment: {_range_m(stated_m)} apart"
    return MapScale(float(stated_m.sum() / mapped.sum()), source)


def _otherwise(none: str, turned_rad: FloatArray) -> str:
    """That a map and the calibration disagree, a sentence that starts with ``none``."""
    off_deg = np.degrees(np.median(turned_rad))
    otherwise = f"in the map the cameras are turned against each other {off_deg:.0f}° otherwise than it says"
    return f"{none}: {otherwise}, or it has them in one place; {advice('other scale')}."


def _check_metres(none: str, lengths_m: FloatArray) -> None:
    """Raises ``InputError``, a sentence that starts with ``none``, if distances (K,) of cameras cannot be metres."""
    if lengths_m.max() > MAX_BASELINE_M:
        metres = "give the positions in its transforms in metres, not in millimetres"
        raise InputError(f"{none}: it says that cameras are {lengths_m.max():.0f} m apart; {metres}.")


def _range_m(lengths_m: FloatArray) -> str:
    shortest, longest = (f"{length_m:.2g}" for length_m in (lengths_m.min(), lengths_m.max()))
    return f"{shortest} m" if shortest == longest else f"{shortest} to {longest} m"


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


def _always_the_same(stated: FloatArray, mapped: FloatArray) -> bool:
    """Whether a map has two cameras alike at all times, of ``stated`` (K, 3), which tell the cameras, and ``mapped``
    (K, 3)."""
    _, cameras = np.unique(stated, axis=0, return_inverse=True)
    each = [mapped[cameras == k] for k in range(cameras.max() + 1)]
    return all(np.ptp(one, axis=0).max() <= SAME * np.linalg.norm(one[0]) for one in each)


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
