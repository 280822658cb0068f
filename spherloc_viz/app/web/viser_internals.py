"""Everything that depends on viser's internals, so that a new version of viser is checked against one file."""

import asyncio
import contextlib
import contextvars
import hmac
import io
import logging
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from functools import cache
from typing import Any, TypeVar, get_type_hints

import numpy as np
import viser
import websockets.asyncio.server
from aiohttp.http_exceptions import HttpProcessingError
from aiohttp.web import RequestPayloadError
from viser import _messages
from viser._assignable_props_api import AssignablePropsBase

from spherloc.types import FloatArray
from spherloc_viz.app.web.changes import Changes

log = logging.getLogger(__name__)


def keep_tracebacks_short() -> None:
    """Have requests that are none pass in silence, and a page that sends what is no message told in a line."""
    logging.getLogger("aiohttp.server").addFilter(_is_news)
    logging.getLogger("websockets.server").addFilter(_in_short)
    warnings.filterwarnings("ignore", message=r"\[viser\] .* does not match annotation")


def tell_in_short(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """A loop's exception handler: a line of what a page's message raised, unless the error is ours."""
    error = context.get("exception")
    if isinstance(error, Exception) and not _is_ours(error):
        log.warning("a page sent a value that is none; it was left out (%s).", type(error).__name__)
    else:
        loop.default_exception_handler(context)


def _is_news(record: logging.LogRecord) -> bool:
    """Not what was answered with a 400 already or is no body as its header says, nor that the other side has gone."""
    error = record.exc_info[1] if record.exc_info else None
    return not isinstance(error, HttpProcessingError | RequestPayloadError | ConnectionError)


def _in_short(record: logging.LogRecord) -> bool:
    error = record.exc_info[1] if record.exc_info else None
    if isinstance(error, Exception) and not _is_ours(error):
        record.levelno, record.levelname, record.args, record.exc_info = logging.WARNING, "WARNING", (), None
        record.msg = f"a page was cut off, since what it sent is no message of a page ({type(error).__name__})."
    return True


def _is_ours(error: Exception) -> bool:
    return any("spherloc_viz" in frame.filename for frame in traceback.extract_tb(error.__traceback__))


KEY_HEADER = "X-Spherloc-Key"
"""Request header that carries the key; a web page cannot set headers on a websocket, a program can."""
ROLE_HEADER = "X-Spherloc-Role"
"""Request header that says what the page may do, next to the key."""
LINK_HEADER = "X-Spherloc-Link"
"""Request header of a page that was opened by a link, which it will tell."""
ANSWERS = "answers"
"""Carries, beside a value for a widget, the number of the change that it answers; ``changes.js`` takes it out."""

Callback = TypeVar("Callback", bound=Callable[..., None])


def start_viser(key: str) -> viser.ViserServer:
    """A viser server on a free loopback port that answers only requests carrying ``key``.

    viser checks neither Host nor Origin and lets any client open a public tunnel. So it listens on loopback
    only, every request without the key is refused before the websocket opens (a page of another site that
    guesses the port gets a 403), and the tunnel messages do nothing.
    """
    # viser greets with a panel naming the internal address, which no browser can reach.
    with _demand(key), contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host="127.0.0.1", port=0, label="spherloc", verbose=False)
    _disable_sharing(server)
    _wake_on_loop(server)
    keep_tracebacks_short()
    _remember_types()
    server.get_event_loop().set_exception_handler(tell_in_short)
    # A page that leaves while it is being drawn is no news for the terminal.
    warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
    return server


def _remember_types() -> None:
    """Look up the types of properties once for a kind of handle; viser does so for every handle, which takes longer
    than all else about a node of the canvas."""
    kinds = cache(get_type_hints)
    handles: Any = AssignablePropsBase
    handles._prop_hints = property(lambda handle: kinds(type(handle._impl.props)))


def set_theme(gui: viser.GuiApi, theme: str) -> None:
    """Make a page, or the pages to come, "dark" or "light"."""
    gui.configure_theme(dark_mode=theme == "dark", show_logo=False, show_share_button=False)


