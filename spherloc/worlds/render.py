"""Pictures of a world through any camera model, with the distance along every ray."""

import io
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from spherloc.cameras.base import Camera
from spherloc.disk_cache import DAMAGED_NPZ, cache_folder, key_of, make_room_once, store, used
from spherloc.errors import InputError
from spherloc.geometry import camera_centre
from spherloc.images import read_image
from spherloc.types import BoolArray, ByteArray, FloatArray
from spherloc.worlds.conditions import CLEAR, Conditions
from spherloc.worlds.occluders import with_occluders
from spherloc.worlds.rays import Hits, RayScene
from spherloc.worlds.shading import GAMMA, Lighting
from spherloc.worlds.world import World

CORNERS = np.array([[-0.125, -0.375], [0.375, -0.125], [0.125, 0.375], [-0.375, 0.125]])
"""Where a pixel at an edge is sampled, from its centre, px."""
SAME_PLANE_M = 0.02
BLOCK = 65536
"""Rays that are followed at once."""


@dataclass(frozen=True, eq=False)
class Render:
    """One picture."""

    image: ByteArray
    """(H, W, 3) BGR; black where the camera model cannot see."""
    range_m: NDArray[np.float32]
    """(H, W) distance along the ray of each pixel's centre; inf where nothing is hit, NaN where none can see."""


def draw(
    world: World, camera: Camera, cam_from_world: FloatArray, conditions: Conditions = CLEAR, seed: int = 0
) -> Render:
    """Cast a ray through every pixel, and four more where surfaces meet.

    ``cam_from_world`` is the camera's pose (3, 4); ``seed`` places occluders and makes noise.
    """
    rotation, centre = cam_from_world[:, :3], camera_centre(cam_from_world)
    rays = with_occluders(world, centre, conditions.occluders, seed)
    lighting = Lighting(world, rays, conditions)
    shape = (camera.height, camera.width)
    columns, rows = np.meshgrid(np.arange(float(shape[1])) + 0.5, np.arange(float(shape[0])) + 0.5)
    pixels: FloatArray = np.column_stack([columns.ravel(), rows.ravel()])
    bearings, seen = camera.unproject(pixels)
    angle = _pixel_angle(bearings.reshape(*shape, 3)).ravel()
    directions = bearings @ rotation
    colours = np.zeros((seen.size, 3), np.float32)
    face, range_m = np.full(seen.size, -2, np.int32), np.full(seen.size, np.nan)
    for block in _blocks(np.flatnonzero(seen)):
        hits = rays.cast(centre, directions[block])
        colours[block] = lighting.colours(centre, directions[block], hits, angle[block])
        face[block], range_m[block] = hits.face, hits.range_m
    away = directions * np.where(np.isfinite(range_m), range_m, 0.0)[:, None]
    edges = np.flatnonzero(_edges(rays, face.reshape(shape), away.reshape(*shape, 3)).ravel() & seen)
    for block in _blocks(edges):
        colours[block] = _refined(lighting, camera, rotation, centre, pixels[block], angle[block])
    image = _developed(colours.reshape(*shape, 3), seen.reshape(shape), camera, conditions, seed)
    return Render(image, range_m.reshape(shape).astype(np.float32))


