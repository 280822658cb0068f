"""Features and matches of photographs: what a map is made from, in a database of COLMAP.

Images, features and pairs that were matched stay in the database, so that an interrupted map goes on with them.
"""

import ctypes
import hashlib
import json
import shutil
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spherloc.cameras.base import Camera
from spherloc.cameras.colmap_models import colmap_camera
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.errors import InputError, StoppedError, reason, shorten
from spherloc.frontend import retrieval
from spherloc.frontend.features import VERSION, Features, extract
from spherloc.frontend.pipeline import FrontendOptions
from spherloc.frontend.view import Gravity, View
from spherloc.mapping.advice import advice
from spherloc.mapping.parallel import Tell, as_completed
from spherloc.mapping.rig import shots_of
from spherloc.mapping.two_view.pairs import MIN_MATCHES, SURE, ImagePairs, relative
from spherloc.mapping.two_view.rotations import agreeing
from spherloc.mapping.two_view.triangles import Pair, Relative, open_triangles
from spherloc.registry import require
from spherloc.types import BoolArray, FloatArray

DATABASE_VERSION = 7
"""Number to be increased when pairs are matched or checked in another way, so that old databases are not used."""
DATABASES = "matches_*.db*"
"""Pattern of the names of databases, with the files that SQLite puts beside them."""
MAX_EXHAUSTIVE = 50
"""Largest number of images of which all pairs are tried; of more, each is tried with its neighbours by name and with
similar images."""
NEIGHBOURS, ALIKE = 5, 15
NEIGHBOURS_LEARNED, ALIKE_LEARNED = 2, 4
"""The same for LightGlue besides SIFT, which takes a second or two a pair."""
WIDEST_RAD = np.radians(85.0)
"""Features farther from the optical axis are left out: COLMAP's fisheyes end at 90 degrees."""

Names = tuple[str, str]
"""Names of two images."""


@dataclass(frozen=True, eq=False)
class Matched:
    """Images whose pairs were matched and checked."""

    database: Path
    """COLMAP's database with features and matches."""
    ids: dict[str, int]
    """Ids of all images in the database, by name."""
    cameras: dict[str, Camera]
    bearings: dict[str, FloatArray]
    """(K, 3) of the features of each image in the database."""
    bound_rad: float
    """Largest angle of a match to its epipolar plane."""
    verified: dict[Pair, Any]
    """``TwoViewGeometry`` of the pairs with a pose, by the numbers of their images."""
    agreed: dict[Pair, Any]
    """Those of them whose rotations agree with those of the others."""
    unsure: dict[Pair, Any]
    """The same of pairs whose pose may be wrong, which are not in ``verified``."""
    sureness: dict[Pair, float]
    """``ImagePairs.sureness`` of pairs in both, but for those that were found through an image between."""
    same_place: NDArray[np.int64]
    """(V, V) number of matches of the pairs that were taken from one place."""
    none_sure: bool = False
    """Whether pairs are in ``verified`` although they are not sure, as none is."""

    @property
    def names(self) -> list[str]:
        """Names of all images."""
        return list(self.ids)

    def rotations(self, pairs: Mapping[Pair, Any]) -> dict[Names, FloatArray]:
        """Rotations (3, 3) of pairs by their names, the second image from the first."""
        names = self.names
        return {(names[one], names[other]): relative(found)[0] for (one, other), found in pairs.items()}

    def counts(self) -> NDArray[np.int64]:
        """Number of matches (V, V) of each of the pairs that agree."""
        return _counts(self.agreed, len(self.ids))

    def without(self, cut: Collection[Names]) -> "Matched":
        """The same without verified pairs of these names."""
        names = self.names
        left = {pair: one for pair, one in self.verified.items() if (names[pair[0]], names[pair[1]]) not in cut}
        return replace(self, verified=left, agreed=_agreeing(left))

    def with_unsure(self) -> "Matched":
        """The same with all pairs, sure or not."""
        return replace(
            self, verified={**self.unsure, **self.verified}, agreed=_agreeing({**self.unsure, **self.agreed})
        )

    def matches(self) -> dict[Names, NDArray[np.int64]]:
        """(M, 2) indices of the features that match, right or wrong, of all pairs that were compared, by their
        names."""
        pycolmap = require("pycolmap", "colmap", "making a map")
        with pycolmap.Database.open(str(self.database)) as opened:
            return {
                pair: np.asarray(opened.read_matches(*_of(self.ids, pair)), np.int64).reshape(-1, 2)
                for pair in combinations(self.ids, 2)
                if opened.exists_matches(*_of(self.ids, pair))
            }


