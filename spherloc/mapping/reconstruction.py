"""Structure from motion: features and matches of this project, two-view checks and bundle adjustment of COLMAP.

Panoramas stay panoramas: COLMAP's camera EQUIRECTANGULAR. Between two of them a match must fit an essential matrix and
not only a homography: a full sphere sees more than one plane, and what fits one plane alone is a facade, a poster or a
floor that looks the same elsewhere.
"""

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
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
from spherloc.registry import require
from spherloc.types import BoolArray, FloatArray

Tell = Callable[[str, int, int], None]
"""Told of each piece of work that is done: its kind in the plural, how many are done, how many there are."""

LEAST_MATCHES = 15
"""Of a pair of images, after the two-view check."""
BOUND_RAD = np.radians(0.5)
"""Of a match to its epipolar plane; in pixels it is kept within ``BOUND_PX``."""
BOUND_PX = 1.5, 6.0
MOST_EXHAUSTIVE = 50
"""Images of which all pairs are tried; of more, each with its neighbours by name and with those that look alike."""
NEIGHBOURS, ALIKE = 5, 15
WIDEST_RAD = np.radians(85.0)
"""Features farther from the optical axis are left out: COLMAP's fisheyes end at 90 degrees."""
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

    def points(self) -> FloatArray:
        """(N, 3) in the frame that the model has now."""
        return np.array([point.xyz for point in self.model.points3D.values()]).reshape(-1, 3)


def reconstruct(views: Sequence[View], folder: Path, tell: Tell) -> Reconstruction:
    """Map images of one camera; the database in ``folder`` is kept, and what is in it is not done again.

    Raises ``InputError`` if pycolmap is missing, if an image or the folder cannot be used, or if no two images fit
    together.
    """
    pycolmap = require("pycolmap", "colmap", "making a map")
    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)
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
        counts = _matched(pycolmap, database, ids, features, usable, tell)
    finally:
        database.close()
    if counts.max(initial=0) < LEAST_MATCHES:
        raise InputError(
            f"no two of the {len(views)} photographs show the same place from two positions: the best pair has "
            f"{counts.max(initial=0)} matches that fit together, of {LEAST_MATCHES} that are needed. Take them closer "
            "to each other, half a metre to two metres apart indoors."
        )
    models = _models(pycolmap, path, len(views), tell)
    if not models:
        raise InputError(
            f"COLMAP could not start a map from these {len(views)} photographs, although pairs of them match: they "
            "may have been taken from one place. Take them half a metre to two metres apart."
        )
    best = models[0]
    poses = {image.name: np.asarray(image.cam_from_world().matrix()) for image in _registered(best)}
    groups = [tuple(sorted(image.name for image in _registered(model))) for model in models[1:]]
    left = tuple(tuple(name for name in group if name not in poses) for group in groups)
    return Reconstruction(best, poses, counts, tuple(group for group in left if group))


def _registered(model: Any) -> list[Any]:
    return [model.image(number) for number in model.reg_image_ids()]


