"""Yaw: arcs of pairs gather on the ring around the sphere, candidate yaws are tried, and most arcs overlap at one."""

from functools import partial

import numpy as np

from spherloc.geometry import yaw_rotation
from spherloc.trace import YawStage
from spherloc.types import IntArray
from spherloc_viz import style
from spherloc_viz.layers import ring, two_roots
from spherloc_viz.layers.arcs import Arcs
from spherloc_viz.layers.frame import Frame, Plan, RunView, growing
from spherloc_viz.layers.primitives import Chart, SceneItem

SIZES = (10, 30, 100, 300, 1000, 3000)
"""How many arcs are shown before all are."""
STOPS = 8
"""Candidate yaws shown at most, before the one with the deepest overlap."""
REACH = 40
"""A peak is the highest within so many quarters of a degree."""


def plans(view: RunView, stage: YawStage) -> list[Plan]:
    """One pair with its arcs, more and more arcs, candidate yaws, and the deepest overlap."""
    arcs = Arcs(stage)
    own = two_roots.charts(view, arcs, counts_chart)
    out = [
        Plan("yaw-pair", "One pair of matches", lambda: two_roots.pair(view, arcs)),
        Plan(
            "yaw-roots",
            "The two roots of a pair",
            lambda: two_roots.roots(view, arcs),
            own,
        ),
    ]
    for size in growing(len(arcs), *SIZES):
        charts = {"yaw": partial(_growing_chart, view, arcs, size)}
        out.append(Plan(f"yaw-arcs-{size}", f"{size:,} arcs", partial(_some, view, arcs, size), charts))
    out.append(Plan("yaw-arcs", "Yaw arcs of all pairs", lambda: _all(view, arcs), {"yaw": lambda: chart(view, stage)}))
    stops = candidate_yaws(stage)
    for number, place in enumerate(stops, 1):
        yaw = ring.degrees_of(place + 0.5, len(stage.overlap))
        charts = {"yaw": partial(chart, view, stage, candidate_rad=np.radians(yaw))}
        draw = partial(_candidate, view, arcs, stops[:number])
        out.append(Plan(f"yaw-candidate-{number}", f"Candidate yaw {yaw:.1f}°", draw, charts))
    charts = {"yaw": lambda: chart(view, stage, found=True)}
    out.append(Plan("yaw-clique", "The yaw most arcs share", lambda: _clique(view, arcs), charts))
    return out


def candidate_yaws(stage: YawStage) -> IntArray:
    """Candidate yaws, in quarters of a degree from -180: the highest peaks without the deepest overlap, by yaw."""
    highest = ring.peaks(stage.overlap, REACH, STOPS + 1)
    places = len(stage.overlap)
    end = int((stage.yaw_rad + np.pi) / (2 * np.pi) * places)
    gaps = np.abs(highest - end)
    return np.sort(highest[np.minimum(gaps, places - gaps) > REACH][:STOPS])


def _some(view: RunView, arcs: Arcs, size: int) -> Frame:
    """The first arcs of those that are spread over all pairs."""
    chosen, start = arcs.spread(size), view.standing(np.eye(3))
    found = arcs.overlap_of(chosen)
    drawn = chosen[: style.MAX_DRAWN_ARCS]
    note = "The arcs are taken evenly from all pairs. " + arcs.stage.rule
    if len(drawn) < size:
        note += f" {len(drawn)} of these {size:,} are drawn."
    most, off = len(found.clique), ring.off_truth(view, found.yaw_rad)
    return Frame(
        f"With {size:,} of {len(arcs):,} arcs on the ring, at most {most:,} overlap, at "
        f"{np.degrees(found.yaw_rad):.2f}°{off}. "
        "Arcs of wrong pairs lie anywhere, while those of right matches all hold the true yaw.",
        f"max over θ of Σ 1(|f(θ)| ≤ τ) = {most:,}   (Eq. 34)",
        start,
        view.colors(style.UNDECIDED),
        view.nobody(),
        note=note,
        items=_ring(view, arcs, drawn, found.overlap),
    )


def _all(view: RunView, arcs: Arcs) -> Frame:
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
        view.nobody(),
        note=note,
        items=_ring(view, arcs, drawn, stage.overlap),
    )


