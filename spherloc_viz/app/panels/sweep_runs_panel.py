"""A sweep over the page's simulation, in processes of its own, drawn as it grows."""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import viser

from spherloc.errors import InputError, SpherlocError
from spherloc.experiments.sweep import AXES, Entrant, SweepPlan, SweepRow, planned, run_sweep
from spherloc.experiments.sweep_plan import parse_values
from spherloc.experiments.sweep_rows import rows_text, summarize, summary_text
from spherloc.processors import processor_count
from spherloc_viz.app.catalog import SceneRequest
from spherloc_viz.app.panels.compare_panel import chips_html, ordered
from spherloc_viz.app.plots.charts import charts_html, table_html
from spherloc_viz.app.text import WITHHELD, begun, status_html
from spherloc_viz.app.web.touch import Touch, Touches
from spherloc_viz.app.web.viser_internals import put
from spherloc_viz.options import usable_estimators
from spherloc_viz.recording.storage.recorder import Recorder

START, CANCEL = "Start sweep", "Cancel"
VALUES = {
    "outlier_rate": "0.5:0.95:0.05",
    "noise_px": "0:10:1",
    "correspondences": "50:400:50",
    "gravity_error_deg": "0:2:0.25",
}
"""What is offered for each axis."""
HINT = "FIRST:LAST:STEP, or numbers with commas between them."
TICKED = ("mc-exact", "mc", "ransac-2p")
MAX_PAGE_ROWS = 20_000
"""Larger sweeps are for the command line, which keeps them on disk."""
ROOM_EVERY = 100
"""Recorded runs after which old ones may have to make room."""
DRAW_EVERY_S = 0.25
DRAW_SHARE = 0.05
"""Largest share of the time that goes into drawing."""

_turn = threading.Lock()
"""Held by the sweep that is running: one at a time on a server, for all pages together."""
_pictures = threading.Lock()
"""Matplotlib is not for several threads at once."""

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class _Results:
    """What is known by now."""

    plan: SweepPlan
    name: str
    """Name of the scene."""
    rows: tuple[SweepRow, ...] = ()


