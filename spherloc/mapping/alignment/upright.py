"""Gravity and scale of a model that was made from images alone."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from spherloc.errors import InputError, show
from spherloc.frontend.gravity_from_lines import SOURCE as LINES
from spherloc.frontend.view import Gravity
from spherloc.geometry import DOWN, align_to_down, camera_centre
from spherloc.mapping.advice import advice
from spherloc.mapping.alignment.line_gravity import middle
from spherloc.mapping.alignment.positions import MAX_SCALE_SD, SWAPPED, Positions, overlaid
from spherloc.types import FloatArray

MIN_LINES = 3
"""Least number of images whose lines give gravity; if there are fewer, all images count as held upright."""
MAX_SPREAD_DEG = 25.0
MIN_LIMIT_DEG, LIMIT_SPREADS = 2.0, 5.0
"""An image whose own gravity differs from the map's by more than the first (degrees), and by more than the second times
the median of all images, has a wrong pose: at a place that looks like the right one."""
LAYER, LAYER_SHARE = 1.08, 0.5
"""The ground is the deepest layer of points below the cameras, up to this factor higher or lower, that has at least
this share of the points of the densest one: tables have fewer, and wrong points and reflections lie at all depths."""
MIN_GROUND_POINTS, MIN_GROUND_SHARE = 30, 0.2
"""Least number of points of the ground, and their least share of all below the cameras."""
FAR, LEAST_FAR_M = 10.0, 0.5
"""An image is misplaced if it is farther from its position than this many times the median of all, and than so many
metres."""
MEDIAN_DEPTH = 10.0
"""Median distance of a point to an image that sees it, in units of a map whose scale is unknown."""


@dataclass(frozen=True)
class Level:
    """Gravity in a model."""

    down: FloatArray
    """Unit vector (3,), model frame."""
    source: str
    """How it was measured, in words."""
    spread_deg: float
    """Median angle between ``down`` and the gravity of single images."""
    leaning: dict[str, float]
    """Angles, degrees, of images whose own gravity differs too much, by name: COLMAP placed them wrongly."""
    by_lines: bool = False
    """Whether vertical lines of enough images measured it."""


@dataclass(frozen=True)
class MapScale:
    """Length of the model's unit."""

    metres_per_unit: float
    source: str
    """How it was measured, in words; empty if it was not, so that the unit is arbitrary."""
    why_unknown: str = ""
    """Why the measurement gave no scale; empty if it did or if there is none."""
    off_m: Mapping[str, float] = field(default_factory=dict)
    """Distance of images to the positions that measured it, metres, by name."""

    @property
    def misplaced(self) -> dict[str, float]:
        """Those distances of images that are much farther off than the others, the farthest first."""
        limit_m = max(LEAST_FAR_M, FAR * float(np.median(list(self.off_m.values())))) if self.off_m else 0.0
        return {name: off for name, off in sorted(self.off_m.items(), key=lambda item: -item[1]) if off > limit_m}


def level_of(poses: Mapping[str, FloatArray], gravity: Mapping[str, Gravity]) -> Level:
    """Gravity of the model, from that of the images, else as the mean of their vertical axes.

    ``poses`` (3, 4) are those of the registered images, by name, and ``gravity`` is that which a file states or
    vertical lines show; a single image that a file states is enough. Raises ``InputError`` if the images do not agree.
    """
    axes = {name: pose[:, :3].T @ DOWN for name, pose in poses.items()}
    measured = {name: poses[name][:, :3].T @ one.down for name, one in gravity.items() if name in poses}
    sources = Counter(gravity[name].source for name in measured)
    is_measured = len(measured) >= MIN_LINES or sources[LINES] < len(measured)
    directions = measured if is_measured else axes
    down = middle(np.stack(list(directions.values())))
    off_deg = {name: float(np.degrees(np.arccos(min(1.0, one @ down)))) for name, one in directions.items()}
    spread_deg = float(np.median(list(off_deg.values())))
    if spread_deg > MAX_SPREAD_DEG:
        raise InputError(
            f"the photographs do not agree on where down is: the median is {spread_deg:.0f} degrees off their mean. "
            "Take them with the camera held upright."
        )
    limit_deg = max(MIN_LIMIT_DEG, LIMIT_SPREADS * spread_deg)
    leaning = {name: off for name, off in off_deg.items() if off > limit_deg}
    told = (
        f"{'vertical lines' if one == LINES else one} of {count} image{'s'[: count > 1]}"
        for one, count in sources.items()
    )
    source = " and ".join(told)
    if not is_measured:
        source = (
            f"the images' own vertical, as if held upright, since vertical lines show it in {len(measured)} of "
            f"{len(poses)} images and {MIN_LINES} are needed"
        )
    return Level(down, source, spread_deg, leaning, sources[LINES] >= MIN_LINES)


def scale_by_distance(poses: Mapping[str, FloatArray], first: str, second: str, metres: float) -> MapScale:
    """The scale that makes two images of ``poses`` (3, 4) ``metres`` apart.

    Raises ``InputError`` if one is not in the map.
    """
    for name in (first, second):
        if name not in poses:
            raise InputError(f"{show(name)} did not get into the map; name two of those that did: {_some(poses)}.")
    apart = float(np.linalg.norm(camera_centre(poses[first]) - camera_centre(poses[second])))
    if apart == 0.0:
        raise InputError(f"{show(first)} and {show(second)} were taken from one place; name two others.")
    return MapScale(metres / apart, f"{first} and {second} are {metres:g} m apart")


