"""Saved views of the desk and saved sets of runs: small text files beside the recordings."""

import contextlib
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from spherloc.errors import InputError, RecordingError, show
from spherloc.files import write_whole

VIEWS, SETS = "views", "sets"
"""Names of the folders of views and of sets, inside the folder of the recordings."""
VIEW_SUFFIX, SET_SUFFIX = ".json", ".txt"
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9 _.-]{0,59}")
MAX_BYTES = 20 << 20
"""Largest file, bytes: the names of 100,000 runs take 8 MB."""
MAX_VIEW_LETTERS = 20_000
MAX_FILES = 500
"""Largest number of views, and of sets, that are listed."""


def save_view(folder: Path, name: str, state: dict[str, Any]) -> None:
    """Store a view under a name; it replaces an earlier view of that name.

    Raises ``InputError`` for a name or state that cannot be stored, ``RecordingError`` if the file cannot be written.
    """
    text = json.dumps(state, indent=1)
    if len(text) > MAX_VIEW_LETTERS:
        raise InputError(f"the view {show(name)} is too large to be stored: clear the brush or the lasso.")
    _write(folder / VIEWS / (_checked(name) + VIEW_SUFFIX), text + "\n")


def views(folder: Path) -> dict[str, dict[str, Any]]:
    """All views by name; other files are left out."""
    found: dict[str, dict[str, Any]] = {}
    for path in _files(folder / VIEWS, VIEW_SUFFIX):
        with contextlib.suppress(OSError, ValueError, RecursionError):
            state = json.loads(_read(path)) if path.stat().st_size <= 4 * MAX_VIEW_LETTERS else None
            if isinstance(state, dict):
                found[path.name.removesuffix(VIEW_SUFFIX)] = state
    return found


def delete_view(folder: Path, name: str) -> None:
    """Delete a view; nothing happens if there is none of that name."""
    with contextlib.suppress(FileNotFoundError):
        (folder / VIEWS / (_checked(name) + VIEW_SUFFIX)).unlink()


def save_set(folder: Path, name: str, files: Sequence[str]) -> Path:
    """Store the names of recordings, a line each, and return the set's path. Raises as ``save_view`` does."""
    if not files:
        raise InputError("no run is selected, so there is no set to be stored.")
    path = folder / SETS / (_checked(name) + SET_SUFFIX)
    _write(path, "".join(f"{file}\n" for file in files))
    return path


def sets(folder: Path) -> dict[str, int]:
    """All sets by name, with their numbers of runs."""
    found: dict[str, int] = {}
    for path in _files(folder / SETS, SET_SUFFIX):
        with contextlib.suppress(RecordingError):
            found[path.name.removesuffix(SET_SUFFIX)] = len(read_set(path))
    return found


def set_path(folder: Path, name: str) -> Path:
    """Path of the set of that name; raises ``InputError`` for an impossible name."""
    return folder / SETS / (_checked(name) + SET_SUFFIX)


def read_set(path: Path) -> tuple[str, ...]:
    """The recordings of a set; raises ``RecordingError``, in one sentence, if the file is not a set."""
    try:
        text = _read(path)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "it is not a text of names"
        raise RecordingError(f"{path}: the set cannot be read ({reason}); save it again.") from error
    return tuple(dict.fromkeys(line.strip() for line in text.splitlines() if line.strip()))


def _checked(name: str) -> str:
    if not NAME.fullmatch(name):
        raise InputError(
            f"{show(name)} cannot be the name of a file: use up to 60 letters, digits, spaces, '-', '_' and '.'."
        )
    return name.strip()


def _files(folder: Path, suffix: str) -> list[Path]:
    try:
        return sorted(path for path in folder.iterdir() if path.name.endswith(suffix))[:MAX_FILES]
    except OSError:
        return []


def _read(path: Path) -> str:
    if not path.is_file() or path.is_symlink() or path.stat().st_size > MAX_BYTES:
        raise ValueError("no such file, or too large")
    return path.read_text(encoding="utf-8")


def _write(path: Path, text: str) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, text.encode())
    except OSError as error:
        raise RecordingError(
            f"{path}: cannot be stored ({error.strerror or error}); make room or check the folder."
        ) from error
