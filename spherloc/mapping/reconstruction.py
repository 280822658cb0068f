"""Structure from motion: features and matches of this project, two-view checks and bundle adjustment of COLMAP.

Panoramas stay panoramas: COLMAP's camera EQUIRECTANGULAR. Between two of them a match must fit an essential matrix and
not only a homography: a full sphere sees more than one plane, and matches that fit a single plane may be on a facade, a
poster or a floor that looks the same elsewhere.

Places that look alike (two hotel rooms, a row of houses) give wrong matches that fit a pose. A map that takes such
places for one puts photographs next to each other that have hardly a match although nothing is between them: a
contradiction. The map is then cut where fewest matches connect it. A second map is made from the strong pairs alone,
and the map with more images, minus a penalty for contradictions, is taken.
"""

import copy
import ctypes
import hashlib
import json
import shutil
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import networkx as nx
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
from spherloc.geometry import camera_centre
from spherloc.mapping.advice import advice
from spherloc.mapping.pairs import MIN_MATCHES, ImagePairs, relative
from spherloc.mapping.parallel import as_completed
from spherloc.mapping.rotations import agreeing
from spherloc.mapping.triangles import Pair, open_triangles
from spherloc.mapping.upright import Tell
from spherloc.registry import require
from spherloc.types import BoolArray, FloatArray

DATABASE_VERSION = 6
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
STRONG = 0.3
"""A strong pair has this share of the matches of the best pair of either image."""
NEARBY = 2
"""Number of nearest images in the map that should match an image."""
MIN_SUPPORT = 0.15
"""Least number of matches of two nearby images, as a share of those of either image's best pair; fewer contradict."""
SIGHT_RAD, SIGHT_POINTS, SIGHT_FACTOR = np.radians(25.0), 8, 1.2
"""An image sees past another camera if it has at least the second number of points within the first angle around the
direction of that camera, and half of them are farther away than the camera by the third factor."""
COST_OF_CONTRADICTION = 4.0
"""Weight of the share of contradictions when two maps are compared by their share of images."""
_TRIES = (
    {"init_min_num_inliers": 50, "init_min_tri_angle": 4.0},
    {"init_min_num_inliers": 25, "init_min_tri_angle": 2.0},
    {"init_min_num_inliers": 15, "init_min_tri_angle": 1.0},
)
"""Conditions for the first pair of a model, tried one after another until there is a model."""


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """A model that COLMAP could make."""

    model: Any
    """``pycolmap.Reconstruction``."""
    poses: dict[str, FloatArray]
    """Poses (3, 4) from the model's frame, which has no scale and no up, by name of a registered image."""
    matches: NDArray[np.int64]
    """(V, V) number of matches of each pair of images after the two-view check."""
    contradictions: tuple[tuple[str, str], ...]
    """Names of pairs of images that the model puts next to each other and in sight of each other, but that hardly
    match."""
    all_matches: NDArray[np.int64]
    """(V, V) like ``matches``, but with pairs of images that were taken from one place."""
    database: Path
    """COLMAP's database with features and matches of all images."""
    ids: dict[str, int]
    """Ids of all images in the database, by name."""

    def without(self, names: Collection[str]) -> "Reconstruction":
        """The model without the images ``names``, and without points that fewer than two of the other images see."""
        for number in list(self.model.reg_image_ids()):
            image = self.model.image(number)
            if image.name in names:
                self.model.deregister_frame(image.frame_id)
        poses = {name: pose for name, pose in self.poses.items() if name not in names}
        against = tuple(pair for pair in self.contradictions if not set(pair) & set(names))
        return replace(self, poses=poses, contradictions=against)

    def judged(self) -> "Reconstruction":
        """The model with its contradictions computed anew."""
        against = contradictions(self.poses, list(self.ids), self.all_matches, points_of(self.model))
        return replace(self, contradictions=against)

    def points(self) -> FloatArray:
        """Positions (N, 3) of the points in the model's present frame."""
        return np.array([point.xyz for point in self.model.points3D.values()]).reshape(-1, 3)

    def depths(self) -> FloatArray:
        """Distance (N,) of each point to an image that sees it, in units of the model's present frame."""
        centres = {number: self.model.image(number).projection_center() for number in self.model.reg_image_ids()}
        points = self.model.points3D.values()
        seen_from = [centres[point.track.elements[0].image_id] for point in points]
        return np.linalg.norm(self.points() - np.reshape(seen_from, (-1, 3)), axis=1)


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
    try:
        database = pycolmap.Database.open(str(path))
    except Exception as error:  # pycolmap passes on whatever SQLite raises
        raise InputError(f"{path}: cannot be written ({reason(error)}); {advice('other folder')}.") from None
    try:
        try:
            ids = _described(pycolmap, database, views, features, usable)
            cameras = [view.camera for view in views]
            promising = _pairs(features, NEIGHBOURS_LEARNED, ALIKE_LEARNED) if len(how.features.parts) > 1 else ()
            compared = ImagePairs(pycolmap, cameras, features, usable, gravity, how.matching, frozenset(promising))
            every = len(views) <= MAX_EXHAUSTIVE
            pairs = list(combinations(range(len(views)), 2)) if every else _pairs(features, NEIGHBOURS, ALIKE)
            counts, same_place = _matched(database, ids, compared, pairs, tell)
        finally:
            database.close()
    except RuntimeError as error:
        if "SQLite" not in str(error):
            raise
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(database))  # to delete what cannot be closed aborts the process
        raise StoppedError(f"{path}: cannot be written ({reason(error)}); {advice('go on')}.") from None
    if counts.max(initial=0) < MIN_MATCHES:
        if same_place.max(initial=0) >= MIN_MATCHES:
            raise InputError(
                f"{np.count_nonzero(np.triu(same_place))} pairs of the {len(views)} photographs match as if all were "
                "taken from one place. If they were, add photographs from half a metre to two metres away; if not, "
                "the calibration is wrong, or something moves along and is seen in each, such as a car or a tripod: "
                f"{advice('moves along')}."
            )
        raise InputError(
            f"no two of the {len(views)} photographs show the same place from two positions: the best pair has "
            f"{counts.max(initial=0)} matches that fit together, but {MIN_MATCHES} are needed. Take them closer "
            "to each other, half a metre to two metres apart indoors."
        )
    names = [view.name for view in views]
    made = [_models_of(pycolmap, path, names, ids, counts, same_place, keep, tell) for keep in (0.0, STRONG)]
    candidates = [one for one in made if one]
    if not candidates:
        raise InputError(
            f"COLMAP could not start a map from these {len(views)} photographs, although pairs of them match: they "
            "may have been taken from one place. Take them half a metre to two metres apart."
        )
    return max(candidates, key=lambda one: _worth(one[0]))


