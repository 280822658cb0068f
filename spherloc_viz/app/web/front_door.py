"""The only door to the page: checks who asks, serves the page, and passes the websocket on to viser."""

import asyncio
import contextlib
import ipaddress
import os
import re
import socket
from urllib.parse import urlsplit

import aiohttp
from aiohttp import web
from multidict import CIMultiDictProxy

from spherloc.errors import InputError
from spherloc_viz.app.web.page import Page, load_page
from spherloc_viz.app.web.touch import MOST_BYTES, TouchDesk
from spherloc_viz.app.web.viser_seams import KEY_HEADER

MAX_MESSAGE_BYTES = 50 * 1024 * 1024
"""What viser accepts from a page."""
HEARTBEAT_S = 20.0
"""A page that answers no ping for this long is gone, and its session ends."""

PARAMETERS = frozenset(f"initialCamera{part}" for part in ("Position", "LookAt", "Up", "Fov", "Near", "Far")) | {
    "darkMode",
    "fixedDpr",
    "hideViserLogo",
}
"""What a link may ask of viser's page. Others are dropped: they make it play a stranger's file or server."""


def open_socket(host: str, port: int) -> socket.socket:
    """A listening socket.

    Raises ``InputError`` if the address cannot be had.
    """
    if not 0 <= port < 2**16:
        raise InputError(f"port {port} does not exist; give --port a number up to 65535, or 0 for any free one.")
    where = f"{host}:{port}"
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        return socket.create_server(address[:2], family=family)
    except socket.gaierror:
        raise InputError(f"'{host}' is no address of this machine; use --host 127.0.0.1.") from None
    except OSError as error:
        # Python adds its own words to the system's.
        reason = os.strerror(error.errno) if error.errno else str(error)
        raise InputError(f"cannot listen on {where} ({reason}); choose another port with --port.") from None


def is_own_name(netloc: str, host: str) -> bool:
    """Whether a Host header names this server: an IP literal, localhost, or the name that --host gave.

    Only a name can be made to point here by a foreign site (DNS rebinding); an address cannot.
    """
    try:
        name = urlsplit(f"//{netloc}").hostname or ""
    except ValueError:
        return False
    if name in ("localhost", host.lower()):
        return True
    with contextlib.suppress(ValueError):
        ipaddress.ip_address(name)
        return True
    return False


def refusal(headers: CIMultiDictProxy[str], host: str, upgrade: bool) -> str | None:
    """Why a request with these headers is refused, or None if it is welcome."""
    own = headers.getall("Host", [])
    if len(own) != 1 or not is_own_name(own[0], host):
        return "This address is not the playground's: open the address that the command printed."
    origins = headers.getall("Origin", [])
    # A browser sends Origin with every websocket; none at all is no browser, and no business of this server.
    if (upgrade and not origins) or any(origin not in _same_origins(own[0]) for origin in origins):
        return "Another site may not use the playground."
    return None


def _same_origins(netloc: str) -> tuple[str, str]:
    return f"http://{netloc}", f"https://{netloc}"


