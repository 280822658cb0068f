"""The sentences of an explanation, chosen by the evidence."""

from dataclasses import dataclass

import numpy as np

from spherloc.metrics import evaluate, rotation_error_deg, translation_error_m
from spherloc.trace import Trace
from spherloc.types import FloatArray

NEARLY = 2.0
"""A residual up to this many times its bound is just beyond it."""


@dataclass(frozen=True, eq=False)
class Poses:
    """What the sentences are chosen by: one correspondence at the estimated, the true and another pose."""

    usable: bool
    kept: bool
    right: bool | None
    labelled: bool
    bound_px: float
    estimate: tuple[float, float] | None
    """Residual at the run's pose in px and degrees; None without one."""
    truth: tuple[float, float] | None
    """The same at the true pose."""
    alternative: tuple[FloatArray, float] | None
    """Another pose (3, 4), and the residual there, px."""
    agree_inliers: tuple[int, int] | None
    """Of the pairs with the run's other inliers, how many agree at its yaw, and how many there are."""


def reason(trace: Trace, poses: Poses) -> tuple[str, str]:
    """A verdict in a few words, and why in one or two sentences."""
    if not poses.usable:
        return (
            "Cannot be used",
            "The camera does not see this pixel: its model has no bearing there. So the match counts as an outlier.",
        )
    rightly = {None: "", True: ", rightly", False: ", wrongly"}
    if trace.cam_from_map is None or poses.estimate is None:
        return "Not judged", _joined("The run found no pose to judge it by.", _by_truth(poses))
    if poses.kept:
        verdict = "Kept" + rightly[poses.right]
        first = f"At the estimated pose it is {_px(poses.estimate[0])} off, within its bound of {_px(poses.bound_px)}."
        return verdict, _joined(first, _why_kept(trace, poses))
    verdict = "Rejected" + rightly[None if poses.right is None else not poses.right]
    return verdict, _joined(_how_far(poses, poses.estimate), _why_rejected(trace, poses))


def _joined(*sentences: str) -> str:
    return " ".join(filter(None, sentences))


def _how_far(poses: Poses, residual: tuple[float, float]) -> str:
    px, degrees = residual
    if np.isinf(px):
        return f"At the estimated pose its point lies behind: {degrees:.0f}° from where its pixel looks."
    times = px / poses.bound_px
    if times < NEARLY:
        return f"At the estimated pose it is {_px(px)} off, just beyond its bound of {_px(poses.bound_px)}."
    return f"At the estimated pose it is {_px(px)} off, {times:,.0f} times its bound of {_px(poses.bound_px)}."


def _why_kept(trace: Trace, poses: Poses) -> str:
    if poses.right is None:
        return ""
    if poses.right:
        return "The truth calls it an inlier too."
    if poses.truth is None:
        return "But its label says that it is wrong."
    if poses.truth[0] <= poses.bound_px:
        return f"Its label says that it is wrong, though it is {_px(poses.truth[0])} off at the true pose."
    if evaluate(trace).success:
        return f"At the true pose it is {_off(poses.truth)}: an outlier that fits by chance."
    off = _off(poses.truth)
    return f"But at the true pose it is {off}: it agrees with a wrong pose, {_away(trace)} from the true one."


def _why_rejected(trace: Trace, poses: Poses) -> str:
    if poses.right:
        return _why_lost(trace, poses)
    alternative = _by_alternative(trace, poses)
    if poses.right is False:
        return _joined(_by_truth(poses), alternative)
    return alternative or _by_pairs(poses)


def _why_lost(trace: Trace, poses: Poses) -> str:
    """A right match that was rejected."""
    if poses.truth is None:
        return "Yet its label says that it is right."
    off = _off(poses.truth)
    if poses.truth[0] > poses.bound_px:
        return f"Its label says that it is right, but it is {off} at the true pose too: the bound is too tight for it."
    if evaluate(trace).success:
        return f"At the true pose it is {off}: the small error of the pose costs it its place."
    return f"It agrees with the true pose, {off} there, but the run ended {_away(trace)} from it."


def _by_truth(poses: Poses) -> str:
    if poses.truth is None:
        return {None: "", True: "Its label says that it is right.", False: "Its label says that it is wrong."}[
            poses.right
        ]
    if poses.right:
        return f"At the true pose it is {_off(poses.truth)}: a right match."
    return f"At the true pose it is {_off(poses.truth)}: a wrong match."


def _by_alternative(trace: Trace, poses: Poses) -> str:
    if poses.alternative is None or not poses.alternative[1] <= poses.bound_px or trace.cam_from_map is None:
        return ""
    return f"It agrees with another pose, {_between(trace.cam_from_map, poses.alternative[0])} from the estimated one."


def _by_pairs(poses: Poses) -> str:
    if poses.agree_inliers is None or poses.agree_inliers[1] == 0:
        return ""
    agree, count = poses.agree_inliers
    some = f"{agree} agree" if agree > 1 else "1 agrees" if agree else "none agrees"
    return f"Of its pairs with the {count} inliers {some} at the estimated yaw."


def _off(residual: tuple[float, float]) -> str:
    px, degrees = residual
    return f"{degrees:.0f}° off" if np.isinf(px) else f"{_px(px)} off"


def _away(trace: Trace) -> str:
    truth, estimate = trace.problem.truth_cam_from_map, trace.cam_from_map
    return "" if truth is None or estimate is None else _between(truth, estimate)


def _between(one: FloatArray, other: FloatArray) -> str:
    return f"{translation_error_m(one, other):.2f} m and {rotation_error_deg(one, other):.1f}°"


def _px(value: float) -> str:
    """Pixels with three digits."""
    return f"{value:.3g} px" if value < 1000 else f"{value:,.0f} px"
