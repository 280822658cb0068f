"""What moves with the camera below panoramas is found where there is something, and nothing where there is not."""

import shutil

import cv2
import pytest

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.frontend.masks import around
from spherloc.mapping.images.carried import BELOW_DEG, carried_nadir_deg
from spherloc.mapping.images.photographs import photographs
from spherloc.mapping.make import make_map
from spherloc.mapping.request import MapRequest
from spherloc_viz.commands.map_report import summary
from tests.frontend.pictures import texture
from tests.frontend.textured_rooms import FISHEYE, room_view, standing, wallpaper
from tests.needs import real_data

CAMERA = Equirectangular(640, 320)
PLACES = ((-1.5, -2.0, 0.0), (-0.5, -1.0, 0.3), (0.5, 0.5, 1.0), (1.5, 2.0, 2.5))
TRIPOD_DEG = 25.0


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("SPHERLOC_CACHE", str(tmp_path / "cache"))


def rooms(folder, camera=CAMERA):
    """Views from four places of a room, a metre and more from each other."""
    return [room_view(folder, f"{k}", camera, standing(*place), wallpaper(3)) for k, place in enumerate(PLACES)]


def paint(views, images):
    """Paint an image over what is below each view, on the disk."""
    for view, image in zip(views, images, strict=True):
        inside = ~around(view.camera, TRIPOD_DEG, 0.0)
        seen = cv2.imread(str(view.path))
        seen[inside] = image[inside, None]
        cv2.imwrite(str(view.path), seen)


def test_a_tripod_is_found(tmp_path, rng):
    """Its rim is found to a few degrees, and the margin leaves it out."""
    views = rooms(tmp_path)
    paint(views, [texture(rng, 320, 640)] * len(views))
    told = []
    assert TRIPOD_DEG - 3.0 <= carried_nadir_deg(views, lambda *what: told.append(what)) <= TRIPOD_DEG + 8.0
    assert [done for _, done, _ in told] == [1, 2, 3, 4]


def test_a_tripod_of_some_images_is_found(tmp_path, rng):
    """Three of four have it: half of the pairs speak for it."""
    views = rooms(tmp_path)
    paint(views[:3], [texture(rng, 320, 640)] * 3)
    assert 0.0 < carried_nadir_deg(views, lambda *_: None) < BELOW_DEG


def test_the_ground_is_none(tmp_path, rng):
    """Neither the floor itself, nor something else below each image, nor the tripod of two images."""
    views = rooms(tmp_path)
    assert carried_nadir_deg(views, lambda *_: None) == 0.0
    paint(views, [texture(rng, 320, 640) for _ in views])
    assert carried_nadir_deg(views, lambda *_: None) == 0.0
    assert carried_nadir_deg(views[:2], lambda *_: None) == 0.0


def test_images_that_are_no_panoramas_are_not_searched(tmp_path, rng):
    views = rooms(tmp_path, FISHEYE)
    assert carried_nadir_deg(views, lambda *what: pytest.fail("an image was searched")) == 0.0


def test_real_places_with_one_tripod_are_maps_of_their_own(tmp_path):
    """Three rooms with two panoramas each; all pictures show the tripod, two of the rooms the same one."""
    folder = real_data("pano_vertical_pairs")
    for path in folder.glob("*.png"):
        shutil.copy(path, tmp_path)
    found = photographs(tmp_path, {})
    made = make_map(MapRequest(found.views, tmp_path), tmp_path / "map")
    assert 24.0 <= made.carried_deg <= 36.0
    rooms = [{name.partition("_")[0] for name in one.written.poses} for one in (made, *made.groups)]
    assert sorted(map(sorted, rooms)) == [["hall"], ["room"], ["stairs"]]
    lines = "\n".join(summary(made, found))
    assert lines.count("on its own") == 2 and "left out" not in lines and "around straight down" in lines
    assert "nadir_deg = " in (tmp_path / "map" / "group_2" / "scene.toml").read_text()
