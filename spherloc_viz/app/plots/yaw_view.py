"""The yaw view: a run's results for yaw over the whole circle, and the arcs of pairs in a window of it."""

import math
import threading
from collections.abc import Callable
from dataclasses import replace
from html import escape

import numpy as np
import viser
from numpy.typing import NDArray

from spherloc.trace import Trace
from spherloc_viz import style
from spherloc_viz.app.glossary import help_html
from spherloc_viz.app.plots import shapes
from spherloc_viz.app.plots.charts import curve_parts
from spherloc_viz.app.plots.shapes import MINUS, Scale, round_ticks, tick_texts, wrapped_deg
from spherloc_viz.app.text import WITHHELD, box, status_html
from spherloc_viz.app.web.touch import Touch, Touches
from spherloc_viz.app.web.viser_internals import at_once, update_widget
from spherloc_viz.layers.primitives import Chart, Curve
from spherloc_viz.layers.yaw import CANDIDATE
from spherloc_viz.layers.yaw_story import (
    ALL,
    ArcBars,
    PairArcs,
    Window,
    YawStory,
    arcs_of,
    arcs_of_step,
    at_step,
    bars_in,
    peak_window,
    places_of,
    spans_in,
    window_around,
    yaw_story,
)

ZOOM = "yaw-zoom"
WIDTH_PX = 380.0
CIRCLE_STEPS = 180
CIRCLE_TOP_PX, CIRCLE_FOOT_PX = 21.0, 77.0
WINDOW_TOP_PX, WINDOW_FOOT_PX = 116.0, 176.0
RIGHT_PX = 12.0
STACK_PX = 196.0
"""Largest height of the rows of bars."""
MIN_PITCH_PX, MAX_PITCH_PX = 3.0, 9.0
LOOKS = (
    shapes.fill(style.INLIER),
    shapes.fill(style.OUTLIER, 0.5),
    shapes.fill(style.OUTLIER),
)
"""Colours of the kinds of pairs."""
LINK = shapes.stroke(style.SELECTED, 1.5)
EDGE = f' stroke="{style.css(style.SELECTED)}" stroke-width="1.5"'
HOVER = (
    "<style>.yaw-second{display:none;pointer-events:none}.yaw-arc:hover+.yaw-second,.yaw-second.chosen{display:inline}"
    ".yaw-arc:hover{stroke:currentColor;stroke-width:1.2}</style>"
)
"""Style rules: while the pointer is on a pair, its arcs over the whole circle are shown too."""


def yaw_svg(story: YawStory, bars: ArcBars, window: Window, kept: NDArray[np.int64], now: str) -> str:
    """The drawing. ``kept`` (N,) are the numbers of the matches on the page, ``now`` is the key of the current step."""
    top = 1.08 * story.top
    low_px = 9.0 + shapes.text_width_px(tick_texts((story.top,))[0])
    whole = Scale(*ALL, low_px, WIDTH_PX - RIGHT_PX)
    part = Scale(*window, low_px, WIDTH_PX - RIGHT_PX)
    pitch = min(MAX_PITCH_PX, max(MIN_PITCH_PX, STACK_PX / max(1, bars.rows)))
    foot = WINDOW_FOOT_PX + (8.0 + pitch * bars.rows if bars.rows else 0.0)
    y = Scale(0.0, top, CIRCLE_FOOT_PX, CIRCLE_TOP_PX)
    y_part = Scale(0.0, top, WINDOW_FOOT_PX, WINDOW_TOP_PX)
    parts = [HOVER, shapes.text(0.0, 10.0, story.y_label), *_legend(story), *_circle(story, whole, y, window, part)]
    parts += [*_window(story, part, y_part, foot, now), *_bars(bars, whole, part, pitch, window, kept)]
    parts.append(f'<g pointer-events="none">{"".join(_markers(story, part, WINDOW_TOP_PX, foot, window))}</g>')
    return shapes.svg(WIDTH_PX, foot + 33.0, parts, f"{story.title}, over yaw")


def degrees(value: float) -> str:
    """An angle as text, in [-180, 180)."""
    return f"{wrapped_deg(value):.2f}°".replace("-", MINUS)


