"""Structure from motion: features and matches of this project, two-view checks and bundle adjustment of COLMAP.

Panoramas stay panoramas: COLMAP's camera EQUIRECTANGULAR. Between two of them a match must fit an essential matrix and
not only a homography: a full sphere sees more than one plane, and what fits one plane alone is a facade, a poster or a
floor that looks the same elsewhere.

Places that look alike (two hotel rooms, a row of houses) give matches that fit all the same. A map that takes them for
one place puts photographs side by side that have hardly a match. So a second map is made of the strong pairs alone, and
the one that explains more images, less those contradictions, is taken.
"""

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from itertools import combinations
from math import tau
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spherloc.cameras.base import Camera
from spherloc.cameras.colmap_models import colmap_camera
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.errors import InputError, reason
from spherloc.frontend import retrieval
from spherloc.frontend.features import VERSION, FeatureOptions, Features, extract
from spherloc.frontend.matching import match
from spherloc.frontend.view import View
from spherloc.geometry import camera_centre
from spherloc.registry import require
from spherloc.types import BoolArray, FloatArray

Tell = Callable[[str, int, int], None]
"""Told of each piece of work that is done: its kind in the plural, how many are done, how many there are."""

DATABASE_VERSION = 4
"""Raised when pairs are matched or checked in another way."""
MIN_MATCHES = 15
"""Of a pair of images, after the two-view check."""
BOUND_RAD = np.radians(0.5)
"""Of a match to its epipolar plane; in pixels it is kept within ``BOUND_PX``."""
BOUND_PX = 1.5, 6.0
ONE_PLACE_RAD = np.radians(0.5)
"""Rays of a match that differ by less: two images from one place, which tell nothing of depth."""
MAX_EXHAUSTIVE = 50
"""Images of which all pairs are tried; of more, each with its neighbours by name and with those that look alike."""
NEIGHBOURS, ALIKE = 5, 15
WIDEST_RAD = np.radians(85.0)
"""Features farther from the optical axis are left out: COLMAP's fisheyes end at 90 degrees."""
STRONG = 0.3
"""A strong pair has this share of the matches of the best pair of either image."""
NEARBY = 2
"""Images next to one in the map, that should match it."""
MIN_SUPPORT = 0.15
"""Share of the matches of the best pair of either image that two nearby images have; with less they contradict."""
COST_OF_CONTRADICTION = 4.0
"""Share of the images that a map is worth less for each share of contradictions."""
_TRIES = (
    {"init_min_num_inliers": 50, "init_min_tri_angle": 4.0},
    {"init_min_num_inliers": 25, "init_min_tri_angle": 2.0},
    {"init_min_num_inliers": 15, "init_min_tri_angle": 1.0},
)
"""What the first pair of a model must have, in turn until there is a model."""


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """The largest model that COLMAP could make."""

    model: Any
    """``pycolmap.Reconstruction``."""
    poses: dict[str, FloatArray]
    """Poses (3, 4) from the model's frame, which has no scale and no up, by name of a registered image."""
    matches: NDArray[np.int64]
    """(V, V) matches of each pair of images after the two-view check."""
    other_groups: tuple[tuple[str, ...], ...]
    """Names of images that fit together, but could not be joined with the rest."""
    contradictions: tuple[tuple[str, str], ...]
    """Names of images that the model puts side by side although they hardly match."""

    def without(self, names: Collection[str]) -> "Reconstruction":
        """The same with fewer images; points that fewer than two others see are gone."""
        for number in list(self.model.reg_image_ids()):
            image = self.model.image(number)
            if image.name in names:
                self.model.deregister_frame(image.frame_id)
        poses = {name: pose for name, pose in self.poses.items() if name not in names}
        against = tuple(pair for pair in self.contradictions if not set(pair) & set(names))
        return replace(self, poses=poses, contradictions=against)

    def points(self) -> FloatArray:
        """(N, 3) in the frame that the model has now."""
        return np.array([point.xyz for point in self.model.points3D.values()]).reshape(-1, 3)