def _key(views: Sequence[View]) -> str:
    """Of the images and of all that their matches depend on: another key is another database."""
    said = [VERSION, FeatureOptions().method, repr(views[0].camera)]
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
    features: Sequence[Features],
    usable: Sequence[NDArray[np.int64]],
    tell: Tell,
) -> NDArray[np.int64]:
    """Matches of each pair of images that fit a pair of poses (V, V), which are in the database then."""
    camera = database.read_all_cameras()[0]
    options = pycolmap.TwoViewGeometryOptions()
    options.min_num_inliers = LEAST_MATCHES
    options.ransac.max_error = float(np.clip(BOUND_RAD * _focal_px(features[0]), *BOUND_PX))
    options.ransac.random_seed = 0
    whole = camera.model.name == "EQUIRECTANGULAR"
    fitting = {pycolmap.TwoViewGeometryConfiguration.CALIBRATED}
    if not whole:
        fitting.add(pycolmap.TwoViewGeometryConfiguration.PLANAR)
    pixels = [found.pixels[index] for found, index in zip(features, usable, strict=True)]
    number_of = [np.full(len(found), -1) for found in features]
    for numbers, index in zip(number_of, usable, strict=True):
        numbers[index] = np.arange(len(index))

    def verified(first: int, second: int) -> tuple[NDArray[np.uint32], Any]:
        found = match(features[first], features[second])
        pairs = np.column_stack([number_of[first][found.query_index], number_of[second][found.reference_index]])
        pairs = pairs[(pairs >= 0).all(axis=1)].astype(np.uint32)
        if len(pairs) < LEAST_MATCHES:
            return pairs, None
        geometry = pycolmap.estimate_calibrated_two_view_geometry(
            camera, pixels[first], camera, pixels[second], pairs, options
        )
        return pairs, geometry if geometry.config in fitting else None

    counts = np.zeros((len(ids), len(ids)), np.int64)
    waiting, done = _pairs(features), 0
    todo = [pair for pair in waiting if not database.exists_matches(*_of(ids, pair))]
    for pair in set(waiting) - set(todo):
        counts[pair] = (
            database.read_two_view_geometry_num_inliers(*_of(ids, pair))
            if (database.exists_two_view_geometry(*_of(ids, pair)))
            else 0
        )
        done += 1
    with ThreadPoolExecutor(_workers()) as pool:
        for pair, (pairs, geometry) in _as_completed(pool, verified, todo):
            if geometry is not None:
                counts[pair] = len(geometry.inlier_matches)
                database.write_two_view_geometry(*_of(ids, pair), geometry)
            database.write_matches(*_of(ids, pair), pairs)  # last: it says that the pair is done
            done += 1
            tell("pairs of images matched", done, len(waiting))
    return counts + counts.T


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


def _focal_px(features: Features) -> float:
    """Pixels a radian, on average."""
    return max(features.image_size) / (tau if features.image_size[0] == 2 * features.image_size[1] else np.pi)


def _pairs(features: Sequence[Features]) -> list[tuple[int, int]]:
    """Which pairs of images are matched."""
    count = len(features)
    if count <= MOST_EXHAUSTIVE:
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


def _models(pycolmap: Any, database: Path, count: int, tell: Tell) -> list[Any]:
    """COLMAP's models, the one with most images first; none if it finds no first pair."""
    options = pycolmap.IncrementalPipelineOptions()
    options.min_num_matches, options.min_model_size, options.random_seed = LEAST_MATCHES, 2, 0
    options.ba_refine_focal_length = options.ba_refine_extra_params = options.extract_colors = False
    mapper = options.mapper
    mapper.abs_pose_refine_focal_length = mapper.abs_pose_refine_extra_params = False
    mapper.abs_pose_min_num_inliers, mapper.abs_pose_min_inlier_ratio = LEAST_MATCHES, 0.05
    options.triangulation.ignore_two_view_tracks = False
    models: list[Any] = []
    for first_pair in _TRIES:
        for key, value in first_pair.items():
            setattr(mapper, key, value)
        found = _mapped(pycolmap, database, options, lambda done: tell("images mapped", done, count))
        models = sorted(found.values(), key=lambda model: -model.num_reg_images())
        if models and models[0].num_reg_images() > count / 2:
            break
    return models


def _mapped(pycolmap: Any, database: Path, options: Any, tell: Callable[[int], None]) -> dict[int, Any]:
    """COLMAP's mapper, in a thread so that Ctrl-C ends it."""
    stop, done = pycolmap.CancellationToken(), 0

    def another() -> None:
        nonlocal done
        done += 1
        tell(done)

    # COLMAP writes its models itself, too.
    with TemporaryDirectory() as folder, ThreadPoolExecutor(1) as pool:
        job = pool.submit(
            pycolmap.incremental_mapping,
            str(database),
            folder,
            folder,
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
