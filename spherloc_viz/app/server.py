"""Starts the playground and ends it."""

import asyncio
import contextlib
import gc
import ipaddress
import secrets
import signal
import socket
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

import viser

from spherloc.datasets import bundled_scenes
from spherloc.errors import InputError, RecordingError, SpherlocError
from spherloc.experiments.kept_results import kept_results
from spherloc.experiments.results import LOCALIZED
from spherloc.files import is_folder
from spherloc.warm_up import warm_up
from spherloc_viz.app.audience import Audience
from spherloc_viz.app.catalog import Catalog, RunRequest, SceneRequest
from spherloc_viz.app.compilation import Compilation, first_and_later
from spherloc_viz.app.page_runs import Known
from spherloc_viz.app.review.run_library import RunLibrary
from spherloc_viz.app.services import Services
from spherloc_viz.app.session import Session
from spherloc_viz.app.stage import views
from spherloc_viz.app.status import Status
from spherloc_viz.app.web.access import Access, Role, open_socket
from spherloc_viz.app.web.desk import DeskRoom
from spherloc_viz.app.web.drops import DropRoom
from spherloc_viz.app.web.front_door import FrontDoor
from spherloc_viz.app.web.viewer import ViewerRoom, of_index
from spherloc_viz.app.web.viser_internals import role_header, set_theme, start_viser, stop_viser
from spherloc_viz.given_files import is_recording
from spherloc_viz.options import usable_estimators
from spherloc_viz.plugins import extensions
from spherloc_viz.recording.index.run_index import RunIndex
from spherloc_viz.recording.replay import RecordedScene, recorded_options
from spherloc_viz.recording.sandbox.examiner import end_examining
from spherloc_viz.recording.storage.recorder import Recorder
from spherloc_viz.recording.storage.room import kept_bytes

SWITCH_S = 0.001
NOT_ENCRYPTED = (
    "warning: the connection is not encrypted, so others who can read the network traffic can use the "
    "links too; on a network that you do not trust, use 127.0.0.1 and an SSH tunnel."
)
MAX_UNHEARD = 3
"""Notices that are kept for a page that opens later."""


def serve(
    scene: Path | None,
    host: str,
    port: int,
    recordings: Path,
    *,
    record: bool = True,
    allow: Sequence[Path] = (),
    keep_gigabytes: float | None = None,
    token: bool = False,
    framed: bool = False,
    on_address: Callable[[str], None] | None = None,
) -> None:
    """Run the playground until Ctrl-C or a termination signal.

    ``scene`` is offered first, before those that come with the project; of a recording (.rrd), pages open its run, and
    of a sequence that was localized before the query with most inliers.
    Port 0 takes any free port. ``on_address`` is called with the address as soon as browsers can be sent there, where
    they wait until all is ready; ``framed`` lets other pages of this machine, such as a notebook's, show the page in a
    frame. Runs that a page settles on are recorded into ``recordings`` unless ``record`` is false; beyond
    ``keep_gigabytes`` (2, or what is there if that is more) the oldest successes are deleted. Pages may open scenes
    from the folder of ``scene`` if it is a scene file, from that of the bundled ones and from ``allow``; photographs
    that are dropped onto them are kept in the first folder of ``allow`` or else in that of ``scene``. A token is
    demanded if ``token`` says so, and always where the address is not this machine's alone.
    Raises ``InputError`` if the scene, one of these folders or the size cannot be used or the port cannot
    be had, and ``RecordingError`` for a recording that cannot be opened.
    """
    catalog, keep_bytes = Catalog(scene), kept_bytes(keep_gigabytes, recordings)
    first = _first_run(catalog)
    with open_socket(host, port) as listener, contextlib.ExitStack() as stack:
        if on_address is not None:
            on_address(_address(listener))
        _answer_quickly()
        early, later = first_and_later()
        _prepare(early)
        compilation = Compilation(later)
        stack.callback(compilation.close)
        compilation.start()
        services = Services(catalog, allowed_roots(scene, allow), first=first, compilation=compilation)
        services.drops = DropRoom(kept_folder(scene, allow))
        services.begin = None if scene is None else best_localized(catalog, recordings)
        sessions = Sessions(services)
        stack.callback(services.downloads.close)
        if record:
            services.recorder = stack.enter_context(
                Recorder(
                    recordings, sessions.report, sessions.notice, keep_bytes=keep_bytes, on_recovery=sessions.recover
                )
            )
        index = _open_index(services.recorder, recordings, stack)
        services.library = None if index is None else RunLibrary(index)
        viewer = None if index is None else ViewerRoom(of_index(index))
        desk = None if services.library is None else DeskRoom(services.library, services.downloads, services.roots)
        key = secrets.token_urlsafe(32)
        server = start_viser(key)
        stack.callback(stop_viser, server)
        stack.callback(sessions.close)
        sessions.attend(server)
        access = Access(demanded=token or not _is_loopback(listener))
        door = FrontDoor(
            host, server.get_port(), key, access, services.downloads, viewer, framed, desk, drops=services.drops
        )
        asyncio.run(_serve_until_told(door, access, listener))


