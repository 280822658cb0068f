"""Localizes images that COLMAP left out in the map, by an estimator of this project that uses gravity.

An image needs no verified pair for that: its matches with all images of the map are taken together, wrong ones
included. A pose is accepted if ``spherloc.outcome`` judges it localized (more than chance, no alternative pose, small
covariance) and if the nearest images of the map match the image well enough.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.errors import ProblemError
from spherloc.estimators import default_options, estimate
from spherloc.frontend.view import Gravity, View
from spherloc.geometry import DOWN, transform
from spherloc.mapping.alignment.fixed_images import FixedImages
from spherloc.mapping.alignment.rig_poses import expected_by_calibration
from spherloc.mapping.alignment.upright import Level, arbitrary_scale
from spherloc.mapping.models.colmap_options import pipeline_options
from spherloc.mapping.models.model import Reconstruction, SeenPoints, contradictions, points_of, poses_of
from spherloc.mapping.parallel import Tell
from spherloc.mapping.rig import expected_poses, shots_of
from spherloc.outcome import Outcome, judge
from spherloc.problem import Problem
from spherloc.registry import require
from spherloc.types import FloatArray

ESTIMATOR = "ransac-2p"
"""Registered name of the estimator: it compiles in a third of the time of ``auto``, which delays only the first map."""
MIN_INLIERS = 12
UNKNOWN_BOUND_RAD = float(np.radians(5.0))
"""Bound on the error of gravity in an image without vertical lines, which is assumed to be level."""
EXPECTED_RAD = float(np.radians(5.0))
"""How far matches may be from where an expected pose has them."""
MAX_ROUNDS = 4
"""Largest number of rounds: a localized image adds points, by which others can be localized in the next round."""


@dataclass(frozen=True, eq=False)
class _Placed:
    """The pose of a localized image in the model's frame, and its inliers."""

    cam_from_model: FloatArray
    """Pose (3, 4)."""
    features: NDArray[np.int64]
    """(K,) indices of the image's features that are inliers."""
    points: NDArray[np.int64]
    """(K,) ids of their points in the model."""


def place_rest(
    made: Reconstruction,
    views: Sequence[View],
    elsewhere: Collection[str],
    gravity: Mapping[str, Gravity],
    level: Level,
    tell: Tell,
    fixed: FixedImages | None = None,
) -> Reconstruction:
    """The map with those left-out images whose pose is accepted; those named in ``elsewhere`` are not tried.

    ``gravity`` is that from vertical lines, by the name of the image. Where a camera took an image together with one
    that is in the map, only matches that fit its expected pose are taken: by the map or, with ``fixed``, by how the
    cameras are fixed to each other. An image that contradicts others once its points are in the map is left out again.
    """
    names, shots = [view.name for view in views], shots_of(views)
    lenses = {view.name: repr(view.camera) for view in views if not isinstance(view.camera, Equirectangular)}
    refused = set(elsewhere)
    for round_number in count(1):
        left = [view for view in views if view.name not in made.poses and view.name not in refused]
        placed: dict[str, _Placed] = {}
        unit = arbitrary_scale(made.depths()).metres_per_unit
        expected = expected_poses(made.poses, shots)
        if fixed is not None:
            expected |= expected_by_calibration(made.poses, fixed)
        for done, view in enumerate(left, start=1):
            one = _place(made, view, gravity.get(view.name), level, unit, expected.get(view.name))
            if one is not None and _undoubted(made, names, view.name, one, lenses):
                placed[view.name] = one
            tell(f"left-out images tried, round {round_number}", done, len(left))
        if not placed:
            return made
        made = _with(made, placed)
        doubted = placed.keys() & {name for pair in made.contradictions for name in pair}
        made, refused = made.without(doubted), refused | doubted
        if round_number == MAX_ROUNDS:
            return made
    raise AssertionError  # count has no end


def _place(
    made: Reconstruction,
    view: View,
    gravity: Gravity | None,
    level: Level,
    unit: float,
    expected: FloatArray | None,
) -> _Placed | None:
    """The pose of a left-out image, with only the matches near the ``expected`` one (3, 4) if that is known; None if it
    is not accepted."""
    pycolmap = require("pycolmap", "colmap", "making a map")
    number = made.ids[view.name]
    found = [np.empty((0, 2), np.int64)]
    with pycolmap.Database.open(str(made.database)) as database:
        keypoints = np.asarray(database.read_keypoints(number), np.float64)[:, :2]
        for name in made.poses:
            other = made.model.image(made.ids[name])
            if not database.exists_matches(number, other.image_id):
                continue
            pairs = np.asarray(database.read_matches(number, other.image_id), np.int64).reshape(-1, 2)
            point_of = np.array([point.point3D_id if point.has_point3D() else -1 for point in other.points2D], np.int64)
            points = point_of[pairs[:, 1]]
            found.append(np.column_stack([pairs[:, 0], points])[points >= 0])
    pairs = np.unique(np.concatenate(found), axis=0)
    pixels = keypoints[pairs[:, 0]]
    points = np.array([made.model.point3D(int(index)).xyz for index in pairs[:, 1]]).reshape(-1, 3)
    if expected is not None:
        seen_at = transform(expected, points)
        bearings, seen = view.camera.unproject(pixels)
        near = seen & (np.sum(bearings * seen_at, axis=1) >= np.cos(EXPECTED_RAD) * np.linalg.norm(seen_at, axis=1))
        pairs, pixels, points = pairs[near], pixels[near], points[near]
    if len(pairs) < MIN_INLIERS:
        return None
    bound_rad = UNKNOWN_BOUND_RAD if gravity is None or gravity.bound_rad is None else gravity.bound_rad
    try:
        problem = Problem(
            name=view.name,
            camera=view.camera,
            pixels=pixels,
            points=points * unit,
            gravity_camera=DOWN if gravity is None else gravity.down,
            gravity_map=level.down,
            gravity_bound_rad=bound_rad + float(np.radians(level.spread_deg)),
            metric=False,
        )
    except ProblemError:
        return None  # none of its features is on a pixel that the camera model sees
    trace = estimate(problem, ESTIMATOR, default_options(ESTIMATOR, problem), 0)
    if trace.cam_from_map is None or judge(trace).outcome != Outcome.LOCALIZED:
        return None
    inliers = np.flatnonzero(trace.inlier_mask)
    _, first = np.unique(pairs[inliers, 0], return_index=True)  # a feature has one point
    inliers = inliers[first]
    if len(inliers) < MIN_INLIERS:
        return None
    pose = trace.cam_from_map
    return _Placed(np.column_stack([pose[:, :3], pose[:, 3] / unit]), pairs[inliers, 0], pairs[inliers, 1])


