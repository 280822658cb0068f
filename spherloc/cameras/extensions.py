"""Camera models and calibration readers of other packages: tried before anything relies on them.

What checks values and arrays of spherloc's own models is to be had from here too.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np

from spherloc import registry
from spherloc.cameras._checks import camera_from_keys, camera_to_table, finite, positive, rows, whole_pixels
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
"""A calibration reader: gets the path of a file that exists and that spherloc itself does not recognise, and the name
of the camera that is asked for, or None for the first or only one.

Gives the camera, its principal point in this project's convention (the centre of the top-left pixel is (0.5, 0.5)), or
None for a file of another kind. Raises ``CalibrationError``, one sentence without the file's name, for a file of its
kind that describes no usable camera.
"""


def camera_class_of(model: str) -> type[Camera]:
    """The class registered for a camera model.

    Raises ``InputError`` if there is none, or if it is an extension that is no camera model.
    """
    found = registry.lookup("cameras", model)
    missing = [name for name in ("project", "unproject", "unprojection_jacobian", "to_dict", "from_dict")
               if not callable(getattr(found, name, None))]  # fmt: skip
    if not isinstance(found, type) or missing:
        what = f"{show(found)}, which is no class" if not isinstance(found, type) else f"without {', '.join(missing)}"
        raise InputError(f"{registry.title('cameras', model)} is {what}; tell its authors.")
    if getattr(found, "model", None) != model:
        raise InputError(
            f"{registry.title('cameras', model)} calls its model {show(getattr(found, 'model', None))}; both must be "
            "one name, tell its authors."
        )
    return found


def tried(camera: Any, model: str) -> Camera:
    """The camera of an extension's model, after its methods were called once each.

    Raises ``InputError`` if it is no camera: later, an exception of a method would not be known as the extension's.
    """
    what = registry.title("cameras", model)
    with registry.guarded("cameras", model):
        if not isinstance(camera, Camera):
            raise InputError(f"{what} made {show(camera)}, which is no camera; tell its authors.")
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
    """A registered calibration reader; raises ``InputError`` if it cannot be imported or is no function."""
    found = registry.lookup("calibrations", name)
    if not callable(found):
        raise InputError(f"{registry.title('calibrations', name)} is {show(found)}, no function; tell its authors.")
    return cast(Reader, found)


def read_by_extensions(path: Path, name: str | None, unknown: str) -> Camera:
    """The camera that the first registered reader finds in a file, by the alphabet of their names.

    Raises ``CalibrationError``, without the file's name: ``unknown``, which says that spherloc does not know the file,
    and why readers refused it, if some did.
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
            refusals.append(f"{what} gave {show(found)}, which is no camera")
        except CalibrationError as error:
            refusals.append(f"{what} refuses it ({_clause(error)})")
        except SpherlocError as error:
            refusals.append(_clause(error))
    raise CalibrationError("; ".join([_clause(unknown), *refusals]) + ".")


def _clause(sentence: object) -> str:
    return str(sentence).rstrip(".")