def match_all(
    pycolmap: Any,
    views: Sequence[View],
    gravity: Sequence[Gravity | None],
    folder: Path,
    tell: Tell,
    how: FrontendOptions,
    fixed: Mapping[Pair, Relative] = MappingProxyType({}),
) -> Matched:
    """Features and matches of images, of which those that a database in ``folder`` has are used again.

    ``gravity`` is that from the images' vertical lines, ``fixed`` the relative poses of pairs that a calibration tells.

    Raises ``InputError`` if an image or the folder cannot be used, or if no two images fit together, and
    ``StoppedError`` if there is no room for the database.
    """
    extracted: dict[int, Features] = {}
    for index, found in as_completed(lambda index: extract(views[index], how.features), range(len(views))):
        extracted[index] = found
        tell("images searched for features", len(extracted), len(views))
    features = [extracted[index] for index in range(len(views))]
    usable = [_usable(view.camera, one.pixels) for view, one in zip(views, features, strict=True)]
    path = folder / f"matches_{_key(views, how, fixed)}.db"
    with _database(pycolmap, path) as database:
        ids = _described(pycolmap, database, views, features, usable)
        cameras = [view.camera for view in views]
        promising = _pairs(features, NEIGHBOURS_LEARNED, ALIKE_LEARNED) if len(how.features.parts) > 1 else ()
        compared = ImagePairs(pycolmap, cameras, features, usable, gravity, how.matching, frozenset(promising), fixed)
        every = len(views) <= MAX_EXHAUSTIVE
        pairs = list(combinations(range(len(views)), 2))
        if not every:
            pairs = sorted({*_pairs(features, NEIGHBOURS, ALIKE), *fixed})
        found, at_one_place, sureness = _compared(database, ids, compared, pairs, tell)
    whole = path.with_name(f"{path.stem}_whole.db")
    try:
        for left in folder.glob(f"{whole.name}-*"):  # of a run that was killed
            left.unlink()
        shutil.copyfile(path, whole)  # else what follows would be found already when the map is made again
    except OSError as error:
        raise StoppedError(f"{whole}: cannot be written ({reason(error)}); {advice('go on')}.") from None
    panoramas = all(isinstance(camera, Equirectangular) for camera in cameras)
    none_sure = not panoramas and all(one < SURE for one in sureness.values()) and bool(sureness)
    together = not panoramas and bool(shots_of(views))  # what cameras took together tells which pairs are wrong
    every = none_sure or together
    sure = {pair: one for pair, one in found.items() if every or sureness[pair] >= SURE}
    with _database(pycolmap, whole) as database:
        between = _with_images_between(database, ids, compared, _agreeing(sure), at_one_place, tell)
    names = [view.name for view in views]
    matched = Matched(
        database=whole,
        ids=dict(zip(names, ids, strict=True)),
        cameras=dict(zip(names, cameras, strict=True)),
        bearings=dict(zip(names, compared.bearings, strict=True)),
        bound_rad=compared.bound_rad,
        verified={**sure, **between},
        agreed=_agreeing(between),
        unsure={pair: one for pair, one in found.items() if pair not in sure},
        sureness=sureness,
        same_place=_counts(at_one_place, len(views)),
        none_sure=none_sure,
    )
    if matched.counts().max(initial=0) < MIN_MATCHES:
        raise InputError(_why_none(matched))
    return matched


def _why_none(matched: Matched) -> str:
    """Why no two of the images fit together."""
    count = len(matched.ids)
    if matched.same_place.max(initial=0) >= MIN_MATCHES:
        pairs = np.count_nonzero(np.triu(matched.same_place))
        match = f"1 pair of the {count} photographs matches"
        if pairs > 1:
            match = f"{pairs} pairs of the {count} photographs match"
        return (
            f"{match} as if all were taken from one place. If they were, add photographs from half a metre to two "
            "metres away; if not, the calibration is wrong, or something moves along and is seen in each, such as a "
            "car or a tripod: "
            f"{advice('moves along')}."
        )
    bare = [name for name, bearings in matched.bearings.items() if len(bearings) < MIN_MATCHES]
    if len(bare) > count - 2:
        return (
            f"{len(bare)} of the {count} photographs, such as {shorten(bare[0])}, show hardly anything that can be "
            "matched, as black, blurred or wholly masked ones do; take sharp photographs in light."
        )
    why = f"the best pair has {matched.counts().max(initial=0)} matches that fit together, but {MIN_MATCHES} are needed"
    if matched.unsure:
        most = max(len(geometry.inlier_matches) for geometry in matched.unsure.values())
        why = f"up to {most} matches of a pair fit together, but as they may where things or places look alike"
    return (
        f"no two of the {count} photographs surely show the same place from two positions: {why}. Take them "
        "closer to each other, half a metre to two metres apart indoors."
    )


