"""Pitch and roll of 360-degree cameras: which way is down, and packets that are not what they should be."""

import struct
import zlib

import numpy as np
import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.datasets.panorama_tags import down_of, gravity_from_tags
from spherloc.errors import InputError
from spherloc.frontend.view import View
from spherloc.geometry import so3_exp

CAMERA = Equirectangular(64, 32)
HEAD = (
    '<?xpacket begin="" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/">'
    '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
)
TAIL = '</rdf:RDF></x:xmpmeta><?xpacket end="w"?>'
SPACE = 'xmlns:GPano="http://ns.google.com/photos/1.0/panorama/"'


def attributes(text):
    return f"{HEAD}<rdf:Description {SPACE} {text}/>{TAIL}"


def view(folder, packet=None, suffix="jpg"):
    path = folder / f"a.{suffix}"
    Image.new("RGB", (64, 32)).save(path, **({} if packet is None else tagged(packet, suffix)))
    return View(path.name, CAMERA, path)


def tagged(packet, suffix):
    """What Pillow is told to write an XMP packet where the format has it."""
    if suffix == "png":
        info = PngInfo()
        info.add_itxt("XML:com.adobe.xmp", packet)
        return {"pnginfo": info}
    return {"tiffinfo": {700: packet.encode()}} if suffix == "tif" else {"xmp": packet.encode()}


def test_pitch_and_roll_turn_down_as_they_say():
    """The middle of an image that looks up by 30 degrees is that far above the horizon; a horizon turned
    counterclockwise by 90 degrees has its down at the right."""
    np.testing.assert_allclose(down_of(0.0, 0.0), [0, 1, 0])
    middle = np.array([0.0, 0.0, 1.0])
    assert np.degrees(np.arcsin(-down_of(np.radians(30.0), 0.4) @ middle)) == pytest.approx(30.0)
    np.testing.assert_allclose(down_of(0.0, np.pi / 2), [1, 0, 0], atol=1e-15)


def test_pitch_and_roll_together_are_those_of_the_specification():
    """Pitch, "measured in degrees above the horizon, for the center in the image", turns the sphere about its axis to
    the right; roll, with which "the horizon rotates counterclockwise in the image", before that about the one ahead."""
    pitch, roll, heading = np.radians([-25.0, 40.0, 70.0])
    turns = [[0.0, 0.0, -heading], [pitch, 0.0, 0.0], [0.0, roll, 0.0]]  # axes right, ahead and up
    world_from_sphere = np.linalg.multi_dot([so3_exp(np.array(turn)) for turn in turns])
    assert np.degrees(np.arcsin(world_from_sphere[2, 1])) == pytest.approx(-25.0)
    right, ahead, up = world_from_sphere.T @ [0.0, 0.0, -1.0]
    np.testing.assert_allclose(down_of(pitch, roll), [right, -up, ahead], atol=1e-12)


ATTRIBUTES = attributes('GPano:PosePitchDegrees="-4.5" GPano:PoseRollDegrees="2"')
ELEMENTS = (
    f"{HEAD}<rdf:Description {SPACE}><GPano:PosePitchDegrees> -4.5</GPano:PosePitchDegrees>"
    f"<GPano:PoseRollDegrees>2.0</GPano:PoseRollDegrees></rdf:Description>{TAIL}"
)


@pytest.mark.parametrize("packet", [ATTRIBUTES, ELEMENTS], ids=["attributes", "elements"])
@pytest.mark.parametrize("suffix", ["jpg", "tif", "png"])
def test_both_ways_of_writing_them_are_read(tmp_path, packet, suffix):
    found = gravity_from_tags(view(tmp_path, packet, suffix))
    np.testing.assert_allclose(found.down, [0.0347919, 0.9963101, 0.0784591], atol=1e-7)  # a little right and ahead
    assert found.source == "pitch and roll in the photograph's tags"