def _first_run(catalog: Catalog) -> Known | None:
    """The run of the recording that the catalog begins with; None if it begins with a scene."""
    label, scene = next(iter(catalog.scenes.items()))
    if not isinstance(scene, RecordedScene):
        return None
    run = scene.run
    request = RunRequest(SceneRequest(label, run.seed), run.estimator, recorded_options(run, scene.path))
    return Known(request, scene.path, run.cam_from_map)


def best_localized(catalog: Catalog, results: Path) -> RunRequest | None:
    """The query of the catalog's first scene that has most inliers of those that were localized before, by the same
    estimator; None if the folder ``results`` has none."""
    label = next(iter(catalog.scenes))
    scene = catalog.map_scene(label)
    if scene is None:
        return None
    try:
        found = kept_results(results, scene, catalog.path(label))
    except SpherlocError:  # the scene can no longer be read, as its page will say
        return None
    rows = () if found is None else [row for row in found.rows if row.status == LOCALIZED]
    if found is None or not rows or found.configuration.estimator not in usable_estimators():
        return None
    best = max(rows, key=lambda row: row.inliers or 0)
    return RunRequest(SceneRequest(label, found.configuration.seed, best.query), found.configuration.estimator, None)


def _prepare(estimators: Sequence[str]) -> None:
    """Warm up what the first run needs; an extension that cannot be used is named once, and the page goes on."""
    told: list[str] = []

    def tell(sentence: str) -> None:
        told.append(sentence)
        _say(sentence)

    warm_up(tell, estimators)
    for extension in extensions():
        if extension.problem and not any(line.startswith(extension.problem) for line in told):
            tell(extension.problem)


def _say(sentence: str) -> None:
    print(f"spherloc: {sentence}", file=sys.stderr, flush=True)


def _open_index(recorder: Recorder | None, folder: Path, stack: contextlib.ExitStack) -> RunIndex | None:
    """The list of what was recorded; None, with a sentence, if there is none: the playground goes on without it."""
    try:
        if recorder is not None:
            return recorder.index
        return stack.enter_context(RunIndex(folder)) if is_folder(folder) else None
    except RecordingError as error:
        print(f"warning: {error}", file=sys.stderr, flush=True)
        return None


def _answer_quickly() -> None:
    """Set the interpreter up for short answers: threads switch sooner than after 5 ms, and the garbage collector
    leaves out all objects that exist at the start."""
    sys.setswitchinterval(SWITCH_S)
    gc.collect()
    gc.freeze()


def allowed_roots(scene: Path | None, allow: Sequence[Path]) -> tuple[Path, ...]:
    """Folders from which pages may open scenes; raises ``InputError`` for one that is not a folder."""
    for folder in allow:
        if not is_folder(folder):
            raise InputError(f"{folder}: is not a folder; give --allow a folder that exists.")
    bundled = {path.parent for path in bundled_scenes().values()}
    own = () if scene is None or is_recording(scene) else (scene.parent,)
    return (*allow, *own, *sorted(bundled))


def kept_folder(scene: Path | None, allow: Sequence[Path]) -> Path | None:
    """The folder in which photographs that are dropped onto a page are kept: the first that is allowed, or that of the
    scene, beside which scenes of photographs in its map are written; None if they go with their page."""
    if allow:
        return Path(allow[0])
    bundled = {path.resolve() for path in bundled_scenes().values()}
    return None if scene is None or is_recording(scene) or scene.resolve() in bundled else scene.parent