def files_of(database: Path) -> tuple[Path, ...]:
    """The files in which ``match_all`` keeps what ``Matched.database`` has."""
    stem = database.name.removesuffix("_whole.db")
    return tuple(sorted(path for path in database.parent.glob(DATABASES) if path.name.startswith(stem)))


@contextmanager
def _database(pycolmap: Any, path: Path) -> Iterator[Any]:
    """COLMAP's database in a file, which is made if it is not there.

    Raises ``InputError`` if it cannot be opened, and ``StoppedError`` if there is no room to write.
    """
    try:
        database = pycolmap.Database.open(str(path))
    except Exception as error:  # pycolmap passes on whatever SQLite raises
        raise InputError(f"{path}: cannot be written ({reason(error)}); {advice('other folder')}.") from None
    try:
        try:
            yield database
        finally:
            database.close()
    except RuntimeError as error:
        if "SQLite" not in str(error):
            raise
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(database))  # to delete what cannot be closed aborts the process
        raise StoppedError(f"{path}: cannot be written ({reason(error)}); {advice('go on')}.") from None


def _key(views: Sequence[View], how: FrontendOptions, fixed: Mapping[Pair, Relative]) -> str:
    """Hash of the images and of all that their matches depend on; it names the database."""
    said: list[object] = [DATABASE_VERSION, VERSION, how.features.method, how.matching.method]
    for view in views:
        status = view.path.stat()
        said += [view.name, status.st_size, status.st_mtime_ns, repr(view.camera)]
        if view.mask is not None:
            said.append(hashlib.sha256(np.packbits(view.usable_pixels()).tobytes()).hexdigest())
    said += [[pair, *(one.tolist() for one in pose)] for pair, pose in sorted(fixed.items())]
    return hashlib.sha256(json.dumps(said).encode()).hexdigest()[:12]


def _usable(camera: Camera, pixels: FloatArray) -> NDArray[np.int64]:
    """Index (K,) of the features that COLMAP can use."""
    if isinstance(camera, Equirectangular):
        return np.arange(len(pixels))
    bearings, seen = camera.unproject(pixels)
    wide: BoolArray = bearings[:, 2] > np.cos(WIDEST_RAD)
    return np.flatnonzero(seen & wide)


def _described(
    pycolmap: Any,
    database: Any,
    views: Sequence[View],
    features: Sequence[Features],
    usable: Sequence[NDArray[np.int64]],
) -> list[int]:
    """Ids of the images in the database, which are added with their features if they are not all there."""
    if database.num_images() == len(views):
        ids = [database.read_image_with_name(view.name).image_id for view in views]
        if all(database.exists_keypoints(number) for number in ids):
            return ids
    database.clear_all_tables()  # a run that was stopped left them half written
    written: dict[str, tuple[int, int]] = {}
    ids = []
    for view, found, index in zip(views, features, usable, strict=True):
        key = repr(view.camera)
        if key not in written:
            written[key] = _camera_in(pycolmap, database, view.camera)
        camera_id, rig_id = written[key]
        image = pycolmap.Image(name=view.name, camera_id=camera_id)
        image.image_id = database.write_image(image)
        frame = pycolmap.Frame()
        frame.rig_id = rig_id
        frame.add_data_id(image.data_id)
        database.write_frame(frame)
        database.write_keypoints(image.image_id, found.pixels[index].astype(np.float32))
        ids.append(image.image_id)
    return ids


def _camera_in(pycolmap: Any, database: Any, camera: Camera) -> tuple[int, int]:
    """Ids of a camera, and of a rig of that camera alone, which are written into the database."""
    name, parameters = colmap_camera(camera)
    described = pycolmap.Camera(model=name, width=camera.width, height=camera.height, params=parameters)
    described.has_prior_focal_length = True  # COLMAP's word for calibrated
    described.camera_id = database.write_camera(described)
    rig = pycolmap.Rig()
    rig.add_ref_sensor(described.sensor_id)
    return described.camera_id, database.write_rig(rig)


