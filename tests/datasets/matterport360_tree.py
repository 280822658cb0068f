"""Writes a building in Matterport360's layout, rendered, with known poses."""

from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.datasets.matterport360 import CAMERA_FROM_BLENDER
from spherloc.geometry import camera_centre
from spherloc.worlds import build_world, render


def write_dpt(path: Path, depth: np.ndarray) -> None:
    """Tag, width, height and rows, as the dataset has them."""
    size = np.array(depth.shape[::-1], "<i4")
    path.write_bytes(np.array([202021.25], "<f4").tobytes() + size.tobytes() + depth.astype("<f4").tobytes())


def write_pose(path: Path, cam_from_map: np.ndarray) -> None:
    """Camera centre, then x y z w of the camera (Blender's axes) to world rotation."""
    world_from_blender = cam_from_map[:, :3].T @ CAMERA_FROM_BLENDER
    numbers = [*camera_centre(cam_from_map), *Rotation.from_matrix(world_from_blender).as_quat()]
    path.write_text(" ".join(f"{number:.9f}" for number in numbers) + "\n")


def write_building(folder: Path, count: int, width: int = 768) -> np.ndarray:
    """Panoramas pano0 to pano<count - 1> along the apartment's path; returns their poses (count, 3, 4)."""
    folder.mkdir(parents=True, exist_ok=True)
    world, camera = build_world("apartment"), Equirectangular(width, width // 2)
    poses = world.route(count, stop=0.35)
    for number, cam_from_map in enumerate(poses):
        picture = render(world, camera, cam_from_map)
        stem = folder / f"pano{number}"
        cv2.imwrite(f"{stem}_rgb.png", picture.image)
        write_dpt(Path(f"{stem}_depth.dpt"), np.where(np.isfinite(picture.range_m), picture.range_m, 0.0))
        write_pose(Path(f"{stem}_pose.txt"), cam_from_map)
    return poses