def role_header(client: viser.ClientHandle) -> str:
    """What the header of a client's connection said of its role; empty if nothing."""
    return client._websock_connection.__dict__.get("role_header", "")


def is_linked(client: viser.ClientHandle) -> bool:
    """Whether a client's page was opened by a link, which it will tell."""
    return client._websock_connection.__dict__.get("linked", False)


def stop_viser(server: viser.ViserServer) -> None:
    """Stop it without its farewell."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def changes_of(part: Any) -> Changes:
    """The numbers of what a user changes in a client's ``gui``."""
    return part.__dict__.setdefault("_spherloc_changes", Changes())


def number_of(handle: Any) -> int:
    """The number of a widget's newest change."""
    state = handle._impl
    return changes_of(state.gui_api).of(state.uuid)


def put(handle: Any, value: Any) -> None:
    """Set a widget's value, unless it was changed since what this thread knows (``Changes.as_of``).

    The widget's callbacks are not called: they are for hands.
    """
    state = handle._impl
    with changes_of(state.gui_api).writing(state.uuid) as number:
        value = type(state.value)(value)
        if number is None or state.value == value:
            return
        message = _messages.GuiUpdateMessage(state.uuid, {"value": value, ANSWERS: number})
        state.gui_api._websock_interface.queue_message(message)
        state.value, state.update_timestamp = value, time.time()


def update_widget(handle: Any, **props: Any) -> None:
    """Set properties of a widget, such as the content of HTML; sends those that differ, and nothing if none does.

    Setting them on the handle does the same, but takes viser ten times as long: it looks up what types they may have.
    """
    state = handle._impl
    updates = _changed(state.props, props)
    if updates and not state.removed:
        state.gui_api._websock_interface.queue_message(_messages.GuiUpdateMessage(state.uuid, updates))


def update_node(handle: Any, **props: Any) -> None:
    """Set properties of a node of the canvas, as ``update_widget``. Arrays have its types and stay as they are."""
    state = handle._impl
    updates = _changed(state.props, props)
    if updates and not state.removed:
        state.api._queue_scene_message(_messages.SceneNodeUpdateMessage(state.name, updates))


def _changed(known: Any, props: dict[str, Any]) -> dict[str, Any]:
    """Those of the properties that differ from the known ones, which follow them."""
    updates = {}
    for name, value in props.items():
        before = getattr(known, name)
        same = np.array_equal(before, value) if isinstance(value, np.ndarray) else before == value
        if not same:
            setattr(known, name, value)
            updates[name] = value
    return updates


@contextlib.contextmanager
def sent_at_once(client: viser.ClientHandle) -> Iterator[None]:
    """While open, messages to a client are collected; then they are sent together, at once.

    ``atomic`` and then ``flush`` do the same, but wake viser's thread twice, the first time to wait; each time the
    thread that draws waits for the interpreter's lock.
    """
    buffer = client._websock_connection.get_message_buffer()
    buffer.atomic_start()
    try:
        yield
    finally:
        with buffer.buffer_lock:
            buffer.atomic_counter -= 1

        def wake() -> None:
            buffer.message_event.set()
            buffer.flush_event.set()

        with contextlib.suppress(RuntimeError):  # the loop has ended
            buffer.event_loop.call_soon_threadsafe(wake)


def place_viewer(client: viser.ClientHandle, position: FloatArray, target: FloatArray) -> None:
    """Put a client's viewer at a position (3,), where it looks at another place, the target (3,).

    Setting the two on the camera sends the same, but viser then moves the target along with the position first, and
    works out twice how the viewer is turned.
    """
    camera = client.camera
    state = camera._state
    if np.array_equal(state.position, position) and np.array_equal(state.look_at, target):
        return
    state.position, state.look_at = np.array(position, dtype=np.float64), np.array(target, dtype=np.float64)
    camera._update_wxyz()
    state.update_timestamp = time.time()
    for message in (
        _messages.SetCameraPositionMessage(tuple(position.tolist())),
        _messages.SetCameraLookAtMessage(tuple(target.tolist())),
    ):
        state.client._websock_connection.queue_message(message)