def reconstruct(views: Sequence[View], folder: Path, tell: Tell) -> Reconstruction:
    """Map images of one camera; the database in ``folder`` is kept, and what is in it is not done again.

    Raises ``InputError`` if pycolmap is missing, if an image or the folder cannot be used, or if no two images fit
    together.
    """
    pycolmap = require("pycolmap", "colmap", "making a map")
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)  # what fails is said here
    camera = views[0].camera
    features = []
    for view in views:
        features.append(extract(view))
        tell("images searched for features", len(features), len(views))
    usable = [_usable(camera, one.pixels) for one in features]
    path = folder / f"matches_{_key(views)}.db"
    try:
        database = pycolmap.Database.open(str(path))
    except Exception as error:  # pycolmap raises whatever SQLite says
        raise InputError(f"{path}: cannot be written ({reason(error)}); give another --output.") from None
    try:
        ids = _described(pycolmap, database, views, features, usable)
        counts, same_place = _matched(pycolmap, database, ids, camera, features, usable, tell)
    finally:
        database.close()
    if counts.max(initial=0) < MIN_MATCHES:
        raise InputError(
            f"no two of the {len(views)} photographs show the same place from two positions: the best pair has "
            f"{counts.max(initial=0)} matches that fit together, of {MIN_MATCHES} that are needed. Take them closer "
            "to each other, half a metre to two metres apart indoors."
        )
    names = [view.name for view in views]
    made = [_best_model(pycolmap, path, names, ids, counts, same_place, keep, tell) for keep in (0.0, STRONG)]
    candidates = [one for one in made if one is not None]
    if not candidates:
        raise InputError(
            f"COLMAP could not start a map from these {len(views)} photographs, although pairs of them match: they "
            "may have been taken from one place. Take them half a metre to two metres apart."
        )
    return max(candidates, key=_worth)


def _best_model(
    pycolmap: Any,
    path: Path,
    names: Sequence[str],
    ids: Sequence[int],
    counts: NDArray[np.int64],
    same_place: NDArray[np.int64],
    keep: float,
    tell: Tell,
) -> Reconstruction | None:
    """The largest model of the pairs with at least the share ``keep`` of the matches of either image's best pair."""
    with TemporaryDirectory() as folder:  # COLMAP takes all pairs of a database, and writes its models itself, too
        database = Path(folder) / "matches.db"
        shutil.copyfile(path, database)
        best = counts.max(axis=1)
        pairs = combinations(range(len(ids)), 2)
        weak = [pair for pair in pairs if not counts[pair] or counts[pair] < keep * best[list(pair)].max()]
        with pycolmap.Database.open(str(database)) as opened:
            for pair in weak:
                if counts[pair] or same_place[pair]:
                    opened.delete_two_view_geometry(*_of(ids, pair))
                    opened.delete_matches(*_of(ids, pair))
        models = _models(pycolmap, database, Path(folder), len(ids), tell)
    if not models:
        return None
    poses = {image.name: np.asarray(image.cam_from_world().matrix()) for image in _registered(models[0])}
    groups = [tuple(sorted(image.name for image in _registered(model))) for model in models[1:]]
    left = [tuple(name for name in group if name not in poses) for group in groups]
    against = _contradictions(poses, names, counts + same_place)
    return Reconstruction(models[0], poses, counts, tuple(group for group in left if group), against)


def _worth(made: Reconstruction) -> float:
    share = len(made.contradictions) / (NEARBY * len(made.poses))
    return len(made.poses) * (1.0 - COST_OF_CONTRADICTION * share)