class FrontDoor:
    """Serves one page and one websocket, and takes reports of presses on the page; everything else is refused."""

    def __init__(self, host: str, viser_port: int, key: str, desk: TouchDesk) -> None:
        self._host = host
        self._desk = desk
        self._upstream = f"http://127.0.0.1:{viser_port}/"
        self._key = key
        self._page: Page = load_page()
        self._client: aiohttp.ClientSession | None = None
        self._open: set[web.WebSocketResponse] = set()

    async def start(self, listener: socket.socket) -> web.AppRunner:
        """Start serving on a listening socket."""
        app = web.Application(client_max_size=MOST_BYTES)
        app.router.add_route("*", "/{path:.*}", self._answer)
        app.cleanup_ctx.append(self._connections)
        app.on_shutdown.append(self._hang_up)
        runner = web.AppRunner(app, access_log=None, handle_signals=False, shutdown_timeout=1.0)
        await runner.setup()
        await web.SockSite(runner, listener).start()
        return runner

    async def _connections(self, app: web.Application):
        async with aiohttp.ClientSession(auto_decompress=False) as self._client:
            yield

    async def _hang_up(self, app: web.Application) -> None:
        await asyncio.gather(*(page.close(code=1001, drain=False) for page in tuple(self._open)))

    async def _answer(self, request: web.Request) -> web.StreamResponse:
        upgrade = request.headers.get("Upgrade", "").lower() == "websocket"
        reason = refusal(request.headers, self._host, upgrade)
        if reason is not None:
            return web.Response(status=403, text=reason + "\n")
        if request.method == "POST" and request.path == "/touch":
            return await self._touch(request)
        if request.method not in ("GET", "HEAD"):
            return web.Response(status=405, text="Only GET is served.\n", headers={"Allow": "GET, HEAD"})
        if not request.query.keys() <= PARAMETERS:
            raise web.HTTPFound("/")
        if request.path != "/":
            return web.Response(status=404, text="There is nothing here; open /.\n")
        return await self._pass_on(request) if upgrade else self._page_response(request)

    async def _touch(self, request: web.Request) -> web.Response:
        """Only a page of this server can send one: others do not know its token, and are told apart by their Origin."""
        if "Origin" not in request.headers:
            return web.Response(status=403, text="Only the playground's page may report presses.\n")
        body = await request.read()
        loop = asyncio.get_running_loop()
        known = await loop.run_in_executor(None, self._desk.deliver, body)
        return web.Response(status=204) if known else web.Response(status=400, text="No page of this playground.\n")

    def _page_response(self, request: web.Request) -> web.Response:
        headers = {
            "Content-Security-Policy": self._page.policy,
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
            "Cross-Origin-Resource-Policy": "same-origin",
            "Cross-Origin-Opener-Policy": "same-origin",
            "Cache-Control": "no-cache",
            "Vary": "Accept-Encoding",
        }
        body = self._page.html
        if "gzip" in request.headers.get("Accept-Encoding", ""):
            body, headers["Content-Encoding"] = self._page.zipped, "gzip"
        return web.Response(body=body, content_type="text/html", charset="utf-8", headers=headers)

    async def _pass_on(self, request: web.Request) -> web.StreamResponse:
        """Join the page's websocket to one of viser's, for as long as both live."""
        assert self._client is not None
        offered = [name for name in re.split(r"[,\s]+", request.headers.get("Sec-WebSocket-Protocol", "")) if name]
        # The client's name and version travel as a subprotocol. Compression would cost more than it saves:
        # viser's messages are compressed already, and its arrays do not compress.
        try:
            upstream = await self._client.ws_connect(
                self._upstream, protocols=offered, headers={KEY_HEADER: self._key}, max_msg_size=0, compress=0
            )
        except aiohttp.ClientError:
            return web.Response(status=502, text="The playground is shutting down.\n")
        async with upstream:
            page = web.WebSocketResponse(
                protocols=[upstream.protocol] if upstream.protocol else (),
                max_msg_size=MAX_MESSAGE_BYTES,
                compress=False,
                heartbeat=HEARTBEAT_S,
            )
            await page.prepare(request)
            self._open.add(page)
            try:
                await _join(page, upstream)
            finally:
                self._open.discard(page)
        return page


async def _join(page: web.WebSocketResponse, upstream: aiohttp.ClientWebSocketResponse) -> None:
    """Pump both ways until one side closes, then close the other in the same way.

    ``send_bytes`` waits while the receiver's buffer is full, and a pump that waits reads no more, so a slow
    page slows viser down instead of filling this process's memory.
    """
    pumps = {asyncio.create_task(_pump(page, upstream)), asyncio.create_task(_pump(upstream, page))}
    try:
        await asyncio.wait(pumps, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for pump in pumps:
            pump.cancel()
        await asyncio.gather(*pumps, return_exceptions=True)
    code = upstream.close_code if upstream.closed else None
    await page.close(code=code if code in (1000, 1001, 1002) else 1001)


async def _pump(
    source: web.WebSocketResponse | aiohttp.ClientWebSocketResponse,
    sink: web.WebSocketResponse | aiohttp.ClientWebSocketResponse,
) -> None:
    with contextlib.suppress(ConnectionError):
        async for message in source:
            if message.type is not aiohttp.WSMsgType.BINARY:
                return
            await sink.send_bytes(message.data)
