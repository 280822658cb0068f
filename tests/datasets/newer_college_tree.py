"""Writes a small Newer College: two walks through a rendered street, with ground truth, IMU, model and prior map."""

from dataclasses import dataclass

import cv2
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.geometry import camera_centre
from spherloc.worlds import build_world, render

WIDTH, HEIGHT = 500, 375
SCALE = WIDTH / 720
FX, FY = 352.779 * SCALE, 354.609 * SCALE
PU, PV = (359.035 + 0.5) * SCALE - 0.5, (260.546 + 0.5) * SCALE - 0.5
"""As in the Kalibr file, where the centre of the top-left pixel is (0, 0)."""
DISTORTION = (-0.04217, -0.00413, 0.00179, -0.00063)
CAMERA = KannalaBrandt(WIDTH, HEIGHT, FX, FY, PU + 0.5, PV + 0.5, DISTORTION)


def motion(rotation, translation):
    """(4, 4)."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return matrix


def turned(degrees, matrix):
    return Rotation.from_euler("xyz", degrees, degrees=True).as_matrix() @ matrix


# The IMU hangs upside down: x ahead, y right, z down, a little askew. The base looks ahead with z up.
CAM_FROM_IMU = motion(turned([2.0, -3.0, 1.0], [[0, 1, 0], [0, 0, 1], [1, 0, 0]]), [0.05, -0.02, 0.01])
IMU_FROM_BASE = motion(turned([0.4, -0.5, 0.3], np.diag([1.0, -1.0, -1.0])), [0.013, -0.012, 0.106])
CAM_FROM_BASE = CAM_FROM_IMU @ IMU_FROM_BASE

MODEL_FROM_MAP_SCALE = 0.37
MODEL_FROM_MAP = Rotation.from_euler("xyz", [40, -70, 110], degrees=True).as_matrix()
MODEL_SHIFT = np.array([3.0, -8.0, 5.0])
"""The COLMAP model has a frame and a scale of its own."""

NS = 1_000_000_000
SPEED_M_S = 1.2


@dataclass(frozen=True)
class Walk:
    """A person who carries the device along a street, swaying and turning it."""

    start_ns: int
    start_m: float
    offset_m: float
    sway_deg: float

    def map_from_imu(self, times_s):
        """Rotations and positions (K, 3) at seconds since the start."""
        t = np.atleast_1d(np.asarray(times_s, dtype=np.float64))
        world = build_world("street")
        first, last = (world.route(1, self.offset_m, start=s, stop=s)[0] for s in (0.3, 0.31))
        ahead = camera_centre(last) - camera_centre(first)
        ahead /= np.linalg.norm(ahead)
        left = np.array([-ahead[1], ahead[0], 0.0])
        way = self.start_m + SPEED_M_S * t + 0.15 * np.sin(1.1 * t)
        positions = camera_centre(first) + way[:, None] * ahead + 0.6 * np.sin(0.7 * t)[:, None] * left
        positions[:, 2] += 0.03 * np.sin(4 * np.pi * t) + 0.1 * np.sin(0.5 * t)
        heading = np.arctan2(ahead[1], ahead[0]) + 0.35 * np.sin(0.6 * t)
        sway = np.radians(self.sway_deg)
        angles = [heading, sway * np.sin(1.3 * t + 0.4) + 0.02 * np.sin(4 * np.pi * t), sway * np.sin(0.9 * t)]
        level_from_imu = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
        return Rotation.from_euler("ZYX", np.column_stack(angles)) * level_from_imu, positions

    def pose(self, time_ns):
        """``map_from_imu`` (4, 4)."""
        rotation, position = self.map_from_imu((time_ns - self.start_ns) / NS)
        return motion(rotation.as_matrix()[0], position[0])

    def cam_from_map(self, time_ns):
        return (CAM_FROM_IMU @ np.linalg.inv(self.pose(time_ns)))[:3]

    def imu(self, times_s, rng, bias_rad_s=0.005):
        """Rates and forces (K, 3) that an IMU measures, with noise and bias, by differences of 0.1 ms."""
        h = 1e-4
        before, at, after = (self.map_from_imu(times_s + step) for step in (-h, 0.0, h))
        rates = (before[0].inv() * after[0]).as_rotvec() / (2 * h)
        accelerations = (before[1] - 2 * at[1] + after[1]) / h**2
        forces = at[0].inv().apply(accelerations + np.array([0.0, 0.0, 9.81]))
        rates += bias_rad_s * np.array([1.0, -1.0, 0.5]) + rng.normal(0, 0.005, rates.shape)
        return rates, forces + 0.03 + rng.normal(0, 0.05, forces.shape)


def write_ground_truth(path, walk, times_ns):
    """Poses of the base."""
    rows = ["#sec,nsec,x,y,z,qx,qy,qz,qw"]
    for time in times_ns:
        pose = walk.pose(time) @ IMU_FROM_BASE
        numbers = [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]
        rows.append(",".join([str(time // NS), str(time % NS), *(f"{number:.9f}" for number in numbers)]))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(rows) + "\n")


def write_imu(path, walk, times_ns, rng):
    rates, forces = walk.imu((np.asarray(times_ns) - walk.start_ns) / NS, rng)
    rows = ["#counter,sec,nsec,wx,wy,wz,ax,ay,az"]
    for counter, (time, numbers) in enumerate(zip(times_ns, np.hstack([rates, forces]), strict=True)):
        rows.append(",".join([str(counter), str(time // NS), str(time % NS), *(f"{n:.9f}" for n in numbers)]))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(rows) + "\n")


def write_calibration(path):
    lines = ["cam0:", "  T_cam_imu:"]
    lines += [f"  - {row.tolist()}" for row in CAM_FROM_IMU]
    lines += ["  camera_model: pinhole", f"  distortion_coeffs: {list(DISTORTION)}", "  distortion_model: equidistant"]
    lines += [f"  intrinsics: {[FX, FY, PU, PV]}", f"  resolution: [{WIDTH}, {HEIGHT}]"]
    lines += ["  rostopic: /alphasense_driver_ros/cam0", ""]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines))


def image_name(time_ns):
    return f"{time_ns // NS}_{time_ns % NS:09d}.png"


def write_images(folder, walk, times_ns, **conditions):
    """Pictures and their distances along the rays, by time."""
    folder.mkdir(parents=True, exist_ok=True)
    pictures = {}
    for time in times_ns:
        picture = render(build_world("street"), CAMERA, walk.cam_from_map(time), **conditions)
        cv2.imwrite(str(folder / image_name(time)), picture.image)
        pictures[time] = picture
    return pictures


def in_model(points):
    return MODEL_FROM_MAP_SCALE * points @ MODEL_FROM_MAP.T + MODEL_SHIFT


def map_from_model():
    """The similarity (3, 4) that undoes ``in_model``."""
    rotation = MODEL_FROM_MAP.T / MODEL_FROM_MAP_SCALE
    return np.column_stack([rotation, -rotation @ MODEL_SHIFT])


def seen_points(picture, cam_from_map, pixels):
    """Map points (N, 3) at pixels (N, 2), by the true distance there; NaN for the sky."""
    bearings, _ = CAMERA.unproject(pixels)
    rows, columns = pixels.astype(int)[:, ::-1].T
    ranges = picture.range_m[rows, columns].astype(np.float64)
    ranges[~np.isfinite(ranges)] = np.nan
    return (bearings * ranges[:, None] - cam_from_map[:, 3]) @ cam_from_map[:, :3]


def write_model(folder, walk, pictures):
    """A COLMAP model in text form: SIFT keypoints of every picture, each with a point of its own."""
    folder.mkdir(parents=True, exist_ok=True)
    params = " ".join(map(repr, [FX, FY, PU + 0.5, PV + 0.5, *DISTORTION]))
    (folder / "cameras.txt").write_text(f"1 OPENCV_FISHEYE {WIDTH} {HEIGHT} {params}\n")
    images, rows = [], []
    for number, (time, picture) in enumerate(pictures.items(), start=1):
        cam_from_map = walk.cam_from_map(time)
        keypoints = cv2.SIFT_create(1500).detect(cv2.cvtColor(picture.image, cv2.COLOR_BGR2GRAY))
        pixels = np.array([keypoint.pt for keypoint in keypoints]) + 0.5
        points = seen_points(picture, cam_from_map, pixels)
        known = np.isfinite(points[:, 0])
        rotation = cam_from_map[:, :3] @ MODEL_FROM_MAP.T
        translation = -rotation @ in_model(camera_centre(cam_from_map)[None])[0]
        x, y, z, w = Rotation.from_matrix(rotation).as_quat()
        images.append(f"{number} {' '.join(map(repr, [*map(float, [w, x, y, z, *translation])]))} 1 {image_name(time)}")
        observed = []
        for index, (pixel, point) in enumerate(zip(pixels[known], in_model(points[known]), strict=True)):
            rows.append(
                f"{len(rows) + 1} {point[0]:.9f} {point[1]:.9f} {point[2]:.9f} 128 128 128 0.1 {number} {index}"
            )
            observed.append(f"{pixel[0]:.6f} {pixel[1]:.6f} {len(rows)}")
        images.append(" ".join(observed))
    (folder / "images.txt").write_text("\n".join(images) + "\n")
    (folder / "points3D.txt").write_text("\n".join(rows) + "\n")


def write_prior_map(path, walk, pictures, step=2):
    """A laser-like cloud of what the pictures see."""
    columns, rows = np.meshgrid(np.arange(0, WIDTH, step) + 0.5, np.arange(0, HEIGHT, step) + 0.5)
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    clouds = [seen_points(picture, walk.cam_from_map(time), pixels) for time, picture in pictures.items()]
    points = np.concatenate(clouds)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(trimesh.PointCloud(points[np.isfinite(points[:, 0])]).export(file_type="ply"))


REFERENCE_WALK = Walk(1_625_133_000 * NS + 5, 4.0, 0.0, 3.0)
QUERY_WALK = Walk(1_625_140_000 * NS + 77, 4.5, 0.5, 12.0)
REFERENCE_TIMES = [REFERENCE_WALK.start_ns + round(t * NS) for t in (4.0, 5.03, 6.06, 7.09)]
QUERY_TIMES = [QUERY_WALK.start_ns + round(t * NS) for t in (-0.5, 4.52, 5.55, 8.0, 11.5)]
"""Before everything, good, good, in a gap of the ground truth, in a gap of the IMU."""


def between(walk, first_s, last_s, rate_hz):
    """Times in ns."""
    return [walk.start_ns + round(n * NS / rate_hz) for n in range(int(first_s * rate_hz), int(last_s * rate_hz) + 1)]


def write_tree(root, rng):
    """All of it; returns the references' pictures."""
    write_calibration(root / "calibration/camchain.yaml")
    pictures = write_images(root / "quad-easy/cam0", REFERENCE_WALK, REFERENCE_TIMES)
    write_images(root / "quad-hard/cam0", QUERY_WALK, QUERY_TIMES[1:3], seed=1)
    for time in QUERY_TIMES:
        (root / "quad-hard/cam0" / image_name(time)).touch()
    write_ground_truth(root / "ground_truth/easy.csv", REFERENCE_WALK, between(REFERENCE_WALK, 2, 9, 10))
    with_gap = between(QUERY_WALK, 0, 7, 10) + between(QUERY_WALK, 9, 13, 10)
    write_ground_truth(root / "ground_truth/hard.csv", QUERY_WALK, with_gap)
    imu_times = between(QUERY_WALK, 0, 11, 200) + between(QUERY_WALK, 12, 13, 200)
    write_imu(root / "quad-hard/imu.csv", QUERY_WALK, imu_times, rng)
    write_model(root / "colmap", REFERENCE_WALK, pictures)
    write_prior_map(root / "prior_map.ply", REFERENCE_WALK, pictures)


SCENE = f"""
kind = "newer-college"
name = "small walk"
root = "newer-college"
calibration = "calibration/camchain.yaml"
camera = "cam0"
query_images = "quad-hard/cam0"
query_ground_truth = "ground_truth/hard.csv"
query_imu = "quad-hard/imu.csv"
reference_images = "quad-easy/cam0"
reference_ground_truth = "ground_truth/easy.csv"
cam_from_base = {CAM_FROM_BASE[:3].tolist()}
"""
MODEL = 'model = "colmap"\n'
PRIOR_MAP = 'prior_map = "prior_map.ply"\n'
