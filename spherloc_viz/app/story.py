"""The panels left of the canvas: the steps and what they say, and views of the run in two dimensions."""

from collections.abc import Callable, Iterable

import viser
from numpy.typing import NDArray

from spherloc_viz.app.charts import ChartPanel
from spherloc_viz.app.image_panel import ImagePanel
from spherloc_viz.app.match_table import MatchTable
from spherloc_viz.app.residual_view import ResidualView
from spherloc_viz.app.steps_panel import StepsPanel
from spherloc_viz.app.text import legend_html, summary_html, table_html
from spherloc_viz.app.touch import Touches
from spherloc_viz.app.wish import Run
from spherloc_viz.app.yaw_view import YawView
from spherloc_viz.layers.primitives import Picture, Table


class Story:
    """One client's panels."""

    def __init__(
        self,
        gui: viser.GuiApi,
        touches: Touches,
        changed: Callable[[object], None],
        select: Callable[[Iterable[int]], None],
        width_px: int,
    ) -> None:
        """``changed`` has the page drawn anew; ``select`` selects matches by their numbers in the problem."""
        steps, views = gui.add_panel(), gui.add_panel()
        with steps.add_tab("Steps"):
            self._summary = gui.add_html("")
            self.steps = StepsPanel(gui, changed)
            touches.on("step", lambda touch: self.steps.go(touch.argument))
            self._diagnosis = gui.add_html("")
            gui.add_html(legend_html())
            self._outcome = gui.add_html("")
        with views.add_tab("Yaw"):
            self._yaw = YawView(gui, touches, changed)
        with views.add_tab("Charts"):
            self._charts = ChartPanel(gui)
        with views.add_tab("Residuals"):
            self._residuals = ResidualView(gui, touches, changed, select)
        with views.add_tab("Images"):
            self._images = ImagePanel(gui, touches, changed)
        with views.add_tab("Matches"):
            self._matches = MatchTable(gui, touches, changed)
        steps.dock_left()
        views.dock_below(steps)
        steps.set_width(width_px)

    def draw(self, run: Run, picture: Picture, playing: bool, outcome: Table, selected: tuple[int, ...]) -> None:
        """Show a step of a run. ``selected`` are numbers in the problem."""
        kept: NDArray = run.kept
        tables = [table for table in picture.tables if table.name != outcome.name]
        self.steps.show(picture.step, playing, tables)
        self._charts.draw(picture.charts)
        self._yaw.draw(run.trace, picture.step.key, selected, kept)
        self._residuals.draw(run.trace, selected, kept)
        self._images.draw(run.trace, picture, selected, kept)
        self._matches.draw(run.trace, selected, kept)
        for widget, html in ((self._summary, summary_html(run.trace)), (self._outcome, table_html(outcome))):
            if widget.content != html:
                widget.content = html

    def diagnose(self, html: str) -> None:
        """Show what the diagnosis says by now."""
        if self._diagnosis.content != html:
            self._diagnosis.content = html
