"""Yaw: arcs of pairs gather on the ring around the sphere, candidate yaws are tried, and most arcs overlap at one."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial

import numpy as np

from spherloc.geometry import wrap_angle, yaw_rotation
from spherloc.metrics import evaluate
from spherloc.trace import YawStage
from spherloc.types import FloatArray, IntArray
from spherloc_viz import style
from spherloc_viz.layers import ring
from spherloc_viz.layers.frame import Frame, Plan, RunView, angle_text, growing, one_color, ring_focus
from spherloc_viz.layers.primitives import Chart, Focus, SceneItem, Segments, true_minus
from spherloc_viz.layers.stage_arcs import StageArcs

FEW_ARCS, WIDE_PX, NARROW_PX = 30, 5.0, 2.0
"""Widths of the lines of few arcs, which would hardly be seen, and of many."""
RAYS_SEEN = 4.5
"""Largest part of the rays of a pair that is framed, in sphere radii."""


@dataclass(frozen=True, eq=False)
class PairRoots:
    """The wave of Eq. 22 of two correspondences, and its roots."""

    wave: FloatArray
    """Its coefficients (d1, d2, d3)."""
    yaws_rad: FloatArray
    """(0 or 2,) its roots, in [-pi, pi)."""
    in_front: np.ndarray
    """(0 or 2,) whether both points are in front of the camera there."""


def pair_roots(view: RunView, first: int, second: int) -> PairRoots:
    """The roots of the wave of two correspondences."""
    aligned = view.trace.problem.aligned
    vi, vj = aligned.bearings[np.searchsorted(aligned.index, [first, second])]
    d, n = view.points[first] - view.points[second], np.cross(vi, vj)
    wave = np.array([n[0] * d[0] + n[2] * d[2], n[0] * d[2] - n[2] * d[0], n[1] * d[1]])
    rho = float(np.hypot(wave[0], wave[1]))
    if rho == 0.0 or abs(wave[2]) > rho:
        return PairRoots(wave, np.zeros(0), np.zeros(0, dtype=bool))
    half = float(np.arccos(-wave[2] / rho))
    yaws = np.asarray(wrap_angle(np.arctan2(wave[1], wave[0]) + half * np.array([1.0, -1.0])))
    # R d = s_i v_i - s_j v_j has both depths positive if both points are in front.
    rays = np.column_stack([vi, -vj])
    depths = np.array([np.linalg.lstsq(rays, yaw_rotation(yaw) @ d, rcond=None)[0] for yaw in yaws])
    return PairRoots(wave, yaws, np.all(depths > 0.0, axis=1))


def _pair(view: RunView, arcs: StageArcs) -> Frame:
    """A pair, and the arc of yaws that it allows."""
    example, stage = arcs.example, arcs.stage
    first, second = (int(number) for number in stage.pairs[example[0]])
    k = arcs.example_in_clique
    lo, hi = np.degrees(stage.lo_rad[k]), np.degrees(stage.hi_rad[k])
    also = ", and a second arc" if len(example) > 1 else ""
    d1, d2, d3 = pair_roots(view, first, second).wave
    items = _items(view, arcs, example, (first, second))
    return Frame(
        f"Matches {first} and {second} can both be right only where the line between their points turns into the plane "
        "of their bearings, and that fixes the yaw. With errors up to the bound, "
        f"{view.trace.options.bound_px:.3g} px, it is an arc of {hi - lo:.2g}°, from {lo:.2f}° to {hi:.2f}°{also}.",
        f"{true_minus(f'{d1:.3g}')} cos θ {_signed(d2)} sin θ {_signed(d3)} = 0   (Eq. 22)",
        *_shown(view, (first, second), 0.5 * float(stage.lo_rad[k] + stage.hi_rad[k])),
        note=stage.rule,
        items=(
            *items,
            ring.name(
                "ring/name", view, 0.5 * float(stage.lo_rad[k] + stage.hi_rad[k]), "arc: the yaws this pair allows"
            ),
        ),
        focus=_focus(view, (first, second), items),
    )


def _roots(view: RunView, arcs: StageArcs) -> Frame:
    """All arcs of the pair, and how many arcs pairs have."""
    example, stage = arcs.example, arcs.stage
    first, second = (int(number) for number in stage.pairs[example[0]])
    found = pair_roots(view, first, second)
    one, several = arcs.pair_counts
    none, more = stage.pairs_total - one - several, "" if arcs.two_at_most else " or more"
    other = example[np.argmin(arcs.in_clique[example])]
    items = _items(view, arcs, example, (first, second))
    return Frame(
        f"{_why(found, len(example))} Of all {stage.pairs_total:,} pairs, {several:,} have two arcs{more}, {one:,} "
        f"have one, and {none:,} have none.",
        "θ = atan2(d2, d1) ± arccos(−d3 / √(d1² + d2²))   (Eq. 22-23)",
        *_shown(view, (first, second), 0.5 * float(stage.lo_rad[other] + stage.hi_rad[other])),
        note=stage.rule,
        items=items,
        focus=_focus(view, (first, second), items),
    )


def _focus(view: RunView, numbers: tuple[int, int], items: tuple[SceneItem, ...]) -> Focus:
    """The ring, and the rays of a pair up to ``RAYS_SEEN``: with far points in view, the ring would be small."""
    away = view.points[list(numbers)] - view.middle
    room_m = RAYS_SEEN * view.sphere_m
    ends = view.middle + away * np.minimum(1.0, room_m / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12))
    return ring_focus(view, ends, *ring.true_ends(items))


def _why(roots: PairRoots, arcs: int) -> str:
    """A sentence on the reason for the number of the pair's arcs."""
    if len(roots.yaws_rad) == 0:
        return "The wave of this pair only comes near zero, so it has no exact root."
    one, two = (f"{value:.2f}°" for value in np.degrees(roots.yaws_rad))
    wave = f"A wave crosses zero twice in a turn, so the pair has two roots, {one} and {two}"
    if roots.in_front.all() and arcs > 1:
        return f"{wave}, and both put its points in front of the camera: only other matches tell the two apart."
    if roots.in_front.all():
        return f"{wave}, but the arc around one of them is too wide to say much."
    other = two if roots.in_front[0] else one
    return f"{wave}, but {other} would put a point opposite to its bearing."


