"""Depth maps in the .dpt format of Matterport360 (and of MPI Sintel): a tag, a size, and floats."""

import os
import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spherloc.errors import InputError
from spherloc.files import open_file, reading
from spherloc.images import MAX_PIXELS

TAG = 202021.25
HEADER = struct.Struct("<fii")


def read_dpt(path: Path) -> NDArray[np.float32]:
    """Depth (H, W), metres, as it is stored: what is not positive and finite is no depth.

    Layout: float32 tag 202021.25, int32 width, int32 height, then float32 row by row, all little endian. Raises
    ``InputError`` for a missing file, another tag, or a size that does not fit the file's.
    """
    with reading(path, "the panorama beside it needs this depth map"), open_file(path) as file:
        header = file.read(HEADER.size)
        if len(header) < HEADER.size:
            raise InputError(f"{path}: is only {len(header)} bytes long; replace this depth map.")
        tag, width, height = HEADER.unpack(header)
        if tag != TAG:
            hint = "; its byte order is reversed" if struct.unpack(">f", header[:4])[0] == TAG else ""
            raise InputError(f"{path}: does not begin with the tag {TAG}{hint}; give a .dpt depth map.")
        count = width * height
        if width < 1 or height < 1 or count > MAX_PIXELS:
            raise InputError(f"{path}: claims {width} x {height} pixels; replace this depth map.")
        length = os.fstat(file.fileno()).st_size - HEADER.size
        if length != 4 * count:
            raise InputError(
                f"{path}: {length:,} bytes follow its header, but {width} x {height} pixels take {4 * count:,}; "
                "replace this depth map."
            )
        content = file.read(4 * count)
    return np.frombuffer(content, "<f4").reshape(height, width)
