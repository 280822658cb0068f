"""The only door to the page: who is let in, and what passes through it."""

import asyncio
import base64
import hashlib
import re
import socket
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from types import SimpleNamespace

import aiohttp
import pytest
import viser
from aiohttp import web
from multidict import CIMultiDict, CIMultiDictProxy
from viser import _messages

from spherloc.errors import InputError
from spherloc_viz.app.server import serve
from spherloc_viz.app.web import access as access_module
from spherloc_viz.app.web import viser_internals
from spherloc_viz.app.web.access import Access, Role, is_own_name, open_socket, refusal
from spherloc_viz.app.web.desk import DeskRoom
from spherloc_viz.app.web.downloads import Downloads
from spherloc_viz.app.web.drops import DropRoom
from spherloc_viz.app.web.front_door import FrontDoor
from spherloc_viz.app.web.page import load_page
from spherloc_viz.app.web.viewer import ViewerRoom
from tests.connected_page import KEY
from tests.waiting import LIMIT_S

VERSION = f"viser-v{viser.__version__}"


def headers(*pairs: tuple[str, str]) -> CIMultiDictProxy[str]:
    return CIMultiDictProxy(CIMultiDict(pairs))


@pytest.mark.parametrize(
    "name", ["127.0.0.1:8080", "localhost:8080", "localhost", "[::1]:8080", "192.168.1.7:80", "robot.lab:8080"]
)
def test_own_names(name: str) -> None:
    """Addresses, localhost on any port (a tunnel changes it), and what --host says."""
    assert is_own_name(name, "robot.lab")


@pytest.mark.parametrize("name", ["evil.example", "127.0.0.1.evil.example:8080", "localhost.evil.example", "", "[::1"])
def test_foreign_names(name: str) -> None:
    assert not is_own_name(name, "127.0.0.1")


@pytest.mark.parametrize(
    "pairs",
    [
        [],
        [("Host", "localhost:1"), ("Host", "localhost:1")],
        [("Host", "rebound.example"), ("Origin", "http://rebound.example")],
        [("Host", "localhost:1"), ("Origin", "http://localhost:2")],
        [("Host", "localhost:1"), ("Origin", "http://127.0.0.1:1")],
        [("Host", "localhost:1"), ("Origin", "null")],
        [("Host", "localhost:1"), ("Origin", "http://localhost:1"), ("Origin", "http://evil.example")],
    ],
)
@pytest.mark.parametrize("upgrade", [False, True])
def test_refused(pairs: list[tuple[str, str]], upgrade: bool) -> None:
    reason = refusal(headers(*pairs), "127.0.0.1", upgrade)
    assert reason is not None and reason.endswith(".")


def test_let_in() -> None:
    page = headers(("Host", "localhost:1"))
    assert refusal(page, "127.0.0.1", upgrade=False) is None
    assert refusal(page, "127.0.0.1", upgrade=True) is not None, "a browser always says where a websocket comes from"
    for origin in ("http://localhost:1", "https://localhost:1"):
        both = headers(("Host", "localhost:1"), ("Origin", origin))
        assert refusal(both, "127.0.0.1", upgrade=True) is None


def test_port_in_use_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with open_socket("127.0.0.1", 0) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(InputError, match=rf"^cannot listen on 127.0.0.1:{port} \([\w ]+\); choose another port"):
            serve(None, "127.0.0.1", port, tmp_path)
    assert capsys.readouterr() == ("", ""), "said before anything else is begun"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("host, port", [("no such name.invalid", 0), ("127.0.0.1", 70_000), ("203.0.113.9", 0)])
def test_impossible_address_is_one_sentence(host: str, port: int) -> None:
    with pytest.raises(InputError, match=r"--(host|port)"):
        open_socket(host, port)


