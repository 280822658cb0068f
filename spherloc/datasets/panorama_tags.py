"""What a 360-degree camera writes into its photographs: pitch and roll, and that they are panoramas, in an XMP packet
after Google's Photo Sphere metadata (https://developers.google.com/streetview/spherical-metadata)."""

import struct
import warnings
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO
from xml.etree import ElementTree

import numpy as np
from PIL import Image

from spherloc.errors import InputError, shorten, show
from spherloc.files import open_file, reading
from spherloc.formats.text_rows import finite_numbers
from spherloc.frontend.view import Gravity, View
from spherloc.types import FloatArray

SOURCE = "pitch and roll in the photograph's tags"
MAX_BYTES = 1_000_000
_MAX_CHUNKS = 100_000
_PNG_KEY = "XML:com.adobe.xmp"
_EXTENSION = b"http://ns.adobe.com/xmp/extension/\0"
"""What a segment of a JPEG begins with that has a piece of an extended packet; the packet's name, 32 digits, follows,
then the length of the whole packet and the piece's place in it."""
_GPANO = "{http://ns.google.com/photos/1.0/panorama/}"
_PITCH, _ROLL = "PosePitchDegrees", "PoseRollDegrees"
_LIMITS_DEG = {_PITCH: 90.0, _ROLL: 360.0}
"""Largest absolute values; of roll, 355 degrees are -5."""


def gravity_from_tags(view: View, near: FloatArray | None = None) -> Gravity:
    """Gravity of a panorama by the pitch and roll in its XMP packet; ``near`` (3,) is not used.

    Raises ``InputError`` if the image cannot be read, or if its tags hold no pitch and roll or no valid angle.
    """
    place = shorten(view.name)
    packets = _packets(view.path)
    if not packets:
        raise InputError(f"{place}: has no XMP tags, which would hold its pitch and roll.")
    pitch_deg, roll_deg = _pitch_and_roll(packets, place)
    return Gravity(down_of(np.radians(pitch_deg), np.radians(roll_deg)), SOURCE)


def down_of(pitch_rad: float, roll_rad: float) -> FloatArray:
    """Down (3,) in the camera frame of a panorama whose middle is ``pitch_rad`` above the horizon.

    The horizon is turned counterclockwise in the image by ``roll_rad``.
    """
    level = np.cos(pitch_rad)
    return np.array([level * np.sin(roll_rad), level * np.cos(roll_rad), -np.sin(pitch_rad)])


def _packets(path: Path) -> list[bytes]:
    """The XMP packet of an image, and the one that extends it if its JPEG has one; none if it has no packet."""
    with reading(path, "correct the path of the image"), open_file(path) as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            with Image.open(file) as image:
                packet = image.info.get("xmp") or image.info.get(_PNG_KEY)
                segments = getattr(image, "applist", ())
                if not packet and image.format == "PNG":
                    packet = _late_packet(file)
        except (Image.UnidentifiedImageError, Image.DecompressionBombError, SyntaxError, ValueError):
            raise InputError(f"{path}: is not an image that can be read; give another one.") from None
    if not packet:
        return []
    main = packet.encode() if isinstance(packet, str) else packet
    extended = _extended(main, [data for name, data in segments if name == "APP1"])
    return [main] if extended is None else [main, extended]


def _late_packet(file: BinaryIO) -> bytes | None:
    """The XMP packet of a PNG that has it after its pixels, as ExifTool writes it, without decoding these."""
    file.seek(8)
    for _ in range(_MAX_CHUNKS):
        length, kind = struct.unpack(">I4s", file.read(8).ljust(8, b"\0"))
        if kind in (b"IEND", b"\0\0\0\0"):
            return None
        if kind != b"iTXt" or length > MAX_BYTES:
            file.seek(length + 4, 1)
            continue
        key, _, rest = file.read(length).partition(b"\0")
        file.seek(4, 1)
        if key == _PNG_KEY.encode() and len(rest) > 1:
            text = rest[2:].split(b"\0", 2)[-1]  # after a language and a translated key
            return text if rest[0] == 0 else _inflated(text)
    return None


