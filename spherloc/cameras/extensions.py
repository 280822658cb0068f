"""Camera models and calibration readers of extensions: each is tried before anything relies on it.

The checks of values and arrays of spherloc's own models can be imported from here too.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np

from spherloc import registry
from spherloc.cameras._checks import (
    UnrecognisedError,
    camera_from_keys,
    camera_to_table,
    finite,
    positive,
    rows,
    whole_pixels,
)
from spherloc.cameras.base import Camera
from spherloc.errors import CalibrationError, InputError, SpherlocError, show

__all__ = [
    "Reader",
    "camera_class_of",
    "camera_from_keys",
    "camera_to_table",
    "finite",
    "positive",
    "read_by_extensions",
    "reader_of",
    "rows",
    "tried",
    "whole_pixels",
]

Reader = Callable[[Path, str | None], Camera | None]
"""A calibration reader: its arguments are the path of an existing file that spherloc itself does not recognise, and the
name of the wanted camera, or None for the first or only one.

It returns the camera, with its principal point in this project's convention (the centre of the top-left pixel is
(0.5, 0.5)), or None for a file of another kind. It raises ``CalibrationError``, one sentence without the file's name,
for a file of its kind that does not describe a usable camera.
"""


def camera_class_of(model: str) -> type[Camera]:
    """The class registered for a camera model.

    Raises ``InputError`` if there is none, or if an extension's object is not a camera model.
    """
    found = registry.lookup("cameras", model)
    missing = [name for name in ("project", "unproject", "unprojection_jacobian", "to_dict", "from_dict")
               if not callable(getattr(found, name, None))]  # fmt: skip
    if not isinstance(found, type) or missing:
        what = f"{show(found)}, not a class" if not isinstance(found, type) else f"without {', '.join(missing)}"
        raise InputError(f"{registry.title('cameras', model)} is {what}; tell its authors.")
    if getattr(found, "model", None) != model:
        raise InputError(
            f"{registry.title('cameras', model)} calls its model {show(getattr(found, 'model', None))}; both names "
            "must be equal, tell its authors."
        )
    return found


def tried(camera: Any, model: str) -> Camera:
    """The camera of an extension's model, after each of its methods was called once.

    Raises ``InputError`` if it is not a camera: of a later exception one would not know that it is the extension's.
    """
    what = registry.title("cameras", model)
    with registry.guarded("cameras", model):
        if not isinstance(camera, Camera):
            raise InputError(f"{what} made {show(camera)}, which is not a camera; tell its authors.")
        pixels = np.array([[0.5, 0.5], [camera.width / 2, camera.height / 2], [np.nan, 0.0]])
        points = np.array([[0.0, 0.0, 1.0], [0.1, -0.2, 2.0], [1.0, 1.0, -1.0], [0.0, 0.0, 0.0]])
        for name, found, shapes in (
            ("project()", camera.project(points), ((4, 2), (4,))),
            ("unproject()", camera.unproject(pixels), ((3, 3), (3,))),
            ("unprojection_jacobian()", (camera.unprojection_jacobian(pixels),), ((3, 3, 2),)),
        ):
            given = tuple(map(np.shape, found))
            if given != shapes or (len(found) == 2 and np.asarray(found[1]).dtype != bool):
                raise InputError(f"{what} gives {name} of a wrong form; tell its authors.")
        if camera.to_dict().get("model") != model:
            raise InputError(f"{what} gives to_dict() without its model; tell its authors.")
    return camera


def reader_of(name: str) -> Reader:
    """A registered calibration reader; raises ``InputError`` if it cannot be imported or is not a function."""
    found = registry.lookup("calibrations", name)
    if not callable(found):
        raise InputError(f"{registry.title('calibrations', name)} is {show(found)}, not a function; tell its authors.")
    return cast(Reader, found)


def read_by_extensions(path: Path, name: str | None, unknown: str) -> Camera:
    """The camera that the first of the registered readers, in alphabetical order, finds in a file.

    Raises ``CalibrationError``, without the file's name: the text ``unknown``, which says that spherloc does not know
    the kind of file, and the reasons of readers that refused it; ``UnrecognisedError`` if none did.
    """
    refusals: list[str] = []
    for key in registry.names("calibrations"):
        what = registry.title("calibrations", key)
        try:
            with registry.guarded("calibrations", key):
                found = reader_of(key)(path, name)
            if found is None:
                continue
            if isinstance(found, Camera):
                return found
            refusals.append(f"{what} gave {show(found)}, which is not a camera")
        except CalibrationError as error:
            refusals.append(f"{what} refuses it ({_clause(error)})")
        except SpherlocError as error:
            refusals.append(_clause(error))
    kind = CalibrationError if refusals else UnrecognisedError
    raise kind("; ".join([_clause(unknown), *refusals]) + ".")


def _clause(sentence: object) -> str:
    return str(sentence).rstrip(".")
