"""The contracts of cameras and of readers of calibration files."""

import json
import math
import tempfile
import warnings
from dataclasses import FrozenInstanceError
from pathlib import Path

import numpy as np

from spherloc.cameras._files import MAX_FILE_BYTES
from spherloc.cameras.base import Camera
from spherloc.cameras.extensions import Reader, reader_of
from spherloc.errors import CalibrationError, show
from spherloc.files import read_file
from spherloc.testing.saying import Saying, name_of
from spherloc.types import BoolArray, FloatArray

GRID = 400
"""Pixels along the longer side of the image at which a camera is looked at, in even steps."""
STEP_PX = 1e-2
"""Of central differences."""


def check_camera(camera: Camera) -> None:
    """Raise ``AssertionError`` unless a camera keeps the contract of ``spherloc.cameras.base.Camera``.

    ``project`` and ``unproject`` are each other's inverse over the whole image and in all directions, within 1e-6 px
    and 1e-6 rad; masks and NaN agree; bearings are unit vectors; the Jacobian is that of central differences within
    1e-6 of its size; NaN, infinity, the origin and empty arrays make no warnings; the camera is frozen, hashable and
    rebuilt from its table, which JSON can hold; and unknown and missing keys are a ``CalibrationError``.
    """
    say = Saying(f"the camera {show(getattr(camera, 'model', camera))}")
    say.need(isinstance(camera, Camera), "lacks a method or attribute of Camera (spherloc.cameras.base)")
    whole = all(isinstance(side, int) and side > 0 for side in (camera.width, camera.height))
    say.need(whole, f"has the size {camera.width} x {camera.height}; give whole pixels")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _check_image(camera, say)
        _check_directions(camera, say)
        _check_jacobian(camera, say)
        _check_odd_input(camera, say)
    _check_table(camera, say)


def check_calibration_reader(reader: Reader | str, path: str | Path, name: str | None = None) -> Camera:
    """Raise ``AssertionError`` unless a calibration reader, or the one registered under a name, keeps its contract.

    ``path`` is a file of its kind, ``name`` that of one of its cameras. It gives a camera that passes ``check_camera``,
    None or a ``CalibrationError`` for files of other kinds, and for parts of its own one of these or a camera. Returns
    the camera.
    """
    say = Saying(f"the calibration reader {show(reader if isinstance(reader, str) else name_of(reader))}")
    read = reader_of(reader) if isinstance(reader, str) else reader
    camera = read(Path(path), name)
    say.need(isinstance(camera, Camera), f"gives {show(camera)} for {path}, which is no camera")
    assert isinstance(camera, Camera)
    check_camera(camera)
    content = read_file(Path(path), MAX_FILE_BYTES)
    others = (
        b"",
        b"\n",
        b"\x00\xff\xfe",
        b"{}",
        b"[1, 2]",
        b"model: 3\n",
        b"a = 1\n",
        b"<a/>",
        "\u00e9 \u4e2d".encode(),
    )
    parts = [content[: len(content) * part // 8] for part in range(1, 8)]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / Path(path).name
        for is_part, text in [(False, text) for text in others] + [(True, text) for text in parts]:
            file.write_bytes(text)
            try:
                found = read(file, name)
            except CalibrationError:
                continue
            except Exception as error:
                say.fail(f"raises {error!r} for a file with {show(text)}; raise CalibrationError or give None")
            allowed = found is None or (is_part and isinstance(found, Camera))
            say.need(allowed, f"gives {show(found)} for a file with {show(text)}")
    return camera


def _pixels(camera: Camera) -> FloatArray:
    """Pixels (N, 2) all over the image, its borders and corners included."""
    step = max(camera.width, camera.height) / GRID
    u = np.append(np.arange(0.0, camera.width, step), camera.width)
    v = np.append(np.arange(0.0, camera.height, step), camera.height)
    return np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)


def _angles(a: FloatArray, b: FloatArray) -> FloatArray:
    """Between rows of (N, 3), rad."""
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1))


def _at(where: FloatArray, wrong: BoolArray) -> str:
    """One of the places, in words."""
    return "(" + ", ".join(f"{value:.6g}" for value in where[int(np.argmax(wrong))]) + ")"


def _check_image(camera: Camera, say: Saying) -> None:
    pixels = _pixels(camera)
    bearings, valid = camera.unproject(pixels)
    forms = np.shape(bearings) == (len(pixels), 3) and np.shape(valid) == (len(pixels),) and valid.dtype == bool
    say.need(forms, "gives unproject() of N pixels other than bearings (N, 3) and a mask (N,) of bool")
    say.need(valid.mean() > 0.01, "sees less than 1 % of its own image")
    say.need(np.isnan(bearings[~valid]).all(), "gives bearings other than NaN where unproject() is invalid")
    wrong = valid & ~(np.abs(np.linalg.norm(bearings, axis=1) - 1.0) < 1e-12)
    say.need(not wrong.any(), f"gives a bearing that is no unit vector at the pixel {_at(pixels, wrong)}")
    again, seen = camera.project(bearings)
    forms = np.shape(again) == (len(pixels), 2) and np.shape(seen) == (len(pixels),) and seen.dtype == bool
    say.need(forms, "gives project() of N points other than pixels (N, 2) and a mask (N,) of bool")
    wrong = seen != valid
    say.need(not wrong.any(), f"has other masks in project() than in unproject() at the pixel {_at(pixels, wrong)}")
    wrong = valid & ~(np.abs(again - pixels).max(axis=1) < 1e-6)
    # A seam or a pole of a panorama has several pixels of one bearing.
    wrong[wrong] = ~(_angles(camera.unproject(again[wrong])[0], bearings[wrong]) < 1e-12)
    say.need(not wrong.any(), f"does not project the bearing of the pixel {_at(pixels, wrong)} to it again")


