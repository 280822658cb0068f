"""Serves one recording to a browser on this machine, without a playground."""

import contextlib
from pathlib import Path

from aiohttp import web

from spherloc.errors import RecordingError
from spherloc_viz.app.web.guard import open_socket, refusal
from spherloc_viz.app.web.viewer_room import PAGE, Viewable, ViewerRoom, viewer_link
from spherloc_viz.recording.run_row import RunRow
from spherloc_viz.recording.viewing.viewer_files import viewer_folder

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