def zoom(window: Window) -> str:
    """Attributes of an area that can be dragged across to choose a part of the window."""
    return shapes.touch(f"{ZOOM}:{window[0]:.6f},{window[1]:.6f}", drag=True)


def _legend(story: YawStory) -> list[str]:
    """Samples of the lines, from the right."""
    # With a candidate there is no room for the curve's name; the axis has it too.
    curves = story.curves if story.candidate_deg is None else ()
    names = [(curve.label, curve.color, curve.kind == "level") for curve in curves]
    names += [("hypotheses", style.INLIER, False)] if story.hypotheses and not story.curves else []
    names += [("truth", style.TRUTH, False)] if story.truth_deg is not None else []
    names += [(CANDIDATE, style.SAMPLE, False)] if story.candidate_deg is not None else []
    names += [("estimate", style.ESTIMATE, True)] if story.estimate_deg is not None else []
    parts, end = [], WIDTH_PX - RIGHT_PX
    for name, color, dashed in reversed(names):
        start = end - shapes.text_width_px(name)
        dashes = ' stroke-dasharray="3 2"' if dashed else ""
        parts += [shapes.text(start, 10.0, name)]
        parts.append(shapes.line(start - 16, 6.0, start - 4, 6.0, shapes.stroke(color, 2.5, dashes)))
        end = start - 26.0
    return parts


def _circle(story: YawStory, x: Scale, y: Scale, window: Window, part: Scale) -> list[str]:
    """The whole circle, with the window marked and connected with its wide drawing below."""
    ticks = round_ticks(*ALL, 5, degrees=True)
    parts = shapes.x_axis(x, CIRCLE_FOOT_PX, ticks, tick_texts(ticks))
    parts += curve_parts(tuple(map(_coarse, story.curves)), x, y)
    parts += _markers(story, x, CIRCLE_TOP_PX, CIRCLE_FOOT_PX, ALL)
    parts += _hypotheses(story, x, y, ALL, "")
    size = (x.high_px - x.low_px, CIRCLE_FOOT_PX - CIRCLE_TOP_PX + 2)
    if window != ALL:
        _, low, high = spans_in(np.array(window[:1]), np.array(window[1:]), ALL)
        for left, right in zip(x.px(low).tolist(), x.px(high).tolist(), strict=True):
            look = 'fill="currentColor" fill-opacity=".13"'
            parts.append(shapes.rect(left, CIRCLE_TOP_PX - 2, max(2.0, right - left), size[1], look))
        middle = x.at(wrapped_deg(0.5 * (window[0] + window[1])))
        fan = f"M{middle - 1:.1f} 79L{part.low_px:.1f} {WINDOW_TOP_PX - 4}H{part.high_px:.1f}L{middle + 1:.1f} 79Z"
        parts.append(f'<path d="{fan}" fill="currentColor" fill-opacity=".05"/>')
    tip = shapes.tooltip("Drag to zoom, click to move the window here")
    look = 'fill="transparent"' + zoom(ALL)
    return [*parts, shapes.rect(x.low_px, CIRCLE_TOP_PX - 2, *size, look, tip)]


def _window(story: YawStory, x: Scale, y: Scale, foot: float, now: str) -> list[str]:
    """The curves in the window, its axis under the bars, and the area that can be dragged across."""
    low, high = x.low, x.high
    ticks = round_ticks(low, high, 6, degrees=True)
    texts = tick_texts(ticks)
    if high > 180.0:
        # Beyond +-180 degrees the numbers start again.
        texts = [
            words if tick < 180.0 else tick_texts((tick - 360.0,))[0] for tick, words in zip(ticks, texts, strict=True)
        ]
    heights = round_ticks(0.0, y.high, 3)
    parts = shapes.x_axis(x, foot, ticks, texts, "yaw (°)")
    parts += shapes.y_axis(y, x.low_px, x.high_px, heights, tick_texts(heights))
    parts += curve_parts(tuple(_beyond(curve, high) for curve in story.curves), x, y)
    tip = shapes.tooltip("Drag to zoom")
    size = (x.high_px - x.low_px, foot - WINDOW_TOP_PX)
    parts.append(shapes.rect(x.low_px, WINDOW_TOP_PX, *size, 'fill="transparent"' + zoom((low, high)), tip))
    return parts + _hypotheses(story, x, y, (low, high), now)


