"""The panels left of the canvas: the steps and what they say, and views of the run in two dimensions."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

import viser
from numpy.typing import NDArray

from spherloc.datasets.map_scene import MapScene
from spherloc_viz.app.catalog import Run
from spherloc_viz.app.controls.steps_panel import StepsPanel
from spherloc_viz.app.glossary import glossary_html, heading_html, linked
from spherloc_viz.app.introduction import introduction_html
from spherloc_viz.app.link import SIDES, TABS
from spherloc_viz.app.matches.image_panel import ImagePanel
from spherloc_viz.app.matches.lens_panel import LensPanel
from spherloc_viz.app.matches.match_table import MatchTablePanel
from spherloc_viz.app.plots.charts import ChartPanel
from spherloc_viz.app.plots.graph_view import GraphView
from spherloc_viz.app.plots.residual_view import ResidualView
from spherloc_viz.app.plots.yaw_view import YawView
from spherloc_viz.app.text import (
    ToldBeside,
    legend_html,
    opening_card_html,
    opening_html,
    stale_html,
    summary_html,
    table_html,
)
from spherloc_viz.app.web.touch import READY, Touch, Touches, pixels_of, seen_views
from spherloc_viz.app.web.viser_internals import update_widget
from spherloc_viz.layers import graph_begins, steps
from spherloc_viz.layers.primitives import Chart, Picture, Table


class LeftPanels:
    """One client's panels."""

    def __init__(
        self,
        gui: viser.GuiApi,
        touches: Touches,
        changed: Callable[[object], None],
        select: Callable[[Iterable[int]], None],
        scene_of: Callable[[str], MapScene | None],
        width_px: int,
    ) -> None:
        """``changed`` has the page drawn anew; ``select`` selects matches by their numbers in the problem; ``scene_of``
        gives the scene with images of a label, if it is one."""
        steps, views = gui.add_panel(), gui.add_panel()
        with steps.add_tab("Steps"):
            self._summary = gui.add_html("")
            self.steps = StepsPanel(gui, changed)
            touches.on("step", lambda touch: self.steps.go(touch.argument))
            touches.on("move", lambda touch: self.steps.move(touch.argument))
            touches.on("projector", self._widen)
            self._diagnosis = self.steps.remark
            gui.add_html(legend_html())
            self._outcome = gui.add_html("")
            self._introduction, self._front, self._ready = gui.add_html(""), gui.add_html(""), gui.add_html("")
            gui.add_html(glossary_html())
            self._card = gui.add_html("")
            self.address = gui.add_html("")
            """For what the page's script is to keep as the address."""
        self._opening = self._of_step = self._asked = self._elsewhere = ""
        self._stale = False
        self.tab = TABS[0]
        """The view that a person or a link has brought to the front, for the page's link."""
        self.side = SIDES[0]
        """The tab that is seen right of the canvas, or was before Share, for the page's link."""
        self._seen, self._changed = frozenset({"Yaw"}), changed
        touches.on("views", self._see)
        with _view(gui, views, "Yaw"):
            self._yaw = YawView(gui, touches, changed)
        with _view(gui, views, "Graph"):
            self.graph = GraphView(gui, touches, changed, select)
        with _view(gui, views, "Charts"):
            gui.add_html(heading_html("Curves of the step at hand", "step"))
            self._charts = ChartPanel(gui)
        with _view(gui, views, "Residuals"):
            self._residuals = ResidualView(gui, touches, changed, select)
        with _view(gui, views, "Images"):
            gui.add_html(heading_html("What the camera measured, and where the pose puts it", "residual"))
            self._images = ImagePanel(gui, touches, changed)
            self._lens = LensPanel(gui, touches, scene_of, changed)
        with _view(gui, views, "Matches"):
            gui.add_html(heading_html("Press a row: the match lights up everywhere", "match"))
            self.matches = MatchTablePanel(gui, touches, changed)
        self._panel, self._width_px, self._projected_px = steps, width_px, 0
        steps.dock_left()
        views.dock_below(steps)
        steps.set_width(width_px)

    def draw(
        self,
        run: Run,
        picture: Picture,
        playing: bool,
        outcome: Table,
        selected: tuple[int, ...],
        hidden: bool,
        offered: str = "",
        beside: ToldBeside = ToldBeside(),  # noqa: B008 -- frozen
    ) -> None:
        """Show a step of a run, in the views that are to be seen. ``selected`` are numbers in the problem; ``hidden``
        says that what came out is not to be told: then run and picture are without it. ``offered`` is HTML that says
        which answers are hidden, and ``beside`` what is told beside the run's verdict."""
        kept: NDArray = run.kept
        tables = [table for table in picture.tables if table.name != outcome.name]
        self.steps.show(picture.step, playing, tables)
        seen = self._seen
        if "Yaw" in seen:
            self._yaw.draw(run.trace, picture.step.key, selected, kept, hidden, _yaw_chart(picture, hidden))
        if "Graph" in seen:
            self.graph.draw(picture.graph, graph_begins(run.trace), selected, kept, hidden)
        if "Charts" in seen:
            self._charts.draw(picture.charts)
        if "Residuals" in seen:
            cost = next((chart for chart in picture.charts if chart.name == "refinement"), None)
            self._residuals.draw(run.trace, selected, kept, cost, hidden)
        if "Images" in seen:
            self._images.draw(run.trace, picture, selected, kept, hidden)
            self._lens.draw(run, hidden)
        if "Matches" in seen:
            self.matches.draw(run.trace, selected, kept, hidden)
        summary, ending = ("", "") if hidden else (summary_html(run.trace, beside), table_html(outcome, linked))
        summary = offered + summary
        if self._opening == run.request.scene.scene:
            self._opening = self._card.content = ""
        elif self._opening:
            summary, ending = opening_html(self._opening), f'<div style="opacity:.35">{ending}</div>'
        elif self._stale:
            summary = f'{stale_html()}<div style="opacity:.5">{summary}</div>'
        self._of_step = front_of(picture.step.stage, picture.step.key) or self._of_step
        front = front_html(self._of_step, self._asked, self._elsewhere)
        for widget, html in ((self._front, front), (self._summary, summary), (self._outcome, ending)):
            update_widget(widget, content=html)
        if not self._introduction.content:
            self._introduction.content = introduction_html(steps(run.trace), picture.step.key)

    def prepare(self, run: Run, picture: Picture, selected: tuple[int, ...], hidden: bool) -> None:
        """Make what ``draw`` will show of another step of the run that is shown."""
        if "Yaw" in self._seen:
            self._yaw.prepare(run.trace, picture.step.key, selected, run.kept, hidden, _yaw_chart(picture, hidden))

    def open_tab(self, tab: str, side: str | None = None) -> None:
        """Bring a view to the front, and a tab of the panel right of the canvas, once: then it is the person's to
        choose."""
        self.tab = tab
        if tab != TABS[0]:
            self._asked = _once_more(tab, self._asked)
        if side is not None and side != self.side:
            self.side, self._elsewhere = side, _once_more(side, self._elsewhere)

    def show_reference(self, number: int) -> None:
        """Bring the images to the front, the query with that reference."""
        self.open_tab("Images")
        self._images.show_reference(number)

    def begin_opening(self, label: str) -> None:
        """Until a run of this scene is shown, say that the panels still show the scene before."""
        self._opening = label
        self._changed(None)

    @property
    def opens_another(self) -> bool:
        """Whether another scene than that of the run that was drawn last is being opened."""
        return bool(self._opening)

    def tell_opening(self, words: str, share: float | None) -> None:
        """Show the progress of the opening, 0 to 1, or None where it is not known."""
        if self._opening:
            self._card.content = opening_card_html(self._opening, words, share)

    def end_opening(self) -> None:
        """The opening has ended without a new run: show the scene before."""
        if self._opening:
            self._opening = self._card.content = ""
            self._changed(None)

    def mark_stale(self, stale: bool) -> None:
        """Say whether the run that is shown is not that of the settings, as one of these cannot be used."""
        if stale != self._stale:
            self._stale = stale
            self._changed(None)

    def _see(self, touch: Touch) -> None:
        """The page reports which views can be seen now. As long as it has not opened those of the step and the link at
        hand, what is seen is nobody's choice."""
        seen = seen_views(touch.argument)
        self._seen = seen.names
        if (seen.of_step, seen.of_link) == (self._of_step, self._asked):
            chosen = [] if seen.of_step in seen.names else [name for name in TABS[1:] if name in seen.names]
            self.tab = chosen[0] if chosen else TABS[0]
        if seen.elsewhere == self._elsewhere:
            self.side = next((name for name in SIDES if name in seen.names), self.side)
        self._changed(None)

    def _widen(self, touch: Touch) -> None:
        """Make room for the projector view on a window of so many pixels; 0 ends it."""
        self._projected_px = int(PROJECTOR_SHARE * pixels_of(touch))
        self._panel.set_width(max(self._width_px, self._projected_px))

    def fit(self, width_px: int) -> None:
        """Be as wide as the window now asks for; the projector view may keep them wider."""
        self._width_px = width_px
        self._panel.set_width(max(width_px, self._projected_px))

    def ready(self) -> None:
        """Tell the page that presses are handled from now on; in a panel that stays when the other one is folded."""
        self._ready.content = READY

    def diagnose(self, above: str, below: str) -> None:
        """Show HTML of the newest diagnosis, above and below the words of the step."""
        update_widget(self.steps.cause, content=above)
        update_widget(self._diagnosis, content=below)


