"""Makes a map from photographs and writes it to the disk: all steps in their order."""

import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from spherloc.errors import InputError, SpherlocError, StoppedError, show
from spherloc.files import lock
from spherloc.frontend.masks import Masks
from spherloc.frontend.view import Gravity, View
from spherloc.mapping.advice import advice
from spherloc.mapping.alignment.line_gravity import GravityByLines
from spherloc.mapping.alignment.positions import gps_of_images
from spherloc.mapping.alignment.rig_poses import turned_otherwise
from spherloc.mapping.alignment.rig_scale import doubt_of_scale, scale_by_rig
from spherloc.mapping.alignment.upright import (
    Level,
    MapScale,
    arbitrary_scale,
    level_of,
    scale_by_distance,
    scale_by_height,
    scale_by_positions,
)
from spherloc.mapping.checked_models import checked_models
from spherloc.mapping.images.folder_cameras import CalibratedLens
from spherloc.mapping.models.kept_models import forget
from spherloc.mapping.models.later import place_rest
from spherloc.mapping.models.misplaced import far_off
from spherloc.mapping.models.model import Reconstruction
from spherloc.mapping.parallel import Tell
from spherloc.mapping.request import MapRequest, ScaleMeasurement
from spherloc.mapping.rig import Shots, disagree, misfits, shots_of, went_apart
from spherloc.mapping.scenes.scene_files import SCENE
from spherloc.mapping.scenes.written import Kept, Written, write_map
from spherloc.mapping.two_view.matched import DATABASES

GROUP = "group"
"""Name of the folder, with a number, of a map of images that could not be joined with the rest."""
MIN_OF_GROUP = 2
"""Least number of images of such a map."""
MIN_POINTS_OF_TWO = 200
"""Least number of points of such a map of two images, which nothing else confirms."""


@dataclass(frozen=True, eq=False)
class Map:
    """A finished map, and how it came about."""

    made: Reconstruction
    level: Level
    scale: MapScale
    written: Written
    lines: GravityByLines
    """Gravity of the photographs from their vertical lines, but for those of which a file states it."""
    groups: "tuple[Map, ...]" = ()
    """Maps of other images, which could not be joined with this one."""
    features: str = "sift"
    """Name of the features that were matched."""
    carried_deg: float = 0.0
    """Half the opening angle of the cone around straight down that was left out, since what is in it moves with the
    camera; 0 if nothing was found."""
    masks: Masks | None = None
    """What was left out of the photographs, that cone included."""
    stated: Mapping[str, Gravity] = field(default_factory=dict)
    """Gravity of photographs that a file or their tags state, by name."""
    doubts: tuple[str, ...] = ()
    """Sentences on how that contradicts the photographs, and on a lens that the map does not confirm."""
    opposed: tuple[str, str] | None = None
    """Two cameras that took images together, but went different ways in this map, or in it and one of ``groups``."""
    lens: CalibratedLens | None = None
    """The lens that the photographs told, or the one that a first map of them fitted better, and how it was found."""
    corrected_rad: float = 0.0
    """Largest angle by which directions differ between those two."""


def make_map(request: MapRequest, folder: Path, tell: Tell = lambda *_: None) -> Map:
    """Make a map and write it into ``folder``, with a scene for the new images too.

    A lens that the photographs told is checked: the map is made anew with one that it fits clearly better.

    Raises ``InputError`` if the images give no map or do not tell their lens, if the measurement names other images, or
    if a file cannot be read: then nothing is left in ``folder`` but a map that was finished before. Raises
    ``StoppedError`` if a file cannot be written: what is done is kept there and not done again. Where another process
    makes a map in ``folder``, that is left alone, and ``InputError`` is raised.
    """
    names, distance = {view.name for view in request.views}, request.measured.distance
    for name in () if distance is None else distance[:2]:
        if name not in names:
            raise InputError(f"{show(name)} is not one of the {len(names)} photographs; give the names of two files.")
    with _folder_of_map(folder):
        return _map_in(folder, request, tell)


