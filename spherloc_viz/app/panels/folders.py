"""The folders in which a page may open files.

A page names a file by the number of an allowed folder and a relative path; both are checked.
"""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from spherloc.datasets.asl_layout import AslSequence, asl_sequence
from spherloc.datasets.given_path import MAX_FOLDERS, images_in_folders, images_of_cameras
from spherloc.datasets.scene_file import read_table
from spherloc.errors import InputError
from spherloc.files import IMAGES
from spherloc.mapping.images.left_out import about_unread

PAGE = 12
"""Rows that are shown at once."""
MAX_ENTRIES = 20_000
"""Largest number of a folder's entries that are looked at."""
MAX_PEEK_BYTES = 100_000
"""Larger TOML files are not read before they are opened."""


@dataclass(frozen=True)
class Row:
    """One line of a listing."""

    kind: Literal["folder", "scene", "other"]
    """Kind of the entry; "other" is a TOML file that is not a scene."""
    name: str
    """File name."""
    place: str
    """What names it to ``Roots.find``."""
    about: str = ""
    """Kind and name of a scene, or what is wrong with it; of a folder whether it is one of a recorded sequence."""


@dataclass(frozen=True)
class Listing:
    """A page of what is in a folder."""

    folder: Path
    place: str
    parent: str | None
    """Place of the folder above, if that may be looked into."""
    rows: tuple[Row, ...]
    page: int
    """Index of the page of the listing, from 0."""
    pages: int
    remarks: tuple[str, ...]
    """What is not shown and why, in sentences."""
    photographs: int
    """Number of image files in it."""
    in_folders: dict[str, int]
    """Number of image files in each of its sub-folders that has some, or of each camera of a sequence in the ASL
    layout; empty if it has other image files itself, or if a link in it leads out of the allowed folders."""
    sequence: bool = False
    """Whether it is such a sequence."""


