"""Newer College: fisheye images of a walk, localized in the map of another with gravity from the IMU (Sec. VI-B.3).

The map is a COLMAP model of the reference images, whose frame and scale ``map_from_model`` gives or the references'
ground truth lets the loader fit, or a point cloud in the frame of the ground truth.
"""

import os
import re
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spherloc.cameras.base import Camera
from spherloc.cameras.tool_files import read_kalibr_chain
from spherloc.datasets import scene_file
from spherloc.datasets.imu import NAME_RULE, down_at, read_imu, timestamp_of
from spherloc.datasets.map_scene import OPTIONAL, REQUIRED, MapScene, folder, read_settings
from spherloc.datasets.scene_file import numbers
from spherloc.errors import InputError, reason, shorten, show
from spherloc.files import is_file, is_folder, names_in, open_file, reading
from spherloc.formats.colmap_files import read_model
from spherloc.formats.colmap_model import ColmapImage, ColmapModel
from spherloc.formats.text_rows import needed_file
from spherloc.frontend.lifting import PointCloudLift, SfmLift
from spherloc.frontend.view import Gravity, Lift, View
from spherloc.geometry import camera_centre, inverse_pose, pose
from spherloc.trajectory import NS_PER_S, Trajectory, pose_at, read_newer_college
from spherloc.types import BoolArray, FloatArray

ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
MAX_CLOUD_BYTES = 1 << 32
"""Largest point cloud, 4 GiB: the whole campus at a spacing of a centimetre takes less."""
_HEADER_BYTES = 1 << 16
_ELEMENT = re.compile(rb"element\s+(\S+)\s+(\d{1,18})\s*$")


@dataclass(frozen=True)
class TimedImage:
    """An image file whose name holds its time."""

    name: str
    """Its path below the folder, with forward slashes."""
    path: Path
    timestamp_ns: int


def images_in(folder: Path) -> tuple[list[TimedImage], int]:
    """Images of a folder by time, and how many others there are whose names carry none.

    Raises ``InputError`` if none carries a time, or if two carry the same one.
    """
    files = [folder / name for name in names_in(folder) if Path(name).suffix.lower() in ENDINGS]
    timed = [(timestamp_of(path.name), path) for path in files]
    images = sorted(
        (TimedImage(path.name, path, time) for time, path in timed if time is not None),
        key=lambda image: (image.timestamp_ns, image.name),
    )
    if not images:
        raise InputError(f"{folder}: none of its {len(files)} images has a time in its name; give {NAME_RULE}.")
    for one, other in pairwise(images):
        if one.timestamp_ns == other.timestamp_ns:
            both = f"{shorten(one.name)} and {shorten(other.name)}"
            raise InputError(f"{folder}: {both} have the same time; keep the images of one camera.")
    return images, len(files) - len(images)


@lru_cache(maxsize=1)
def read_cloud(path: Path) -> NDArray[np.float32]:
    """Points (N, 3) of a PLY file, metres; cached, because all references share them.

    Raises ``InputError`` for any other file and for one without a finite point.
    """
    import trimesh  # takes half a second

    _check_header(path)
    try:
        cloud = trimesh.load(path, file_type="ply", process=False)
        points = np.asarray(getattr(cloud, "vertices", ()), dtype=np.float32).reshape(-1, 3)
    except Exception as error:  # trimesh passes on whatever its parsers raise
        raise InputError(f"{path}: no readable PLY point cloud ({reason(error)}); export the map again.") from None
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        raise InputError(f"{path}: holds no finite point; export the map again.")
    points.setflags(write=False)
    return points


