"""Positions of photographs from another source (a trajectory, GPS), which give the map's scale.

The map's camera centres are aligned with these positions by a similarity. Up to half of the positions may be wrong: the
similarity has the least median of distances (Rousseeuw 1984) and is then fitted to the positions near it.
"""

import csv
import re
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import combinations
from math import comb
from pathlib import Path

import numpy as np
from PIL import Image

from spherloc.datasets.imu import NAME_RULE
from spherloc.datasets.query_gravity import time_of
from spherloc.errors import InputError, shorten, show
from spherloc.files import open_file
from spherloc.formats.text_rows import finite_numbers, rows
from spherloc.frontend.view import View
from spherloc.trajectory import NS_PER_S, Trajectory, pose_at, read_euroc, read_tum
from spherloc.types import BoolArray, FloatArray

MIN_POSITIONS = 4
"""Least number of the map's images with a position: a similarity fits fewer whatever they are."""
MAX_SCALE_SD = 0.1
"""Largest relative standard deviation of the scale."""
MAX_GAP_S = 0.5
"""Largest time between two poses of a trajectory that are interpolated."""
SWAPPED = 3.0
"""Latitudes and longitudes are taken for exchanged if they fit so many times better in the other order."""
MAX_SPREAD_DEG = 0.05
"""Positions that may be latitudes and longitudes, far from 0, are taken for those if they are no farther apart: five
kilometres, as metres a hand."""
SAMPLES = 2000
NEAR_SD = 2.5
"""Positions within this many robust standard deviations are used in the fit."""
_COLUMNS = "image x y z in metres"
_GPS_WORDS = ({"lat", "latitude"}, {"lon", "lng", "long", "longitude"}, {"alt", "altitude"})
_METRE_WORDS = (
    {"x", "east", "easting"},
    {"y", "north", "northing"},
    {"z", "up", "alt", "altitude", "elevation", "height"},
)
_SPACED = re.compile(r"(.*?\S)\s+([-+.\deE]+)\s+([-+.\deE]+)\s+([-+.\deE]+)(?:\s+#.*)?")
"""A name, three numbers and perhaps a comment, with spaces between them."""
_EQUATOR_M, _FLATTENING = 6_378_137.0, 1.0 / 298.257223563
"""Equatorial radius and flattening of the Earth (WGS 84)."""
_GPS_TAGS = 0x8825


@dataclass(frozen=True, eq=False)
class Positions:
    """Positions of photographs in metres, in any frame."""

    by_name: Mapping[str, FloatArray]
    """Position (3,), m, by the name of the photograph; z is up where ``horizontal``."""
    source: str
    """Where they come from, in a few words."""
    horizontal: bool = False
    """Whether heights are not used, as with GPS."""
    other_order: Mapping[str, FloatArray] | None = None
    """What they are if latitudes and longitudes are exchanged; None where they cannot be."""


@dataclass(frozen=True, eq=False)
class SimilarityFit:
    """A similarity that aligns points with positions."""

    scale: float
    """Metres per unit of the points."""
    rotation: FloatArray
    """(D, D), from the frame of the points to that of the positions."""
    translation: FloatArray
    """(D,), m."""
    scale_sd: float
    """Relative standard deviation of the scale, from the distances after the alignment."""
    off_m: FloatArray
    """(N,) distances between positions and aligned points."""
    near: BoolArray
    """(N,) mask of the positions that the similarity was fitted to."""


