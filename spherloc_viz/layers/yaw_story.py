"""The results of a run for yaw: curves over the whole circle, and arcs in windows of the circle."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from spherloc.bounds import bounds_of
from spherloc.consensus.yaw_arcs import yaw_arcs
from spherloc.geometry import wrap_angle, yaw_of
from spherloc.trace import ConsensusStage, RansacStage, Trace, YawStage
from spherloc.types import FloatArray, IntArray
from spherloc_viz import style
from spherloc_viz.layers import ring
from spherloc_viz.layers.frame import RunView
from spherloc_viz.layers.primitives import Chart, Curve
from spherloc_viz.layers.stage_arcs import StageArcs
from spherloc_viz.layers.yaw import CANDIDATE, chosen_arcs

Window = tuple[float, float]
"""Yaws from the first, in [-180, 180) degrees, to the second, which exceeds 180 where the window crosses the seam."""

ALL: Window = (-180.0, 180.0)
MIN_WIDTH_DEG = 0.02


@dataclass(frozen=True, eq=False)
class YawStory:
    """The results of a run for yaw, as curves over -180 to 180 degrees."""

    title: str
    y_label: str
    curves: tuple[Curve, ...]
    """Steps and levels over the whole circle; no markers."""
    hypotheses: tuple[tuple[float, int, str, str], ...]
    """Yaw (degrees), correspondences explained, name and key of the step (or "") of every pose that was tried."""
    top: float
    """Largest value of the y axis."""
    estimate_deg: float | None
    truth_deg: float | None
    note: str
    """What is left out, as a sentence; may be empty."""
    candidate_deg: float | None = None
    """The candidate yaw of a step."""
    peak_deg: float | None = None
    """The yaw to look at: the estimate or, at a step, its candidate or the yaw that most of its arcs share."""


def yaw_story(trace: Trace) -> YawStory:
    """The curves of a run."""
    truth, estimate = _truth_deg(trace), None
    if trace.cam_from_map is not None:
        estimate = _yaw_deg(trace, trace.cam_from_map)
    yaw, exact, ransac = trace.stage(YawStage), trace.stage(ConsensusStage), trace.stage(RansacStage)
    curves: tuple[Curve, ...] = ()
    tried: tuple[tuple[float, int, str, str], ...] = ()
    note = ""
    title, y_label = "No stage of this run looked at the yaw", "matches"
    if yaw is not None:
        title, y_label = "Arcs that overlap at each yaw", "number of arcs"
        curves = (ring.step_curve("that overlap", yaw.overlap),)
        estimate = float(np.degrees(yaw.yaw_rad)) if estimate is None else estimate
    elif exact is not None:
        title, best = (
            "What a pose can explain at each yaw",
            int(exact.support.max(initial=exact.seed_support)),
        )
        ends = np.array(ALL)
        level = Curve("best pose", ends, np.full(2, float(best)), style.INLIER, "level")
        curves = (ring.step_curve("bound", exact.bound), level)
        poses = list(zip(exact.cam_from_map, exact.support.tolist(), strict=True))[: 1 + style.MAX_DRAWN_ALTERNATIVES]
        tried = tuple((_yaw_deg(trace, pose), support, "verified pose", "") for pose, support in poses)
        if len(poses) < len(exact.support):
            note = f"Of {len(exact.support):,} verified poses, the best {len(poses)} are shown as stems."
    elif ransac is not None:
        title = "Yaw of each best hypothesis"
        counts = np.count_nonzero(ransac.inlier_masks, axis=1).tolist()
        rows = zip(ransac.cam_from_map, counts, ransac.improved_at.tolist(), strict=True)
        tried = tuple(
            (_yaw_deg(trace, pose), count, f"sample {at + 1:,}", f"sample-{k}")
            for k, (pose, count, at) in enumerate(rows, 1)
        )
    values = [float(curve.y.max(initial=0.0)) for curve in curves] + [float(count) for _, count, *_ in tried]
    return YawStory(title, y_label, curves, tried, max([1.0, *values]), estimate, truth, note, peak_deg=estimate)


def _yaw_deg(trace: Trace, cam_from_map: FloatArray) -> float:
    return float(np.degrees(yaw_of(trace.problem.aligned.align_pose(cam_from_map)[:, :3])))


def _truth_deg(trace: Trace) -> float | None:
    truth = RunView(trace).truth
    return None if truth is None else float(np.degrees(yaw_of(truth[:, :3])))


def window_around(middle_deg: float, width_deg: float) -> Window:
    """The window of that middle and width, at most the circle."""
    if not width_deg < 359.0:
        return ALL
    width = max(width_deg, MIN_WIDTH_DEG)
    low = round((middle_deg - 0.5 * width + 180.0) % 360.0 - 180.0, 9)
    return low, low + width


def places_of(yaw_deg: float, window: Window) -> list[float]:
    """Positions of a yaw in a window, degrees: none, one, or two if it is at both ends of the circle."""
    low, high = window
    return [yaw for yaw in (yaw_deg - 360.0, yaw_deg, yaw_deg + 360.0) if low <= yaw <= high]


WIDTHS_DEG = (1.0, 2.0, 4.0, 6.0, 10.0, 20.0, 30.0, 60.0, 120.0)
"""Widths of the window around the peak."""
MAX_BARS = 60
MAX_CHOSEN = 24
"""Largest number of bars for selected pairs."""
MAX_MATCHES, MAX_INLIERS = 32, 20
"""For a run that stores no arcs: number of matches whose pairs are computed, and of inliers among them."""
KINDS = ("both right", "one wrong", "both wrong")
KINDS_BY_RUN = ("both inliers", "one outlier", "both outliers")
"""Kinds of pairs, and what they are called where the truth is not known."""
ROUNDING_RAD = 1e-9
"""More than what is lost between radians and degrees."""
CELLS = 240
"""Number of cells across the window by which bars are packed into rows."""


@dataclass(frozen=True, eq=False)
class PairArcs:
    """A arcs of feasible yaw of pairs of matches, one or more per pair."""

    pairs: NDArray[np.integer]
    """(A, 2) indices of the two correspondences of each arc, ascending."""
    lo_rad: FloatArray
    """(A,) lower ends, in [-pi, pi)."""
    hi_rad: FloatArray
    """(A,) upper ends, not below ``lo_rad``."""
    rule: str
    """A sentence on the choice of the arcs; empty if they are the run's own."""
    deepest_deg: float | None = None
    """The yaw that most of them share, if the run has found it."""


