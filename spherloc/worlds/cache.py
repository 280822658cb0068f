"""Renders that are kept on disk: the same picture is drawn once."""

import io
import zipfile
import zlib
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from spherloc.cameras.base import Camera
from spherloc.disk_cache import cache_folder, key_of, make_room_once, store, used
from spherloc.errors import InputError
from spherloc.images import read_image
from spherloc.types import FloatArray
from spherloc.worlds.conditions import CLEAR, Conditions
from spherloc.worlds.render import Render, draw
from spherloc.worlds.world import World


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

    ``name`` is the stem of the file, for people to read.
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
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error, NotImplementedError):
        return None
    right = range_m.shape == (camera.height, camera.width) and range_m.dtype == np.float32
    return range_m if right else None


def _stored_image(path: Path, camera: Camera):
    try:
        image = read_image(path)
    except InputError:
        return None
    return image if image.shape == (camera.height, camera.width, 3) else None
