"""All that a page shows of a run: the canvas, the story beside it, and the card of what is selected."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import viser

from spherloc.datasets.synthetic import TrueCamera
from spherloc.diagnosis import Diagnosis
from spherloc_viz.app.catalog import Catalog
from spherloc_viz.app.controls.controls import Controls, Owner
from spherloc_viz.app.matches.match_card import MatchCard
from spherloc_viz.app.panels.export_panel import Shown
from spherloc_viz.app.services import Services
from spherloc_viz.app.stage.canvas import Canvas, panel_widths_px
from spherloc_viz.app.story import Story
from spherloc_viz.app.text import diagnosis_html, status_html
from spherloc_viz.app.web.touch import Touches
from spherloc_viz.app.web.viser_seams import set_theme
from spherloc_viz.app.wish import Run
from spherloc_viz.layers import paint, steps, with_rival
from spherloc_viz.layers.primitives import Picture, SceneItem
from spherloc_viz.layers.selection import with_selection
from spherloc_viz.layers.tables import outcome_table
from spherloc_viz.layers.trajectory import trajectory_items

START_THEME = "dark"


class Face:
    """One client's page. Everything is drawn on the session's page thread."""

    def __init__(
        self,
        client: viser.ClientHandle,
        catalog: Catalog,
        touches: Touches,
        owner: Owner,
        services: Services,
        select: Callable[[Iterable[int], bool], None],
        moved: Callable[[TrueCamera], None],
    ) -> None:
        """``select`` gets numbers of correspondences in the problem, ``moved`` the true camera's new place."""
        self._client, self._catalog = client, catalog
        left_px, right_px = panel_widths_px(client.camera.image_width)
        self.controls = Controls(client, catalog, services, touches, owner, right_px)
        self.story = Story(client.gui, touches, owner.redraw, lambda places: select(places, False), left_px)
        self.card = MatchCard(client.gui)
        self.canvas = Canvas(client, self.controls.display, select, moved, left_px + right_px)
        self._shown: tuple[Run, Picture] | None = None
        self._theme = START_THEME

    def draw(self, run: Run, diagnosis: Diagnosis | None, selected: tuple[int, ...], asked: bool) -> float | None:
        """Show the step at hand of a run; returns seconds to the next step if they play.

        ``selected`` are numbers in the problem, and ``diagnosis`` is None for as long as there is none. ``asked`` is
        false if only time has passed.
        """
        trace, controls = run.trace, self.controls
        timeline = steps(trace)
        index, pause = self.story.steps.settle(timeline, asked)
        picture, last = paint(trace, index), index == len(timeline) - 1
        rival = None if diagnosis is None else diagnosis.rival_cam_from_map
        if last and rival is not None:
            picture = with_rival(picture, trace, rival)
        drawn = with_selection(picture, trace, selected)
        drawn = replace(drawn, scene=drawn.scene + controls.items(run) + self._trajectory(run))
        self._shown = run, drawn
        with self._client.atomic():
            self._follow_theme()
            self.canvas.draw(run, drawn, self._catalog.mesh(run.wish.scene.scene), controls.camera_movable)
            # The other views tell inliers by the colours of the picture as it was.
            told = replace(picture, step=drawn.step)
            self.story.draw(run, told, pause is not None, outcome_table(trace), selected)
            waiting = status_html("Diagnosing …")
            self.story.diagnose(waiting if diagnosis is None else diagnosis_html(diagnosis, whole=last))
            self.card.draw(trace, selected, run.kept, rival)
            controls.draw(run, diagnosis)
        self._client.flush()
        return self.canvas.check() if pause is None else pause

    def shown(self, recorded: Path | None) -> Shown | None:
        """What is on the page, to be exported; ``recorded`` is the run's recording, if there is one."""
        if self._shown is None:
            return None
        (run, picture), display = self._shown, self.controls.display
        trace, layers = run.trace, display.layers()
        return Shown(
            trace=trace,
            items=tuple(item for item in picture.scene if item.layer in layers),
            backdrop=self._catalog.mesh(run.wish.scene.scene) if "mesh" in layers else None,
            title=run.wish.scene.scene,
            note=f"{trace.estimator}, seed {trace.seed}. {trace.message}",
            recorded=recorded,
            dark=display.theme == "dark",
        )

    def _follow_theme(self) -> None:
        theme = self.controls.display.theme
        if theme != self._theme:
            self._theme = theme
            set_theme(self._client.gui, theme)

    def _trajectory(self, run: Run) -> tuple[SceneItem, ...]:
        """The sequence that was localized in the scene at hand, if any."""
        label = run.wish.scene.scene
        scene, rows = self._catalog.map_scene(label), self.controls.sequence.rows(label)
        if scene is None or not rows:
            return ()
        return trajectory_items(rows, run.trace.problem.aligned.map_turn, scene.thresholds[-1][1])
