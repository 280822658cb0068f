"""Unfinished files and folders: their names tell which process writes them; those of a killed one are recovered or
deleted."""

import contextlib
import hashlib
import os
import re
import secrets
import shutil
import socket
import time
from functools import cache, lru_cache
from pathlib import Path

STALE_AFTER_S = 600.0
"""An unfinished file this old is taken for abandoned if its owner cannot be asked: a file takes less than a second."""

_OWNER = r"(?P<machine>[0-9a-f]{8})-(?P<boot>[0-9a-f]{8})-(?P<pid>\d{1,10})-(?P<start>\d{1,20})-"
_PART = re.compile(rf"(?P<name>.+\.rrd)\.(?:{_OWNER})?[0-9a-f]{{8}}\.part")
_FOLDER = re.compile(rf"\.dropped-{_OWNER}[0-9a-f]{{16}}")


def unfinished(path: Path) -> Path:
    """The name under which this process writes the file ``path`` before it is moved to its own; new in every call."""
    return path.with_name(f"{path.name}.{_owner()}-{secrets.token_hex(4)}.part")


def target_of(part: Path) -> Path | None:
    """The file that an unfinished recording was to become; None if it is none."""
    match = _PART.fullmatch(part.name)
    return None if match is None else part.with_name(match["name"])


def leftovers(folder: Path) -> list[Path]:
    """Unfinished recordings in ``folder`` that will not be finished, because their process has ended or they are old.

    Age counts only where it cannot be known whether the process is alive, as on another machine. Raises ``OSError``
    if the folder cannot be read.
    """
    found: list[Path] = []
    with os.scandir(folder) as entries:
        for entry in entries:
            match = _PART.fullmatch(entry.name)
            with contextlib.suppress(FileNotFoundError):  # finished meanwhile
                if match is not None and entry.is_file(follow_symlinks=False):
                    alive = _alive(match)
                    if alive is None:
                        alive = time.time() - entry.stat().st_mtime <= STALE_AFTER_S
                    if not alive:
                        found.append(Path(entry.path))
    return sorted(found)


def unfinished_folder(home: Path) -> Path:
    """A hidden folder in ``home``, not made yet, in which this process gathers files; new in every call."""
    return home / f".dropped-{_owner()}-{secrets.token_hex(8)}"


def remove_abandoned_folders(home: Path) -> None:
    """Remove the folders named by ``unfinished_folder`` in ``home`` that are this user's and whose process has ended on
    this machine. Links, and folders whose process cannot be asked, stay; so does what cannot be removed."""
    with contextlib.suppress(OSError), os.scandir(home) as entries:
        for entry in entries:
            match = _FOLDER.fullmatch(entry.name)
            if match is None or not entry.is_dir(follow_symlinks=False):
                continue
            own = os.name == "nt" or entry.stat(follow_symlinks=False).st_uid == os.getuid()
            if own and _alive(match) is False:
                shutil.rmtree(entry.path, ignore_errors=True)


def _owner() -> str:
    """This process."""
    return _named(os.getpid())


@lru_cache(maxsize=1)
def _named(pid: int) -> str:
    """This process, which has another number once it is forked."""
    return f"{here()}-{pid}-{_start_of(pid) or 0}"


def _alive(part: re.Match[str]) -> bool | None:
    """Whether the process that a name tells of is alive; None if that cannot be known here."""
    if part["machine"] is None:
        return None
    machine, boot = _here()
    if part["machine"] != machine:
        return None
    if part["boot"] != boot:
        return False
    start = _start_of(int(part["pid"]))
    if not start:
        return None if start == 0 else False
    return str(start) == part["start"] if part["start"] != "0" else None


def here() -> str:
    """What tells this machine, since it was started, from others."""
    return "-".join(_here())


@cache
def _here() -> tuple[str, str]:
    """Hashes of this machine, with its space of process numbers, and of the time since which it runs."""
    try:
        space = str(Path("/proc/self/ns/pid").readlink())
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        space = boot = ""
    return _hash(f"{socket.gethostname()} {space}"), _hash(boot)


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:8]


def _start_of(pid: int) -> int | None:
    """When a process began, in ticks since the machine did (0 where that is not known); None if it has ended."""
    if not Path("/proc/self/stat").exists():
        return 0 if _exists(pid) else None
    try:
        # The name of the program, in parentheses, may hold anything.
        words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return None if words[0] in "ZX" else int(words[19])  # dead, though its parent has not heard of it yet
    except (FileNotFoundError, ProcessLookupError):
        return 0 if _exists(pid) else None  # processes of other users may be hidden
    except (OSError, ValueError, IndexError):
        return 0


def _exists(pid: int) -> bool:
    if os.name == "nt":
        return True  # sending a signal there would end it
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:
        return True
    return True
