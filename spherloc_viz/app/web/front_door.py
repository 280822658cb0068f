"""The only door to the page: checks who asks, serves the page, and passes the websocket on to viser."""

import asyncio
import contextlib
import re
import socket

import aiohttp
from aiohttp import web

from spherloc_viz.app.web.access import NO_TOKEN, SAFE, Access, Role, refusal, refused
from spherloc_viz.app.web.desk import DO, MAX_BYTES, NO_RUNS, DeskRoom, is_desk
from spherloc_viz.app.web.downloads import DOWNLOADS, Downloads
from spherloc_viz.app.web.drops import DROPS, DropRoom
from spherloc_viz.app.web.learn import is_learning, learn_answer
from spherloc_viz.app.web.page import Page, load_page
from spherloc_viz.app.web.viewer import NOT_RECORDED, PAGE, ViewerRoom
from spherloc_viz.app.web.viser_internals import KEY_HEADER, LINK_HEADER, ROLE_HEADER

MAX_MESSAGE_BYTES = 50 * 1024 * 1024
"""What viser accepts from a page."""
HEARTBEAT_S = 20.0
"""A page that answers no ping for this long is gone, and its session ends."""

MAX_AUDIENCE = 200
"""Pages of an audience at once; each takes a thread and some megabytes."""
FULL = f"The audience is full: {MAX_AUDIENCE} pages are open. Close one, or ask the presenter.\n"

PARAMETERS = frozenset(f"initialCamera{part}" for part in ("Position", "LookAt", "Up", "Fov", "Near", "Far")) | {
    "darkMode",
    "fixedDpr",
    "hideViserLogo",
}
"""What a link may ask of viser's page. Others are dropped: they make it play another server's file."""
LINKED = "linked"
"""What the page asks of its websocket if it was opened by a link (``changes.js``)."""
LESSONS_NOT_FOR_AUDIENCE = (
    "Lessons are the presenter's to open: the link for an audience shows what the presenter shows."
)
DROPS_NOT_FOR_AUDIENCE = (
    "Photographs are the presenter's to drop: the link for an audience shows what the presenter shows."
)
NOT_FOR_AUDIENCE = "Recordings are the presenter's to open: the link for an audience shows what the presenter shows."


class FrontDoor:
    """Serves one page, one websocket, the lessons, the viewer of recordings and exported files, takes photographs that
    are dropped onto pages, and nothing else."""

    def __init__(
        self,
        host: str,
        viser_port: int,
        key: str,
        access: Access,
        downloads: Downloads,
        viewer: ViewerRoom | None = None,
        framed: bool = False,
        desk: DeskRoom | None = None,
        *,
        drops: DropRoom | None = None,
    ) -> None:
        """``viewer`` and ``desk`` are None where nothing is recorded, ``drops`` where pages take no files; ``framed``
        lets other pages of this machine, such as a notebook's, show the page in a frame."""
        self._host, self._access = host, access
        self._viewer, self._desk = viewer, desk
        self._downloads, self._drops = downloads, drops or DropRoom()
        self._upstream = f"http://127.0.0.1:{viser_port}/"
        self._key = key
        self._page: Page = load_page(framed)
        self._client: aiohttp.ClientSession | None = None
        self._open: set[web.WebSocketResponse] = set()
        self._audience = 0
        """How many pages of an audience are open, or about to be."""

    async def start(self, listener: socket.socket) -> web.AppRunner:
        """Start serving on a listening socket."""
        app = web.Application(client_max_size=MAX_BYTES)
        app.router.add_route("*", "/{path:.*}", self._answer)
        app.cleanup_ctx.append(self._connections)
        app.on_shutdown.append(self._hang_up)
        if self._viewer is not None:
            app.on_cleanup.append(self._viewer.close)
        if self._desk is not None:
            app.on_cleanup.append(self._desk.close)
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
        dropped = request.path.startswith(DROPS)
        posted = request.method == "POST" and (request.path == DO or dropped)
        # A form on another site could post without an Origin of ours; a GET changes nothing.
        reason = refusal(request.headers, self._host, upgrade or posted)
        if reason is not None:
            return web.Response(status=403, text=reason + "\n")
        entry = None if upgrade else self._access.enter(request)
        if entry is not None:
            return entry
        role = self._access.role(request)
        if role is None:
            return refused(request, NO_TOKEN)
        if request.method not in ("GET", "HEAD") and not posted:
            return web.Response(status=405, text="Only GET is served.\n", headers={"Allow": "GET, HEAD"})
        if posted and dropped:
            return (
                await self._drops.answer(request)
                if role is Role.PRESENTER
                else refused(request, DROPS_NOT_FOR_AUDIENCE)
            )
        if request.path.startswith(PAGE):
            if role is not Role.PRESENTER:
                return refused(request, NOT_FOR_AUDIENCE)
            if self._viewer is None:
                return web.Response(status=404, text=f"{NOT_RECORDED}\n")
            return await self._viewer.answer(request)
        if is_desk(request.path):
            if role is not Role.PRESENTER:
                return refused(request, NOT_FOR_AUDIENCE)
            if self._desk is None:
                return web.Response(status=404, text=f"{NO_RUNS}\n")
            return await self._desk.answer(request)
        if request.path.startswith(DOWNLOADS):
            if role is not Role.PRESENTER:
                return refused(request, NOT_FOR_AUDIENCE)
            return self._downloads.answer(request)
        if is_learning(request.path):
            return await learn_answer(request) if role is Role.PRESENTER else refused(request, LESSONS_NOT_FOR_AUDIENCE)
        if not request.query.keys() <= (PARAMETERS | {LINKED} if upgrade else PARAMETERS):
            raise web.HTTPFound("/")
        if request.path != "/":
            return web.Response(status=404, text="There is nothing here; open /.\n")
        if not upgrade:
            return self._page_response(request)
        return await (self._pass_on(request, role) if role is Role.PRESENTER else self._seat(request))

    async def _seat(self, request: web.Request) -> web.StreamResponse:
        """One more page of an audience, if there is room."""
        if self._audience >= MAX_AUDIENCE:
            return web.Response(status=503, text=FULL)
        self._audience += 1
        try:
            return await self._pass_on(request, Role.AUDIENCE)
        finally:
            self._audience -= 1

    def _page_response(self, request: web.Request) -> web.Response:
        headers = SAFE | {
            "Content-Security-Policy": self._page.policy,
            "Cache-Control": "no-cache",
            "Vary": "Accept-Encoding",
        }
        body = self._page.html
        if "gzip" in request.headers.get("Accept-Encoding", ""):
            body, headers["Content-Encoding"] = self._page.zipped, "gzip"
        return web.Response(body=body, content_type="text/html", charset="utf-8", headers=headers)

    async def _pass_on(self, request: web.Request, role: Role) -> web.StreamResponse:
        """Join the page's websocket to one of viser's, which learns whose it is, for as long as both live."""
        assert self._client is not None
        offered = [name for name in re.split(r"[,\s]+", request.headers.get("Sec-WebSocket-Protocol", "")) if name]
        linked = {LINK_HEADER: LINKED} if LINKED in request.query else {}
        # The client's name and version travel as a subprotocol. Compression would cost more than it saves:
        # viser's messages are compressed already, and its arrays do not compress.
        try:
            upstream = await self._client.ws_connect(
                self._upstream,
                protocols=offered,
                headers={KEY_HEADER: self._key, ROLE_HEADER: role} | linked,
                max_msg_size=0,
                compress=0,
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