def _signed(value: float) -> str:
    return f"{'−' if value < 0 else '+'} {abs(value):.3g}"


def _shown(view: RunView, numbers: tuple[int, int], yaw_rad: float) -> tuple[FloatArray, np.ndarray, np.ndarray]:
    """The sphere at a yaw, the pair in its colour, and its rays."""
    mask = view.mask(np.array(numbers))
    return view.standing(yaw_rotation(yaw_rad)), view.colors(style.UNDECIDED, (mask, style.SAMPLE)), mask


def _items(view: RunView, arcs: StageArcs, shown: np.ndarray, numbers: tuple[int, int]) -> tuple[SceneItem, ...]:
    """Some arcs of the pair with a spoke through each, and the line between its points."""
    middles = 0.5 * (arcs.stage.lo_rad + arcs.stage.hi_rad)[shown]
    spokes = [ring.spoke("ring/candidate", view, view.middle, float(yaw), style.SAMPLE).points for yaw in middles]
    marked = np.ones(len(shown), dtype=bool)
    ends = view.points[list(numbers)][None]
    ids = np.array([numbers], dtype=np.int64)
    return (
        arcs.drawn(view, shown, marked, style.SAMPLE, 7.0),
        ring.outline("ring/overlap", ring.circle(view, view.middle, np.zeros(())), style.SPHERE),
        ring.pieces("ring/pieces", view, arcs.stage.lo_rad[shown], arcs.stage.hi_rad[shown]),
        Segments("ring/candidate", "yaw ring", np.concatenate(spokes), one_color(style.SAMPLE, len(spokes)), 4.0),
        *ring.spokes(view, view.middle, None, middles),
        Segments("pairs/sample", "pairs", ends, one_color(style.SAMPLE, 1), 3.0, ids=ids),
    )


