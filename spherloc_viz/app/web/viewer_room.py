"""The Rerun viewer behind a front door: the page that opens a run at a step, and all that it loads."""

import asyncio
import re
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from urllib.parse import urlencode

from aiohttp import web

from spherloc.errors import InputError, RecordingError, SpherlocError, show
from spherloc_viz.app.web.guard import SAFE
from spherloc_viz.app.web.viewer_page import DATA, PROGRAM, SORRY_POLICY, sorry_page, viewer_page, viewer_policy
from spherloc_viz.recording.content.columns import TIMELINE
from spherloc_viz.recording.index.run_index import RunIndex
from spherloc_viz.recording.review.notes import REVIEW_SUFFIX, reviewed_name
from spherloc_viz.recording.run_row import RunRow
from spherloc_viz.recording.sandbox.examiner import examine, resolve_inside
from spherloc_viz.recording.viewing.view import labels_of, step_of
from spherloc_viz.recording.viewing.viewer_files import NAMES, viewer_folder, viewer_version

PAGE = "/viewer/"
NOT_RECORDED = "There are no recordings to view: start the playground without --no-record."
FOREVER = "private, max-age=31536000, immutable"
"""Its address says which version of the program it is."""


def viewer_link(file: str, step: int) -> str:
    """The path and query that open a recording of the folder of recordings at a step, unescaped for HTML."""
    return PAGE + "?" + urlencode({"run": file, "step": step})


@dataclass(frozen=True)
class Viewable:
    """A run that may be viewed."""

    path: Path
    """Of its recording."""
    row: RunRow
    """What is known about it."""


def of_index(index: RunIndex) -> Callable[[str], Viewable]:
    """Finds runs by the names of their files in an index's folder: those that it knows, and what passes examination.

    What it returns raises ``RecordingError`` for what is no recording there, or none of ours.
    """

    def find(file: str) -> Viewable:
        path = resolve_inside(index.folder, file)
        try:
            state = path.stat()
        except OSError as error:  # it has gone since
            raise RecordingError(f"{file}: the recording cannot be read ({error.strerror}).") from None
        return Viewable(path, index.get(file) or _examined(path, state.st_mtime_ns, state.st_size))

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