def _blocks(index: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Pieces whose temporary arrays stay in the processor's cache, which halves the time."""
    return np.array_split(index, -(-len(index) // BLOCK)) if len(index) else []


def _pixel_angle(bearings: FloatArray) -> FloatArray:
    """(H, W): the larger of a pixel's two sizes, radians."""
    size = np.zeros(bearings.shape[:2])
    for axis in (0, 1):
        step = np.linalg.norm(np.diff(bearings, axis=axis), axis=2)
        pad = [(0, 1) if a == axis else (0, 0) for a in (0, 1)]
        size = np.fmax(size, np.pad(step, pad, mode="edge"))
    return np.maximum(size, 1e-5)


def _edges(rays: RayScene, face: NDArray[np.int32], places: FloatArray) -> BoolArray:
    """(H, W): pixels one of whose neighbours shows another part that does not continue this one's plane."""
    surface = np.where(face >= 0, rays.mesh.surface[face], face)
    edge = np.zeros(face.shape, dtype=bool)
    for axis in (0, 1):
        first = tuple(slice(None, -1) if a == axis else slice(None) for a in (0, 1))
        second = tuple(slice(1, None) if a == axis else slice(None) for a in (0, 1))
        rows, columns = np.nonzero((surface[first] != surface[second]) & (face[first] > -2) & (face[second] > -2))
        other = (rows + (axis == 0), columns + (axis == 1))
        here, there = face[rows, columns], face[other]
        step = places[other] - places[rows, columns]
        off = np.abs(np.einsum("ij,ij->i", rays.normals[here], step))
        turned = np.einsum("ij,ij->i", rays.normals[here], rays.normals[there]) < 0.999
        apart = (here < 0) | (there < 0) | turned | (off > SAME_PLANE_M)
        edge[rows[apart], columns[apart]] = True
        edge[other[0][apart], other[1][apart]] = True
    return edge


def _refined(
    lighting: Lighting, camera: Camera, rotation: FloatArray, centre: FloatArray, pixels: FloatArray, angle: FloatArray
) -> NDArray[np.float32]:
    """Mean colour (N, 3) of four rays through each of ``pixels`` (N, 2)."""
    if len(pixels) == 0:
        return np.empty((0, 3), np.float32)
    spread = (pixels[:, None] + CORNERS).reshape(-1, 2)
    bearings, seen = camera.unproject(spread)
    directions = bearings[seen] @ rotation
    hits: Hits = lighting.rays.cast(centre, directions)
    colours = np.zeros((len(spread), 3), np.float32)
    colours[seen] = lighting.colours(centre, directions, hits, 0.5 * np.repeat(angle, len(CORNERS))[seen])
    weights = seen.reshape(-1, len(CORNERS), 1)
    return (colours.reshape(-1, len(CORNERS), 3) * weights).sum(axis=1) / np.maximum(weights.sum(axis=1), 1)


def _developed(
    linear: NDArray[np.float32], seen: BoolArray, camera: Camera, conditions: Conditions, seed: int
) -> ByteArray:
    """Bytes BGR of linear RGB: blur, exposure, a film's soft shoulder, noise."""
    linear = _blurred(linear, conditions, wraps=camera.model == "equirectangular")
    bright = linear * np.float32(2.0**conditions.exposure_stops)
    # A soft shoulder: highlights lose contrast before they burn out.
    mapped = bright * (1 + bright / 6.0) / (1 + 0.55 * bright)
    picture = 255 * np.clip(mapped, 0, 1) ** (1 / GAMMA)
    if conditions.noise > 0:
        rng = np.random.default_rng([seed, 53])
        picture = picture + conditions.noise * rng.standard_normal(picture.shape, dtype=np.float32)
    picture[~seen] = 0
    return np.round(np.clip(picture, 0, 255)).astype(np.uint8)[..., ::-1].copy()


def _blurred(linear: NDArray[np.float32], conditions: Conditions, wraps: bool) -> NDArray[Any]:
    margin = int(np.ceil(3 * conditions.defocus_px + conditions.motion_blur_px)) + 1
    if margin == 1:
        return linear
    wide = np.pad(linear, [(0, 0), (margin, margin), (0, 0)], mode="wrap" if wraps else "edge")
    if conditions.defocus_px > 0:
        wide = cv2.GaussianBlur(wide, (0, 0), conditions.defocus_px)
    if conditions.motion_blur_px > 1:
        length = round(conditions.motion_blur_px)
        wide = cv2.blur(wide, (length, 1))
    return wide[:, margin:-margin]


@cache
def sources_hash() -> str:
    """Of the code that draws worlds: a picture of an older version is not this one's."""
    folder = Path(__file__).parent
    return key_of(*(path.read_bytes() for path in sorted(folder.rglob("*.py"))))


def image_path(
    world: World,
    camera: Camera,
    cam_from_world: FloatArray,
    conditions: Conditions = CLEAR,
    seed: int = 0,
    name: str = "render",
) -> Path:
    """Where the picture is kept, whether or not it was drawn yet; its distances are beside it with the suffix .npz.

    ``cam_from_world`` is the camera's pose (3, 4); ``name`` is the stem of the file, for people to read.
    """
    place = np.ascontiguousarray(cam_from_world, np.float64).tobytes()
    key = key_of(*world.identity(), sorted(camera.to_dict().items()), place, conditions, seed, sources_hash())
    return cache_folder("renders") / key / f"{name}.png"


def render(
    world: World,
    camera: Camera,
    cam_from_world: FloatArray,
    conditions: Conditions = CLEAR,
    seed: int = 0,
    name: str = "render",
) -> Render:
    """A picture and its distances, from the cache on disk if they are there.

    ``cam_from_world`` (3, 4) is [R | t], metres. The same arguments give the same picture; a damaged file of the cache
    is drawn again, and a cache that cannot be written costs only time.
    """
    path = image_path(world, camera, cam_from_world, conditions, seed, name)
    image, range_m = _stored_image(path, camera), stored_range(path, camera)
    if image is not None and range_m is not None:
        used(path)
        used(path.with_suffix(".npz"))
        return Render(image, range_m)
    make_room_once(cache_folder("renders"))
    picture = draw(world, camera, cam_from_world, conditions, seed)
    done, png = cv2.imencode(".png", picture.image, [cv2.IMWRITE_PNG_COMPRESSION, 3])
    if done:
        packed = io.BytesIO()
        np.savez_compressed(packed, range_m=picture.range_m)
        store(path.with_suffix(".npz"), packed.getvalue())
        store(path, png.tobytes())
    return picture


def stored_range(path: Path, camera: Camera) -> NDArray[np.float32] | None:
    """(H, W) of the file of distances beside a picture's ``path``; None if it is missing or damaged."""
    try:
        with np.load(path.with_suffix(".npz"), allow_pickle=False) as content:
            range_m = content["range_m"]
    except DAMAGED_NPZ:
        return None
    right = range_m.shape == (camera.height, camera.width) and range_m.dtype == np.float32
    return range_m if right else None


def _stored_image(path: Path, camera: Camera):
    try:
        image = read_image(path)
    except InputError:
        return None
    return image if image.shape == (camera.height, camera.width, 3) else None