CANDIDATE = "candidate"
"""Label of a candidate yaw's marker in a chart."""
SIZES = (10, 30, 100, 300, 1000, 3000)
"""Numbers of arcs that are shown in steps before all are."""
MAX_CANDIDATES = 8
"""Largest number of candidate yaws with a step, before the one with the largest overlap."""
REACH = 40
"""A peak is the largest value within this many quarters of a degree on both sides."""


def plans(view: RunView, stage: YawStage) -> list[Plan]:
    """Steps for one pair with its arcs, more and more arcs, candidate yaws, and the largest overlap."""
    arcs = StageArcs(stage, view.trace.inlier_mask)
    pair, roots, every = partial(_pair, view, arcs), partial(_roots, view, arcs), partial(_all, view, arcs)
    out = [
        Plan("yaw-pair", "One pair of matches", pair, _chart_of(view, arcs, "yaw-pair"), untold=pair),
        Plan("yaw-roots", "The two roots of a pair", roots, _chart_of(view, arcs, "yaw-roots"), untold=roots),
    ]
    for size in growing(len(arcs), *SIZES):
        key, some = f"{GROWING}{size}", partial(_some, view, arcs, size)
        charts = _chart_of(view, arcs, key)
        out.append(Plan(key, f"{size:,} arcs", some, charts, untold=partial(some, told=False)))
    charts = {"yaw": lambda: chart(view, stage)}
    out.append(Plan("yaw-arcs", "Yaw arcs of all pairs", every, charts, untold=every))
    places = candidate_yaws(stage)
    for number, place in enumerate(places, 1):
        yaw = ring.degrees_of(place + 0.5, len(stage.overlap))
        charts = {"yaw": partial(chart, view, stage, candidate_rad=np.radians(yaw))}
        draw = partial(_candidate, view, arcs, places[:number])
        out.append(Plan(f"yaw-candidate-{number}", f"Candidate yaw {yaw:.1f}°", draw, charts))
    charts = {"yaw": lambda: chart(view, stage, found=True)}
    out.append(Plan("yaw-clique", "The yaw most arcs share", lambda: _clique(view, arcs), charts))
    return out


GROWING = "yaw-arcs-"
"""Beginning of the keys of steps that show the first few arcs; the number of these follows."""


def chosen_arcs(arcs: StageArcs, key: str) -> IntArray | None:
    """Indices of the arcs that a step shows, ascending; None if it shows all."""
    if key in ("yaw-pair", "yaw-roots"):
        return arcs.example
    size = key.removeprefix(GROWING)
    return np.sort(arcs.spread(int(size))) if size != key and size.isdecimal() else None


def _chart_of(view: RunView, arcs: StageArcs, key: str) -> dict[str, Callable[[], Chart]]:
    """The chart of a step that shows some of the arcs."""

    def draw() -> Chart:
        chosen = chosen_arcs(arcs, key)
        assert chosen is not None
        return counts_chart(view, arcs.overlap_of(chosen).overlap)

    return {"yaw": draw}


def candidate_yaws(stage: YawStage) -> IntArray:
    """Candidate yaws, in quarters of a degree from -180: the highest peaks except the largest overlap, by yaw."""
    highest = ring.peaks(stage.overlap, REACH, MAX_CANDIDATES + 1)
    places = len(stage.overlap)
    end = int((stage.yaw_rad + np.pi) / (2 * np.pi) * places)
    gaps = np.abs(highest - end)
    return np.sort(highest[np.minimum(gaps, places - gaps) > REACH][:MAX_CANDIDATES])


def _some(view: RunView, arcs: StageArcs, size: int, told: bool = True) -> Frame:
    """The first arcs of those that are spread over all pairs; if ``told``, where most of them overlap."""
    chosen, start = arcs.spread(size), view.standing(np.eye(3))
    found = arcs.overlap_of(chosen)
    drawn = chosen[: style.MAX_DRAWN_ARCS]
    note = "The arcs are taken evenly from all pairs. " + arcs.stage.rule
    if len(drawn) < size:
        note += f" {len(drawn)} of these {size:,} are drawn."
    most, off = len(found.clique), ring.off_truth(view, found.yaw_rad)
    meet = "no two overlap" if most == 1 else f"at most {most:,} overlap, at {np.degrees(found.yaw_rad):.2f}°{off}"
    count = f" = {most:,}" if told else ""
    return Frame(
        f"With {size:,} of {len(arcs):,} arcs on the ring, {meet if told else 'the outline counts those at each yaw'}. "
        "Arcs of wrong pairs lie anywhere; of two right matches, one arc holds the true yaw.",
        f"max over θ of Σ 1(|f(θ)| ≤ τ){count}   (Eq. 34)",
        start,
        view.colors(style.UNDECIDED),
        view.no_matches(),
        note=note,
        items=_ring(view, arcs, drawn, found.overlap),
    )


