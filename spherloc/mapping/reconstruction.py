"""Structure from motion: features and matches of this project, two-view checks and bundle adjustment of COLMAP.

Panoramas stay panoramas: COLMAP's camera EQUIRECTANGULAR. Between two of them a match must fit an essential matrix and
not only a homography: a full sphere sees more than one plane, and matches that fit a single plane may be on a facade, a
poster or a floor that looks the same elsewhere.

Where places look alike, a map may take two for one (see ``model``). A second map is made from the strong pairs alone,
and the one with more images in all its parts, minus a penalty for contradictions, is taken. Where contradictions cut a
map of panoramas, both are made again without the pairs that had joined its parts. Where cameras took images together,
maps of each by itself are another candidate, joined by these images (see ``rig``).
"""

import ctypes
import hashlib
import json
import shutil
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spherloc.cameras.base import Camera
from spherloc.cameras.colmap_models import colmap_camera
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.errors import InputError, StoppedError, reason
from spherloc.frontend import retrieval
from spherloc.frontend.features import VERSION, Features, extract
from spherloc.frontend.pipeline import FrontendOptions
from spherloc.frontend.view import Gravity, View
from spherloc.mapping.advice import advice
from spherloc.mapping.later import with_images
from spherloc.mapping.misplaced import fits, without_misplaced
from spherloc.mapping.model import Reconstruction, parted, registered, untangled, worth
from spherloc.mapping.pairs import MIN_MATCHES, ImagePairs, relative
from spherloc.mapping.parallel import Tell, as_completed
from spherloc.mapping.rig import Shots, joint_of, one_camera, shots_of, went_apart, with_ties
from spherloc.mapping.rotations import agreeing
from spherloc.mapping.triangles import Pair, open_triangles
from spherloc.mapping.upright import level_of
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
ROUNDS = 3
"""Largest number of times that maps are made, each time without the pairs that joined what was cut."""
STRONG = 0.3
"""A strong pair has this share of the matches of the best pair of either image."""
CUT_RAD = float(np.radians(15.0))
"""Largest angle between the rotation of a pair and that of its images in a map that was cut between them, if the pair
says the same as that map: wrong pairs agree with each other less well than right ones."""
Rotations = Mapping[tuple[str, str], FloatArray]
"""Rotations (3, 3) of pairs of images by their names, the second from the first."""
_TRIES = (
    {"init_min_num_inliers": 50, "init_min_tri_angle": 4.0},
    {"init_min_num_inliers": 25, "init_min_tri_angle": 2.0},
    {"init_min_num_inliers": 15, "init_min_tri_angle": 1.0},
)
"""Conditions for the first pair of a model, tried one after another until there is a model."""


