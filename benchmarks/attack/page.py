"""Attacks a running playground on this machine: requests, and messages through the websocket of its page."""

import asyncio
import contextlib
import json
import re
import subprocess
import tempfile
import time
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import IO, Any
from urllib.parse import urlsplit

import aiohttp
import msgspec
import numpy as np

from benchmarks.attack.damage import damaged
from benchmarks.attack.drops import attack_drops
from benchmarks.attack.files import Tally
from benchmarks.page_client import HELLO, PageClient
from benchmarks.playground import SCENE, memory_mib, playground

REQUESTS, PRESSES, MESSAGES = ("requests without the token", "requests with it"), "presses", "websocket messages"
DROPPED = "dropped photographs"
CONTINUE = 100
"""The status that says no more than that the request may go on."""
ANSWER_S = 2.0
"""Half a request is answered with nothing: the server waits for the rest."""
EACH = 25
"""After so many messages another page must find the playground as it should be."""
PATHS = (
    "/", "/?darkMode", "/viewer/", "/viewer/?run=a.rrd&step=0", "/viewer/data/a.rrd", "/viewer/program/1/x",
    "/viewer/data/../../../../etc/passwd", "/viewer/data/%2e%2e%2f%2e%2e%2fetc%2fpasswd", "//evil.example/", "/%00",
    "*",
    "/viewer/?run=" + "a" * 5000, "/viewer/data/" + "n" * 300 + ".rrd", "/viewer/?step=" + "9" * 5000, "/?token=x",
    "/?websocket=ws://evil.example", "/viewer/data/runs.sqlite", "/viewer/?run=%ff%fe", "/\u202e", "/viewer/data/.", "",
)  # fmt: skip
METHODS = ("GET", "HEAD", "POST", "PUT", "OPTIONS", "CONNECT", "TRACE", "get", "G\0T", "X" * 200)
HEADERS = (
    "Host: 127.0.0.1:{port}", "Host: evil.example", "Host: [::1", "Origin: http://127.0.0.1:{port}", "Origin: null",
    "Origin: http://evil.example", "Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13",
    "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", "Sec-WebSocket-Key: x", "Content-Length: -1", "Content-Length: 5",
    "Content-Length: 99999999999999999999", "Transfer-Encoding: chunked", "Cookie: {cookie}",
    "Cookie: " + "a=b; " * 500,
    "Cookie: spherloc-0=x", "Accept-Encoding: gzip", "Accept: text/html", "X: " + "y" * 9000, "Range: bytes=-1",
    "Expect: 100-continue", "X-Spherloc-Key: x", "X-Spherloc-Role: presenter", "Sec-WebSocket-Protocol: viser-v0",
)  # fmt: skip
PROPERTIES = ("value", "label", "visible", "x")
OTHERS = ("RunJavascriptMessage", "Nothing", "", "GuiRemoveMessage", "SetCameraPositionMessage")
VALUES: tuple[Any, ...] = (
    None, True, -1, 10**18, -(2**63), 0.5, float("nan"), float("inf"), "", "x" * 10_000, "\u202e\u0000<script>",
    "../" * 50,
    "1e308", b"\0" * 100, [], [1, 2, 3], [[[]]], {}, {"a": {"b": None}}, "/dev/zero", "-0", "nan", "9" * 400,
)  # fmt: skip


def attack_page(count: int, seed: int) -> dict[str, Tally]:
    """So many requests without a token, with one, to the address of dropped photographs, presses, and messages through
    the websocket; what came of each."""
    tallies = {name: Tally() for name in (*REQUESTS, DROPPED, PRESSES, MESSAGES)}
    with (
        tempfile.TemporaryFile("w+") as errors,
        tempfile.TemporaryDirectory() as place,
        _served(Path(place) / "kept", errors) as (link, server),
    ):
        asyncio.run(_attack(link, server, tallies, (count, Path(place) / "kept"), np.random.default_rng([seed, 1])))
        memory_mb = memory_mib(server.pid)
        errors.seek(0)
        printed = errors.read()
    for text in printed.split("Traceback (most recent call last)")[1:]:
        tally = tallies.setdefault("the terminal", Tally())
        tally.add(_answer(tally.tried, "traceback", 0.0, memory_mb, text[-2000:]))
    return tallies


