"""A page connected to a real viser server, without a browser: it sends what it is told and notes what it gets."""

import asyncio
import contextlib
import threading
from collections.abc import Callable, Iterator
from typing import Any

import aiohttp
import msgspec
import viser
import zstandard

from spherloc_viz.app.web.access import Role
from spherloc_viz.app.web.viser_internals import KEY_HEADER, LINK_HEADER, ROLE_HEADER
from tests.waiting import LIMIT_S, until

KEY = "a key of this test"
"""That of a viser server of tests."""
HELLO = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (0.0, 0.0, -3.0),
    "fov": 1.0,
    "near": 0.01,
    "far": 100.0,
    "image_height": 72,
    "image_width": 128,
    "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, -1.0, 0.0),
}


class Wire:
    """A connection to viser on a thread and an event loop of its own, which end with it."""

    def __init__(self, port: int, key: str, role: str = Role.PRESENTER, linked: bool = False) -> None:
        """Connect, and say what a page says first; ``linked`` is one that was opened by a link."""
        self._port = port
        self._headers = {KEY_HEADER: key, ROLE_HEADER: role} | ({LINK_HEADER: "linked"} if linked else {})
        self._loop, self._leaving = asyncio.new_event_loop(), asyncio.Event()
        self._socket: aiohttp.ClientWebSocketResponse | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        until(lambda: self._socket is not None)
        self.send(HELLO)

    def _run(self) -> None:
        with contextlib.closing(self._loop):
            self._loop.run_until_complete(self._live())

    async def _live(self) -> None:
        """Read until the server or the page leaves."""
        async with aiohttp.ClientSession() as client:
            self._socket = await client.ws_connect(
                f"http://127.0.0.1:{self._port}/",
                headers=self._headers,
                protocols=[f"viser-v{viser.__version__}"],
                max_msg_size=0,
            )
            ends = {asyncio.create_task(self._read(self._socket)), asyncio.create_task(self._leaving.wait())}
            done, rest = await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)
            for task in rest:
                task.cancel()
            await asyncio.gather(*rest, return_exceptions=True)
            await self._socket.close()
            for task in done:
                task.result()

    async def _read(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        async for message in socket:
            for reply in self.heard(message.data):
                await socket.send_bytes(msgspec.msgpack.encode(reply))

    def heard(self, data: bytes) -> Iterator[dict[str, Any]]:
        """What is answered to a packet of messages: nothing."""
        return iter(())

    def send(self, message: dict[str, Any]) -> None:
        """Send a message as the page's script would."""
        assert self._socket is not None
        sending = self._socket.send_bytes(msgspec.msgpack.encode(message))
        asyncio.run_coroutine_threadsafe(sending, self._loop).result(LIMIT_S)

    def close(self) -> None:
        """Leave."""
        # The loop is closed already where the server went first.
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._leaving.set)
        self._thread.join(LIMIT_S)
        assert not self._thread.is_alive()


class ConnectedPage(Wire):
    """One client; ``handle`` is viser's of it."""

    def __init__(self, server: viser.ViserServer, key: str) -> None:
        self.answer: Callable[[dict[str, Any]], dict[str, Any] | None] = lambda message: None
        """Called with every message; what it returns is sent."""
        self.files: dict[str, bytes] = {}
        """What was downloaded, by name."""
        self._names: dict[str, str] = {}
        known = set(server.get_clients())
        super().__init__(server.get_port(), key)
        until(lambda: set(server.get_clients()) - known)
        (number,) = set(server.get_clients()) - known
        self.handle = server.get_clients()[number]

    def heard(self, data: bytes) -> Iterator[dict[str, Any]]:
        """Notes files, and asks ``answer`` what to say."""
        for message in _messages(data):
            if message["type"] == "FileTransferStartDownload":
                self._names[message["transfer_uuid"]] = message["filename"]
            elif message["type"] == "FileTransferPart":
                name = self._names[message["transfer_uuid"]]
                self.files[name] = self.files.get(name, b"") + message["content"]
            reply = self.answer(message)
            if reply is not None:
                yield reply

    def press(self, button: Any) -> None:
        """Press a button."""
        self.send({"type": "GuiUpdateMessage", "uuid": button._impl.uuid, "updates": {"value": True}})

    def upload(self, button: Any, name: str, content: bytes, said: int | None = None, part: int = 100_000) -> None:
        """Upload a file; ``said`` is the size that is announced."""
        parts = [content[at : at + part] for at in range(0, len(content), part)]
        start = {"type": "FileTransferStartUpload", "source_component_uuid": button._impl.uuid, "transfer_uuid": name}
        size = len(content) if said is None else said
        self.send(start | {"filename": name, "mime_type": "", "part_count": len(parts), "size_bytes": size})
        for number, piece in enumerate(parts):
            message = {"type": "FileTransferPart", "source_component_uuid": button._impl.uuid, "transfer_uuid": name}
            self.send(message | {"part_index": number, "content": piece})


def _messages(data: bytes) -> list[dict[str, Any]]:
    """The messages of a packet, without their arrays: two lengths, then msgpack in zstd, then arrays."""
    length = int.from_bytes(data[8:16], "little")
    return msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(data[16 : 16 + length]))["messages"]
