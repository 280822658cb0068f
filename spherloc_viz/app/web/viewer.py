"""The page that opens a recording in Rerun's viewer, the page that says why not, and the policies of both."""

import asyncio
import base64
import contextlib
import hashlib
import html
import re
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from string import Template
from urllib.parse import quote, urlencode

from aiohttp import web

from spherloc.errors import InputError, RecordingError, SpherlocError, show
from spherloc_viz.app.web.access import SAFE, SORRY_POLICY, open_socket, refusal, sorry_page
from spherloc_viz.given_files import REVIEW_SUFFIX
from spherloc_viz.recording.content.names import TIMELINE
from spherloc_viz.recording.index.run_index import RunIndex
from spherloc_viz.recording.rerun_program import NAMES, viewer_folder, viewer_version
from spherloc_viz.recording.reviews import reviewed_name
from spherloc_viz.recording.run_row import RunRow
from spherloc_viz.recording.sandbox.examiner import examine, resolve_inside
from spherloc_viz.recording.viewer import labels_of, step_of

PROGRAM = "/viewer/program/"
DATA = "/viewer/data/"


def viewer_page(file: str, row: RunRow, step: int, version: str, timeline: str) -> str:
    """The page that opens the run of ``file`` at a step (from 1), in the viewer of a version."""
    run = row.title or f"{row.name}, {row.estimator}, seed {row.seed}"
    layers = (file, file.removesuffix(".rrd") + ".review.rrd")
    values = {
        "title": f"{run}: step {step} - spherloc",
        "opening": f"Opening {run} at step {step} …",
        "program": f"{PROGRAM}{quote(version)}/",
        "files": " ".join(DATA + quote(name) for name in layers),
        "timeline": timeline,
        "step": str(row.on_timeline(step)),
    }
    escaped = {name: html.escape(value) for name, value in values.items()}
    return Template(_text("viewer.html")).substitute(escaped, script=_text("viewer.js"))


@cache
def viewer_policy() -> str:
    """A policy under which the viewer works and reaches nothing but this server: no fonts, no statistics, no API.

    Only the page's own script runs, by its hash, and the program that it loads; so a recording cannot bring code.
    """
    digest = base64.b64encode(hashlib.sha256(_text("viewer.js").encode()).digest()).decode()
    rules = {
        "default-src": "'none'",
        "script-src": f"'sha256-{digest}' 'strict-dynamic' 'wasm-unsafe-eval'",
        "style-src": "'unsafe-inline'",
        "img-src": "data: blob:",
        "connect-src": "'self'",
        "base-uri": "'none'",
        "form-action": "'none'",
        "frame-ancestors": "'none'",
    }
    return "; ".join(f"{name} {value}" for name, value in rules.items())


@cache
def _text(name: str) -> str:
    return Path(__file__).with_name(name).read_text(encoding="utf-8")


PAGE = "/viewer/"
NOT_RECORDED = "There are no recordings to view: start the playground without --no-record."
FOREVER = "private, max-age=31536000, immutable"
"""Its address says which version of the program it is."""


def viewer_link(file: str, step: int) -> str:
    """The path and query that open a recording of the folder of recordings at a step (from 1), unescaped for HTML."""
    return PAGE + "?" + urlencode({"run": file, "step": step})


@dataclass(frozen=True)
class Viewable:
    """A run that may be viewed."""

    path: Path
    """Path of the recording."""
    row: RunRow
    """What is known about it."""


def of_index(index: RunIndex) -> Callable[[str], Viewable]:
    """Finds runs by the names of their files in an index's folder: those examined before, and what passes examination.

    The returned function raises ``RecordingError`` for a file that is not a recording there, or not one of spherloc's.
    """

    def find(file: str) -> Viewable:
        path = resolve_inside(index.folder, file)
        try:
            state = path.stat()
        except OSError as error:  # it has gone since
            raise RecordingError(f"{file}: the recording cannot be read ({error.strerror}).") from None
        return Viewable(path, index.examined(file) or _examined(path, state.st_mtime_ns, state.st_size))

    return find


@lru_cache(maxsize=64)
def _examined(path: Path, mtime_ns: int, size_bytes: int) -> RunRow:
    """Once for each state of a file: a page that opens asks three times."""
    return examine(path)