def _inflated(text: bytes) -> bytes:
    """The text, of which no more is read than a packet may have; empty if it is damaged."""
    try:
        return zlib.decompressobj().decompress(text, MAX_BYTES + 1)
    except zlib.error:
        return b""


def _extended(main: bytes, segments: Sequence[bytes]) -> bytes | None:
    """The packet that extends the ``main`` one, in pieces in segments of a JPEG (XMP specification, part 3); None if
    there is none, or if it is not there as a whole."""
    pieces: dict[int, bytes] = {}
    whole = 0
    for data in segments:
        if data.startswith(_EXTENSION) and len(data) >= len(_EXTENSION) + 40:
            name, place = data[len(_EXTENSION) :][:32], data[len(_EXTENSION) + 32 :]
            if name in main:
                whole, start = struct.unpack(">II", place[:8])
                pieces[start] = place[8:]
    packet = b"".join(piece for _, piece in sorted(pieces.items()))
    return packet if packet and len(packet) == whole else None


def says_full_panorama(path: Path) -> bool:
    """Whether the XMP packet of an image says that it is an equirectangular panorama of the whole sphere.

    Raises ``InputError`` if it cannot be read.
    """
    root = _root(_packets(path))
    if root is None or _value(root, "ProjectionType") != "equirectangular":
        return False
    cropped, full = (
        [_value(root, name) for name in names]
        for names in (
            ("CroppedAreaImageWidthPixels", "CroppedAreaImageHeightPixels"),
            ("FullPanoWidthPixels", "FullPanoHeightPixels"),
        )
    )
    return cropped == full or None in (*cropped, *full)


def _root(packets: Sequence[bytes]) -> ElementTree.Element | None:
    """An element with all that the packets say; None if there is none, or if the first one is damaged."""
    roots = [_parsed(packet) for packet in packets]
    if not roots or roots[0] is None:
        return None
    both = ElementTree.Element("both")
    both.extend([root for root in roots if root is not None])
    return both


def _parsed(packet: bytes) -> ElementTree.Element | None:
    """The root of an XMP packet; None if it is damaged."""
    packet = packet.rstrip(b"\0")  # some programs end or pad it so
    # Declarations could define entities that grow without end or name other files; XMP has none.
    if len(packet) > MAX_BYTES or b"<!" in packet or b"\0" in packet:
        return None
    try:
        return ElementTree.fromstring(packet.strip())
    except (ElementTree.ParseError, ValueError, RecursionError, LookupError):
        return None


def _value(root: ElementTree.Element, name: str) -> str | None:
    """The last value of a GPano property; None if it has none."""
    found = None
    for element in root.iter():
        text = element.text if element.tag == f"{_GPANO}{name}" else element.get(f"{_GPANO}{name}")
        found = found if text is None else text.strip()
    return found


def _pitch_and_roll(packets: Sequence[bytes], place: str) -> tuple[float, float]:
    """Pitch and roll, degrees; one of them is enough: cameras leave out an angle of 0."""
    root = _root(packets)
    if root is None:
        raise InputError(f"{place}: its XMP tags are damaged, so that its pitch and roll cannot be read.")
    found: dict[str, float] = {}
    for name, limit in _LIMITS_DEG.items():
        text = _value(root, name)
        if text is not None:
            (angle,) = finite_numbers([text], f"{place}, {name}")
            if abs(angle) > limit:
                raise InputError(f"{place}: {name} is {show(angle)}; it must be an angle from {-limit:g} to {limit:g}.")
            found[name] = angle
    if not found:
        raise InputError(f"{place}: its XMP tags hold no pitch and roll ({_PITCH}, {_ROLL}).")
    return found.get(_PITCH, 0.0), found.get(_ROLL, 0.0)
