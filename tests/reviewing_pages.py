"""Pages whose runs are recorded into a folder, and who reviews them; no browser needed."""

from pathlib import Path
from typing import Any

import viser

from spherloc.errors import RecordingError
from spherloc_viz.app.catalog import Catalog
from spherloc_viz.app.review.run_library import RunLibrary
from spherloc_viz.app.server import Sessions
from spherloc_viz.app.services import Services
from spherloc_viz.app.session import Session
from spherloc_viz.app.web.touch import Touch
from spherloc_viz.app.web.viser_internals import start_viser, stop_viser
from spherloc_viz.recording.storage.recorder import Recorder
from tests.connected_page import KEY, ConnectedPage
from tests.tiny_scene import write_tiny_scene
from tests.waiting import until


class Office:
    """A server whose pages record into a folder and review what is there."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "recordings"
        self.errors: list[RecordingError] = []
        self.recorder = Recorder(self.folder, self.report, on_recovery=lambda words: self.sessions.recover(words))
        catalog = Catalog(write_tiny_scene(folder))
        self.services = Services(catalog, (folder,), self.recorder, RunLibrary(self.recorder.index))
        self.sessions = Sessions(self.services)
        self.server: viser.ViserServer = start_viser(KEY)
        self.sessions.attend(self.server)
        self.visitors: list[Visitor] = []

    def report(self, error: RecordingError) -> None:
        self.errors.append(error)
        self.sessions.report(error)

    def visit(self, recorded: bool = True) -> "Visitor":
        """A new page, by default once its first run is on the disk."""
        known = set(self.sessions._open)
        page = ConnectedPage(self.server, KEY)
        until(lambda: set(self.sessions._open) - known)
        (number,) = set(self.sessions._open) - known
        self.visitors.append(Visitor(page, self.sessions._open[number]))
        if recorded:
            self.visitors[-1].settle()
        return self.visitors[-1]

    @property
    def files(self) -> list[str]:
        return sorted(path.name for path in self.folder.glob("*.rrd") if ".review." not in path.name)

    def close(self) -> None:
        for visitor in self.visitors:
            visitor.page.close()
        self.sessions.close()
        stop_viser(self.server)
        self.recorder.close()
        self.services.downloads.close()
        assert not self.errors


class Visitor:
    """A page with its session."""

    def __init__(self, page: ConnectedPage, session: Session) -> None:
        self.page, self.session = page, session
        self.panel, self.card = session._controls._recordings, session._controls.review

    def touch(self, words: str) -> None:
        action, _, argument = words.partition(":")
        self.session._touches.deliver(Touch(action, argument, 0.5, 0.5, 0.5, 0.5, False))

    def set(self, widget: Any, value: Any) -> None:
        self.page.send({"type": "GuiUpdateMessage", "uuid": widget._impl.uuid, "updates": {"value": value}})

    def settle(self) -> None:
        """Wait until the page's run is recorded, on the disk and diagnosed."""
        session = self.session
        until(lambda: session._run is not None and session._runs.path(session._run.trace) is not None)
        path = session._runs.path(session._run.trace)  # type: ignore[union-attr]
        assert path is not None
        until(path.exists)
        until(lambda: session._diagnosed is not None and session._diagnosed[0] is session._run.trace)  # type: ignore[union-attr]

    @property
    def opening(self) -> bool:
        """Whether a run is still being opened; what is said of it in the end is empty."""
        return self.panel._reviewer._background._busy

    @property
    def rows(self) -> str:
        assert self.panel._runs is not None
        return self.panel._runs._rows.content

    @property
    def drawn(self) -> dict[str, Any]:
        return self.session._display.canvas._painter._drawn

    def see(self) -> None:
        """Have the tab in front."""
        self.touch("views:Recordings;Yaw;")


def recorded_twice(office: Office) -> tuple[Visitor, str, str]:
    """A page that has made two runs of two problems, and the runs' files."""
    visitor = office.visit()
    (first,) = office.files
    simulation = visitor.session._controls.scene._simulation
    visitor.set(simulation._outliers, 60.0)
    until(lambda: len(office.files) == 2)
    visitor.settle()
    until(lambda: office.recorder.waiting == 0)
    (second,) = set(office.files) - {first}
    return visitor, first, second
