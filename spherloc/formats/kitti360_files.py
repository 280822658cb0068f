"""Files of KITTI-360 (cvlibs.net, kitti360Scripts): layout, calibration, poses, laser scans.

Transformations are (4, 4), named ``to_from_from``: p_to = to_from_from @ p_from, metres.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np

from spherloc.cameras.base import Camera
from spherloc.cameras.calibration import load_camera
from spherloc.errors import InputError, show
from spherloc.files import is_file, is_folder, names_in, read_file, reading, size_of
from spherloc.formats.text_rows import finite_numbers, needed_file, rows
from spherloc.types import BoolArray, FloatArray

MAX_SCAN_BYTES = 1 << 28
"""Largest file of a scan: a hundred times those of the dataset."""
FARTHEST_M = 10_000.0
"""Laser returns beyond this, a hundred times the sensor's range, mean a damaged file."""
MAX_SIDE_PX = 10_000
FARTHEST_ORIGIN_M = 1e9
"""Beyond this, 25 times around the Earth, a position has lost its millimetres."""
ROTATION_TOLERANCE = 1e-3
"""Rotations written with four digits are about this far from orthonormal."""
SIDES = {"image_02": "left", "image_03": "right"}
"""Side to which each fisheye camera looks."""
_POINT_BYTES = 16
_TIME = re.compile(r"(\d{4}-\d\d-\d\d) (\d\d:\d\d:\d\d)(\.\d{1,9})?")


@dataclass(frozen=True, eq=False)
class Rig:
    """A fisheye camera and the laser scanner on the vehicle."""

    camera: Camera
    imu_from_camera: FloatArray
    imu_from_velodyne: FloatArray
    car_mask: Path | None
    """File of the mask of the vehicle itself in the image; None if the file is missing."""


@dataclass(frozen=True)
class Drive:
    """The paths of the files of one sequence."""

    root: Path
    number: int

    @property
    def name(self) -> str:
        """The sequence's folder."""
        return f"2013_05_28_drive_{self.number:04d}_sync"

    @property
    def poses(self) -> Path:
        """Poses of the IMU in the world."""
        return self.root / "data_poses" / self.name / "poses.txt"

    def images(self, camera: str) -> Path:
        """Folder of a fisheye camera's images."""
        return self.root / "data_2d_raw" / self.name / camera / "data_rgb"

    def timestamps(self, camera: str) -> Path:
        """Times of a camera's images, a line a frame; the file may be missing."""
        return self.root / "data_2d_raw" / self.name / camera / "timestamps.txt"

    @property
    def scans(self) -> Path:
        """Folder of the Velodyne's scans."""
        return self.root / "data_3d_raw" / self.name / "velodyne_points" / "data"

    def scan(self, frame: int) -> Path:
        """The scan of a frame."""
        return self.scans / f"{frame:010d}.bin"


def read_rig(root: Path, camera: str, where: str) -> Rig:
    """The calibration of the camera "image_02" or "image_03".

    cam_k -> velo = cam_to_velo inv(cam_to_pose[0]) cam_to_pose[k] (kitti360Scripts, issue 15). The pixel centre's 0.5
    is added (``load_camera``). Raises ``InputError`` that names a missing or wrong file.
    """

    def calibration(name: str, what: str) -> Path:
        return needed_file(root / "calibration", name, where, what)

    lens_file = calibration(f"{camera}.yaml", f"the calibration of {camera}")
    to_pose_file = calibration("calib_cam_to_pose.txt", "where the cameras are on the vehicle")
    to_velodyne_file = calibration("calib_cam_to_velo.txt", "where the laser scanner is")
    imu_from = read_cam_to_pose(to_pose_file)
    for key in ("image_00", camera):
        if key not in imu_from:
            raise InputError(f"{to_pose_file}: there is no line '{key}:'; take the dataset's own file.")
    velodyne_from_image_00 = read_cam_to_velo(to_velodyne_file)
    car_mask = root / "fisheye" / f"mask_{SIDES[camera]}_fisheye.npy"
    return Rig(
        camera=load_camera(lens_file),
        imu_from_camera=imu_from[camera],
        imu_from_velodyne=imu_from["image_00"] @ np.linalg.inv(velodyne_from_image_00),
        car_mask=car_mask if is_file(car_mask) else None,
    )


