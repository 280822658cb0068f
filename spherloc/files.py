"""Reads files that a user names, regular files of limited size only, and writes files as a whole.

A link to ``/dev/zero`` has no end, and opening a pipe without a writer never returns. Every refusal is an ``OSError``
with a reason in ``strerror``, also for impossible file names, for which Python raises ``ValueError``.
"""

import errno
import os
import stat
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from spherloc.errors import InputError, reason

_PIECE_BYTES = 1 << 20
IMAGES = {".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp"}
"""Endings of the names of files that count as images, in lower case."""


def is_image(name: str) -> bool:
    """Whether a file counts as an image by its name; hidden files, such as macOS's "._photo.jpg", do not."""
    return Path(name).suffix.lower() in IMAGES and not name.startswith(".")


def is_file(path: Path) -> bool:
    """True for a regular file, links followed; False also for a path that cannot be looked up: too long, no
    permission."""
    return _mode_is(path, stat.S_ISREG)


def is_folder(path: Path) -> bool:
    """True for a folder, links followed; False also for a path that cannot be looked up: too long, no permission."""
    return _mode_is(path, stat.S_ISDIR)


def _mode_is(path: Path, kind: Callable[[int], bool]) -> bool:
    try:
        return kind(Path(path).stat().st_mode)
    except (OSError, ValueError):
        return False


def size_of(path: Path) -> int:
    """Size of a regular file, bytes; raises ``OSError`` for anything else.

    To be called before a library opens a path by itself.
    """
    try:
        status = Path(path).stat()
    except ValueError:
        raise _no_such_name(path) from None
    _check_regular(status.st_mode, path)
    return status.st_size


def open_file(path: Path) -> BinaryIO:
    """A regular file, opened for reading bytes; raises ``OSError`` for anything else, and never waits for a pipe."""
    size_of(path)  # opening a device may already do something
    try:
        file = open(path, "rb", opener=_without_waiting)  # noqa: SIM115 -- Path.open has no opener
    except ValueError:
        raise _no_such_name(path) from None
    try:
        _check_regular(os.fstat(file.fileno()).st_mode, path)
    except OSError:
        file.close()
        raise
    return file


def read_file(path: Path, most_bytes: int) -> bytes:
    """The content of a regular file.

    Raises ``OSError`` for anything else and for a file of more than ``most_bytes``, also if it grows beyond them while
    it is read or does not state its size.
    """
    with open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        content = file.read(min(size, most_bytes) + 1)
        while len(content) <= most_bytes and (more := file.read(_PIECE_BYTES)):
            content += more
    if len(content) > most_bytes:
        raise OSError(errno.EFBIG, f"larger than {_bytes(most_bytes)}", str(path))
    return content


@contextmanager
def reading(path: Path, advice: str) -> Iterator[None]:
    """Context in which a file is read: every ``OSError`` becomes an ``InputError`` with ``advice`` ("correct the key
    'image'")."""
    try:
        yield
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; {advice}.") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({reason(error)}); {advice}.") from None


def names_in(folder: Path) -> list[str]:
    """Names in a folder, sorted.

    Raises ``InputError``, one sentence that names it, if there is no such folder or it cannot be listed.
    """
    try:
        return sorted(entry.name for entry in Path(folder).iterdir())
    except (OSError, ValueError) as error:
        raise InputError(f"{folder}: cannot be read ({reason(error)}); give a folder that can be listed.") from None


def _without_waiting(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0))


def _check_regular(mode: int, path: Path) -> None:
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, "a folder, not a file", str(path))
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, "not a regular file but a device, a pipe or a socket", str(path))


def _bytes(count: int) -> str:
    for unit, size in (("MiB", 1 << 20), ("KiB", 1 << 10)):
        if count % size == 0:
            return f"{count // size:,} {unit}"
    return f"{count:,} bytes"


def _no_such_name(path: Path) -> OSError:
    return OSError(errno.EINVAL, "no file can have such a name", str(path))


def write_whole(path: Path, content: bytes, sync: bool = False) -> None:
    """Write a file so that no reader sees half of it; ``sync`` waits until it is on the disk.

    Raises ``OSError`` if that fails; no partial file is left then.
    """
    part = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.part")
    try:
        with part.open("wb") as file:
            file.write(content)
            if sync:
                file.flush()
                os.fsync(file.fileno())
        part.replace(path)
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)


def lock(handle: int) -> None:
    """Lock an open file or folder against other processes; the system releases the lock however this process ends.

    Raises ``BlockingIOError`` if another process has it. Does nothing where there are no such locks.
    """
    try:
        import fcntl
    except ImportError:  # Windows
        return
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise
    except OSError:  # a file system without locks
        return
