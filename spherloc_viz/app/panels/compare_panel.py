"""Runs several estimators on the problem at hand, one after another, and shows them side by side."""

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from html import escape
from typing import Any

import numpy as np
import viser

from spherloc.diagnosis import Cause, diagnose
from spherloc.errors import InputError
from spherloc.estimators import default_options, estimate
from spherloc.problem import Problem
from spherloc.trace import Trace
from spherloc.watch import Cancelled, Watch
from spherloc_viz import style
from spherloc_viz.app.panels.export_panel import VIEW as SHARE
from spherloc_viz.app.plots.charts import chart_svg
from spherloc_viz.app.text import DIM, WITHHELD, WORDS, begun, box, dot_html, status_html
from spherloc_viz.app.web.touch import Touch, Touches, seen_views
from spherloc_viz.app.workers import BackgroundWorker
from spherloc_viz.layers.comparison import (
    FIRST,
    NO_VALUE,
    Entry,
    coinciding,
    color_of,
    comparison_items,
    comparison_table,
    residual_chart,
    yaw_chart,
)
from spherloc_viz.layers.primitives import Chart, SceneItem, Table
from spherloc_viz.options import usable_estimators


def ordered(names: Sequence[str]) -> tuple[str, ...]:
    """Estimators in the order in which they are offered."""
    return tuple(sorted(names, key=lambda name: (FIRST.index(name) if name in FIRST else len(FIRST), name)))


def chips_html(action: str, names: Sequence[str], ticked: set[str]) -> str:
    """Names to be ticked; a press is reported as ``action`` with the name."""
    chips = "".join(_chip(action, name, name in ticked) for name in names)
    return box(f'<div style="display:flex;flex-wrap:wrap;gap:.35em">{chips}</div>', "font-size:12px")


def _chip(action: str, name: str, ticked: bool) -> str:
    look = f"border:1px solid rgba(128,140,160,{0.8 if ticked else 0.3});opacity:{1 if ticked else 0.7}"
    return (
        f'<span role="checkbox" aria-checked="{str(ticked).lower()}" aria-label="{escape(name)}" tabindex="0" '
        f'data-touch="{escape(action)}:{escape(name)}" '
        f'style="white-space:nowrap;border-radius:1em;padding:.1em .6em;{look}">'
        f"{dot_html(color_of(name))}{escape(name)}</span>"
    )


START, STOP = "Compare", "Cancel"
VIEW = "Compare"
"""Name by which the page reports whether the panel can be seen."""
LIVE_AFTER_S = 0.25
"""A live comparison waits until the problem has stood still for this long."""
TICKED = ("mc-exact", "mc", "ransac-2p")
"""Estimators that are compared at first: exact, the paper's, two points. Baselines with their defaults seldom win."""
MEASURED = ("rotation", "position", "F1", "time")
"""Columns that have one in the table; the others are in the line below."""
NOTE = (
    "One run each, one after another, all with the page's bound; the estimator that is chosen on the page has all of "
    "the page's options, the others have default ones. Times are of these runs, which are made for this table: the run "
    "that the page shows has a time of its own. Press a row to use its estimator."
)

