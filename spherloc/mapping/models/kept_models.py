"""Keeps what COLMAP made of photographs, before level and scale, so that the same map is not made again.

A file beside the map has it, with a hash of all on which it depends: photographs, cameras, masks, gravity, features and
the sources of this package. Where anything of that differs, or the file is damaged, the models are made anew.
"""

import io
import json
import zipfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from spherloc.disk_cache import DAMAGED_NPZ, key_of, store
from spherloc.files import is_file, names_in, open_file, read_file
from spherloc.frontend.features import VERSION
from spherloc.frontend.pipeline import FrontendOptions
from spherloc.frontend.view import Gravity, View
from spherloc.mapping.alignment.fixed_images import FixedImages
from spherloc.mapping.models.model import Reconstruction, poses_of
from spherloc.mapping.rig import shots_of
from spherloc.registry import require

FILE = "models.zip"
"""Name of the file."""
_INDEX, _COUNTS = "index.json", "counts.npz"
_MAX_SOURCE = 1 << 20
"""Bytes of a source file of this package."""


def kept_or_made(
    views: Sequence[View],
    gravity: Sequence[Gravity | None],
    folder: Path,
    how: FrontendOptions,
    fixed: FixedImages | None,
    make: Callable[[], tuple[Reconstruction, ...]],
) -> tuple[Reconstruction, ...]:
    """The models that ``make`` makes of ``views`` with their ``gravity`` and what says how their cameras are ``fixed``;
    those that ``folder`` keeps if they were made of the same.

    Models that were just made are read back from the file, so that a map is the same either way. If they cannot be
    written, nothing is kept. Raises what ``make`` raises.
    """
    key = _key(views, gravity, how, fixed)
    kept = _read(folder, key)
    if kept is not None:
        return kept
    forget(folder)  # a run that is stopped may change the database on which these models rely
    made = make()
    return (_read(folder, key) if _write(folder, key, made) else None) or made


def forget(folder: Path) -> None:
    """Remove the models that a folder keeps."""
    with suppress(OSError):  # a file that stays is read for its own key only
        (folder / FILE).unlink()


def _key(
    views: Sequence[View], gravity: Sequence[Gravity | None], how: FrontendOptions, fixed: FixedImages | None
) -> str:
    """Hash of all on which the models depend."""
    pycolmap = require("pycolmap", "colmap", "making a map")
    parts: list[object] = [VERSION, pycolmap.__version__, how]
    parts += [read_file(path, _MAX_SOURCE) for path in sorted(Path(__file__).parent.glob("*.py"))]
    for view, down in zip(views, gravity, strict=True):
        status = view.path.stat()
        parts += [view.name, status.st_size, status.st_mtime_ns, view.camera]
        if view.mask is not None:
            parts.append(np.packbits(view.usable_pixels()).tobytes())
        if down is not None:
            parts += [down.down.tobytes(), down.source, down.bound_rad, down.sd_rad, down.by_map]
        parts.append(None)
    if fixed is not None:
        parts += [fixed.moments, fixed.one_moment]
        parts += [part for name, matrix in sorted(fixed.body_from_camera.items()) for part in (name, matrix.tobytes())]
    return key_of(*parts, sorted(shots_of(views).items()))


def _write(folder: Path, key: str, made: Sequence[Reconstruction]) -> bool:
    """Write models; False if that fails."""
    content = io.BytesIO()
    index: dict[str, Any] = {"key": key, "database": made[0].database.name, "ids": made[0].ids, "models": []}
    try:
        with TemporaryDirectory() as place, zipfile.ZipFile(content, "w") as file:
            for number, one in enumerate(made):
                model = Path(place) / str(number)
                model.mkdir()
                one.model.write(str(model))
                np.savez(model / _COUNTS, matches=one.matches, all_matches=one.all_matches)
                told = {"images": list(one.poses), "contradictions": one.contradictions}
                index["models"].append({**told, "joined": one.joined, "joints": one.joints, "unsure": one.unsure})
                for name in names_in(model):
                    file.write(model / name, f"{number}/{name}")
            file.writestr(_INDEX, json.dumps(index))
    except (OSError, RuntimeError):
        return False
    return store(folder / FILE, content.getvalue())


def _read(folder: Path, key: str) -> tuple[Reconstruction, ...] | None:
    """The models of that key that a folder keeps; None if there are none, or if a file is damaged or gone."""
    pycolmap = require("pycolmap", "colmap", "making a map")
    try:
        with open_file(folder / FILE) as opened, zipfile.ZipFile(opened) as file, TemporaryDirectory() as place:
            index = json.loads(file.read(_INDEX))
            database = folder / Path(index["database"]).name
            if index["key"] != key or not is_file(database):
                return None
            file.extractall(place)  # zipfile keeps every name inside
            return tuple(
                _one(pycolmap, Path(place) / str(number), told, database, index["ids"])
                for number, told in enumerate(index["models"])
            )
    except (*DAMAGED_NPZ, TypeError, AttributeError):
        return None


def _one(pycolmap: Any, model: Path, told: dict[str, Any], database: Path, ids: dict[str, int]) -> Reconstruction:
    read = pycolmap.Reconstruction(str(model))
    poses = poses_of(read)
    with np.load(model / _COUNTS, allow_pickle=False) as counts:
        matches, all_matches = counts["matches"], counts["all_matches"]
    return Reconstruction(
        read,
        {name: poses[name] for name in told["images"]},
        matches,
        tuple((one, other) for one, other in told["contradictions"]),
        all_matches,
        database,
        ids,
        told["joined"],
        tuple((one, other) for one, other in told["joints"]),
        told["unsure"],
    )