def read_cam_to_pose(path: Path) -> dict[str, FloatArray]:
    """``imu_from_camera`` by camera, of lines "image_0X: " and twelve numbers.

    Raises ``InputError`` for a wrong line.
    """
    found: dict[str, FloatArray] = {}
    for place, text in rows(path, "the dataset's calib_cam_to_pose.txt"):
        key, _, values = text.partition(":")
        if key in found:
            raise InputError(f"{place}: {show(key)} is there twice; remove one of the lines.")
        found[key] = _rigid(values.split(), place)
    return found


def read_cam_to_velo(path: Path) -> FloatArray:
    """``velodyne_from_image_00`` (3, 4), the twelve numbers of the only line; raises ``InputError`` for other lines."""
    lines = list(rows(path, "the dataset's calib_cam_to_velo.txt"))
    if len(lines) != 1:
        raise InputError(f"{path}: has {len(lines)} lines of numbers instead of one; take the dataset's own file.")
    place, text = lines[0]
    return _rigid(text.split(), place)


def read_poses(path: Path) -> dict[int, FloatArray]:
    """``world_from_imu`` by frame, in growing order, of lines with a frame and twelve numbers. Frames have gaps.

    Raises ``InputError`` for a wrong line.
    """
    poses: dict[int, FloatArray] = {}
    last = -1
    for place, text in rows(path, "the poses.txt of a sequence"):
        frame, *values = text.split()
        if not (frame.isascii() and frame.isdigit() and len(frame) <= 10 and int(frame) > last):
            raise InputError(f"{place}: the frame {show(frame)} does not come after {last}; sort the lines by frame.")
        last = int(frame)
        poses[last] = _rigid(values, place)
    if not poses:
        raise InputError(f"{path}: holds no pose; take the dataset's own file.")
    return poses


def _rigid(words: list[str], place: str) -> FloatArray:
    """The rigid motion (4, 4) of twelve numbers, 3 x 4 row by row, its rotation made exactly orthonormal.

    Raises ``InputError`` if the rotation is farther than ``ROTATION_TOLERANCE`` from one.
    """
    values = finite_numbers(words, place)
    if len(values) != 12:
        raise InputError(f"{place}: has {len(values)} numbers for a 3 x 4 matrix, which needs 12; correct the line.")
    given = np.reshape(values, (3, 4))
    if np.abs(given[:, 3]).max() > FARTHEST_ORIGIN_M:
        raise InputError(f"{place}: its position is beyond {FARTHEST_ORIGIN_M:g} m; correct it.")
    left, _, right = np.linalg.svd(np.clip(given[:, :3], -2.0, 2.0))
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = left @ right, given[:, 3]
    if not np.abs(motion[:3, :3] - given[:, :3]).max() <= ROTATION_TOLERANCE or np.linalg.det(left @ right) < 0:
        raise InputError(f"{place}: its 3 x 3 part is not a rotation; check the order and number of the values.")
    return motion


def read_timestamps(path: Path) -> list[float]:
    """Seconds since 1970 (UTC) of every frame, of lines "2013-05-28 08:46:02.904094720".

    Raises ``InputError`` for a wrong line.
    """
    times = []
    for place, text in rows(path, "the timestamps.txt of a camera"):
        match = _TIME.fullmatch(text)
        try:
            if match is None:
                raise ValueError
            whole = datetime.fromisoformat(f"{match[1]}T{match[2]}").replace(tzinfo=UTC)
        except ValueError:
            raise InputError(f"{place}: no time like 2013-05-28 08:46:02.904094720; correct it.") from None
        times.append(whole.timestamp() + float(match[3] or 0))
    return times


