"""One browser client: its own widgets, canvas, run and threads."""

import math
import time
from collections import deque
from collections.abc import Iterable
from dataclasses import replace
from operator import itemgetter
from pathlib import Path
from typing import TypeVar

import numpy as np
import viser
from numpy.typing import NDArray

from spherloc.datasets.synthetic import TrueCamera
from spherloc.diagnosis import Diagnosis, diagnose
from spherloc.errors import InputError, SpherlocError
from spherloc.estimators import default_options, estimate
from spherloc.outcome import judge
from spherloc.problem import Problem
from spherloc.trace import Trace
from spherloc.types import FloatArray
from spherloc.watch import Cancelled, Watch
from spherloc_viz.app.catalog import Run, RunRequest, SceneRequest
from spherloc_viz.app.controls.controls import Controls
from spherloc_viz.app.edits import Edits
from spherloc_viz.app.history import History
from spherloc_viz.app.link import Followed, Follower
from spherloc_viz.app.map_pictures import MapPictures
from spherloc_viz.app.page_link import PageLink
from spherloc_viz.app.page_runs import Known, PageRuns
from spherloc_viz.app.panels.export_panel import Shown
from spherloc_viz.app.panels.folders import Roots
from spherloc_viz.app.review.opened import Opened
from spherloc_viz.app.run_display import Callbacks, RunDisplay
from spherloc_viz.app.services import Services
from spherloc_viz.app.stage.canvas import panel_widths_px
from spherloc_viz.app.status import Notices, Status
from spherloc_viz.app.text import begun
from spherloc_viz.app.waits import Waits
from spherloc_viz.app.web.touch import READY, Touch, Touches
from spherloc_viz.app.web.viser_internals import at_once, follow_changes, guard_callbacks, is_linked
from spherloc_viz.app.workers import Job, LatestWorker
from spherloc_viz.layers.withheld import TOLD

QUIET_S = 0.7
"""Runs count as settled, and are recorded, when nothing has changed for this long."""
VIEWER_STILL_S = 0.3
"""The address is updated when nothing was drawn and the viewer has not moved for this long."""
DIAGNOSE_AFTER_S = 0.2
"""A diagnosis often takes longer than a run, so it starts only when the picture has not changed for this long."""

PREPARE_AFTER_S = 0.15
"""Steps around the one at hand are painted ahead when nothing was drawn for this long."""

T = TypeVar("T")


