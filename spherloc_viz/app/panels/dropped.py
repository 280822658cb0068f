"""Keeps the photographs that are dropped onto a page in a folder that is made for them.

What a page sends is untrusted. It is limited in number and size, and written nowhere but into that folder. Names are
checked, and are of files with the endings of photographs and of what may lie beside them. While files arrive, the
folder is hidden; it gets its name when all are there, and is removed if anything fails, or by the next playground if
this one is killed.
"""

import contextlib
import json
import os
import re
import shutil
import threading
from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import BinaryIO

from spherloc.errors import InputError, reason, shorten
from spherloc.files import IMAGES, is_image
from spherloc.images import MAX_BYTES
from spherloc.mapping.images.found_calibrations import CALIBRATIONS
from spherloc.mapping.images.left_out import UNREAD
from spherloc.mapping.scenes.scene_files import MAP_FOLDER
from spherloc_viz.app.web.drops import Arriving, NotTakenError
from spherloc_viz.recording.storage.unfinished import remove_abandoned_folders, unfinished_folder

BESIDE = (*CALIBRATIONS, ".csv")
"""Endings of the files beside photographs that are kept: calibrations, positions and gravity."""
MAX_BESIDE_BYTES = 50_000_000
MAX_FILES = 2_000
MAX_ALL_BYTES = 20_000_000_000
MAX_DEEP = 5
"""Longest path of a file in the folder, names; of a recorded sequence they have four."""
MAX_NAME_BYTES = 200
MAX_FOLDER_LETTERS = 40
UNSAFE = re.compile(r'[\\:*?"<>|]|[. ]$|^(con|prn|aux|nul|com\d|lpt\d)(\.|$)', re.IGNORECASE)
"""What names must not have, of which some mean something else on Windows."""
FOLDER = "dropped_{}"
NO_NAME = "photographs"
"""The name of what has none, such as several files."""


class DroppedFiles:
    """What is dropped onto one page: a folder at a time, a file after the other. Thread-safe.

    Whatever is refused raises ``InputError``, one sentence; ``NotTakenError`` where only one file is.
    """

    def __init__(self, homes: Callable[[], tuple[Callable[[], Path], ...]], done: Callable[[Path], None]) -> None:
        """``homes`` gives what find the folders in which one may be made, of which the first is taken that can be
        written into; ``done`` is called with the folder once all of its files are there."""
        self._homes, self._done = homes, done
        self._lock = threading.Lock()
        self._closed = False
        self._folder: Path | None = None
        """Where files arrive; None while nothing is being dropped."""
        self._name = ""
        self._files = self._bytes = 0
        self._arriving: _ArrivingFile | None = None

    def begin(self, name: str, count: int, size_bytes: int) -> None:
        """Make room for so many files of that size in all, dropped as a folder of that name (empty for none). What is
        still on its way is given up."""
        with self._lock:
            if self._closed:
                raise InputError("this page has been closed; open another.")
            self._remove()
            if not (0 < count <= MAX_FILES and 0 <= size_bytes <= MAX_ALL_BYTES):
                raise InputError(
                    f"{count:,} files of {size_bytes / 1e9:.1f} GB cannot be dropped at once; drop {MAX_FILES:,} files "
                    f"of {MAX_ALL_BYTES / 1e9:.0f} GB at most, or open their folder under Open."
                )
            self._folder = self._made(size_bytes)
            self._name = FOLDER.format(_folder_name(name))
            self._files = self._bytes = 0

    def _made(self, size_bytes: int) -> Path:
        """A hidden folder in the first home that can be written into."""
        wrong: OSError | None = None
        for home in self._homes():
            try:
                place = home()
                remove_abandoned_folders(place)
                folder = unfinished_folder(place)
                folder.mkdir()
                free = shutil.disk_usage(folder).free
            except OSError as error:
                wrong = error
                continue
            if free > size_bytes:
                return folder
            folder.rmdir()
            raise InputError(
                f"the photographs have {size_bytes / 1e6:,.0f} MB, and the disk of the playground has "
                f"{free / 1e6:,.0f} MB free; make room."
            )
        raise InputError(
            f"there is no place for the photographs ({'' if wrong is None else reason(wrong)}); make room."
        )

    def open(self, name: str) -> Arriving:
        """A file that arrives, to be closed before the next. ``name`` is its path in the folder, with "/"."""
        parts = safe_parts(name)
        with self._lock:
            if self._folder is None:
                raise InputError("these photographs are no longer awaited; drop them again.")
            if self._arriving is not None:
                raise InputError(f"{parts[-1]}: another file is on its way; send one after the other.")
            if self._files >= MAX_FILES:
                raise NotTakenError(f"{parts[-1]}: is more than {MAX_FILES:,} files; drop fewer.")
            path = self._folder.joinpath(*parts)
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                file = path.open("xb", buffering=0)
            except (FileExistsError, NotADirectoryError):
                told = shorten(parts[-1])
                raise NotTakenError(f"{told}: is called as another file is; give it another name.") from None
            except OSError as error:
                self._remove()
                raise _not_written(path, error) from None
            self._files += 1
            self._arriving = _ArrivingFile(self, path, file)
            return self._arriving

    def end(self) -> None:
        """All are there: the folder gets its name."""
        with self._lock:
            folder = self._folder
            if folder is None or self._arriving is not None or not self._files:
                raise InputError("these photographs are not all there; drop them again.")
            number = 1
            while True:
                kept = folder.with_name(self._name if number == 1 else f"{self._name}_{number}")
                if not any(map(os.path.lexists, (kept, kept.with_name(MAP_FOLDER.format(kept.name))))):
                    break
                number += 1
            try:
                folder.rename(kept)
            except OSError as error:
                self._remove()
                raise _not_written(kept, error) from None
            self._folder = None
        self._done(kept)

    def cancel(self) -> None:
        """Remove what has arrived of the folder; nothing happens if all of it has."""
        with self._lock:
            self._remove()

    def close(self) -> None:
        """The page has gone: as ``cancel``, and nothing more can be dropped."""
        with self._lock:
            self._closed = True
            self._remove()

    def _remove(self) -> None:
        folder, self._folder = self._folder, None
        if self._arriving is not None:
            self._arriving.file.close()
            self._arriving = None
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)

    def write(self, arriving: "_ArrivingFile", piece: bytes) -> None:
        """Add a piece to a file; raises ``InputError``, after which nothing of the folder is left."""
        with self._lock:
            if self._arriving is not arriving:
                raise InputError("these photographs are no longer awaited; drop them again.")
            self._bytes += len(piece)
            arriving.size_bytes += len(piece)
            name, most = shorten(arriving.path.name), most_bytes(arriving.path.name)
            try:
                if arriving.size_bytes > most:
                    raise InputError(f"{name}: larger than {most / 1e6:.0f} MB; drop smaller files.")
                if self._bytes > MAX_ALL_BYTES:
                    raise InputError(f"more than {MAX_ALL_BYTES / 1e9:.0f} GB are too many; drop fewer photographs.")
                _write_all(arriving.file, piece)
            except InputError:
                self._remove()
                raise
            except OSError as error:
                self._remove()
                raise _not_written(arriving.path, error) from None

    def broken_off(self, arriving: "_ArrivingFile") -> None:
        """A file will not be whole: as ``cancel``, unless other files have been begun since."""
        with self._lock:
            if self._arriving is arriving:
                self._remove()

    def arrived(self, arriving: "_ArrivingFile") -> None:
        """A file is there as a whole."""
        with self._lock:
            if self._arriving is arriving:
                self._arriving = None
            with contextlib.suppress(OSError):
                arriving.file.close()