_warm: set[str] = set()
"""Estimators that have run in this process: the first run of each also loads its compiled code."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """The comparison of one problem, as far as it has come."""

    problem: Problem
    names: tuple[str, ...]
    """Of the estimators that are compared."""
    entries: tuple[Entry, ...] = ()
    charts: tuple[Chart, ...] = ()
    items: tuple[SceneItem, ...] = ()


class ComparePanel:
    """Which estimators, a button, a table and charts; ``items`` are what the canvas shows of it."""

    def __init__(
        self,
        gui: viser.GuiApi,
        touches: Touches,
        use: Callable[[str], None],
        changed: Callable[[object], None],
        prepare: Callable[[str, Watch], None] = lambda name, watch: None,
    ) -> None:
        """``use`` is called with the estimator of a row that is pressed, ``changed`` when there is more to show,
        ``prepare`` before an estimator runs, which may take long and is ended by the watch."""
        self._use, self._changed, self._prepare = use, changed, prepare
        self._names = ordered(usable_estimators())
        self._ticked = {name for name in self._names if name in TICKED}
        self._choice = gui.add_html(chips_html("compare", self._names, self._ticked))
        self._button = gui.add_button(START, hint="Run the ticked estimators on the problem at hand.")
        self._live = gui.add_checkbox("Live", False, hint="Compare again whenever the problem changes.")
        self._bar = gui.add_progress_bar(0.0, visible=False)
        self._status = gui.add_html("", visible=False)
        self._table = gui.add_html(box(f'<div style="{DIM}">{escape(NOTE)}</div>', "font-size:12px"))
        self._lock = threading.Lock()
        self._trace: Trace | None = None
        self._done: Comparison | None = None
        self._shown: tuple[Comparison | None, bool, bool] = (None, False, False)
        """What was compared, whether it is of the problem at hand, and whether it is hidden."""
        self._hidden = False
        self._stop, self._watch = threading.Event(), Watch()
        self._closed, self._seen = False, False
        self._background = BackgroundWorker("spherloc-compare", self._complain)
        self._button.on_click(self._press)
        self._live.on_update(self._switch)
        touches.on("compare", self._tick)
        touches.on("use", self._choose)
        touches.on("views", self._see)

    def draw(self, trace: Trace, hidden: bool = False) -> None:
        """Follow the run at hand, whose problem, seed and options are those to compare with; ``hidden`` shows nothing
        of what comes out."""
        with self._lock:
            before, self._trace, self._hidden = self._trace, trace, hidden
        if self._live.value and (before is None or not is_same(before.problem, trace.problem)):
            self._start(LIVE_AFTER_S)
        self._show()

    def compared(self, trace: Trace) -> tuple[str, ...]:
        """Names of the estimators that were compared on the problem of a run; none if another problem was compared."""
        with self._lock:
            done = self._done
        same = done is not None and is_same(done.problem, trace.problem)
        return done.names if done is not None and same else ()

    def follow(self, trace: Trace, names: Sequence[str]) -> None:
        """Compare estimators on the problem of a run, as a link asks for; without names, nothing."""
        if names and set(names) != set(self.compared(trace)):
            with self._lock:
                self._ticked = set(names)
                self._choice.content = chips_html("compare", self._names, self._ticked)
            self._start(trace=trace)

    def items(self, trace: Trace) -> tuple[SceneItem, ...]:
        """What the canvas shows beside a run while this panel is seen, and the one that makes pictures of the canvas if
        it is opened next; nothing if another problem was compared."""
        done = self._done if self._seen else None
        return done.items if done is not None and is_same(done.problem, trace.problem) else ()

    def close(self) -> None:
        """End the comparison at hand; does not wait."""
        self._closed = True
        self._background.close()
        self._halt()

    def _see(self, touch: Touch) -> None:
        """The page reports which tabs are open now."""
        names = seen_views(touch.argument).names
        seen = VIEW in names or (self._seen and SHARE in names)
        if seen != self._seen:
            self._seen = seen
            self._changed(None)

    def _press(self, event: viser.GuiEvent) -> None:
        if self._button.label == STOP:
            self._background.forget()
            self._halt()
        else:
            self._start()

    def _switch(self, event: viser.GuiEvent) -> None:
        if self._live.value:
            self._start()

    def _tick(self, touch: Touch) -> None:
        if touch.argument in self._names:
            with self._lock:
                self._ticked ^= {touch.argument}
                self._choice.content = chips_html("compare", self._names, self._ticked)
            if self._live.value:
                self._start()

    def _choose(self, touch: Touch) -> None:
        if touch.argument in self._names:
            self._use(touch.argument)

    def _start(self, after_s: float = 0.0, trace: Trace | None = None) -> None:
        """Compare after a while, on the problem of a run or else of the one that is shown then, and end the comparison
        at hand."""
        self._halt()
        self._background.ask(partial(self._work, after_s, trace))

    def _halt(self) -> None:
        """End the comparison at hand, also within a run."""
        self._stop.set()
        self._watch.cancel()

    def _work(self, after_s: float, trace: Trace | None) -> None:
        stop = self._stop = threading.Event()
        if stop.wait(after_s) or self._closed:
            return
        self._button.label, self._bar.visible = STOP, True
        try:
            self._compare(stop, trace)
        finally:
            self._button.label, self._bar.visible, self._status.visible = START, False, False

    def _compare(self, stop: threading.Event, of: Trace | None = None) -> None:
        """Run all and diagnose all, showing each as it comes. Raises ``InputError`` if there is nothing to
        compare, and in the end about each estimator that failed."""
        with self._lock:
            trace, names = of or self._trace, [name for name in self._names if name in self._ticked]
        if trace is None:
            raise InputError("there is no run to compare with yet; wait for the first picture.")
        if not names:
            raise InputError("no estimator is ticked; tick one or more.")
        entries: tuple[Entry, ...] = ()
        failures: list[str] = []
        for place, name in enumerate(names):
            self._progress(place / len(names), f"{name}, {place + 1} of {len(names)} …")
            watch = self._watch = Watch()
            if stop.is_set() or self._closed:
                return
            try:
                self._prepare(name, watch)
                entries = (*entries, Entry(_run(trace, name, watch)))
            except Cancelled:
                return
            except InputError as error:  # of one estimator: the others are compared
                failures.append(str(error))
                continue
            self._publish(names, entries)
        for place, entry in enumerate(entries):
            self._progress(place / len(names), f"Diagnosing {entry.trace.estimator} …")
            if stop.is_set() or self._closed:
                return
            entries = (*entries[:place], replace(entry, diagnosis=diagnose(entry.trace)), *entries[place + 1 :])
            self._publish(names, entries)
        if failures:
            raise InputError(" ".join(failures))

    def _progress(self, share: float, words: str) -> None:
        self._bar.value = 100.0 * share
        self._status.content, self._status.visible = status_html(words), True

    def _complain(self, sentence: str) -> None:
        self._status.content = status_html(begun(sentence), wrong=True)
        self._status.visible = True

    def _publish(self, names: Sequence[str], entries: tuple[Entry, ...]) -> None:
        charts = (residual_chart(entries), yaw_chart(entries))
        known = tuple(chart for chart in charts if chart is not None)
        with self._lock:
            problem = entries[0].trace.problem
            self._done = Comparison(problem, tuple(names), entries, known, comparison_items(entries))
        self._changed(None)
        self._show()

    def _show(self) -> None:
        """Put the comparison on the page, paler if it is of an earlier problem."""
        with self._lock:
            done, trace, hidden = self._done, self._trace, self._hidden
            if done is None or trace is None:
                return
            fits = is_same(done.problem, trace.problem)
            if self._shown == (done, fits, hidden):
                return
            self._shown = (done, fits, hidden)
            told = status_html(WITHHELD) if hidden else comparison_html(done.entries, done.charts, fits)
            self._table.content = told


def _run(trace: Trace, name: str, watch: Watch) -> Trace:
    """An estimator on the problem of a run. Before its first run in this process it runs once more, to load its code.

    Raises ``Cancelled`` if ``watch`` ends either.
    """
    options = options_like(trace, name)
    if name not in _warm:
        estimate(trace.problem, name, options, trace.seed, watch)
        _warm.add(name)
    return estimate(trace.problem, name, options, trace.seed, watch)


def options_like(trace: Trace, name: str) -> Any:
    """The run's own options; of another estimator its default ones, but with the run's bound, which decides what is an
    inlier: else two estimators would be asked two questions."""
    if name == trace.estimator:
        return trace.options
    return replace(default_options(name, trace.problem), bound_px=trace.options.bound_px)


def is_same(one: Problem, other: Problem) -> bool:
    """Whether both are the same problem, though maybe made twice."""
    if one is other:
        return True
    arrays = ("pixels", "points", "gravity_camera", "gravity_map", "truth_cam_from_map", "truth_inliers")
    plain = ("name", "camera", "bound_px", "gravity_bound_rad", "gravity_sd_rad")
    return all(getattr(one, name) == getattr(other, name) for name in plain) and all(
        np.array_equal(getattr(one, name), getattr(other, name)) for name in arrays
    )


def comparison_html(entries: Sequence[Entry], charts: Sequence[Chart], fits: bool) -> str:
    """Table and charts; paler, with a remark, if they do not fit the problem at hand."""
    table = comparison_table(entries)
    rows = "".join(_row_html(table, row) for row in table.rows)
    head = "".join(f'<td style="text-align:right;{DIM}">{escape(name)}</td>' for name in MEASURED)
    style_css = "border-collapse:collapse;width:100%;font-size:12px;font-variant-numeric:tabular-nums"
    body = box(f'<table style="{style_css}"><tr><td></td>{head}</tr>{rows}</table>')
    body += "".join(
        f'<div style="padding:0 .8em .2em;font-size:12.5px;font-weight:600">{escape(chart.title)}</div>'
        + box(chart_svg(chart) + f'<div style="font-size:12px;{DIM}">{escape(coinciding(chart))}</div>')
        for chart in charts
    )
    body += box(f'<div style="{DIM}">{escape(NOTE)}</div>', "font-size:12px")
    if fits:
        return body
    return status_html(f"The problem has changed since; press {START}.") + f'<div style="opacity:.45">{body}</div>'


def _row_html(table: Table, row: tuple) -> str:
    """A row of numbers and a line of words; both are pressed to use the estimator."""
    value = dict(zip(table.columns, map(str, row), strict=True))
    name = value["estimator"]
    touch = f'data-touch="use:{escape(name)}" title="Use {escape(name)}"'
    cell = 'style="padding:.35em 0 0 .5em;text-align:right;white-space:nowrap"'
    numbers = "".join(f"<td {cell}>{escape(value[column])}</td>" for column in MEASURED)
    title = dot_html(color_of(name)) + escape(name)
    head = f'<td style="padding-top:.35em;white-space:nowrap;font-weight:600">{title}</td>'
    shares = ("inliers", "precision", "recall")
    words = [f"{value[share]} {share}" for share in shares if value[share] not in (NO_VALUE, "0")]
    words += [value["certificate"]] if value["certificate"] != NO_VALUE else []
    # Named as what it is: beside "no pose" a cause alone reads as if it were about a pose.
    words += [f"diagnosis: {value['diagnosis']}"] if value["diagnosis"] not in (NO_VALUE, Cause.OK) else []
    color = WORDS.get(value["outcome"])
    verdict = (
        f'<span style="{f"color:{style.css_text(color)};font-weight:600" if color else ""}">{value["outcome"]}</span>'
    )
    line = f'{verdict}<span style="{DIM}"> · {escape(" · ".join(words))}</span>' if words else verdict
    below = f'<td colspan="{1 + len(MEASURED)}" style="padding:0 0 .35em 1.15em">{line}</td>'
    rule = 'style="border-top:1px solid rgba(128,140,160,.25)"'
    return f'<tr tabindex="0" {touch} {rule}>{head}{numbers}</tr><tr {touch}>{below}</tr>'
