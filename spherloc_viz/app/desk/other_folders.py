"""Other folders of recordings that the desk may compare with: those below the folders that a page may open."""

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from spherloc.errors import InputError
from spherloc_viz.app.panels.folders import Roots
from spherloc_viz.recording.index.file import FILE_NAME
from spherloc_viz.recording.index.query import RunQuery
from spherloc_viz.recording.index.run_index import RunIndex
from spherloc_viz.recording.run_row import RunRow
from spherloc_viz.recording.storage.room import GALLERY

MAX_LOOKED_INTO = 2_000
"""Largest number of folders that are searched for recordings."""
MAX_DEPTH = 5
"""How many levels below an allowed folder are searched."""
MAX_OFFERED = 200


class OtherFolders:
    """Folders with a list of runs, other than the one that the desk shows."""

    def __init__(self, own: Path, allowed: Sequence[Path]) -> None:
        """``own`` is the folder of the desk's recordings, in which there may be other folders too."""
        self._own, self._roots = Path(os.path.realpath(own)), Roots([own, *allowed])

    def listed(self) -> list[dict[str, str]]:
        """``place`` and ``name`` of each for the page, those inside the desk's own folder first."""
        found: list[dict[str, str]] = []
        looked_into = 0
        for root in self._roots.folders:
            for folder in _folders(root, MAX_DEPTH):
                looked_into += 1
                place = self._roots.place(folder)
                if looked_into > MAX_LOOKED_INTO or len(found) == MAX_OFFERED:
                    return found
                if (
                    folder != self._own
                    and (folder / FILE_NAME).is_file()
                    and all(place != one["place"] for one in found)
                ):
                    name = folder.relative_to(root).as_posix()
                    found.append({"place": place or "", "name": f"{root.name}/{name}" if name != "." else root.name})
        return found

    def rows(self, place: str) -> tuple[RunRow, ...]:
        """All runs of a listed folder, after its new recordings have been read.

        Raises ``InputError`` for a place that may not be opened or has no runs, ``RecordingError`` as the list does.
        """
        folder = self._roots.find(place)
        if not (folder / FILE_NAME).is_file():
            raise InputError(f"{folder}: has no list of runs; make it with spherloc runs {folder}.")
        with RunIndex(folder) as index:
            index.refresh()
            return index.find(RunQuery(), None).rows


def _folders(folder: Path, depth: int) -> Iterator[Path]:
    """A folder and those in it, without hidden ones, links and galleries."""
    yield folder
    if not depth:
        return
    try:
        with os.scandir(folder) as entries:
            inside = sorted(entry.name for entry in entries if _is_plain_folder(entry))
    except OSError:
        return
    for name in inside:
        yield from _folders(folder / name, depth - 1)


def _is_plain_folder(entry: os.DirEntry[str]) -> bool:
    try:
        return entry.is_dir(follow_symlinks=False) and not entry.name.startswith(".") and entry.name != GALLERY
    except OSError:
        return False
