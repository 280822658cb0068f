"""Scenes that were opened before, kept in the user's cache."""

import json
import threading
from pathlib import Path

from spherloc.disk_cache import cache_folder, store

MOST = 8
"""Scenes that are remembered."""
MOST_BYTES = 100_000

_writing = threading.Lock()


class RecentScenes:
    """Paths of scene files, the newest first, in a small JSON file that all pages share."""

    def __init__(self, path: Path | None = None) -> None:
        self._path = path or cache_folder("recent") / "scenes.json"

    def read(self) -> tuple[tuple[Path, ...], str]:
        """The paths, and a remark if the file is damaged; whether the scenes are still there is not known."""
        try:
            if not self._path.exists():
                return (), ""
            if self._path.stat().st_size > MOST_BYTES:
                raise ValueError("too large")
            values = json.loads(self._path.read_text(encoding="utf-8"))
            if not isinstance(values, list) or not all(isinstance(value, str) for value in values):
                raise ValueError("no list of paths")
        except (OSError, ValueError, RecursionError):
            return (), f"The list of recent scenes ({self._path.name}) is damaged and is begun anew."
        return tuple(Path(value) for value in values[:MOST] if value and "\0" not in value), ""

    def note(self, path: Path) -> None:
        """Put a scene file in front."""
        with _writing:
            before, _ = self.read()
            paths = [str(path), *(str(other) for other in before if other != path)]
            store(self._path, json.dumps(paths[:MOST], indent=1).encode())
