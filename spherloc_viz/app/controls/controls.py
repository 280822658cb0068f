"""The panel right of the canvas: its tabs Play, Compare, Sweep, Open, Recordings and Share."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import Any, Literal, Protocol

import viser

from spherloc.datasets.map_scene import MapScene
from spherloc.datasets.synthetic import SyntheticScene
from spherloc.diagnosis import Diagnosis
from spherloc.errors import InputError
from spherloc.trace import Trace
from spherloc.types import FloatArray
from spherloc.watch import Watch
from spherloc_viz import share, style
from spherloc_viz.app.catalog import Catalog, Run, RunRequest, SceneRequest
from spherloc_viz.app.controls.choices import choices_html, preset_names, story_html
from spherloc_viz.app.controls.estimator_controls import EstimatorControls
from spherloc_viz.app.controls.presets import Preset, presets
from spherloc_viz.app.controls.scene_controls import SceneControls
from spherloc_viz.app.controls.sequence_panel import SequencePanel
from spherloc_viz.app.glossary import heading_html
from spherloc_viz.app.panels.compare_panel import ComparePanel
from spherloc_viz.app.panels.export_panel import ExportPanel, Shown
from spherloc_viz.app.panels.open_panel import OpenedScene, OpenPanel
from spherloc_viz.app.panels.recordings_panel import RecordingsPage, RecordingsPanel
from spherloc_viz.app.panels.sweep_runs_panel import SweepPanel
from spherloc_viz.app.review.opened import Opened
from spherloc_viz.app.review.reviewer import ReviewCard
from spherloc_viz.app.said_together import SaidTogether
from spherloc_viz.app.services import Services
from spherloc_viz.app.stage import views
from spherloc_viz.app.text import box
from spherloc_viz.app.web.touch import Touches
from spherloc_viz.app.web.viser_internals import at_once, put, update_widget
from spherloc_viz.app.workers import LatestWorker
from spherloc_viz.layers.primitives import SceneItem
from spherloc_viz.layers.scene import trajectory_items
from spherloc_viz.layers.withheld import HIDDEN, ONLY_OUTCOME, TOLD, withheld_by
from spherloc_viz.recording.replay import Reopened

PROJECTOR = (
    '<div class="words" style="padding:.2em .8em .3em"><button class="projector-toggle" title="The canvas, what the '
    'step says in large type, and the view that goes with it">Projector view, key L</button> '
    '<a href="/learn" target="_blank" title="Lessons beside the live canvas" style="font-size:13.5px;margin-left:.4em;'
    'white-space:nowrap">Learn how it works</a></div>'
)


class DisplayControls:
    """View buttons, whether the view follows the steps, dark or light, and a switch for each layer."""

    def __init__(self, gui: viser.GuiApi, changed: Callable[[object], None]) -> None:
        self._changed = changed
        self._wanted: str | None = None
        self.times_hidden = 0
        """How often the answers were hidden or shown."""
        self._outcome_told = False
        """Whether of hidden answers the outcome is told all the same, as links can ask for."""
        self._views = gui.add_button_group("View", views.NAMES)
        self._dark = gui.add_checkbox("Dark", True, hint="Dark for a screen, light for a projector and for print.")
        gui.add_html(PROJECTOR)
        self._hide = gui.add_checkbox(
            "Hide answers", False, hint="No truth, no outcome and no comparison, until each is asked for."
        )
        with gui.add_folder("Layers", expand_by_default=False):
            self._follow = gui.add_checkbox("Follow steps", True, hint="Move to where the step's subject reads best.")
            self._layers = {name: gui.add_checkbox(name.capitalize(), True) for name in style.LAYERS}
        self._views.on_click(self._press)
        self._hide.on_update(self._hide_or_show)
        for widget in (self._dark, *self._layers.values()):
            widget.on_update(changed)

    @property
    def theme(self) -> Literal["dark", "light"]:
        """Settings of how the page looks."""
        return "dark" if self._dark.value else "light"

    @theme.setter
    def theme(self, theme: str) -> None:
        put(self._dark, theme == "dark")

    @property
    def answers(self) -> str:
        """Which answers are told: one of the words of ``layers.withheld``."""
        hidden = ONLY_OUTCOME if self._outcome_told else HIDDEN
        return hidden if self._hide.value else TOLD

    @answers.setter
    def answers(self, word: str) -> None:
        put(self._hide, word != TOLD)
        self._outcome_told = word == ONLY_OUTCOME

    @property
    def withheld(self) -> frozenset[str]:
        """The answers that are hidden, of all runs."""
        return withheld_by(self.answers)

    @property
    def follow(self) -> bool:
        """Whether the view follows the steps."""
        return self._follow.value

    def layers(self) -> frozenset[str]:
        """Layers that are switched on."""
        return frozenset(name for name, widget in self._layers.items() if widget.value)

    @property
    def wanted_view(self) -> str | None:
        """The view that ``take_view`` will return."""
        return self._wanted

    def take_view(self) -> str | None:
        """The view that was asked for since the last call, if any."""
        wanted, self._wanted = self._wanted, None
        return wanted

    @at_once
    def _hide_or_show(self, event: viser.GuiEvent) -> None:
        self.times_hidden += 1
        self._outcome_told = False
        self._changed(event)

    @at_once
    def _press(self, event: viser.GuiEvent) -> None:
        self._wanted = event.target.value
        self._changed(event)


UNDO, REDO, NEW_SEED = "Undo", "Redo", "New seed"


class Owner(Protocol):
    """Functions of the session that the controls call."""

    def changed(self, event: object = None) -> None:
        """Something that a run depends on was changed."""

    def redraw(self, event: object = None) -> None:
        """Something that is shown was changed."""

    def open(self, request: RunRequest) -> None:
        """Ask for this."""

    def use_estimator(self, name: str) -> None:
        """Go on with another estimator."""

    def prepare_estimator(self, name: str, watch: Watch) -> None:
        """Return when an estimator is compiled; raises ``Cancelled`` if ``watch`` ends that."""

    def step_history(self, by: int) -> None:
        """Undo (-1) or redo (+1)."""

    def open_recorded(self, request: RunRequest, path: Path, cam_from_map: FloatArray | None) -> None:
        """Ask for a run that is recorded already, as ``path`` and with this pose (3, 4)."""

    def record(self, trace: Trace, scene: SceneRequest, anew: bool) -> None:
        """Record a run that a panel made of a scene."""

    def shown(self) -> Shown | None:
        """What is on the page."""


class Controls:
    """One client's controls. Widgets only note requests; the session's threads act on them."""

    def __init__(
        self,
        client: viser.ClientHandle,
        catalog: Catalog,
        services: Services,
        touches: Touches,
        owner: Owner,
        width_px: int,
    ) -> None:
        gui = client.gui
        self._catalog, self._owner = catalog, owner
        self._sequence: SceneRequest | None = None
        """What the sequence that was started last is of."""
        self._presets = presets(catalog)
        self._told: Preset | None = None
        """The preset that was shown last, for as long as its scene is shown."""
        self._opening = False
        """Whether another scene than that of the widgets is being opened."""
        self.slow = SlowRun(gui, f"spherloc-clock-{client.client_id}")
        self._moves = gui.add_button_group("", (UNDO, REDO, NEW_SEED))
        self._moves.on_click(self._move)
        self.review = ReviewCard(owner.redraw)
        tabs = gui.add_tab_group()
        with self._tab(gui, tabs, "Play"):
            self._build_play(gui, touches, services.library and services.library.folder)
        with self._tab(gui, tabs, "Compare"):
            gui.add_html(heading_html("Several estimators on this problem", "estimator"))
            self.compare = ComparePanel(gui, touches, owner.use_estimator, owner.redraw, owner.prepare_estimator)
        with self._tab(gui, tabs, "Sweep"):
            gui.add_html(heading_html("From where on does an estimator fail?", "sweep"))
            self._sweep = SweepPanel(gui, touches, self._chosen_sweep, services.recorder)
        with self._tab(gui, tabs, "Open"):
            about = "Other scenes, your own matches, and your own photographs: drop a folder onto the page"
            gui.add_html(heading_html(about, "scene"))
            self._open = OpenPanel(
                gui, client, touches, services.roots, self._open_scene, self._scene_file, drops=services.drops
            )
        with self._tab(gui, tabs, "Recordings"):
            gui.add_html(heading_html("Recorded runs, and a gallery of failures", "recording"))
            page = RecordingsPage(services.roots, self._enter, owner.open, owner.open_recorded, services.downloads)
            self._recordings = RecordingsPanel(gui, client, touches, services.library, self.review, page)
        with self._tab(gui, tabs, "Share"):
            self._export = ExportPanel(gui, client, owner.shown)
        undo: Any = gui.add_command(UNDO, hotkey="Z", modifier="cmd/ctrl")
        redo: Any = gui.add_command(REDO, hotkey="Z", modifier="cmd/ctrl+shift")
        undo.on_trigger(lambda event: owner.step_history(-1))
        redo.on_trigger(lambda event: owner.step_history(1))
        gui.main_panel.dock_right()
        gui.main_panel.set_width(width_px)

    @contextmanager
    def _tab(self, gui: viser.GuiApi, tabs: viser.GuiTabGroupHandle, name: str) -> Iterator[None]:
        """The content of a tab, which begins with the review at hand; the page reports whether it can be seen."""
        with tabs.add_tab(name):
            gui.add_html(f'<div data-view="{name}" data-side></div>')
            self.review.stand(gui)
            yield

    def _build_play(self, gui: viser.GuiApi, touches: Touches, results: Path | None) -> None:
        gui.add_html(heading_html("Drag a slider: each move is solved at once", "estimator"))
        self._preset = gui.add_dropdown(
            "Preset",
            preset_names(self._presets, False),
            hint="Each sets a scene, an estimator and its options, and shows one thing.",
        )
        self._preset.on_update(self._choose_preset)
        self._choices = gui.add_html("")
        self._story = gui.add_html("", visible=False)
        self.scene = SceneControls(gui, self._catalog, self._owner.changed)
        self._movable = gui.add_checkbox("Drag the camera", False, hint="Handles on the true camera move and turn it.")
        self._movable.on_update(self._owner.redraw)
        self._edits = gui.add_html("", visible=False)
        self.estimator = EstimatorControls(gui, self._owner.changed)
        ask = self._chosen_sequence, self._localized, self.open_query
        self.sequence = SequencePanel(gui, touches, results, *ask)
        self.display = DisplayControls(gui, self._owner.redraw)

    @property
    def camera_movable(self) -> bool:
        """Whether the true camera can be dragged."""
        return self._movable.value and self._movable.visible

    @property
    def dropping(self) -> str:
        """HTML that lets photographs be dropped onto the page."""
        return self._open.dropping

    def close(self) -> None:
        """End what runs; does not wait."""
        for part in (self.slow, self.sequence, self.compare, self._sweep, self._open, self._recordings, self._export):
            part.close()

    def follow_scene(self) -> bool:
        """If another scene was chosen, show what it offers, and tell so."""
        another = self.scene.follow_scene()
        if another:
            self._show_scene(self.scene.read().scene)
        return another

    def begin_opening(self, label: str) -> None:
        """Until this scene is at hand, or ``end_opening``, offer nothing for change that belongs to another one."""
        if label != self.scene.at_hand:
            self._opening = True
            self.scene.offer(False)
            self._movable.visible = False
            self.sequence.offer(False)

    def end_opening(self) -> None:
        """The opening has ended without a new run: offer what the scene before has."""
        if self._opening and self.scene.at_hand:
            self.scene.offer(True)
            self._show_scene(self.scene.at_hand)

    def write(self, request: RunRequest) -> None:
        """Show this; raises ``InputError`` if it cannot be."""
        self.scene.write(request.scene)
        self.estimator.write(request.estimator, request.options)
        self._show_scene(request.scene.scene)

    def items(self, run: Run, hidden: bool) -> tuple[SceneItem, ...]:
        """What the canvas shows beside a run: cameras of other estimators, recorded ones, and those of a sequence.

        All of them are answers, which ``hidden`` leaves out.
        """
        return () if hidden else self.compare.items(run.trace) + self.review.items(run) + self._trajectory(run)

    def said_together(self, run: Run) -> SaidTogether | None:
        """What the queries of the run's scene, judged by each other, say of this one; None if nothing."""
        label = run.request.scene.scene
        scene = self._catalog.map_scene(label)
        if scene is None or not self.sequence.rows(label):
            return None
        return self.sequence.said_of(label, scene, run.request.scene.query, run.trace.cam_from_map)

    def draw(self, run: Run, diagnosis: Diagnosis | None, hidden: bool) -> None:
        """Show what belongs to the newest run; ``diagnosis`` is None until it is ready; ``hidden`` hides answers."""
        self._follow_preset(run.request, hidden)
        self.scene.name_scene(run.request.scene)
        scene = self._catalog.synthetic(run.request.scene.scene)
        html = "" if self._opening else _changes_html(run, scene, hidden)
        if self._edits.content != html:
            self._edits.content, self._edits.visible = html, bool(html)
        images = self._catalog.map_scene(run.request.scene.scene)
        self.sequence.mark("" if images is None else images.query(run.request.scene.query).name)
        self.compare.draw(run.trace, hidden)
        self.review.draw(run, diagnosis, hidden)
        for part in (self._sweep, self.sequence, self._recordings, self._export):
            part.hide_answers(hidden)

    def show_how_to_repeat(self, run: Run) -> None:
        """Say how to repeat a run that the page has settled on."""
        request, scene = run.request, run.request.scene
        words = (scene.seed, scene.query, scene.variation, request.estimator, request.options)
        path = self._catalog.path(scene.scene)
        self._export.draw(share.as_python(path, *words), share.as_command(path, *words))

    def _trajectory(self, run: Run) -> tuple[SceneItem, ...]:
        """The sequence that was localized in the scene at hand, if any."""
        label = run.request.scene.scene
        scene, rows = self._catalog.map_scene(label), self.sequence.rows(label)
        if scene is None or not rows:
            return ()
        return trajectory_items(rows, run.trace.problem.aligned.map_turn, scene.thresholds[-1][1])

    def _show_scene(self, label: str) -> None:
        self._opening = False
        self.sequence.show(label, self._catalog.map_scene(label), self._catalog.path(label))
        self._movable.visible = self._catalog.synthetic(label) is not None

    def _follow_preset(self, request: RunRequest, hidden: bool) -> None:
        """Show the preset's name for as long as the page is as it says, and its story for as long as its scene is
        shown, so that a slider that changes the preset does not move under the pointer. Both are answers."""
        names = preset_names(self._presets, hidden)
        if self._preset.options != names:
            self._preset.options = names
        asked = (RunRequest(preset.scene, preset.estimator, preset.options) for preset in self._presets)
        place = next((place for place, one in enumerate(asked, 1) if one == request), 0)
        if self._preset.value != names[place]:
            put(self._preset, names[place])
        if place > 0:
            self._told = self._presets[place - 1]
        elif self._told is not None and self._told.scene.scene != request.scene.scene:
            self._told = None
        html = "" if hidden or self._told is None else story_html(self._told, changed=place == 0)
        update_widget(self._choices, content=choices_html(self._presets, self._catalog, hidden))
        if self._story.content != html:
            self._story.content, self._story.visible = html, bool(html)

    @at_once
    def _choose_preset(self, event: viser.GuiEvent) -> None:
        place = self._preset.options.index(event.target.value)
        if event.client is not None and place > 0:
            preset = self._presets[place - 1]
            self._owner.open(RunRequest(preset.scene, preset.estimator, preset.options))

    @at_once
    def _move(self, event: viser.GuiEvent) -> None:
        button = event.target.value
        if button == NEW_SEED:
            self.scene.next_seed()
            self._owner.changed()
        else:
            self._owner.step_history(-1 if button == UNDO else 1)

    def _scene_file(self) -> Path:
        """The file of the scene that the page shows."""
        return self._catalog.path(self.scene.read().scene)

    def _open_scene(self, opened: OpenedScene) -> None:
        label = self._catalog.add(opened.scene, opened.path, opened.label)
        seed = getattr(opened.scene, "seed", 0)
        estimator, _ = self.estimator.read()
        self._owner.open(RunRequest(SceneRequest(label, seed), estimator, None))

    def open_linked(self, file: str) -> Opened:
        """Open a recording to which a link leads; raises ``RecordingError`` if it cannot be."""
        return self._recordings.open_linked(file)

    def _enter(self, got: Reopened) -> RunRequest:
        """Offer a reopened scene, and request for its run."""
        label = self._catalog.enter(got.scene, got.path, got.label, brief=not got.live)
        return RunRequest(SceneRequest(label, got.seed, got.query, got.variation), got.estimator, got.options)

    def _chosen_sequence(self) -> tuple[str, MapScene, str, Any, int]:
        """What the sequence panel localizes; raises ``InputError`` if the page says nothing that can be."""
        request = self.scene.read()
        scene = self._catalog.map_scene(request.scene)
        if scene is None:
            raise InputError("this scene has no query images; choose one that has.")
        self._sequence = request
        return request.scene, scene, *self.estimator.read(), request.seed

    def open_query(self, name: str) -> None:
        """Go on with another query of the scene at hand."""
        request = self.scene.read_unchanged()
        self._owner.open(RunRequest(replace(request, query=name), *self.estimator.read()))

    def _localized(self, trace: Trace | None, anew: bool) -> None:
        """One more query of a sequence is done, or one that was done before is tried anew."""
        request = self._sequence
        if trace is not None and request is not None:
            images = self._catalog.map_scene(request.scene)
            views = () if images is None else images.queries
            query = next((view.name for view in views if view.path == trace.problem.image), None)
            self._owner.record(trace, replace(request, query=query), anew)
        self._owner.redraw()

    def _chosen_sweep(self) -> tuple[Path, SceneRequest]:
        request = self.scene.read()
        return self._catalog.path(request.scene), request