def _check_header(path: Path) -> None:
    """Refuse a file whose header claims more than the file holds, before memory is allocated for it."""
    with reading(path, "give the prior map as a PLY file"), open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        header, end, _ = file.read(_HEADER_BYTES).partition(b"end_header")
    if not header.startswith(b"ply") or not end or size > MAX_CLOUD_BYTES:
        raise InputError(f"{path}: no PLY file of at most {MAX_CLOUD_BYTES >> 30} GiB; give the prior map as one.")
    lines = [line.strip() for line in header.splitlines() if line.startswith(b"element")]
    matches = [_ELEMENT.match(line) for line in lines]
    if not lines or not all(matches) or sum(int(match[2]) for match in matches if match) > size:
        raise InputError(f"{path}: its header claims more points than fit into {size} bytes; export the map again.")


TOLERANCE = 1e-3
"""Largest difference of the singular values of a scaled rotation, as a share of the scale: typed ones are rounded."""
MIN_SPREAD = 0.02
"""Least ratio of the second to the first extent of positions; below it they lie on a line and do not fix a rotation."""
FARTHEST = 1e9
"""Largest absolute coordinate of a position, in the units of its frame."""
WORST_FIT = 0.1
"""Largest residual, as a share of the positions' extent: beyond it they are not the same positions."""
MIN_USED = 0.8
"""Least share of the positions that must fit: of four arbitrary positions, three always fit."""
_REMEDY = "give map_from_model"
_ROUNDS = 30
_INLIER_MEDIANS = 4.0


@dataclass(frozen=True, eq=False)
class Similarity:
    """x_to = scale rotation x_from + translation."""

    scale: float
    rotation: FloatArray
    """(3, 3), from the old to the new frame."""
    translation: FloatArray
    """(3,), in the unit of the new frame."""

    def points(self, points: FloatArray) -> FloatArray:
        """Points (N, 3) in the other frame."""
        return self.scale * points @ self.rotation.T + self.translation

    def pose(self, cam_from_old: FloatArray) -> FloatArray:
        """``cam_from_new`` (3, 4) of a camera, whose own axes keep their length."""
        rotation = cam_from_old[:, :3] @ self.rotation.T
        return pose(rotation, self.scale * cam_from_old[:, 3] - rotation @ self.translation)


@dataclass(frozen=True, eq=False)
class Alignment:
    """A similarity that was fitted to pairs of points."""

    similarity: Similarity
    used: int
    """Number of pairs that fit."""
    rms_m: float
    """Root mean square of their residuals, m."""


def similarity_of(value: Any, key: str, where: str) -> Similarity:
    """A similarity given as ``[[...], [...], [...]]``, 3 x 4: scale times rotation, and translation.

    Raises ``InputError`` for another shape, and if the 3 x 3 part is not a rotation times a positive scale.
    """
    matrix = numbers(value, (3, 4), key, where)
    left, sizes, right = np.linalg.svd(matrix[:, :3])
    scale = float(sizes.mean())
    if not 1e-9 <= scale <= 1e9 or np.ptp(sizes) > TOLERANCE * scale or np.linalg.det(left @ right) < 0:
        raise InputError(f"{where}: the 3 x 3 part of {key} is not a rotation times a positive scale; correct it.")
    return Similarity(scale, left @ right, matrix[:, 3])


def align(old: FloatArray, new: FloatArray, where: str) -> Alignment:
    """The similarity that takes the positions ``old`` (N, 3) to ``new`` (N, 3); a few of them may be wrong.

    Umeyama's closed form (1991), reweighted so that the sum of distances is least instead of that of squares.
    Raises ``InputError`` for fewer than three pairs, for positions on a line, and for positions that do not fit.
    """
    if len(old) < 3:
        raise InputError(f"{where}: only {len(old)} positions are known in both, and it takes three; {_REMEDY}.")
    if not (np.abs(old) <= FARTHEST).all():
        raise InputError(f"{where}: a position lies beyond {FARTHEST:g}; correct or remove it.")
    _check_spread(old, new, where)
    weights = np.ones(len(old))
    for _ in range(_ROUNDS):
        found = _umeyama(old, new, weights / weights.sum())
        residuals = np.linalg.norm(found.points(old) - new, axis=1)
        weights = 1.0 / np.maximum(residuals, 1e-3 + 0.1 * np.median(residuals))
    good = np.less_equal(residuals, max(_INLIER_MEDIANS * float(np.median(residuals)), 1e-3))
    used, rms = int(good.sum()), float(np.sqrt(np.mean(residuals[good] ** 2)))
    extent = float(np.sqrt(np.mean(np.sum((new - new.mean(axis=0)) ** 2, axis=1))))
    if rms > WORST_FIT * extent or used < MIN_USED * len(old):
        raise InputError(
            f"{where}: the positions do not fit, {used} of {len(old)} by {rms:.2g} m over {extent:.2g} m; take both "
            f"from the same recording, or {_REMEDY}."
        )
    _check_spread(old[good], new[good], where)
    return Alignment(found, used, rms)