@contextmanager
def _folder_of_map(folder: Path) -> Iterator[None]:
    """Make the folder of a map, and keep other processes out. Nothing is left of a map that cannot be made; what can go
    on is kept."""
    made = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror}); {advice('other folder')}.") from None
    with _locked(folder), _tidy(folder, made):
        yield


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Lock a folder against other processes that make a map in it."""
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:  # Windows cannot open folders
        yield
        return
    try:
        try:
            lock(handle)
        except BlockingIOError:
            busy = "another process is making a map there"
            raise InputError(f"{folder}: {busy}; wait until it is done, or {advice('own folder')}.") from None
        yield
    finally:
        os.close(handle)


@contextmanager
def _tidy(folder: Path, made: bool) -> Iterator[None]:
    """Leave nothing of a map that cannot be made in its folder, which was ``made`` for it or not."""
    before = set(folder.glob(DATABASES))
    try:
        yield
    except StoppedError:
        raise
    except SpherlocError:
        finished = (folder / SCENE).exists()
        forget(folder)
        for path in folder.glob(DATABASES):
            if path not in before or not finished:
                path.unlink(missing_ok=True)
        made = made or bool(before)
        raise
    finally:
        if made:
            with suppress(OSError):  # it is not empty
                folder.rmdir()


def _map_in(folder: Path, request: MapRequest, tell: Tell) -> Map:
    """``make_map`` in a folder that is there."""
    if not request.measured.given:
        request = replace(request, measured=replace(request.measured, positions=gps_of_images(request.views)))
    checked = checked_models(folder, request, tell)
    request, built = checked.request, checked.built
    views, measured, stated = built.views, request.measured, request.stated
    first, *others = built.models
    kept = Kept(built.masks, request.how, stated)
    known = {} if stated is None else stated.found
    lines = built.lines.in_maps([one.poses for one in built.models], first.points())
    gravity = {**known, **lines.found}
    found = _finished(first, views, nearer_to_others(first, others), gravity, measured, tell)
    inside = set(found[0].poses)
    doubts = [*(() if stated is None else stated.doubts), *checked.doubts]
    if measured.fixed is not None and found[2].source:
        doubts += filter(None, [doubt_of_scale(found[0].poses, found[2], measured.fixed)])
    written = write_map(*found, views, request.images, folder, request.new_images, kept)
    made = Map(
        *found,
        written,
        lines,
        features=kept.how.features.method,
        carried_deg=built.carried_deg,
        masks=built.masks,
        stated=known,
        doubts=tuple(doubts),
        lens=request.lens,
        corrected_rad=checked.corrected_rad,
    )
    groups: list[Map] = []
    for other in others:
        if len(other.poses.keys() - inside) < MIN_OF_GROUP:
            continue
        try:
            every = {view.name for view in views}  # others do not grow
            found = _finished(other.without(inside), views, every, gravity, measured, tell)
        except InputError:  # its images do not agree on where down is
            continue
        if not _worth_a_map(found[0]):
            continue
        inside |= found[0].poses.keys()
        place = folder / f"{GROUP}_{len(groups) + 2}"
        try:
            place.mkdir(exist_ok=True)
        except OSError as error:
            raise InputError(f"{place}: cannot be made ({error.strerror}); {advice('other folder')}.") from None
        group, level, scale = found
        own = write_map(*found, views, request.images, place, request.new_images, kept)
        groups.append(replace(made, made=group, level=level, scale=scale, written=own))
    for path in checked.unused:
        path.unlink(missing_ok=True)
    return replace(made, groups=tuple(groups), opposed=_opposed(made, groups, shots_of(views)))


def _opposed(made: Map, groups: Sequence[Map], shots: Shots) -> tuple[str, str] | None:
    """See ``Map.opposed``."""
    poses, down = made.made.poses, made.level.down
    found = (disagree(poses, group.made.poses, (down, group.level.down), shots) for group in groups)
    return went_apart(poses, shots) or next(filter(None, found), None)


def _worth_a_map(made: Reconstruction) -> bool:
    """Whether images that could not be joined with the rest are a map of their own."""
    count = len(made.poses)
    return count > MIN_OF_GROUP or (count == MIN_OF_GROUP and len(made.model.points3D) >= MIN_POINTS_OF_TWO)


def nearer_to_others(made: Reconstruction, others: Sequence[Reconstruction]) -> set[str]:
    """Names of images that are not in the model and have more matches with those of another one."""
    place = {name: index for index, name in enumerate(made.ids)}

    def ties(name: str, group: Collection[str]) -> int:
        return int(made.all_matches[place[name], [place[one] for one in group if one != name]].sum())

    return {
        name
        for name in made.ids.keys() - made.poses.keys()
        if any(ties(name, other.poses) > ties(name, made.poses) for other in others)
    }


def _finished(
    made: Reconstruction,
    views: Sequence[View],
    elsewhere: Collection[str],
    gravity: Mapping[str, Gravity],
    measured: ScaleMeasurement,
    tell: Tell,
) -> tuple[Reconstruction, Level, MapScale]:
    """A model with images added later and without those whose own gravity, or what another camera took together with
    them, disagrees, and those far off; its gravity and its scale."""
    shots, fixed = shots_of(views), measured.fixed
    if fixed is not None:
        made = made.without(turned_otherwise(made.poses, fixed))
    made = made.without(level_of(made.poses, gravity).leaning)
    made = made.without(misfits(made.poses, shots) | far_off(made.poses))
    made = place_rest(made, views, elsewhere, gravity, level_of(made.poses, gravity), tell, fixed)
    level = level_of(made.poses, gravity)
    made = made.without(level.leaning.keys() | misfits(made.poses, shots) | far_off(made.poses))
    if fixed is not None:
        made = made.without(turned_otherwise(made.poses, fixed))
    made = made.without_near_points()
    return made, level, scale_of(made, level, measured)


def scale_of(made: Reconstruction, level: Level, measured: ScaleMeasurement) -> MapScale:
    """The scale by ``measured``; arbitrary, with the reason, if that does not fit: the map itself is finished."""
    why_unknown = ""
    for scale in _scales(made, level, measured):
        try:
            return scale()
        except InputError as error:
            why_unknown = why_unknown or str(error)
    return replace(arbitrary_scale(made.depths()), why_unknown=why_unknown)


def _scales(made: Reconstruction, level: Level, measured: ScaleMeasurement) -> Iterator[Callable[[], MapScale]]:
    """What computes the scale, the best first; raises ``InputError`` when it is called and does not fit."""
    if measured.distance is not None:
        yield partial(scale_by_distance, made.poses, *measured.distance)
    if measured.camera_height_m is not None:
        yield partial(scale_by_height, made.poses, made.points(), level, measured.camera_height_m)
    if measured.positions is not None:
        yield partial(scale_by_positions, made.poses, measured.positions, level)
    if measured.fixed is not None:
        yield partial(scale_by_rig, made.poses, measured.fixed)