def _coarse(curve: Curve) -> Curve:
    """The curve with fewer points, for the small drawing of the circle."""
    if curve.kind != "step":
        return curve
    return replace(curve, **dict(zip("xy", shapes.thin_steps(curve.x, curve.y, CIRCLE_STEPS), strict=True)))


def _beyond(curve: Curve, high: float) -> Curve:
    """The curve, continued around the circle if a window crosses the seam."""
    if high <= 180.0:
        return curve
    if curve.kind == "level":
        return Curve(curve.label, np.array([-180.0, 540.0]), curve.y, curve.color, "level")
    x, y = np.concatenate([curve.x, curve.x + 360.0]), np.concatenate([curve.y, curve.y])
    return Curve(curve.label, x, y, curve.color, curve.kind)


def _markers(story: YawStory, x: Scale, top: float, foot: float, window: Window) -> list[str]:
    """The true yaw as a broad line, a candidate as a narrower one and the estimate as a thin dashed one, so that all
    are seen where they coincide."""
    parts = []
    known = (
        (story.truth_deg, style.TRUTH, 3.5, ""),
        (story.candidate_deg, style.SAMPLE, 2.5, ""),
        (story.estimate_deg, style.ESTIMATE, 1.75, ' stroke-dasharray="5 4"'),
    )
    for yaw, color, width, dashes in known:
        if yaw is not None:
            for place in places_of(yaw, window):
                parts.append(shapes.line(x.at(place), top, x.at(place), foot, shapes.stroke(color, width, dashes)))
    return parts


def _hypotheses(story: YawStory, x: Scale, y: Scale, window: Window, now: str) -> list[str]:
    """A line for the yaw of each pose that was tried, as high as its support; that of the current step has its own
    colour, and those that were tried later are faint."""
    parts: list[str] = []
    steps = [key for *_, key in story.hypotheses]
    current = steps.index(now) if now and now in steps else len(steps)
    for number, (yaw, count, name, key) in enumerate(story.hypotheses):
        faint = ' opacity=".25"' if number > current else ""
        for place in places_of(yaw, window):
            left, top = x.at(place), y.at(count)
            color = style.SAMPLE if key and key == now else style.INLIER
            press = shapes.touch(f"step:{key}") if key else ""
            tip = shapes.tooltip(f"{name}: {count} inliers at {degrees(yaw)}")
            stem = f"M{left:.1f} {y.low_px:.1f}V{top:.1f}"
            parts.append(
                f'<g{press}{faint}>{tip}<path d="{stem}" {shapes.stroke(color, 1.5)}/>'
                + shapes.dot(left, top, 3.0, shapes.fill(color))
                + "</g>"
            )
    return parts


def _bars(bars: ArcBars, whole: Scale, part: Scale, pitch: float, window: Window, kept: NDArray[np.int64]) -> list[str]:
    """A bar for each arc in the window; behind it a connection with the other arc of the pair, which is shown when the
    pointer is on the pair or the pair is selected."""
    data, links = _bar_data(bars, whole, part, pitch, window)
    rows = zip(
        kept[bars.pairs].tolist(), bars.kind.tolist(), bars.chosen.tolist(), data, links, _tips(bars), strict=True
    )
    out: list[str] = []
    for (a, b), kind, chosen, path, link, tip in rows:
        tag = f'class="yaw-arc" data-touch="select:{a},{b}" d="{path}" {LOOKS[kind]}{EDGE if chosen else ""}'
        if path:
            out.append(f"<path {tag}><title>{a} and {b}, {bars.kinds[kind]}: {tip}</title></path>")
        if link:
            out.append(f'<path class="yaw-second{" chosen" if chosen else ""}" d="{link}" {LINK}/>')
    return out