def test_policy_fits_the_page() -> None:
    page = load_page()
    scripts = re.findall(r"<script\b[^>]*>(.*?)</script>", page.html.decode(), flags=re.DOTALL)
    rules = dict(rule.split(" ", 1) for rule in page.policy.split("; "))
    for text in scripts:
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert f"'sha256-{digest}'" in rules["script-src"]
    assert rules["default-src"] == "'none'" and rules["frame-ancestors"] == "'self'", "in lessons only"
    assert "unsafe" not in rules["script-src"].replace("'wasm-unsafe-eval'", "")
    assert not re.search(r"https?:|\*", page.policy), "nothing outside may be reached"


class Door:
    """A running front door and a client that knocks on it."""

    def __init__(self, port: int, client: aiohttp.ClientSession, access: Access) -> None:
        self.url = f"http://127.0.0.1:{port}/"
        self.access = access
        self._client = client

    async def get(self, path: str = "", method: str = "GET", **sent: str) -> aiohttp.ClientResponse:
        response = await self._client.request(method, self.url + path, headers=sent, allow_redirects=False)
        await response.read()
        return response

    async def post(self, path: str, body: bytes, **sent: str) -> aiohttp.ClientResponse:
        response = await self._client.post(self.url + path, data=body, headers=sent, allow_redirects=False)
        await response.read()
        return response

    def knock(self, origin: str | None = "own", path: str = "", cookie: str = "", **options: object):
        sent = {} if origin is None else {"Origin": self.url.rstrip("/") if origin == "own" else origin}
        sent |= {"Cookie": cookie} if cookie else {}
        return self._client.ws_connect(self.url + path, headers=sent, protocols=[VERSION], max_msg_size=0, **options)  # type: ignore[arg-type]


@asynccontextmanager
async def door_to(
    port: int,
    viewer: ViewerRoom | None = None,
    token: bool = False,
    downloads: Downloads | None = None,
    desk: DeskRoom | None = None,
    drops: DropRoom | None = None,
) -> AsyncIterator[Door]:
    listener, access = open_socket("127.0.0.1", 0), Access(token)
    door = FrontDoor("127.0.0.1", port, KEY, access, downloads or Downloads(), viewer, False, desk, drops=drops)
    runner = await door.start(listener)
    try:
        async with aiohttp.ClientSession(cookie_jar=aiohttp.DummyCookieJar()) as client:
            yield Door(listener.getsockname()[1], client, access)
    finally:
        await runner.cleanup()


@asynccontextmanager
async def echoing() -> AsyncIterator[tuple[int, list[str]]]:
    """A websocket server in viser's place that sends back what it gets; yields its port and the keys it was shown."""
    keys: list[str] = []

    async def answer(request: web.Request) -> web.WebSocketResponse:
        keys.append(request.headers.get(viser_internals.KEY_HEADER, ""))
        page = web.WebSocketResponse(protocols=[VERSION], max_msg_size=0)
        await page.prepare(request)
        async for message in page:
            if message.data == b"leave":
                await page.close(code=1002, message=b"version")
                break
            await page.send_bytes(message.data)
        return page

    app = web.Application()
    app.router.add_get("/", answer)
    runner = web.AppRunner(app)
    await runner.setup()
    listener = socket.create_server(("127.0.0.1", 0))
    await web.SockSite(runner, listener).start()
    try:
        yield listener.getsockname()[1], keys
    finally:
        await runner.cleanup()


def through_an_echo(visit: Callable[[Door, list[str]], Awaitable[None]]) -> None:
    async def run() -> None:
        async with echoing() as (port, keys), door_to(port) as door:
            await visit(door, keys)

    asyncio.run(asyncio.wait_for(run(), LIMIT_S))


def test_page_is_served_with_its_policy() -> None:
    async def visit(door: Door, keys: list[str]) -> None:
        for encoding in ("gzip", "identity"):
            response = await door.get(**{"Accept-Encoding": encoding})
            assert response.status == 200 and "<title>spherloc</title>" in await response.text()
            assert response.headers["Content-Security-Policy"] == load_page().policy
        assert (await door.get("?darkMode&fixedDpr=1")).status == 200
        assert keys == [], "the page comes from the door itself"

    through_an_echo(visit)


