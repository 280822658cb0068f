"""Newer College: fisheye images of a walk, localized in the map of another with gravity from the IMU (Sec. VI-B.3).

The map is a COLMAP model of the reference images, whose frame and scale ``map_from_model`` gives or the references'
ground truth lets the loader fit, or a point cloud in the frame of the ground truth.
"""

from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from spherloc.cameras.base import Camera
from spherloc.cameras.kalibr import read_kalibr_chain
from spherloc.datasets import scene_file
from spherloc.datasets.imu import down_at, read_imu
from spherloc.datasets.map_scene import OPTIONAL, REQUIRED, MapScene, folder, read_settings
from spherloc.datasets.similarity import Similarity, align, similarity_of
from spherloc.errors import InputError, show
from spherloc.files import is_file, is_folder
from spherloc.formats.colmap_model import ColmapImage, ColmapModel, read_model
from spherloc.formats.newer_college_files import NAME_RULE, TimedImage, images_in, read_cloud, timestamp_of
from spherloc.formats.text_rows import needed_file
from spherloc.frontend.lifting import PointCloudLift, SfmLift
from spherloc.frontend.view import Lift, View
from spherloc.geometry import camera_centre, pose
from spherloc.trajectory import NS_PER_S, Trajectory, pose_at, read_newer_college
from spherloc.types import BoolArray, FloatArray

EXTRAS = ("colmap",)
EXAMPLE = """\
kind = "newer-college"
name = "Newer College, quad-hard in quad-easy"
root = "newer-college"                     # the paths that follow are relative to it
calibration = "calibration/camchain.yaml"  # Kalibr camera chain with T_cam_imu
camera = "cam0"
query_images = "quad-hard/cam0"            # names end in <sec>_<nsec> or in nanoseconds
query_ground_truth = "gt-nc-quad-hard.csv"
query_imu = "quad-hard/imu.csv"
reference_images = "quad-easy/cam0"
reference_ground_truth = "gt-nc-quad-easy.csv"
model = "quad-easy/colmap"                 # or prior_map = "cloud.ply"
# map_from_model = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]   # a similarity; else fitted to the ground truth
# cam_from_base = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]    # where the ground truth's body is not the IMU
# query_step = 10                          # every n-th image; likewise reference_step
"""

THRESHOLDS = ((2.0, 0.25), (5.0, 0.5), (8.0, 1.0))
"""Table IV."""
GRAVITY_BOUND_DEG = 3.0
"""What the IMU's filter keeps to for a walking person and a gyroscope with a bias of 0.01 rad/s."""
GRAVITY_MAP = np.array([0.0, 0.0, -1.0])
"""The ground truth's z axis points up: it was registered to a levelled laser scan."""
MAX_GAP_S = 0.5
"""Of the ground truth, which comes at 10 Hz."""
MAP_REACH_M = 60.0
"""Points of the prior map that are farther from a reference are left out of it."""


def load(table: dict[str, Any], path: Path) -> MapScene:
    """Read a scene of ``kind = "newer-college"``; images and points are read when they are needed.

    Raises ``InputError`` for a wrong key and for a missing or damaged file, which it names. Images without a time,
    ground truth, gravity or file are skipped, and the scene's remarks say how many.
    """
    where = str(path)
    files = {"calibration", "camera", "query_images", "query_ground_truth", "query_imu", "reference_images"}
    choices = {"reference_ground_truth", "model", "map_from_model", "prior_map", "cam_from_base"}
    steps = {"query_step", "reference_step"}
    scene_file.check_keys(table, REQUIRED | files | {"root"}, OPTIONAL | choices | steps, where)
    settings = read_settings(table, where, GRAVITY_BOUND_DEG, THRESHOLDS)
    place = _Place(table, folder(table, "root", path), where)
    rig = _rig(place)
    queries, query_remarks = _queries(place, rig)
    references, reference_remarks = _references(place, rig)
    return settings.scene(path, queries, references, GRAVITY_MAP, (*reference_remarks, *query_remarks))


@dataclass(frozen=True, eq=False)
class _Place:
    """The scene file's keys, and where its paths start."""

    table: dict[str, Any]
    root: Path
    where: str

    def file(self, key: str, what: str) -> Path:
        """An existing file that a key names."""
        return needed_file(self.root, scene_file.text(self.table, key, self.where), self.where, what)

    def folder(self, key: str) -> Path:
        """An existing folder that a key names."""
        named = self.root / scene_file.text(self.table, key, self.where)
        if not is_folder(named):
            raise InputError(f"{self.where}: {key} names the folder {named}, which does not exist; correct the path.")
        return named

    def step(self, key: str) -> int:
        """Every n-th; by default all."""
        return scene_file.integer({key: 1} | self.table, key, self.where, 1, 100_000)


