"""Opens a recording in the Rerun viewer, in a window of its own or in a browser."""

import contextlib
import os
import socket
import subprocess
import sys
from pathlib import Path
from urllib.parse import quote

from aiohttp import web

from spherloc.errors import InputError, RecordingError
from spherloc_viz.recording.reader import check_recording
from spherloc_viz.recording.rerun_program import rerun_command, rerun_environment
from spherloc_viz.recording.viewer_files import NAMES, content_policy, viewer_files

HOST = "127.0.0.1"


def view(path: Path, web: bool, port: int = 0) -> None:
    """Open a recording and return when the viewer is closed.

    With ``web``, a browser on this machine can open it at the address that is printed, until Ctrl-C; ``port`` 0 takes
    a free one. Raises ``RecordingError`` if it is no recording or the viewer cannot open, ``InputError`` if the port
    is taken.
    """
    check_recording(path)
    path = Path(path).resolve()
    if web:
        _serve(path, port)
    else:
        _open_window(path)


def _open_window(path: Path) -> None:
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise RecordingError(f"{path.name}: there is no display to open a window on; add --web to use a browser.")
    # Its own port is for programs that send data to it: nobody else on the network should.
    command = [*rerun_command(), "--bind", HOST, "--port", "auto", str(path)]
    if subprocess.run(command, env=rerun_environment(), check=False).returncode:
        raise RecordingError(f"{path.name}: the Rerun viewer has failed; add --web to use a browser instead.")


def _serve(path: Path, port: int) -> None:
    try:
        listener = socket.create_server((HOST, port))
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"cannot listen on {HOST}:{port} ({reason}); choose another port with --port.") from None
    with listener, contextlib.suppress(KeyboardInterrupt):
        address = f"http://{HOST}:{listener.getsockname()[1]}"
        app = _app(path, address, viewer_files())
        print(f"{path.name} is open at {address}/ ; Ctrl-C ends it.", flush=True)
        web.run_app(app, sock=listener, print=None, access_log=None, shutdown_timeout=1.0)


def _app(path: Path, address: str, files: dict[str, bytes]) -> web.Application:
    """Serves the viewer's files and this one recording to pages of ``address``."""
    recording = f"{address}/{quote(path.name)}"
    start = f"/?url={quote(recording, safe='')}&persist=0&hide_welcome_screen"
    policy = content_policy(files["/"])

    async def answer(request: web.Request) -> web.StreamResponse:
        # A name that a foreign site makes point here (DNS rebinding) must not read the recording.
        if request.host != address.removeprefix("http://"):
            return web.Response(status=403, text=f"Open {address}/ instead.\n")
        if request.path == "/" and request.query.get("url") != recording:
            raise web.HTTPFound(start)
        if request.path in files:
            headers = {"Content-Security-Policy": policy, "X-Content-Type-Options": "nosniff"}
            return web.Response(body=files[request.path], content_type=NAMES[request.path], headers=headers)
        if request.path == f"/{path.name}":
            return web.FileResponse(path)
        return web.Response(status=404, text=f"There is nothing here; open {address}/.\n")

    app = web.Application()
    app.router.add_get("/{path:.*}", answer)
    return app
