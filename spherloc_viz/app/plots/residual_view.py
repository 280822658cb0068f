"""The residual view: residuals of the matches at the pose, how well inliers were separated from outliers, and the
history of RANSAC."""

from collections.abc import Callable
from html import escape

import numpy as np
import viser
from numpy.typing import NDArray

from spherloc.trace import Trace
from spherloc.types import FloatArray
from spherloc_viz import style
from spherloc_viz.app.glossary import help_html
from spherloc_viz.app.plots import shapes
from spherloc_viz.app.plots.charts import chart_html, curve_parts
from spherloc_viz.app.plots.shapes import Scale, decade_ticks, round_ticks, tick_texts
from spherloc_viz.app.text import DIM, WITHHELD, box, dot_html, status_html, table_html
from spherloc_viz.app.web.touch import Touch, Touches
from spherloc_viz.app.web.viser_internals import update_widget
from spherloc_viz.layers.primitives import Chart, Curve
from spherloc_viz.layers.residuals import (
    BestHistory,
    Histogram,
    Residuals,
    bin_words,
    history_of,
    residuals_of,
    scores_table,
)

SELECT_BIN = "select-bin"
WIDTH_PX, RIGHT_PX = 380.0, 12.0
HEIGHT_PX, FOOT_PX, TOP_PX = 150.0, 117.0, 20.0
GAP_PX = 5.0
"""Gap between the regular bins and the first and last one, which hold all smaller and larger values."""
HATCH = (
    '<defs><pattern id="hatch" width="5" height="5" patternUnits="userSpaceOnUse" patternTransform="rotate(45)">'
    '<rect width="2" height="5" fill="#101418" fill-opacity=".75"/></pattern></defs>'
)
"""What marks matches that the run judged wrongly."""
UNITS = {"px": "residual (px)", "deg": "residual (°)"}


def histogram_svg(histogram: Histogram, selected: NDArray[np.bool_]) -> str:
    """A histogram, the run's inliers below its outliers, and hatched those of both that it judged wrongly; outlines
    show how many of the ``selected`` (N,) matches are in a bin. Every bin that is not empty can be pressed."""
    total = histogram.inliers + histogram.outliers
    top = 1.08 * max(1, int(total.max()))
    y = Scale(0.0, top, FOOT_PX, TOP_PX)
    y_ticks = [tick for tick in round_ticks(0.0, top, 5) if tick == int(tick)]
    texts = tick_texts(tuple(y_ticks))
    left_px = 9.0 + max(map(shapes.text_width_px, texts))
    bins, step = len(total), (WIDTH_PX - RIGHT_PX - left_px - 2 * GAP_PX) / len(total)
    x = Scale(
        float(histogram.edges[0]),
        float(histogram.edges[-1]),
        left_px + step + GAP_PX,
        WIDTH_PX - RIGHT_PX - step - GAP_PX,
        log=True,
    )
    ticks = decade_ticks(x.low, x.high, 8)
    parts = shapes.y_axis(y, left_px, WIDTH_PX - RIGHT_PX, y_ticks, texts)
    texts_x = tick_texts(ticks, log=True)
    parts += shapes.x_axis(x, FOOT_PX, ticks, texts_x, UNITS[histogram.unit])
    parts += [shapes.text(left_px, FOOT_PX + 29, f"< {texts_x[0]}"), shapes.text(0.0, 11.0, "matches")]
    parts += [shapes.text(WIDTH_PX - RIGHT_PX, FOOT_PX + 29, f"≥ {texts_x[-1]}", "end"), *_bound(histogram, x)]
    across = [left_px + step * k + GAP_PX * ((k > 0) + (k == bins - 1)) + 0.5 for k in range(bins)]
    chosen = np.bincount(histogram.bin[selected], minlength=bins)
    parts += _bars(histogram, chosen, across, step - 1.0, y)
    return shapes.svg(WIDTH_PX, HEIGHT_PX, parts, f"Histogram of residuals, {UNITS[histogram.unit]}")


