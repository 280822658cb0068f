"""A page without a screen: speaks viser's protocol through the front door, as the browser does, and draws nothing."""

import asyncio
import time
from dataclasses import dataclass, field
from typing import Any

import aiohttp
import msgspec
import viser
import zstandard

HELLO = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (3.0, -3.0, 3.0),
    "fov": 0.8,
    "near": 0.01,
    "far": 100.0,
    "image_height": 720,
    "image_width": 1280,
    "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, -1.0, 0.0),
}
"""What a page of 1280 x 720 says first."""
QUIET_S = 0.15
"""An answer is over when nothing has come for this long."""


@dataclass
class Widget:
    """A widget as the page knows it."""

    uuid: str
    kind: str
    props: dict[str, Any]
    value: Any = None
    change: int = 0
    """The number of its newest change."""


@dataclass
class Answer:
    """What followed a message."""

    seconds: float
    """From the message to the last byte before a pause."""
    bytes: int
    messages: int


@dataclass
class PageClient:
    """One connected page."""

    address: str
    widgets: dict[str, Widget] = field(default_factory=dict)
    """By uuid."""
    html: dict[str, str] = field(default_factory=dict)
    """What HTML elements say, by uuid."""
    received: int = 0
    """Bytes by now."""
    messages: int = 0
    last_s: float = 0.0
    """When the last bytes came."""
    changes: int = 0
    """Changes of widgets by now, which number them."""
    cookie: str = ""
    """What the link with a token gave, where one is needed."""

    async def __aenter__(self) -> "PageClient":
        self._session = aiohttp.ClientSession()
        self._socket = await self._session.ws_connect(
            self.address,
            headers={"Origin": self.address.rstrip("/")} | ({"Cookie": self.cookie} if self.cookie else {}),
            protocols=[f"viser-v{viser.__version__}"],
            max_msg_size=0,
            compress=0,
        )
        self._reader = asyncio.create_task(self._read())
        await self.send(HELLO)
        return self

    async def __aexit__(self, *problem: object) -> None:
        self._reader.cancel()
        await self._socket.close()
        await self._session.close()

    async def send(self, message: dict[str, Any]) -> None:
        """Send one message."""
        await self._socket.send_bytes(msgspec.msgpack.encode(message))

    async def set(self, label: str, value: Any) -> None:
        """Change the widget of that label, as a hand on the page does."""
        widget = self.widget(label)
        self.changes += 1
        widget.value, widget.change = value, self.changes
        updates = {"value": value, "change": self.changes}
        await self.send({"type": "GuiUpdateMessage", "uuid": widget.uuid, "updates": updates})

    def widget(self, label: str) -> Widget:
        """The widget of that label; raises ``KeyError`` if there is none."""
        for widget in self.widgets.values():
            if widget.props.get("label") == label:
                return widget
        raise KeyError(label)

    def says(self, text: str) -> bool:
        """Whether any HTML on the page contains that text."""
        return any(text in content for content in self.html.values())

    async def until(self, condition: Any, timeout_s: float = 60.0) -> None:
        """Wait until something is so; raises ``TimeoutError``."""
        end = time.perf_counter() + timeout_s
        while not condition():
            if time.perf_counter() > end:
                raise TimeoutError
            await asyncio.sleep(0.005)

    async def settle(self, quiet_s: float = QUIET_S) -> None:
        """Wait until nothing has come for a while."""
        while time.perf_counter() - self.last_s < quiet_s:
            await asyncio.sleep(quiet_s / 10)

    async def answer(self, label: str, value: Any, quiet_s: float = QUIET_S) -> Answer:
        """Change a widget and wait for all that follows at once."""
        bytes_before, messages_before, start = self.received, self.messages, time.perf_counter()
        await self.set(label, value)
        await self.until(lambda: self.last_s > start)
        await self.settle(quiet_s)
        return Answer(self.last_s - start, self.received - bytes_before, self.messages - messages_before)

    async def _read(self) -> None:
        decompressor = zstandard.ZstdDecompressor()
        async for frame in self._socket:
            self.last_s = time.perf_counter()
            data = frame.data
            self.received += len(data)
            size = int.from_bytes(data[8:16], "little")
            batch = msgspec.msgpack.decode(decompressor.decompress(data[16 : 16 + size]))
            for message in batch["messages"]:
                self.messages += 1
                self._take(message)

    def _take(self, message: dict[str, Any]) -> None:
        kind, uuid = message["type"], message.get("uuid", "")
        if kind.startswith("Gui") and "props" in message:
            self.widgets[uuid] = Widget(uuid, kind, dict(message["props"]), message.get("value"))
            if "content" in message["props"]:
                self.html[uuid] = message["props"]["content"]
        elif kind == "GuiUpdateMessage" and uuid in self.widgets:
            updates = message["updates"]
            widget = self.widgets[uuid]
            # As the page's script has it (``changes.js``).
            if updates.get("answers", widget.change) >= widget.change:
                widget.value = updates.get("value", widget.value)
            widget.props.update(updates)
            if "content" in updates:
                self.html[uuid] = updates["content"]
        elif kind == "GuiRemoveMessage":
            self.widgets.pop(uuid, None)
            self.html.pop(uuid, None)
