"""Localizes all queries of a scene in the background and shows the progress."""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import viser

from spherloc.datasets.map_scene import MapScene
from spherloc.errors import SpherlocError, shorten
from spherloc.experiments.kept_results import kept_results
from spherloc.experiments.results import LOCALIZED, QueryResult
from spherloc.experiments.sequence import How, localize_queries
from spherloc.experiments.summary import success_rates
from spherloc.mapping.scenes.joint_outcome import judged_together
from spherloc.trace import Trace
from spherloc.types import FloatArray
from spherloc_viz.app.controls.query_strip import QueryStrip
from spherloc_viz.app.said_together import SaidTogether, said_together
from spherloc_viz.app.text import ramp_html, status_html, table_html
from spherloc_viz.app.web.touch import Touches
from spherloc_viz.layers.primitives import Table
from spherloc_viz.style import error_scale

START, STOP = "Localize all queries", "Stop"
MAX_DOUBTS = 4
"""Largest number of queries of which is told why other queries or maps speak against them."""


class SequencePanel:
    """A button, a bar and a table; ``rows`` are what is done by now of a scene's sequence."""

    def __init__(
        self,
        gui: viser.GuiApi,
        touches: Touches,
        folder: Path | None,
        chosen: Callable[[], tuple[str, MapScene, str, Any, int]],
        done: Callable[[Trace | None, bool], None],
        open_query: Callable[[str], None],
    ) -> None:
        """``folder`` has the results of ``spherloc localize``, if there is one. ``chosen`` tells the scene's label, the
        scene, estimator, options and seed; ``done`` is called for every query with its run, if it came so far, and
        whether the query was run before and is tried anew; ``open_query`` shows the query of that name."""
        self._results, self._chosen, self._done = folder, chosen, done
        self._folder = gui.add_folder("Sequence", visible=False)
        with self._folder:
            self._button = gui.add_button(START)
            self._bar = gui.add_progress_bar(0.0, visible=False)
            self._text = gui.add_html("")
            self._pictures = gui.add_html("")
        self._button.on_click(self._press)
        self._lock = threading.Lock()
        self._stop: threading.Event | None = None
        self._rows: dict[str, tuple[QueryResult, ...]] = {}
        """By the label of the scene."""
        self._shown: tuple[str, MapScene | None] = ("", None)
        self._query = ""
        self._hidden = False
        self._strip = QueryStrip(touches, self._show_pictures, open_query, self._complain)

    def show(self, label: str, scene: MapScene | None, path: Path) -> None:
        """Show the panel for a scene with queries, whose file is ``path``, and hide it for others."""
        self.offer(scene is not None)
        another, self._shown = label != self._shown[0], (label, scene)
        self._follow()
        if not another or scene is None:
            return
        rows = self.rows(label)
        self._text.content = sequence_html(rows, scene) if rows else ""
        if not rows and self._results is not None:
            what = self._results, label, scene, path
            threading.Thread(target=self._read_kept, args=what, name="spherloc-kept", daemon=True).start()

    def offer(self, offered: bool) -> None:
        """Show the panel, or hide it; what it says stays."""
        self._folder.visible = offered

    def _read_kept(self, folder: Path, label: str, scene: MapScene, path: Path) -> None:
        """Show what was localized before in a scene, if nothing is localized or has been on this page."""
        try:
            found = kept_results(folder, scene, path)
        except SpherlocError:  # then there is nothing to show; the panel will say so if it is used
            return
        with self._lock:
            if found is None or label in self._rows or self._shown[0] != label:
                return
            self._rows[label] = found.rows
        words = f"Localized before by {found.configuration.estimator}: {shorten(found.folder.name)}."
        self._text.content = sequence_html(found.rows, scene) + status_html(words)
        self._follow()
        self._done(None, False)

    def mark(self, query: str) -> None:
        """Say which query the page shows; empty for none."""
        if query != self._query:
            self._query = query
            self._follow()

    def hide_answers(self, hidden: bool) -> None:
        """Hide the results, or show them again."""
        if self._text.visible == hidden:
            self._text.visible = not hidden
        if self._hidden != hidden:
            self._hidden = hidden
            self._follow()

    def _follow(self) -> None:
        """The strip shows the scene at hand, and what became of its queries."""
        label, scene = self._shown
        self._strip.set(scene, self.rows(label), self._hidden, self._query)

    def _show_pictures(self, html: str) -> None:
        if self._pictures.content != html:
            self._pictures.content = html

    def _complain(self, sentence: str) -> None:
        self._text.content = status_html(sentence, wrong=True)

    def rows(self, label: str) -> tuple[QueryResult, ...]:
        """Results by now, in the order of the sequence."""
        with self._lock:
            return self._rows.get(label, ())

    def said_of(self, label: str, scene: MapScene, query: str | None, pose: FloatArray | None) -> SaidTogether | None:
        """What the results of a scene's queries say of one whose run by itself has this ``pose`` (3, 4), by default of
        the first one; None if nothing."""
        name = scene.query(query).name
        row = next((row for row in self.rows(label) if row.query == name), None)
        return None if row is None else said_together(row, pose, scene.thresholds[0])

    def close(self) -> None:
        """End after the query at hand; does not wait."""
        self._strip.close()
        with self._lock:
            if self._stop is not None:
                self._stop.set()

    def _press(self, event: viser.GuiEvent) -> None:
        with self._lock:
            if self._stop is not None:
                self._stop.set()
                return
            self._stop = threading.Event()
            stop = self._stop
        threading.Thread(target=self._run, args=(stop,), name="spherloc-sequence", daemon=True).start()

    def _run(self, stop: threading.Event) -> None:
        self._button.label, self._bar.visible, self._bar.value = STOP, True, 0.0
        try:
            label, scene, estimator, options, seed = self._chosen()
            with self._lock:
                self._rows[label] = ()
            for row, trace in localize_queries(scene, scene.queries, estimator, options, seed):
                with self._lock:
                    rows = self._rows[label] = (*self._rows[label], row)
                self._bar.value = 100.0 * len(rows) / len(scene.queries)
                self._text.content = sequence_html(rows, scene)
                self._follow()
                self._done(trace, False)
                if stop.is_set():
                    break
            else:
                self._judge_together(label, scene, How(estimator, options, seed), stop)
        except SpherlocError as error:
            self._text.content = status_html(str(error), wrong=True)
        finally:
            self._button.label, self._bar.visible = START, False
            with self._lock:
                self._stop = None

    def _judge_together(self, label: str, scene: MapScene, how: How, stop: threading.Event) -> None:
        """Judge the queries of a scene by each other, now that all are localized by themselves."""
        for row, trace in judged_together(scene, self.rows(label), how):
            with self._lock:
                rows = tuple(row if one.query == row.query else one for one in self._rows[label])
                self._rows[label] = rows
            self._text.content = sequence_html(rows, scene)
            self._follow()
            self._done(trace, True)
            if stop.is_set():
                break