def read_positions(path: Path, views: Sequence[View]) -> Positions:
    """Positions in a file: rows ``image x y z``, a table with titles (image, lat, lon or image, easting, northing), or
    a trajectory (TUM, EuRoC).

    A trajectory is interpolated at the times in the images' names. Raises ``InputError`` for a wrong row, and for a
    file that has no position of any image.
    """
    first = next(iter(rows(path, f"rows of {_COLUMNS}, or a trajectory")), None)
    if first is None:
        raise InputError(f"{path}: is empty; give rows of {_COLUMNS}.")
    words = first[1].partition("#")[0].replace(",", " ").split()
    if path.suffix.lower() == ".csv" and (len(words) > 8 or words[0].isdigit()):
        found = _at_times(read_euroc(path), views)
    elif len(words) == 8 and _is_number(words[0]):
        found = _of_trajectory(path, views)
    else:
        return _of_rows(path, views)
    if not found:
        why = f"; their names must hold it ({NAME_RULE})"
        if views and (time_ns := time_of(views[0])) is not None:
            clocks = f"its first one is of {shorten(words[0])}, {shorten(views[0].name)} of {time_ns / NS_PER_S:.3f} s"
            why = f": {clocks}; give times on the same clock"
        raise InputError(f"{path}: this trajectory has no pose at the time of any of the {len(views)} images{why}.")
    return Positions(found, f"the trajectory {shorten(path.name)}")


def _of_trajectory(path: Path, views: Sequence[View]) -> dict[str, FloatArray]:
    """Positions from the rows of a TUM trajectory, whose times may be in seconds or in nanoseconds."""
    try:
        found = _at_times(read_tum(path, "s"), views)
    except InputError as error:  # nanoseconds are too large for seconds
        try:
            return _at_times(read_tum(path, "ns"), views)
        except InputError:
            raise error from None
    with suppress(InputError):
        found = found or _at_times(read_tum(path, "ns"), views)
    return found


def _at_times(trajectory: Trajectory, views: Sequence[View]) -> dict[str, FloatArray]:
    found = {}
    for view in views:
        time_ns = time_of(view)
        pose = None if time_ns is None else pose_at(trajectory, time_ns, MAX_GAP_S)
        if pose is not None:
            found[view.name] = pose[:, 3]
    return found


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _words(text: str) -> list[str]:
    """The words of a row, of which the first, a name, may have spaces or be in quotes."""
    for mark in (";", "\t", ","):
        if mark in text:
            with suppress(csv.Error):  # a line end within the row
                return [word.strip() for word in next(csv.reader([text], delimiter=mark, skipinitialspace=True))]
    if (found := _SPACED.fullmatch(text)) is not None:
        return [found[1].strip("\"'"), *found.groups()[1:]]
    return text.partition("#")[0].split()


def _of_rows(path: Path, views: Sequence[View]) -> Positions:
    names = {view.name for view in views}
    columns: list[int] | None = None
    in_degrees, named = False, ""
    found: dict[str, FloatArray] = {}
    count = 0
    for number, (place, text) in enumerate(rows(path, f"rows of {_COLUMNS}")):
        words = _words(text)
        if number == 0:
            columns = _columns(words, _GPS_WORDS)
            in_degrees = columns is not None
            columns = columns or _columns(words, _METRE_WORDS)
            if columns is not None:
                continue
        wanted = 4 if columns is None else max(columns) + 1
        if len(words) < wanted or (columns is None and len(words) != wanted):
            what = _COLUMNS if columns is None else "the columns of the first one"
            raise InputError(f"{place}: has {len(words)} words; give {what}.")
        numbers = finite_numbers(words[1:4] if columns is None else [words[column] for column in columns], place)
        if in_degrees and not (abs(numbers[0]) <= 90.0 and abs(numbers[1]) <= 360.0):
            exchanged = abs(numbers[1]) <= 90.0 and abs(numbers[0]) <= 360.0
            advice = "exchange the titles of the two columns" if exchanged else "give degrees"
            raise InputError(f"{place}: {numbers[0]:g}, {numbers[1]:g} is not a latitude and longitude; {advice}.")
        if words[0] in found:
            raise InputError(f"{place}: {show(words[0])} is there a second time; keep one row.")
        count += 1
        named = named or words[0]
        if words[0] in names:
            found[words[0]] = np.array([*numbers, 0.0][:3])
    if not found:
        first = f", such as {show(named)}," if named else ""
        raise InputError(
            f"{path}: none of its {count} rows{first} names one of the {len(views)} images, such as "
            f"{show(views[0].name)}; use the file names of the images, with their folder and ending."
        )
    if len(found) > 1 and len({tuple(at) for at in found.values()}) == 1:
        raise InputError(
            f"{path}: has the same position for all of its {len(found)} images, which gives no scale; give where each "
            "of them was taken."
        )
    if not in_degrees:
        if _are_degrees(np.array(list(found.values()))):
            raise InputError(
                f"{path}: its positions seem to be latitudes and longitudes in degrees, and metres are expected; name "
                "the columns in the first row: image,lat,lon."
            )
        flat = columns is not None and len(columns) == 2
        return Positions(found, f"the positions in {shorten(path.name)}", horizontal=flat)
    exchanged = {name: at[[1, 0, 2]] for name, at in found.items()}
    possible = all(abs(at[0]) <= 90.0 for at in exchanged.values())
    other = local_metres(exchanged) if possible else None
    return Positions(local_metres(found), f"GPS in {shorten(path.name)}", horizontal=True, other_order=other)


