"""Makes a scene of what a person uploads: matches, a calibration, gravity and maybe the truth.

What is uploaded is untrusted. It is limited in size, read only as what it should be, and written nowhere but into
the session's own folder, under names of ours. No uploaded file can name another file.
"""

import json
import re
import shutil
import tempfile
import threading
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from spherloc.cameras.base import Camera
from spherloc.cameras.calibration import load_camera
from spherloc.datasets import Scene, load_scene
from spherloc.errors import InputError, show

MAX_BYTES = 10_000_000
MAX_CALIBRATION_BYTES = 256 * 1024
MAX_ROWS = 200_000
MAX_NAME = 60


@dataclass(frozen=True)
class File:
    """A file as it was uploaded."""

    name: str
    """Untrusted text: shown, never used as a path."""
    content: bytes

    @property
    def title(self) -> str:
        """The name without folders and without what cannot be printed."""
        last = PurePosixPath(self.name.replace("\\", "/")).name
        return "".join(filter(str.isprintable, last)).strip()[:MAX_NAME] or "upload"


@dataclass(frozen=True)
class UploadForm:
    """What a person filled in."""

    matches: File
    """CSV."""
    calibration: File
    """A calibration file of any kind that ``load_camera`` reads."""
    gravity_camera: str
    """Three numbers, as all texts below."""
    gravity_map: str
    gravity_bound_deg: str
    """One number; empty for 0."""
    truth: str
    """Twelve numbers, the rows of the true [R | t]; empty if it is unknown."""


class Scratch:
    """A folder of one session, which other users of the machine cannot read; made when it is first needed."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._folder: Path | None = None
        self._made = 0
        self._closed = False

    def new(self) -> Path:
        """A new, empty folder in it. Raises ``InputError`` if there is no room for one."""
        with self._lock:
            if self._closed:
                raise InputError("this page has been closed; open another.")
            try:
                if self._folder is None:
                    self._folder = Path(tempfile.mkdtemp(prefix="spherloc-"))  # mode 0700
                self._made += 1
                folder = self._folder / str(self._made)
                folder.mkdir(mode=0o700)
            except OSError as error:
                raise InputError(f"there is no place for the file ({error.strerror}); make room.") from None
            return folder

    def has(self, path: Path) -> bool:
        """Whether a path is in it."""
        return self._folder is not None and path.resolve().is_relative_to(self._folder.resolve())

    def close(self) -> None:
        """Remove it with all that is in it."""
        with self._lock:
            self._closed = True
            if self._folder is not None:
                shutil.rmtree(self._folder, ignore_errors=True)


def open_upload(form: UploadForm, folder: Path) -> tuple[Path, Scene]:
    """Write the scene that a form describes into an empty folder, and read it as any scene file is read.

    Raises ``InputError`` in one sentence, which calls the files by the names that they were uploaded with.
    """
    names = {
        folder / "matches.csv": form.matches.title,
        folder / "calibration": form.calibration.title,
        folder / "scene.toml": "the form",
    }
    path = folder / "scene.toml"
    try:
        check_matches(form.matches)
        (folder / "matches.csv").write_bytes(form.matches.content)
        camera = read_calibration(form.calibration, folder / "calibration")
        path.write_text(scene_text(form, camera), encoding="utf-8")
        scene = load_scene(path)
    except InputError as error:
        sentence = str(error)
        for own, shown in names.items():
            sentence = sentence.replace(str(own), shown)
        raise InputError(sentence) from None
    except OSError as error:
        raise InputError(f"the upload cannot be kept ({error.strerror}); make room.") from None
    return path, scene


def check_matches(file: File) -> None:
    """Raise ``InputError`` for what is too large, or no text at all, before it is read."""
    if len(file.content) > MAX_BYTES:
        raise InputError(f"{file.title}: larger than {MAX_BYTES // 1_000_000} MB; upload fewer matches.")
    if not file.content:
        raise InputError(f"{file.title}: is empty; upload a CSV with the columns u, v, X, Y, Z.")
    nul = file.content.find(b"\0")
    if nul >= 0:
        raise InputError(f"{file.title}: byte {nul} is not text; upload a CSV with the columns u, v, X, Y, Z.")
    # Rows end with \n, \r or both; a quoted line break makes this too many, never too few.
    ends = file.content.count(b"\n") + file.content.count(b"\r") - file.content.count(b"\r\n")
    if ends > MAX_ROWS:
        raise InputError(f"{file.title}: has more than {MAX_ROWS:,} lines; upload fewer matches.")


def read_calibration(file: File, path: Path) -> Camera:
    """The camera of an uploaded calibration, which is written to ``path`` on the way.

    Raises ``InputError`` for what is too large or no calibration, and for a TOML with more than a camera in it: an
    upload must not name files.
    """
    if len(file.content) > MAX_CALIBRATION_BYTES:
        raise InputError(f"{file.title}: larger than {MAX_CALIBRATION_BYTES // 1024} KiB, which no calibration is.")
    keys = _toml_keys(file.content)
    if "camera" in keys and len(keys) > 1:
        other = min(keys - {"camera"})
        raise InputError(
            f"{file.title}: has {show(other)} beside the section [camera]; upload the camera alone, since an upload "
            "cannot name other files."
        )
    path.write_bytes(file.content)
    return load_camera(path)


def _toml_keys(content: bytes) -> set[str]:
    """The keys at the top of a TOML; none if it is none, which ``load_camera`` then judges."""
    try:
        return set(tomllib.loads(content.decode("utf-8-sig")))
    except (ValueError, RecursionError):
        return set()


def scene_text(form: UploadForm, camera: Camera) -> str:
    """The scene file (TOML) of a form.

    Raises ``InputError`` for a field that is not made of as many numbers as it should be.
    """
    bound = form.gravity_bound_deg.strip()
    gravity = {
        "camera": numbers(form.gravity_camera, 3, "gravity in the camera"),
        "map": numbers(form.gravity_map, 3, "gravity in the map"),
        **({"bound_deg": numbers(bound, 1, "gravity's error")[0]} if bound else {}),
    }
    parts = {"camera": camera.to_dict(), "gravity": gravity}
    if form.truth.strip():
        values = numbers(form.truth, 12, "the true pose")
        parts["truth"] = {"cam_from_map": [values[0:4], values[4:8], values[8:12]]}
    head = {"kind": "correspondences", "name": form.matches.title, "correspondences": "matches.csv"}
    sections = (f"\n[{name}]\n" + _lines(table) for name, table in parts.items())
    return _lines(head) + "".join(sections)


def _lines(table: Mapping[str, Any]) -> str:
    # A JSON text, number or list is one in TOML too.
    return "".join(f"{key} = {json.dumps(value, ensure_ascii=False)}\n" for key, value in table.items())


def numbers(text: str, count: int, what: str) -> list[float]:
    """So many finite numbers, apart by spaces, commas, semicolons or brackets; ``InputError`` if they are none."""
    words = re.split(r"[\s,;\[\]()]+", text.strip(" \t\r\n,;[]()"))
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != count or not np.isfinite(values).all():
        numeral = "a number" if count == 1 else f"{count} numbers"
        raise InputError(f"{what} is {show(text[:80])}; give {numeral}.")
    return values