@pytest.mark.parametrize("squeezed", [False, True])
@pytest.mark.parametrize("packet", [ATTRIBUTES, ELEMENTS], ids=["attributes", "elements"])
def test_a_packet_behind_the_pixels_of_a_png_is_read(tmp_path, packet, squeezed):
    """ExifTool writes it there."""
    plain = view(tmp_path, None, "png")
    text = zlib.compress(packet.encode()) if squeezed else packet.encode()
    data = plain.path.read_bytes()
    other = chunk(b"iTXt", b"Title\0\0\0\0\0A room")
    late = chunk(b"iTXt", b"XML:com.adobe.xmp\0" + bytes([squeezed, 0]) + b"\0\0" + text)
    plain.path.write_bytes(data[:-12] + other + late + data[-12:])
    np.testing.assert_allclose(gravity_from_tags(plain).down, [0.0347919, 0.9963101, 0.0784591], atol=1e-7)
    plain.path.write_bytes(data[:-12] + other + late[: len(late) // 2])
    with pytest.raises(InputError, match="XMP tags"):
        gravity_from_tags(plain)


def chunk(kind, content):
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def test_a_packet_in_further_segments_of_a_jpeg_is_read(tmp_path):
    """What does not fit into a segment of 64 kB is extended; a piece of it that is missing leaves the rest."""
    name = b"0123456789ABCDEF0123456789ABCDEF"
    main = attributes(f'xmlns:xmpNote="http://ns.adobe.com/xmp/note/" xmpNote:HasExtendedXMP="{name.decode()}"')
    photograph = view(tmp_path, main)
    data, extended = photograph.path.read_bytes(), ELEMENTS.replace("<GPano", f"{' ' * 70_000}<GPano", 1).encode()

    def write(named, *places):
        key = b"http://ns.adobe.com/xmp/extension/\0" + named + struct.pack(">I", len(extended))
        bodies = [key + struct.pack(">I", start) + extended[start : start + 60_000] for start in places]
        segments = [b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body for body in bodies]
        photograph.path.write_bytes(data[:2] + b"".join(segments) + data[2:])

    write(name, 60_000, 0)
    np.testing.assert_allclose(gravity_from_tags(photograph).down, [0.0347919, 0.9963101, 0.0784591], atol=1e-7)
    for wrong in ((name, 0), (name[::-1], 0, 60_000)):
        write(*wrong)
        with pytest.raises(InputError, match="hold no pitch and roll"):
            gravity_from_tags(photograph)


def test_a_packet_that_ends_with_zeros_and_an_angle_beyond_180_degrees_are_read(tmp_path):
    level = gravity_from_tags(view(tmp_path, ATTRIBUTES))
    np.testing.assert_array_equal(gravity_from_tags(view(tmp_path, f"{ATTRIBUTES}\0\0")).down, level.down)
    around = gravity_from_tags(view(tmp_path, ATTRIBUTES.replace('"2"', '"-358"')))
    np.testing.assert_allclose(around.down, level.down, atol=1e-12)


@pytest.mark.parametrize("suffix", ["jpg", "tif", "png"])
def test_a_photograph_without_tags_is_named(tmp_path, suffix):
    with pytest.raises(InputError) as caught:
        gravity_from_tags(view(tmp_path, None, suffix))
    assert str(caught.value) == f"a.{suffix}: has no XMP tags, which would hold its pitch and roll."


@pytest.mark.parametrize(
    ("packet", "said"),
    [
        (attributes('GPano:ProjectionType="equirectangular"'), "hold no pitch and roll"),
        (attributes('GPano:PosePitchDegrees="up"'), "'up' is not a finite number"),
        (attributes('GPano:PosePitchDegrees="95"'), "PosePitchDegrees is 95.0; it must be an angle from -90 to 90"),
        ("<x:xmpmeta", "XMP tags are damaged"),
        ('<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/hostname">]><a>&b;</a>', "XMP tags are damaged"),
    ],
)
def test_what_is_missing_or_wrong_is_said(tmp_path, packet, said):
    with pytest.raises(InputError, match=said):
        gravity_from_tags(view(tmp_path, packet))


def test_what_is_no_image_is_said(tmp_path):
    (tmp_path / "a.jpg").write_bytes(b"no image")
    with pytest.raises(InputError, match="is not an image that can be read"):
        gravity_from_tags(View("a.jpg", CAMERA, tmp_path / "a.jpg"))
