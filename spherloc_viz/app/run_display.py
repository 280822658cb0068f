"""All that a page shows of a run: the canvas, the story beside it, and the card of what is selected."""

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Protocol

import numpy as np
import viser

from spherloc.datasets.map_scene import MapScene
from spherloc.datasets.synthetic import TrueCamera
from spherloc.diagnosis import Diagnosis
from spherloc.metrics import evaluate
from spherloc.outcome import Judgement, known_judgement
from spherloc.trace import Trace
from spherloc.types import FloatArray
from spherloc_viz.app.catalog import Run
from spherloc_viz.app.controls.controls import DisplayControls
from spherloc_viz.app.left_panels import LeftPanels
from spherloc_viz.app.matches.match_card import MatchCard
from spherloc_viz.app.panels.export_panel import Shown
from spherloc_viz.app.plots.graph_view import CLIQUE_STEP
from spherloc_viz.app.said_together import SaidTogether
from spherloc_viz.app.stage.canvas import Canvas, canvas_width_px, panel_widths_px, text_scale
from spherloc_viz.app.stage.subjects import walk_at_end
from spherloc_viz.app.text import (
    ToldBeside,
    cause_html,
    evidence_html,
    hidden_html,
    key_step_html,
    status_html,
    summary_of,
)
from spherloc_viz.app.web.touch import Touch, Touches, pixels_of
from spherloc_viz.app.web.viser_internals import changes_of, sent_at_once, set_theme
from spherloc_viz.layers import paint, steps, with_alternative
from spherloc_viz.layers.key_step import key_step
from spherloc_viz.layers.outcome import early_table
from spherloc_viz.layers.point_cloud import cloud_items, with_few_rays
from spherloc_viz.layers.primitives import Label, Picture, SceneItem, Segments, StepHeading, Table
from spherloc_viz.layers.scale_bar import scale_bar
from spherloc_viz.layers.selection import with_selection
from spherloc_viz.layers.where_taken import where_taken
from spherloc_viz.layers.withheld import ANSWERS, OUTCOME, untold

START_THEME = "dark"
MAX_AHEAD = 22
"""Number of steps around the one at hand that are painted before they are asked for; less than what is kept of a run's
pictures."""
NAMED_AT = frozenset({"Matches", "Outcome"})
"""Stages at whose steps references have their names in the canvas: elsewhere these cover what the step is about."""


class Panel(Protocol):
    """What ``RunDisplay`` needs of the panel right of the canvas."""

    @property
    def display(self) -> DisplayControls:
        """What of the canvas is shown."""
        ...

    @property
    def camera_movable(self) -> bool:
        """Whether the true camera can be dragged."""
        ...

    def items(self, run: Run, hidden: bool) -> tuple[SceneItem, ...]:
        """What the canvas shows beside a run; ``hidden`` leaves out what would tell the answers."""
        ...

    def said_together(self, run: Run) -> SaidTogether | None:
        """What other queries say of that of a run; None if nothing."""
        ...

    def draw(self, run: Run, diagnosis: Diagnosis | None, hidden: bool) -> None:
        """Show the settings of this run; if ``hidden``, show nothing that gives an answer away."""
        ...


@dataclass(frozen=True)
class Callbacks:
    """Functions that ``RunDisplay`` calls when the user does something on it."""

    redraw: Callable[[object], None]
    """The page is to be drawn anew."""
    select: Callable[[Iterable[int], bool], None]
    """Matches were selected, by their numbers in the problem; or, if true, are to be added to what is."""
    move: Callable[[TrueCamera], None] | None
    """The true camera was dragged to a new place; None where it may not be."""
    photograph: Callable[[str, str], None]
    """The dot of a photograph was pressed: its layer, and the photograph's name."""
    scene_of: Callable[[str], MapScene | None]
    """The scene with images of that label, if it is one."""


PROJECTED = 1.7
"""How many times as large labels are in the projector view: they are read from the last row."""