def _contradictions(
    poses: Mapping[str, FloatArray], names: Sequence[str], counts: NDArray[np.int64]
) -> tuple[tuple[str, str], ...]:
    """Images and those next to them that hardly match."""
    inside = [index for index, name in enumerate(names) if name in poses]
    centres = np.stack([camera_centre(poses[names[index]]) for index in inside])
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    best = counts.max(axis=1)
    found = []
    for row, index in enumerate(inside):
        for place in np.argsort(apart[row])[: min(NEARBY, len(inside) - 1)]:
            other = inside[int(place)]
            if counts[index, other] < MIN_SUPPORT * min(best[index], best[other]):
                found.append((names[index], names[other]))
    return tuple(found)


def _registered(model: Any) -> list[Any]:
    return [model.image(number) for number in model.reg_image_ids()]


def _key(views: Sequence[View]) -> str:
    """Of the images and of all that their matches depend on: another key is another database."""
    said = [DATABASE_VERSION, VERSION, FeatureOptions().method, repr(views[0].camera)]
    for view in views:
        status = view.path.stat()
        said += [view.name, status.st_size, status.st_mtime_ns]
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
    """Ids of the images in the database, where they are now if they were not."""
    if database.num_images():
        return [database.read_image_with_name(view.name).image_id for view in views]
    name, parameters = colmap_camera(views[0].camera)
    width, height = views[0].camera.width, views[0].camera.height
    camera = pycolmap.Camera(model=name, width=width, height=height, params=parameters)
    camera.has_prior_focal_length = True  # calibrated, that means
    camera.camera_id = database.write_camera(camera)
    rig = pycolmap.Rig()
    rig.add_ref_sensor(camera.sensor_id)
    rig_id = database.write_rig(rig)
    ids = []
    for view, found, index in zip(views, features, usable, strict=True):
        image = pycolmap.Image(name=view.name, camera_id=camera.camera_id)
        image.image_id = database.write_image(image)
        frame = pycolmap.Frame()
        frame.rig_id = rig_id
        frame.add_data_id(image.data_id)
        database.write_frame(frame)
        database.write_keypoints(image.image_id, found.pixels[index].astype(np.float32))
        ids.append(image.image_id)
    return ids


