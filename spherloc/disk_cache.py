"""What can be computed again is kept on disk: rendered images and features, by a key of all that they depend on."""

import contextlib
import hashlib
import os
import uuid
from pathlib import Path

VARIABLE = "SPHERLOC_CACHE"
"""Environment variable that moves the cache."""


def cache_folder(kind: str) -> Path:
    """Folder for one kind of things ("renders", "features"): under $SPHERLOC_CACHE, else in the user's cache."""
    own = os.environ.get(VARIABLE)
    shared = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "spherloc"
    return (Path(own) if own else shared) / kind


def key_of(*parts: object) -> str:
    """A file name for what follows from ``parts``: bytes, or whatever has a ``repr`` that says it all."""
    digest = hashlib.sha256()
    for part in parts:
        content = part if isinstance(part, bytes) else repr(part).encode()
        digest.update(len(content).to_bytes(8, "little") + content)
    return digest.hexdigest()[:32]


def store(path: Path, content: bytes) -> bool:
    """Write a file of the cache so that no reader sees half of it; False if that fails, which only costs time."""
    part = path.with_name(f"{path.name}.{uuid.uuid4().hex[:8]}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_bytes(content)
        part.replace(path)
    except OSError:
        return False
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
    return True