class RunDisplay:
    """One client's page. Everything is drawn on the session's page thread."""

    def __init__(
        self,
        client: viser.ClientHandle,
        touches: Touches,
        controls: Panel,
        callbacks: Callbacks,
        widths_px: tuple[int, int],
    ) -> None:
        """``widths_px`` are those of the panels left and right of the canvas."""
        self._client, self.controls = client, controls
        window_px = client.camera.image_width
        select, movable = callbacks.select, callbacks.move is not None
        self.panels = LeftPanels(
            client.gui,
            touches,
            callbacks.redraw,
            lambda chosen: select(chosen, False),
            callbacks.scene_of,
            widths_px[0],
        )
        self.card = MatchCard(client.gui, movable, text_scale(window_px), canvas_width_px(window_px))
        moved = callbacks.move or (lambda place: None)
        self.canvas = Canvas(client, self.controls.display, select, moved, callbacks.photograph, sum(widths_px))
        self._widths_px = widths_px
        self._shown: tuple[Run, bytes | None, Picture] | None = None
        self._map: tuple[str, MapScene, bytes | None] | None = None
        """The scene that is being opened: label, scene and mesh."""
        self._revealed: tuple[Run | None, int, frozenset[str]] = None, 0, frozenset()
        """A run, how often answers had been hidden or shown, and which were then asked for although hidden."""
        self._blind: tuple[Run, frozenset[str], Run] | None = None
        """A run, what is withheld of it, and the same without that."""
        self._around: tuple[MapScene, FloatArray, tuple[SceneItem, ...]] | None = None
        """A scene, how its map is turned, and its points and references."""
        self._outcome: tuple[Trace, Judgement | None, Table] | None = None
        self._to_prepare: deque[Callable[[], None]] = deque()
        """What paints the steps around the one at hand, the nearest first."""
        self._scene_of = callbacks.scene_of
        self._theme = START_THEME
        self._redraw = callbacks.redraw
        touches.on("reveal", self._reveal)
        touches.on("projector", self._project)
        touches.on("window", self._fit_window)

    def withheld(self, run: Run) -> frozenset[str]:
        """Which of ``ANSWERS`` this page hides of a run."""
        return self.controls.display.withheld - self._told(run)

    def _told(self, run: Run) -> frozenset[str]:
        """Which answers of a run the user asked for since answers were hidden."""
        of, times, told = self._revealed
        return told if of is run and times == self.controls.display.times_hidden else frozenset()

    def _reveal(self, touch: Touch) -> None:
        """Show one answer of the shown run, until answers are hidden again or another run is shown."""
        if self._shown is not None:
            run = self._shown[0]
            told = self._told(run) | ANSWERS & {touch.argument}
            self._revealed = run, self.controls.display.times_hidden, told
            self._redraw(touch)

    def _project(self, touch: Touch) -> None:
        """Begin the projector view, whose panel the page has widened; 0 ends it."""
        self.canvas.enlarge_labels(1.0 if touch.argument == "0" else PROJECTED)

    def _fit_window(self, touch: Touch) -> None:
        """The window has another width, as after zooming or on another screen: fit the panels and the text to it."""
        window_px = pixels_of(touch)
        widths_px, scale = panel_widths_px(window_px), text_scale(window_px)
        if window_px:
            self.card.fit(scale, canvas_width_px(window_px))
        if window_px and widths_px != self._widths_px:
            self._widths_px = widths_px
            self.panels.fit(widths_px[0])
            self._client.gui.main_panel.set_width(widths_px[1])
            self.canvas.fit_text(scale)

    def open_map(self, label: str, scene: MapScene, mesh: bytes | None) -> None:
        """Until a run of this scene is drawn, show its map in place of the run at hand."""
        self._map = label, scene, mesh

    def draw_map(self) -> None:
        """Show the map of what is opened before there is any run."""
        if self._map is not None:
            with sent_at_once(self._client):
                self.canvas.draw_map(*self._map)

    def end_opening(self) -> None:
        """The opening has ended without a new run: show the scene before."""
        self._map = None
        self.panels.end_opening()

    def draw(
        self,
        run: Run,
        mesh: bytes | None,
        diagnosis: Diagnosis | None,
        selected: tuple[int, ...],
        asked: bool,
        answers: int,
        presenter: frozenset[str] = frozenset(),
    ) -> float | None:
        """Show the step at hand of a run, whose map has that mesh; returns seconds to the next step if they play.

        ``selected`` are numbers in the problem, and ``diagnosis`` is None for as long as there is none. ``asked`` is
        false if only time has passed. The run answers the changes up to the number ``answers``. ``presenter``
        are the answers that a presenter hides, besides those that this page does.
        """
        controls, known = self.controls, run
        withheld = presenter | self.withheld(run)
        hidden, told = bool(withheld), OUTCOME not in withheld
        run = self._untold(run, withheld)
        trace = run.trace
        timeline = steps(trace, told)
        index, pause = self._advance(run, timeline, asked)
        picture, last = paint(trace, index, told), index == len(timeline) - 1
        diagnosis = None if hidden else diagnosis
        alternative = None if diagnosis is None else diagnosis.alternative_cam_from_map
        if last and alternative is not None:
            picture = with_alternative(picture, trace, alternative)
        if last and self._scene_of(run.request.scene.scene) is not None:
            picture = with_few_rays(picture, int(np.count_nonzero(trace.inlier_mask)))
        drawn = self._with_surroundings(
            with_selection(picture, trace, selected), run, controls.items(known, hidden), last
        )
        self._shown = known, mesh, drawn
        with sent_at_once(self._client):
            self._follow_theme()
            with changes_of(self._client.gui).as_of(answers):
                if self._map is not None and self._map[0] != run.request.scene.scene:
                    self.canvas.draw_map(*self._map)
                else:
                    self._map = None
                    self.canvas.draw(run, drawn, mesh, controls.camera_movable)
                controls.draw(known, diagnosis, hidden)
            # The other views take the inliers from the colours of the picture before anything is hidden.
            plain = replace(picture, step=drawn.step)
            outcome = self._outcome_of(trace, known_judgement(known.trace))
            offered = hidden_html(withheld, not presenter) if withheld else ""
            where = self._where(run) if last and not hidden else ""
            cause = str(diagnosis.cause) if diagnosis is not None and diagnosis.doubtful else ""
            together = None if hidden else controls.said_together(known)
            words = ToldBeside(cause, where, together)
            self.panels.draw(run, plain, pause is not None, outcome, selected, not told, offered, words)
            self.panels.diagnose(*("", "") if hidden else _diagnosed_html(trace, diagnosis, index))
            right = partial(self.canvas.card_is_right, drawn)
            # While another scene opens, matches of the one before are not offered for change.
            carded = () if self.panels.opens_another else selected
            self.card.draw(trace, carded, run.kept, alternative, right, not told)
        nearest = sorted(range(len(timeline)), key=lambda other: (abs(other - index), index - other))
        self._to_prepare = deque(
            partial(self._paint_ahead, run, other, selected, told) for other in nearest[1 : 1 + MAX_AHEAD]
        )
        return self.canvas.check() if pause is None else pause

    def _advance(self, run: Run, timeline: tuple[StepHeading, ...], asked: bool) -> tuple[int, float | None]:
        """The number of the step to show, and seconds to the next one if they play."""
        at_hand = self._shown[2].step.stage if self._shown is not None else ""
        balls = self.controls.display.wanted_view == "Balls" and at_hand != "Translation"
        if balls and any(step.key == CLIQUE_STEP for step in timeline):
            self.panels.steps.go(CLIQUE_STEP)
        if self._opens_photographs(run):
            self.panels.steps.begin_at(timeline[-1].key)
        return self.panels.steps.advance(timeline, asked)

    def _with_surroundings(self, picture: Picture, run: Run, beside: tuple[SceneItem, ...], last: bool) -> Picture:
        """The picture of a step, which may be the ``last``, with what is ``beside`` the run and with its map."""
        names = {item.name for item in beside if isinstance(item, Label) and item.layer == "trajectory"}
        # Where queries are named, the name of the ellipsoid would lie over that of the one at hand.
        left_out = {"uncertainty/sigmas"} if names and picture.step.stage in NAMED_AT else names
        scene = picture.scene + beside + self._cloud(run, picture.step.stage)
        if last and not names:
            scene += self._query_name(run, picture)
        picture = replace(picture, scene=tuple(item for item in scene if item.name not in left_out))
        walk = walk_at_end(picture) if last else None
        if walk is None:
            return picture
        box = np.stack([walk.min(axis=0), walk.max(axis=0)])
        return replace(picture, scene=(*picture.scene, *scale_bar("walk", box, run.trace.problem.metric)))

    def prepare(self) -> bool:
        """Paint one of the steps that may be asked for next; false if there is none that is not painted."""
        try:
            paint_one = self._to_prepare.popleft()
        except IndexError:
            return False
        paint_one()
        return True

    def stop_preparing(self) -> None:
        """Paint no step ahead until the next picture; on any thread."""
        self._to_prepare.clear()

    def _paint_ahead(self, run: Run, index: int, selected: tuple[int, ...], told: bool) -> None:
        self.panels.prepare(run, paint(run.trace, index, told), selected, not told)

    def _opens_photographs(self, run: Run) -> bool:
        """Whether this is the first run on the page of a map of photographs, of which is asked first where they were
        taken."""
        known = self._shown is not None and self._shown[0].request.scene.scene == run.request.scene.scene
        return not known and self._photographs(run) is not None

    def _photographs(self, run: Run) -> MapScene | None:
        """The run's scene, if it is a map of photographs."""
        scene = self._scene_of(run.request.scene.scene)
        return None if scene is None or scene.cloud is None else scene

    def _where(self, run: Run) -> str:
        """Where the query of a map of photographs was taken."""
        scene = self._photographs(run)
        return "" if scene is None else where_taken(scene, run.trace)

    def _outcome_of(self, trace: Trace, judged: Judgement | None) -> Table:
        """The table of the outcome, which is the same at all steps."""
        if self._outcome is None or self._outcome[0] is not trace or self._outcome[1] is not judged:
            self._outcome = trace, judged, early_table(trace, judged)
        return self._outcome[2]

    def _cloud(self, run: Run, stage: str) -> tuple[SceneItem, ...]:
        """The points of the run's map and its references, with their names where the whole map is the subject."""
        scene, turn = self._scene_of(run.request.scene.scene), run.trace.problem.aligned.map_turn
        if scene is None:
            return ()
        if self._around is None or self._around[0] is not scene or not np.array_equal(self._around[1], turn):
            self._around = scene, turn, cloud_items(scene, turn)
        items = self._around[2]
        return items if stage in NAMED_AT else tuple(item for item in items if not isinstance(item, Label))

    def _query_name(self, run: Run, picture: Picture) -> tuple[SceneItem, ...]:
        """The name of the query of a map of photographs, over its camera."""
        scene, query = self._photographs(run), run.request.scene.query
        camera = next((item for item in picture.scene if item.name == "cameras/estimate"), None)
        if scene is None or query is None or not isinstance(camera, Segments):
            return ()
        (x, y, z), top = camera.points[0, 0], float(camera.points[..., 1].min())  # y points down
        return (Label("cloud/query", "cameras", np.array([x, top - 0.2 * (y - top), z]), query),)

    def _untold(self, run: Run, withheld: frozenset[str]) -> Run:
        """The run without what is withheld of it."""
        if not withheld:
            return run
        if self._blind is None or self._blind[0] is not run or self._blind[1] != withheld:
            self._blind = run, withheld, replace(run, trace=untold(run.trace, withheld))
        return self._blind[2]

    @property
    def step_key(self) -> str:
        """Key of the step at hand; empty before the first picture."""
        return "" if self._shown is None else self._shown[2].step.key

    def shown(self, recorded: Path | None) -> Shown | None:
        """What is on the page, to be exported; ``recorded`` is the run's recording, if there is one."""
        if self._shown is None:
            return None
        (run, mesh, picture), display = self._shown, self.controls.display
        trace, layers = run.trace, display.layers()
        words, facts = summary_of(trace)
        hidden = bool(self.withheld(run))
        outcome = "" if hidden else f" · {words.capitalize()} · {' · '.join(facts)}"
        return Shown(
            trace=trace,
            items=tuple(item for item in picture.scene if item.layer in layers),
            backdrop=mesh if "mesh" in layers else None,
            title=f"{len(trace.problem)} matches" if hidden else trace.problem.name,
            note=f"{picture.step.title} · {trace.estimator}, seed {trace.seed}{outcome}",
            recorded=recorded,
            dark=display.theme == "dark",
        )

    def _follow_theme(self) -> None:
        theme = self.controls.display.theme
        if theme != self._theme:
            self._theme = theme
            set_theme(self._client.gui, theme)


def _diagnosed_html(trace: Trace, diagnosis: Diagnosis | None, index: int) -> tuple[str, str]:
    """What the step at ``index`` says of a run's diagnosis, above and below its own words; the diagnosis is None until
    there is one. The last step says it, those before it where to look, since nothing that the cause speaks of has
    been shown there."""
    timeline = steps(trace)
    if index == len(timeline) - 1:
        return (
            ("", status_html("Diagnosing …"))
            if diagnosis is None
            else (cause_html(diagnosis), evidence_html(diagnosis))
        )
    if diagnosis is None or not diagnosis.doubtful:
        return "", ""
    # Of a run that succeeded, the key step is where its consensus was found.
    success = evaluate(trace).success
    key = len(timeline) - 1 if success else key_step(trace, diagnosis)
    return "", key_step_html(timeline, key, index, success is False)
