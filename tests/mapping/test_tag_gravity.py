"""Pitch and roll in the tags of panoramas, which may be levelled already."""

import numpy as np
import pytest
from PIL import Image

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.datasets.panorama_tags import SOURCE, down_of
from spherloc.geometry import align_to_down
from spherloc.mapping.alignment.tag_gravity import stated_by_tags
from spherloc.mapping.images.photographs import photographs
from spherloc.mapping.scenes.new_images import new_images_of

HEIGHT = 320
XMP = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    '<rdf:Description xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" GPano:PosePitchDegrees="{}" '
    'GPano:PoseRollDegrees="{}"/></rdf:RDF></x:xmpmeta>'
)
ANGLES_DEG = [(8.0, 3.0), (-5.0, 6.0), (2.0, -9.0), (7.0, -6.0)]


def quiet(*_) -> None:
    """Nobody is told."""


def columns(down, rng):
    """A panorama (H, 2 H) of upright columns, in a camera whose down is ``down`` (3,)."""
    v, u = np.mgrid[:HEIGHT, : 2 * HEIGHT] + 0.5
    bearings, _ = Equirectangular(2 * HEIGHT, HEIGHT).unproject(np.column_stack([u.ravel(), v.ravel()]))
    x, y, z = align_to_down(down) @ bearings.T
    azimuth, wall = np.arctan2(x, z), np.abs(y) < 0.6
    edges = np.sort(rng.uniform(-np.pi, np.pi, 24))
    shades = rng.integers(40, 220, 25)
    shades[-1] = shades[0]
    grey = np.where(wall, shades[np.searchsorted(edges, azimuth)], 128)
    return grey.astype(np.uint8).reshape(HEIGHT, 2 * HEIGHT)


def panoramas(folder, rng, tagged=ANGLES_DEG, leaning=ANGLES_DEG):
    """Panoramas of cameras that are ``leaning``, whose tags say ``tagged``: both pitch and roll, degrees."""
    folder.mkdir()
    for number, (said, angles_deg) in enumerate(zip(tagged, leaning, strict=True)):
        image = columns(down_of(*np.radians(angles_deg)), rng)
        tags = {} if said is None else {"xmp": XMP.format(*said).encode()}
        Image.fromarray(image).save(folder / f"{number}.jpg", quality=95, **tags)
    return photographs(folder, {}, panorama=True)


def test_tags_that_lines_agree_with_are_gravity(tmp_path, rng):
    """Also of an image without lines, but not of one whose lines contradict its tags, or that has none."""
    tagged = [*ANGLES_DEG, (1.0, 1.0), (10.0, 0.0), None]
    found = panoramas(tmp_path / "a", rng, tagged, [*ANGLES_DEG, (1.0, 1.0), (0.0, 12.0), (3.0, 3.0)])
    stated, (remark,) = stated_by_tags(found.views, quiet)
    assert sorted(stated.found) == [f"{number}.jpg" for number in range(5)] and stated.lines_agree
    for name, one in stated.found.items():
        np.testing.assert_allclose(one.down, down_of(*np.radians(tagged[int(name[0])])), atol=1e-12)
        assert one.source == SOURCE and 1.0 <= np.degrees(one.bound_rad) <= 3.0
    assert remark.startswith("Gravity of 5 photographs is from pitch and roll in their tags, with which the vertical")
    assert "lines of 4 of the 5 that lean most agree to 0." in remark
    assert "the tags of 1 contradict their lines and are not used, such as 5.jpg" in remark
    new, remarks = new_images_of(tmp_path / "a", found, panorama=True)
    assert new.gravity.keys() == stated.found.keys() and remark in remarks
    assert not new_images_of(tmp_path / "a", found, panorama=True, measured_gravity=False)[0].gravity


def test_levelled_panoramas_are_not_levelled_again(tmp_path, rng):
    stated, (remark,) = stated_by_tags(panoramas(tmp_path / "a", rng, leaning=[(0.0, 0.0)] * 4).views, quiet)
    assert stated is None
    assert remark == (
        "Pitch and roll in the tags of 4 photographs are not used, since these are levelled already, as the vertical "
        "lines of 4 of the 4 that lean most say."
    )


@pytest.mark.parametrize("leaning", [[(-p, r) for p, r in ANGLES_DEG], [*ANGLES_DEG[:2], (0.0, 0.0), (0.0, 0.0)]])
def test_tags_of_another_convention_or_of_some_images_are_not_used(tmp_path, rng, leaning):
    stated, (remark,) = stated_by_tags(panoramas(tmp_path / "a", rng, leaning=leaning).views, quiet)
    assert stated is None and "are not used: vertical lines agree with them in " in remark


def test_without_tags_or_where_all_are_level_nothing_is_said(tmp_path, rng):
    assert stated_by_tags(panoramas(tmp_path / "a", rng, [None] * 4).views, quiet) == (None, [])
    level = [(0.0, 0.5)] * 4
    assert stated_by_tags(panoramas(tmp_path / "b", rng, level, level).views, quiet) == (None, [])
