"""Cache on disk for results that can be computed again, such as rendered images and features. The key of a file is a
hash of everything that its content depends on."""

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
"""Size to which the files of one kind are reduced, as far as they have not been used recently."""
UNUSED_S = 7 * 86_400.0
"""Files that were used within this time are not deleted, since they may be in use."""
TOUCH_S = 3_600.0
"""A use is not recorded again within this time."""
DAMAGED_NPZ = (OSError, ValueError, LookupError, EOFError, MemoryError, zipfile.BadZipFile, zlib.error, RuntimeError)
"""Exceptions that numpy raises for an .npz file that was cut off or changed."""


def cache_folder(kind: str) -> Path:
    """Folder for one kind of files ("renders", "features"): under $SPHERLOC_CACHE, else in the user's cache.

    For a user without a home folder it is a temporary folder, which is deleted when the process ends.
    """
    own = os.environ.get(VARIABLE)
    return (Path(own) if own else user_cache() or _temporary()) / kind


def user_cache() -> Path | None:
    """The user's cache folder; None for a user without a home folder."""
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
    """A file name for content that is determined by ``parts``: bytes, or objects whose ``repr`` is complete."""
    digest = hashlib.sha256()
    for part in parts:
        content = part if isinstance(part, bytes) else repr(part).encode()
        digest.update(len(content).to_bytes(8, "little") + content)
    return digest.hexdigest()[:32]


def store(path: Path, content: bytes) -> bool:
    """Write a file of the cache so that no reader sees half of it; False if that fails, which costs only time."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, content)
    except OSError:
        return False
    return True


def used(path: Path) -> None:
    """Record that a file of the cache was used now."""
    with contextlib.suppress(OSError):
        if time.time() - path.stat().st_mtime > TOUCH_S:
            os.utime(path)


@cache
def make_room_once(folder: Path) -> None:
    """``make_room``, the first time in this process."""
    make_room(folder)


def make_room(folder: Path, keep_bytes: int = KEEP_BYTES) -> int:
    """Delete the longest unused files of a kind until all take at most ``keep_bytes``; returns the number of deleted
    ones.

    Files that were used within a week are kept, whatever their size, and so are files that cannot be deleted.
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