def _bars(histogram: Histogram, chosen: NDArray[np.int64], across: list[float], width: float, y: Scale) -> list[str]:
    """One path per colour, and over each bin that is not empty an area to press, as high as the plot."""
    inliers, outliers = histogram.inliers, histogram.outliers
    feet, middle, top = np.full(len(across), FOOT_PX), y.px(inliers), y.px(inliers + outliers)
    hatched = y.px(inliers - histogram.wrongly_kept), y.px(inliers + histogram.wrongly_rejected)
    parts = [
        HATCH,
        _boxes(across, width, feet, middle, "inliers", shapes.fill(style.INLIER)),
        _boxes(across, width, middle, top, "outliers", shapes.fill(style.OUTLIER)),
        _boxes(across, width, *hatched, "wrongly", 'fill="url(#hatch)"'),
        _boxes(across, width, feet, y.px(chosen), "chosen", shapes.stroke(style.SELECTED, 2.0)),
    ]
    press = f'class="bin" fill="transparent" data-touch="{SELECT_BIN}:{histogram.unit}:'
    wrongly = histogram.wrongly_kept, histogram.wrongly_rejected
    rows = zip(
        across, bin_words(histogram.unit), *(counts.tolist() for counts in (inliers, outliers, *wrongly)), strict=True
    )
    for place, (left, range_words, kept, rejected, wrongly_kept, wrongly_rejected) in enumerate(rows):
        if kept + rejected:
            words = (
                _count(kept, "inliers", wrongly_kept, "kept"),
                _count(rejected, "outliers", wrongly_rejected, "rejected"),
            )
            tip = shapes.tooltip(f"{range_words}: {words[0]}, {words[1]}; click to select")
            parts.append(shapes.rect(left, TOP_PX, width, FOOT_PX - TOP_PX, f'{press}{place}"', tip))
    return parts


def _count(count: int, what: str, wrongly: int, done: str) -> str:
    return f"{count} {what}" + (f" ({wrongly} wrongly {done})" if wrongly else "")


def _boxes(across: list[float], width: float, feet: FloatArray, tops: FloatArray, name: str, look: str) -> str:
    """A path of upright boxes, without those of height 0."""
    rows = zip(across, feet.tolist(), tops.tolist(), strict=True)
    data = "".join(f"M{x:.1f} {foot:.1f}V{top:.1f}h{width:.1f}V{foot:.1f}z" for x, foot, top in rows if foot > top)
    return f'<path class="{name}" d="{data}" {look}/>' if data else ""


def _bound(histogram: Histogram, x: Scale) -> list[str]:
    """The median bound as a line, and the range of all bounds as a band if they differ."""
    low, middle, high = (x.at(value) for value in histogram.bound)
    parts = []
    least, median, most = (f"{value:.2g}" for value in histogram.bound)
    unit = "°" if histogram.unit == "deg" else " px"
    wide = histogram.widened * " with gravity's error"
    words = f"bound {median}{unit}{wide}"
    if high - low > 1.0:
        parts.append(shapes.rect(low, TOP_PX, high - low, FOOT_PX - TOP_PX, shapes.fill(style.ESTIMATE, 0.15)))
        span = f"{least} to {most}{unit}"
        words = f"bound {span}{wide}" if wide else f"median {words} ({span})"
    look = shapes.stroke(style.ESTIMATE, 1.5, ' stroke-dasharray="4 3"')
    parts.append(shapes.line(middle, TOP_PX - 4, middle, FOOT_PX, look))
    half = 0.5 * shapes.text_width_px(words)
    return [*parts, shapes.text(min(max(middle, 70.0 + half), WIDTH_PX - half), 11.0, words, "middle")]