def _served(kept: Path, errors: IO[str]) -> AbstractContextManager[tuple[str, subprocess.Popen[str]]]:
    """The link to a playground, and its process, which keeps what is dropped in the new folder ``kept``."""
    kept.mkdir()
    return playground(SCENE, None, "--token", "--allow", str(kept), errors=errors)


async def _attack(
    link: str,
    server: subprocess.Popen[str],
    tallies: dict[str, Tally],
    much: tuple[int, Path],
    rng: np.random.Generator,
) -> None:
    """``much`` is the number of attacks of each kind, and the folder in which dropped photographs are kept."""
    count, kept = much
    parts = urlsplit(link)
    port = parts.port or 0
    cookie = await _cookie(link)
    for number in range(count):
        for name, known in zip(REQUESTS, ("none=x", cookie), strict=True):
            start = time.perf_counter()
            status = await _request(port, _hostile_request(rng, port, known))
            outcome = "accepted" if status < 400 else "traceback" if status == 500 else "sentence"
            if status < 400 and status != CONTINUE and known != cookie:
                outcome = "let in"
            _note(tallies[name], number, outcome, time.perf_counter() - start, server, f"status {status}")
    await _press(f"http://{parts.netloc}/", cookie, server, tallies[PRESSES], count, rng)
    await _talk(f"http://{parts.netloc}/", cookie, server, tallies[MESSAGES], count, rng)
    async with PageClient(f"http://{parts.netloc}/", cookie=cookie) as page:
        await page.until(lambda: page.says("data-drops"), 120.0)
        to = port, cookie, partial(_request, port)
        number = 0
        async for outcome, seconds, what in attack_drops(page, to, kept, count, rng):
            _note(tallies[DROPPED], number, outcome, seconds, server, what)
            number += 1


def _note(tally: Tally, number: int, outcome: str, seconds: float, server: subprocess.Popen[str], wrong: str) -> None:
    if server.poll() is not None:
        raise RuntimeError(f"the playground ended with code {server.returncode} after {wrong}")
    tally.add(_answer(number, outcome, seconds, memory_mib(server.pid), wrong))


def _answer(number: int, outcome: str, seconds: float, memory_mb: float, wrong: str) -> dict[str, Any]:
    told = "" if outcome in ("accepted", "sentence") else wrong
    return {
        "number": number, "file": "the page", "outcome": outcome, "said": "", "wrong": told, "seconds": seconds,
        "peak_mb": memory_mb,
    }  # fmt: skip


async def _cookie(link: str) -> str:
    async with aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True)) as client:
        response = await client.get(link)
        return response.headers["Set-Cookie"].split(";")[0]


def _hostile_request(rng: np.random.Generator, port: int, cookie: str) -> bytes:
    """A request of odd parts, of which some are damaged once more."""
    method = METHODS[0] if rng.random() < 0.7 else str(rng.choice(METHODS))
    lines = [f"{method} {rng.choice(PATHS[: 8 if rng.random() < 0.5 else None])} HTTP/1.1"]
    lines += [HEADERS[0]] * (rng.random() < 0.9) + [f"Cookie: {cookie}"] * (rng.random() < 0.8)
    lines += [str(header) for header in rng.choice(HEADERS, size=rng.integers(0, 4))]
    text = "\r\n".join(line.replace("{port}", str(port)).replace("{cookie}", cookie) for line in lines)
    data = text.encode("utf-8", "surrogatepass") + b"\r\n\r\n" + rng.bytes(int(rng.integers(0, 50)))
    return damaged(data, rng) if rng.random() < 0.3 else data


