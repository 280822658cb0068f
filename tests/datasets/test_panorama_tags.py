"""Pitch and roll of 360-degree cameras: which way is down, and packets that are not what they should be."""

import numpy as np
import pytest
from PIL import Image

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.datasets.panorama_tags import down_of, gravity_from_tags
from spherloc.errors import InputError
from spherloc.frontend.view import View

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
    Image.new("RGB", (64, 32)).save(path, **({} if packet is None else {"xmp": packet.encode()}))
    return View(path.name, CAMERA, path)


def test_pitch_and_roll_turn_down_as_they_say():
    """The middle of an image that looks up by 30 degrees is that far above the horizon; a horizon turned
    counterclockwise by 90 degrees has its down at the right."""
    np.testing.assert_allclose(down_of(0.0, 0.0), [0, 1, 0])
    middle = np.array([0.0, 0.0, 1.0])
    assert np.degrees(np.arcsin(-down_of(np.radians(30.0), 0.4) @ middle)) == pytest.approx(30.0)
    np.testing.assert_allclose(down_of(0.0, np.pi / 2), [1, 0, 0], atol=1e-15)


@pytest.mark.parametrize(
    "packet",
    [
        attributes('GPano:PosePitchDegrees="-4.5" GPano:PoseRollDegrees="2"'),
        f"{HEAD}<rdf:Description {SPACE}><GPano:PosePitchDegrees> -4.5</GPano:PosePitchDegrees>"
        f"<GPano:PoseRollDegrees>2.0</GPano:PoseRollDegrees></rdf:Description>{TAIL}",
    ],
    ids=["attributes", "elements"],
)
def test_both_ways_of_writing_them_are_read(tmp_path, packet):
    found = gravity_from_tags(view(tmp_path, packet))
    np.testing.assert_allclose(found.down, down_of(np.radians(-4.5), np.radians(2.0)))
    assert found.source == "pitch and roll in the photograph's tags"


@pytest.mark.parametrize(
    ("packet", "said"),
    [
        (None, "a.jpg: has no XMP tags"),
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