def history_svg(history: BestHistory) -> str:
    """Inliers of the best hypothesis over the samples drawn (left axis), and Eq. 28's prediction (right axis)."""
    top, last = 1.08 * float(history.inliers[-1]), float(max(10, history.iterations))
    y, chance = Scale(0.0, top, FOOT_PX, TOP_PX), Scale(0.0, 1.08, FOOT_PX, TOP_PX)
    y_ticks = tuple(tick for tick in round_ticks(0.0, top, 5) if tick == int(tick))
    texts = tick_texts(y_ticks)
    left_px, right_px = 9.0 + max(map(shapes.text_width_px, texts)), WIDTH_PX - 38.0
    x = Scale(1.0, last, left_px, right_px, log=True)
    ticks = decade_ticks(1.0, last, 8)
    parts = shapes.y_axis(y, left_px, right_px, y_ticks, texts)
    parts += shapes.x_axis(x, FOOT_PX, ticks, tick_texts(ticks, log=True), "samples drawn")
    parts += [shapes.text(right_px + 5, chance.at(0.5 * k) + 4, f"{50 * k} %") for k in range(3)]
    drawn = np.append(history.drawn, history.iterations)
    held = Curve("best", drawn, np.append(history.inliers, history.inliers[-1]), style.INLIER, "step")
    parts += curve_parts((held,), x, y)
    if history.share > 0.0:
        k = np.geomspace(1.0, last, 80)
        data = shapes.corners(x.px(k), chance.px(history.probability(k)))
        parts.append(f'<path class="chance" d="{data}" {shapes.stroke(style.ESTIMATE, 1.75)}/>')
    if history.clean_at is not None:
        place = x.at(history.clean_at)
        parts.append(
            shapes.line(place, TOP_PX, place, FOOT_PX, shapes.stroke(style.TRUTH, 2.0, ' stroke-dasharray="5 4"'))
        )
    return shapes.svg(WIDTH_PX, HEIGHT_PX, [*parts, *_history_legend(history, right_px)], "Inliers over samples drawn")


def _history_legend(history: BestHistory, right_px: float) -> list[str]:
    parts = [shapes.text(0.0, 11.0, "inliers"), shapes.text(WIDTH_PX, 11.0, "chance", "end")]
    names = [("Eq. 28", style.ESTIMATE), ("best so far", style.INLIER)]
    names += [("clean sample", style.TRUTH)] if history.clean_at is not None else []
    end = right_px - 12.0
    for name, color in names:
        start = end - shapes.text_width_px(name)
        parts += [shapes.text(end, 11.0, name, "end")]
        parts.append(shapes.line(start - 16, 7.0, start - 4, 7.0, shapes.stroke(color, 2.5)))
        end = start - 26.0
    return parts


Select = Callable[[tuple[int, ...]], None]


class ResidualView:
    """The panel of the residuals. Pressing a bin of a histogram selects its matches."""

    def __init__(self, gui: viser.GuiApi, touches: Touches, changed: Callable[[object], None], select: Select) -> None:
        """``select`` is called with the matches of a bin that was pressed, as indices in the problem."""
        self._changed, self._select = changed, select
        self._known: tuple[Trace, Residuals | None, str, str] | None = None
        self._drawn: tuple[tuple[int, ...], Chart | None] | None = None
        self._bins: dict[str, Histogram] = {}
        self._html = gui.add_html("")
        touches.on(SELECT_BIN, self._press)

    def draw(
        self,
        trace: Trace,
        selected: tuple[int, ...],
        kept: NDArray[np.int64],
        cost: Chart | None = None,
        hidden: bool = False,
    ) -> None:
        """Show a run with the ``selected`` matches (indices in the problem) marked; ``kept``, the numbers (N,) of the
        matches on the page, is not used here. ``cost`` is the chart of the residuals so far, which stands above. All of
        it are answers, which ``hidden`` leaves out. Sends nothing if nothing changed.
        """
        if hidden:
            self._known, self._drawn, self._bins = None, None, {}
            update_widget(self._html, content=status_html(WITHHELD))
            return
        if self._known is None or self._known[0] is not trace:
            residuals, history = residuals_of(trace), history_of(trace)
            self._known = trace, residuals, table_html(scores_table(trace)), _history_html(history)
        elif self._drawn is not None and self._drawn[0] == selected and self._drawn[1] is cost:
            return
        _, residuals, scores, history_html = self._known
        bins: dict[str, Histogram] = {} if residuals is None else {one.unit: one for one in residuals.histograms}
        fall = "" if cost is None or len(cost.curves[0].x) < 2 else chart_html(cost)  # a dot alone says nothing
        content = fall + _residuals_html(residuals, selected) + scores + history_html
        # A press on a histogram that has changed meanwhile selects the matches that are in that bin now.
        self._bins = bins
        update_widget(self._html, content=content)
        self._drawn = selected, cost

    def _press(self, touch: Touch) -> None:
        unit, _, place = touch.argument.partition(":")
        found = self._bins.get(unit)
        if found is None or not (place.isascii() and place.isdigit()):
            return
        self._select(tuple(np.flatnonzero(found.bin == int(place)).tolist()))
        self._changed(None)


