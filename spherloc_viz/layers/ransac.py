"""RANSAC: every hypothesis that beat those before it, with the pair that made it."""

import numpy as np

from spherloc.metrics import ransac_success_probability
from spherloc.trace import RansacStage
from spherloc_viz import style
from spherloc_viz.layers.frame import Frame, RunView
from spherloc_viz.layers.primitives import Chart, Curve, Step


def frames(view: RunView, stage: RansacStage) -> list[Frame]:
    """One frame an improvement."""
    return [_improvement(view, stage, k) for k in range(len(stage.improved_at))]


def _improvement(view: RunView, stage: RansacStage, k: int) -> Frame:
    i, j = stage.samples[k]
    mask = stage.inlier_masks[k]
    inliers, count = int(np.count_nonzero(mask)), len(mask)
    drawn = int(stage.improved_at[k]) + 1
    chance = ransac_success_probability(inliers / count, 2, drawn)
    last = k == len(stage.improved_at) - 1
    then = f"none of the other {stage.iterations - drawn:,} samples beats it" if last else "a later one beats it"
    pair = np.array([i, j])
    return Frame(
        Step(
            f"sample-{k + 1}",
            f"Sample {drawn:,}" + (": the best" if last else ""),
            f"Matches {i} and {j} fix a pose that explains {inliers} of {count} matches; {then}. "
            f"At that share of inliers, {_samples(drawn)} a clean pair with probability {chance:.3g}.",
            "P = 1 − (1 − wⁿ)ᵏ,  n = 2   (Eq. 28)",
        ),
        view.aligned_pose(stage.cam_from_map[k]),
        view.colors(style.UNDECIDED, (mask, style.INLIER), (pair, style.SAMPLE)),
        mask | np.isin(np.arange(count), pair),
        located=True,
        charts=(chart(stage),),
    )


def _samples(drawn: int) -> str:
    return "one sample is" if drawn == 1 else f"{drawn:,} samples contain"


def chart(stage: RansacStage) -> Chart:
    """Inliers of the best hypothesis over the iterations."""
    counts = np.count_nonzero(stage.inlier_masks, axis=1).astype(np.float64)
    x = np.concatenate([stage.improved_at + 1.0, [max(stage.iterations, 1)]])
    curve = Curve("best hypothesis", x, np.append(counts, counts[-1:]), style.INLIER, "step")
    return Chart("ransac", "Inliers of the best hypothesis so far", "samples drawn", "inliers", (curve,))