class Roots:
    """Folders below which a page may look. Symbolic links count as what they point to."""

    def __init__(self, folders: Sequence[Path]) -> None:
        """Folders that do not exist are left out."""
        resolved = (Path(os.path.realpath(folder)) for folder in folders)
        self.folders = tuple(dict.fromkeys(folder for folder in resolved if folder.is_dir()))

    def add(self, folder: Path) -> None:
        """Allow another folder, which exists."""
        self.folders = tuple(dict.fromkeys((*self.folders, Path(os.path.realpath(folder)))))

    def find(self, place: str) -> Path:
        """The resolved path of a place "NUMBER:RELATIVE".

        Raises ``InputError`` unless it exists below one of the roots.
        """
        number, colon, relative = place.partition(":")
        if not (colon and number.isascii() and number.isdigit() and len(number) < 4):
            raise InputError("this is not a place in an allowed folder; choose one from the list.")
        if int(number) >= len(self.folders):
            raise InputError("this folder is not allowed any more; choose one from the list.")
        try:
            path = Path(os.path.realpath(self.folders[int(number)] / relative))
            known = self.place(path) is not None and path.exists()
        except (OSError, ValueError):  # names that no file can have
            known = False
        if not known:
            raise InputError("this file is not there or not in an allowed folder; choose one from the list.")
        return path

    def place(self, path: Path) -> str | None:
        """What names a resolved path to ``find``; None if it is below none of the roots."""
        for number, root in enumerate(self.folders):
            if path.is_relative_to(root):
                return f"{number}:{path.relative_to(root).as_posix()}"
        return None

    def look_into(self, place: str, page: int = 0) -> Listing:
        """A page of the sub-folders and scene files in a folder; pages that there are not become the nearest.

        Raises ``InputError`` if it cannot be read or is not allowed.
        """
        folder = self.find(place)
        try:
            entries, remarks, photographs, outside = self._entries(folder)
        except OSError as error:
            reason = error.strerror or error
            raise InputError(f"the folder {folder.name} cannot be read ({reason}); choose another.") from None
        pages = max(1, -(-len(entries) // PAGE))
        page = min(max(page, 0), pages - 1)
        rows = tuple(describe(path, own) for path, own in entries[PAGE * page : PAGE * (page + 1)])
        above = self.place(folder.parent)
        folders = [] if photographs or outside else [path.name for path, _ in entries if path.is_dir()]
        sequence = None if outside else self._sequence(folder)
        counts = images_in_folders(folder, folders, MAX_FOLDERS) if sequence is None else images_of_cameras(sequence)
        at, recorded = self.place(folder) or "", sequence is not None
        if sequence is None:
            rows = tuple(self._with_sequence(folder, row) for row in rows)
        else:
            remarks = (*remarks, *self._about_other_cameras(sequence))
        return Listing(folder, at, above, rows, page, pages, remarks, photographs, counts, recorded)

    def _with_sequence(self, folder: Path, row: Row) -> Row:
        """A row of a folder, which says so if it is one of a recorded sequence."""
        sequence = self._sequence(folder / row.name) if row.kind == "folder" else None
        if sequence is None:
            return row
        return replace(row, about=f"a recorded sequence of {and_words(sorted(sequence.cameras))}")

    def _about_other_cameras(self, sequence: AslSequence) -> Iterator[str]:
        """Where all cameras of a sequence are, if it is that of one of several."""
        whole = self._sequence(sequence.folder)
        if whole is not None and whole.cameras.keys() > sequence.cameras.keys():
            cameras = and_words(sorted(whole.cameras))
            yield f"For a map of all cameras of this sequence, {cameras}, go up to {whole.folder.name}."

    def _sequence(self, folder: Path) -> AslSequence | None:
        """The sequence in the ASL layout that a folder is, if all of its cameras are below the roots."""
        sequence = asl_sequence(folder)
        inside = sequence is not None and all(
            self.place(Path(os.path.realpath(images))) is not None for images in sequence.cameras.values()
        )
        return sequence if inside else None

    def _entries(self, folder: Path) -> tuple[list[tuple[Path, str]], tuple[str, ...], int, int]:
        """Folders, then TOML files, by name, each with its place; what was left out; how many are images; and how many
        lead out of the roots."""
        found: list[tuple[bool, str, Path, str]] = []
        files: list[str] = []
        hidden = outside = photographs = 0
        whole = True
        with os.scandir(folder) as scan:
            for count, entry in enumerate(scan):
                if count == MAX_ENTRIES:
                    whole = False
                    break
                is_folder = _is_folder(entry)
                photographs += not is_folder and Path(entry.name).suffix.lower() in IMAGES
                if not is_folder:
                    files.append(entry.name)
                if not (is_folder or entry.name.lower().endswith(".toml")):
                    continue
                if entry.name.startswith("."):
                    hidden += 1
                    continue
                path = Path(os.path.realpath(entry.path)) if entry.is_symlink() else folder / entry.name
                place = self.place(path)
                if place is None:
                    outside += 1
                else:
                    found.append((not is_folder, entry.name, folder / entry.name, place))
        found.sort(key=lambda item: (item[0], item[1].casefold(), item[1]))
        remarks = (*about_unread(sorted(files)), *_remarks(hidden, outside, whole))
        return [(path, place) for _, _, path, place in found], remarks, photographs, outside


def and_words(words: Sequence[str]) -> str:
    """One word or more: "cam0, cam1 and cam2"."""
    *others, last = words
    return f"{', '.join(others)} and {last}" if others else last


def _remarks(hidden: int, outside: int, whole: bool) -> Iterator[str]:
    if hidden:
        yield f"{hidden} hidden by a leading dot."
    if outside:
        yield f"{outside} left out, since they are links to folders that are not allowed."
    if not whole:
        yield f"Only the first {MAX_ENTRIES:,} entries of this folder were looked at."


def _is_folder(entry: os.DirEntry) -> bool:
    try:
        return entry.is_dir()
    except OSError:
        return False


def describe(path: Path, place: str) -> Row:
    """A folder or file, and what a scene file says of itself."""
    try:
        if path.is_dir():
            return Row("folder", path.name, place)
        if not path.is_file():  # reading a pipe would wait for ever
            return Row("other", path.name, place, "is not a file")
        if path.stat().st_size > MAX_PEEK_BYTES:
            return Row("scene", path.name, place, "large")
        table = read_table(path)
    except (InputError, OSError):
        return Row("other", path.name, place, "cannot be read")
    kind, name = table.get("kind"), table.get("name")
    if not isinstance(kind, str):
        return Row("other", path.name, place, "is not a scene file")
    about = " ".join(str(table.get("about", "")).split())
    return Row("scene", path.name, place, ": ".join(filter(None, (f"{name} ({kind})", about))))