def put_handle(handle: Any, wxyz: Any, position: Any) -> None:
    """Put a handle on the canvas somewhere, unless it was dragged since what this thread knows."""
    gui = handle._impl.api._owner.gui
    with changes_of(gui).writing(handle.name) as number:
        if number is not None:
            handle.wxyz, handle.position = np.asarray(wxyz), np.asarray(position)


def follow_changes(client: viser.ClientHandle, pressed: Callable[[Any], None]) -> Changes:
    """Number what a user changes on a client's page, and what is set in answer.

    ``pressed`` is called at once with what the page reports of other presses.

    viser would take a value over and call the callbacks on threads that run ahead of it or behind, and send values
    without a number. ``changes.js`` is what the page does about them.
    """
    changes = changes_of(client.gui)
    connection: Any = client._websock_connection
    handle_others, queue = connection._handle_incoming_message, connection.queue_message
    poses = _messages.SetPositionMessage, _messages.SetOrientationMessage

    async def handle(client_id: Any, message: Any) -> None:
        if type(message) is _messages.GuiUpdateMessage:
            _hear(client, changes, message, pressed)
        else:
            with changes.as_of(changes.now()):
                await handle_others(client_id, message)

    def send(message: Any) -> None:
        if type(message) is _messages.GuiUpdateMessage and "value" in message.updates:
            message.updates.setdefault(ANSWERS, changes.moment())
        elif isinstance(message, poses) and message.name in client.scene._handle_from_transform_controls_name:
            queue(_messages.GuiUpdateMessage(message.name, {ANSWERS: changes.moment()}))
        queue(message)

    connection._handle_incoming_message, connection.queue_message = handle, send
    return changes


def _hear(client: viser.ClientHandle, changes: Changes, message: Any, pressed: Callable[[Any], None]) -> None:
    """Take over what a user has changed, and call the callbacks, which are not coroutines."""
    if not (isinstance(message.uuid, str) and isinstance(message.updates, dict)):
        return
    gui: Any = client.gui
    handle, number, gesture = (
        gui._gui_input_handle_from_uuid.get(message.uuid),
        *(word if type(word := message.updates.get(name)) is int else None for name in ("change", "gesture")),
    )
    with changes.hearing(message.uuid, number):
        changes.gesture = gesture or changes.gesture
        if "touch" in message.updates:
            pressed(message.updates["touch"])
        if handle is None or "value" not in message.updates:
            return
        state, sent = handle._impl, message.updates["value"]
        taken = _taken(handle, sent)
        same, state.value, state.update_timestamp = taken == state.value, taken, time.time()
        if not state.is_button and taken != (tuple(sent) if isinstance(sent, list) else sent):
            # The page shows what it sent.
            gui._websock_interface.queue_message(_messages.GuiUpdateMessage(message.uuid, {"value": taken}))
        if same and not state.is_button:
            return
        event = viser.GuiEvent(client, client.client_id, handle)
        for callback in tuple(state.update_cb):
            gui._thread_executor.submit(callback, event)


def _taken(handle: Any, sent: Any) -> Any:
    """What a widget makes of a value that the page sent; what it had if that cannot be."""
    value = handle._impl.value
    if isinstance(handle, viser.GuiDropdownHandle) and sent not in handle.options:
        return value
    try:
        if isinstance(value, tuple):
            return tuple(type(old)(new) for old, new in zip(value, sent, strict=True))
        return type(value)(sent)
    except (TypeError, ValueError, OverflowError):
        return value