def _compared(
    database: Any, ids: Sequence[int], compared: ImagePairs, waiting: Sequence[Pair], tell: Tell
) -> tuple[dict[Pair, Any], dict[Pair, Any], dict[Pair, float]]:
    """The geometry of pairs, that of pairs taken from one place, which is not among it, and how sure the others are.

    The matches are written into the database.
    """
    found: dict[Pair, Any] = {}
    todo = [pair for pair in waiting if not database.exists_matches(*_of(ids, pair))]
    for pair in set(waiting) - set(todo):
        if database.exists_two_view_geometry(*_of(ids, pair)):
            found[pair] = database.read_two_view_geometry(*_of(ids, pair))
    done = len(waiting) - len(todo)
    for pair, (pairs, geometry) in as_completed(lambda pair: compared.compare(*pair), todo):
        if geometry is not None:
            found[pair] = geometry
            database.write_two_view_geometry(*_of(ids, pair), geometry)
        database.write_matches(*_of(ids, pair), pairs)  # last, since it marks the pair as done
        done += 1
        tell("pairs of images matched", done, len(waiting))
    same_place = {pair: found.pop(pair) for pair in sorted(found) if compared.same_place(found[pair])}
    matches = {pair: database.read_matches(*_of(ids, pair)) for pair in found}
    sure = dict(as_completed(lambda pair: compared.sureness(*pair, matches[pair], found[pair]), list(found)))
    return found, same_place, sure


def _with_images_between(
    database: Any,
    ids: Sequence[int],
    compared: ImagePairs,
    agreed: Mapping[Pair, Any],
    same_place: Collection[Pair],
    tell: Tell,
) -> dict[Pair, Any]:
    """The geometry of pairs, and that of more of them by an image between the two, which is written into the
    database."""
    found = dict(agreed)
    known = {pair: relative(geometry) for pair, geometry in found.items()}
    between = {pair: middles for pair, middles in open_triangles(known).items() if pair not in same_place}

    def close(pair: Pair) -> Any:
        return compared.between(pair, matches[pair], known, between[pair])

    matches = {
        pair: database.read_matches(*_of(ids, pair))
        for pair in sorted(between)
        if database.exists_matches(*_of(ids, pair))
    }
    for done, (pair, geometry) in enumerate(as_completed(close, list(matches)), start=1):
        tell("pairs with an image between them matched", done, len(matches))
        if geometry is not None:
            found[pair] = geometry
            if database.exists_two_view_geometry(*_of(ids, pair)):
                database.delete_two_view_geometry(*_of(ids, pair))
            database.write_two_view_geometry(*_of(ids, pair), geometry)
    return found


def _agreeing(found: Mapping[Pair, Any]) -> dict[Pair, Any]:
    """The pairs whose rotations agree with those of the others."""
    rotations = {pair: relative(geometry)[0] for pair, geometry in sorted(found.items())}
    agree = agreeing(rotations, {pair: len(geometry.inlier_matches) for pair, geometry in found.items()})
    return {pair: found[pair] for pair in sorted(agree)}


def _counts(found: Mapping[Pair, Any], size: int) -> NDArray[np.int64]:
    """Number of matches (V, V) of each pair."""
    counts = np.zeros((size, size), np.int64)
    for pair, geometry in found.items():
        counts[pair] = counts[pair[::-1]] = len(geometry.inlier_matches)
    return counts


def _of(ids: Any, pair: tuple[Any, Any]) -> tuple[int, int]:
    return ids[pair[0]], ids[pair[1]]


def _pairs(features: Sequence[Features], neighbours: int, alike: int) -> list[Pair]:
    """The pairs of each image with ``neighbours`` by name on either side, and with the ``alike`` images that look most
    like it."""
    pairs = {(one, other) for one, other in combinations(range(len(features)), 2) if other - one <= neighbours}
    described = [retrieval.real_descriptors(one) for one in features]
    words = retrieval.vocabulary([one for one in described if len(one)])
    vectors = np.stack([retrieval.vlad(one, words) for one in described])
    for index, vector in enumerate(vectors):
        for other in retrieval.rank(vector, vectors)[: alike + 1].tolist():
            if other != index:
                pairs.add((min(index, other), max(index, other)))
    return sorted(pairs)
