"""Which posed images are triangulated with which, and a map of posed images without depth."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.datasets import load_scene
from spherloc.errors import InputError
from spherloc.estimators import estimate
from spherloc.frontend.partners import partners, spread
from spherloc.frontend.view import View
from spherloc.metrics import evaluate
from tests.frontend.textured_rooms import PANORAMA, room_view, standing, wallpaper

NARROW = KannalaBrandt(200, 200, 110.0, 110.0, 100.0, 100.0, (0.0, 0.0, 0.0, 0.0))


@settings(max_examples=50)
@given(st.lists(st.floats(0.0, 100.0), max_size=20).map(sorted))
def test_spread_of_neighbours(distances):
    chosen = spread([(distance, index) for index, distance in enumerate(distances)], lambda _: True)
    far = [distances[index] for index in chosen]
    assert len(far) <= 4 and all(distance > 0.0 for distance in far)
    assert all(b >= 2.0 * a for a, b in pairwise(far))
    if any(distance > 0.0 for distance in distances):
        assert far[0] == min(distance for distance in distances if distance > 0.0)


def row(camera, yaws):
    """Cameras one after another, which look where ``yaws`` say."""
    places_m = (0.0, 1.0, 2.2, 3.3, 4.5)
    return [View(f"{x}", camera, Path("x"), standing(x, 0.0, yaw)) for x, yaw in zip(places_m, yaws, strict=False)]


def test_panoramas_are_partners_whichever_way_they_look():
    turned = [0.0, np.pi, np.pi / 2, 2.0, -1.0]
    assert partners(row(Equirectangular(64, 32), turned))[0] == [1, 2, 4]
    assert partners(row(Equirectangular(64, 32), turned)) == partners(row(Equirectangular(64, 32), [0.0] * 5))


def test_narrow_cameras_that_look_elsewhere_are_none():
    found = partners(row(NARROW, [0.0, np.pi, np.pi, 0.3, np.pi]))
    assert found[0] == [3] and found[1] == [2, 4] and found[3] == [0]


def test_what_was_taken_together_comes_first_if_it_looks_the_same_way():
    views = row(NARROW, [0.0, 0.0, np.pi, 0.0])
    assert partners(views, [[2, 3], [], [], []])[0] == [3, 1]


def test_posed_images_without_depth_are_a_map(tmp_path):
    """Panoramas in a drawn room that look all ways; their points are triangulated with each other."""
    walls = wallpaper(4)
    places = [(-1.0, -1.5, 0.0), (-0.2, -1.4, 2.0), (0.9, -0.9, 4.0)]
    text = [
        'kind = "image-folder"\nname = "room"\nimages = ["query.png"]\n[camera]\nmodel = "equirectangular"',
        f"width = {PANORAMA.width}\nheight = {PANORAMA.height}",
        "[frontend]\nmax_features = 1500\n[gravity]\nmap = [0, 1, 0]\ncamera = [0, 1, 0]",
    ]
    for number, (x, z, yaw) in enumerate(places):
        room_view(tmp_path, f"{number}", PANORAMA, standing(x, z, yaw), walls)
        text.append(f'[[references]]\nimage = "{number}.png"\ncam_from_map = {standing(x, z, yaw).tolist()}')
    query = standing(-0.1, -0.6, 5.0)
    room_view(tmp_path, "query", PANORAMA, query, walls)
    scene = tmp_path / "scene.toml"
    scene.write_text("\n".join([*text, f'[truth]\n"query.png" = {query.tolist()}\n']))
    metrics = evaluate(estimate(load_scene(scene).problem(), "mc"))
    assert metrics.rotation_error_deg is not None and metrics.translation_error_m is not None
    assert metrics.rotation_error_deg < 0.3 and metrics.translation_error_m < 0.03

    scene.write_text("\n".join(text[:4]))
    with pytest.raises(InputError, match="the only reference has no depth"):
        load_scene(scene)
    scene.write_text("\n".join([*text, 'depth = "2.png"']))
    with pytest.raises(InputError, match=r"\[\[references\]\] 3: key 'along' is missing"):
        load_scene(scene)
