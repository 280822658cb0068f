"""Images are read as they are stored, and what is no image, or claims too much, is one sentence."""

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from spherloc.errors import InputError
from spherloc.images import grey, read_depth_png, read_eighth, read_image, read_size

PICTURE = np.random.default_rng(5).integers(0, 256, (24, 40, 3), dtype=np.uint8)
DEPTH = np.random.default_rng(6).integers(0, 65536, (24, 40), dtype=np.uint16)


def encoded(suffix: str) -> bytes:
    done, content = cv2.imencode(suffix, PICTURE)
    assert done
    return content.tobytes()


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tiff", ".webp", ".jpg"])
def test_pixels_and_size(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_bytes(encoded(suffix))
    assert read_size(path) == (40, 24)
    image = read_image(path)
    assert image.shape == PICTURE.shape
    if suffix in (".png", ".bmp", ".tiff"):
        assert np.array_equal(image, PICTURE), "the colours are blue, green, red"


def test_grey_images_stay_grey(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), PICTURE[:, :, 0])
    image = read_image(tmp_path / "a.png")
    assert np.array_equal(image, PICTURE[:, :, 0]) and grey(image) is image
    assert np.array_equal(grey(PICTURE), cv2.cvtColor(PICTURE, cv2.COLOR_BGR2GRAY))


def test_an_orientation_tag_turns_nothing(tmp_path: Path) -> None:
    tag = Image.Exif()
    tag[0x0112] = 6  # to be shown turned by 90 degrees
    Image.fromarray(PICTURE[:, :, ::-1]).save(tmp_path / "a.jpg", exif=tag, quality=95)
    assert read_image(tmp_path / "a.jpg").shape == PICTURE.shape and read_size(tmp_path / "a.jpg") == (40, 24)


@pytest.mark.parametrize("bits", [8, 10, 12, 16])
@pytest.mark.parametrize("suffix", [".png", ".tiff"])
def test_16_bits_become_8_by_those_that_are_used(tmp_path: Path, bits: int, suffix: str) -> None:
    """A camera of 12 bits fills the lower ones, which would else be nearly black."""
    path = tmp_path / f"a{suffix}"
    for picture in (PICTURE, PICTURE[:, :, 0]):
        cv2.imwrite(str(path), picture.astype(np.uint16) << (bits - 8))
        assert np.array_equal(read_image(path), picture)
        assert abs(read_eighth(path).mean() - picture.mean()) < 30.0
    cv2.imwrite(str(path), np.zeros((24, 40), np.uint16))
    assert not read_image(path).any()


def test_numbers_that_are_no_pixels_are_told(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.tiff"), PICTURE[:, :, 0].astype(np.float32))
    for read in (read_image, read_eighth):
        with pytest.raises(InputError, match=r"a\.tiff: has float32 pixels; give an image with 8 or 16 bits a channel"):
            read(tmp_path / "a.tiff")
    cv2.imwrite(str(tmp_path / "a.tiff"), PICTURE.astype(np.float32))
    with pytest.raises(InputError, match=r"a\.tiff: is damaged, or a TIFF of a kind that is not read; save it as PNG"):
        read_image(tmp_path / "a.tiff")


def test_depth_has_16_bits(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "depth.png"), DEPTH)
    assert np.array_equal(read_depth_png(tmp_path / "depth.png"), DEPTH)
    cv2.imwrite(str(tmp_path / "colour.png"), PICTURE)
    with pytest.raises(InputError, match=r"colour\.png: is not a depth map; give a PNG with one channel of 16 bits"):
        read_depth_png(tmp_path / "colour.png")


@pytest.mark.parametrize("read", [read_image, read_depth_png, read_size])
def test_missing_and_foreign_files(tmp_path: Path, read) -> None:
    with pytest.raises(InputError, match=r"none\.png: no such file"):
        read(tmp_path / "none.png")
    with pytest.raises(InputError, match="cannot be read"):
        read(tmp_path)
    for content in (b"", b"hello", encoded(".png")[:20]):
        (tmp_path / "a.png").write_bytes(content)
        with pytest.raises(InputError, match=r"a\.png: not an image that can be read, or a damaged one"):
            read(tmp_path / "a.png")
    (tmp_path / "a.jpg").write_bytes(b"\0\0\0\x18ftypheic" + bytes(500))
    with pytest.raises(InputError, match=r"a\.jpg: is HEIC or AVIF, whatever its name says; convert it to JPEG or PNG"):
        read(tmp_path / "a.jpg")


def claiming(width: int, height: int) -> bytes:
    """A PNG whose header is right but for the size that it claims."""
    header = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    start = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header))
    return start + encoded(".png")[len(start) :]


def test_a_huge_claim_is_refused_before_anything_is_allocated(tmp_path: Path) -> None:
    bitmap = bytearray(encoded(".bmp"))
    bitmap[18:26] = struct.pack("<ii", 30_000, 30_000)
    for name, content in (("a.png", claiming(30_000, 30_000)), ("a.bmp", bytes(bitmap))):
        (tmp_path / name).write_bytes(content)
        for read in (read_image, read_size):
            with pytest.raises(InputError, match="claims 0 pixels or more than 150,000,000"):
                read(tmp_path / name)


@settings(max_examples=200)
@given(data=st.data(), suffix=st.sampled_from([".png", ".jpg", ".bmp", ".webp"]))
def test_damaged_images_are_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject, suffix: str
) -> None:
    content = bytearray(encoded(suffix))
    for _ in range(data.draw(st.integers(0, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    path = tmp_path_factory.getbasetemp() / f"fuzz{suffix}"
    path.write_bytes(content[: data.draw(st.integers(0, len(content)))])
    try:
        assert read_image(path).size <= 150_000_000 * 3
    except InputError as error:
        assert str(error).startswith(str(path)) and str(error).endswith(".")