def _bar_data(bars: ArcBars, whole: Scale, part: Scale, pitch: float, window: Window) -> tuple[list[str], list[str]]:
    """The data of two paths for every pair: its arcs in the window; and, if it has a second arc or is selected, ticks
    at all of its arcs over the whole circle with the lines that connect them, there and in the window."""
    arc, low, high = spans_in(bars.lo_deg, bars.hi_deg, window)
    left = part.px(low)
    width = np.maximum(1.5, part.px(high) - left)
    top = WINDOW_FOOT_PX + 6.0 + pitch * bars.row[arc]
    data, links = [""] * len(bars.pairs), [""] * len(bars.pairs)
    linked = ((bars.count > 1) | bars.chosen)[bars.owner]
    boxes = _each(f"M%.1f %.1fh%.1fv{0.78 * pitch:.1f}h-%.1fz", left, top, width, width)
    spots = _each("%.1f %.1f", left + 0.5 * width, top + 0.39 * pitch)
    for pair, link, text, spot in zip(bars.owner[arc].tolist(), linked[arc].tolist(), boxes, spots, strict=True):
        data[pair] += text
        if link:
            links[pair] += f"{'L' if links[pair] else 'M'}{spot}"
    middles = whole.px(wrapped_deg(0.5 * (bars.lo_deg + bars.hi_deg)))
    ends = whole.px(np.maximum(bars.lo_deg, -180.0)), whole.px(np.minimum(bars.hi_deg, 180.0))
    ticks = _each(f"M%.1f {CIRCLE_FOOT_PX - 2:g}H%.1f", ends[0], np.maximum(ends[1], ends[0] + 1.5))
    before: dict[int, float] = {}
    for k in np.flatnonzero(linked).tolist():
        pair, middle = int(bars.owner[k]), float(middles[k])
        links[pair] += ticks[k]
        if pair in before:
            links[pair] += _arch(before[pair], middle)
        before[pair] = middle
    return data, links


def _arch(a: float, b: float) -> str:
    foot, top = CIRCLE_FOOT_PX - 4, CIRCLE_TOP_PX - 12
    return f"M{a:.1f} {foot:g}Q{0.5 * (a + b):.1f} {top:g} {b:.1f} {foot:g}"


def _each(template: str, *columns: NDArray[np.floating]) -> list[str]:
    """The template filled in with each row of the columns (K,): one formatting is much faster than K."""
    flat = np.column_stack(columns).ravel().tolist()
    return (f"{template}\n" * len(columns[0]) % tuple(flat)).split("\n")[:-1]


def _tips(bars: ArcBars) -> list[str]:
    """The ends of every pair's arcs as text, those in the window first."""
    order = np.lexsort((bars.row < 0, bars.owner))
    texts = _each("%.2f° to %.2f°", bars.lo_deg[order], wrapped_deg(bars.hi_deg[order]))
    for k in np.flatnonzero((bars.hi_deg - bars.lo_deg)[order] >= 360.0).tolist():
        texts[k] = "every yaw"
    tips = [""] * len(bars.pairs)
    for pair, text in zip(bars.owner[order].tolist(), texts, strict=True):
        tips[pair] += f", second arc {text}" if tips[pair] else text
    return [tip.replace("-", MINUS) for tip in tips]


NO_ARCS = PairArcs(np.zeros((0, 2), np.int64), np.zeros(0), np.zeros(0), "")
UNTOLD = "Answers are hidden: the estimate, and which arcs are of right matches, are told once they are revealed."
PEAK, WHOLE = "Zoom to the peak", "All yaws"
MAX_MADE = 24
"""Largest number of a run's contents that are kept."""
Question = tuple[str, tuple[int, ...], Window | None, bool, Chart | None]
"""What the content depends on, for a run: key of the step, if it has a content of its own; indices of the selected
matches; window that was chosen; whether results are left out; chart of the step."""
MIN_DRAG = 0.012
"""Share of the plot that a press must cross to count as a drag."""