def _matched(
    pycolmap: Any,
    database: Any,
    ids: Sequence[int],
    camera: Camera,
    features: Sequence[Features],
    usable: Sequence[NDArray[np.int64]],
    tell: Tell,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Matches (V, V) of each pair of images that fit two poses, and (V, V) of pairs that were taken from one place.

    They are in the database then.
    """
    height = round(np.pi * _focal_px(camera))
    sphere = Equirectangular(2 * height, height)
    options = pycolmap.TwoViewGeometryOptions()
    options.min_num_inliers = MIN_MATCHES
    options.ransac.max_error = float(np.clip(BOUND_RAD * sphere.width / tau, *BOUND_PX))
    options.ransac.random_seed = 0
    # Whatever the lens, bearings are compared: of fisheyes COLMAP would ask for fundamental matrices, too.
    panorama = pycolmap.Camera(
        model="EQUIRECTANGULAR", width=sphere.width, height=sphere.height, params=[sphere.width, sphere.height]
    )
    pixels = [
        sphere.project(camera.unproject(found.pixels[index])[0])[0]
        for found, index in zip(features, usable, strict=True)
    ]
    number_of = [np.full(len(found), -1) for found in features]
    for numbers, index in zip(number_of, usable, strict=True):
        numbers[index] = np.arange(len(index))

    kinds = pycolmap.TwoViewGeometryConfiguration
    options.compute_relative_pose = True  # for the angle between the rays of a match

    def fits(geometry: Any) -> bool:
        if geometry.config == kinds.PLANAR:
            return geometry.tri_angle < ONE_PLACE_RAD
        return geometry.config in (kinds.CALIBRATED, kinds.PANORAMIC)

    def verified(first: int, second: int) -> tuple[NDArray[np.uint32], Any]:
        found = match(features[first], features[second])
        pairs = np.column_stack([number_of[first][found.query_index], number_of[second][found.reference_index]])
        pairs = pairs[(pairs >= 0).all(axis=1)].astype(np.uint32)
        if len(pairs) < MIN_MATCHES:
            return pairs, None
        geometry = pycolmap.estimate_calibrated_two_view_geometry(
            panorama, pixels[first], panorama, pixels[second], pairs, options
        )
        return pairs, geometry if fits(geometry) else None

    counts, same_place = np.zeros((2, len(ids), len(ids)), np.int64)

    def count(pair: tuple[int, int], geometry: Any) -> None:
        (counts if geometry.config == kinds.CALIBRATED else same_place)[pair] = len(geometry.inlier_matches)

    waiting, done = _pairs(features), 0
    todo = [pair for pair in waiting if not database.exists_matches(*_of(ids, pair))]
    for pair in set(waiting) - set(todo):
        if database.exists_two_view_geometry(*_of(ids, pair)):
            count(pair, database.read_two_view_geometry(*_of(ids, pair)))
        done += 1
    with ThreadPoolExecutor(_workers()) as pool:
        for pair, (pairs, geometry) in _as_completed(pool, verified, todo):
            if geometry is not None:
                count(pair, geometry)
                database.write_two_view_geometry(*_of(ids, pair), geometry)
            database.write_matches(*_of(ids, pair), pairs)  # last: it says that the pair is done
            done += 1
            tell("pairs of images matched", done, len(waiting))
    return counts + counts.T, same_place + same_place.T


def _as_completed(
    pool: ThreadPoolExecutor, work: Callable[[int, int], Any], pairs: Sequence[tuple[int, int]]
) -> Iterator[tuple[tuple[int, int], Any]]:
    """Results as they come; few are begun ahead, so that Ctrl-C need not wait for all."""
    running: dict[Future[Any], tuple[int, int]] = {}
    left = iter(pairs)
    while True:
        while len(running) < 2 * _workers() and (pair := next(left, None)) is not None:
            running[pool.submit(work, *pair)] = pair
        if not running:
            return
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            yield running.pop(future), future.result()


def _workers() -> int:
    return max(1, min(4, os.cpu_count() or 1))


def _of(ids: Sequence[int], pair: tuple[int, int]) -> tuple[int, int]:
    return ids[pair[0]], ids[pair[1]]


def _focal_px(camera: Camera) -> float:
    """Pixels a radian in the middle of the image."""
    ahead = np.array([[0.0, 0.0, 1.0], [1e-3, 0.0, 1.0]])
    pixels, _ = camera.project(ahead)
    return float(np.linalg.norm(pixels[1] - pixels[0]) / 1e-3)


def _pairs(features: Sequence[Features]) -> list[tuple[int, int]]:
    """Which pairs of images are matched."""
    count = len(features)
    if count <= MAX_EXHAUSTIVE:
        return list(combinations(range(count), 2))
    pairs = {(first, second) for first, second in combinations(range(count), 2) if second - first <= NEIGHBOURS}
    described = [retrieval.real_descriptors(one) for one in features]
    words = retrieval.vocabulary([one for one in described if len(one)])
    vectors = np.stack([retrieval.vlad(one, words) for one in described])
    for index, vector in enumerate(vectors):
        for other in retrieval.rank(vector, vectors)[: ALIKE + 1].tolist():
            if other != index:
                pairs.add((min(index, other), max(index, other)))
    return sorted(pairs)


def _models(pycolmap: Any, database: Path, folder: Path, count: int, tell: Tell) -> list[Any]:
    """COLMAP's models, the one with most images first; none if it finds no first pair."""
    options = pycolmap.IncrementalPipelineOptions()
    options.min_num_matches, options.min_model_size, options.random_seed = MIN_MATCHES, 2, 0
    options.num_threads = 1  # else every run gives another map
    options.ba_refine_focal_length = options.ba_refine_extra_params = options.extract_colors = False
    mapper = options.mapper
    mapper.abs_pose_refine_focal_length = mapper.abs_pose_refine_extra_params = False
    mapper.abs_pose_min_num_inliers, mapper.abs_pose_min_inlier_ratio = MIN_MATCHES, 0.05
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