def _check_directions(camera: Camera, say: Saying) -> None:
    rng = np.random.default_rng(7)
    points = rng.normal(size=(20_000, 3))
    points *= 10.0 ** rng.uniform(-1, 2, (len(points), 1)) / np.linalg.norm(points, axis=1, keepdims=True)
    pixels, valid = camera.project(points)
    say.need(valid.any(), "projects no direction")
    say.need(np.isnan(pixels[~valid]).all(), "gives pixels other than NaN where project() is invalid")
    bearings, seen = camera.unproject(pixels)
    wrong = seen != valid
    say.need(not wrong.any(), f"cannot unproject what it projects of the point {_at(points, wrong)}")
    # Close to a fold the angle has half the digits of the pixel, since the pixel hardly moves there.
    error = np.where(valid, _angles(bearings, points), 0.0)
    say.need(error.max() < 1e-6, f"has another bearing than that of the point {_at(points, error >= 1e-6)}")
    say.need(np.median(error[valid]) < 1e-12, "has bearings that are off by more than 1e-12 rad in the median")


def _check_jacobian(camera: Camera, say: Saying) -> None:
    pixels = np.vstack([_pixels(camera)[::17], [[math.nan, 1.0], [-1e7, 3.0]]])
    valid, analytic = camera.unproject(pixels)[1], camera.unprojection_jacobian(pixels)
    say.need(np.shape(analytic) == (len(pixels), 3, 2), "gives a Jacobian other than (N, 3, 2)")
    finite = np.isfinite(analytic).all(axis=(1, 2))
    wrong = valid & ~finite
    say.need(not wrong.any(), f"has no finite Jacobian at the valid pixel {_at(pixels, wrong)}")
    say.need(np.isnan(analytic[~valid]).all(), "gives a Jacobian other than NaN where unproject() is invalid")
    ends = [[camera.unproject(pixels + sign * axis)[0] for sign in (1, -1)] for axis in np.eye(2) * STEP_PX]
    numeric = np.stack([(ahead - behind) / (2 * STEP_PX) for ahead, behind in ends], axis=-1)
    # The differences themselves fail where the rim is near, and the model bends without bound there.
    outward = pixels + 0.02 * (pixels - [camera.width / 2, camera.height / 2])
    inside = camera.unproject(outward)[1] & np.isfinite(numeric).all(axis=(1, 2))
    inside[-2:] = False
    size = np.linalg.norm(analytic, axis=(1, 2))
    wrong = inside & ~(np.linalg.norm(analytic - numeric, axis=(1, 2)) < 1e-6 * size)
    say.need(inside.any(), "has no pixel at which its Jacobian can be compared with differences")
    say.need(not wrong.any(), f"has another Jacobian than central differences at the pixel {_at(pixels, wrong)}")


def _check_odd_input(camera: Camera, say: Saying) -> None:
    nan, inf = math.nan, math.inf
    points = [
        [0, 0, 0],
        [nan, 0, 1],
        [0, nan, 1],
        [0, 0, nan],
        [inf, 0, 1],
        [0, -inf, 1],
        [0, 0, inf],
        [inf, inf, -inf],
    ]
    for what, method, given in (
        ("project()", camera.project, np.array(points)),
        ("unproject()", camera.unproject, np.array([[nan, 1.0], [1.0, nan], [inf, 1.0], [1.0, -inf], [1e300, 1e300]])),
    ):
        try:
            found, valid = method(given)
            say.need(not valid.any() and np.isnan(found).all(), f"takes NaN, infinity or the origin in {what}")
            nothing = [np.shape(part) for part in method(np.empty((0, given.shape[1])))]
            say.need(nothing == [(0, np.shape(found)[1]), (0,)], f"gives {nothing} for no rows in {what}")
        except Warning as warning:
            say.fail(f"makes a warning of NaN, infinity or the origin in {what} ({warning}); use np.errstate")


def _check_table(camera: Camera, say: Saying) -> None:
    table, kind = camera.to_dict(), type(camera)
    try:
        plain = json.loads(json.dumps(table, allow_nan=False)) == table
    except (TypeError, ValueError):
        plain = False
    say.need(plain, f"gives to_dict() with more than plain numbers, texts and lists: {show(table)}")
    say.need(
        table.get("model") == camera.model == kind.model, f"calls its model {show(table.get('model'))} in to_dict()"
    )
    again = kind.from_dict(table, "here")
    say.need(again == camera and hash(again) == hash(camera), "is not equal to from_dict() of its to_dict()")
    try:
        camera.width = camera.width + 1  # pyright: ignore[reportAttributeAccessIssue]
    except (FrozenInstanceError, AttributeError):
        pass
    else:
        say.fail("can be changed; make it a frozen dataclass")
    for key in table:
        rest = {name: value for name, value in table.items() if name != key}
        say.raises(CalibrationError, lambda rest=rest: kind.from_dict(rest, "here"), f"in from_dict() without {key}")
    wrong = {**table, "no_such_key": 1}
    say.raises(CalibrationError, lambda: kind.from_dict(wrong, "here"), "in from_dict() of an unknown key")
    wrong = {**table, "width": math.nan}
    say.raises(CalibrationError, lambda: kind.from_dict(wrong, "here"), "in from_dict() of a width that is NaN")