def _yaw_chart(picture: Picture, hidden: bool) -> Chart | None:
    """The chart of the yaw as of a step about yaws, and at all steps if results are ``hidden``; None elsewhere."""
    of_yaw = picture.charts if hidden or picture.step.key.startswith("yaw-") else ()
    return next((chart for chart in of_yaw if chart.name == "yaw"), None)


PROJECTOR_SHARE = 0.4
"""Share of the window's width for the view left of the canvas in the projector view."""
FRONTS = {
    "Matches": "Images",
    "Samples": "Yaw",
    "Yaw": "Yaw",
    "Translation": "Graph",
    "Consensus": "Yaw",
    "Refinement": "Residuals",
    "Outcome": "Residuals",
}
"""The view that goes with the steps of a stage."""


def front_of(stage: str, key: str) -> str:
    """The view that goes with a step; empty if none does."""
    return "Graph" if key.startswith("consensus-clique") else FRONTS.get(stage, "")


def front_html(name: str, asked: str, elsewhere: str) -> str:
    """Tells the page's script which view goes with a step, and what tabs a link asked for, here and elsewhere."""
    return f'<div hidden data-front="{name}" data-tab="{asked}" data-elsewhere="{elsewhere}"></div>'


def _once_more(tab: str, asked: str) -> str:
    """The words that ask for a tab, "NAME NUMBER", after those that ``asked`` before."""
    return f"{tab} {1 + int(asked.partition(' ')[2] or 0)}"


@contextmanager
def _view(gui: viser.GuiApi, panel: viser.PanelHandle, name: str) -> Iterator[None]:
    """The content of a tab; the page reports whether it can be seen."""
    with panel.add_tab(name):
        gui.add_html(f'<div data-view="{name}"></div>')
        yield
