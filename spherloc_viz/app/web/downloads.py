"""Files that one page may fetch: served from the disk in pieces, so that a large one takes no memory."""

import contextlib
import secrets
import tempfile
import threading
from dataclasses import dataclass
from pathlib import Path

from aiohttp import web

from spherloc.errors import RecordingError
from spherloc_viz.app.web.access import SAFE

DOWNLOADS = "/download/"


@dataclass(frozen=True)
class Download:
    """A file that is offered."""

    path: Path
    """Its temporary file."""
    name: str
    """File name under which a browser saves it; letters, digits, ".", "_" and "-" only."""
    address: str
    """Path of its address, with a token that cannot be guessed."""


class Downloads:
    """All that a server offers. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._offered: dict[str, Download] = {}

    def room(self, name: str) -> Download:
        """A file to be written, and then offered; raises ``RecordingError`` if there is no place for temporary ones."""
        token = secrets.token_urlsafe(32)
        try:
            with self._lock:
                if self._folder is None:
                    self._folder = tempfile.TemporaryDirectory(prefix="spherloc-downloads-", ignore_cleanup_errors=True)
                folder = Path(self._folder.name)
        except OSError as error:
            raise RecordingError(
                f"no temporary file can be made ({error.strerror}); make room or set TMPDIR."
            ) from error
        return Download(folder / token, name, f"{DOWNLOADS}{token}/{name}")

    def offer(self, download: Download) -> None:
        """Serve the file from now on to everybody who knows its address."""
        with self._lock:
            self._offered[download.address] = download

    def withdraw(self, download: Download) -> None:
        """Serve it no more, and delete it; a download that has begun gets all of it."""
        with self._lock:
            self._offered.pop(download.address, None)
        with contextlib.suppress(OSError):
            download.path.unlink(missing_ok=True)

    def answer(self, request: web.Request) -> web.StreamResponse:
        """The file of a request for ``/download/...``, which the front door has checked."""
        with self._lock:
            found = self._offered.get(request.path)
        if found is None:
            return web.Response(status=404, text="This file is offered no more; export it again.\n", headers=SAFE)
        headers = SAFE | {
            "Content-Type": "application/octet-stream",
            "Content-Disposition": f'attachment; filename="{found.name}"',
            "Content-Security-Policy": "default-src 'none'; sandbox",
            "Cache-Control": "no-store",
        }
        return web.FileResponse(found.path, headers=headers)

    def close(self) -> None:
        """Delete all."""
        with self._lock:
            folder, self._folder = self._folder, None
            self._offered.clear()
        if folder is not None:
            folder.cleanup()
