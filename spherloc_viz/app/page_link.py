"""The link of one page: kept in the browser's address, and followed where the browser goes to another one."""

import secrets
from dataclasses import replace

import viser

from spherloc.trace import Trace
from spherloc_viz.app.catalog import Catalog, Run
from spherloc_viz.app.controls.controls import Controls
from spherloc_viz.app.controls.steps_panel import find_step
from spherloc_viz.app.edits import Edits
from spherloc_viz.app.link import Followed, PageView, address_html, link_of
from spherloc_viz.app.panels.folders import Roots
from spherloc_viz.app.run_display import RunDisplay
from spherloc_viz.app.services import Services
from spherloc_viz.app.web.viser_internals import update_widget
from spherloc_viz.layers import steps
from spherloc_viz.lessons.numbers import number_text, numbers_of


class PageLink:
    """What the page shows, as a link, and the page as a link asks for it. Call its methods by one thread at a time but
    for ``write``."""

    def __init__(
        self,
        client: viser.ClientHandle,
        services: Services,
        catalog: Catalog,
        roots: Roots,
        page: tuple[Controls, RunDisplay, Edits],
    ) -> None:
        """Tells the page where its address is kept, so that it tells the link by which it was opened: all handlers must
        be registered before."""
        self._known, self._catalog, self._roots = services.catalog.scenes, catalog, roots
        self._controls, self._display, self._edits = page
        self.arrived = 0
        """Of how many links that were followed the page shows the step."""
        self.in_lesson = False
        """Whether a lesson shows this page in a frame."""
        self._numbers: tuple[Trace, dict[str, str]] | None = None
        """The numbers of a run as text, for that lesson."""
        self._name = secrets.token_hex(8)
        self._addresses = client.gui.add_html(""), self._display.panels.address
        """Twice, since a panel that is folded tells nothing."""
        self._tell(address_html("", self._name, 0))

    def view(self, run: Run | None) -> PageView:
        """What the page shows of its run."""
        display, panels = self._controls.display, self._display.panels
        selected = () if run is None else tuple(run.kept[list(self._edits.places(run.kept))].tolist())
        return PageView(
            self._display.step_key,
            selected,
            display.theme,
            display.answers,
            self._display.canvas.viewpoint(),
            panels.tab,
            () if run is None else self._controls.compare.compared(run.trace),
            replace(panels.matches.look, page=0),
            panels.graph.look,
            panels.side,
        )

    def write(self, run: Run) -> None:
        """Write what the page shows into the address of the browser."""
        opened = self._controls.review.opened
        recording = opened.recorded.row.file if opened is not None and opened.request == run.request else None
        link = link_of(run, self.view(run), self._catalog, self._known, self._roots, recording)
        self._tell(address_html(link, self._name, self.arrived, self._told_numbers(run.trace)))

    def hide(self, followed: Followed) -> None:
        """Hide what a link hides. Before its run is there, which else would be seen with it."""
        if followed.request is not None:
            self._controls.display.answers = followed.view.answers

    def arrive(self, followed: Followed, run: Run | None) -> list[str]:
        """Set step, selection, tabs and viewer as a link asks for them, whose run is there; returns what it could not
        have, a part of a sentence each."""
        remarks, view = list(followed.remarks), followed.view
        if followed.request is None:
            return remarks
        self._controls.display.theme = view.theme
        self.hide(followed)
        if run is None:
            return remarks
        kept = set(run.kept.tolist())
        self._edits.select(set(view.selected) & kept)
        key = _step_key(run.trace, followed)
        panels = self._display.panels
        panels.steps.go(key)
        panels.matches.look, panels.graph.look = view.table, view.graph
        panels.open_tab(view.tab, view.side)
        self._controls.compare.follow(run.trace, view.compared)
        if view.viewpoint:
            self._display.canvas.hold(key, view.viewpoint)
        return remarks + followed.missing(key, kept)

    def _tell(self, html: str) -> None:
        for widget in self._addresses:
            update_widget(widget, content=html)

    def _told_numbers(self, trace: Trace) -> dict[str, str] | None:
        """The run's numbers for the lesson that shows this page in a frame; None without a lesson."""
        if not self.in_lesson:
            return None
        if self._numbers is None or self._numbers[0] is not trace:
            self._numbers = trace, {name: number_text(value) for name, value in numbers_of(trace).items()}
        return self._numbers[1]


def _step_key(trace: Trace, followed: Followed) -> str:
    """The key of the step that a link names; for a recording without one, that of the key step."""
    timeline, opened = steps(trace), followed.opened
    if opened is not None and not followed.view.step:
        return timeline[min(opened.recorded.row.key_step, len(timeline) - 1)].key
    return timeline[find_step(timeline, followed.view.step)].key