def without_car(path: Path, camera: Camera) -> BoolArray:
    """(H, W), false where ``fisheye/mask_{left,right}_fisheye.npy`` is not zero: the vehicle, which moves along.

    The mask may be smaller than the image. Raises ``InputError`` if the file is not such a mask.
    """
    try:
        size_of(path)  # refuses a pipe, which numpy would wait for
        # Mapped: a header that claims more than the file holds is refused before anything is allocated.
        mask = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception:  # numpy parses the header as Python text, which can raise nearly anything
        mask = None
    sides = mask.shape if isinstance(mask, np.ndarray) and mask.dtype.kind in "buif" else ()
    if mask is None or len(sides) != 2 or not 0 < min(sides) <= max(sides) <= MAX_SIDE_PX:
        raise InputError(f"{path}: is not the mask of the car, rows and columns of numbers; replace or remove it.")
    size = (camera.width, camera.height)
    car = cv2.resize((np.asarray(mask) != 0).astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    return car == 0


def frames_in(folder: Path, ending: str, where: str, what: str) -> set[int]:
    """Frames of the files in a folder that are named by ten digits and ``ending``; other files are ignored.

    Raises ``InputError`` if there is no such folder; ``what`` says what it should hold.
    """
    if not is_folder(folder):
        raise InputError(f"{where}: the folder {folder} is missing, {what}; check 'root' and the sequence.")
    named = re.compile(r"\d{10}" + re.escape(ending), re.ASCII)
    return {int(name[:10]) for name in names_in(folder) if named.fullmatch(name)}


def read_scan(path: Path) -> FloatArray:
    """Laser returns (N, 3), Velodyne frame, metres, of little-endian float32 x, y, z, reflectance.

    Rays without a return, stored as exactly (0, 0, 0), are left out. Raises ``InputError``, naming the byte, for a
    damaged file, and for one without any point.
    """
    with reading(path, "download the scan or leave out its frame"):
        content = read_file(path, MAX_SCAN_BYTES)
    if len(content) % _POINT_BYTES:
        raise InputError(
            f"{path}: {len(content)} bytes, but a scan has {_POINT_BYTES} for each point; the file is damaged or not "
            "a scan: replace it."
        )
    rows = np.frombuffer(content, dtype="<f4").reshape(-1, 4)
    points = rows[:, :3].astype(np.float64)
    bad = np.flatnonzero(~(np.abs(points) <= FARTHEST_M).all(axis=1))
    if len(bad):
        x, y, z = points[bad[0]]
        raise InputError(
            f"{path}, byte {bad[0] * _POINT_BYTES}: the point ({x:g}, {y:g}, {z:g}) is not a laser return in metres; "
            "the file is damaged: replace it."
        )
    points = points[points.any(axis=1)]
    if not len(points):
        raise InputError(f"{path}: holds no point; replace it or leave out its frame.")
    return points


def scan_motion(poses: Mapping[int, FloatArray], frame: int, imu_from_velodyne: FloatArray) -> FloatArray | None:
    """How the scanner moved during the turn of a frame: its pose (4, 4) one turn before, in the frame's scanner frame.

    From the frame before, else the frame after, as the dataset's own tools do; None where neither has a pose.
    """
    for earlier, later in ((frame - 1, frame), (frame, frame + 1)):
        if earlier in poses and later in poses:
            later_from_earlier = np.linalg.inv(poses[later]) @ poses[earlier]
            return np.linalg.inv(imu_from_velodyne) @ later_from_earlier @ imu_from_velodyne
    return None


def unwrapped(points: FloatArray, motion: FloatArray) -> FloatArray:
    """Returns (N, 3) of one turn, corrected to the moment when the scanner looked ahead, at which the cameras fire.

    Raw scans are not corrected for the vehicle's motion (kitti360Scripts, issue 87): at 10 m/s and 10 Hz, what lies
    beside the vehicle, where the fisheyes look, is off by a quarter of a metre. The scanner turns clockwise, so that
    a return at the azimuth a > 0 is a / 2 pi turns old.
    """
    from scipy.spatial.transform import Rotation  # takes a quarter of a second

    turns = np.arctan2(points[:, 1], points[:, 0])[:, None] / (2.0 * np.pi)
    rotation_vector = Rotation.from_matrix(motion[:3, :3]).as_rotvec()
    return Rotation.from_rotvec(turns * rotation_vector).apply(points) + turns * motion[:3, 3]
