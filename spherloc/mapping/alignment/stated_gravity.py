"""Gravity of photographs that a file states: a vector for each, or the log of an IMU that is fixed to the camera."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from spherloc.datasets.imu import read_imu, why_unknown
from spherloc.datasets.query_gravity import ImuLog, read_gravity_file, time_of
from spherloc.errors import InputError, shorten, show
from spherloc.frontend.view import Gravity, View
from spherloc.mapping.images.photographs import cameras_of
from spherloc.types import FloatArray

BOUND_RAD = float(np.radians(2.0))
"""Bound on the error of a gravity that is stated without one."""


@dataclass(frozen=True, eq=False)
class StatedGravity:
    """Gravity of some of the photographs, by name, and where it is from."""

    found: Mapping[str, Gravity]
    file: Path
    camera_from_imu: FloatArray | None
    """Rotation (3, 3) from the IMU's frame to the camera's; None if ``file`` is a gravity file."""
    remarks: tuple[str, ...]
    """Sentences on what does not fit together."""
    in_map_folder: bool = False
    """Whether a gravity file of them is written for the scenes of the map, as ``file`` is the log of an IMU that
    several cameras are fixed to, or since it is from tags."""
    lines_agree: bool = False
    """Whether vertical lines agree with it, so that those of queries are searched where nothing is stated."""
    doubts: tuple[str, ...] = ()
    """Sentences on how it contradicts the photographs (``gravity_check``)."""

    @property
    def is_gravity_file(self) -> bool:
        """Whether ``file`` is a gravity file and no log of an IMU."""
        return self.camera_from_imu is None and not self.in_map_folder


def read_stated_gravity(file: Path, camera_from_imu: FloatArray | None, views: Sequence[View]) -> StatedGravity:
    """Gravity of ``views`` by a gravity file or, with a rotation ``camera_from_imu`` (3, 3), by the log of an IMU.

    Raises ``InputError`` for a file that is none, if it tells nothing of any of the views, and for an IMU with several
    cameras.
    """
    remarks: list[str] = []
    if camera_from_imu is None:
        rows, names = read_gravity_file(file), {view.name for view in views}
        found = {name: one for name, one in rows.items() if name in names}
        strange = [name for name in rows if name not in names]
        as_there = f"their names, such as {show(views[0].name)}" if views else "their names"
        rule = f"it names {show(next(iter(rows), ''))}; give rows image gx gy gz [sd_deg] with {as_there}"
        if strange and found:
            remarks.append(
                f"{file}: {len(strange)} of its {len(rows)} rows belong to none of the photographs, the first is "
                f"{shorten(strange[0])}; their names are such as {shorten(views[0].name)}."
            )
    elif (count := len(cameras_of(views))) > 1:
        raise InputError(
            f"{file}: the photographs are of {count} cameras, each of which is turned otherwise to the IMU; give a "
            "gravity file instead, with rows image gx gy gz [sd_deg]."
        )
    else:
        log = ImuLog(file, read_imu(file), camera_from_imu)
        timed = log.with_gravity(tuple(replace(view, gravity=None) for view in views))
        found = {view.name: view.gravity for view in timed if view.gravity is not None}
        rule = f"the first is {shorten(views[0].name)}: {why_unknown(log.samples, time_of(views[0]))}" if views else ""
    without = [view.name for view in views if view.name not in found]
    if not found:
        raise InputError(f"{file}: has gravity of none of the {len(views)} photographs; {rule}.")
    remarks += without_words(file, without, len(views))
    for name, one in found.items():
        if one.bound_rad is None:
            found[name] = replace(one, bound_rad=BOUND_RAD)
    return StatedGravity(found, file, camera_from_imu, tuple(remarks))


def without_words(file: Path, without: Sequence[str], count: int) -> list[str]:
    """A remark on those of ``count`` photographs, by name, of which a file has no gravity; none if there are none."""
    if not without:
        return []
    return [
        f"{file}: {len(without)} of {count} photographs have no gravity there, the first is {shorten(without[0])}; "
        "their vertical lines are searched."
    ]
