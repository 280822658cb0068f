"""Answers that are withheld: what came out of a run and the truth, while a class predicts or somebody tests themselves.

A step that tells what came out shows the last step before it that does not (``Plan.untold``).
"""

from collections.abc import Sequence, Set
from dataclasses import replace

import numpy as np

from spherloc.trace import Stage, Trace, YawStage
from spherloc_viz.layers.frame import Plan
from spherloc_viz.layers.primitives import Step, StepHeading

OUTCOME, TRUTH = "outcome", "truth"
ANSWERS = frozenset({OUTCOME, TRUTH})
"""What may be withheld: what came out, and the true pose and labels with all that follows from them."""

TOLD, HIDDEN, ONLY_OUTCOME = "told", "hidden", "outcome"
"""Which answers are told, in the words of a link: all, none, or what came out without the truth."""


def withheld_by(told: str) -> frozenset[str]:
    """The answers that one of these words withholds."""
    return {TOLD: frozenset[str](), HIDDEN: ANSWERS, ONLY_OUTCOME: frozenset({TRUTH})}[told]


def untold(trace: Trace, withheld: Set[str]) -> Trace:
    """The run without its true pose, true labels and the expected share of wrong matches, if the truth is withheld; and
    without its pose, inliers, certificate and message, if the outcome is."""
    problem = trace.problem
    if TRUTH in withheld:
        problem = replace(problem, truth_cam_from_map=None, truth_inliers=None, estimated_outlier_rate=None)
    told = replace(trace, problem=problem)
    if OUTCOME not in withheld:
        return told
    return replace(
        told,
        stages=tuple(map(_untold, trace.stages)),
        cam_from_map=None,
        inlier_mask=np.zeros_like(trace.inlier_mask),
        message="",
        certificate=None,
    )


def _untold(stage: Stage) -> Stage:
    """The stage without what its steps before the outcome would choose their example by."""
    return replace(stage, clique=stage.clique[:0]) if isinstance(stage, YawStage) else stage


def last_untold(plans: Sequence[Plan], index: int) -> int:
    """Index of the last step up to one that can be shown while what came out is withheld."""
    return next(k for k in range(index, -1, -1) if plans[k].untold is not None)


def untold_headings(plans: Sequence[Plan], headings: Sequence[StepHeading]) -> tuple[StepHeading, ...]:
    """The headings of steps; those that tell what came out are called by their stage."""
    rows = zip(plans, headings, strict=True)
    return tuple(one if plan.untold is not None else replace(one, title=one.stage) for plan, one in rows)


def untold_step(asked: StepHeading, shown: StepHeading) -> Step:
    """What is said at a step that tells what came out, while the picture is that of another one."""
    words = f"What this step tells is withheld until it is revealed; the canvas stays at “{shown.title}”."
    return Step(asked.key, asked.stage, words, "", "", asked.stage)
