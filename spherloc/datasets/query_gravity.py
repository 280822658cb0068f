"""Gravity of queries, for every kind of scene with images: from a file, the image, its tags, an IMU, or the true pose.

A gravity file has a row ``image gx gy gz [sd_deg]`` a query: its name as the scene has it (in quotation marks where it
has spaces), a vector that points down in the camera frame, of any length, and the standard deviation of each of its two
tilts in degrees, a third of the bound. Words are parted by spaces or commas; # begins a comment. The first row may be
these titles.
"""

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from spherloc.datasets import scene_file
from spherloc.datasets.imu import ImuSamples, down_at, read_imu, time_in_name, why_unknown
from spherloc.errors import InputError, shorten, show
from spherloc.formats.text_rows import finite_numbers, rows
from spherloc.frontend.view import Gravity, View
from spherloc.geometry import DOWN
from spherloc.trajectory import NS_PER_S
from spherloc.types import FloatArray

MeasuredGravity = Callable[[View, FloatArray | None], Gravity]
"""Measures gravity of a query; takes its approximate direction (3,) or None. May raise ``InputError``."""

SOURCES = ("reference", "lines", "tags", "level", "truth")
"""Values of ``[gravity] query``."""
_KEYS = {"bound_deg", "sd_deg", "file", "query", "map_bound_deg"}
BOUND_SD = 3.0
"""Number of standard deviations that make a bound."""
ROUNDED_NS = 1_000
"""Nanoseconds in a name are taken for a time that is stated in seconds if they differ by less: a double of seconds
since 1970 is rounded to a quarter of a microsecond."""
_MAX_SD_DEG = 25.0
_ROW = re.compile(r'(?:"([^"]+)"|([^\s,"]+))[\s,]+(.*)')
_COLUMNS = "image gx gy gz [sd_deg]"
_TITLES = re.compile(r"(g?)x \1y \1z( (sd|sd_deg))?")
"""Titles of the columns after the first."""


@dataclass(frozen=True, eq=False)
class ImuLog:
    """Measurements of an inertial measurement unit that is fixed to the camera."""

    file: Path
    samples: ImuSamples
    camera_from_imu: FloatArray
    """Rotation (3, 3) from the unit's frame to the camera's."""

    def with_gravity(self, views: tuple[View, ...]) -> tuple[View, ...]:
        """The views, with gravity where they have a time within the log and no gravity yet."""
        times = [time_of(view) for view in views]
        down = down_at(self.samples, np.array([0 if time is None else time for time in times], dtype=np.int64))
        down = down @ self.camera_from_imu.T
        known = [time is not None and bool(np.isfinite(row).all()) for time, row in zip(times, down, strict=True)]
        return tuple(
            replace(view, gravity=Gravity(row / np.linalg.norm(row), "the IMU"))
            if measured and view.gravity is None
            else view
            for view, row, measured in zip(views, down, known, strict=True)
        )


def time_of(view: View) -> int | None:
    """When a view was taken, ns, as the loader states it or as the name of its image says; None if neither does."""
    by_name = time_in_name(view.name)
    if view.timestamp_s is None:
        return by_name
    stated = round(view.timestamp_s * NS_PER_S)
    return by_name if by_name is not None and abs(by_name - stated) < ROUNDED_NS else stated


@dataclass(frozen=True)
class GravitySettings:
    """The keys of the section [gravity] that are about queries."""

    bound_rad: float
    """Bound on the error of a gravity that comes without a bound of its own."""
    sd_rad: float | None
    """Its standard deviation; None takes a third of the bound."""
    query: str
    """One of ``SOURCES``."""
    file: str
    """Path of the gravity file; empty if there is none."""
    stated: Mapping[str, Gravity]
    """Rows of the gravity file by the names of the images."""
    bound_is_stated: bool
    """Whether the scene file states ``bound_rad``, which otherwise is the loader's default."""
    map_bound_rad: float = 0.0
    """Bound on the error of the map's own gravity."""
    imu: ImuLog | None = None
    """Log of an inertial measurement unit that is fixed to the camera; None if there is none."""

    def of_queries(
        self, views: Iterable[View], gravity_map: FloatArray, references: Iterable[View] = ()
    ) -> tuple[tuple[View, ...], list[str]]:
        """The queries with their gravity, as far as it is known before they are read, and remarks on the others.

        ``gravity_map`` (3,) is the unit vector that points down in the map; rows of the gravity file may be of
        ``references``, too.
        """
        queries = tuple(self._with_gravity(view, gravity_map) for view in views)
        if self.imu is not None:
            queries = self.imu.with_gravity(queries)
        names = {view.name for view in (*queries, *references)}
        remarks, strange = [], [name for name in self.stated if name not in names]
        without = [view.name for view in queries if self.file and view.name not in self.stated]
        if strange:
            remarks.append(
                f"{len(strange)} of {len(self.stated)} rows of {self.file} belong to none of the queries, the first is "
                f"{shorten(strange[0])}."
            )
        if without:
            remarks.append(
                f"{len(without)} of {len(queries)} queries have no row in {self.file}, the first is "
                f"{shorten(without[0])}."
            )
        if self.imu is not None:
            lost = [view for view in queries if view.gravity is None]
            if lost:
                remarks.append(
                    f"{len(lost)} of {len(queries)} queries have no gravity from {self.imu.file}, the first is "
                    f"{shorten(lost[0].name)}: {why_unknown(self.imu.samples, time_of(lost[0]))}."
                )
        if self.query == "truth":
            unknown = sum(view.cam_from_map is None for view in queries)
            remarks.append(
                "Gravity of the queries is that of their true poses, which a real query does not have: errors are "
                f"smaller than they would be{f'; {unknown} of {len(queries)} have no true pose' if unknown else ''}."
            )
        return queries, remarks

    def _with_gravity(self, view: View, gravity_map: FloatArray) -> View:
        if view.name in self.stated:
            return replace(view, gravity=self.stated[view.name])
        if self.query != "reference" or self.imu is not None:
            view = replace(view, gravity=None)  # what the scene asks for replaces what the loader has
        if self.query == "level":
            return replace(view, gravity=Gravity(DOWN, "the image's own up"))
        if self.query == "truth" and view.cam_from_map is not None:
            down = view.cam_from_map[:, :3] @ gravity_map
            # The loader's default is for a gravity that is taken from another image.
            exact = None if self.bound_is_stated else 0.0
            return replace(view, gravity=Gravity(down / np.linalg.norm(down), "the true pose", exact, by_map=True))
        return view

    @property
    def measured(self) -> MeasuredGravity | None:
        """The function that measures gravity in a query image; None if none is asked for."""
        return {"lines": _from_lines, "tags": _from_tags}.get(self.query)


