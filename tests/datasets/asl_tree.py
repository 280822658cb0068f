"""A recorded sequence in the layouts of EuRoC and of TUM-VI: two small cameras, an IMU that turns, ground truth."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

START = 1_520_530_308_199_447_626
STEP_NS = 50_000_000
SIZE = (64, 48)


def transform(rotation, translation):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return matrix


@dataclass(frozen=True)
class Tree:
    """What was written, and the truth."""

    folder: Path
    times: list[int]
    body_from_camera: dict[str, np.ndarray]
    body_from_imu: np.ndarray
    world_from_body: dict[int, np.ndarray]
    """(4, 4) by time."""
    down: np.ndarray
    """(3,) in the world of the ground truth."""

    @property
    def mav(self):
        return self.folder / "mav0"

    def down_in(self, camera, time):
        """Down in a camera's frame."""
        return (self.world_from_body[time] @ self.body_from_camera[camera])[:3, :3].T @ self.down

    def centre_of(self, camera, time):
        """The centre of a camera in the world of the ground truth."""
        return (self.world_from_body[time] @ self.body_from_camera[camera])[:3, 3]


def _yaml(matrix):
    numbers = ",\n         ".join(", ".join(f"{value:.12f}" for value in row) for row in matrix)
    return f"T_BS:\n  cols: 4\n  rows: 4\n  data: [{numbers}]\n"


def _rows(matrix):
    return "".join(f"  - [{', '.join(f'{value:.12f}' for value in row)}]\n" for row in matrix)


LENS = ("pinhole", "equidistant", [20.0, 21.0, 31.5, 23.5], [0.01, -0.002, 0.001, 0.0])


def sensor_yaml(matrix, focal=20.0):
    camera_model, distortion_model, (_, *others), coefficients = LENS
    return (
        f"# General sensor definitions.\nsensor_type: camera\ncomment: VI-Sensor\n\n{_yaml(matrix)}rate_hz: 20\n"
        f"resolution: [{SIZE[0]}, {SIZE[1]}]\ncamera_model: {camera_model}\n"
        f"intrinsics: {[focal, *others]} #fu, fv, cu, cv\n"
        f"distortion_model: {distortion_model}\ndistortion_coefficients: {coefficients}\n"
    )


def euroc(folder, rng, count=12):
    """EuRoC: ``sensor.yaml`` with ``T_BS`` of every sensor, which are no identities."""
    tree = _sequence(folder, rng, count)
    for number, (camera, matrix) in enumerate(tree.body_from_camera.items()):
        (tree.mav / camera / "sensor.yaml").write_text(sensor_yaml(matrix, 20.0 + number))
    (tree.mav / "imu0" / "sensor.yaml").write_text(f"sensor_type: imu\n{_yaml(tree.body_from_imu)}rate_hz: 200\n")
    truth = tree.mav / "state_groundtruth_estimate0"
    truth.mkdir()
    body_from_marker = transform(Rotation.random(random_state=8).as_matrix(), rng.normal(size=3))
    (truth / "sensor.yaml").write_text(f"sensor_type: visual-inertial\n{_yaml(body_from_marker)}")
    _write_truth(truth / "data.csv", tree, body_from_marker, ",0" * 9)
    return tree


