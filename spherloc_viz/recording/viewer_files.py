"""The files of Rerun's web viewer, which are packed inside rerun's own program, and the policy to serve them under."""

import base64
import hashlib
import re
import subprocess
import urllib.request

from spherloc.errors import RecordingError
from spherloc_viz.recording.rerun_program import rerun_command, rerun_environment

NAMES = {
    "/": "text/html",
    "/re_viewer.js": "text/javascript",
    "/re_viewer_bg.wasm": "application/wasm",
    "/favicon.ico": "image/x-icon",
}
"""What the page needs, and the type of each."""


def viewer_files() -> dict[str, bytes]:
    """The files by their paths, 43 MB. rerun's program serves them to us once, on this machine, and is ended.

    Raises ``RecordingError`` if it does not.
    """
    ports = ["--bind", "127.0.0.1", "--port", "auto", "--web-viewer-port", "0"]
    environment = rerun_environment() | {"RUST_LOG": "info", "NO_COLOR": "1"}
    # A proxy that the environment names knows nothing of this machine's ports.
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    with subprocess.Popen(
        [*rerun_command(), "--serve-web", *ports], stderr=subprocess.PIPE, text=True, env=environment
    ) as server:
        assert server.stderr is not None
        try:
            found = (re.search(r"Hosting a web-viewer at (http://[\d.:]+)", line) for line in server.stderr)
            address = next(match[1] for match in found if match)
            return {name: opener.open(address + name, timeout=30).read() for name in NAMES}
        except (OSError, StopIteration) as error:
            raise RecordingError("rerun's web viewer does not start; reinstall the package rerun-sdk.") from error
        finally:
            server.terminate()


def content_policy(html: bytes) -> str:
    """A policy under which the viewer works and reaches nothing but this server: no fonts, no statistics, no API.

    A link that names a foreign recording cannot load it either.
    """
    scripts = re.findall(rb"<script>(.*?)</script>", html, flags=re.DOTALL)
    hashes = [base64.b64encode(hashlib.sha256(script).digest()).decode() for script in scripts]
    own = " ".join(f"'sha256-{value}'" for value in hashes)
    rules = {
        "default-src": "'none'",
        "script-src": f"'self' {own} 'wasm-unsafe-eval'",
        "style-src": "'unsafe-inline'",
        "img-src": "'self' data: blob:",
        "connect-src": "'self'",
        "base-uri": "'none'",
        "form-action": "'none'",
        "frame-ancestors": "'none'",
    }
    return "; ".join(f"{name} {value}" for name, value in rules.items())