def _undoubted(
    made: Reconstruction, names: Sequence[str], name: str, placed: _Placed, lenses: Mapping[str, str]
) -> bool:
    """Whether its neighbours in the map match it: at a place that only looks alike, hardly any do."""
    poses = {**made.poses, name: placed.cam_from_model}
    points = {**points_of(made.model), name: SeenPoints.of(made.model, placed.points.tolist())}
    against = contradictions(poses, names, made.all_matches, points, lenses=lenses)
    return not any(name in pair for pair in against)


def with_images(made: Reconstruction, poses: Mapping[str, FloatArray], adjust: bool = True) -> Reconstruction:
    """The map with images of these poses (3, 4) in its frame, after another triangulation and, with ``adjust``, bundle
    adjustment."""
    none = np.empty(0, np.int64)
    return _with(made, {name: _Placed(pose, none, none) for name, pose in poses.items()}, adjust)


def _with(made: Reconstruction, placed: Mapping[str, _Placed], adjust: bool = True) -> Reconstruction:
    """The map with more images, as ``with_images``."""
    pycolmap = require("pycolmap", "colmap", "making a map")
    model = made.model
    register(made, {name: one.cam_from_model for name, one in placed.items()})
    for name, one in placed.items():
        for feature, point in zip(one.features.tolist(), one.points.tolist(), strict=True):
            model.add_observation(point, pycolmap.TrackElement(made.ids[name], feature))
    with TemporaryDirectory() as folder:
        options, database = pipeline_options(pycolmap), str(made.database)
        model = pycolmap.triangulate_points(model, database, folder, folder, False, options, refine_intrinsics=False)
    if adjust:
        adjusted(pycolmap, model)
    return replace(made, model=model, poses=poses_of(model)).judged()


def register(made: Reconstruction, poses: Mapping[str, FloatArray]) -> None:
    """Give images poses (3, 4) in a model, which sees nothing of theirs yet."""
    pycolmap = require("pycolmap", "colmap", "making a map")
    for name, cam_from_model in poses.items():
        frame_id = _image_in(pycolmap, made, made.ids[name])
        made.model.frame(frame_id).rig_from_world = pycolmap.Rigid3d(cam_from_model)
        made.model.register_frame(frame_id)


def _image_in(pycolmap: Any, made: Reconstruction, number: int) -> int:
    """Id of an image's frame in the model; it is added if COLMAP left it out, as it does without a verified pair."""
    model = made.model
    if model.exists_image(number):
        return int(model.image(number).frame_id)
    with pycolmap.Database.open(str(made.database)) as database:
        known = database.read_image(number)
        keypoints = np.asarray(database.read_keypoints(number), np.float64)[:, :2]
        frame = database.read_frame(known.frame_id)
        camera, rig = database.read_camera(known.camera_id), database.read_rig(frame.rig_id)
    image = pycolmap.Image(name=known.name, keypoints=keypoints, camera_id=known.camera_id, image_id=number)
    image.frame_id = known.frame_id
    if not model.exists_camera(known.camera_id):
        model.add_camera(camera)
    if not model.exists_rig(frame.rig_id):
        model.add_rig(rig)
    if not model.exists_frame(known.frame_id):
        model.add_frame(frame)
    model.add_image(image)
    return int(known.frame_id)


def adjusted(pycolmap: Any, model: Any) -> None:
    """Bundle adjustment of poses and points; the camera stays as it is.

    It does what ``pycolmap.bundle_adjustment`` does, which would set COLMAP's level of logging back to its default, so
    that this and all later steps print lines of their own.
    """
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.num_threads = 1
    pycolmap.ObservationManager(model).filter_observations_with_negative_depth()
    images = pycolmap.BundleAdjustmentConfig()
    for number in model.reg_image_ids():
        images.add_image(number)
    images.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, images, model).solve()
    pycolmap.ObservationManager(model).filter_observations_with_negative_depth()
    model.update_point_3d_errors()
