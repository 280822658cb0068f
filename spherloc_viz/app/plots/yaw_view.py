"""The yaw view: what a run says about yaw over the whole circle, and the arcs of pairs in a window of it."""

import math
import threading
from collections.abc import Callable
from html import escape

import numpy as np
import viser
from numpy.typing import NDArray

from spherloc.trace import Trace
from spherloc_viz.app.plots.yaw_drawing import ZOOM, yaw_svg
from spherloc_viz.app.text import box
from spherloc_viz.app.web.touch import Touch, Touches
from spherloc_viz.app.web.viser_internals import at_once
from spherloc_viz.layers.yaw_bars import (
    KINDS,
    Arcs,
    Bars,
    arcs_of,
    bars_in,
    peak_window,
    right_ones,
)
from spherloc_viz.layers.yaw_story import ALL, Window, YawStory, window_around, yaw_story

PEAK, WHOLE = "Zoom to the peak", "All yaws"
LEAST_DRAG = 0.012
"""Share of the plot that a press must cross to count as a drag."""


class YawView:
    """Zooms by drags over the plots and by buttons; ``draw`` shows a run. Presses only note a window."""

    def __init__(self, gui: viser.GuiApi, touches: Touches, changed: Callable[[object], None]) -> None:
        self._changed = changed
        self._lock = threading.Lock()
        self._wanted: Window | None = None
        self._peak: Window = ALL
        self._known: tuple[Trace, YawStory] | None = None
        self._arcs: tuple[Trace, tuple[int, ...], Arcs] | None = None
        self._drawn: tuple | None = None
        self._buttons = gui.add_button_group("Yaw", (PEAK, WHOLE))
        self._html = gui.add_html("")
        self._buttons.on_click(self._click)
        touches.on(ZOOM, self._zoom)

    def draw(self, trace: Trace, step_key: str, selected: tuple[int, ...], kept: NDArray[np.int64]) -> None:
        """Show a run, at a step, with the pairs of the ``selected`` matches (numbers of the problem) brought out.

        ``kept`` (N,) are the numbers by which the matches are known on the page. Sends nothing if nothing changed.
        """
        with self._lock:
            wanted = self._wanted
        story = self._story(trace)
        hypothesis = step_key.removesuffix("-pose")
        shown_key = hypothesis if any(hypothesis == key for *_, key in story.hypotheses) else ""
        drawn = (trace, shown_key, selected, wanted)
        if self._drawn is not None and self._drawn[1:] == drawn[1:] and self._drawn[0] is trace:
            return
        arcs = self._arcs_of(trace, selected)
        peak = peak_window(story, arcs)
        window = peak if wanted is None else wanted
        with self._lock:
            self._peak = peak
        bars = bars_in(trace, arcs, window, selected)
        note = escape(caption(trace, story, arcs, bars))
        content = box(
            f'<div style="font-weight:600;padding-bottom:.3em">{escape(story.title)}</div>'
            f"{yaw_svg(story, bars, window, kept, shown_key)}"
            f'<div style="font-size:11.5px;opacity:.7;padding-top:.3em">{note}</div>'
        )
        if content != self._html.content:
            self._html.content = content
        self._drawn = drawn

    def _story(self, trace: Trace) -> YawStory:
        if self._known is None or self._known[0] is not trace:
            self._known = trace, yaw_story(trace)
        return self._known[1]

    def _arcs_of(self, trace: Trace, selected: tuple[int, ...]) -> Arcs:
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
        if last - first > LEAST_DRAG:
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


def _window_of(argument: str) -> Window | None:
    """The window that a press says it was on; None if it says nothing sensible."""
    try:
        low, high = map(float, argument.split(","))
    except ValueError:
        return None
    sensible = math.isfinite(low) and -180.0 <= low < 180.0 and low < high <= low + 360.0
    return (low, high) if sensible else None


def caption(trace: Trace, story: YawStory, arcs: Arcs, bars: Bars) -> str:
    """Which arcs are shown, by which rule, and what their colours mean."""
    total = sum(bars.total)
    if total == 0:
        return " ".join(filter(None, (story.note, arcs.rule, "No pair has an arc in this window.")))
    in_window = bars.row >= 0
    shown = int(np.count_nonzero(in_window))
    if shown < total:
        kinds = np.bincount(bars.kind[bars.owner[in_window]], minlength=len(KINDS)).tolist()
        counts = ", ".join(f"{n:,} of {of:,} {name}" for n, of, name in zip(kinds, bars.total, KINDS, strict=True))
        rule = f"{shown:,} of {total:,} arcs in this window shown, an even sample: {counts}."
    else:
        counts = ", ".join(f"{of:,} {name}" for of, name in zip(bars.total, KINDS, strict=True))
        rule = f"All {total:,} arcs in this window shown: {counts}."
    judged = right_ones(trace)[1]
    colors = f"Green: both matches right {judged}; red: both wrong; pale red: one wrong."
    return " ".join(filter(None, (story.note, arcs.rule, rule, colors)))