class Session:
    """Lives as long as the tab's connection.

    Threads of its own, so that steps can be walked while the next run is being solved (docs/architecture.md lists
    them). All leave the interpreter while they compute or wait.
    """

    def __init__(self, client: viser.ClientHandle, services: Services) -> None:
        self._client, self._services, self._catalog = client, services, services.catalog.branch()
        self._status = Status(client)
        guard_callbacks(client, self._status.fail)
        self._touches = Touches(self._status.fail)
        self._changes = follow_changes(client, self._touches.receive)
        number = client.client_id
        self._solver = LatestWorker(f"spherloc-solver-{number}", self._guarded(self._solve))
        self._page = LatestWorker(f"spherloc-page-{number}", self._guarded(self._show))
        self._viewer = LatestWorker(f"spherloc-viewer-{number}", self._guarded(self._follow_viewer))
        self._diagnoser = LatestWorker(f"spherloc-diagnosis-{number}", self._guarded(self._examine))
        self._pictures = MapPictures(number, self._catalog, self._status.say, self._page.ask, self._guarded)
        self._edits, self._history = Edits(), History()
        self._asked: deque[tuple[int, RunRequest | int]] = deque()
        """Requests to open, and steps through the history (-1 undo, 1 redo), that are still to be done, in their order.
        Before each of them stands the number of the change that asked for it."""
        self._roots = Roots(services.roots)
        self._follower = Follower(self._catalog, self._roots, self._problem, self._open_linked)
        self._links: deque[tuple[int, str]] = deque()
        """Links that are still to be followed; before each stands the number of the change that came before it."""
        self._followed = 0
        """How many links were followed."""
        self._run: Run | None = None
        self._answers = 0
        """The number of the newest change that the run knows, or an earlier one."""
        self._diagnosed: tuple[Trace, Diagnosis] | None = None
        self._runs = PageRuns(services.recorder, self._catalog)
        self.notices = Notices(client)
        self._due_s = -math.inf
        """When the page is to be drawn again although nothing has changed, seconds of a monotonic clock."""
        self._built = False
        """Whether all widgets are there: the first of them may be used before the last one is made."""
        left_px, right_px = panel_widths_px(client.camera.image_width)
        self._controls = Controls(client, self._catalog, services, self._touches, self, right_px)
        callbacks = Callbacks(
            self.redraw, self.select, self._move_camera, self._press_photograph, self._catalog.map_scene
        )
        self._display = RunDisplay(client, self._touches, self._controls, callbacks, (left_px, right_px))
        shown = self._status, self._controls, self._display
        self._waits = Waits(self._catalog, services.compilation, shown, lambda: self._run, self._page.ask)
        self._listen()
        self._built = True
        # Only now may the page report presses: all handlers are registered.
        client.gui.add_html(READY + self._controls.dropping)
        self._display.panels.ready()
        # And only then may it see where its address is kept.
        page = self._controls, self._display, self._edits
        self._link = PageLink(client, services, self._catalog, self._roots, page)

    def start(self) -> None:
        """Solve and show the first problem, or the recorded run that was asked for; where the page was opened by a
        link, nothing before the page has told that."""
        self._client.camera.on_update(lambda camera: self._viewer.after(VIEWER_STILL_S))
        for worker in (self._page, self._viewer, self._diagnoser, self._pictures, self._controls.slow, self._solver):
            worker.start()
        first, begin = self._services.first, self._services.begin
        if first is not None:
            self.open_recorded(first.request, first.path, first.cam_from_map)
        elif begin is not None and not is_linked(self._client):
            self.open(begin)
        elif not is_linked(self._client):
            self._solver.ask()

    def close(self) -> None:
        """End the threads; does not wait."""
        for worker in (self._solver, self._page, self._viewer, self._diagnoser, self._pictures, self._controls):
            worker.close()

    def complain(self, sentence: str) -> None:
        """Show one sentence about what went wrong; the page keeps its last run and stays usable."""
        self._status.complain(sentence)

    # What the user does. viser and the front door call these methods on threads of their own; they only note requests.

    @at_once
    def changed(self, event: object = None) -> None:
        """A widget that a run depends on was changed on the page by its user."""
        if self._built:
            self._controls.slow.outdate()
            self._display.stop_preparing()
        self._solver.ask()

    @at_once
    def redraw(self, event: object = None) -> None:
        """The page is to be drawn anew."""
        self._page.ask()

    def open(self, request: RunRequest) -> None:
        """Set the page to this request, such as a scene that a panel opens."""
        self._asked.append((self._changes.moment(), request))
        self.changed()

    def open_recorded(self, request: RunRequest, path: Path, cam_from_map: FloatArray | None) -> None:
        """Set the page to the request of a run that is recorded as ``path``, with this pose (3, 4)."""
        self._runs.expect(Known(request, path, cam_from_map))
        self.open(request)

    def step_history(self, by: int) -> None:
        """Undo (-1) or redo (+1)."""
        self._asked.append((self._changes.moment(), by))
        self.changed()

    def select(self, places: Iterable[int], extend: bool = False) -> None:
        """Select matches by their numbers in the problem."""
        run = self._run
        if run is not None:
            self._edits.select(run.kept[list(places)].tolist(), extend)
            self._page.ask()

    def _listen(self) -> None:
        self._controls.scene.reset.on_click(self._reset)
        on = self._touches.on
        on("select", self._select_numbers)
        on("deselect", lambda touch: (self._edits.select(()), self._page.ask()))
        for action, edit in (("spoil", self._edits.spoil), ("mend", self._edits.mend), ("hide", self._edits.hide)):
            on(action, lambda touch, edit=edit: (edit(), self.changed()))
        on("unhide", lambda touch: (self._edits.show_all(), self.changed()))
        on("unedit", self._take_back)
        on("link", self._note_link)
        on("numbers", self._tell_numbers)
        on("cancel", lambda touch: self._controls.slow.cancel())

    def _note_link(self, touch: Touch) -> None:
        """The browser went to an address that is a link: it is to be followed."""
        self._links.append((self._changes.moment(), touch.argument))
        self.changed()

    def _tell_numbers(self, touch: Touch) -> None:
        """A lesson that shows this page in a frame asks for the numbers of its runs."""
        self._link.in_lesson = True
        self._display.canvas.fill_page()
        self._page.ask()

    def _reset(self, event: object) -> None:
        """Take back all changes to the scene, as one step of the history."""
        self.open(RunRequest(self._controls.scene.read_unchanged(), *self._controls.estimator.read()))

    def _take_back(self, event: object) -> None:
        """Take back all changes to single matches."""
        self._edits.clear()
        self.changed()

    def _select_numbers(self, touch: Touch) -> None:
        run = self._run
        if run is not None and self._edits.select_words(touch.argument, touch.extend, run.kept):
            self._page.ask()

    def use_estimator(self, name: str) -> None:
        """Change to another estimator with its default options."""
        run = self._run
        if run is not None:
            self.open(RunRequest(run.request.scene, name, None))

    def prepare_estimator(self, name: str, watch: Watch) -> None:
        """Return when an estimator is compiled; raises ``Cancelled`` if ``watch`` ends that."""
        self._waits.for_estimator(name, watch)

    def _move_camera(self, true_camera: TrueCamera) -> None:
        self._controls.scene.true_camera = true_camera
        self.changed()

    def _press_photograph(self, layer: str, name: str) -> None:
        """Open the query of a localized sequence whose dot was pressed; show a reference beside the query at hand."""
        run = self._run
        if run is None:
            return
        if layer == "trajectory":
            self._controls.open_query(name)
            return
        scene = self._catalog.map_scene(run.request.scene.scene)
        image = next((view.path for view in scene.references if view.name == name), None) if scene else None
        references = run.trace.problem.reference_images
        if image in references:
            self._display.panels.show_reference(references.index(image))
        else:
            self._status.say(f"This query was not matched with {name}.")

    def shown(self) -> Shown | None:
        """What is on the page, to be exported."""
        run = self._run
        return self._display.shown(None if run is None else self._runs.path(run.trace))

    # What the threads do.

    def _request(self, opened: tuple[int, RunRequest] | None) -> RunRequest:
        """The request of the page after all noted openings and links, with the number of the newest change in it."""
        controls = self._controls
        if opened is not None:
            number, asked = opened
            problem = self._problem(asked.scene)
            options = asked.options or default_options(asked.estimator, problem)
            with self._changes.as_of(number):
                controls.write(replace(asked, options=options))
            self._edits.write(asked.scene)
        else:
            with self._changes.as_of(controls.scene.chosen_at):
                if controls.follow_scene():
                    controls.estimator.follow_problem(self._problem(controls.scene.read()))
        request = RunRequest(self._edits.apply(controls.scene.read()), *controls.estimator.read())
        if opened is not None:
            self._runs.became(opened[1], request)
            controls.review.became(opened[1], request)
        return request

    def _solve(self, asked: bool) -> float | None:
        """The solver thread's job: solve what the page asks for now, or record what it has settled on."""
        if not asked:
            return self._settle()
        try:
            pause = self._solve_newest()
            self._display.panels.mark_stale(False)
            return pause
        except Cancelled:
            if self._controls.slow.stopped:
                what = "choose another scene." if self._run is None else "the page still shows the run before."
                self._status.say(f"Cancelled; {what}")
            self._controls.end_opening()
            self._display.end_opening()
            return None
        except Exception:
            self._controls.end_opening()
            self._display.end_opening()
            self._display.panels.mark_stale(True)
            raise

    def _solve_newest(self) -> float | None:
        """Solve what the page asks for now, if that is not shown. Raises ``Cancelled`` if that was ended."""
        if not self._links:
            return self._solve_request()
        links = _taken(self._links)
        number, link = links[-1]
        arrived = True
        try:
            followed = self._follower.follow(link, self._shown_request(), self._link.view(self._run))
            if followed.view.answers != TOLD:
                with self._changes.as_of(number):
                    self._link.hide(followed)
            if followed.request is not None:
                self._asked.append((number, followed.request))
            pause = self._solve_request()
            self._arrive(followed, number)
            return pause
        except Cancelled:
            arrived = self._controls.slow.stopped
            raise
        finally:
            if arrived:
                self._followed += len(links)
                self._page.ask()
            else:  # the run was ended for a newer change, and is made again with it
                self._links.extendleft(reversed(links))

    def _shown_request(self) -> RunRequest:
        """The request of the run at hand; before there is one, what the page begins with."""
        if self._run is not None:
            return self._run.request
        return RunRequest(self._controls.scene.read(), *self._controls.estimator.read())

    def _arrive(self, followed: Followed, number: int) -> None:
        """A link was followed, and its run is there. ``number`` is that of the change before it."""
        with self._changes.as_of(number):
            remarks = self._link.arrive(followed, self._run)
        if remarks:
            self._status.complain(" ".join(begun(remark) for remark in remarks), lasting=True)

    def _open_linked(self, file: str) -> Opened:
        """Open the recording that a link names."""
        opened = self._controls.open_linked(file)
        self._runs.expect(Known(opened.request, opened.path, opened.recorded.cam_from_map))
        return opened

    def _solve_request(self) -> float | None:
        number, gesture = self._changes.moment(), self._changes.gesture
        self._controls.slow.renew()
        request = self._request(self._newest_opened(gesture))
        self._history.note(request, time.monotonic(), gesture)
        before = self._run
        if self._run is None or request != self._run.request:
            problem = self._problem(request.scene)
            watch = self._controls.slow.begin()
            try:
                self.prepare_estimator(request.estimator, watch)
                trace = estimate(problem, request.estimator, request.options, request.scene.seed, watch)
            finally:
                self._controls.slow.end()
            run = Run(request, trace, _kept(request, problem))
            self._run, self._answers = run, number
            self._page.ask()
            self._pictures.want(run)
        elif self._answers != number:
            self._answers = number
            self._page.ask()
        self._status.say(self._runs.announce(self._run))
        self._status.withdraw(another=self._run is not before)
        return QUIET_S

    def _newest_opened(self, gesture: int) -> tuple[int, RunRequest] | None:
        """The request to be shown after all noted openings and steps of the history, with the number of the change that
        asked for it. What was changed before a step of the history is noted first: that is what Undo takes back."""
        opened: tuple[int, RunRequest] | None = None
        for number, asked in sorted(_taken(self._asked), key=itemgetter(0)):
            if isinstance(asked, RunRequest):
                opened = number, asked
                continue
            by = asked
            try:
                self._history.note(self._request(opened), time.monotonic(), gesture)
            except InputError:
                # An invalid change is not in the history: Undo takes back this change and nothing before it.
                by = max(by, 0)
            request = self._history.step(by)
            opened = None if request is None else (number, request)
        return opened

    def _problem(self, request: SceneRequest) -> Problem:
        """The problem that the page asks for; raises ``Cancelled`` if a person ends it while the map is described."""
        return self._waits.for_problem(request)

    def _settle(self) -> float | None:
        """Record the page's run; returns the seconds to the next attempt, None if there is nothing more to do."""
        run = self._run
        if run is None:
            return None
        if not self._pictures.whole(run):  # its recording has the query image
            return QUIET_S
        self._controls.show_how_to_repeat(run)
        withheld = self._display.withheld(run)
        self._services.presented.show(run, self._mesh(run), self._diagnosis(run), withheld)
        sentence, pause = self._runs.finish(run, self._diagnosis(run))
        self._status.say(sentence, self._runs.keepable(run.trace), self._runs.untold(sentence))
        return pause

    def record(self, trace: Trace, scene: SceneRequest, anew: bool) -> None:
        """Record a run that a panel made, if runs are recorded; ``anew`` in the place of that before."""
        try:
            self._runs.record(trace, scene, anew)
        except SpherlocError as error:
            self.complain(str(error))

    def _diagnosis(self, run: Run) -> Diagnosis | None:
        """The run's diagnosis; None if it is not ready."""
        known = self._diagnosed
        return known[1] if known is not None and known[0] is run.trace else None

    def _mesh(self, run: Run) -> bytes | None:
        """The mesh of the run's map; None if the map has none or it is not ready."""
        return self._catalog.known_mesh(run.request.scene.scene)

    def _show(self, asked: bool) -> float | None:
        """The page thread's job: show the step at hand of the newest run; while there is nothing to show, paint the
        steps around it ahead."""
        left = self._due_s - time.monotonic()
        if not asked and left > 0.0:
            return 0.0 if self._display.prepare() else (left if left < math.inf else None)
        answers, followed, run = self._answers, self._followed, self._run
        if run is None:
            self._display.draw_map()
            return None
        diagnosis = self._diagnosis(run)
        withheld = self._display.withheld(run)
        self._services.presented.hide(run, withheld)
        self._status.hide_answers(bool(withheld))
        pause = self._display.draw(run, self._mesh(run), diagnosis, self._edits.places(run.kept), asked, answers)
        self._link.arrived = followed
        if self._link.in_lesson:
            self._link.write(run)
        self._viewer.after(VIEWER_STILL_S)
        if diagnosis is None:
            self._diagnoser.after(DIAGNOSE_AFTER_S)
        self._due_s = math.inf if pause is None else time.monotonic() + pause
        return PREPARE_AFTER_S if pause is None else min(pause, PREPARE_AFTER_S)

    def _follow_viewer(self, asked: bool) -> None:
        """The viewer thread's job, for when the viewer stands still: write its place into the address."""
        run = self._run
        if run is not None and self._display.step_key:
            self._link.write(run)

    def _examine(self, asked: bool) -> None:
        """The diagnosis thread's job, for when nothing has changed for a while: diagnose the newest run and show it."""
        run = self._run
        if run is None or self._diagnosis(run) is not None:
            return
        judge(run.trace)
        self._diagnosed = run.trace, diagnose(run.trace)
        self._services.presented.diagnose(*self._diagnosed)
        self._page.ask()

    def _guarded(self, job: Job) -> Job:
        """The job, with its errors shown as sentences; it knows the changes that were made before it begins."""

        def run(asked: bool) -> float | None:
            try:
                with self._changes.as_of(self._changes.now()):
                    return job(asked)
            except Exception as error:
                self._status.fail(error)
            return None

        return run


def _taken(queue: deque[T]) -> list[T]:
    """Take all items that wait in a queue, without waiting for more."""
    return [queue.popleft() for _ in range(len(queue))]


def _kept(request: RunRequest, problem: Problem) -> NDArray[np.int64]:
    """The original numbers (N,) of a problem's correspondences."""
    variation = request.scene.variation
    return variation.kept(len(problem) + len(variation.hidden))
