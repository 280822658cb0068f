"""Everything that leans on viser's insides, so that a new version of viser is checked against one file."""

import asyncio
import contextlib
import hmac
import io
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from typing import Any, TypeVar

import viser
import websockets.asyncio.server
from viser import _messages

KEY_HEADER = "X-Spherloc-Key"
"""Request header that carries the key; a web page cannot set headers on a websocket, a program can."""
ROLE_HEADER = "X-Spherloc-Role"
"""Request header that says what the page may do, next to the key."""


Callback = TypeVar("Callback", bound=Callable[..., None])


def start_viser(key: str) -> viser.ViserServer:
    """A viser server on a free loopback port that answers only requests carrying ``key``.

    viser checks neither Host nor Origin and lets any client open a public tunnel. So it listens on loopback
    only, every request without the key is refused before the websocket opens (a page of another site that
    guesses the port gets a 403), and the tunnel messages do nothing.
    """
    # viser greets with a panel naming the internal address, which nobody can use.
    with _demand(key), contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host="127.0.0.1", port=0, label="spherloc", verbose=False)
    _disable_sharing(server)
    _wake_on_loop(server)
    # A page that leaves while it is being drawn is no news for the terminal.
    warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
    return server


def set_theme(gui: viser.GuiApi, theme: str) -> None:
    """Make a page, or the pages to come, "dark" or "light"."""
    gui.configure_theme(dark_mode=theme == "dark", show_logo=False, show_share_button=False)


def role_header(client: viser.ClientHandle) -> str:
    """What the header of a client's connection said of its role; empty if nothing."""
    return client._websock_connection.__dict__.get("role_header", "")


def stop_viser(server: viser.ViserServer) -> None:
    """Stop it without its farewell."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def put_back(handle: Any) -> None:
    """Show the value that Python holds in the widget, also if the page lost one on its way here.

    The page throttles all widgets together and drops messages; assigning ``handle.value`` would not help,
    since it sends nothing when Python's value stays the same.
    """
    state = handle._impl
    message = _messages.GuiUpdateMessage(state.uuid, {"value": state.value})
    state.gui_api._websock_interface.queue_message(message)


def at_once(callback: Callback) -> Callback:
    """Mark a widget's callback to be called on viser's event loop as soon as a page's message is there.

    viser would call it later, on some thread: by then the next message may have changed the widget's value. So it
    must not take long. A coroutine is called in time too, but viser makes one also of what Python itself sets, and
    where the loop ends before its turn nobody awaits it.
    """
    callback.__dict__["at_once"] = True
    return callback


class _GuardedExecutor:
    """An executor whose tasks report what they raise, instead of a traceback on the server's terminal."""

    def __init__(self, executor: Executor, failed: Callable[[Exception], None]) -> None:
        self._executor, self._failed = executor, failed

    def submit(self, task: Callable[..., Any], *words: Any) -> Future[None]:
        """As ``Executor.submit``, but for tasks that are to be done at once."""
        if getattr(task, "at_once", False):
            self._run(task, words)
            done: Future[None] = Future()
            done.set_result(None)
            return done
        return self._executor.submit(self._run, task, words)

    def _run(self, task: Callable[..., Any], words: tuple[Any, ...]) -> None:
        try:
            task(*words)
        except Exception as error:
            self._failed(error)


def guard_callbacks(client: viser.ClientHandle, failed: Callable[[Exception], None]) -> None:
    """Have ``failed`` called with whatever a callback of this client's widgets and scene raises."""
    for part in (client.gui, client.scene):
        executor: Any = _GuardedExecutor(part._thread_executor, failed)
        part._thread_executor = executor


@contextlib.contextmanager
def _demand(key: str) -> Iterator[None]:
    """While open, websocket servers that are started demand the key of every request.

    ``websockets`` has a hook for this (``process_request``) but viser fills it itself and offers no other, so
    the call is wrapped for the moment of viser's start. If viser should start its server in another way, this
    raises rather than leave the port open.
    """
    original = websockets.asyncio.server.serve
    started = []

    def serve(*args: Any, process_request: Callable[..., Any], **options: Any) -> Any:
        started.append(True)

        def checked(connection: Any, request: Any) -> Any:
            if not hmac.compare_digest(request.headers.get(KEY_HEADER, "").encode(), key.encode()):
                return connection.respond(403, "Forbidden\n")
            return process_request(connection, request)

        return original(*args, process_request=checked, **options)

    websockets.asyncio.server.serve = serve  # type: ignore[assignment]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = original
    if not started:
        raise RuntimeError("this version of viser starts its server in an unknown way; install viser 1.1.1.")


def _disable_sharing(server: viser.ViserServer) -> None:
    connection = server._websock_server
    for message in (_messages.ShareUrlRequest, _messages.ShareUrlDisconnect):
        connection.unregister_handler(message)
        connection.register_handler(message, lambda client, message: None)


class _LoopEvent(asyncio.Event):
    """An event that only its own loop sets; elsewhere ``set`` does nothing."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        super().__init__()
        self._home = loop

    def set(self) -> None:
        """As ``asyncio.Event.set``, on the loop's thread."""
        try:
            at_home = asyncio.get_running_loop() is self._home
        except RuntimeError:
            at_home = False
        if at_home:
            super().set()


def _wake_on_loop(server: viser.ViserServer) -> None:
    """Have those who wait for messages woken on the event loop only.

    viser sets their event on the thread that queues a message and then, safely, on the loop; the former raises now and
    then, since the loop may change the event's waiters meanwhile. The latter alone suffices: a message is in its buffer
    before, so whoever waits, or is about to, finds it.
    """
    sockets: Any = server._websock_server
    loop = sockets._background_event_loop
    sockets._broadcast_buffer.message_event = _LoopEvent(loop)

    def connected(client: Any) -> None:
        request = sockets._live_connections[client.client_id].request
        client.role_header = request.headers.get(ROLE_HEADER, "")
        client.get_message_buffer().message_event = _LoopEvent(loop)

    # Before viser's own callback, from which on messages are queued, and before anybody waits for one.
    sockets._client_connect_cb.insert(0, connected)