def _all(view: RunView, arcs: StageArcs) -> Frame:
    stage, start = arcs.stage, view.standing(np.eye(3))
    drawn, count = arcs.spread(style.MAX_DRAWN_ARCS), len(arcs)
    note = stage.rule
    if len(drawn) < count:
        note += f" {len(drawn)} of {count:,} arcs, taken evenly from all pairs, are drawn."
    width = np.degrees(arcs.median_width_rad)
    return Frame(
        f"Two matches fix the yaw up to their noise: {stage.pairs_total:,} pairs give {count:,} arcs, {width:.1f}° "
        "wide at the median. The ring shows where the camera would look; the outline counts the arcs.",
        "|d1 cos θ + d2 sin θ + d3| ≤ τ   (Eq. 22, 33)",
        start,
        view.colors(style.UNDECIDED),
        view.no_matches(),
        note=note,
        items=_ring(view, arcs, drawn, stage.overlap),
    )


def _candidate(view: RunView, arcs: StageArcs, places: IntArray) -> Frame:
    """The last of the candidate yaws so far."""
    counts, place = arcs.stage.overlap, int(places[-1])
    lo, hi = (ring.degrees_of(place + part, len(counts)) for part in (0, 1))
    yaw, here = np.radians(0.5 * (lo + hi)), int(counts[place])
    turned, drawn = view.standing(yaw_rotation(yaw)), arcs.spread(style.MAX_DRAWN_ARCS)
    met = arcs.over(drawn, np.radians(lo), np.radians(hi))
    mean = float(np.sum(arcs.stage.hi_rad - arcs.stage.lo_rad)) / (2 * np.pi)
    items = _ring(view, arcs, drawn, counts, met, style.SAMPLE, (yaw,))
    return Frame(
        f"The candidate yaw {0.5 * (lo + hi):.1f}° lies in up to {here:,} of {len(arcs):,} arcs, counted over a "
        f"quarter of a degree: the most within 10° on either side. {_so_far(counts, places)}",
        f"Σ 1(|f(θ)| ≤ τ) = {here:,}   (Eq. 34)",
        turned,
        view.colors(style.UNDECIDED),
        view.no_matches(),
        note=f"A yaw at random lies in {mean:,.0f} arcs on average. Arcs drawn: {len(drawn)}; pink ones hold it.",
        items=(*items, ring.spoke("ring/candidate", view, view.middle, yaw, style.SAMPLE)),
    )


def _so_far(counts: np.ndarray, places: IntArray) -> str:
    """A sentence that compares the last candidate with those before it."""
    if len(places) == 1:
        return "It is the first candidate from −180° on; only the highest peaks are shown."
    best = places[:-1][int(np.argmax(counts[places[:-1]]))]
    most, here = int(counts[best]), int(counts[places[-1]])
    where = f"{ring.degrees_of(best + 0.5, len(counts)):.1f}°"
    if here > most:
        return f"That beats the candidates before it, of which {where} was the best with {most:,}."
    return f"The candidate at {where} {'is in more' if most > here else 'is in as many'}: {most:,}."