def _check_spread(old: FloatArray, new: FloatArray, where: str) -> None:
    for positions in (old, new):
        extents = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False)
        if not extents[1] > MIN_SPREAD * extents[0]:
            raise InputError(f"{where}: the positions lie on a line, which does not fix a rotation; {_REMEDY}.")


def _umeyama(old: FloatArray, new: FloatArray, weights: FloatArray) -> Similarity:
    """Least weighted squares; weights (N,) that sum to 1."""
    old_mean, new_mean = weights @ old, weights @ new
    old_centred, new_centred = old - old_mean, new - new_mean
    left, sizes, right = np.linalg.svd((weights[:, None] * new_centred).T @ old_centred)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    rotation = left @ np.diag(signs) @ right
    scale = float(sizes @ signs / (weights @ np.sum(old_centred**2, axis=1)))
    return Similarity(scale, rotation, new_mean - scale * rotation @ old_mean)


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
"""Limits (degrees, metres) of Table IV."""
GRAVITY_BOUND_DEG = 3.0
"""Largest error of the IMU's filter for a walking person and a gyroscope with a bias of 0.01 rad/s."""
GRAVITY_MAP = np.array([0.0, 0.0, -1.0])
"""Gravity in the map frame: the ground truth's z axis points up, since it was registered to a levelled laser scan."""
MAX_GAP_S = 0.5
"""Longest gap of the ground truth over which poses are interpolated; it has 10 poses a second."""
MAP_REACH_M = 60.0
"""Points of the prior map that are farther from a reference's camera are not used for that reference."""


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
    scene = settings.scene(path, queries, references, GRAVITY_MAP, (*reference_remarks, *query_remarks))
    return replace(scene, vehicle_from_camera=inverse_pose(rig.cam_from_base[:3]))


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
        """The key's n, of "every n-th"; 1 by default."""
        return scene_file.integer({key: 1} | self.table, key, self.where, 1, 100_000)


@dataclass(frozen=True, eq=False)
class _Rig:
    """The camera and its place on the device."""

    camera: Camera
    cam_from_imu: FloatArray
    """Rigid motion (4, 4) from the IMU's frame to the camera's."""
    cam_from_base: FloatArray
    """The same from the base, the body whose poses the ground truth holds."""
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
        raise InputError(f"{calibration}: {name} has no T_cam_imu, which the IMU's measurements need; add it.")
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
        _view(image, rig.camera, cam_from_map, gravity=Gravity(direction, "the IMU"))
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
    """The key ``map_from_model``, or a fit to the true positions of the model's cameras, with a remark on it."""
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
    gravity: Gravity | None = None,
) -> View:
    return View(
        name=image.name,
        camera=camera,
        path=image.path,
        cam_from_map=cam_from_map,
        gravity=gravity,
        timestamp_s=image.timestamp_ns / NS_PER_S,
        lift=lift,
    )


def _remarks(*counts: tuple[int, str]) -> list[str]:
    return [f"{count} {what}: skipped." for count, what in counts if count]
