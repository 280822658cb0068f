"""Writes a small KITTI-360: two drives through a rendered street, in the dataset's own layout and file formats."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from spherloc.cameras.mei import Mei
from spherloc.worlds import Conditions, build_world, render

SIDE_PX = 500
SCALE = SIDE_PX / 1400
XI = 2.2134047507854890
DISTORTION = {"k1": 1.6798235660113681e-02, "k2": 1.6548773243373522, "p1": 4.2223943394772046e-04, "p2": 4.2462134e-04}
GAMMA = (1336.3220825849971 * SCALE, 1335.7883350012958 * SCALE)
CENTRE = ((716.94323510126321 + 0.5) * SCALE - 0.5, (705.76498308221585 + 0.5) * SCALE - 0.5)
"""As in the file, where the centre of the top-left pixel is (0, 0)."""

CAMERA = Mei(
    width=SIDE_PX,
    height=SIDE_PX,
    fx=GAMMA[0],
    fy=GAMMA[1],
    cx=CENTRE[0] + 0.5,
    cy=CENTRE[1] + 0.5,
    xi=XI,
    distortion=(DISTORTION["k1"], DISTORTION["k2"], DISTORTION["p1"], DISTORTION["p2"]),
)

REFERENCE, QUERY = 5, 4
STEP_M = 0.9
"""The car's way from one frame to the next: 32 km/h."""
BEAMS_DEG = np.linspace(2.0, -24.8, 64)
AZIMUTHS = 1200