async def _request(port: int, data: bytes) -> int:
    """The status that it is answered with; 400 if the connection is just closed."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    try:
        with contextlib.suppress(ConnectionError):
            writer.write(data)
            await writer.drain()
            line = await asyncio.wait_for(reader.readline(), ANSWER_S)
            match = re.match(rb"HTTP/1\.[01] (\d{3})", line)
            return int(match[1]) if match else 400
        return 400
    except TimeoutError:
        return 400
    finally:
        writer.close()


async def _press(
    address: str, cookie: str, server: subprocess.Popen[str], tally: Tally, count: int, rng: np.random.Generator
) -> None:
    """Reports of presses."""
    async with PageClient(address, cookie=cookie) as page:
        await page.until(lambda: page.says("data-ready"), 120.0)
        await page.until(lambda: page.says("data-ready"), 120.0)
        said = " ".join(page.html.values())
        others = {"run-open", "run-label", "runs-export", "run-mark"}
        actions = sorted(set(re.findall(r'data-touch="([\w-]+):', said)) | others)
        good = {"action": "select:1", "at": [0.5, 0.5], "from": [0.5, 0.5], "extend": False}
        for number in range(count):
            argument = str(VALUES[int(rng.integers(len(VALUES)))]) if rng.random() < 0.7 else str(rng.integers(-5, 200))
            report = good | {"action": f"{rng.choice(actions)}:{argument}"}
            if rng.random() < 0.4:
                report[str(rng.choice(list(report)))] = _plain(VALUES[int(rng.integers(len(VALUES)))])
            body = json.dumps(report).encode()
            body = damaged(body, rng) if rng.random() < 0.3 else body
            start = time.perf_counter()
            said = body.decode("utf-8", "replace") if rng.random() < 0.9 else body
            await page.send({"type": "GuiUpdateMessage", "uuid": "", "updates": {"touch": said}})
            outcome = "accepted" if not page._socket.closed else "the page was cut off"
            _note(tally, number, outcome, time.perf_counter() - start, server, repr(body[:300]))
        await page.set("Seed", "4711")
        await page.until(lambda: page.says("_4711_") or page.says("Opened"), 120.0)


def _plain(value: Any) -> Any:
    return value.decode("latin-1") if isinstance(value, bytes) else value


async def _talk(
    address: str, cookie: str, server: subprocess.Popen[str], tally: Tally, count: int, rng: np.random.Generator
) -> None:
    """Messages to the page's widgets and to none; between them another page must find all as it should be."""
    number = 0
    while number < count:
        async with PageClient(address, cookie=cookie) as page:
            await page.until(lambda page=page: page.says("data-ready"), 120.0)
            for _ in range(EACH):
                data = _hostile_message(rng, page)
                start, outcome = time.perf_counter(), "accepted"
                try:
                    if rng.random() < 0.03:
                        await page._socket.send_str(data[:1000].decode("latin-1"))
                    else:
                        await page._socket.send_bytes(data)
                    await asyncio.sleep(0.01)
                except (ConnectionError, aiohttp.ClientError):
                    outcome = "sentence"
                if page._socket.closed:
                    outcome = "sentence"
                _note(tally, number, outcome, time.perf_counter() - start, server, repr(data[:200]))
                number += 1
                if outcome == "sentence":
                    break
        start = time.perf_counter()
        async with PageClient(address, cookie=cookie) as page:
            try:
                await page.until(lambda page=page: page.says("data-ready"), 120.0)
            except TimeoutError:
                seconds = time.perf_counter() - start
                _note(tally, number, "no more pages", seconds, server, "a page that was opened stayed empty")
                return


def _hostile_message(rng: np.random.Generator, page: PageClient) -> bytes:
    widgets = list(page.widgets)
    uuid, value = str(rng.choice(widgets)), VALUES[int(rng.integers(len(VALUES)))]
    kinds: tuple[dict[str, Any], ...] = (
        {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value}},
        {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {str(rng.choice(PROPERTIES)): value}},
        {"type": "FileTransferStartUpload", "source_component_uuid": uuid, "transfer_uuid": "t", "filename": "../../a",
         "mime_type": "x", "part_count": int(rng.integers(-1, 10**9)), "size_bytes": int(rng.integers(-1, 10**12))},
        {"type": "FileTransferPart", "source_component_uuid": uuid, "transfer_uuid": "t",
         "part_index": int(rng.integers(-1, 9)), "content": rng.bytes(100)},
        {"type": "CommandTriggerMessage", "uuid": uuid},
        HELLO | {str(rng.choice(list(HELLO)[1:])): value},
        HELLO | {"position": [float("nan")] * 3},
        {"type": "SceneNodeClickMessage", "name": "/map/points", "instance_index": int(rng.integers(-5, 10**9)),
         "ray_origin": [0, 0, 0], "ray_direction": [0, 0, 1], "screen_pos": [0.5, 0.5]},
        {"type": "ShareUrlRequest"},
        {"type": str(rng.choice(OTHERS))},
        {"type": value},
        {"a": value},
    )  # fmt: skip
    data = msgspec.msgpack.encode(kinds[int(rng.integers(len(kinds)))])
    choice = rng.random()
    if choice < 0.15:
        return damaged(data, rng)
    return rng.bytes(int(rng.integers(1, 300))) if choice < 0.2 else data