DONE = {"spoiled": "made wrong", "mended": "made right", "hidden": "hidden"}
"""What was done to single matches, by the field of a variation, in words."""


def _changes_html(run: Run, scene: SyntheticScene | None, hidden: bool) -> str:
    """What is not as the file of the scene has it, and what was done to single matches; empty if nothing was.
    ``hidden`` says only that something was done."""
    variation, parts = run.request.scene.variation, []
    told = () if scene is None or hidden else variation.words(scene)
    if told:
        parts.append(f"Changed from the scene: {escape(', '.join(told))}")
    done = [f"{len(getattr(variation, name))} {words}" for name, words in DONE.items() if getattr(variation, name)]
    if done:
        links = [("unedit:", "take back")] + [("unhide:", "show hidden")] * bool(variation.hidden)
        ways = " · ".join(f'<u data-touch="{action}" role="button" tabindex="0">{words}</u>' for action, words in links)
        what = "Matches were changed by hand" if hidden else f"Matches by hand: {', '.join(done)}"
        parts.append(f"{what}. {ways}")
    return box("".join(f"<div>{part}</div>" for part in parts), "font-size:12px") if parts else ""


AFTER_S = 0.4
"""A run that takes longer shows its progress, and is ended by a newer request. Shorter runs are finished: else
nothing would be shown while a slider is dragged."""
EVERY_S = 0.1


