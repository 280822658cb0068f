"""The residual view: how far the matches are from the pose, how well inliers were told from outliers, and how RANSAC
went."""

from collections.abc import Callable
from html import escape

import numpy as np
import viser
from numpy.typing import NDArray

from spherloc.trace import Trace
from spherloc_viz import style
from spherloc_viz.app.plots.charts import chart_html
from spherloc_viz.app.plots.residual_drawing import SELECT_BIN, histogram_svg, history_svg
from spherloc_viz.app.text import DIM, box, dot_html, table_html
from spherloc_viz.app.web.touch import Touch, Touches
from spherloc_viz.layers.primitives import Chart
from spherloc_viz.layers.residuals import Histogram, History, Residuals, history_of, residuals_of, scores_table

Select = Callable[[tuple[int, ...]], None]


class ResidualView:
    """Pressing a bin of a histogram selects its matches."""

    def __init__(self, gui: viser.GuiApi, touches: Touches, changed: Callable[[object], None], select: Select) -> None:
        """``select`` is called with the matches of a bin that was pressed, by their numbers in the problem."""
        self._changed, self._select = changed, select
        self._known: tuple[Trace, Residuals | None, str, str] | None = None
        self._drawn: tuple[tuple[int, ...], Chart | None] | None = None
        self._bins: dict[str, Histogram] = {}
        self._html = gui.add_html("")
        touches.on(SELECT_BIN, self._press)

    def draw(self, trace: Trace, selected: tuple[int, ...], kept: NDArray[np.int64], cost: Chart | None = None) -> None:
        """Show a run with the ``selected`` matches (numbers of the problem) marked; nothing here needs ``kept``, the
        numbers (N,) by which matches are known on the page. ``cost`` is how the residuals fell so far, to stand above.
        Sends nothing if nothing changed.
        """
        if self._known is None or self._known[0] is not trace:
            residuals, history = residuals_of(trace), history_of(trace)
            self._known = trace, residuals, table_html(scores_table(trace)), _history_html(history)
        elif self._drawn is not None and self._drawn[0] == selected and self._drawn[1] is cost:
            return
        _, residuals, scores, history_html = self._known
        bins: dict[str, Histogram] = {} if residuals is None else {one.unit: one for one in residuals.histograms}
        fall = "" if cost is None else chart_html(cost)
        content = fall + _residuals_html(residuals, selected) + scores + history_html
        # A press on what was on the page a moment ago selects what is in that bin now.
        self._bins = bins
        if content != self._html.content:
            self._html.content = content
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
    return box(_title("Residuals at the estimated pose") + _legend_html(residuals.judged) + drawings + note)


def _legend_html(judged: str) -> str:
    """What the colours mean: not what the run made of a match, as elsewhere, but what is known of it."""
    dots = "".join(
        f'<span style="margin-right:1.1em">{dot_html(color)}{words}</span>'
        for color, words in ((style.INLIER, "right"), (style.OUTLIER, "wrong"))
    )
    return f'<div style="font-size:12px;padding-bottom:.3em">{dots}<span style="{DIM}">{escape(judged)}</span></div>'


def residuals_caption(residuals: Residuals) -> str:
    """What the axes mean, and what the last bins hold."""
    words = ["Bins grow by equal factors; the first and the last hold all that is smaller or larger."]
    behind = int(np.count_nonzero(np.isinf(residuals.px))) - residuals.blind
    if behind:
        words.append(f"In px, the last one holds {behind:,} matches more than 90° off.")
    if residuals.blind:
        words.append(f"The last ones also hold {residuals.blind:,} whose pixel the camera model cannot see.")
    return " ".join(words)


def _history_html(history: History | None) -> str:
    if history is None:
        return ""
    return box(_title("How RANSAC got there") + history_svg(history) + _note(history_caption(history)))


def history_caption(history: History) -> str:
    """Eq. 28 with this run's numbers, and when this run was lucky."""
    share = f"w = {100.0 * history.share:.3g} % inliers, n = {history.size}"
    words = f"P = 1 − (1 − wⁿ)ᵏ (Eq. 28) with {share}: "
    if np.isfinite(history.half_at):
        words += f"half of all runs draw a sample of inliers only within {max(1.0, history.half_at):,.0f}."
    else:
        words += "no sample could be of inliers only."
    if history.clean_at is not None:
        words += f" Here the first improvement by right matches only was sample {history.clean_at:,}."
    return words


def _title(words: str) -> str:
    return f'<div style="font-weight:600;padding-bottom:.3em">{escape(words)}</div>'


def _note(words: str) -> str:
    return f'<div style="font-size:11.5px;opacity:.7;padding-top:.3em">{escape(words)}</div>'