def _models_of(
    pycolmap: Any,
    path: Path,
    names: Sequence[str],
    ids: Sequence[int],
    counts: NDArray[np.int64],
    same_place: NDArray[np.int64],
    keep: float,
    tell: Tell,
) -> tuple[Reconstruction, ...]:
    """Models, the largest first, of the pairs with at least the share ``keep`` of the matches of either image's best
    pair."""
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
    number_of = dict(zip(names, ids, strict=True))
    found = []
    for model in models:
        poses = {image.name: np.asarray(image.cam_from_world().matrix()) for image in _registered(model)}
        whole = Reconstruction(model, poses, counts, (), counts + same_place, path, number_of)
        found += parted(whole.judged())
    return untangled(found)


def parted(made: Reconstruction) -> list[Reconstruction]:
    """The model cut until no two images contradict each other: parts of two images or more, the largest first.

    A contradiction says that two images do not belong next to each other, so somewhere between them the model takes two
    similar places for one. The cut that separates the two images with the fewest matches is made there.
    """
    if not made.contradictions:
        return [made]
    place = {name: index for index, name in enumerate(made.ids)}
    graph = nx.Graph()
    graph.add_nodes_from(made.poses)
    for one, other in combinations(made.poses, 2):
        if matches := int(made.all_matches[place[one], place[other]]):
            graph.add_edge(one, other, capacity=matches)
    cuts = [nx.minimum_cut(graph, *pair) for pair in sorted(set(map(_sorted, made.contradictions)))]
    _, (first, second) = min(cuts, key=lambda cut: cut[0])
    parts = []
    for side in (first, second):
        if len(made.poses.keys() - side) > 1:
            part = replace(made, model=copy.deepcopy(made.model)).without(side)
            parts += parted(part.judged())
    return sorted(parts, key=lambda part: -len(part.poses))