@dataclass(frozen=True, eq=False)
class ArcBars:
    """P pairs, with an arc in a window or selected, and all of their arcs."""

    pairs: IntArray
    """(P, 2) indices of the two correspondences of each pair."""
    kind: IntArray
    """(P,) index into ``KINDS``."""
    chosen: NDArray[np.bool_]
    """(P,) whether the pair is selected."""
    count: IntArray
    """(P,) number of arcs of each pair, also outside the window."""
    owner: IntArray
    """(B,) index in ``pairs`` of each arc."""
    lo_deg: FloatArray
    """(B,) lower ends, in [-180, 180)."""
    hi_deg: FloatArray
    """(B,) upper ends, not below ``lo_deg``."""
    row: IntArray
    """(B,) row of each arc in the window, from the top; -1 outside of it."""
    total: tuple[int, int, int]
    """Number of arcs in the window of each kind, drawn or not."""
    kinds: tuple[str, str, str] = KINDS
    """What the kinds are called."""

    @property
    def rows(self) -> int:
        """Number of rows."""
        return int(self.row.max(initial=-1)) + 1


def right_ones(trace: Trace) -> NDArray[np.bool_]:
    """Which matches (N,) are right, by the truth where it is known, else by the run's inliers."""
    return trace.inlier_mask if trace.problem.truth_inliers is None else trace.problem.truth_inliers


def arcs_of(trace: Trace, selected: tuple[int, ...]) -> PairArcs:
    """The run's own arcs; if it stores none, those of some of its inliers, of the selection and of other matches."""
    stage = trace.stage(YawStage)
    if stage is not None:
        return PairArcs(stage.pairs, stage.lo_rad, stage.hi_rad, "", float(np.degrees(stage.yaw_rad)))
    aligned = trace.problem.aligned
    members = _members(trace, selected)
    places = np.searchsorted(aligned.index, members)
    bounds = bounds_of(aligned, trace.options.bound_px)
    some = replace(
        aligned,
        index=members,
        bearings=aligned.bearings[places],
        points=aligned.points[places],
        pixel_from_bearing=aligned.pixel_from_bearing[places],
        radians_per_pixel=aligned.radians_per_pixel[places],
    )
    pairs, lo, hi = yaw_arcs(some, bounds.radians[places])
    whole = f"all {len(members)}" if len(members) == len(trace.problem) else f"{len(members)} of {len(trace.problem):,}"
    return PairArcs(
        members[pairs], lo, hi, f"{trace.estimator} keeps no arcs; these are of the pairs of {whole} matches."
    )