@dataclass(frozen=True, eq=False)
class _Rig:
    """The camera and its place on the device."""

    camera: Camera
    cam_from_imu: FloatArray
    """(4, 4)"""
    cam_from_base: FloatArray
    """(4, 4), the base being the body of the ground truth."""
    timeshift_s: float
    """Added to a time of the camera to get that of the IMU's clock."""

    def cam_from_map(self, truth: Trajectory, timestamp_ns: int) -> FloatArray | None:
        """Pose (3, 4) at a time; None where the ground truth has a gap."""
        map_from_base = pose_at(truth, timestamp_ns, MAX_GAP_S)
        if map_from_base is None:
            return None
        rotation = self.cam_from_base[:3, :3] @ map_from_base[:, :3].T
        return pose(rotation, self.cam_from_base[:3, 3] - rotation @ map_from_base[:, 3])


def _rig(place: _Place) -> _Rig:
    calibration = place.file("calibration", "the Kalibr camera chain")
    cameras = read_kalibr_chain(calibration)
    name = scene_file.text(place.table, "camera", place.where)
    if name not in cameras:
        raise InputError(f"{calibration}: has no camera {show(name)}; give one of {', '.join(cameras)}.")
    cam_from_imu = cameras[name].cam_from_imu
    if cam_from_imu is None:
        raise InputError(f"{calibration}: {name} has no T_cam_imu, without which the IMU says nothing; add it.")
    cam_from_base = cam_from_imu
    if "cam_from_base" in place.table:
        given = similarity_of(place.table["cam_from_base"], "cam_from_base", place.where)
        if abs(given.scale - 1.0) > 1e-3:
            raise InputError(f"{place.where}: the 3 x 3 part of cam_from_base has the scale {given.scale:g}; give 1.")
        cam_from_base = np.vstack([pose(given.rotation, given.translation), [0.0, 0.0, 0.0, 1.0]])
    return _Rig(cameras[name].camera, cam_from_imu, cam_from_base, cameras[name].timeshift_s)


def _queries(place: _Place, rig: _Rig) -> tuple[list[View], list[str]]:
    """Images with a time, a true pose and gravity."""
    folder_of_images = place.folder("query_images")
    truth_file = place.file("query_ground_truth", "the true poses of the queries")
    imu_file = place.file("query_imu", "the inertial measurements of the queries")
    images, untimed = images_in(folder_of_images)
    images = images[:: place.step("query_step")]
    truth = read_newer_college(truth_file)
    poses = [rig.cam_from_map(truth, image.timestamp_ns) for image in images]
    shift_ns = round(rig.timeshift_s * NS_PER_S)
    down = down_at(read_imu(imu_file), np.array([image.timestamp_ns + shift_ns for image in images]))
    down_camera = down @ rig.cam_from_imu[:3, :3].T
    known = [bool(np.isfinite(direction).all()) for direction in down_camera]
    views = [
        _view(image, rig.camera, cam_from_map, gravity_camera=direction)
        for image, cam_from_map, direction, measured in zip(images, poses, down_camera, known, strict=True)
        if cam_from_map is not None and measured
    ]
    without_pose = sum(cam_from_map is None for cam_from_map in poses)
    without_gravity = len(images) - without_pose - len(views)
    return views, _remarks(
        (untimed, f"images of {folder_of_images} have no time in their names ({NAME_RULE})"),
        (without_pose, f"of the {len(images)} query images fall into gaps of {truth_file.name} or outside of it"),
        (without_gravity, f"of the {len(images)} query images fall into gaps of {imu_file.name} or outside of it"),
    )