def _candidate(view: RunView, arcs: Arcs, stops: IntArray) -> Frame:
    """The last of the candidate yaws so far."""
    counts, place = arcs.stage.overlap, int(stops[-1])
    lo, hi = (ring.degrees_of(place + part, len(counts)) for part in (0, 1))
    yaw, here = np.radians(0.5 * (lo + hi)), int(counts[place])
    turned, drawn = view.standing(yaw_rotation(yaw)), arcs.spread(style.MAX_DRAWN_ARCS)
    met = arcs.over(drawn, np.radians(lo), np.radians(hi))
    mean = float(np.sum(arcs.stage.hi_rad - arcs.stage.lo_rad)) / (2 * np.pi)
    items = _ring(view, arcs, drawn, counts, met, style.SAMPLE)
    return Frame(
        f"The candidate yaw {lo:.2f}° lies in up to {here:,} of {len(arcs):,} arcs within a quarter of a degree, the "
        f"most within 10° on either side. {_so_far(counts, stops)}",
        f"Σ 1(|f(θ)| ≤ τ) = {here:,}   (Eq. 34)",
        turned,
        view.colors(style.UNDECIDED),
        view.nobody(),
        note=f"A yaw at random lies in {mean:,.0f} arcs on average. {len(drawn)} arcs are drawn; pink ones hold it.",
        items=(*items, ring.spoke("ring/candidate", view, view.middle, yaw, style.SAMPLE)),
    )


def _so_far(counts: np.ndarray, stops: IntArray) -> str:
    """How the last candidate compares with those before it."""
    if len(stops) == 1:
        return "It is the first candidate from −180° on; only the highest peaks are shown."
    best = stops[:-1][int(np.argmax(counts[stops[:-1]]))]
    most, here = int(counts[best]), int(counts[stops[-1]])
    where = f"{ring.degrees_of(best, len(counts)):.2f}°"
    if here > most:
        return f"That beats the candidates before it, of which {where} was the best with {most:,}."
    return f"The candidate at {where} {'is in more' if most > here else 'is in as many'}: {most:,}."


def _clique(view: RunView, arcs: Arcs) -> Frame:
    stage, drawn = arcs.stage, arcs.with_clique()
    turned, count = view.standing(yaw_rotation(stage.yaw_rad)), len(arcs)
    note = stage.rule
    if len(drawn) < count:
        note += f" An even sample of {len(drawn)} of {count:,} arcs is drawn, half of them from the clique."
    interval = np.degrees(stage.best_rad[1] - stage.best_rad[0])
    off = ring.off_truth(view, stage.yaw_rad)
    items = _ring(view, arcs, drawn, stage.overlap, arcs.in_clique[drawn], style.CLIQUE)
    return Frame(
        f"{len(stage.clique):,} arcs overlap at {np.degrees(stage.yaw_rad):.2f}°{off}; no other yaw lies in more. "
        f"They are a maximum clique of the rotation graph and agree on an interval of {interval:.2g}°.",
        "max over θ of Σ 1(|f(θ)| ≤ τ)   (Eq. 34, 37)",
        turned,
        view.colors(style.UNDECIDED, (view.mask(stage.pairs[stage.clique]), style.CLIQUE)),
        view.nobody(),
        note=note,
        items=(
            *items,
            ring.spoke("ring/estimate", view, view.middle, stage.yaw_rad, style.ESTIMATE),
            ring.name("ring/name", view, stage.yaw_rad, "maximum clique: these arcs overlap"),
            ring.name("ring/ring", view, stage.yaw_rad + np.pi, "yaw ring"),
        ),
    )


def _ring(
    view: RunView,
    arcs: Arcs,
    drawn: IntArray,
    counts: np.ndarray,
    marked: np.ndarray | None = None,
    mark: style.RGB = style.UNDECIDED,
) -> tuple[SceneItem, ...]:
    """Some arcs, those that are marked in their colour, the outline of the counts, and the true yaw if it is known."""
    heights = ring.by_degree(counts)
    line = ring.circle(view, view.middle, heights / max(1, int(heights.max())))
    mask = np.zeros(len(drawn), dtype=bool) if marked is None else marked
    band = arcs.drawn(view, drawn, mask, mark)
    return band, ring.outline("ring/overlap", line, style.SPHERE), *ring.spokes(view, view.middle, None)


def _growing_chart(view: RunView, arcs: Arcs, size: int) -> Chart:
    return counts_chart(view, arcs.overlap_of(arcs.spread(size)).overlap)


def counts_chart(view: RunView, counts: np.ndarray, yaw_rad: float | None = None) -> Chart:
    """Overlap count over yaw, with the truth and an estimate if there is one."""
    peak = float(counts.max(initial=1))
    curves = [ring.step_curve("arcs that overlap", counts), *ring.markers(view, peak, yaw_rad)]
    return Chart("yaw", "Arcs that overlap at each yaw", "yaw (°)", "arcs", tuple(curves))


def chart(view: RunView, stage: YawStage, found: bool = False, candidate_rad: float | None = None) -> Chart:
    """Overlap count of all arcs over yaw, with the truth and, once found, the estimate, or a candidate yaw."""
    plain = counts_chart(view, stage.overlap, stage.yaw_rad if found else None)
    if candidate_rad is None:
        return plain
    candidate = ring.marker("candidate", candidate_rad, float(stage.overlap.max(initial=1)), style.SAMPLE)
    return Chart(plain.name, plain.title, plain.x_label, plain.y_label, (*plain.curves, candidate))
