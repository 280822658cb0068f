"""What several correspondences have in common in one run."""

from dataclasses import dataclass

import numpy as np

from spherloc.consensus.yaw_arcs import yaw_arcs
from spherloc.geometry import yaw_of
from spherloc.trace import Trace
from spherloc.types import IntArray
from spherloc_viz.layers.agreement import agreement, subset
from spherloc_viz.layers.frame import even
from spherloc_viz.layers.verdicts import run_bounds, verdicts

MOST = 200
"""Of more correspondences an even sample is asked for its pairs."""


@dataclass(frozen=True)
class Traits:
    """Several correspondences in one run."""

    count: int
    """How many they are."""
    kept: int
    """Those that the run calls inliers."""
    right: int | None
    """Those that truly are; None if the truth is unknown."""
    median_px: float | None
    """Median residual at the run's pose; None without a pose, or if none of them has a bearing."""
    agree: int
    """Pairs among them that agree at the run's yaw."""
    pairs: int
    """Pairs among them, of at most ``MOST``."""
    sentences: tuple[str, ...]
    """What they have in common."""


def explain_many(trace: Trace, numbers: IntArray) -> Traits:
    """What the correspondences (K,) of these indices in the problem have in common."""
    known = verdicts(trace)
    places = np.flatnonzero(np.isin(trace.problem.aligned.index, numbers))
    places = even(places, MOST)
    agree, pairs = _agreeing(trace, places)
    errors = None if known.estimate is None else known.estimate.px[numbers]
    known_errors = np.empty(0) if errors is None else errors[~np.isnan(errors)]
    return Traits(
        count=len(numbers),
        kept=int(np.count_nonzero(known.kept[numbers])),
        right=None if known.right is None else int(np.count_nonzero(known.right[numbers])),
        median_px=float(np.median(known_errors)) if len(known_errors) else None,
        agree=agree,
        pairs=pairs,
        sentences=tuple(filter(None, (*_pair(trace, places), *_common(trace, numbers)))),
    )


def _agreeing(trace: Trace, places: IntArray) -> tuple[int, int]:
    pairs = len(places) * (len(places) - 1) // 2
    if trace.cam_from_map is None or not pairs:
        return 0, pairs
    aligned = trace.problem.aligned
    yaw = yaw_of(aligned.align_pose(trace.cam_from_map)[:, :3])
    return int(np.count_nonzero(agreement(aligned, run_bounds(trace).radians, yaw, places, places))) // 2, pairs


def _pair(trace: Trace, places: IntArray) -> tuple[str, ...]:
    """Where the arcs of two correspondences are."""
    if len(places) != 2:
        return ()
    aligned = trace.problem.aligned
    bound_rad = run_bounds(trace).radians[places]
    bound_rad.setflags(write=False)
    _, lo, hi = yaw_arcs(subset(aligned, places), bound_rad)
    if not len(lo):
        return ("Their pair has no yaw arc: no yaw explains both, or they are too close to say anything.",)
    arcs = " and ".join(f"{_degrees(a)} to {_degrees(b)}" for a, b in zip(lo, hi, strict=True))
    return (f"Their pair has {'one yaw arc' if len(lo) == 1 else f'{len(lo)} yaw arcs'}: {arcs}.",)


def _degrees(angle_rad: float) -> str:
    return f"{(np.degrees(angle_rad) + 180.0) % 360.0 - 180.0:.1f}°"


def _common(trace: Trace, numbers: IntArray) -> tuple[str, ...]:
    problem, known = trace.problem, verdicts(trace)
    unseen = int(np.count_nonzero(~problem.usable[numbers]))
    behind = 0 if known.estimate is None else int(np.count_nonzero(np.isinf(known.estimate.px[numbers])))
    sentences = []
    if unseen:
        sentences.append(f"The camera does not see {unseen} of their pixels.")
    if behind:
        sentences.append(f"The points of {behind} lie behind at the estimated pose.")
    if known.truth is not None and known.estimate is not None:
        lost = ~known.kept[numbers] & (known.truth.px[numbers] <= known.limit_px[numbers])
        if lost.any():
            sentences.append(f"{np.count_nonzero(lost)} agree with the true pose and not with the estimated one.")
    if problem.reference_index is not None and len(problem.reference_images) > 1:
        references = np.unique(problem.reference_index[numbers])
        one = len(references) == 1
        name = problem.reference_images[int(references[0])].name
        sentences.append(f"All were matched with {name}." if one else f"They come from {len(references)} references.")
    return tuple(sentences)