def _are_degrees(positions: FloatArray) -> bool:
    """Whether positions (N, 3) look like latitudes and longitudes, in any order, of one place."""
    flat = positions[:, :2]
    spread, away = np.ptp(flat, axis=0).max(), np.abs(flat).max()
    in_range = np.sort(np.abs(flat).max(axis=0)) <= [90.0, 180.0]
    near = 0.0 < spread < min(MAX_SPREAD_DEG, 0.01 * away)
    return len(flat) >= MIN_POSITIONS and near and bool(in_range.all())


def _columns(words: Sequence[str], kinds: Sequence[set[str]]) -> list[int] | None:
    """Columns of two coordinates and, if there is one, the height in a row of titles; None for another row."""
    titles = [word.strip('"').lower().removesuffix("_m") for word in words]
    places = [next((at for at, word in enumerate(titles) if at and word in kind), None) for kind in kinds]
    if places[0] is None or places[1] is None:
        return None
    return [at for at in places if at is not None]


def gps_of_images(views: Sequence[View]) -> Positions | None:
    """Positions in the photographs' own EXIF tags; None if fewer than ``MIN_POSITIONS`` have one."""
    found = {}
    for view in views:
        place = _gps_tag(view.path)
        if place is not None:
            found[view.name] = np.array([*place, 0.0])
    if len(found) < MIN_POSITIONS:
        return None
    return Positions(local_metres(found), "GPS in the photographs", horizontal=True)


def _gps_tag(path: Path) -> tuple[float, float] | None:
    """Latitude and longitude, degrees, that a camera wrote into an image; None if there is nothing usable."""
    try:
        # Pillow warns of images that are large, as panoramas are.
        with warnings.catch_warnings(action="ignore"), open_file(path) as file, Image.open(file) as image:
            tags = image.getexif().get_ifd(_GPS_TAGS)
            signs = [tags[1] in ("N", "n"), tags[3] in ("E", "e")]
            angles = [sum(float(part) / 60**power for power, part in enumerate(tags[tag])) for tag in (2, 4)]
    except Exception:  # Pillow passes on whatever a damaged tag raises
        return None
    if not (np.isfinite(angles).all() and angles[0] <= 90.0 and angles[1] <= 180.0) or angles == [0.0, 0.0]:
        return None
    latitude, longitude = (angle if sign else -angle for angle, sign in zip(angles, signs, strict=True))
    return latitude, longitude


