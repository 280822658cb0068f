"""True poses of images that are localized in a map of the same recorded sequence, by its ground truth.

The ground truth has a frame of its own, so it is aligned with the map: by a similarity that most positions of the map's
images agree with, and by the rotations of these. A map that does not fit it gets no true poses.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from spherloc.datasets.asl_layout import AslSequence, asl_sequence, of_all_cameras
from spherloc.datasets.map_scene import DEFAULT_THRESHOLDS
from spherloc.errors import InputError
from spherloc.frontend.view import View
from spherloc.geometry import camera_centre, inverse_pose, pose, rotation_angle
from spherloc.mapping.alignment.positions import MIN_POSITIONS, SimilarityFit, overlaid
from spherloc.mapping.alignment.sequence import SensorTruth, readable_truths, shots_of_sequence
from spherloc.types import FloatArray

MAX_OFF_DEG, MAX_OFF_M = DEFAULT_THRESHOLDS[1]
"""Largest medians of the map's rotations and positions against the ground truth: of a map that is farther off, the
errors would tell more than those of queries."""
MIN_SD_M, MIN_SD_RAD = 1e-3, 1e-4
"""Least standard deviations of positions and rotations, as weights."""


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """The ground truth of a sequence at the images of a map and at other images of it, in its own frame."""

    of_map: Mapping[str, FloatArray] = field(default_factory=dict)
    """``truth_from_camera`` (3, 4) of images that may be in the map, by name; metres."""
    of_queries: Mapping[str, FloatArray] = field(default_factory=dict)
    """The same of the others."""
    source: str = ""
    """Its file."""
    why_none: str = ""
    """Why there is none, in a few words; empty if there is one."""


@dataclass(frozen=True, eq=False)
class AlignedTruth:
    """True poses in the frame of a map, if they are known."""

    poses: Mapping[str, FloatArray]
    """True ``cam_from_map`` (3, 4) of queries by name, in the map's unit; empty if they are not known."""
    said: str
    """What they are from and how well that fits the map, or why they are not known; in a few words."""


def ground_truth(folder: Path, queries: Sequence[View], mapped: Sequence[View]) -> GroundTruth | None:
    """The ground truth of the sequence in ``folder`` that ``queries`` and the images of a map, ``mapped``, are of.

    None if ``folder`` holds no sequence, or one without ground truth.
    """
    found = asl_sequence(folder)
    if found is None:
        return None
    sequence = of_all_cameras(found)
    truths = list(readable_truths(sequence, []))
    if not truths:
        return None
    shots = shots_of_sequence(sequence, mapped)
    if not shots:
        return GroundTruth(why_none="the ground truth of this sequence may have another frame than that of the map's")
    asked = shots_of_sequence(sequence, queries)
    for truth in truths:
        of_map, of_queries = (
            {shot.name: at for shot in some if (at := truth.camera_pose_at(shot)) is not None}
            for some in (shots, asked)
        )
        if len(of_map) >= MIN_POSITIONS and of_queries:
            return GroundTruth(of_map, of_queries, sequence.called(truth.table))
    return GroundTruth(why_none=_why_none(sequence, truths))


def _why_none(sequence: AslSequence, truths: Sequence[SensorTruth]) -> str:
    turned = [truth for truth in truths if truth.places.turned]
    if not turned:
        return f"{sequence.called(truths[0].table)} has no rotations"
    of_what = "is of other times than the images, or no file says how the cameras are fixed to its sensor"
    return f"{sequence.called(turned[0].table)} {of_what}"


def aligned_truth(truth: GroundTruth, poses: Mapping[str, FloatArray]) -> AlignedTruth:
    """The true poses of queries in the frame of the map whose images have these ``poses``, ``cam_from_map`` (3, 4).

    There are none where the map fits the ground truth badly.
    """
    if truth.why_none:
        return AlignedTruth({}, truth.why_none)
    names = [name for name in poses if name in truth.of_map]
    centres = np.array([camera_centre(poses[name]) for name in names]).reshape(-1, 3)
    true = np.array([truth.of_map[name] for name in names]).reshape(-1, 3, 4)
    try:
        fit = overlaid(centres, true[:, :, 3])
    except InputError as error:
        return AlignedTruth({}, f"{truth.source} could not be aligned with the map: {error}".rstrip("."))
    turns = np.array([true[k, :, :3] @ poses[name][:, :3] for k, name in enumerate(names)])
    near = fit.near
    rotation = _rotation(fit, centres[near], true[near, :, 3], turns[near])
    translation = true[near, :, 3].mean(axis=0) - fit.scale * rotation @ centres[near].mean(axis=0)
    off = np.linalg.norm(fit.scale * centres[near] @ rotation.T + translation - true[near, :, 3], axis=1)
    off_m, off_deg = float(np.median(off)), float(np.degrees(np.median(_angles(turns[near], rotation))))
    count = int(np.count_nonzero(near))
    measured = f"{count} of {len(names)} images of the map fit it, to {off_m:.2g} m and {off_deg:.2g}° in the median"
    if off_m > MAX_OFF_M or off_deg > MAX_OFF_DEG or 2 * count < len(names):
        needed = f"at least half of them must, to {MAX_OFF_M:g} m and {MAX_OFF_DEG:g}°"
        return AlignedTruth({}, f"{truth.source} fits the map badly: {measured}; {needed}")
    found = {}
    for name, truth_from_camera in truth.of_queries.items():
        centre = rotation.T @ (truth_from_camera[:, 3] - translation) / fit.scale
        found[name] = inverse_pose(pose(rotation.T @ truth_from_camera[:, :3], centre))
    return AlignedTruth(found, f"{truth.source}, which was aligned with the map: {measured}")


def truth_words(truth: AlignedTruth) -> str:
    """What the true poses are, or why there are none, as a sentence."""
    return f"The true poses are those of {truth.said}." if truth.poses else f"True poses are not known: {truth.said}."


def _rotation(fit: SimilarityFit, centres: FloatArray, places: FloatArray, turns: FloatArray) -> FloatArray:
    """The rotation (3, 3) from the map to the ground truth by positions (N, 3) of both and by that of each image,
    ``turns`` (N, 3, 3): images along a straight line leave the one about it to the rotations.

    It maximises the trace of its product with a weighted sum, and so has the least weighted squares of both.
    """
    mean = _nearest_rotation(turns.sum(axis=0))
    variance_m = max(float(np.mean(fit.off_m[fit.near] ** 2)) / 3.0, MIN_SD_M**2)
    variance_rad = max(float(np.mean(_angles(turns, mean) ** 2)) / 3.0, MIN_SD_RAD**2)
    moved, aimed = centres - centres.mean(axis=0), places - places.mean(axis=0)
    return _nearest_rotation(fit.scale * aimed.T @ moved / variance_m + turns.sum(axis=0) / (2.0 * variance_rad))


def _nearest_rotation(matrix: FloatArray) -> FloatArray:
    left, _, right = np.linalg.svd(matrix)
    return left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right


def _angles(turns: FloatArray, rotation: FloatArray) -> FloatArray:
    """Angles (N,), rad, between rotations (N, 3, 3) and one (3, 3)."""
    return np.array([rotation_angle(turn @ rotation.T) for turn in turns])