def arcs_of_step(arcs: PairArcs, trace: Trace, step_key: str) -> PairArcs:
    """Of a run's arcs those that a step shows: all of them if it does not choose."""
    stage = trace.stage(YawStage)
    all_arcs = None if stage is None else StageArcs(stage, trace.inlier_mask)
    chosen = None if all_arcs is None else chosen_arcs(all_arcs, step_key)
    if all_arcs is None or chosen is None:
        return arcs
    some = arcs.pairs[chosen], arcs.lo_rad[chosen], arcs.hi_rad[chosen]
    return PairArcs(*some, "Only arcs of this step are counted.", all_arcs.middle_deg(chosen))


def at_step(story: YawStory, chart: Chart, arcs: PairArcs) -> YawStory:
    """The story with the curves and the yaws of a step's chart of the yaw, which knows no estimate before its step;
    ``arcs`` are the step's."""
    curves = tuple(curve for curve in chart.curves if curve.kind == "step")
    marked = {curve.label: float(curve.x[0]) for curve in chart.curves if curve.kind == "marker"}
    candidate, estimate = marked.get(CANDIDATE), marked.get(ring.ESTIMATE)
    peak = next((yaw for yaw in (estimate, candidate, arcs.deepest_deg) if yaw is not None), None)
    top = max([1.0, *(float(curve.y.max(initial=0.0)) for curve in curves)])
    return replace(story, curves=curves, top=top, candidate_deg=candidate, estimate_deg=estimate, peak_deg=peak)


