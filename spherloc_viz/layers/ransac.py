"""RANSAC: every hypothesis that beat those before it, with the sample that made it."""

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
    sample, mask, refitted = stage.samples[k], stage.inlier_masks[k], bool(stage.locally_optimized[k])
    inliers, count, size = int(np.count_nonzero(mask)), len(mask), len(sample)
    drawn = int(stage.improved_at[k]) + 1
    chance = ransac_success_probability(inliers / count, size, drawn)
    last = k == len(stage.improved_at) - 1
    then = f"none of the other {stage.iterations - drawn:,} samples beats it" if last else "a later one beats it"
    source = "A fit to the inliers of the step before gives" if refitted else f"Matches {_listed(sample)} fix"
    return Frame(
        Step(
            f"sample-{k + 1}",
            f"Sample {drawn:,}" + (", fitted again" if refitted else "") + (": the best" if last else ""),
            f"{source} a pose that explains {inliers} of {count} matches; {then}. "
            f"At that share of inliers, {_samples(drawn)} only right matches with probability {chance:.3g}.",
            f"P = 1 − (1 − wⁿ)ᵏ,  n = {size}   (Eq. 28)",
            f"Confidence reached: {100 * stage.confidence_reached:.4g} %." if last else "",
        ),
        view.aligned_pose(stage.cam_from_map[k]),
        view.colors(style.UNDECIDED, (mask, style.INLIER), *(() if refitted else ((sample, style.SAMPLE),))),
        mask | np.isin(np.arange(count), sample),
        located=True,
        charts=(chart(stage),),
    )


def _listed(sample: np.ndarray) -> str:
    """The numbers of the sampled matches, "3, 14 and 15"."""
    words = [str(number) for number in sample]
    return ", ".join(words[:-1]) + f" and {words[-1]}" if words[1:] else words[0]


def _samples(drawn: int) -> str:
    return "one sample has" if drawn == 1 else f"one of {drawn:,} samples has"


def chart(stage: RansacStage) -> Chart:
    """Inliers of the best hypothesis over the iterations."""
    counts = np.count_nonzero(stage.inlier_masks, axis=1).astype(np.float64)
    x = np.concatenate([stage.improved_at + 1.0, [max(stage.iterations, 1)]])
    curve = Curve("best hypothesis", x, np.append(counts, counts[-1:]), style.INLIER, "step")
    return Chart("ransac", "Inliers of the best hypothesis so far", "samples drawn", "inliers", (curve,))