def reconstruct(
    views: Sequence[View],
    gravity: Sequence[Gravity | None],
    folder: Path,
    tell: Tell,
    how: FrontendOptions | None = None,
) -> tuple[Reconstruction, ...]:
    """Map images of one camera or several; the database in ``folder`` is kept, and what it has is used again.

    The map with most images comes first, then maps of other images that could not be joined with it.

    ``gravity`` is that from the images' vertical lines, ``how`` the features and their matching, SIFT if it is None.

    Raises ``InputError`` if pycolmap is missing, if an image or the folder cannot be used, or if no two images fit
    together, and ``StoppedError`` if there is no room for the database.
    """
    pycolmap = require("pycolmap", "colmap", "making a map")
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)  # errors are reported here instead
    how = how or FrontendOptions()
    extracted: dict[int, Features] = {}
    for index, found in as_completed(lambda index: extract(views[index], how.features), range(len(views))):
        extracted[index] = found
        tell("images searched for features", len(extracted), len(views))
    features = [extracted[index] for index in range(len(views))]
    usable = [_usable(view.camera, one.pixels) for view, one in zip(views, features, strict=True)]
    path = folder / f"matches_{_key(views, how)}.db"
    with _database(pycolmap, path) as database:
        ids = _described(pycolmap, database, views, features, usable)
        cameras = [view.camera for view in views]
        promising = _pairs(features, NEIGHBOURS_LEARNED, ALIKE_LEARNED) if len(how.features.parts) > 1 else ()
        compared = ImagePairs(pycolmap, cameras, features, usable, gravity, how.matching, frozenset(promising))
        every = len(views) <= MAX_EXHAUSTIVE
        pairs = list(combinations(range(len(views)), 2)) if every else _pairs(features, NEIGHBOURS, ALIKE)
        found, at_one_place, one_thing = _matched(database, ids, compared, pairs, tell)
    whole = path.with_name(f"{path.stem}_whole.db")
    try:
        for left in folder.glob(f"{whole.name}-*"):  # of a run that was killed
            left.unlink()
        shutil.copyfile(path, whole)  # else what follows would be found already when the map is made again
    except OSError as error:
        raise StoppedError(f"{whole}: cannot be written ({reason(error)}); {advice('go on')}.") from None
    with _database(pycolmap, whole) as database:
        between = _with_images_between(database, ids, compared, _agreeing(found), at_one_place, tell)
    every = {**found, **between}
    agreed = _agreeing(between)
    counts, same_place = _counts(agreed, len(views)), _counts(at_one_place, len(views))
    if counts.max(initial=0) < MIN_MATCHES:
        if same_place.max(initial=0) >= MIN_MATCHES:
            raise InputError(
                f"{np.count_nonzero(np.triu(same_place))} pairs of the {len(views)} photographs match as if all were "
                "taken from one place. If they were, add photographs from half a metre to two metres away; if not, "
                "the calibration is wrong, or something moves along and is seen in each, such as a car or a tripod: "
                f"{advice('moves along')}."
            )
        found = f"the best pair has {counts.max(initial=0)} matches that fit together, but {MIN_MATCHES} are needed"
        if one_thing:
            most = max(one_thing.values())
            found = (
                f"up to {most} matches of a pair fit together, but in one part of the view, as of a thing at two places"
            )
        raise InputError(
            f"no two of the {len(views)} photographs surely show the same place from two positions: {found}. Take them "
            "closer to each other, half a metre to two metres apart indoors."
        )
    names = [view.name for view in views]
    turns = {(names[one], names[other]): relative(geometry)[0] for (one, other), geometry in every.items()}
    rotations = {(names[one], names[other]): turns[names[one], names[other]] for one, other in agreed}
    number_of = dict(zip(names, ids, strict=True))
    shots, made, rigid = shots_of(views), list[tuple[Reconstruction, ...]](), ()
    if shots:
        known = {name: one for name, one in zip(names, gravity, strict=True) if one is not None}
        tied = with_ties(counts + same_place, names, shots)
        own = counts * one_camera(names, shots)
        models, _ = _models_of(pycolmap, whole, number_of, (rotations, turns), own, same_place, 0.0, tell)
        if rigid := _joined(models, shots, known, counts, tied):
            made, same_place = [rigid], tied - counts
    for _ in range(ROUNDS):
        cut = set[tuple[str, str]]()
        for keep in (0.0, STRONG):
            models, apart = _models_of(pycolmap, whole, number_of, (rotations, turns), counts, same_place, keep, tell)
            made.append(models)
            cut |= apart
        if not cut or not all(isinstance(view.camera, Equirectangular) for view in views):
            break
        every = {pair: geometry for pair, geometry in every.items() if (names[pair[0]], names[pair[1]]) not in cut}
        agreed = _agreeing(every)
        counts = _counts(agreed, len(views))
        rotations = {(names[one], names[other]): turns[names[one], names[other]] for one, other in agreed}
    candidates = [models for models in made if models]
    if rigid:
        candidates = [models for models in candidates if not any(went_apart(one.poses, shots) for one in models)]
    if not candidates:
        raise InputError(
            f"COLMAP could not start a map from these {len(views)} photographs, although pairs of them match: they "
            "may have been taken from one place. Take them half a metre to two metres apart."
        )
    # Most images in all, then in one map, then those by strong pairs.
    return max(reversed(candidates), key=lambda models: (sum(map(worth, models)), worth(models[0])))


def _models_of(
    pycolmap: Any,
    path: Path,
    number_of: dict[str, int],
    rotations: tuple[Rotations, Rotations],
    counts: NDArray[np.int64],
    same_place: NDArray[np.int64],
    keep: float,
    tell: Tell,
) -> tuple[tuple[Reconstruction, ...], set[tuple[str, str]]]:
    """Models, the largest first, of the pairs with at least the share ``keep`` of the matches of either image's best
    pair, and the pairs that joined what contradictions showed to be apart.

    ``number_of`` are the ids of all images by name, ``rotations`` those of the pairs that agree and of all pairs.
    """
    ids = list(number_of.values())
    with TemporaryDirectory() as folder:  # COLMAP uses all pairs of a database, and writes its models into a folder
        database = Path(folder) / "matches.db"
        shutil.copyfile(path, database)
        best = counts.max(axis=1)
        pairs = combinations(range(len(ids)), 2)
        weak = [pair for pair in pairs if not counts[pair] or counts[pair] < keep * best[list(pair)].max()]
        with pycolmap.Database.open(str(database)) as opened:
            for pair in weak:
                if opened.exists_two_view_geometry(*_of(ids, pair)):
                    opened.delete_two_view_geometry(*_of(ids, pair))
                    opened.delete_matches(*_of(ids, pair))
        models = _models(pycolmap, database, Path(folder), len(ids), tell)
    found, cut = list[Reconstruction](), set[tuple[str, str]]()
    for model in models:
        poses = {image.name: np.asarray(image.cam_from_world().matrix()) for image in registered(model)}
        whole = Reconstruction(model, poses, counts, (), counts + same_place, path, number_of)
        whole = without_misplaced(whole, rotations[0])
        if len(whole.poses) > 1:
            whole = whole.judged()
            parts = parted(whole)
            cut |= _cut(whole, parts, rotations[1])
            found += parts
    return untangled(found), cut


