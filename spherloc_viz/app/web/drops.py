"""The door for photographs that are dropped onto pages: which page a file is for, and its way from the network there.

The page (``drops.js``) posts to an address of its own, one after the other: ``begin``, ``file`` for each, and ``end``
or ``cancel``.
"""

import asyncio
import secrets
import threading
from pathlib import Path
from typing import Protocol

from aiohttp import web

from spherloc.errors import InputError
from spherloc_viz.app.web.access import SAFE
from spherloc_viz.recording.storage.unfinished import remove_abandoned_folders

DROPS = "/drop/"
PIECE_BYTES = 1 << 20
NOT_TAKEN = "This page takes no files any more; load it again.\n"
LEFT_OUT, ENDED = 422, 409
"""Status of an answer if one file was not taken, and if none of them is kept."""


class NotTakenError(InputError):
    """One file is not taken; others still may be."""


class Arriving(Protocol):
    """A file that arrives."""

    def write(self, piece: bytes) -> None:
        """Add a piece. Raises ``InputError``, after which nothing is kept of what was dropped."""

    def close(self) -> None:
        """No more pieces come."""

    def break_off(self) -> None:
        """It is not whole, so nothing is kept of what was dropped with it; what was dropped since stays."""


class Receiver(Protocol):
    """One page's keeper of what is dropped onto it. Whatever is refused raises ``InputError``, a file that is left out
    ``NotTakenError``."""

    def begin(self, name: str, count: int, size_bytes: int) -> None:
        """Make room."""

    def open(self, name: str) -> Arriving:
        """A file that arrives."""
        ...

    def end(self) -> None:
        """All are there."""

    def cancel(self) -> None:
        """Remove what is there."""


class DropRoom:
    """All pages onto which photographs can be dropped. Thread-safe."""

    def __init__(self, kept_in: Path | None = None) -> None:
        """``kept_in`` is the folder in which they are kept, from which goes what killed playgrounds left half; None if
        they go with their page."""
        if kept_in is not None:
            remove_abandoned_folders(kept_in)
        self.kept_in = kept_in
        self._lock = threading.Lock()
        self._pages: dict[str, Receiver] = {}

    def take_for(self, page: Receiver) -> str:
        """The address of a page, which cannot be guessed, for as long as it is open."""
        address = f"{DROPS}{secrets.token_urlsafe(32)}/"
        with self._lock:
            self._pages[address] = page
        return address

    def leave(self, address: str) -> None:
        """The page has gone."""
        with self._lock:
            self._pages.pop(address, None)

    async def answer(self, request: web.Request) -> web.Response:
        """Answer a POST to ``/drop/...``, which the front door has checked."""
        address, _, what = request.path.rpartition("/")
        with self._lock:
            page = self._pages.get(f"{address}/")
        if page is None:
            return _said(404, NOT_TAKEN)
        told = request.query
        try:
            if what == "file":
                await _receive(page, told.get("name", ""), request)
            elif what == "begin":
                count, size_bytes = (_whole(told.get(name, "")) for name in ("count", "bytes"))
                await asyncio.to_thread(page.begin, told.get("name", ""), count, size_bytes)
            elif what == "end":
                await asyncio.to_thread(page.end)
            elif what == "cancel":
                await asyncio.to_thread(page.cancel)
            else:
                return _said(404, NOT_TAKEN)
        except NotTakenError as error:
            return _said(LEFT_OUT, str(error))
        except InputError as error:
            return _said(ENDED, str(error))
        return _said(200, "")


async def _receive(page: Receiver, name: str, request: web.Request) -> None:
    """Take the body of a request as a file.

    Raises ``InputError`` if it is not taken or not whole; nothing is kept then of what was dropped, unless it is a
    ``NotTakenError``.
    """
    file = await asyncio.to_thread(page.open, name)
    whole = False
    try:
        async for piece in request.content.iter_chunked(PIECE_BYTES):
            await asyncio.to_thread(file.write, piece)
        whole = True
    except (web.RequestPayloadError, ConnectionError):
        raise InputError("a file broke off on its way, so none was kept; drop the photographs again.") from None
    finally:
        await asyncio.to_thread(file.close if whole else file.break_off)


def _whole(digits: str) -> int:
    """A number that a page has told; -1, which is refused, if it is none."""
    return int(digits) if digits.isascii() and digits.isdecimal() and len(digits) < 16 else -1


def _said(status: int, sentence: str) -> web.Response:
    return web.Response(status=status, text=sentence, headers=SAFE | {"Cache-Control": "no-store"})