def _sorted(pair: tuple[str, str]) -> tuple[str, str]:
    return (min(pair), max(pair))


def untangled(made: Sequence[Reconstruction]) -> tuple[Reconstruction, ...]:
    """The models without images that have more matches with those of another one, the largest first.

    Models that share images and yet could not be joined take two places for one somewhere. A shared image belongs to
    the model with which it has most matches.
    """
    if len(made) < 2:
        return tuple(made)
    place = {name: index for index, name in enumerate(made[0].ids)}
    members = [set(one.poses) for one in made]
    changed = True
    while changed:
        changed = False
        for name in place:
            ties = [
                int(made[0].all_matches[place[name], [place[one] for one in group - {name}]].sum()) for group in members
            ]
            for group, tie in zip(members, ties, strict=True):
                if name in group and tie < max(ties):
                    group.remove(name)
                    changed = True
    left = [one.without(one.poses.keys() - group) for one, group in zip(made, members, strict=True) if len(group) > 1]
    return tuple(sorted(left, key=lambda one: -len(one.poses)))


def _worth(made: Reconstruction) -> float:
    share = len(made.contradictions) / (NEARBY * len(made.poses))
    return len(made.poses) * (1.0 - COST_OF_CONTRADICTION * share)


def contradictions(
    poses: Mapping[str, FloatArray],
    names: Sequence[str],
    counts: NDArray[np.int64],
    points: Mapping[str, FloatArray],
) -> tuple[tuple[str, str], ...]:
    """Pairs of neighbouring images of ``poses``, in sight of each other, that hardly match.

    ``counts`` (V, V) are the numbers of matches of all ``names``, ``points`` (K, 3) the points that each image sees.
    """
    inside = [index for index, name in enumerate(names) if name in poses]
    centres = np.stack([camera_centre(poses[names[index]]) for index in inside])
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    best = counts.max(axis=1)
    found = []
    for row, index in enumerate(inside):
        for place in np.argsort(apart[row])[: min(NEARBY, len(inside) - 1)]:
            other = inside[int(place)]
            if counts[index, other] >= MIN_SUPPORT * min(best[index], best[other]):
                continue
            here, there = centres[row], centres[int(place)]
            if _sees_past(points[names[index]], here, there) and _sees_past(points[names[other]], there, here):
                found.append((names[index], names[other]))
    return tuple(found)


def _sees_past(points: FloatArray, centre: FloatArray, other: FloatArray) -> bool:
    """Whether the points (K, 3) that a camera at ``centre`` sees in the direction of another camera lie behind it.

    With a wall between the two cameras they would lie in front of it; such cameras need not match.
    """
    rays, way = points - centre, other - centre
    depth, distance = np.linalg.norm(rays, axis=1), float(np.linalg.norm(way))
    near = rays @ way > np.cos(SIGHT_RAD) * depth * distance
    return bool(np.count_nonzero(near) >= SIGHT_POINTS and np.median(depth[near]) > SIGHT_FACTOR * distance)


def points_of(model: Any) -> dict[str, FloatArray]:
    """The points (K, 3) that each image of a model sees, by its name."""
    found = {}
    for image in _registered(model):
        ids = [point.point3D_id for point in image.points2D if point.has_point3D()]
        found[image.name] = np.array([model.point3D(one).xyz for one in ids]).reshape(-1, 3)
    return found


def _registered(model: Any) -> list[Any]:
    return [model.image(number) for number in model.reg_image_ids()]


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
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Numbers of matches (V, V) of each pair that fit a relative pose, and the same of pairs taken from one place.

    The matches are written into the database. Pairs whose rotation disagrees with others have none.
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
    found = {
        pair: geometry
        for pair, geometry in found.items()
        if not compared.on_one_thing(*pair, database.read_matches(*_of(ids, pair)), geometry)
    }
    found = _agreeing(found)
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
    return _counts(_agreeing(found), len(ids)), _counts(same_place, len(ids))


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
