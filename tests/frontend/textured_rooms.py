"""Pictures of rooms with random wallpaper, through any camera, with exact ranges: real matching on known geometry."""

from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from spherloc.cameras.base import Camera
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.cameras.mei import Mei
from spherloc.frontend.lifting import DepthLift
from spherloc.frontend.view import View
from spherloc.geometry import camera_centre, pose, so3_exp
from spherloc.types import FloatArray

PANORAMA = Equirectangular(512, 256)
FISHEYE = KannalaBrandt(300, 290, 94.0, 95.0, 151.0, 144.0, (0.02, -0.01, 0.003, -0.0005))
MEI = Mei(300, 300, 247.0, 247.0, 149.0, 152.0, 1.4, (0.05, -0.02, 0.0003, -0.0002))
HALF_M = np.array([3.0, 1.6, 4.0])
TEXELS = 300


@lru_cache
def wallpaper(seed: int) -> np.ndarray:
    """(6, TEXELS, TEXELS) grey levels, spots and stripes of sizes that differ from one paper to another."""
    random = np.random.default_rng(seed)
    walls = np.zeros((6, TEXELS, TEXELS), np.float32)
    sizes = [(10, 10), (40, 40), *random.permutation([(15, 90), (90, 15), (80, 80)])[:2]]
    for wall in walls:
        for size in sizes:
            noise = random.normal(size=size).astype(np.float32)
            wall += cv2.resize(noise, (TEXELS, TEXELS), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 35 * walls, 0, 255)


def look(camera: Camera, cam_from_map: FloatArray, walls: np.ndarray) -> tuple[np.ndarray, FloatArray]:
    """Image (H, W) bytes and ranges (H, W), m, NaN where the camera sees nothing; the room is centred in the map."""
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    bearings, seen = camera.unproject(np.column_stack([columns.ravel(), rows.ravel()]))
    rays, centre = bearings @ cam_from_map[:, :3], camera_centre(cam_from_map)
    with np.errstate(divide="ignore", invalid="ignore"):
        to_walls = (np.sign(rays) * HALF_M - centre) / rays
    ranges = np.min(np.where(seen[:, None], to_walls, np.inf), axis=1)
    axis = to_walls.argmin(axis=1)
    places = (centre + ranges[:, None] * rays) / HALF_M
    image = np.zeros(len(rays), np.float32)
    for side in range(6):
        on = seen & (axis == side // 2) & ((rays[np.arange(len(rays)), axis] > 0) == bool(side % 2))
        u, v = ((np.delete(places[on], side // 2, axis=1) + 1) / 2 * (TEXELS - 1)).T.astype(np.float32)
        if on.any():
            image[on] = map_coordinates(walls[side], np.stack([u, v]), order=1)
    shape = (camera.height, camera.width)
    return image.reshape(shape).round().astype(np.uint8), np.where(seen, ranges, np.nan).reshape(shape)


def standing(x: float, z: float, yaw_rad: float) -> FloatArray:
    """Pose (3, 4) of an upright camera; y of map and camera points down."""
    rotation = so3_exp(np.array([0.0, yaw_rad, 0.0]))
    return pose(rotation, -rotation @ np.array([x, 0.1, z]))


def room_view(
    folder: Path,
    name: str,
    camera: Camera,
    cam_from_map: FloatArray,
    walls: np.ndarray,
) -> View:
    """A view whose image is written as a PNG, lifted by its true depth."""
    image, ranges = look(camera, cam_from_map, walls)
    path = folder / f"{name}.png"
    cv2.imwrite(str(path), image)
    return View(name, camera, path, cam_from_map, lift=DepthLift(lambda: ranges, camera, cam_from_map, "ray"))