class Sessions:
    """The sessions of all connected clients."""

    def __init__(self, services: Services) -> None:
        self._services = services
        self._open: dict[int, Session | Audience] = {}
        self._lock = threading.Lock()
        self._unheard: list[str] = []
        """Notices that came when no page was open, for the next one."""
        self._lost = 0
        """Runs that were not recorded since the last one that was."""
        self._failure = ""

    def attend(self, server: viser.ViserServer) -> None:
        """Open a session for every client that connects and close it when the client leaves."""
        server.scene.world_axes.visible = False
        # With another up direction at first, a page would turn the picture over when its first view is set.
        server.initial_camera.up = tuple(views.UP)
        server.initial_camera.position = views.START
        set_theme(server.gui, "dark")
        server.on_client_connect(lambda client: self._welcome(server, client))
        server.on_client_disconnect(lambda client: self._dismiss(client.client_id))

    def report(self, error: RecordingError) -> None:
        """Tell every presenter's page, and those that open later, that a run could not be recorded."""
        with self._lock:
            self._lost += 1
            counted = f" {self._lost} runs were not recorded." if self._lost > 1 else ""
            self._failure = failure = f"{error}{counted}"
        for session in self._presenters():
            session.notices.fail(failure)

    def recover(self, sentence: str) -> None:
        """Tell every presenter's page that runs are recorded again."""
        with self._lock:
            self._lost, self._failure = 0, ""
        for session in self._presenters():
            session.notices.recover(sentence)

    def notice(self, sentence: str) -> None:
        """Show every presenter's page a sentence about recordings, such as what was recovered or deleted."""
        sessions = self._presenters()
        if not sessions:
            with self._lock:
                self._unheard = [*self._unheard[1 - MAX_UNHEARD :], sentence]
        for session in sessions:
            session.notices.show(sentence)

    def _presenters(self) -> tuple[Session, ...]:
        with self._lock:
            return tuple(session for session in self._open.values() if isinstance(session, Session))

    def close(self) -> None:
        """Close them all."""
        for number in tuple(self._open):
            self._dismiss(number)

    def _welcome(self, server: viser.ViserServer, client: viser.ClientHandle) -> None:
        try:
            kind = Session if role_header(client) == Role.PRESENTER else Audience
            session = kind(client, self._services)
        except Exception as error:  # else the page would wait for its first picture for ever
            Status(client).fail(error)
            return
        with self._lock:
            self._open[client.client_id] = session
            unheard = self._unheard if isinstance(session, Session) else []
            if unheard:
                self._unheard = []
            failure = self._failure
        session.start()
        if failure and isinstance(session, Session):
            session.notices.fail(failure)
        if unheard and isinstance(session, Session):
            session.notices.show(" ".join(unheard))
        # viser runs these callbacks side by side: the client may have left before it was welcomed.
        if client.client_id not in server.get_clients():
            self._dismiss(client.client_id)

    def _dismiss(self, number: int) -> None:
        with self._lock:
            session = self._open.pop(number, None)
        if session is not None:
            session.close()


async def _serve_until_told(door: FrontDoor, access: Access, listener: socket.socket) -> None:
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        try:
            loop.add_signal_handler(number, stop.set)
        except NotImplementedError:  # Windows: asyncio.run ends on Ctrl-C by itself
            break
    runner = await door.start(listener)
    address = _address(listener)
    print(f"spherloc playground: {access.link(address, Role.PRESENTER)}", flush=True)
    if access.demanded:
        print(f"for an audience, which can only look: {access.link(address, Role.AUDIENCE)}", flush=True)
    if not _is_loopback(listener):
        print(NOT_ENCRYPTED, file=sys.stderr, flush=True)
    try:
        await stop.wait()
    finally:
        end_examining()  # a hostile file can keep requests for a minute
        await runner.cleanup()


def _is_loopback(listener: socket.socket) -> bool:
    return ipaddress.ip_address(listener.getsockname()[0]).is_loopback


def _address(listener: socket.socket) -> str:
    """Address of a server for a browser; for a server that listens on all addresses, the one that others see."""
    host, port = listener.getsockname()[:2]
    if ipaddress.ip_address(host).is_unspecified:
        host = _outward_address(listener.family) or host
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def _outward_address(family: int) -> str | None:
    """The address by which other machines reach this one; None without a network. Sends nothing."""
    elsewhere = "2001:db8::1" if family == socket.AF_INET6 else "192.0.2.1"  # addresses for documentation
    with socket.socket(family, socket.SOCK_DGRAM) as probe, contextlib.suppress(OSError):
        probe.connect((elsewhere, 9))
        return probe.getsockname()[0]
    return None