class SweepPanel:
    """What to sweep, a button, charts, a table, and files to download."""

    def __init__(
        self,
        gui: viser.GuiApi,
        touches: Touches,
        chosen: Callable[[], tuple[Path, SceneRequest]],
        recorder: Recorder | None = None,
    ) -> None:
        """``chosen`` tells the file of the page's scene and what is changed about it; it may raise ``InputError``.

        ``recorder`` is that of the page's runs; without one those of sweeps are not recorded either.
        """
        self._chosen, self._recorder = chosen, recorder
        names = usable_estimators()
        self._names = ordered(names)
        self._ticked = {name for name in self._names if name in TICKED}
        self._chips = gui.add_html(chips_html("sweep", self._names, self._ticked))
        self._over = gui.add_dropdown("Over", tuple(AXES.values()), hint="What takes several values.")
        self._values = gui.add_text("Values", VALUES["outlier_rate"], hint=HINT)
        self._runs = gui.add_number(
            "Runs", 20, min=1, max=10_000, step=1, hint="Problems at each value, the same for all."
        )
        most = processor_count()
        self._workers = gui.add_number(
            "Workers", min(2, most), min=1, max=most, step=1, hint="Processes beside this page."
        )
        hint = "Keep a recording of each run, which takes longer than solving it."
        self._record = gui.add_checkbox("Record runs", recorder is not None, visible=recorder is not None, hint=hint)
        self._button = gui.add_button(START)
        self._bar = gui.add_progress_bar(0.0, visible=False)
        self._status = gui.add_html(status_html("The scene is the page's, with all that is changed about it."))
        self._files = gui.add_button_group("Download", ("CSV", "Summary", "PNG"), visible=False)
        self._charts = gui.add_html("", visible=False)
        self._table = gui.add_html("", visible=False)
        self._lock = threading.Lock()
        self._stop: threading.Event | None = None
        self._results: _Results | None = None
        self._complaints: list[str] = []
        """Why runs of the last sweep could not be recorded."""
        self._warnings: list[str] = []
        """Estimators of other packages that failed in it."""
        self._closed = self._hidden = False
        self._withheld = gui.add_html(status_html(WITHHELD), visible=False)
        self._button.on_click(self._press)
        self._over.on_update(self._follow)
        self._files.on_click(self._download)
        touches.on("sweep", self._tick)

    def close(self) -> None:
        """End the sweep and its processes; does not wait."""
        with self._lock:
            self._closed = True
            if self._stop is not None:
                self._stop.set()

    def hide_answers(self, hidden: bool) -> None:
        """Put the results away, or show them again."""
        if hidden != self._hidden:
            self._hidden = hidden
            self._show_results()

    def _show_results(self) -> None:
        results = self._results
        there = results is not None and bool(results.rows)
        self._charts.visible = self._table.visible = self._files.visible = there and not self._hidden
        self._withheld.visible = there and self._hidden

    def _tick(self, touch: Touch) -> None:
        if touch.argument in self._names:
            with self._lock:
                self._ticked ^= {touch.argument}
                self._chips.content = chips_html("sweep", self._names, self._ticked)

    def _follow(self, event: viser.GuiEvent) -> None:
        if self._values.value in VALUES.values():  # it was not typed
            put(self._values, VALUES[self._axis()])

    def _axis(self) -> str:
        return next(name for name, title in AXES.items() if title == self._over.value)

    def _press(self, event: viser.GuiEvent) -> None:
        with self._lock:
            if self._stop is not None:
                self._stop.set()
                return
            if self._closed:
                return
            self._stop = stop = threading.Event()
        self._button.label, self._bar.value, self._bar.visible = CANCEL, 0.0, True
        threading.Thread(target=self._run, args=(stop,), name="spherloc-sweep", daemon=True).start()

    def _run(self, stop: threading.Event) -> None:
        sentence, wrong = "", True
        try:
            results = self._begin()
            if _wait_for_turn(stop, self._say):
                try:
                    self._sweep(results, stop)
                finally:
                    _turn.release()
            sentence, wrong = self._outcome(results.plan), False
        except SpherlocError as error:
            sentence = str(error)
        except Exception as error:
            log.exception("sweep")
            sentence = f"This is a bug in the playground ({error!r}); sweep something else."
        finally:
            with self._lock:
                self._stop = None
            if not self._closed:
                self._say(sentence, wrong)
                self._button.label, self._bar.visible = START, False

    def _begin(self) -> _Results:
        """The sweep that the page describes, with the results of the last one if it was the same."""
        path, request = self._chosen()
        over = self._axis()
        variation = replace(request.variation.without_edits(), **{over: None})
        entrants = [Entrant(name) for name in self._names if name in self._ticked]
        values, runs = parse_values([self._values.value]), int(self._runs.value)
        plan = planned(path, over, values, entrants, runs, variation, request.seed)
        if plan.rows > MAX_PAGE_ROWS:
            raise InputError(
                f"these are {plan.rows:,} runs; ask for {MAX_PAGE_ROWS:,} or fewer, or take spherloc sweep on the "
                "command line."
            )
        before = self._results
        same = before is not None and replace(before.plan, runs=runs) == plan
        rows = tuple(row for row in before.rows if row.seed < request.seed + runs) if before and same else ()
        self._results = _Results(plan, request.scene, rows)
        return self._results

    def _sweep(self, results: _Results, stop: threading.Event) -> None:
        plan, rows = results.plan, list(results.rows)
        self._say("Starting the workers …" if not rows else "Going on …")
        done = {(row.estimator, row.value, row.seed) for row in rows}
        began, before, due = time.monotonic(), len(rows), 0.0
        recorder, self._complaints = self._recorder if self._record.value else None, []
        self._warnings = []
        keep = None if recorder is None else recorder.sweep_store()
        workers, complain, warn = int(self._workers.value), self._complaints.append, self._warnings.append
        for row in run_sweep(plan, done, workers, None, stop, keep, complain, warn):
            rows.append(row)
            if recorder is not None and len(rows) % ROOM_EVERY == 0:
                recorder.make_room()
            if self._closed or time.monotonic() < due:
                continue
            start = time.monotonic()
            self._results = replace(results, rows=tuple(rows))
            self._bar.value = 100.0 * len(rows) / plan.rows
            left_s = (start - began) / (len(rows) - before) * (plan.rows - len(rows))
            self._say(f"{len(rows):,} of {plan.rows:,} runs, about {_duration(left_s)} left.")
            self._draw()
            due = time.monotonic() + max(DRAW_EVERY_S, (time.monotonic() - start) / DRAW_SHARE)
        self._results = replace(results, rows=tuple(rows))
        if not self._closed:
            self._draw()

    def _outcome(self, plan: SweepPlan) -> str:
        done, lost = 0 if self._results is None else len(self._results.rows), self._complaints
        said = f" {len(lost):,} could not be recorded, the first since: {lost[0]}" if lost else ""
        said = " ".join([said, *self._warnings])
        if done == plan.rows:
            return f"{done:,} runs on {plan.runs} problems at each value, from seed {plan.first_seed} on.{said}"
        return f"Stopped at {done:,} of {plan.rows:,} runs; {START} goes on while nothing is changed.{said}"

    def _draw(self) -> None:
        results = self._results
        if results is None or not results.rows:
            return
        plan = results.plan
        points = summarize(plan.labels, results.rows)
        self._charts.content = charts_html(plan.over, plan.labels, points)
        self._table.content = table_html(plan.over, plan.labels, points)
        self._show_results()

    def _say(self, sentence: str, wrong: bool = False) -> None:
        self._status.content = status_html(begun(sentence), wrong)

    def _download(self, event: viser.GuiEvent) -> None:
        results = self._results
        if results is None or event.client is None:
            return
        name, content = download_of(results.plan, results.name, results.rows, self._files.value)
        event.client.send_file_download(name, content, save_immediately=True)


def download_of(plan: SweepPlan, scene: str, rows: tuple[SweepRow, ...], kind: str) -> tuple[str, bytes]:
    """Name and content of the file of that kind ("CSV", "Summary", "PNG")."""
    stem = f"sweep_{Path(plan.scene).stem}_{plan.over}"
    if kind == "CSV":
        return f"{stem}.csv", rows_text(plan.over, plan.labels, rows).encode()
    points = summarize(plan.labels, rows)
    if kind == "Summary":
        return f"{stem}.summary.csv", summary_text(plan.over, points).encode()
    from spherloc_viz.plots.sweeps import sweep_png

    with _pictures:
        return f"{stem}.png", sweep_png(scene, plan.over, plan.labels, points)


def _wait_for_turn(stop: threading.Event, say: Callable[[str], None]) -> bool:
    """Wait until no other sweep is running on this server; false if it was stopped before."""
    if _turn.acquire(blocking=False):
        return True
    say("Another sweep is running on this server; this one waits for it …")
    while not stop.is_set():
        if _turn.acquire(timeout=0.1):
            return True
    return False


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90.0 else f"{seconds / 60.0:.0f} min"