def at_once(callback: Callback) -> Callback:
    """Mark a widget's callback to be called on viser's event loop as soon as a page's message is there.

    viser would call it later, on some thread: by then the next message may have changed the widget's value. So it
    must not take long. A coroutine is called in time too, but viser makes one also of what Python itself sets, and
    where the loop ends before its turn it is never awaited.
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
        return self._executor.submit(contextvars.copy_context().run, self._run, task, words)

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

    module: Any = websockets.asyncio.server
    module.serve = serve
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
    before, so a thread that waits, or is about to, finds it.
    """
    sockets: Any = server._websock_server
    loop = sockets._background_event_loop
    sockets._broadcast_buffer.message_event = _LoopEvent(loop)

    def connected(client: Any) -> None:
        request = sockets._live_connections[client.client_id].request
        client.role_header = request.headers.get(ROLE_HEADER, "")
        client.linked = LINK_HEADER in request.headers
        client.get_message_buffer().message_event = _LoopEvent(loop)
        _check_views(client)

    # Before viser's own callback, from which on messages are queued, and before anybody waits for one.
    sockets._client_connect_cb.insert(0, connected)


def _check_views(connection: Any) -> None:
    """Ignore a viewer's place that a page reports if its numbers are invalid: viser would keep it, and raise an error
    whenever the viewer is moved."""
    handle_all = connection._handle_incoming_message

    async def handle(client_id: Any, message: Any) -> None:
        if type(message) is not _messages.ViewerCameraMessage or _is_view(message):
            await handle_all(client_id, message)

    connection._handle_incoming_message = handle


def _is_view(message: Any) -> bool:
    try:
        sizes = _numbers((message.fov, message.near, message.far, message.image_height, message.image_width), 5)
        wxyz, up = _numbers(message.wxyz, 4), _numbers(message.up_direction, 3)
        with np.errstate(over="ignore", invalid="ignore"):
            ahead = _numbers(message.look_at, 3) - _numbers(message.position, 3)
            lengths = [np.linalg.norm(one) for one in (wxyz, up, ahead)]
    except ValueError:
        return False
    return bool(np.isfinite([*sizes, *lengths]).all() and min(lengths) > 0.0)


def _numbers(values: Any, count: int) -> FloatArray:
    """What a page sent as so many numbers; raises ``ValueError`` if it is anything else."""
    numbers = np.asarray(values)
    if numbers.dtype.kind not in "iuf" or numbers.shape != (count,):
        raise ValueError(f"not {count} numbers")
    return numbers.astype(np.float64)


MAX_AT_ONCE = 2
"""Files on their way."""
MIN_PART_BYTES = 4096
"""The page sends parts of half a megabyte; far smaller ones would fill the memory with their bookkeeping."""


def limit_uploads(client: viser.ClientHandle, most_bytes: int, complain: Callable[[str], None]) -> None:
    """Drop files of more than ``most_bytes``, whether the page says so or just sends more; tell ``complain`` why."""
    gui, connection = client.gui, client._websock_connection
    begin, add = gui._handle_file_transfer_start, gui._handle_file_transfer_part
    under_way = gui._current_file_upload_states

    def refuse(message: Any, sentence: str) -> None:
        # Else the page would wait for ever, with its button disabled.
        ack = _messages.FileTransferPartAck(message.source_component_uuid, message.transfer_uuid, 1, 1)
        connection.queue_message(ack)
        complain(sentence)

    def checked_begin(client_id: Any, message: Any) -> None:
        parts = max(1, most_bytes // MIN_PART_BYTES)
        if not (0 <= message.size_bytes <= most_bytes and 0 <= message.part_count <= parts):
            refuse(message, f"the file is larger than {most_bytes / 1e6:.2g} MB; upload a smaller one.")
        elif len(under_way) >= MAX_AT_ONCE:
            refuse(message, "two files are on their way already; wait for them.")
        else:
            begin(client_id, message)

    def checked_add(client_id: Any, message: Any) -> None:
        state = under_way.get(message.transfer_uuid)
        if state is not None and state["transferred_bytes"] + len(message.content) > state["total_bytes"]:
            under_way.pop(message.transfer_uuid, None)
            refuse(message, "the file is larger than it said; upload it again.")
            return
        add(client_id, message)

    handlers: Any = (
        (_messages.FileTransferStartUpload, begin, checked_begin),
        (_messages.FileTransferPart, add, checked_add),
    )
    for kind, original, checked in handlers:
        connection.unregister_handler(kind, original)
        connection.register_handler(kind, checked)