def test_everything_else_is_refused() -> None:
    async def visit(door: Door, keys: list[str]) -> None:
        assert (await door.get("etc/passwd")).status == 404
        assert (await door.get("", method="POST")).status == 405
        assert (await door.get("", Host="rebound.example")).status == 403
        assert (await door.get("", Origin="http://evil.example")).status == 403
        for query in ("?websocket=ws://evil.example", "?playbackPath=data:,x", "?darkMode&playbackPath=/x"):
            response = await door.get(query)
            assert response.status == 302 and response.headers["Location"] == "/"
        for origin in (None, "null", "http://evil.example", "http://localhost:1"):
            with pytest.raises(aiohttp.WSServerHandshakeError, match="403"):
                await door.knock(origin)
        assert keys == [], "nothing of this reached the server behind the door"

    through_an_echo(visit)


def test_a_body_that_is_not_compressed_as_it_says_is_no_news(caplog: pytest.LogCaptureFixture) -> None:
    viser_internals.keep_tracebacks_short()

    async def visit(door: Door, keys: list[str]) -> None:
        sent = {"Content-Encoding": "gzip", "Origin": door.url.rstrip("/"), "Connection": "close"}
        for path, status in (("nothing", 405), ("drop/x/file", 404)):
            assert (await door.post(path, b"none", **sent)).status == status

    through_an_echo(visit)
    assert "Traceback" not in caplog.text


def test_messages_pass_whole_in_both_directions() -> None:
    async def visit(door: Door, keys: list[str]) -> None:
        async with door.knock() as socket:
            assert socket.protocol == VERSION
            for size in (0, 1, 70_000, 8_000_000):
                sent = hashlib.shake_256(str(size).encode()).digest(size)
                await socket.send_bytes(sent)
                assert await socket.receive_bytes() == sent
            # Many at once: none is lost and they stay in order, also where they fill every buffer on the way.
            many = [bytes([k % 256]) * 50_000 for k in range(100)]
            sending = asyncio.create_task(send_all(socket, many))
            assert [await socket.receive_bytes() for _ in many] == many
            await sending
        assert keys == [KEY]

    async def send_all(socket: aiohttp.ClientWebSocketResponse, messages: list[bytes]) -> None:
        for message in messages:
            await socket.send_bytes(message)

    through_an_echo(visit)


def test_the_reason_of_a_close_passes() -> None:
    """viser's page tells a version mismatch by its code."""

    async def visit(door: Door, keys: list[str]) -> None:
        async with door.knock() as socket:
            await socket.send_bytes(b"leave")
            assert (await socket.receive()).type is aiohttp.WSMsgType.CLOSE
            assert socket.close_code == 1002

    through_an_echo(visit)


def test_without_a_server_behind_it_says_so() -> None:
    async def run() -> None:
        with socket.create_server(("127.0.0.1", 0)) as unused:
            port = unused.getsockname()[1]
        async with door_to(port) as door:
            assert (await door.get()).status == 200
            with pytest.raises(aiohttp.WSServerHandshakeError, match="502"):
                await door.knock()

    asyncio.run(asyncio.wait_for(run(), LIMIT_S))


def test_viser_itself_answers_the_key_only() -> None:
    """Its port can be guessed; a page that does so, or a program without the key, gets nothing."""
    server = viser_internals.start_viser(KEY)
    try:

        async def run() -> None:
            url = f"http://127.0.0.1:{server.get_port()}/"
            async with aiohttp.ClientSession() as client:
                for wrong in ({}, {viser_internals.KEY_HEADER: ""}, {viser_internals.KEY_HEADER: KEY + "x"}):
                    assert (await client.get(url, headers=wrong)).status == 403
                    with pytest.raises(aiohttp.WSServerHandshakeError, match="403"):
                        await client.ws_connect(url, headers=wrong, protocols=[VERSION])
            async with door_to(server.get_port()) as door, door.knock() as page:
                assert page.protocol == VERSION
                assert (await page.receive()).type is aiohttp.WSMsgType.BINARY

        asyncio.run(asyncio.wait_for(run(), LIMIT_S))
        assert server.get_host() == "127.0.0.1"
    finally:
        viser_internals.stop_viser(server)


