"""What can be computed again is kept on disk: rendered images and features, by a key of all that they depend on."""

import atexit
import contextlib
import hashlib
import os
import shutil
import tempfile
import time
import zipfile
import zlib
from functools import cache
from pathlib import Path

from spherloc.files import write_whole

VARIABLE = "SPHERLOC_CACHE"
"""Environment variable that moves the cache."""
KEEP_BYTES = 2 << 30
"""What one kind of things may take once it was not used for a while."""
UNUSED_S = 7 * 86_400.0
"""What was used within this time stays: somebody may be looking at it."""
TOUCH_S = 3_600.0
"""A use is not noted again within this time."""
DAMAGED_NPZ = (OSError, ValueError, LookupError, EOFError, MemoryError, zipfile.BadZipFile, zlib.error, RuntimeError)
"""What numpy raises for an .npz that was cut off or changed."""


def cache_folder(kind: str) -> Path:
    """Folder for one kind of things ("renders", "features"): under $SPHERLOC_CACHE, else in the user's cache.

    A user without a home has one that ends with the process.
    """
    own = os.environ.get(VARIABLE)
    return (Path(own) if own else user_cache() or _temporary()) / kind


def user_cache() -> Path | None:
    """The user's folder for what can be computed again; None for a user without a home."""
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "spherloc"
    except RuntimeError:
        return None


@cache
def _temporary() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="spherloc-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def key_of(*parts: object) -> str:
    """A file name for what follows from ``parts``: bytes, or whatever has a ``repr`` that says it all."""
    digest = hashlib.sha256()
    for part in parts:
        content = part if isinstance(part, bytes) else repr(part).encode()
        digest.update(len(content).to_bytes(8, "little") + content)
    return digest.hexdigest()[:32]


def store(path: Path, content: bytes) -> bool:
    """Write a file of the cache so that no reader sees half of it; False if that fails, which only costs time."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, content)
    except OSError:
        return False
    return True


def used(path: Path) -> None:
    """Note that a file of the cache is still wanted."""
    with contextlib.suppress(OSError):
        if time.time() - path.stat().st_mtime > TOUCH_S:
            os.utime(path)


@cache
def make_room_once(folder: Path) -> None:
    """``make_room``, the first time in this process."""
    make_room(folder)


def make_room(folder: Path, keep_bytes: int = KEEP_BYTES) -> int:
    """Delete the longest unused files of a kind until it takes no more than ``keep_bytes``; returns how many went.

    Files that were used within a week stay, whatever they take. What cannot be deleted stays too.
    """
    found = []
    for path in folder.rglob("*"):
        with contextlib.suppress(OSError):  # deleted by another process meanwhile
            if path.is_file():
                told = path.stat()
                found.append((told.st_mtime, told.st_size, path))
    total, gone = sum(size for _, size, _ in found), 0
    for when, size, path in sorted(found):
        if total <= keep_bytes or time.time() - when <= UNUSED_S:
            break
        with contextlib.suppress(OSError):
            path.unlink()
            total, gone = total - size, gone + 1
        if path.parent != folder:
            with contextlib.suppress(OSError):  # it holds other files
                path.parent.rmdir()
    return gone