def tum_vi(folder, rng, count=12, key="T_cam_imu"):
    """TUM-VI: a Kalibr chain in ``dso``, and poses of the IMU. If ``key`` is T_cn_cnm1, the second camera is placed
    by the first alone."""
    tree = _sequence(folder, rng, count)
    imu_from = {name: np.linalg.inv(tree.body_from_imu) @ one for name, one in tree.body_from_camera.items()}
    text = ""
    for number, (camera, imu_from_camera) in enumerate(imu_from.items()):
        camera_model, distortion_model, (_, *others), coefficients = LENS
        text += f"{camera}:\n"
        if key == "T_imu_cam":
            text += f"  T_imu_cam:\n{_rows(imu_from_camera)}"
        elif key == "T_cam_imu" or number == 0:
            text += f"  T_cam_imu:\n{_rows(np.linalg.inv(imu_from_camera))}"
        if number:
            text += f"  T_cn_cnm1:\n{_rows(np.linalg.inv(imu_from_camera) @ imu_from['cam0'])}"
        text += (
            f"  camera_model: {camera_model}\n  distortion_model: {distortion_model}\n"
            f"  distortion_coeffs: {coefficients}\n"
            f"  intrinsics: {[20.0 + number, *others]}\n  resolution: [{SIZE[0]}, {SIZE[1]}]\n"
        )
    for path in tree.mav.glob("cam*/data/*.png"):  # of 16 bits
        cv2.imwrite(str(path), 256 * cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).astype(np.uint16))
    (folder / "dso" / "cam0").mkdir(parents=True)
    (folder / "dso" / "camchain.yaml").write_text(text)
    (folder / "dso" / "cam0" / "camera.txt").write_text("EquiDistant 0.373 0.373 0.498 0.499 0 0 0 0\n64 48\n")
    (folder / "dso" / "imu_config.yaml").write_text("update_rate: 200\nrostopic: /imu0\n")
    (tree.mav / "mocap0").mkdir()
    _write_truth(tree.mav / "mocap0" / "data.csv", tree, tree.body_from_imu, "")
    return tree


def _sequence(folder, rng, count):
    times = [START + STEP_NS * k for k in range(count)]
    body_from_camera = {
        f"cam{k}": transform(Rotation.random(random_state=k).as_matrix(), rng.normal(size=3)) for k in range(2)
    }
    body_from_imu = transform(Rotation.random(random_state=7).as_matrix(), rng.normal(size=3))
    down = rng.normal(size=3)
    down /= np.linalg.norm(down)
    held, axis = Rotation.random(random_state=9), rng.normal(size=3)
    held_at = {time: held * Rotation.from_rotvec(0.4 * k * STEP_NS * 1e-9 * axis) for k, time in enumerate(times)}
    poses = {time: transform(turn.as_matrix(), rng.normal(size=3)) for time, turn in held_at.items()}
    tree = Tree(folder, times, body_from_camera, body_from_imu, poses, down)
    rows = ["#timestamp [ns],w_RS_S_x [rad s^-1],w_y,w_z,a_RS_S_x [m s^-2],a_y,a_z"]
    turn = body_from_imu[:3, :3].T
    for k in range(-200, 200 + 10 * count):
        world_from_body = (held * Rotation.from_rotvec(0.4 * k * 0.005 * axis)).as_matrix()
        force = turn @ world_from_body.T @ (-9.81 * down) + rng.normal(0.0, 0.02, 3)
        numbers = [*(turn @ (0.4 * axis)), *force]
        rows.append(f"{START + 5_000_000 * k},{','.join(f'{value:.9f}' for value in numbers)}")
    (tree.mav / "imu0").mkdir(parents=True)
    (tree.mav / "imu0" / "data.csv").write_text("\n".join(rows) + "\n")
    for camera in body_from_camera:
        images = tree.mav / camera / "data"
        images.mkdir(parents=True)
        for time in times:
            cv2.imwrite(str(images / f"{time}.png"), rng.integers(0, 255, (SIZE[1], SIZE[0]), np.uint8))
        (images.parent / "data.csv").write_text(
            "#timestamp [ns],filename\r\n" + "".join(f"{time},{time}.png\r\n" for time in times)
        )
    return tree


def _write_truth(path, tree, body_from_sensor, more):
    rows = ["#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"]
    for time, world_from_body in tree.world_from_body.items():
        pose = world_from_body @ body_from_sensor
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        rows.append(f"{time},{','.join(f'{value:.9f}' for value in (*pose[:3, 3], w, x, y, z))}{more}")
    path.write_text("\n".join(rows) + "\n")