def motion(rotation, translation):
    """(4, 4)."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return matrix


# The IMU looks ahead along x, y is to its right and z down; image_00 looks ahead too, image_02 and image_03 to the left
# and right, all a little askew; the laser scanner has z up.
IMU_FROM = {
    "image_00": motion([[0, 0, 1], [1, 0, 0], [0, 1, 0]], [1.57, -0.18, -0.35]),
    "image_02": motion(
        Rotation.from_euler("xyz", [1.5, -1.0, 2.0], degrees=True).as_matrix() @ [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
        [0.72, -0.55, -0.10],
    ),
    "image_03": motion(
        Rotation.from_euler("xyz", [-1.0, 0.5, 1.0], degrees=True).as_matrix() @ [[-1, 0, 0], [0, 0, 1], [0, 1, 0]],
        [0.70, 0.58, -0.10],
    ),
}
IMU_FROM_VELODYNE = motion(
    Rotation.from_euler("xyz", [0.4, -0.6, 0.5], degrees=True).as_matrix() @ np.diag([1.0, -1.0, -1.0]),
    [0.80, -0.02, -0.60],
)


@dataclass(frozen=True)
class Tree:
    """What was written, and the truth."""

    root: Path
    world_from_imu: dict[int, dict[int, np.ndarray]]
    """(4, 4) by sequence and frame."""

    def drive(self, sequence):
        return f"2013_05_28_drive_{sequence:04d}_sync"

    def poses_file(self, sequence):
        return self.root / "data_poses" / self.drive(sequence) / "poses.txt"

    def image(self, sequence, frame, camera="image_02"):
        return self.root / "data_2d_raw" / self.drive(sequence) / camera / "data_rgb" / f"{frame:010d}.png"

    def scan(self, sequence, frame):
        return self.root / "data_3d_raw" / self.drive(sequence) / "velodyne_points" / "data" / f"{frame:010d}.bin"

    def cam_from_map(self, sequence, frame, camera="image_02"):
        return np.linalg.inv(self.world_from_imu[sequence][frame] @ IMU_FROM[camera])[:3]


def drive_poses(world, frames, offset_m, start_m, tilts_deg):
    """``world_from_imu`` (4, 4) by frame, also one before and one after ``frames``; ``tilts_deg``: roll, pitch."""
    wanted = range(min(frames) - 1, max(frames) + 2)
    shares = [(start_m + STEP_M * (frame - min(frames))) / world.length_m for frame in wanted]
    poses = {}
    for frame, share in zip(wanted, shares, strict=True):
        level = motion(np.eye(3), np.zeros(3))
        level[:3] = world.route(1, offset_m=offset_m, start=share, stop=share)[0]
        tilt = motion(Rotation.from_euler("xy", tilts_deg, degrees=True).as_matrix(), np.zeros(3))
        poses[frame] = np.linalg.inv(level) @ np.array([[0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]) @ tilt
    return poses


def scan_of(world, poses, frame):
    """One turn of the scanner on the moving car, (N, 3) as measured and (N, 3) in the world.

    Azimuth 0 is seen at the time of the frame.
    """
    azimuth, elevation = (
        grid.ravel()
        for grid in np.meshgrid(np.linspace(-np.pi, np.pi, AZIMUTHS, endpoint=False), np.radians(BEAMS_DEG))
    )
    beams = np.column_stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    turns = -azimuth / (2 * np.pi)  # the scanner turns clockwise: what is on the left was seen before
    origins, directions = np.empty_like(beams), np.empty_like(beams)
    for sign, other in ((turns < 0, poses[frame - 1]), (turns >= 0, poses[frame + 1])):
        here = poses[frame] @ IMU_FROM_VELODYNE
        there = other @ IMU_FROM_VELODYNE
        share = np.abs(turns[sign])[:, None]
        turned = Rotation.from_matrix(here[:3, :3].T @ there[:3, :3]).as_rotvec()
        rotations = Rotation.from_matrix(here[:3, :3]) * Rotation.from_rotvec(share * turned)
        origins[sign] = here[:3, 3] + share * (there[:3, 3] - here[:3, 3])
        directions[sign] = rotations.apply(beams[sign])
    ranges = world.rays.cast(origins, directions).range_m
    hit = ranges < 80
    ranges[~hit] = 0.0
    return beams[hit] * ranges[hit, None], (origins + directions * ranges[:, None])[hit]


def row(matrix):
    return " ".join(f"{value:.12e}" for value in np.asarray(matrix)[:3].ravel())


def write_calibration(root):
    folder = root / "calibration"
    folder.mkdir(parents=True)
    for number in (2, 3):
        lines = ["%YAML:1.0", "---", "model_type: MEI", f"camera_name: image_{number:02d}"]
        lines += [f"image_width: {SIDE_PX}", f"image_height: {SIDE_PX}"]
        lines += ["mirror_parameters:", f"   xi: {XI!r}", "distortion_parameters:"]
        lines += [f"   {key}: {value!r}" for key, value in DISTORTION.items()]
        lines += ["projection_parameters:", f"   gamma1: {GAMMA[0]!r}", f"   gamma2: {GAMMA[1]!r}"]
        lines += [f"   u0: {CENTRE[0]!r}", f"   v0: {CENTRE[1]!r}", ""]
        (folder / f"image_{number:02d}.yaml").write_text("\n".join(lines))
    lines = [f"{camera}: {row(matrix)}" for camera, matrix in IMU_FROM.items()]
    (folder / "calib_cam_to_pose.txt").write_text("\n".join(lines) + "\n")
    to_velodyne = np.linalg.inv(IMU_FROM_VELODYNE) @ IMU_FROM["image_00"]
    (folder / "calib_cam_to_velo.txt").write_text(row(to_velodyne) + "\n")


def write_drive(tree, sequence, frames, conditions=None, scans=()):
    """Poses of all frames; images of ``frames``; scans of ``scans``."""
    world, poses = build_world("street"), tree.world_from_imu[sequence]
    tree.poses_file(sequence).parent.mkdir(parents=True)
    text = "".join(f"{frame} {row(matrix)} \n" for frame, matrix in poses.items())
    tree.poses_file(sequence).write_text(text)
    for frame in frames:
        picture = render(world, CAMERA, tree.cam_from_map(sequence, frame), **conditions or {})
        tree.image(sequence, frame).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(tree.image(sequence, frame)), picture.image)
    for frame in scans:
        tree.scan(sequence, frame).parent.mkdir(parents=True, exist_ok=True)
        points, _ = scan_of(world, poses, frame)
        tree.scan(sequence, frame).write_bytes(np.insert(points, 3, 0.3, axis=1).astype("<f4").tobytes())
    times = "".join(f"2013-05-28 08:46:{2 + frame // 10:02d}.{frame % 10}04094720\n" for frame in range(max(poses) + 1))
    tree.image(sequence, 0).parent.parent.joinpath("timestamps.txt").write_text(times)


REFERENCES, QUERIES = (100, 102, 104), (31, 32)


def write_tree(root):
    """All of it: two drives in one street, the second half a metre to the left and under clouds."""
    world = build_world("street")
    mapped = drive_poses(world, REFERENCES, 0.0, 30.0, (0.3, -0.2))
    asked = drive_poses(world, QUERIES, 0.6, 31.0, (-0.2, 0.4))
    tree = Tree(root, {REFERENCE: mapped, QUERY: asked})
    write_calibration(root)
    write_drive(tree, REFERENCE, REFERENCES, scans=range(REFERENCES[0], REFERENCES[-1] + 1))
    write_drive(tree, QUERY, QUERIES, {"conditions": Conditions(light="overcast"), "seed": 1})
    return tree


SCENE = """
kind = "kitti360"
name = "small drive"
root = "KITTI-360"
reference_sequence = 5
query_sequence = 4
camera = "image_02"
"""
