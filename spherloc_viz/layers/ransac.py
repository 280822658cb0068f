"""RANSAC: every hypothesis that was better than those before it, and the prediction of Eq. 28; the choice of
``auto``."""

from functools import partial

import numpy as np

from spherloc.metrics import ransac_success_probability
from spherloc.trace import DecisionStage, RansacStage
from spherloc_viz import style
from spherloc_viz.layers.frame import Frame, Plan, RunView, close_focus, even, one_color
from spherloc_viz.layers.primitives import Chart, Curve, Segments, Table

MAX_IMPROVEMENTS = 60
"""Largest number of improvements with steps; of more an even sample is shown, with the first and the last, the best."""
MAX_IN_TWO = 30
"""Largest number of improvements that have two steps each: the sample, and the votes of the matches."""
SHARES = (0.5, 0.2, 0.1, 0.05, 0.02)
"""Shares of inliers for which the table of Eq. 28 is computed."""
CURVE_POINTS = 80


def plans(view: RunView, stage: RansacStage) -> list[Plan]:
    """Steps for the number of samples by Eq. 28, every improvement, and a comparison with Eq. 28."""
    count = len(stage.improved_at)
    shown = even(np.arange(count), MAX_IMPROVEMENTS).tolist()
    needed = partial(_needed, view, stage)
    out = [Plan("samples-needed", "How many samples it takes", needed, untold=partial(needed, told=False))]
    for k in shown:
        title, charts = _title(stage, k), {"ransac": partial(chart, stage, k)}
        if count <= MAX_IN_TWO:
            out.append(Plan(f"sample-{k + 1}-pose", f"{title.split(':')[0]}, a pose", partial(_drawn, view, stage, k)))
        out.append(Plan(f"sample-{k + 1}", title, partial(_improvement, view, stage, k), charts))
    if count:
        charts = {"ransac": partial(chart, stage, count - 1), "chance": partial(chance_chart, stage)}
        out.append(Plan("samples-drawn", "What was to be expected", lambda: _expected(view, stage), charts))
    return out


def _title(stage: RansacStage, k: int) -> str:
    again = ", fitted again" if stage.locally_optimized[k] else ""
    best = ": the best" if k == len(stage.improved_at) - 1 else ""
    return f"Sample {int(stage.improved_at[k]) + 1:,}{again}{best}"


def _size(stage: RansacStage) -> int:
    return stage.samples.shape[1]


def _needed(view: RunView, stage: RansacStage, told: bool = True) -> Frame:
    """How many samples it takes by Eq. 28; if ``told``, also how many the run drew, which its inliers may decide."""
    size = _size(stage)
    rows = tuple((f"{100 * share:.0f} %", f"{_samples_for(share, size):,}") for share in SHARES)
    half, tenth = _samples_for(0.5, size), _samples_for(0.1, size)
    return Frame(
        f"A sample of {size} matches gives a right pose only if all {size} are right, so with half of them right "
        f"{half:,} samples hold a clean one with 99 % probability, and with a tenth {tenth:,}."
        + (f" This run drew {stage.iterations:,} samples from {len(view.points)} matches." if told else ""),
        f"k = log(1 − P) / log(1 − wⁿ),  n = {size},  P = 0.99   (Eq. 28)",
        view.standing(np.eye(3)),
        view.colors(style.UNDECIDED),
        view.no_matches(),
        tables=(Table("samples needed for 99 %", ("right matches", "samples"), rows),),
    )


def _samples_for(share: float, size: int, chance: float = 0.99) -> int:
    """Eq. 28 for the number of samples."""
    return int(np.ceil(np.log1p(-chance) / np.log1p(-(share**size))))


