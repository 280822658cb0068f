"""The charts of a step beside the canvas."""

from html import escape

import viser

from spherloc_viz.app.plots.svg import chart_svg
from spherloc_viz.app.text import box
from spherloc_viz.layers.primitives import Chart

NONE_YET = "No chart yet: the first one comes with a later step, and then it stays."


class ChartPanel:
    """The charts of a picture, one under the other."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._html = gui.add_html("")
        self._shown: tuple[Chart, ...] | None = None

    def draw(self, charts: tuple[Chart, ...]) -> None:
        """Show these charts and no others."""
        if (
            self._shown is not None
            and len(charts) == len(self._shown)
            and all(a is b for a, b in zip(charts, self._shown, strict=True))
        ):
            return
        self._shown = charts
        content = "".join(map(chart_html, charts)) or box(escape(NONE_YET))
        if content != self._html.content:
            self._html.content = content


def chart_html(chart: Chart) -> str:
    """A chart under its title."""
    return box(f'<div style="font-weight:600;padding-bottom:.3em">{escape(chart.title)}</div>{chart_svg(chart)}')