class ViewerRoom:
    """Answers requests for ``/viewer/...``; who asks has been checked at the door."""

    def __init__(self, find: Callable[[str], Viewable]) -> None:
        """``find`` gives the run of a file, or raises ``RecordingError``; it is called in threads and may take long."""
        self._find = find
        # Of its own, as a file that takes long to examine must not keep presses on the playground's pages waiting.
        self._threads = ThreadPoolExecutor(2, "spherloc-viewer")

    async def close(self, app: web.Application) -> None:
        """End its threads; for an application's ``on_cleanup``."""
        self._threads.shutdown(wait=False, cancel_futures=True)

    async def answer(self, request: web.Request) -> web.StreamResponse:
        """The page, a file of the viewer's program, or a recording."""
        path = request.path
        answer, argument = next(
            (answer, path[len(start) :])
            for start, answer in ((PROGRAM, self._program), (DATA, self._data), (PAGE, self._page))
            if path.startswith(start)
        )
        try:
            return await asyncio.get_running_loop().run_in_executor(self._threads, answer, argument, request)
        except SpherlocError as error:
            if answer == self._page:
                return _html(sorry_page(str(error)), SORRY_POLICY, status=404)
            return web.Response(status=404, text=f"{error}\n", headers=SAFE)

    def _page(self, rest: str, request: web.Request) -> web.StreamResponse:
        if rest:
            raise InputError("There is nothing here; open the viewer from the list of recordings.")
        file = request.query.get("run", "")
        found = self._find(file)
        step = step_of(found.row, _number(request.query.get("step")))
        return _html(viewer_page(file, found.row, step, viewer_version(), TIMELINE), viewer_policy())

    def _program(self, rest: str, request: web.Request) -> web.StreamResponse:
        version, _, name = rest.partition("/")
        if version != viewer_version() or name not in NAMES:
            raise InputError("There is no such file of the viewer: reload the page.")
        headers = SAFE | {"Content-Type": NAMES[name], "Cache-Control": FOREVER}
        return web.FileResponse(viewer_folder() / name, headers=headers)

    def _data(self, rest: str, request: web.Request) -> web.StreamResponse:
        is_review = rest.endswith(REVIEW_SUFFIX)
        found = self._find(reviewed_name(rest) if is_review else rest)
        path = labels_of(found.path, found.row.run_id) if is_review else found.path
        if path is None:
            return web.Response(status=204, headers=SAFE)
        headers = SAFE | {
            "Content-Type": "application/octet-stream",
            "Content-Security-Policy": "default-src 'none'; sandbox",
            "Cache-Control": "no-cache",
        }
        return web.FileResponse(path, headers=headers)


def _number(text: str | None) -> int | None:
    if text is None:
        return None
    if not re.fullmatch(r"\d{1,9}", text, re.ASCII):
        raise InputError(f"{show(text)}: not the number of a step; give one such as step=0.")
    return int(text)


def _html(text: str, policy: str, status: int = 200) -> web.Response:
    headers = SAFE | {"Content-Security-Policy": policy, "Cache-Control": "no-cache"}
    return web.Response(status=status, text=text, content_type="text/html", charset="utf-8", headers=headers)


HOST = "127.0.0.1"
NAME = "run.rrd"
"""What the recording is called on the page, whatever its file is called."""


def serve_recording(path: Path, row: RunRow, step: int, port: int) -> None:
    """Print the address at which a browser opens a recording paused at a step, and serve it until Ctrl-C.

    Port 0 takes any free one. Raises ``InputError`` if the port is taken, ``RecordingError`` if the viewer is missing.
    """
    with open_socket(HOST, port) as listener, contextlib.suppress(KeyboardInterrupt):
        viewer_folder()
        app = _app(path, row, step)
        link = f"http://{HOST}:{listener.getsockname()[1]}/"
        print(f"{path.name} is open at {link} ; Ctrl-C ends it.", flush=True)
        web.run_app(app, sock=listener, print=None, access_log=None, shutdown_timeout=1.0)


def _app(path: Path, row: RunRow, step: int) -> web.Application:
    def find(file: str) -> Viewable:
        if file != NAME:
            raise RecordingError("There is no such recording here; open / instead.")
        return Viewable(path, row)

    room = ViewerRoom(find)

    async def answer(request: web.Request) -> web.StreamResponse:
        reason = refusal(request.headers, HOST, upgrade=False)
        if reason is not None:
            return web.Response(status=403, text=f"{reason}\n")
        if request.path.startswith(PAGE):
            return await room.answer(request)
        if request.path == "/":
            raise web.HTTPFound(viewer_link(NAME, step))
        return web.Response(status=404, text="There is nothing here; open / instead.\n")

    app = web.Application()
    app.router.add_get("/{path:.*}", answer)
    app.on_cleanup.append(room.close)
    return app