class YawView:
    """The panel of the yaw; ``draw`` shows a run. Drags over the plots and buttons zoom; they only store the new
    window."""

    def __init__(self, gui: viser.GuiApi, touches: Touches, changed: Callable[[object], None]) -> None:
        self._changed = changed
        self._lock = threading.Lock()
        self._wanted: Window | None = None
        self._peak: Window = ALL
        self._known: tuple[Trace, YawStory] | None = None
        self._arcs: tuple[Trace, tuple[int, ...], PairArcs] | None = None
        self._made_of: Trace | None = None
        self._made: dict[Question, tuple[str, Window]] = {}
        """The contents that were made last for that run, for those who walk back and forth, and ahead: with their
        window of the peak."""
        self._drawn: Question | None = None
        self._buttons = gui.add_button_group("Yaw", (PEAK, WHOLE))
        self._html = gui.add_html("")
        self._buttons.on_click(self._click)
        touches.on(ZOOM, self._zoom)

    def draw(
        self,
        trace: Trace,
        step_key: str,
        selected: tuple[int, ...],
        kept: NDArray[np.int64],
        hidden: bool = False,
        step_chart: Chart | None = None,
    ) -> None:
        """Show a run, at a step, with the pairs of the ``selected`` matches (indices in the problem) highlighted.

        ``kept`` (N,) are the numbers of the matches on the page. ``step_chart`` is the chart of the yaw as of a step
        about yaws, whose curve then takes the place of the run's. ``hidden`` leaves out the results, among them that
        curve of the run. Sends nothing if nothing changed.
        """
        asked = self._question(trace, step_key, selected, hidden, step_chart)
        if asked == self._drawn:
            return
        content, peak = self._content(asked, trace, step_key, kept)
        with self._lock:
            self._peak = peak
        update_widget(self._html, content=content)
        self._drawn = asked

    def prepare(
        self,
        trace: Trace,
        step_key: str,
        selected: tuple[int, ...],
        kept: NDArray[np.int64],
        hidden: bool,
        step_chart: Chart | None,
    ) -> None:
        """Make what ``draw`` will show of another step of that run."""
        self._content(self._question(trace, step_key, selected, hidden, step_chart), trace, step_key, kept)

    def _question(
        self, trace: Trace, step_key: str, selected: tuple[int, ...], hidden: bool, step_chart: Chart | None
    ) -> Question:
        """What the content of the panel depends on, for a run."""
        if self._made_of is not trace:
            self._made_of, self._made, self._drawn = trace, {}, None
        of_step = step_key if step_chart is not None else self._hypothesis(trace, step_key)
        with self._lock:
            return of_step, selected, self._wanted, hidden, step_chart

    def _content(self, asked: Question, trace: Trace, step_key: str, kept: NDArray[np.int64]) -> tuple[str, Window]:
        """The content of the panel, made or kept, and the window of the peak."""
        _, _, _, hidden, step_chart = asked
        if hidden and step_chart is None:
            return status_html(WITHHELD), self._peak
        self._made[asked] = made = self._made.pop(asked, None) or self._make(asked, trace, step_key, kept)
        if len(self._made) > MAX_MADE:
            del self._made[next(iter(self._made))]
        return made

    def _make(self, asked: Question, trace: Trace, step_key: str, kept: NDArray[np.int64]) -> tuple[str, Window]:
        """The content of the panel, whose window is the wanted one or else that of the peak; and that of the peak."""
        _, selected, wanted, hidden, step_chart = asked
        story = self._story(trace)
        arcs = NO_ARCS if hidden else arcs_of_step(self._arcs_of(trace, selected), trace, step_key)
        if step_chart is not None:
            story = at_step(story, step_chart, arcs)
        if hidden:
            story = untold(story)
        peak = peak_window(story, arcs)
        window = peak if wanted is None else wanted
        bars = bars_in(trace, arcs, window, selected)
        note = escape(UNTOLD if hidden else caption(trace, story, arcs, bars))
        content = box(
            f'<div style="font-weight:600;padding-bottom:.3em">{escape(story.title)}{help_html("arc")}</div>'
            f"{bars_html(bars)}{yaw_svg(story, bars, window, kept, self._hypothesis(trace, step_key))}"
            f'<div style="font-size:12px;opacity:.7;padding-top:.3em">{note}</div>'
        )
        return content, peak

    def _hypothesis(self, trace: Trace, step_key: str) -> str:
        """The key of the pose that was tried at a step; empty if none was."""
        key = step_key.removesuffix("-pose")
        return key if any(key == known for *_, known in self._story(trace).hypotheses) else ""

    def _story(self, trace: Trace) -> YawStory:
        if self._known is None or self._known[0] is not trace:
            self._known = trace, yaw_story(trace)
        return self._known[1]

    def _arcs_of(self, trace: Trace, selected: tuple[int, ...]) -> PairArcs:
        if self._arcs is None or self._arcs[0] is not trace or self._arcs[1] != selected:
            self._arcs = trace, selected, arcs_of(trace, selected)
        return self._arcs[2]

    @at_once
    def _click(self, event: viser.GuiEvent) -> None:
        self._show(None if event.target.value == PEAK else ALL)

    def _zoom(self, touch: Touch) -> None:
        window = _window_of(touch.argument)
        if window is None:
            return
        low, width = window[0], window[1] - window[0]
        first, last = sorted((touch.from_x, touch.x))
        if last - first > MIN_DRAG:
            self._show(window_around(low + 0.5 * (first + last) * width, (last - first) * width))
        elif window == ALL:
            with self._lock:
                current = self._wanted or self._peak
            if current != ALL:
                self._show(window_around(low + touch.x * width, current[1] - current[0]))

    def _show(self, window: Window | None) -> None:
        with self._lock:
            self._wanted = window
        self._changed(None)