class SlowRun:
    """One session's progress bar and cancel button."""

    def __init__(self, gui: viser.GuiApi, name: str) -> None:
        self._bar = gui.add_progress_bar(0.0, visible=False)
        self._button = gui.add_button("Cancel", visible=False, color="red")
        self._button.on_click(lambda event: self.cancel())
        self._lock = threading.Lock()
        self._watch: Watch | None = None
        self._outdated = False
        self._stopped = self._lasting = False
        self._clock = LatestWorker(name, self._tick)

    def start(self) -> None:
        """Start the clock."""
        self._clock.start()

    def close(self) -> None:
        """End the run at hand and the clock; does not wait."""
        self._clock.close()
        with self._lock:
            if self._watch is not None:
                self._watch.cancel()

    def renew(self) -> None:
        """The page's request is about to be read: only changes after this make the next run outdated."""
        self._outdated = False

    def begin(self, lasting: bool = False) -> Watch:
        """A run begins; returns the watch that can end it. A ``lasting`` run is not ended by newer requests."""
        with self._lock:
            self._watch, self._stopped, self._lasting = Watch(), False, lasting
            watch = self._watch
        self._clock.after(AFTER_S)
        return watch

    def end(self) -> None:
        """The run has ended."""
        with self._lock:
            self._watch = None
        if self._bar.visible:
            self._clock.ask()

    def outdate(self) -> None:
        """Something newer is asked for."""
        self._outdated = True

    @property
    def stopped(self) -> bool:
        """Whether the user ended the last run."""
        return self._stopped

    def cancel(self) -> None:
        """The user cancels the run at hand."""
        with self._lock:
            if self._watch is not None:
                self._stopped = True
                self._watch.cancel()

    def _tick(self, asked: bool) -> float | None:
        with self._lock:
            watch = self._watch
        slow = watch is not None and not asked
        if watch is not None and slow:
            if self._outdated and not self._lasting:
                watch.cancel()
            self._bar.value = 100.0 * watch.fraction
        if self._bar.visible != slow and (slow or watch is None):
            self._bar.visible = self._button.visible = slow
        if watch is None:
            return None
        return AFTER_S if asked else EVERY_S