def _members(trace: Trace, selected: tuple[int, ...]) -> IntArray:
    """Usable matches whose pairs are computed, ascending: even samples of inliers, selection and others."""
    usable = trace.problem.aligned.index
    if len(usable) <= MAX_MATCHES:
        return usable
    wanted = np.zeros(len(trace.problem), dtype=bool)
    wanted[[number for number in selected if trace.problem.usable[number]][: MAX_MATCHES // 3]] = True
    wanted[sample(np.flatnonzero(trace.inlier_mask), MAX_INLIERS)] = True
    others = usable[~wanted[usable]]
    wanted[sample(others, MAX_MATCHES - int(np.count_nonzero(wanted)))] = True
    return np.flatnonzero(wanted)


def sample(indices: IntArray, count: int) -> IntArray:
    """At most ``count`` of the indices, evenly spaced."""
    count = min(count, len(indices))
    return indices[np.arange(count) * len(indices) // max(1, count)]


def peak_window(story: YawStory, arcs: PairArcs) -> Window:
    """A window around the yaw to look at, wide enough for most of the arcs over it; the circle without one."""
    if story.peak_deg is None:
        return ALL
    middle = np.radians(story.peak_deg)
    over = _overlapping(arcs, middle, middle)
    away = wrap_angle(arcs.lo_rad[over] - middle), wrap_angle(arcs.hi_rad[over] - middle)
    reach = np.maximum(np.abs(away[0]), np.abs(away[1]))
    need = 3.0 * np.degrees(float(np.median(reach))) if len(reach) else 10.0
    width = next((width for width in WIDTHS_DEG if width >= need), WIDTHS_DEG[-1])
    # Rounded, so that the window does not move while a slider changes the yaw by little.
    step = 0.1 * width
    return window_around(step * round(story.peak_deg / step), width)


def _overlapping(arcs: PairArcs, low_rad: float, high_rad: float) -> NDArray[np.bool_]:
    """Mask of the arcs that reach into a window from -pi <= low < pi to high <= low + 2 pi."""
    lo, hi, circle = arcs.lo_rad, arcs.hi_rad, 2.0 * np.pi
    return ((lo <= high_rad) & (hi >= low_rad)) | (hi >= low_rad + circle) | (lo <= high_rad - circle)


def _in_window(arcs: PairArcs, window: Window) -> IntArray:
    """Indices of the arcs of which ``spans_in`` finds a part; only where one just touches the window is it asked."""
    low, high = np.radians(window).tolist()
    inside = _overlapping(arcs, low + ROUNDING_RAD, high - ROUNDING_RAD)
    touching = np.flatnonzero(_overlapping(arcs, low - ROUNDING_RAD, high + ROUNDING_RAD) & ~inside)
    found, _, _ = spans_in(np.degrees(arcs.lo_rad[touching]), np.degrees(arcs.hi_rad[touching]), window)
    inside[touching[found]] = True
    return np.flatnonzero(inside)


def bars_in(trace: Trace, arcs: PairArcs, window: Window, selected: tuple[int, ...], most: int = MAX_BARS) -> ArcBars:
    """Selected pairs, wherever their arcs are, and pairs with an arc in a window: an even sample with an equal share of
    each kind.
    """
    right = right_ones(trace)
    inside = _in_window(arcs, window)
    pairs = arcs.pairs[inside]
    kind = 2 - right[pairs[:, 0]].astype(np.int64) - right[pairs[:, 1]]
    of_kind = [inside[kind == k] for k in range(len(KINDS))]
    drawn = np.zeros(len(arcs.pairs), dtype=bool)
    if selected:
        drawn[sample(np.flatnonzero(_chosen(arcs.pairs, selected)), MAX_CHOSEN)] = True
    room = most - int(np.count_nonzero(drawn[inside]))
    for place, group in enumerate(sorted(of_kind, key=len)):
        some = sample(group[~drawn[group]], room // (len(KINDS) - place))
        drawn[some] = True
        room -= len(some)
    codes = arcs.pairs[:, 0].astype(np.int64) * len(right) + arcs.pairs[:, 1]
    shown = codes[drawn]
    shown = shown[np.diff(shown, prepend=-1) > 0]
    first, last = np.searchsorted(codes, shown, "left"), np.searchsorted(codes, shown, "right")
    owner = np.repeat(np.arange(len(shown)), last - first)
    mine = np.arange(len(owner)) - np.repeat(np.cumsum(last - first) - (last - first), last - first) + first[owner]
    those = arcs.pairs[first].astype(np.int64)
    lo_deg, hi_deg = np.degrees(arcs.lo_rad[mine]), np.degrees(arcs.hi_rad[mine])
    kinds = 2 - right[those[:, 0]].astype(np.int64) - right[those[:, 1]]
    return ArcBars(
        pairs=those,
        kind=kinds,
        chosen=_chosen(those, selected),
        count=last - first,
        owner=owner,
        lo_deg=lo_deg,
        hi_deg=hi_deg,
        row=_rows(lo_deg, hi_deg, kinds[owner], window),
        total=(len(of_kind[0]), len(of_kind[1]), len(of_kind[2])),
        kinds=KINDS if trace.problem.truth_inliers is not None else KINDS_BY_RUN,
    )


def _chosen(pairs: NDArray[np.integer], selected: tuple[int, ...]) -> NDArray[np.bool_]:
    """Mask (P,) of the pairs (P, 2) that are selected: those among the selected matches, or all with a single one."""
    if not selected:
        return np.zeros(len(pairs), dtype=bool)
    held = np.isin(pairs, selected)
    return np.all(held, axis=1) if len(selected) > 1 else np.any(held, axis=1)


def spans_in(lo_deg: FloatArray, hi_deg: FloatArray, window: Window) -> tuple[IntArray, FloatArray, FloatArray]:
    """The parts of arcs (B,) in a window: indices (S,) of the arcs, ascending, and ends (S,), (S,) in the window.

    An arc has two parts there if it leaves the window and comes back; one of a whole turn or more does not leave it.
    """
    low, high = window
    turns = np.array([-360.0, 0.0, 360.0])
    lo, hi = lo_deg[:, None] + turns, hi_deg[:, None] + turns
    inside = (lo <= high) & (hi >= low)
    whole = hi_deg - lo_deg >= 360.0
    lo[whole], hi[whole], inside[whole] = low, high, turns == 0.0
    arc, turn = np.nonzero(inside)
    return arc, np.maximum(lo[arc, turn], low), np.minimum(hi[arc, turn], high)


def _rows(lo_deg: FloatArray, hi_deg: FloatArray, kind: IntArray, window: Window) -> IntArray:
    """A row (B,) for every arc in the window such that those in a row do not touch: the kinds one under the other,
    narrow arcs above wide ones, each in the first row of its kind that has room.
    """
    low, high = window
    cell = (high - low) / CELLS
    row = np.full(len(lo_deg), -1, dtype=np.int64)
    arc, left, right = spans_in(lo_deg, hi_deg, window)
    masks = dict.fromkeys(arc.tolist(), 0)
    cells = ((left - low) / cell).astype(np.int64).tolist(), ((right - low) / cell).astype(np.int64).tolist()
    for bar, first, last in zip(arc.tolist(), *cells, strict=True):
        # One bit per cell, and one more so that neighbours do not touch.
        masks[bar] |= ((1 << (last - first + 2)) - 1) << first
    there = np.array(list(masks), dtype=np.int64)
    taken: list[int] = []
    start, current = 0, -1
    for place in np.lexsort(((hi_deg - lo_deg)[there], kind[there])).tolist():
        bar = int(there[place])
        if kind[bar] != current:
            start, current = len(taken), int(kind[bar])
        row[bar] = _first_free(taken, start, masks[bar])
    return row


def _first_free(taken: list[int], start: int, mask: int) -> int:
    """The first row from ``start`` on in which all bits of the mask are free, else a new row; the bits are then
    taken."""
    for place in range(start, len(taken)):
        if not taken[place] & mask:
            taken[place] |= mask
            return place
    taken.append(mask)
    return len(taken) - 1