def local_metres(degrees: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """Positions (3,) by name: east, north and 0 in metres from the middle one, of latitudes and longitudes in degrees.

    By the Earth's radii of curvature there (WGS 84): good to a millimetre in a hundred metres.
    """
    middle = np.median(np.stack(list(degrees.values())), axis=0)
    sine = np.sin(np.radians(middle[0]))
    eccentricity2 = _FLATTENING * (2.0 - _FLATTENING)
    bend = 1.0 - eccentricity2 * sine * sine
    north_m = np.radians(_EQUATOR_M * (1.0 - eccentricity2) / bend**1.5)
    east_m = np.radians(_EQUATOR_M / np.sqrt(bend)) * np.cos(np.radians(middle[0]))
    return {
        name: np.array([((at[1] - middle[1] + 180.0) % 360.0 - 180.0) * east_m, (at[0] - middle[0]) * north_m, 0.0])
        for name, at in degrees.items()
    }


def overlaid(points: FloatArray, positions: FloatArray) -> SimilarityFit:
    """The similarity that aligns points (N, D) with positions (N, D) in metres, D = 2 or 3; half of them may be wrong.

    Raises ``InputError`` if there are fewer than ``MIN_POSITIONS``, or if points or positions are all in one place.
    """
    count, size = points.shape
    if count < MIN_POSITIONS:
        have = f"only {count} images of the map have" if count else "no image of the map has"
        raise InputError(f"{have} a position, but {MIN_POSITIONS} are needed.")
    best: tuple[float, FloatArray] | None = None
    for sample in _samples(count, size):
        fit = _similarity(points[sample], positions[sample])
        if fit is None:
            continue
        off = _off(fit, points, positions)
        median = float(np.median(off))
        if best is None or median < best[0]:
            best = median, off
    if best is None:
        raise InputError("the positions, or the images of the map, are all in one place.")
    unknowns = 4 if size == 2 else 7
    sd = 1.4826 * (1.0 + 5.0 / max(1, count - size)) * best[0]
    near = best[1] <= max(NEAR_SD * sd, float(np.partition(best[1], MIN_POSITIONS - 1)[MIN_POSITIONS - 1]))
    fit = _similarity(points[near], positions[near])
    if fit is None:
        raise InputError("the positions, or the images of the map, are all in one place.")
    off = _off(fit, points, positions)
    variance = float(np.sum(off[near] ** 2)) / max(1, size * int(near.sum()) - unknowns)
    spread = float(np.sum((fit[0] * (points[near] - points[near].mean(axis=0))) ** 2))
    return SimilarityFit(*fit, float(np.sqrt(variance / spread)), off, near)


def _samples(count: int, size: int) -> list[list[int]]:
    """Index sets of ``size`` points, which fix a similarity of the plane or of space; all of them if they are few."""
    if comb(count, size) <= SAMPLES:
        return [list(sample) for sample in combinations(range(count), size)]
    rng = np.random.default_rng(0)
    return [rng.choice(count, size, replace=False).tolist() for _ in range(SAMPLES)]


def _similarity(points: FloatArray, positions: FloatArray) -> tuple[float, FloatArray, FloatArray] | None:
    """Scale, rotation (D, D) and translation (D,) that take points (N, D) closest to positions (Umeyama 1991)."""
    middle, target = points.mean(axis=0), positions.mean(axis=0)
    centred, aimed = points - middle, positions - target
    spread = float(np.sum(centred**2))
    left, stretch, right = np.linalg.svd(aimed.T @ centred)
    mirror = np.ones(len(stretch))
    mirror[-1] = np.sign(np.linalg.det(left @ right)) or 1.0
    scale = float(np.sum(stretch * mirror)) / spread if spread > 0.0 else 0.0
    if not 0.0 < scale < np.inf:
        return None
    rotation = left @ np.diag(mirror) @ right
    return scale, rotation, target - scale * rotation @ middle


def _off(fit: tuple[float, FloatArray, FloatArray], points: FloatArray, positions: FloatArray) -> FloatArray:
    scale, rotation, translation = fit
    return np.linalg.norm(scale * points @ rotation.T + translation - positions, axis=1)