def read_gravity(table: Mapping[str, Any], where: str, bound_deg: float) -> GravitySettings:
    """The keys of the section [gravity] ``table`` that all kinds share; ``bound_deg`` is the loader's default.

    ``where`` is the scene file. Raises ``InputError`` for a wrong key or value and for a gravity file with a wrong row.
    """
    section = f"{where} [gravity]"
    with_imu = {"imu", "camera_from_imu"}
    scene_file.check_keys(table, with_imu if with_imu & table.keys() else set(), with_imu | _KEYS, section)
    bound_rad, sd_rad = scene_file.gravity_error_rad({"bound_deg": bound_deg} | dict(table), section)
    query = table.get("query", "reference")
    if query not in SOURCES:
        raise InputError(f"{section}: query is {show(query)}; give one of {', '.join(map(show, SOURCES))}.")
    file = scene_file.text(table, "file", section) if "file" in table else ""
    stated = read_gravity_file(Path(where).parent / file) if file else {}
    imu = None
    if "imu" in table:
        log = Path(where).parent / scene_file.text(table, "imu", section)
        imu = ImuLog(log, read_imu(log), camera_from_imu(table["camera_from_imu"], section))
    map_bound_deg = scene_file.number({"map_bound_deg": 0.0} | dict(table), "map_bound_deg", section, 0.0, 45.0)
    map_bound_rad = float(np.radians(map_bound_deg))
    return GravitySettings(bound_rad, sd_rad, query, file, stated, "bound_deg" in table, map_bound_rad, imu)


def camera_from_imu(value: Any, where: str) -> FloatArray:
    """The rotation (3, 3) that is given ``where``; raises ``InputError`` if it is none."""
    rotation = scene_file.numbers(value, (3, 3), "camera_from_imu", where)
    with np.errstate(over="ignore", invalid="ignore"):
        proper = np.allclose(rotation @ rotation.T, np.eye(3), rtol=0, atol=1e-3) and np.linalg.det(rotation) > 0
    if not proper:
        raise InputError(f"{where}: camera_from_imu is not a rotation; give the 3 x 3 part of T_cam_imu.")
    return rotation


def read_gravity_file(path: Path) -> dict[str, Gravity]:
    """Gravity by image, from the rows of a gravity file.

    Raises ``InputError``, one sentence with the file and the line, for a row of another form, for a vector of length
    zero, and for an image that is there twice.
    """
    found: dict[str, Gravity] = {}
    for number, (place, text) in enumerate(rows(path, f"rows of {_COLUMNS}")):
        match = _ROW.match(text)
        words = match[3].partition("#")[0].replace(",", " ").split() if match else []
        if number == 0 and _TITLES.fullmatch(" ".join(words).replace('"', "").lower()):
            continue
        if match is None or len(words) not in (3, 4):
            log = "; the log of an IMU needs camera_from_imu" if text.count(",") in (6, 8) else ""
            raise InputError(f"{place}: is not a row {_COLUMNS}; give a name and three or four numbers{log}.")
        name = match[1] or match[2]
        x, y, z, *sd_deg = finite_numbers(words, place)
        length = float(np.linalg.norm([x, y, z]))
        if not 1e-3 < length < 1e6:
            raise InputError(f"{place}: its vector has the length {length:.3g}; give one that points down.")
        if sd_deg and not 0.0 <= sd_deg[0] <= _MAX_SD_DEG:
            raise InputError(f"{place}: sd_deg is {sd_deg[0]:g}; give degrees from 0 to {_MAX_SD_DEG:g}.")
        if name in found:
            raise InputError(f"{place}: {show(name)} is there a second time; keep one row.")
        sd_rad = float(np.radians(sd_deg[0])) if sd_deg else None
        bound_rad = None if sd_rad is None else BOUND_SD * sd_rad
        found[name] = Gravity(np.array([x, y, z]) / length, "the gravity file", bound_rad, sd_rad)
    return found


def _from_lines(view: View, near: FloatArray | None) -> Gravity:
    from spherloc.frontend.gravity_from_lines import gravity_from_lines  # only where it is asked for

    return gravity_from_lines(view, near)


def _from_tags(view: View, near: FloatArray | None) -> Gravity:
    from spherloc.datasets.panorama_tags import gravity_from_tags

    return gravity_from_tags(view, near)
