"""Files of the Newer College Dataset: images whose names carry their time, and the prior map's point cloud."""

import os
import re
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from spherloc.errors import InputError, reason, shorten
from spherloc.files import names_in, open_file, reading
from spherloc.trajectory import NS_PER_S

ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
NAME_RULE = "names like 1625133000_123456789.png (seconds_nanoseconds) or 1625133000123456789.png (nanoseconds)"
MAX_CLOUD_BYTES = 1 << 32
"""The whole campus at a centimetre takes a few gigabytes."""
_HEADER_BYTES = 1 << 16
_ELEMENT = re.compile(rb"element\s+(\S+)\s+(\d{1,18})\s*$")
_SECONDS = re.compile(r"(?:.*\D)?(\d{9,10})_(\d{1,9})", re.ASCII)
_NANOSECONDS = re.compile(r"(?:.*\D)?(\d{18,19})", re.ASCII)


@dataclass(frozen=True)
class TimedImage:
    """An image file."""

    name: str
    """Its path below the folder, with forward slashes."""
    path: Path
    timestamp_ns: int


def timestamp_of(name: str) -> int | None:
    """Nanoseconds that an image's name ends with, as <seconds>_<nanoseconds> or as nanoseconds; None for other names.

    Something else may precede: infra1_1583836591_182590976.png. The nanoseconds need not have leading zeros.
    """
    stem = PurePosixPath(name).stem
    if match := _SECONDS.fullmatch(stem):
        return int(match[1]) * NS_PER_S + int(match[2])
    if match := _NANOSECONDS.fullmatch(stem):
        return int(match[1])
    return None


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
    """Points (N, 3) of a PLY file, metres; kept, because all references share them.

    Raises ``InputError`` for what is no such file or holds no finite point.
    """
    import trimesh  # takes half a second

    _check_header(path)
    try:
        cloud = trimesh.load(path, file_type="ply", process=False)
        points = np.asarray(getattr(cloud, "vertices", ()), dtype=np.float32).reshape(-1, 3)
    except Exception as error:  # trimesh lets whatever its parsers stumble over through
        raise InputError(f"{path}: no readable PLY point cloud ({reason(error)}); export the map again.") from None
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        raise InputError(f"{path}: holds no finite point; export the map again.")
    points.setflags(write=False)
    return points


def _check_header(path: Path) -> None:
    """Refuse what claims more than it holds before anything is allocated for it."""
    with reading(path, "give the prior map as a PLY file"), open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        header, end, _ = file.read(_HEADER_BYTES).partition(b"end_header")
    if not header.startswith(b"ply") or not end or size > MAX_CLOUD_BYTES:
        raise InputError(f"{path}: no PLY file of at most {MAX_CLOUD_BYTES >> 30} GiB; give the prior map as one.")
    lines = [line.strip() for line in header.splitlines() if line.startswith(b"element")]
    matches = [_ELEMENT.match(line) for line in lines]
    if not lines or not all(matches) or sum(int(match[2]) for match in matches if match) > size:
        raise InputError(f"{path}: its header claims more points than fit into {size} bytes; export the map again.")