def _cut(whole: Reconstruction, parts: Sequence[Reconstruction], rotations: Rotations) -> set[tuple[str, str]]:
    """Those pairs of images in different parts of a model whose rotations (3, 3) put them where that had them."""
    part_of = {name: number for number, part in enumerate(parts) for name in part.poses}
    return {
        (one, other)
        for (one, other), rotation in rotations.items()
        if one in part_of
        and other in part_of
        and part_of[one] != part_of[other]
        and fits(whole.poses[one], whole.poses[other], rotation, CUT_RAD)
    }


def _joined(
    models: Sequence[Reconstruction],
    shots: Shots,
    gravity: Mapping[str, Gravity],
    counts: NDArray[np.int64],
    tied: NDArray[np.int64],
) -> tuple[Reconstruction, ...]:
    """Models of single cameras, joined where these took images together; none if no two are joined.

    ``gravity`` is that of images by name, ``counts`` and ``tied`` (V, V) the numbers of matches of all pairs, the
    latter with those taken from one place or together.
    """
    left = [replace(one, matches=counts, all_matches=tied) for one in models]
    joined: list[Reconstruction] = []
    while left:
        whole = left.pop(0)
        for other in list(left):
            try:
                downs = level_of(whole.poses, gravity).down, level_of(other.poses, gravity).down
            except InputError:  # its images do not agree on where down is
                continue
            joint = joint_of(whole.poses, other.poses, downs, shots)
            if joint is not None:
                more = {name: pose for name, pose in joint.poses.items() if name not in whole.poses}
                whole = replace(with_images(whole.without(joint.misfits), more), joined=True)
                left.remove(other)
        joined.append(whole)
    return untangled(joined) if len(joined) < len(models) else ()


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


def _key(views: Sequence[View], how: FrontendOptions) -> str:
    """Hash of the images and of all that their matches depend on; it names the database."""
    said = [DATABASE_VERSION, VERSION, how.features.method, how.matching.method]
    for view in views:
        status = view.path.stat()
        said += [view.name, status.st_size, status.st_mtime_ns, repr(view.camera)]
        if view.mask is not None:
            said.append(hashlib.sha256(np.packbits(view.usable_pixels()).tobytes()).hexdigest())
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


def _matched(
    database: Any, ids: Sequence[int], compared: ImagePairs, waiting: Sequence[Pair], tell: Tell
) -> tuple[dict[Pair, Any], dict[Pair, Any], dict[Pair, int]]:
    """The geometry of pairs, that of pairs taken from one place, and the numbers of matches of pairs that may show one
    thing at two places, which are in neither.

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
    one_thing = {
        pair: len(geometry.inlier_matches)
        for pair, geometry in found.items()
        if compared.on_one_thing(*pair, database.read_matches(*_of(ids, pair)), geometry)
    }
    return {pair: found[pair] for pair in found if pair not in one_thing}, same_place, one_thing


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


def _of(ids: Sequence[int], pair: tuple[int, int]) -> tuple[int, int]:
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


def _models(pycolmap: Any, database: Path, folder: Path, count: int, tell: Tell) -> list[Any]:
    """COLMAP's models, the one with most images first; none if it finds no first pair."""
    options = pycolmap.IncrementalPipelineOptions()
    options.min_num_matches, options.min_model_size, options.random_seed = MIN_MATCHES, 2, 0
    options.num_threads = 1  # with more threads every run gives another map
    options.ba_refine_focal_length = options.ba_refine_extra_params = options.extract_colors = False
    mapper = options.mapper
    mapper.abs_pose_refine_focal_length = mapper.abs_pose_refine_extra_params = False
    mapper.abs_pose_min_num_inliers, mapper.abs_pose_min_inlier_ratio = MIN_MATCHES, 0.05
    # COLMAP starts with no pair that moved along the optical axis, where a narrow lens sees no depth; a wide one does.
    mapper.init_max_forward_motion = 1.0
    options.triangulation.ignore_two_view_tracks = False
    models: list[Any] = []
    for first_pair in _TRIES:
        for key, value in first_pair.items():
            setattr(mapper, key, value)
        found = _mapped(pycolmap, database, folder, options, lambda done: tell("images mapped", done, count))
        models = sorted(found.values(), key=lambda model: -model.num_reg_images())
        if models and models[0].num_reg_images() > count / 2:
            break
    return models


def _mapped(pycolmap: Any, database: Path, folder: Path, options: Any, tell: Callable[[int], None]) -> dict[int, Any]:
    """COLMAP's mapper, in a thread so that Ctrl-C ends it."""
    stop, done = pycolmap.CancellationToken(), 0

    def another() -> None:
        nonlocal done
        done += 1
        tell(done)

    with ThreadPoolExecutor(1) as pool:
        job = pool.submit(
            pycolmap.incremental_mapping,
            str(database),
            str(folder),
            str(folder),
            options,
            next_image_callback=another,
            cancellation_token=stop,
        )
        try:
            while not wait([job], timeout=0.2).done:
                pass
        except KeyboardInterrupt:
            stop.cancel()
            raise
        return job.result()
