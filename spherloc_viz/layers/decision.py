"""Decision: which estimator was chosen for the problem, and why."""

import numpy as np

from spherloc.metrics import ransac_success_probability
from spherloc.trace import DecisionStage
from spherloc_viz import style
from spherloc_viz.layers.frame import Frame, Plan, RunView
from spherloc_viz.layers.primitives import Table


def plans(view: RunView, stage: DecisionStage) -> list[Plan]:
    """One stop."""
    return [Plan("decision", f"Chosen: {stage.chosen}", lambda: _frame(view, stage))]


def _frame(view: RunView, stage: DecisionStage) -> Frame:
    count, rate = len(view.points), stage.inlier_rate
    chance = ransac_success_probability(rate, 2, stage.samples)
    return Frame(
        f"{stage.reason.rstrip('.')}. "
        f"The best of {stage.samples:,} sampled pairs explains {round(rate * count)} of {count} matches, so "
        f"that a clean pair was among them with probability {chance:.3g}.",
        f"P = 1 − (1 − wⁿ)ᵏ,  n = 2,  w = {rate:.3g},  k = {stage.samples:,}   (Eq. 28)",
        view.standing(np.eye(3)),
        view.colors(style.UNDECIDED),
        view.nobody(),
        tables=(_table(stage, count),),
    )


def _table(stage: DecisionStage, count: int) -> Table:
    rows = (
        ("chosen", stage.chosen),
        ("matches", f"{count:,}"),
        ("sampled pairs", f"{stage.samples:,}"),
        ("inliers of the best", f"{100 * stage.inlier_rate:.1f} %"),
    )
    return Table("decision", ("", "this problem"), rows)
