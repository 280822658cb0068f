"""Shared by camera models: checks of calibration values and coordinate arrays, ``[camera]`` tables, focal lengths."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from math import inf, isfinite
from numbers import Integral, Real
from typing import Any, ClassVar, Self, TypeVar

import numpy as np

from spherloc.errors import CalibrationError, ProblemError, show
from spherloc.types import BoolArray, FloatArray

MAX_SIDE_PX = 100_000
"""Largest width or height: beyond any panorama, so that a corrupt size cannot exhaust the memory."""

C = TypeVar("C")


class UnrecognisedError(CalibrationError):
    """The file is of a kind that spherloc does not read; an extension may read it."""


def whole_pixels(key: str, value: Any) -> int:
    """An image side in pixels; raises ``CalibrationError`` if it is not a whole number from 1 to ``MAX_SIDE_PX``."""
    side = int(value) if isinstance(value, Integral) and not isinstance(value, bool) else 0
    if not 1 <= side <= MAX_SIDE_PX:
        raise _bad(key, value, f"give a whole number of pixels from 1 to {MAX_SIDE_PX}")
    return side


def finite(key: str, value: Any) -> float:
    """A finite number; raises ``CalibrationError`` otherwise."""
    number = _as_float(value)
    if number is None or not isfinite(number):
        raise _bad(key, value, "give a finite number")
    return number


def positive(key: str, value: Any) -> float:
    """A finite number greater than zero; raises ``CalibrationError`` otherwise."""
    number = _as_float(value)
    if number is None or not 0 < number < inf:
        raise _bad(key, value, "give a finite number greater than zero")
    return number


def coefficients(key: str, value: Any, names: str) -> tuple[float, ...]:
    """As many finite numbers as ``names`` ("k1, k2") lists; raises ``CalibrationError`` otherwise."""
    count = len(names.split(","))
    numbers = [_as_float(item) for item in value] if isinstance(value, list | tuple | np.ndarray) else []
    if len(numbers) != count or not all(number is not None and isfinite(number) for number in numbers):
        raise _bad(key, value, f"give a list of {count} finite numbers, {names}")
    return tuple(number for number in numbers if number is not None)


def camera_from_keys(cls: type[C], table: Any, where: str) -> C:
    """Build the camera ``cls`` from a table whose keys are exactly ``model`` and the fields of ``cls``.

    Raises ``CalibrationError``, one sentence that starts with ``where``, for an unknown, missing or bad value.
    """
    with located(where):
        if not isinstance(table, dict):
            raise CalibrationError(f"the camera is {show(table)}: give a table of keys and values.")
        model: str = getattr(cls, "model", "")
        known = ["model", *(field.name for field in fields(cls))]  # pyright: ignore[reportArgumentType]
        for key in table:
            if key not in known:
                raise CalibrationError(
                    f"camera key {show(key)} is unknown to the model '{model}': "
                    f"remove it, the keys are {', '.join(known)}."
                )
        for key in known:
            if key not in table:
                raise CalibrationError(f"camera key '{key}' is missing: add it, the model '{model}' needs it.")
        if table["model"] != model:
            raise CalibrationError(f"camera key 'model' is {show(table['model'])}: give '{model}' here.")
        return cls(**{key: value for key, value in table.items() if key != "model"})


@contextmanager
def located(place: str) -> Iterator[None]:
    """Put ``place`` in front of a ``CalibrationError`` that is raised inside; places nest."""
    try:
        yield
    except CalibrationError as error:
        kind = UnrecognisedError if isinstance(error, UnrecognisedError) else CalibrationError
        raise kind(f"{place}: {error}") from None


def camera_to_table(camera: Any) -> dict[str, Any]:
    """The ``[camera]`` table of a camera: plain numbers and lists, ready for TOML or JSON."""
    table: dict[str, Any] = {"model": camera.model}
    for field in fields(camera):
        value = getattr(camera, field.name)
        table[field.name] = list(value) if isinstance(value, tuple) else value
    return table


def rows(name: str, array: Any, columns: int) -> FloatArray:
    """``array`` as float64 (N, columns); raises ``ProblemError`` if it is not such an array of real numbers."""
    try:
        given = np.asarray(array)
        if given.dtype.kind not in "fiu":
            raise ProblemError(f"{name} hold {given.dtype} values: give an array of real numbers.")
    except ValueError:
        raise ProblemError(f"{name} have rows of different lengths: give an array of shape (N, {columns}).") from None
    if given.ndim != 2 or given.shape[1] != columns:
        raise ProblemError(f"{name} have the shape {given.shape}: give an array of shape (N, {columns}).")
    return given.astype(np.float64, copy=False)


@dataclass(frozen=True)
class FocalCamera:
    """A camera with focal lengths and a principal point; each model defines its focal length."""

    model: ClassVar[str]

    width: int
    """Image width in pixels."""
    height: int
    """Image height in pixels."""
    fx: float
    """Focal length along x in pixels."""
    fy: float
    """Focal length along y in pixels."""
    cx: float
    """Principal point, x in pixels; the centre of the top-left pixel is 0.5."""
    cy: float
    """Principal point, y in pixels; the centre of the top-left pixel is 0.5."""

    def to_dict(self) -> dict[str, Any]:
        """The ``[camera]`` table: model and all fields."""
        return camera_to_table(self)

    @classmethod
    def from_dict(cls, table: dict[str, Any], where: str) -> Self:
        """Build from a ``[camera]`` table; raises ``CalibrationError`` (see ``Camera.from_dict``)."""
        return camera_from_keys(cls, table, where)

    def project(self, points: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Pixels (N, 2) of camera-frame points (N, 3) in metres, and the mask (N,) of directions that are valid.

        A direction is valid where the model is one to one (see its module); other pixels are NaN.
        Raises ``ProblemError`` for a wrong shape.
        """
        points = rows("points", points, 3)
        with np.errstate(all="ignore"):
            x, y, valid = self._plane_points(points)
            pixels = np.column_stack([self.cx + self.fx * x, self.cy + self.fy * y])
        pixels[~valid] = np.nan
        return pixels, valid

    def unproject(self, pixels: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Unit bearings (N, 3) of pixels (N, 2), and the mask (N,) of pixels that the lens reaches.

        Raises ``ProblemError`` for a wrong shape.
        """
        with np.errstate(all="ignore"):
            bearings = self._bearings(pixels)
        return bearings, ~np.isnan(bearings[:, 2])

    def _plane_points(self, points: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Projections of points (N, 3), in focal lengths from the principal point: x, y and validity, each (N,)."""
        raise NotImplementedError

    def _bearings(self, pixels: FloatArray) -> FloatArray:
        """Unit bearings (N, 3) of pixels (N, 2), NaN for pixels that the lens does not reach."""
        raise NotImplementedError

    def check_focal(self) -> None:
        """Check and normalise sizes, focal lengths and principal point while the camera is being constructed.

        Raises ``CalibrationError`` for an unusable value.
        """
        checks = {
            "width": whole_pixels,
            "height": whole_pixels,
            "fx": positive,
            "fy": positive,
            "cx": finite,
            "cy": finite,
        }
        for key, check in checks.items():
            object.__setattr__(self, key, check(key, getattr(self, key)))

    def check_lens(self, coefficient_names: str) -> None:
        """``check_focal``, and the same for ``distortion``; raises ``CalibrationError`` for an unusable value."""
        self.check_focal()
        given = getattr(self, "distortion", None)
        object.__setattr__(self, "distortion", coefficients("distortion", given, coefficient_names))

    def check_sees_image(self, rim: float, shape: str | None = None) -> None:
        """Raise ``CalibrationError`` for a fisheye camera that cannot unproject any pixel of its own image.

        ``rim`` is the distorted radius, in focal lengths, of the last direction that the model can invert; ``shape``
        quotes the keys that determine it in the message, by default the distortion.
        """
        if not 1.0 <= rim * min(self.fx, self.fy) < inf:
            quoted = shape or f"camera key 'distortion' is {show(list(getattr(self, 'distortion', ())))}"
            raise CalibrationError(
                f"{quoted}, which cannot be inverted one pixel away from the principal point: "
                "check the order and the signs of the coefficients."
            )
        nearest = [[min(max(self.cx, 0.0), self.width), min(max(self.cy, 0.0), self.height)]]
        if not self.unproject(np.array(nearest))[1][0]:
            raise CalibrationError(
                f"camera keys 'cx', 'cy' are {self.cx:g}, {self.cy:g}, from where the lens reaches no pixel of the "
                f"{self.width} x {self.height} image: give the principal point in pixels."
            )

    def plane(self, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pixels (N, 2) in focal lengths from the principal point, x and y, each (N,).

        Raises ``ProblemError`` for a wrong shape.
        """
        u, v = rows("pixels", pixels, 2).T
        with np.errstate(all="ignore"):
            return (u - self.cx) / self.fx, (v - self.cy) / self.fy

    def plane_within(self, pixels: FloatArray, max_radius: float) -> tuple[FloatArray, FloatArray]:
        """``plane``, with NaN at and beyond the distance ``max_radius``."""
        x, y = self.plane(pixels)
        with np.errstate(all="ignore"):
            outside = ~(np.hypot(x, y) < max_radius)
        x[outside] = y[outside] = np.nan
        return x, y


def _as_float(value: Any) -> float | None:
    if not isinstance(value, Real) or isinstance(value, bool):
        return None
    try:
        return float(value)
    except OverflowError:
        return inf


def _bad(key: str, value: Any, remedy: str) -> CalibrationError:
    return CalibrationError(f"camera key '{key}' is {show(value)}: {remedy}.")