def _drawn(view: RunView, stage: RansacStage, k: int) -> Frame:
    """A sample and its pose, before the matches vote."""
    sample, refitted = stage.samples[k], bool(stage.locally_optimized[k])
    state, colors = view.aligned_pose(stage.cam_from_map[k]), view.colors(style.UNDECIDED, (sample, style.SAMPLE))
    if refitted:
        before = stage.inlier_masks[max(k - 1, 0)]
        colors, rays = view.colors(style.UNDECIDED, (before, style.SAMPLE)), before
        what = f"All {np.count_nonzero(before)} inliers of the step before are fitted at once"
        items = ()
    else:
        rays, what = view.mask(sample), f"Sample {int(stage.improved_at[k]) + 1:,} takes matches {_listed(sample)}"
        items = (_line(view, sample),)
    return Frame(
        f"{what}, and the camera comes to stand at {view.position(state)}. {_in_truth(view, np.flatnonzero(rays))}",
        f"n = {_size(stage)}:  s v = R p + t for every sampled match   (Eq. 18)",
        state,
        colors,
        rays,
        located=True,
        items=items,
        focus=close_focus(view, state, view.points[sample]),
    )


def _in_truth(view: RunView, sample: np.ndarray) -> str:
    """Whether a sample is clean, as a sentence."""
    labels = view.trace.problem.truth_inliers
    if labels is None:
        return f"Whether these are right is not known yet, so the pose is tested on all {len(view.points)} matches."
    right = int(np.count_nonzero(labels[sample]))
    return f"In truth {right} of these {len(sample)} are right, which RANSAC cannot know: it tests the pose on all."


def _line(view: RunView, sample: np.ndarray) -> Segments:
    """Lines between the sampled points, one after another."""
    ids = np.stack([sample[:-1], sample[1:]], axis=1).astype(np.int64)
    return Segments("pairs/sample", "pairs", view.points[ids], one_color(style.SAMPLE, len(ids)), 3.0, ids=ids)


def _improvement(view: RunView, stage: RansacStage, k: int) -> Frame:
    sample, mask, refitted = stage.samples[k], stage.inlier_masks[k], bool(stage.locally_optimized[k])
    inliers, count, size = int(np.count_nonzero(mask)), len(mask), len(sample)
    drawn, total = int(stage.improved_at[k]) + 1, len(stage.improved_at)
    chance = ransac_success_probability(inliers / count, size, drawn)
    last = k == total - 1
    then = f"none of the other {stage.iterations - drawn:,} samples beats it" if last else "a later one beats it"
    source = "A fit to the inliers of the step before gives" if refitted else f"Matches {_listed(sample)} fix"
    note = f"Confidence reached: {100 * stage.confidence_reached:.4g} %." if last else ""
    if total > MAX_IMPROVEMENTS:
        note += f" {MAX_IMPROVEMENTS} of {total} improvements are shown: evenly, with the first and the last."
    return Frame(
        f"{source} a pose that explains {inliers} of {count} matches; {then}. "
        f"At that share of inliers, {_samples(drawn)} only right matches with probability {chance:.3g}.",
        f"P = 1 − (1 − wⁿ)ᵏ,  n = {size}   (Eq. 28)",
        view.aligned_pose(stage.cam_from_map[k]),
        view.colors(style.UNDECIDED, (mask, style.INLIER), *(() if refitted else ((sample, style.SAMPLE),))),
        mask if refitted else mask | view.mask(sample),
        note=note.strip(),
        located=True,
        items=() if refitted else (_line(view, sample),),
    )


