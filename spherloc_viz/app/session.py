"""One browser client: its own widgets, canvas, run and threads."""

import logging
import threading
from dataclasses import dataclass, replace
from typing import Any

import viser

from spherloc.datasets.map_scene import MapScene
from spherloc.diagnosis import Diagnosis, diagnose
from spherloc.errors import InputError, SpherlocError
from spherloc.estimators import estimate
from spherloc.problem import Problem
from spherloc.trace import Trace
from spherloc_viz.app import views
from spherloc_viz.app.catalog import Catalog, SceneWish
from spherloc_viz.app.charts import ChartPanel
from spherloc_viz.app.display_controls import DisplayControls
from spherloc_viz.app.estimator_controls import EstimatorControls
from spherloc_viz.app.image_panel import ImagePanel
from spherloc_viz.app.newest import Job, Newest
from spherloc_viz.app.painter import Painter
from spherloc_viz.app.scene_controls import SceneControls
from spherloc_viz.app.sequence_panel import SequencePanel
from spherloc_viz.app.steps_panel import StepsPanel
from spherloc_viz.app.text import diagnosis_html, legend_html, status_html, table_html
from spherloc_viz.app.viser_seams import put_back
from spherloc_viz.layers import paint, steps, with_rival
from spherloc_viz.layers.primitives import Picture, SceneItem
from spherloc_viz.layers.tables import outcome_table
from spherloc_viz.layers.trajectory import trajectory_items
from spherloc_viz.recording.background import Recorder

QUIET_S = 0.7
"""Runs count as settled, and are recorded, when nothing has changed for this long."""
DIAGNOSE_AFTER_S = 0.2
"""A diagnosis costs more than many a run, so it waits until the picture has stood still for this long."""
PANELS_PX = ((1600, 460, 380), (0, 360, 340))
"""From this width of the window on: widths of the panels left and right of the canvas."""