def _clique(view: RunView, arcs: StageArcs) -> Frame:
    stage, drawn = arcs.stage, arcs.with_clique()
    turned, count = view.standing(yaw_rotation(stage.yaw_rad)), len(arcs)
    note = f"The more of its arcs are in the clique, the more gold a match is. {stage.rule}".strip()
    if len(drawn) < count:
        note += f" {len(drawn)} of {count:,} arcs, evenly chosen, are drawn, half of them from the clique."
    interval = np.degrees(stage.best_rad[1] - stage.best_rad[0])
    off = ring.off_truth(view, stage.yaw_rad)
    error_deg = evaluate(view.trace).rotation_error_deg
    if off and error_deg is not None:
        note = f"The refinement turns the camera, too: the pose of the outcome is {angle_text(error_deg)} off. {note}"
    note = f"{_widened(view, stage)}{note}"
    items = _ring(view, arcs, drawn, stage.overlap, arcs.in_clique[drawn], style.CLIQUE, (stage.yaw_rad,))
    return Frame(
        f"{len(stage.clique):,} arcs, each of a pair of matches, overlap at {np.degrees(stage.yaw_rad):.2f}°{off}; no "
        f"other yaw lies in more. They are a maximum clique of the rotation graph and agree on an interval of "
        f"{interval:.2g}°.",
        "max over θ of Σ 1(|f(θ)| ≤ τ)   (Eq. 34, 37)",
        turned,
        style.blended(style.UNDECIDED, style.CLIQUE, view.shares(stage.pairs[stage.clique])),
        view.no_matches(),
        note=note,
        items=(
            *items,
            ring.spoke("ring/estimate", view, view.middle, stage.yaw_rad, style.ESTIMATE),
            ring.name("ring/name", view, stage.yaw_rad, "maximum clique of arcs"),
            ring.name("ring/ring", view, stage.yaw_rad + np.pi, "yaw ring, as high as arcs overlap", stage.overlap),
        ),
    )


def _widened(view: RunView, stage: YawStage) -> str:
    """What an error of gravity does to the arcs, as a sentence; empty if gravity has none."""
    bound_deg, right = np.degrees(view.trace.problem.gravity_bound_rad), view.trace.problem.truth_inliers
    if bound_deg == 0.0:
        return ""
    lost = right is not None and not right[stage.pairs].all(axis=1).any()
    which = ", and leaves none of two right matches narrow enough" if lost else ""
    return f"Gravity's error, up to {bound_deg:.2g}°, widens the arcs{which}. "


def _ring(
    view: RunView,
    arcs: StageArcs,
    drawn: IntArray,
    counts: np.ndarray,
    marked: np.ndarray | None = None,
    mark: style.RGB = style.UNDECIDED,
    yaws_rad: Iterable[float] = (),
) -> tuple[SceneItem, ...]:
    """Some arcs, those that are marked in their colour, the outline of the counts, and the true yaw if it is known,
    where it hides no line at one of ``yaws_rad``."""
    heights = ring.by_degree(counts)
    line = ring.circle(view, view.middle, heights / max(1, int(heights.max())))
    mask = np.zeros(len(drawn), dtype=bool) if marked is None else marked
    band = arcs.drawn(view, drawn, mask, mark, WIDE_PX if len(drawn) <= FEW_ARCS else NARROW_PX)
    return band, ring.outline("ring/overlap", line, style.SPHERE), *ring.spokes(view, view.middle, None, yaws_rad)


def counts_chart(view: RunView, counts: np.ndarray, yaw_rad: float | None = None) -> Chart:
    """Overlap count over yaw, with the truth and an estimate if there is one."""
    peak = float(counts.max(initial=1))
    curves = [ring.step_curve("that overlap", counts), *ring.markers(view, peak, yaw_rad)]
    return Chart("yaw", "Arcs that overlap at each yaw", "yaw (°)", "number of arcs", tuple(curves))


def chart(view: RunView, stage: YawStage, found: bool = False, candidate_rad: float | None = None) -> Chart:
    """Overlap count of all arcs over yaw, with the truth and, once found, the estimate, or a candidate yaw."""
    plain = counts_chart(view, stage.overlap, stage.yaw_rad if found else None)
    if candidate_rad is None:
        return plain
    candidate = ring.marker(CANDIDATE, candidate_rad, float(stage.overlap.max(initial=1)), style.SAMPLE)
    return Chart(plain.name, plain.title, plain.x_label, plain.y_label, (*plain.curves, candidate))
