"""Whether stated gravity of photographs contradicts what they show: their vertical lines, and the down of panoramas."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.errors import InputError
from spherloc.frontend.gravity_from_lines import gravity_of_lines, image_lines
from spherloc.frontend.view import Gravity, View
from spherloc.geometry import DOWN
from spherloc.images import grey
from spherloc.mapping.alignment.stated_gravity import StatedGravity
from spherloc.mapping.parallel import Tell, as_completed
from spherloc.types import FloatArray

MAX_CHECKED = 8
"""Largest number of images whose lines are searched."""
UP_DEG = 120.0
"""Gravity that is farther from the image's own down points up, or the camera was upside down."""
TILTED_DEG = 45.0
"""Panoramas are tilted by less than that."""
MIN_SHARE = 0.5
"""Share of the images above which they speak for all."""
_FRAME = "vectors must point down in the camera frame, with x right, y down and z ahead"


@dataclass(frozen=True, eq=False)
class LineCheck:
    """How far the stated gravity of some images is from their vertical lines."""

    off_deg: FloatArray
    """(N,) angles of those images whose lines show a vertical, up or down; the least if there are two."""
    contradicts: int
    """Number of those that are off by more than both bounds together."""


def check_stated(stated: StatedGravity, views: Sequence[View], tell: Tell) -> list[str]:
    """Sentences on how stated gravity contradicts the images ``views``; none if it does not.

    ``tell`` is called after each image whose lines were searched. Raises ``InputError`` if most vectors of a gravity
    file point up in panoramas.
    """
    known = [view for view in views if view.name in stated.found]
    panoramas = [view for view in known if isinstance(view.camera, Equirectangular)]
    others = [view for view in known if view not in panoramas]
    own_deg = [
        np.array([_angle_deg(stated.found[view.name].down, DOWN) for view in some]) for some in (panoramas, others)
    ]
    up = [int(np.count_nonzero(angles > UP_DEG)) for angles in own_deg]
    if up[0] > MIN_SHARE * len(panoramas):
        said = f"{stated.file}: its gravity seems to point up in {up[0]} of {len(panoramas)} panoramas"
        if stated.is_gravity_file:
            raise InputError(f"{said}, as an accelerometer measures; give the opposite vectors: {_FRAME}.")
        return [f"{said}; check how the IMU is turned to the camera."]
    remarks: list[str] = []
    if up[1] > MIN_SHARE * len(others):
        remarks.append(
            f"{stated.file}: its gravity points to the upper edge of {up[1]} of {len(others)} images: if the camera "
            f"was not upside down, it is up, as an accelerometer measures; {_FRAME}."
        )
    middle_deg = float(np.median(own_deg[0])) if panoramas else 0.0
    if middle_deg > TILTED_DEG:
        said = f"differs from the panoramas' own down by {middle_deg:.0f}° (median) and seems wrong"
        return [*remarks, f"{stated.file}: its gravity {said}; {_FRAME}."]
    lines = by_lines(stated, known, tell)
    if len(lines.off_deg) > 1 and lines.contradicts > MIN_SHARE * len(lines.off_deg):
        remarks.append(
            f"{stated.file}: its gravity differs from the vertical lines of {lines.contradicts} of "
            f"{len(lines.off_deg)} images by {np.median(lines.off_deg):.1f}° (median), more than both bounds allow; "
            f"{_FRAME}."
        )
    return remarks


def by_lines(stated: StatedGravity, views: Sequence[View], tell: Tell) -> LineCheck:
    """The stated gravity of some of ``views`` against their lines: about it, and about the panoramas' own down."""
    count = min(len(views), MAX_CHECKED)
    chosen = [views[place] for place in np.linspace(0, len(views) - 1, count).astype(int)] if count else []

    def measure(view: View) -> list[Gravity]:
        found: list[Gravity] = []
        try:
            lines = image_lines(grey(view.read()), view.camera, view.usable_pixels())
        except InputError:
            return found
        own = [DOWN] if isinstance(view.camera, Equirectangular) else []
        for near in (stated.found[view.name].down, *own):
            try:
                found.append(gravity_of_lines(lines, near, view.name))
            except InputError:  # too few lines meet there
                continue
        return found

    off_deg, contradicts = [], 0
    for done, (view, verticals) in enumerate(as_completed(measure, chosen), start=1):
        tell("images compared with the stated gravity", done, count)
        if verticals:
            given = stated.found[view.name]
            angle_deg, one = min((_axial_deg(given.down, one.down), number) for number, one in enumerate(verticals))
            bounds = [bound for bound in (given.bound_rad, verticals[one].bound_rad) if bound is not None]
            off_deg.append(angle_deg)
            contradicts += angle_deg > np.degrees(sum(bounds))
    return LineCheck(np.array(off_deg), contradicts)


def _angle_deg(one: FloatArray, other: FloatArray) -> float:
    return float(np.degrees(np.arccos(np.clip(one @ other, -1.0, 1.0))))


def _axial_deg(one: FloatArray, other: FloatArray) -> float:
    """The angle between two lines along unit vectors (3,), degrees: lines show where down is up to its sign."""
    angle_deg = _angle_deg(one, other)
    return min(angle_deg, 180.0 - angle_deg)