def _residuals_html(residuals: Residuals | None, selected: tuple[int, ...]) -> str:
    if residuals is None:
        return box(_title("Residuals") + "This run found no pose, so that matches have no residuals.")
    marked = np.zeros(len(residuals.px), dtype=bool)
    marked[list(selected)] = True
    drawings = "".join(histogram_svg(one, marked) for one in residuals.histograms)
    note = _note(residuals_caption(residuals))
    return box(_title("Residuals at the estimated pose", "residual") + _legend_html(residuals) + drawings + note)


def _legend_html(residuals: Residuals) -> str:
    """The meaning of the colours, which are those of the canvas, and of the hatching."""
    dots = "".join(
        f'<span style="margin-right:1.1em">{dot_html(color)}{words}</span>'
        for color, words in ((style.INLIER, "inliers"), (style.OUTLIER, "outliers"))
    )
    box_px = 'width="14" height="11"'
    swatch = (
        f'<svg {box_px} style="vertical-align:-1px;margin:0 .4em 0 1.1em">{HATCH}'
        f'<rect {box_px} {shapes.fill(style.UNDECIDED, 0.5)}/><rect {box_px} fill="url(#hatch)"/></svg>'
    )
    hatched = f"{swatch}wrongly, by the truth" if residuals.truth_known else ""
    return (
        f'<div style="font-size:12px;padding-bottom:.3em">{dots}<span style="{DIM}">of this run</span>{hatched}</div>'
    )


def residuals_caption(residuals: Residuals) -> str:
    """The meaning of the axes, and what the last bins hold."""
    words = ["Bins grow by equal factors; the first and the last hold all that is smaller or larger."]
    behind = int(np.count_nonzero(np.isinf(residuals.px))) - residuals.blind
    if behind:
        words.append(f"In px, the last one holds {behind:,} matches more than 90° off.")
    if residuals.blind:
        words.append(f"The last ones also hold {residuals.blind:,} whose pixel the camera model cannot see.")
    return " ".join(words)


def _history_html(history: BestHistory | None) -> str:
    if history is None:
        return ""
    return box(_title("How RANSAC got there", "RANSAC") + history_svg(history) + _note(history_caption(history)))


def history_caption(history: BestHistory) -> str:
    """Eq. 28 with this run's numbers, and the first improvement by a clean sample."""
    share = f"w = {100.0 * history.share:.3g} % inliers, n = {history.size}"
    words = f"P = 1 − (1 − wⁿ)ᵏ (Eq. 28) with {share}: "
    if np.isfinite(history.half_at):
        words += f"half of all runs draw a sample of inliers only within {max(1.0, history.half_at):,.0f}."
    else:
        words += "no sample could be of inliers only."
    if history.clean_at is not None:
        words += f" Here the first improvement by right matches only was sample {history.clean_at:,}."
    return words


def _title(words: str, term: str | None = None) -> str:
    """A heading, with a "?" that explains a term."""
    help_ = "" if term is None else help_html(term)
    return f'<div style="font-weight:600;padding-bottom:.3em">{escape(words)}{help_}</div>'


def _note(words: str) -> str:
    return f'<div style="font-size:12px;opacity:.7;padding-top:.3em">{escape(words)}</div>'