def scale_by_height(poses: Mapping[str, FloatArray], points: FloatArray, level: Level, metres: float) -> MapScale:
    """The scale that puts the cameras ``metres`` above the ground, the deepest dense layer of points (N, 3) below them.

    Raises ``InputError`` if there are too few points below the cameras, or if these lie at all depths.
    """
    centres = np.stack([camera_centre(pose) for pose in poses.values()])
    offset = points - centres[KDTree(centres).query(points)[1]]
    below = offset @ level.down
    # Most points that are seen 45 degrees or more below the horizon are on the ground.
    depths = np.sort(below[below > 0.707 * np.linalg.norm(offset, axis=1)])
    if len(depths) < MIN_GROUND_POINTS:
        raise InputError(
            f"only {len(depths)} points of the map lie below the cameras, too few to find the ground; give the "
            "distance of two images instead."
        )
    ground = _deepest_layer(depths)
    if len(ground) < max(MIN_GROUND_POINTS, MIN_GROUND_SHARE * len(depths)):
        raise InputError(
            f"the {len(depths)} points of the map below the cameras lie at all depths, so that the ground cannot be "
            "told from the rest; give the distance of two images instead."
        )
    height = float(np.median(ground))
    spread = float(np.median(np.abs(ground - height))) / height
    source = (
        f"cameras {metres:g} m above the ground, which {len(ground):,} of {len(depths):,} points below them show to "
        f"{max(spread, 1e-3):.1%}"
    )
    return MapScale(metres / height, source)


def _deepest_layer(depths: FloatArray) -> FloatArray:
    """Those of the ``depths`` (N,), ascending, that are in the deepest dense layer."""

    def ends(depth: FloatArray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        return np.searchsorted(depths, depth / LAYER), np.searchsorted(depths, depth * LAYER, "right")

    first, last = ends(depths)
    dense = last - first >= LAYER_SHARE * (last - first).max()
    layer = depths[first[dense][-1] : last[dense][-1]]
    for _ in range(10):  # from the edge of the layer to its middle
        begin, end = ends(np.array([np.median(layer)]))
        layer = depths[begin[0] : end[0]]
    return layer


def scale_by_positions(poses: Mapping[str, FloatArray], positions: Positions, level: Level) -> MapScale:
    """The scale that aligns the images of ``poses`` (3, 4) with positions from another source.

    Raises ``InputError`` if too few have a position, or if these do not fix the scale to ``MAX_SCALE_SD``, and if
    latitudes and longitudes fit far better when they are exchanged.
    """
    names = [name for name in poses if name in positions.by_name]
    centres = np.array([camera_centre(poses[name]) for name in names]).reshape(-1, 3)
    places = np.array([positions.by_name[name] for name in names]).reshape(-1, 3)
    if positions.horizontal:
        centres, places = (centres @ upright_frame(level).T)[:, :2], places[:, :2]
    try:
        found = overlaid(centres, places)
    except InputError as error:
        raise InputError(f"{positions.source} gave no scale: {error}") from None
    off_m = dict(zip(names, found.off_m.tolist(), strict=True))
    near = int(np.count_nonzero(found.near))
    measured = f"{near} of {len(names)} images fit it, {float(np.median(found.off_m[found.near])):.2g} m off"
    if (other := positions.other_order) is not None:
        exchanged = overlaid(centres, np.array([other[name] for name in names])[:, :2])
        off = [float(np.median(fit.off_m)) for fit in (found, exchanged)]
        if SWAPPED * off[1] < off[0]:
            raise InputError(
                f"{positions.source} gave no scale: its latitudes and longitudes seem to be exchanged, since in the "
                f"other order the images fit to {off[1]:.2g} m instead of {off[0]:.2g} m; exchange them."
            )
    if found.scale_sd > MAX_SCALE_SD or 2 * near < len(names):
        raise InputError(
            f"{positions.source} gave no scale: {measured} in the median, so that the scale is uncertain by "
            f"{found.scale_sd:.0%}; {advice('other scale')}."
        )
    source = f"{positions.source}: {measured} in the median, the scale is good to {max(found.scale_sd, 5e-4):.1%}"
    return MapScale(found.scale, source, off_m=off_m)


def arbitrary_scale(depths: FloatArray) -> MapScale:
    """The scale at which the median of ``depths`` (N,), distances of points to images that see them, is ten units.

    Limits of positions, which are a tenth of a unit, then are a hundredth of that distance, for a rig whose cameras are
    a hand apart as for images along a street.
    """
    return MapScale(MEDIAN_DEPTH / float(np.median(depths)) if len(depths) else 1.0, "")


def upright_frame(level: Level) -> FloatArray:
    """Rotation (3, 3) from the model's frame to one whose z axis is up."""
    to_down = align_to_down(level.down)  # turns down to +y
    return np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]) @ to_down


def _some(poses: Mapping[str, FloatArray]) -> str:
    names = sorted(poses)
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