def sequence_html(rows: tuple[QueryResult, ...], scene: MapScene) -> str:
    """How far the sequence is, how many succeed within each limit, what the colours of the dots mean, what the truth is
    from, and why queries are doubted that are localized by themselves."""
    rates, unit = success_rates(rows, scene.thresholds), "m" if scene.metric else "units"
    lines = [
        (f"within {rate.degrees:g}° and {rate.metres:g} {unit}", f"{rate.successes} of {rate.judged}") for rate in rates
    ]
    done = ("queries", f"{len(rows)} of {len(scene.queries)}")
    located = ("localized", f"{sum(row.status == LOCALIZED for row in rows)} of {len(rows)}")
    limit_m = scene.thresholds[-1][1]
    errors = [row.translation_error_m for row in rows if row.translation_error_m is not None]
    scale, small = (100.0, "cm") if scene.metric else (1.0, unit)
    worst = f"{scale * error_scale(np.array(errors), limit_m):.2g} {small}; red beyond {limit_m:g} {unit}"
    doubts = [f"{row.query} is doubtful: {why}" for row in rows for why in row.doubts]
    more = [f"And {len(doubts) - MAX_DOUBTS} more are."] if len(doubts) > MAX_DOUBTS else []
    truth = [scene.about_truth] if rates and scene.about_truth else []
    return (
        table_html(Table("sequence", ("", ""), (done, located, *lines)))
        + (ramp_html("0", worst) if errors else "")
        + "".join(status_html(sentence) for sentence in (*truth, *doubts[:MAX_DOUBTS], *more))
    )
