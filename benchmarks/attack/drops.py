"""Attacks the address at which a running playground takes photographs that are dropped onto a page."""

import asyncio
import json
import re
import secrets
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from html import unescape
from pathlib import Path
from urllib.parse import quote

import numpy as np

from benchmarks.attack.damage import damaged
from benchmarks.page_client import PageClient

NAMES = (
    "../a.jpg", "../../a.jpg", "a/../../a.jpg", "..", "/etc/a.jpg", "/a.jpg", "//a.jpg", "C:\\a.jpg", "\\\\host\\a.jpg",
    "..\\a.jpg", "a.jpg\0", "\0", "", ".", ".ssh/a.jpg", "a/b/c/d/e/f.jpg", "n" * 300 + ".jpg", "n" * 5000 + ".jpg",
    "a\n.jpg", "\u202egpj.a.jpg", "con.jpg", "a.jpg.", "a.py", "a.html", "a.svg", "%2e%2e/a.jpg", "~/a", "a.jpg/",
)  # fmt: skip
"""What no dropped file may be called."""
COUNTS = ("-1", "0", "1e9", "999999999999", "9" * 400, "", "nan", "0x10", "\u0663")
LENGTHS = ("99999999999999", "9" * 30, "-5", "1e3", "+7")
"""What is said to be a body's length, of which eight bytes come."""
METHODS = ("GET", "HEAD", "PUT", "PATCH", "DELETE", "OPTIONS", "TRACE", "post")
ORIGINS = ("http://evil.example", "null", "http://127.0.0.1:1", "", "file://")
BURST = 200
"""So many files are sent at once."""

Ask = Callable[[bytes], Awaitable[int]]
"""Sends a request and returns the status of its answer."""
Noted = tuple[str, float, str]
"""The outcome of a request, seconds, and what was asked."""


class _Door:
    """The address of one page's drops, and requests to it."""

    def __init__(self, page: PageClient, port: int, cookie: str) -> None:
        said = re.search(r'data-drops="([^"]+)"', " ".join(page.html.values()))
        assert said is not None, "the page takes dropped photographs"
        self.address: str = json.loads(unescape(said[1]))["address"]
        self._port, self._cookie = port, cookie

    def request(self, what: str, body: bytes = b"bytes", **odd: str) -> bytes:
        """A request as the page makes it, but for what is ``odd``: ``method``, ``key``, ``origin``, ``length`` and
        ``cookie``."""
        address = f"/drop/{odd['key']}/" if "key" in odd else self.address
        origin = odd.get("origin", "http://127.0.0.1:{port}").replace("{port}", str(self._port))
        lines = (
            f"{odd.get('method', 'POST')} {address}{what} HTTP/1.1",
            f"Host: 127.0.0.1:{self._port}",
            *([f"Origin: {origin}"] if origin else []),
            f"Cookie: {odd.get('cookie', self._cookie)}",
            f"Content-Length: {odd.get('length', len(body))}",
        )
        return "\r\n".join(lines).encode() + b"\r\n\r\n" + body


def _begin(count: object = 3, size_bytes: object = 100, name: str = "rooms") -> str:
    return f"begin?name={quote(name)}&count={quote(str(count))}&bytes={quote(str(size_bytes))}"


def _file(name: str) -> str:
    return f"file?name={quote(name, safe='')}"


def _hostile(door: _Door, rng: np.random.Generator) -> bytes:
    """A request that must be refused."""
    good, kind = _file(f"{rng.integers(10**9)}.jpg"), int(rng.integers(7))
    if kind == 0:
        key = door.address.split("/")[2]
        keys = (secrets.token_urlsafe(32), key[:-1], f"{key}x", key.swapcase(), "..", "", f"{key}/..", "%2e%2e")
        return door.request(good, key=str(rng.choice(keys)))
    if kind == 1:
        return door.request(good, origin=str(rng.choice(ORIGINS)))
    if kind == 2:
        return door.request(good, cookie="none=x")
    if kind == 3:
        wrong = str(rng.choice(COUNTS))
        return door.request(_begin(count=wrong) if wrong == "0" or rng.random() < 0.5 else _begin(size_bytes=wrong))
    if kind == 4:
        return door.request(good, b"8 bytes.", length=str(rng.choice(LENGTHS)))
    if kind == 5:
        return door.request(str(rng.choice((good, _begin(), "end"))), method=str(rng.choice(METHODS)))
    return door.request(_file(NAMES[int(rng.integers(len(NAMES)))]))


def _harmless(door: _Door, rng: np.random.Generator) -> bytes:
    """A request in any order, of which some are damaged: it may be taken or not."""
    names = (f"{rng.integers(50)}.jpg", f"cam0/{rng.integers(50)}.png", "sensor.yaml")
    whats = (_begin(name="../" * int(rng.integers(3)) + "rooms"), *map(_file, names), "end", "cancel", "nothing", "")
    data = door.request(str(rng.choice(whats)), rng.bytes(int(rng.integers(2000))))
    return damaged(data, rng) if rng.random() < 0.3 else data


async def attack_drops(
    page: PageClient, to: tuple[int, str, Ask], folder: Path, count: int, rng: np.random.Generator
) -> AsyncIterator[Noted]:
    """So many requests to the drops of a page, at a port with a cookie (``to``), and then ``BURST`` files at once.

    Yields what came of each. Dropped photographs are kept in ``folder``, where nothing else may be left.
    """
    port, cookie, ask = to
    door = _Door(page, port, cookie)
    for _ in range(count):
        must_not = rng.random() < 0.7
        data, start = (_hostile if must_not else _harmless)(door, rng), time.perf_counter()
        status = await ask(data)
        outcome = "traceback" if status == 500 else "sentence" if status >= 300 else "accepted"
        wrong = must_not and outcome == "accepted"
        yield "let in" if wrong else outcome, time.perf_counter() - start, f"status {status}: {data[:300]!r}"
    start = time.perf_counter()
    await ask(door.request(_begin(BURST, 10**6, "burst")))
    statuses = await asyncio.gather(*(ask(door.request(_file(f"{n}.jpg"), bytes(1000))) for n in range(BURST)))
    taken = sum(status == 200 for status in statuses)
    ended = await ask(door.request("end"))
    for status in statuses:
        yield "accepted" if status == 200 else "sentence" if status in (409, 422) else "let in", 0.0, f"status {status}"
    kept = [path for path in folder.glob("dropped_burst*/*") if path.stat().st_size == 1000]
    whole = ended == 200 and len(kept) == taken > 0
    said = f"of {BURST} files at once {taken} were taken and {len(kept)} kept; the end has status {ended}"
    yield "accepted" if whole else "lost", time.perf_counter() - start, said
    await ask(door.request("cancel"))
    strange = [path for path in folder.parent.rglob("*") if path.is_file() and not _is_kept(path, folder)]
    hidden = list(folder.glob(".*"))
    yield "left" if strange or hidden else "accepted", 0.0, f"left: {[*strange, *hidden][:5]}"


def _is_kept(path: Path, folder: Path) -> bool:
    """Whether a file may be there: a photograph or a calibration in the folder of a drop."""
    return (
        path.is_relative_to(folder)
        and path.relative_to(folder).parts[0].startswith("dropped_")
        and path.suffix in (".jpg", ".png", ".yaml")
    )
