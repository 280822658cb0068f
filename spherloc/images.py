"""Reads images. Pixels are used as they are stored: a calibration does not consider a photograph's orientation tag.

Those of 16 bits become 8 by the bits that the image uses: cameras with 10 or 12 bits fill the lower ones.
"""

import io
import warnings
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from spherloc.errors import InputError
from spherloc.files import open_file, read_file, reading
from spherloc.types import ByteArray

MAX_BYTES = 200_000_000
MAX_PIXELS = 150_000_000
"""Largest number of pixels, beyond any panorama, so that a corrupt header cannot exhaust the memory."""

USED_BITS = (8, 10, 12, 16)
"""How many bits of 16 cameras use. Of 16 bits that stop below 12 hardly anything could be seen."""

ORIENTATION = 0x0112
"""EXIF's tag of how to turn the pixels: 1 for not at all, up to 8."""
HEIF = tuple(b"ftyp" + brand for brand in (b"heic", b"heix", b"hevc", b"mif1", b"avif"))
"""How files of HEIC and AVIF begin, after four bytes; a photograph that was sent or copied may be one named .jpg."""


class DamagedImageError(InputError):
    """A file that can be read holds no image, or not all of one."""


def read_image(path: Path) -> ByteArray:
    """An image as (H, W, 3) BGR or (H, W) grey bytes.

    Raises ``InputError`` for a file that is missing, unreadable, too large, not an image or one of other numbers than
    integers of 8 or 16 bits.
    """
    return _read(path, cv2.IMREAD_ANYCOLOR)


def read_depth_png(path: Path) -> NDArray[np.uint16]:
    """A depth map (H, W) of 16-bit numbers, whose unit the caller knows.

    Raises ``InputError`` for a file that is missing, unreadable, too large or does not have one channel of 16 bits.
    """
    image = _decode(path, cv2.IMREAD_UNCHANGED)
    if image.dtype != np.uint16 or image.ndim != 2:
        raise InputError(f"{path}: is not a depth map; give a PNG with one channel of 16 bits.")
    return image


def read_size(path: Path) -> tuple[int, int]:
    """Width and height of an image, px, by its header alone.

    Raises ``InputError`` for a file that is missing, too large or not an image.
    """
    path = Path(path)
    with reading(path, "correct the path of the image"), open_file(path) as file:
        return _size(file, path)


def orientation_of(path: Path) -> int:
    """The orientation tag of a photograph: by 2 to 8 programs show it turned or mirrored, from 5 on by a quarter turn.

    1 without a valid tag; those of PNGs, for which all of it would be decoded, are not looked for.
    """
    try:
        with warnings.catch_warnings(action="ignore"), open_file(path) as file, Image.open(file) as image:
            tag = 1 if image.format == "PNG" else image.getexif().get(ORIENTATION, 1)
            return tag if tag in range(2, 9) else 1
    except Exception:  # Pillow passes on whatever a damaged tag raises
        return 1


def check_image(path: Path) -> tuple[int, int]:
    """Width and height of an image, px, after all of it was decoded: JPEGs in a tenth of the usual time.

    Raises ``InputError`` as ``read_image`` does, ``DamagedImageError`` if the file itself is at fault; ``read_size``
    does not notice that its end is missing.
    """
    size = read_size(path)
    read_eighth(path)
    return size


def read_eighth(path: Path) -> ByteArray:
    """An image as grey bytes (H / 8, W / 8): a JPEG in a tenth of the usual time.

    Raises ``InputError`` as ``read_image`` does.
    """
    return _read(path, cv2.IMREAD_REDUCED_GRAYSCALE_8)


def read_reduced(path: Path, least_px: int) -> ByteArray:
    """An image as grey bytes (H / N, W / N), N at most 8 and such that its longer side has ``least_px`` or more.

    Raises ``InputError`` as ``read_image`` does.
    """
    longer = max(read_size(path))
    flags = (
        (8, cv2.IMREAD_REDUCED_GRAYSCALE_8),
        (4, cv2.IMREAD_REDUCED_GRAYSCALE_4),
        (2, cv2.IMREAD_REDUCED_GRAYSCALE_2),
    )
    flag = next((flag for divisor, flag in flags if longer >= divisor * least_px), cv2.IMREAD_GRAYSCALE)
    return _read(path, flag)


def grey(image: ByteArray) -> ByteArray:
    """Grey image (H, W) of a BGR or grey image."""
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)


def _read(path: Path, flag: int) -> ByteArray:
    image = _decode(path, flag | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION)
    if image.dtype == np.uint16:
        most = int(image.max())
        image = (image >> next(bits - 8 for bits in USED_BITS if most < 1 << bits)).astype(np.uint8)
    if image.dtype != np.uint8 or image.ndim not in (2, 3):
        raise InputError(f"{path}: has {image.dtype} pixels; give an image with 8 or 16 bits a channel.")
    return image


def _decode(path: Path, flags: int) -> NDArray:
    path = Path(path)
    with reading(path, "correct the path of the image"):
        content = read_file(path, MAX_BYTES)
    _size(io.BytesIO(content), path)
    try:
        image = cv2.imdecode(np.frombuffer(content, np.uint8), flags) if content else None
    except cv2.error:
        image = None
    if image is None or image.size == 0:
        raise DamagedImageError(f"{path}: not an image that can be read, or a damaged one; replace it.")
    return image


def _size(file: BinaryIO, path: Path) -> tuple[int, int]:
    """Width and height by the header, px; a decoder would allocate all memory that a damaged header asks for."""
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(file) as image:
            width, height = image.size
    except Image.DecompressionBombError:  # Pillow's own limit is a little higher than ours
        width, height = MAX_PIXELS, MAX_PIXELS
    except Exception:  # Pillow's readers pass on whatever a damaged header raises
        if path.suffix.lower() in (".tif", ".tiff"):  # Pillow lacks kinds such as colours in floating-point numbers
            raise InputError(f"{path}: is damaged, or a TIFF of a kind that is not read; save it as PNG.") from None
        file.seek(0)
        if file.read(12)[4:] in HEIF:
            raise InputError(f"{path}: is HEIC or AVIF, whatever its name says; convert it to JPEG or PNG.") from None
        raise DamagedImageError(f"{path}: not an image that can be read, or a damaged one; replace it.") from None
    if not 0 < width * height <= MAX_PIXELS:
        raise InputError(f"{path}: claims 0 pixels or more than {MAX_PIXELS:,}; give a smaller image.")
    return width, height