FIRST_CHECKS, CHECK_S = 8, 0.4
"""A page that is still building itself drops its first view and reports that its viewer has not moved."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Wish:
    """All that a run depends on."""

    scene: SceneWish
    estimator: str
    options: Any


@dataclass(frozen=True, eq=False)
class Run:
    """A wish fulfilled."""

    wish: Wish
    trace: Trace


class Session:
    """Lives as long as the tab's connection.

    Three threads, so that steps can be walked while the next run is being solved: one solves the newest wish,
    one shows the newest run, one diagnoses it. All leave the interpreter while they compute or wait.
    """

    def __init__(self, client: viser.ClientHandle, catalog: Catalog, recorder: Recorder | None) -> None:
        self._client, self._catalog, self._recorder = client, catalog, recorder
        self._solver = Newest(f"spherloc-solver-{client.client_id}", self._guarded(self._solve))
        self._page = Newest(f"spherloc-page-{client.client_id}", self._guarded(self._show))
        self._doctor = Newest(f"spherloc-doctor-{client.client_id}", self._guarded(self._examine))
        self._run: Run | None = None
        self._diagnosed: tuple[Trace, Diagnosis] | None = None
        self._recorded: tuple[Trace, str] | None = None
        self._viewed: tuple[str, str, str] | None = None
        self._checks = FIRST_CHECKS
        self._complaint: tuple[str, viser.NotificationHandle] | None = None
        self._complaining = threading.Lock()
        self._full_width = client.camera.image_width
        self._panels_px = next(widths for least, *widths in PANELS_PX if self._full_width >= least)
        self._build()
        self._painter = Painter(client)

    def start(self) -> None:
        """Solve and show the first problem."""
        self._page.start()
        self._doctor.start()
        self._solver.start()
        self._solver.ask()

    def close(self) -> None:
        """End the threads; does not wait."""
        for worker in (self._solver, self._page, self._doctor, self._sequence):
            worker.close()

    def _build(self) -> None:
        gui = self._client.gui
        self._client.scene.set_up_direction("-y")
        self._outcome = gui.add_html("")
        self._scene = SceneControls(gui, self._catalog, self._changed)
        gui.add_button_group("", ("New seed",)).on_click(self._next_seed)
        self._estimator = EstimatorControls(gui, self._changed)
        self._sequence = SequencePanel(gui, self._chosen_sequence, self._localized)
        self._display = DisplayControls(gui, self._redraw)
        self._status = gui.add_html(status_html("Solving the first problem …"))
        story = gui.add_panel()
        with story.add_tab("Steps"):
            self._steps = StepsPanel(gui, self._redraw)
            gui.add_html(legend_html())
            self._diagnosis = gui.add_html("")
            self._images = ImagePanel(gui)
            self._charts = ChartPanel(gui)
        story.dock_left()
        story.set_width(self._panels_px[0])
        gui.main_panel.dock_right()
        gui.main_panel.set_width(self._panels_px[1])

    def _changed(self, event: Any) -> None:
        # Widgets that Python itself sets have no client; what they mean is known already.
        if event.client is not None:
            self._solver.ask()

    def _redraw(self, event: Any) -> None:
        self._page.ask()

    def _chosen_sequence(self) -> tuple[str, MapScene, str, Any, int]:
        """What the sequence panel localizes; raises ``InputError`` if the page says nothing that can be."""
        wish = self._scene.read()
        scene = self._catalog.map_scene(wish.scene)
        if scene is None:
            raise InputError("this scene has no query images; choose one that has.")
        return wish.scene, scene, *self._estimator.read(), wish.seed

    def _localized(self, trace: Trace | None) -> None:
        """One more query of a sequence is done."""
        if trace is not None and self._recorder is not None:
            try:
                self._recorder.submit(trace)
            except SpherlocError as error:
                self.complain(str(error))
        self._page.ask()

    def _next_seed(self, event: Any) -> None:
        self._scene.next_seed()
        self._solver.ask()

    def _solve(self, asked: bool) -> float | None:
        """The solver thread's job: solve what the page asks for now, or record what it has settled on."""
        if not asked:
            self._settle()
            return None
        if self._scene.follow_scene():
            self._sequence.show(self._catalog.map_scene(self._scene.read().scene))
            self._estimator.follow_problem(self._problem(self._scene.read()))
        wish = Wish(self._scene.read(), *self._estimator.read())
        if self._run is None or wish != self._run.wish:
            problem = self._problem(wish.scene)
            self._status.content = status_html(f"Solving with {wish.estimator} …")
            self._run = Run(wish, estimate(problem, wish.estimator, wish.options, wish.scene.seed))
            self._page.ask()
        self._status.content = status_html(
            "Runs are not recorded." if self._recorder is None else "Will be recorded when nothing changes any more."
        )
        self._withdraw()
        return QUIET_S

    def _problem(self, wish: SceneWish) -> Problem:
        """The problem that the page asks for; of images, with word of how far they are."""
        scene = self._catalog.map_scene(wish.scene)
        if scene is not None:

            def report(done: int, count: int) -> None:
                self._status.content = status_html(f"Describing the map: {done} of {count} reference images …")

            scene.prepare(report)
            self._status.content = status_html("Reading and matching images …")
        return self._catalog.problem(wish)

    def _settle(self) -> None:
        for widget in (*self._scene.widgets, *self._estimator.widgets, *self._display.widgets, *self._steps.widgets):
            put_back(widget)
        if self._recorder is None or self._run is None:
            return
        trace = self._run.trace
        if self._recorded is None or self._recorded[0] is not trace:
            self._recorded = trace, self._recorder.submit(trace).name
        self._status.content = status_html(f"Recorded as {self._recorded[1]}")

    def _show(self, asked: bool) -> float | None:
        """The page thread's job: show the step at hand of the newest run."""
        run = self._run
        if run is None:
            return None
        trace = run.trace
        timeline, outcome = steps(trace), outcome_table(trace)
        index, pause = self._steps.settle(timeline, asked)
        picture = paint(trace, index)
        tables = [table for table in picture.tables if table.name != outcome.name]
        last = index == len(timeline) - 1
        diagnosis, remark = None, status_html("Diagnosing …")
        if self._diagnosed is not None and self._diagnosed[0] is trace:
            diagnosis = self._diagnosed[1]
            remark = diagnosis_html(diagnosis, whole=last)
            if last and diagnosis.rival_cam_from_map is not None:
                picture = with_rival(picture, trace, diagnosis.rival_cam_from_map)
        picture = replace(picture, scene=picture.scene + self._trajectory(run))
        mesh = self._catalog.mesh(run.wish.scene.scene)
        layers = self._display.layers()
        with self._client.atomic():
            self._painter.draw(picture.scene, layers)
            self._painter.draw_backdrop(mesh, trace.problem.aligned.map_turn, "mesh" in layers)
            self._images.draw(trace, picture)
            self._steps.show(playing=pause is not None, tables=tables)
            self._charts.draw(picture.charts)
            self._outcome.content = table_html(outcome)
            self._diagnosis.content = remark
            self._move_viewer(trace, picture)
        self._client.flush()
        if diagnosis is None:
            self._doctor.ask()
        if pause is None and self._checks > 0:
            self._checks -= 1
            return CHECK_S
        return pause

    def _trajectory(self, run: Run) -> tuple[SceneItem, ...]:
        """The sequence that was localized in the scene at hand, if any."""
        label = run.wish.scene.scene
        scene, rows = self._catalog.map_scene(label), self._sequence.rows(label)
        if scene is None or not rows:
            return ()
        return trajectory_items(rows, run.trace.problem.aligned.map_turn, scene.thresholds[-1][1])

    def _examine(self, asked: bool) -> float | None:
        """The doctor thread's job: once nothing has changed for a while, diagnose the newest run and show it."""
        run = self._run
        if run is None or (self._diagnosed is not None and self._diagnosed[0] is run.trace):
            return None
        if asked:
            return DIAGNOSE_AFTER_S
        self._diagnosed = run.trace, diagnose(run.trace)
        self._page.ask()
        return None

    def _move_viewer(self, trace: Trace, picture: Picture) -> None:
        """Go where the person wants, or, if that is to follow the steps, where the step's subject reads best."""
        wanted = self._display.take_view()
        name, subject = views.fitting(picture)
        fitting = (trace.problem.name, name, subject)
        if wanted is None and (views.is_unmoved(self._client) or (self._display.follow and fitting != self._viewed)):
            wanted = name
        self._viewed = fitting
        if wanted is not None:
            views.look(self._client, views.find(wanted, picture, self._aspect()))

    def _aspect(self) -> float:
        """Width over height of the canvas."""
        camera = self._client.camera
        # The page tells its size before it docks the panels, and again some frames later.
        docked = sum(self._panels_px) if camera.image_width == self._full_width else 0
        return max(0.3, (camera.image_width - docked) / max(1, camera.image_height))

    def complain(self, sentence: str) -> None:
        """Say in one sentence what went wrong; the page keeps its last run and stays usable."""
        sentence = sentence[:1].upper() + sentence[1:]
        with self._complaining:
            self._status.content = status_html(sentence, wrong=True)
            if self._complaint is not None:
                if self._complaint[0] == sentence:
                    return
                self._complaint[1].remove()
            note = self._client.add_notification("Cannot do that", sentence, color="red")
            self._complaint = (sentence, note)

    def _withdraw(self) -> None:
        with self._complaining:
            if self._complaint is not None:
                self._complaint[1].remove()
                self._complaint = None

    def _guarded(self, job: Job) -> Job:
        """The job with its errors turned into sentences on the page."""

        def run(asked: bool) -> float | None:
            try:
                return job(asked)
            except SpherlocError as error:
                self.complain(str(error))
            except Exception as error:
                log.exception("session %s", self._client.client_id)
                self.complain(f"This is a bug in the playground ({error!r}); change a setting or reload the page.")
            return None

        return run
