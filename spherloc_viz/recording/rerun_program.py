"""Rerun's own program: where it is, how it runs without usage data, and the web viewer packed inside it."""

import os
import re
import subprocess
import sys
import threading
import urllib.request
from importlib.metadata import version
from pathlib import Path

import rerun_cli

from spherloc.disk_cache import cache_folder, store
from spherloc.errors import RecordingError


def rerun_command() -> list[str]:
    """The rerun program of this environment."""
    folder = Path(rerun_cli.__file__).parent
    program = folder / ("rerun.exe" if os.name == "nt" else "rerun")
    return [str(program)] if program.exists() else [sys.executable, "-m", "rerun_cli"]


def rerun_environment() -> dict[str, str]:
    """Our environment for rerun's program, in which it sends no usage data.

    Its only switches are the settings of its user, which spherloc must not change, and the variable ``CI``.
    """
    environment = {name: value for name, value in os.environ.items() if name != "FORCE_RERUN_ANALYTICS"}
    return environment | {"CI": "true", "TELEMETRY_ENABLED": "false"}


NAMES = {"re_viewer.js": "text/javascript", "re_viewer_bg.wasm": "application/wasm"}
"""What a page needs, 43 MB, and the type of each."""
START_LIMIT_S = 60.0
"""rerun's program takes a fifth of a second; one that takes this long has got stuck."""

_lock = threading.Lock()


def viewer_version() -> str:
    """The version of rerun that is installed; another one has other files."""
    return version("rerun-sdk")


def viewer_folder() -> Path:
    """A folder with the files of ``NAMES``, in the user's cache, made at the first call, which takes a second.

    Raises ``RecordingError`` if rerun's program does not give them or they cannot be kept.
    """
    folder = cache_folder("viewer") / viewer_version()
    with _lock:
        if not all((folder / name).is_file() for name in NAMES):
            for name, content in _from_program().items():
                if not store(folder / name, content):
                    raise RecordingError(
                        f"{folder}: the viewer's files cannot be kept there; make room, or set SPHERLOC_CACHE to "
                        "another folder."
                    )
    return folder


def _from_program() -> dict[str, bytes]:
    """The files as rerun's program serves them to us once, on this machine; it is ended then."""
    ports = ["--bind", "127.0.0.1", "--port", "auto", "--web-viewer-port", "0"]
    environment = rerun_environment() | {"RUST_LOG": "info", "NO_COLOR": "1"}
    # Without a proxy: one that the environment names cannot reach this machine's ports.
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    with subprocess.Popen(
        [*rerun_command(), "--serve-web", *ports], stderr=subprocess.PIPE, text=True, env=environment
    ) as server:
        assert server.stderr is not None
        limit = threading.Timer(START_LIMIT_S, server.kill)
        limit.start()
        try:
            found = (re.search(r"Hosting a web-viewer at (http://[\d.:]+)", line) for line in server.stderr)
            address = next(match[1] for match in found if match)
            return {name: opener.open(f"{address}/{name}", timeout=30).read() for name in NAMES}
        except (OSError, StopIteration) as error:
            raise RecordingError("rerun's web viewer does not start; reinstall the package rerun-sdk.") from error
        finally:
            limit.cancel()
            server.terminate()
