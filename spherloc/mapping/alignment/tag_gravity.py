"""Gravity of panoramas by the pitch and roll in their tags, where their lines say that the tags are of these pixels.

A camera, or its program, that levels a panorama may leave the tags of before in it: they must not be applied again.
Nothing in a file says which of the two it is, but vertical lines do, in images that were taken with a leaning camera.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.datasets.panorama_tags import gravity_from_tags
from spherloc.datasets.query_gravity import BOUND_SD
from spherloc.errors import InputError
from spherloc.frontend.gravity_from_lines import gravity_from_lines
from spherloc.frontend.view import Gravity, View
from spherloc.geometry import DOWN
from spherloc.mapping.alignment.stated_gravity import BOUND_RAD, StatedGravity
from spherloc.mapping.parallel import Tell, as_completed
from spherloc.types import FloatArray

MIN_LEAN_RAD = float(np.radians(1.5))
"""Images that lean by less, as their tags say, do not tell whether they are levelled."""
MAX_COMPARED = 8
"""Largest number of images whose lines are searched: those that lean most."""
MIN_AGREEING, CLEARLY_MORE = 2, 2.0
"""Least number of images whose lines agree with tags, or with level images, and how many times more than disagree."""
MIN_BOUND_RAD, MAX_BOUND_RAD = np.radians([1.0, 3.0]).tolist()


def stated_by_tags(views: Sequence[View], tell: Tell) -> tuple[StatedGravity | None, list[str]]:
    """Gravity of those ``views`` that are panoramas with pitch and roll, if their lines agree, and remarks.

    None without such tags, if these say that all are level, and if the images are levelled already or do not tell.
    ``tell`` is called after each image whose lines were searched.
    """
    tagged = _tagged(views)
    leaning = sorted((view for view in views if view.name in tagged), key=lambda view: -_lean_rad(tagged[view.name]))
    compared = [view for view in leaning if _lean_rad(tagged[view.name]) > MIN_LEAN_RAD][:MAX_COMPARED]
    if not compared:
        return None, []
    off_rad: dict[str, float] = {}
    level = 0
    contradicted = []
    for view, lines in _lines(compared, tell):
        bound_rad = lines.bound_rad or 0.0
        off_tag, off_level = _angle_rad(lines.down, tagged[view.name].down), _lean_rad(lines)
        if off_tag > bound_rad + BOUND_RAD:
            contradicted.append(view.name)
        elif off_tag + bound_rad < off_level:
            off_rad[view.name] = off_tag
        level += off_level <= bound_rad + BOUND_RAD and off_level + bound_rad < off_tag
    of_all = f"of the {len(compared)} that lean most"
    if level >= MIN_AGREEING and level > CLEARLY_MORE * len(off_rad):
        return None, [
            f"Pitch and roll in the tags of {len(tagged)} photographs are not used, since these are levelled already, "
            f"as the vertical lines of {level} {of_all} say."
        ]
    if len(off_rad) < MIN_AGREEING or len(off_rad) <= CLEARLY_MORE * max(level, len(contradicted)):
        return None, [
            f"Pitch and roll in the tags of {len(tagged)} photographs are not used: vertical lines agree with them in "
            f"{len(off_rad)} {of_all}, and with levelled photographs in {level}."
        ]
    median_rad = float(np.median(list(off_rad.values())))
    bound_rad = float(np.clip(BOUND_SD * median_rad, MIN_BOUND_RAD, MAX_BOUND_RAD))
    found = {name: Gravity(one.down, one.source, bound_rad) for name, one in tagged.items() if name not in contradicted}
    remark = (
        f"Gravity of {len(found)} photographs is from pitch and roll in their tags, with which the vertical lines of "
        f"{len(off_rad)} {of_all} agree to {np.degrees(median_rad):.1f}° (median)"
    )
    if contradicted:
        remark += (
            f"; the tags of {len(contradicted)} contradict their lines and are not used, such as {contradicted[0]}"
        )
    folder = views[0].path.parent
    return StatedGravity(found, folder, None, (), in_map_folder=True, lines_agree=True), [f"{remark}."]


def _tagged(views: Sequence[View]) -> Mapping[str, Gravity]:
    """Gravity by the tags of those views that are panoramas and have such tags, by name."""
    found = {}
    for view in views:
        if isinstance(view.camera, Equirectangular):
            try:
                found[view.name] = gravity_from_tags(view)
            except InputError:  # it has none, or none that can be read
                continue
    return found


def _lines(views: Sequence[View], tell: Tell) -> list[tuple[View, Gravity]]:
    """The views whose vertical lines show gravity, with it."""

    def measure(view: View) -> Gravity | None:
        try:
            return gravity_from_lines(view)
        except InputError:
            return None

    found = []
    for done, (view, one) in enumerate(as_completed(measure, views), start=1):
        tell("images compared with their tags", done, len(views))
        if one is not None:
            found.append((view, one))
    return found


def _lean_rad(gravity: Gravity) -> float:
    return _angle_rad(gravity.down, DOWN)


def _angle_rad(one: FloatArray, other: FloatArray) -> float:
    return float(np.arccos(np.clip(one @ other, -1.0, 1.0)))