def test_nobody_can_open_a_public_tunnel(monkeypatch: pytest.MonkeyPatch) -> None:
    server = viser_internals.start_viser(KEY)
    try:
        asked: list[str] = []
        monkeypatch.setattr(server, "request_share_url", lambda *_: asked.append("request"))
        monkeypatch.setattr(server, "disconnect_share_url", lambda *_: asked.append("disconnect"))
        for message in (_messages.ShareUrlRequest, _messages.ShareUrlDisconnect):
            handlers = server._websock_server._incoming_handlers[message]
            for handler in handlers:
                handler(viser.infra.ClientId(0), message())
        server._thread_executor.shutdown(wait=True)
        assert asked == []
    finally:
        viser_internals.stop_viser(server)


def test_another_viser_fails_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A version that starts its server in another way must not run unguarded."""
    monkeypatch.setattr(viser, "ViserServer", lambda **_: SimpleNamespace())
    with pytest.raises(RuntimeError, match="viser"):
        viser_internals.start_viser(KEY)


ROUTES = (
    ("GET", ""),
    ("HEAD", ""),
    ("GET", "?darkMode"),
    ("GET", "viewer/?run=a.rrd&step=0"),
    ("GET", "viewer/program/0.41.0/re_viewer.js"),
    ("GET", "viewer/data/a.rrd"),
    ("GET", "viewer/data/a.review.rrd"),
    ("GET", "nothing"),
    ("POST", ""),
    ("POST", "drop/x/begin?name=a&count=1&bytes=1"),
    ("PUT", "viewer/data/a.rrd"),
)
"""One of each kind that the door knows, and some that it does not."""


def test_without_the_token_nothing_passes() -> None:
    """On any route and any websocket, whatever is given instead."""
    asked: list[str] = []
    viewer = ViewerRoom(lambda file: asked.append(file) or pytest.fail("reached"))

    async def visit() -> None:
        async with echoing() as (port, keys), door_to(port, viewer, token=True) as door:
            right = door.access._tokens[Role.PRESENTER]
            name, another = door.access._cookie, Access(True)
            wrong = (
                "",
                "x",
                right[:-1],
                right + "x",
                right.swapcase(),
                another._tokens[Role.PRESENTER],
                "\u00e9",
                "None",
            )
            for token in wrong:
                for cookie in (f"{name}={token}", f"{another._cookie}={right}", f"token={right}"):
                    for method, path in ROUTES:
                        response = await door.get(path, method, Cookie=cookie, Origin=door.url.rstrip("/"))
                        assert response.status == 403, (method, path, cookie)
                        assert method == "HEAD" or "link" in await response.text()
                    for path in ("", "viewer/", f"?token={right}"):
                        with pytest.raises(aiohttp.WSServerHandshakeError, match="403"):
                            await door.knock(path=path, cookie=cookie)
                response = await door.get(f"?token={token}", Cookie=f"{name}={right}")
                assert response.status == 403 and "Set-Cookie" not in response.headers
            assert (await door.get(f"?token={right}&token={right}")).status == 403
            assert (await door.get(f"?token={right}", "POST")).status == 403, "a link opens the page alone"
            page = await door.get(Accept="text/html,*/*")
            assert page.content_type == "text/html" and page.headers["Content-Security-Policy"]
            assert "<script" not in await page.text()
            assert keys == [] and asked == []

    asyncio.run(asyncio.wait_for(visit(), LIMIT_S))


def test_a_link_becomes_a_cookie_and_the_token_leaves_the_address() -> None:
    async def visit() -> None:
        async with echoing() as (port, _), door_to(port, token=True) as door:
            origin = door.url.rstrip("/")
            link = door.access.link(origin, Role.PRESENTER).removeprefix(door.url)
            for path in (link, f"{link}&darkMode=", f"/evil.example/{link}", f"viewer/{link}"):
                response = await door.get(path)
                text = await response.text()
                target = re.findall(r'content="0;url=([^"]*)"', text)
                assert response.status == 200 and target == ["/?darkMode=" if "dark" in path else "/"]
                assert "token" not in text and response.headers["Cache-Control"] == "no-store"
                cookie, *rest = response.headers["Set-Cookie"].split("; ")
                assert sorted(rest) == ["HttpOnly", "Path=/", "SameSite=Strict"]
            assert (await door.get(Cookie=cookie)).status == 200
            assert (await door.get("viewer/", Cookie=cookie)).status == 404
            async with door.knock(cookie=cookie) as socket:
                await socket.send_bytes(b"in")
                assert await socket.receive_bytes() == b"in"
            assert (await door.get(Cookie=cookie, Origin="http://evil.example")).status == 403
            assert (await door.get(Cookie=cookie, Host="rebound.example")).status == 403

    asyncio.run(asyncio.wait_for(visit(), LIMIT_S))


def test_tokens_are_compared_in_constant_time_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """The right one gets nobody in where the comparison says no, and all are compared."""
    compared: list[bytes] = []

    def never(given: bytes, token: bytes) -> bool:
        compared.append(token)
        return False

    async def visit() -> None:
        async with door_to(1, token=True) as door:
            tokens = door.access._tokens
            assert len(set(tokens.values())) == len(Role) and min(map(len, tokens.values())) >= 43
            with monkeypatch.context() as patch:
                patch.setattr(access_module.hmac, "compare_digest", never)
                right = tokens[Role.PRESENTER]
                assert (await door.get(f"?token={right}")).status == 403
                assert (await door.get(Cookie=f"{door.access._cookie}={right}")).status == 403
            assert compared == [token.encode() for token in tokens.values()] * 2

    asyncio.run(visit())


def test_an_audience_opens_no_recordings() -> None:
    viewer = ViewerRoom(lambda file: pytest.fail("reached"))

    async def visit() -> None:
        async with echoing() as (port, _), door_to(port, viewer=viewer, token=True) as door:
            cookie = f"{door.access._cookie}={door.access._tokens[Role.AUDIENCE]}"
            for path in ("viewer/?run=a.rrd&step=0", "viewer/data/a.rrd", "viewer/program/0.41.0/re_viewer.js"):
                response = await door.get(path, Cookie=cookie)
                assert response.status == 403 and "presenter" in await response.text()
            assert (await door.get(Cookie=cookie)).status == 200

    asyncio.run(asyncio.wait_for(visit(), LIMIT_S))


def test_an_exported_file_is_given_to_who_knows_its_address_until_it_is_withdrawn() -> None:
    downloads = Downloads()
    offered, other = downloads.room("runs.zip"), downloads.room("runs.zip")
    content = b"PK" + bytes(3_000_000)
    offered.path.write_bytes(content)
    downloads.offer(offered)

    async def visit() -> None:
        async with echoing() as (port, _), door_to(port, token=True, downloads=downloads) as door:
            cookies = {role: f"{door.access._cookie}={token}" for role, token in door.access._tokens.items()}
            path = offered.address.removeprefix("/")
            response = await door.get(path, Cookie=cookies[Role.PRESENTER])
            assert response.status == 200 and await response.read() == content
            assert response.headers["Content-Disposition"] == 'attachment; filename="runs.zip"'
            assert (await door.get(path)).status == 403
            assert (await door.get(path, Cookie=cookies[Role.AUDIENCE])).status == 403
            for wrong in (other.address, f"{offered.address}x", "/download/", f"/download//{offered.path}"):
                assert (await door.get(wrong.removeprefix("/"), Cookie=cookies[Role.PRESENTER])).status == 404
            downloads.withdraw(offered)
            assert (await door.get(path, Cookie=cookies[Role.PRESENTER])).status == 404

    asyncio.run(asyncio.wait_for(visit(), LIMIT_S))
    assert not offered.path.exists() and offered.path.parent.is_dir()
    downloads.close()
    assert not offered.path.parent.exists()