def untold(story: YawStory) -> YawStory:
    """The story of a step that tells no result, without what the run found: poses, their support, and the estimate."""
    return replace(story, hypotheses=(), estimate_deg=None, peak_deg=None, note="")


def _window_of(argument: str) -> Window | None:
    """The window in the argument of a press; None if the argument is not a valid one."""
    try:
        low, high = map(float, argument.split(","))
    except ValueError:
        return None
    sensible = math.isfinite(low) and -180.0 <= low < 180.0 and low < high <= low + 360.0
    return (low, high) if sensible else None


def bars_html(bars: ArcBars) -> str:
    """What the colours of the bars that are drawn mean; empty without bars."""
    kinds = np.unique(bars.kind[bars.owner[bars.row >= 0]]).tolist()
    samples = "".join(
        f'<span style="white-space:nowrap"><svg width="16" height="8"><path d="M0 0h16v8H0z" {LOOKS[kind]}/></svg>'
        f" {bars.kinds[kind]}</span>"
        for kind in kinds
    )
    look = "font-size:12px;display:flex;flex-wrap:wrap;column-gap:.5em;padding-bottom:.2em"
    return f'<div style="{look}">arcs of pairs: {samples}</div>' if kinds else ""


def caption(trace: Trace, story: YawStory, arcs: PairArcs, bars: ArcBars) -> str:
    """The caption: which arcs are shown, and by which rule."""
    total = sum(bars.total)
    if total == 0:
        return " ".join(filter(None, (story.note, arcs.rule, "No pair has an arc in this window.")))
    in_window = bars.row >= 0
    shown = int(np.count_nonzero(in_window))
    if shown < total:
        kinds = np.bincount(bars.kind[bars.owner[in_window]], minlength=len(bars.kinds)).tolist()
        rows = zip(kinds, bars.total, bars.kinds, strict=True)
        counts = ", ".join(f"{n:,} of {of:,} {name}" if of else f"none {name}" for n, of, name in rows)
        rule = f"{shown:,} of {total:,} arcs in this window shown, evenly chosen: {counts}."
    else:
        counts = ", ".join(f"{of:,} {name}" for of, name in zip(bars.total, bars.kinds, strict=True))
        rule = f"All {total:,} arcs" if total > 1 else "The only arc"
        rule = f"{rule} in this window shown: {counts}."
    by_run = trace.problem.truth_inliers is None
    colors = "Inliers and outliers are this run's." if by_run else "Right or wrong by the truth."
    joined = "Violet lines join the two arcs of one pair." if (bars.chosen & (bars.count > 1)).any() else ""
    return " ".join(filter(None, (story.note, arcs.rule, rule, colors, joined)))
