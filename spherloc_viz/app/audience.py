"""A page of an audience: it shows the presenter's run, with steps, selection and view of its own.

What could compute, read or write on the server is not forbidden here but absent: the page has no widget for it, and no
handler for what a changed page might send instead.
"""

from collections.abc import Callable, Iterable
from html import escape

import viser

from spherloc.diagnosis import Diagnosis
from spherloc_viz.app.catalog import Run
from spherloc_viz.app.controls.controls import DisplayControls
from spherloc_viz.app.edits import Edits
from spherloc_viz.app.run_display import Callbacks, RunDisplay
from spherloc_viz.app.said_together import SaidTogether
from spherloc_viz.app.services import Services
from spherloc_viz.app.stage.canvas import panel_widths_px
from spherloc_viz.app.status import Status
from spherloc_viz.app.text import DIM, box
from spherloc_viz.app.web.touch import READY, Touch, Touches
from spherloc_viz.app.web.viser_internals import follow_changes, guard_callbacks, limit_uploads
from spherloc_viz.app.workers import LatestWorker
from spherloc_viz.layers.primitives import SceneItem

WAITING = "The presenter has not shown anything yet."
ABOUT = (
    "This is the audience's page: it shows the presenter's run and follows when that changes. Steps, selection and "
    "view are your own. Scenes, estimators, matches, recordings and files are for the presenter to change and open."
)


class AudienceControls:
    """The panel right of the canvas: what this page is for, and what of the canvas is shown."""

    camera_movable = False

    def __init__(self, gui: viser.GuiApi, width_px: int, changed: Callable[[object], None]) -> None:
        gui.add_html(box(f'<div style="{DIM}">{escape(ABOUT)}</div>', "font-size:12px"))
        self.display = DisplayControls(gui, changed)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(width_px)

    def items(self, run: Run, hidden: bool) -> tuple[SceneItem, ...]:
        """Nothing beside the run."""
        return ()

    def said_together(self, run: Run) -> SaidTogether | None:
        """Nothing: results of all queries are on the presenter's page."""
        return None

    def draw(self, run: Run, diagnosis: Diagnosis | None, hidden: bool) -> None:
        """Nothing here depends on the run."""


class Audience:
    """Lives as long as the tab's connection; one thread of its own draws what is new."""

    def __init__(self, client: viser.ClientHandle, services: Services) -> None:
        self._services = services
        self._status = Status(client)
        guard_callbacks(client, self._status.fail)
        self._touches = Touches(self._status.fail)
        self._changes = follow_changes(client, self._touches.receive)
        limit_uploads(client, 0, self._status.complain)
        self._edits = Edits()
        self._page = LatestWorker(f"spherloc-page-{client.client_id}", self._draw)
        left_px, right_px = panel_widths_px(client.camera.image_width)
        controls = AudienceControls(client.gui, right_px, self._redraw)
        callbacks = Callbacks(self._redraw, self._select, None, lambda layer, name: None, lambda label: None)
        self._display = RunDisplay(client, self._touches, controls, callbacks, (left_px, right_px))
        self._touches.on("select", self._select_numbers)
        self._touches.on("deselect", lambda touch: self._select(()))
        # Only now may the page report presses: all handlers are registered.
        client.gui.add_html(READY)
        self._display.panels.ready()

    def start(self) -> None:
        """Show what the presenter shows."""
        self._page.start()
        self._services.presented.follow(self._page.ask)
        self._page.ask()

    def close(self) -> None:
        """End the thread; does not wait."""
        self._services.presented.leave(self._page.ask)
        self._page.close()

    def _redraw(self, event: object = None) -> None:
        self._page.ask()

    def _select(self, places: Iterable[int], extend: bool = False) -> None:
        """Select matches by their numbers in the problem."""
        shown = self._services.presented.newest
        if shown is not None:
            self._edits.select(shown.run.kept[list(places)].tolist(), extend)
            self._page.ask()

    def _select_numbers(self, touch: Touch) -> None:
        shown = self._services.presented.newest
        if shown is not None and self._edits.select_words(touch.argument, touch.extend, shown.run.kept):
            self._page.ask()

    def _draw(self, asked: bool) -> float | None:
        now = self._changes.now()
        with self._changes.as_of(now):
            return self._draw_presented(asked, now)

    def _draw_presented(self, asked: bool, now: int) -> float | None:
        shown = self._services.presented.newest
        try:
            if shown is None:
                self._status.say(WAITING)
                return None
            request, name, withheld = shown.run.request, shown.run.trace.problem.name, shown.withheld
            how = f"{request.estimator}, seed {request.scene.seed}."
            self._status.hide_answers(bool(withheld | self._display.withheld(shown.run)))
            self._status.say(f"The presenter shows {name}, {how}", untold=f"The presenter shows {how}")
            selected = self._edits.places(shown.run.kept)
            return self._display.draw(shown.run, shown.mesh, shown.diagnosis, selected, asked, now, withheld)
        except Exception as error:
            self._status.fail(error)
            return None