class _ArrivingFile:
    """A file of which pieces arrive."""

    def __init__(self, drop: DroppedFiles, path: Path, file: BinaryIO) -> None:
        self._drop = drop
        self.path, self.file, self.size_bytes = path, file, 0

    def write(self, piece: bytes) -> None:
        """Add a piece; raises ``InputError`` as ``DroppedFiles.write``."""
        self._drop.write(self, piece)

    def close(self) -> None:
        """All of it is there, or no more will come."""
        self._drop.arrived(self)

    def break_off(self) -> None:
        """It broke off on its way."""
        self._drop.broken_off(self)


def _not_written(path: Path, error: OSError) -> InputError:
    return InputError(
        f"{shorten(path.name)}: cannot be written ({reason(error)}), so none of the photographs was kept; make room "
        "and drop them again."
    )


def _write_all(file: BinaryIO, piece: bytes) -> None:
    rest = memoryview(piece)
    while rest:
        rest = rest[file.write(rest) :]


def safe_parts(name: str) -> tuple[str, ...]:
    """The folders and the name of a file that a page has named by its path in what was dropped.

    Raises ``NotTakenError`` for one that is no relative path, is too deep or too long, is hidden, has letters that no
    name should have, or has not the ending of a photograph or of what lies beside photographs.
    """
    parts = tuple(name.split("/"))
    told = shorten(parts[-1])
    if len(parts) > MAX_DEEP:
        raise NotTakenError(f"{told}: lies more than {MAX_DEEP - 1} folders deep; drop the folder that has it.")
    for part in parts:
        letters = part.encode("utf-8", "replace")
        if not part or part.startswith(".") or not part.isprintable() or UNSAFE.search(part):
            raise NotTakenError(f"{told}: has a name that is not kept here; give it one of letters and digits.")
        if len(letters) > MAX_NAME_BYTES:
            raise NotTakenError(f"{told}: has too long a name; give it a shorter one.")
    if not is_image(parts[-1]) and Path(parts[-1]).suffix.lower() not in BESIDE:
        raise NotTakenError(f"{told}: is no photograph ({', '.join(sorted(IMAGES))}) and no calibration; leave it out.")
    return parts


def most_bytes(name: str) -> int:
    """The largest size of a file of that name."""
    return MAX_BYTES if is_image(name) else MAX_BESIDE_BYTES


def _folder_name(name: str) -> str:
    """What of a dropped folder's name its folder here is called by."""
    return re.sub(r"[^\w-]+", "_", name).strip("_")[:MAX_FOLDER_LETTERS] or NO_NAME


def dropping_html(address: str) -> str:
    """What tells the page (``drops.js``) where it sends what is dropped, and what is taken."""
    told = {
        "address": address,
        "photographs": sorted(IMAGES),
        "unread": sorted(UNREAD),
        "beside": BESIDE,
        "mostBytes": MAX_BYTES,
        "mostBytesBeside": MAX_BESIDE_BYTES,
        "mostFiles": MAX_FILES,
    }
    return f'<div data-drops="{escape(json.dumps(told))}"></div>'