def _expected(view: RunView, stage: RansacStage) -> Frame:
    """Eq. 28 with the best pose's share of inliers, compared with this run."""
    mask, size = stage.inlier_masks[-1], _size(stage)
    share, best = np.count_nonzero(mask) / len(mask), int(stage.improved_at[-1]) + 1
    by_then = ransac_success_probability(share, size, best)
    clean = mask[stage.samples].all(axis=1) & ~stage.locally_optimized
    if clean.any():
        first = int(stage.improved_at[np.flatnonzero(clean)[0]]) + 1
        met = f"the first of these that improved on the best so far was sample {first:,}"
    else:
        met = "none of these improved on the best so far"
    mean = f"one sample in {1.0 / share**size:,.0f} is expected" if share else "no sample is expected"
    return Frame(
        f"With {100 * share:.3g} % inliers, {mean} to hold only inliers of the best pose; {met}. The best pose came "
        f"with sample {best:,}; the probability that such a sample is drawn by then is {by_then:.3g}.",
        f"P = 1 − (1 − wⁿ)ᵏ,  n = {size},  w = {share:.3g},  k = {best:,}   (Eq. 28)",
        view.aligned_pose(stage.cam_from_map[-1]),
        view.colors(style.UNDECIDED, (mask, style.INLIER)),
        mask,
        note=f"After all {stage.iterations:,} samples the confidence is {100 * stage.confidence_reached:.4g} %.",
        located=True,
    )


def _listed(sample: np.ndarray) -> str:
    """The numbers of the sampled matches, "3, 14 and 15"."""
    words = [str(number) for number in sample]
    return ", ".join(words[:-1]) + f" and {words[-1]}" if words[1:] else words[0]


def _samples(drawn: int) -> str:
    return "one sample has" if drawn == 1 else f"one of {drawn:,} samples has"


def chart(stage: RansacStage, last: int) -> Chart:
    """Inliers of the best hypothesis over the iterations, up to an improvement."""
    counts = np.count_nonzero(stage.inlier_masks[: last + 1], axis=1).astype(np.float64)
    whole = last == len(stage.improved_at) - 1
    end = max(stage.iterations, 1) if whole else int(stage.improved_at[last + 1]) + 1
    x = np.append(stage.improved_at[: last + 1] + 1.0, float(end))
    curve = Curve("best hypothesis", x, np.append(counts, counts[-1:]), style.INLIER, "step")
    return Chart("ransac", "Inliers of the best hypothesis so far", "samples drawn", "inliers", (curve,))


def chance_chart(stage: RansacStage) -> Chart:
    """Eq. 28 over the samples, with the best pose's share of inliers, and when that pose was found."""
    mask, size = stage.inlier_masks[-1], _size(stage)
    share, best = np.count_nonzero(mask) / len(mask), float(stage.improved_at[-1]) + 1.0
    drawn = np.unique(np.geomspace(1, max(stage.iterations, 1), CURVE_POINTS).round())
    chances = np.array([ransac_success_probability(share, size, int(k)) for k in drawn])
    curves = (
        Curve("clean sample", drawn, chances, style.UNDECIDED),
        Curve("best pose found", np.array([best]), np.array([1.0]), style.INLIER, "marker"),
    )
    return Chart("chance", "Chance that a sample was clean, by Eq. 28", "samples drawn", "probability", curves)


def decision_plans(view: RunView, stage: DecisionStage) -> list[Plan]:
    """One step."""
    return [Plan("decision", f"Chosen: {stage.chosen}", lambda: _decision(view, stage))]


def _decision(view: RunView, stage: DecisionStage) -> Frame:
    count, rate = len(view.points), stage.inlier_rate
    chance = ransac_success_probability(rate, 2, stage.samples)
    return Frame(
        f"{stage.reason.rstrip('.')}. "
        f"The best of {stage.samples:,} sampled pairs explains {round(rate * count)} of {count} matches, so "
        f"that a clean pair was among them with probability {chance:.3g}.",
        f"P = 1 − (1 − wⁿ)ᵏ,  n = 2,  w = {rate:.3g},  k = {stage.samples:,}   (Eq. 28)",
        view.standing(np.eye(3)),
        view.colors(style.UNDECIDED),
        view.no_matches(),
        tables=(_decision_table(stage, count),),
    )


def _decision_table(stage: DecisionStage, count: int) -> Table:
    rows = (
        ("chosen", stage.chosen),
        ("matches", f"{count:,}"),
        ("sampled pairs", f"{stage.samples:,}"),
        ("inliers of the best", f"{100 * stage.inlier_rate:.1f} %"),
    )
    return Table("decision", ("", "this problem"), rows)