def _references(place: _Place, rig: _Rig) -> tuple[list[View], list[str]]:
    """Images with points, from the COLMAP model or the prior map."""
    if ("model" in place.table) == ("prior_map" in place.table):
        raise InputError(f"{place.where}: give one of the keys 'model' (a COLMAP model) and 'prior_map' (a PLY file).")
    if "map_from_model" in place.table and "prior_map" in place.table:
        raise InputError(f"{place.where}: map_from_model belongs to a model, not to a prior_map; remove it.")
    if "model" in place.table:
        return _model_references(place, rig)
    images, untimed = images_in(place.folder("reference_images"))
    images = images[:: place.step("reference_step")]
    cloud = place.file("prior_map", "the prior map")
    truth_file = place.file("reference_ground_truth", "the poses of the references")
    truth = read_newer_college(truth_file)
    views = []
    for image in images:
        cam_from_map = rig.cam_from_map(truth, image.timestamp_ns)
        if cam_from_map is not None:
            points = partial(_points_near, cloud, camera_centre(cam_from_map))
            views.append(_view(image, rig.camera, cam_from_map, PointCloudLift(points, rig.camera, cam_from_map)))
    return views, _remarks(
        (untimed, f"reference images have no time in their names ({NAME_RULE})"),
        (
            len(images) - len(views),
            f"of the {len(images)} reference images fall into gaps of {truth_file.name} or outside of it",
        ),
    )


def _points_near(cloud: Path, centre: FloatArray) -> FloatArray:
    points = read_cloud(cloud)
    return points[np.linalg.norm(points - centre, axis=1) <= MAP_REACH_M].astype(np.float64)


def _model_references(place: _Place, rig: _Rig) -> tuple[list[View], list[str]]:
    model = read_model(place.folder("model"))
    files = place.folder("reference_images")
    similarity, remark = _map_from_model(place, rig, model)
    images = list(model.images.values())[:: place.step("reference_step")]
    present = [image for image in images if is_file(files / image.name)]
    views = [
        View(
            name=image.name,
            camera=model.camera(image.camera_id),
            path=files / image.name,
            cam_from_map=similarity.pose(image.cam_from_map),
            timestamp_s=None if (time := timestamp_of(image.name)) is None else time / NS_PER_S,
            lift=_ModelLift(image, model, similarity),
        )
        for image in present
    ]
    missing = (len(images) - len(present), f"of the {len(images)} images of {model.folder} are not in {files}")
    return views, [*remark, *model.remarks, *_remarks(missing)]


def _map_from_model(place: _Place, rig: _Rig, model: ColmapModel) -> tuple[Similarity, list[str]]:
    """Given, or fitted to the true positions of the model's cameras, which a remark then says."""
    if "map_from_model" in place.table:
        return similarity_of(place.table["map_from_model"], "map_from_model", place.where), []
    truth_file = place.file("reference_ground_truth", "which says where the model's cameras were")
    truth = read_newer_college(truth_file)
    pairs = []
    for image in model.images.values():
        time = timestamp_of(image.name)
        true = None if time is None else rig.cam_from_map(truth, time)
        if true is not None:
            pairs.append((camera_centre(image.cam_from_map), camera_centre(true)))
    if not pairs:
        raise InputError(
            f"{place.where}: no image of {model.folder} has a time in its name ({NAME_RULE}) that {truth_file} covers, "
            "so the model cannot be placed; give map_from_model."
        )
    old, new = np.array(pairs).transpose(1, 0, 2)
    found = align(old, new, f"{place.where}: the cameras of {model.folder} cannot be placed by {truth_file}")
    return found.similarity, [
        f"{model.folder} was placed by {found.used} of {len(pairs)} camera positions of {truth_file.name}: scale "
        f"{found.similarity.scale:.4g}, residual {found.rms_m:.2g} m (root mean square)."
    ]


@dataclass(frozen=True, eq=False)
class _ModelLift:
    """Points of the keypoints that the model observed in an image; a ``Lift``."""

    image: ColmapImage
    model: ColmapModel
    map_from_model: Similarity

    def __call__(self, pixels: FloatArray) -> tuple[FloatArray, BoolArray]:
        return _observed(self)(pixels)


@lru_cache(maxsize=32)
def _observed(lift: _ModelLift) -> SfmLift:
    pixels, points = lift.image.observed(lift.model)
    return SfmLift(pixels, lift.map_from_model.points(points))


def _view(
    image: TimedImage,
    camera: Camera,
    cam_from_map: FloatArray,
    lift: Lift | None = None,
    gravity_camera: FloatArray | None = None,
) -> View:
    return View(
        name=image.name,
        camera=camera,
        path=image.path,
        cam_from_map=cam_from_map,
        gravity_camera=gravity_camera,
        timestamp_s=image.timestamp_ns / NS_PER_S,
        lift=lift,
    )


def _remarks(*counts: tuple[int, str]) -> list[str]:
    return [f"{count} {what}: skipped." for count, what in counts if count]
