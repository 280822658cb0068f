"""Gravity of photographs by their lines where they are stored sideways, as those of headsets are."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.datasets import bundled_scenes, load_scene
from spherloc.errors import InputError
from spherloc.frontend.view import Gravity, View
from spherloc.geometry import DOWN, camera_centre, pose, so3_exp
from spherloc.mapping.alignment.gravity_check import check_stated
from spherloc.mapping.alignment.line_gravity import (
    RIGHT,
    GravityByLines,
    gravity_by_lines,
    share_below,
    upright_in_body,
)
from spherloc.mapping.alignment.stated_gravity import StatedGravity

COUNT = 7


@pytest.fixture(scope="module")
def upright() -> list[View]:
    """Fisheyes of a walk through an apartment, in which the camera turns."""
    scene = load_scene(bundled_scenes()["apartment_fisheye"])
    for view in scene.references[:COUNT]:
        view.make_file()
    return [View(view.name, view.camera, view.path, view.cam_from_map) for view in scene.references[:COUNT]]


def turned(views: list[View], folder, quarters: int) -> list[View]:
    """The same images turned counter-clockwise, with their camera and their poses."""
    found = []
    for view in views:
        path = folder / f"{view.name}_{quarters}.png"
        cv2.imwrite(str(path), np.rot90(cv2.imread(str(view.path)), quarters))
        camera, pose = view.camera, view.cam_from_map
        for _ in range(quarters):
            camera = KannalaBrandt(
                camera.height,
                camera.width,
                camera.fy,
                camera.fx,
                camera.cy,
                camera.width - camera.cx,
                camera.distortion,
            )
            pose = np.stack([pose[1], -pose[0], pose[2]])
        found.append(View(view.name, camera, path, pose))
    return found


def off_deg(view: View, one: Gravity) -> float:
    down = view.cam_from_map[:, :3] @ [0.0, 0.0, -1.0]
    return float(np.degrees(np.arccos(np.clip(one.down @ down, -1.0, 1.0))))


def quiet(*_) -> None:
    """Nobody is told."""


def maps_of(views: list[View]) -> tuple[list[dict], np.ndarray]:
    """A map: poses, and points of which two thirds are below the cameras."""
    poses = {view.name: view.cam_from_map for view in views}
    centres = np.stack([camera_centre(pose) for pose in poses.values()])
    offsets = np.tile([[2.0, 0.0, -1.0], [0.0, 3.0, -0.5], [1.0, 1.0, 0.8]], (len(views), 1))
    return [poses], np.repeat(centres, 3, axis=0) + offsets


@pytest.mark.parametrize("quarters", [1, 3])
def test_images_that_are_stored_sideways_tell_down_all_the_same(upright, tmp_path, quarters):
    """Down is at their right or at their left, which the points of the map tell: most are below the cameras."""
    views = turned(upright, tmp_path, quarters)
    lines = gravity_by_lines(views, quiet)
    assert lines.sideways and not lines.unsure and len(lines.found) >= 5
    maps, points = maps_of(views)
    assert share_below(maps[0], points, np.array([0.0, 0.0, -1.0])) == pytest.approx(2 / 3)
    for doubted in (lines, replace(lines, unsure=True), replace(lines.other, other=replace(lines, other=None))):
        found = doubted.in_maps(maps, points)
        assert found.sideways and not found.unsure
        assert max(off_deg(view, found.found[view.name]) for view in views if view.name in found.found) < 1.0


def test_upright_images_are_not_taken_for_such(upright):
    lines = gravity_by_lines(upright, quiet)
    assert not lines.sideways and not lines.unsure
    maps, points = maps_of(upright)
    for doubted in (lines, replace(lines, unsure=True), replace(lines.other, other=replace(lines, other=None))):
        found = doubted.in_maps(maps, points)
        assert not found.sideways and not found.unsure
        assert max(off_deg(view, found.found[view.name]) for view in upright) < 1.0


def test_a_camera_that_has_not_turned_does_not_tell(upright, tmp_path):
    """Each image is alone with its camera, so that only the map tells; without one they are taken as upright."""
    views = [
        replace(view, camera=replace(view.camera, fx=view.camera.fx + 1e-6 * k))
        for k, view in enumerate(turned(upright, tmp_path, 1))
    ]
    lines = gravity_by_lines(views, quiet)
    assert lines.unsure and not lines.sideways
    assert lines.in_maps(*maps_of(views)).sideways
    same = [replace(view, cam_from_map=views[0].cam_from_map) for view in views]  # they all see the same
    both = replace(lines, found={view.name: lines.other.found[views[0].name] for view in views})
    other = replace(lines.other, found={view.name: lines.other.found[views[0].name] for view in views})
    found = replace(both, other=other).in_maps(*maps_of(same))
    assert found.unsure and not found.sideways


def car_camera(yaw_deg: float, roll_deg: float = 0.0) -> np.ndarray:
    """``body_from_camera`` (4, 4) of a camera of a car, x forward, y left, z up, that looks to a side and 20° down."""
    upright = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    look = so3_exp(np.radians([0.0, 0.0, yaw_deg])) @ upright @ so3_exp(np.radians([-20.0, 0.0, 0.0]))
    found = np.eye(4)
    found[:3, :3] = look @ so3_exp(np.radians([0.0, 0.0, roll_deg]))
    return found


def test_cameras_that_look_to_all_sides_are_upright(upright, tmp_path):
    """A calibration says so: what is below in their images is one direction of the car. That of cameras which look the
    same way does not, nor one of cameras that are all turned by 90°."""
    sides = (0.0, 90.0, 180.0, -90.0)
    bodies = [car_camera(yaw_deg) for yaw_deg in sides]
    assert upright_in_body(bodies) and upright_in_body([car_camera(yaw_deg, 180.0) for yaw_deg in sides])
    assert not upright_in_body(bodies[:1] * 2) and not upright_in_body([])
    assert not upright_in_body([car_camera(yaw_deg, 90.0) for yaw_deg in sides])
    views = turned(upright, tmp_path, 1)
    lines = gravity_by_lines(views, quiet, None, {view.name: bodies[k % 4] for k, view in enumerate(views)})
    assert not lines.sideways and lines.other is None


def test_gravity_that_a_file_states_shows_where_to_look_in_the_others(upright, tmp_path):
    views = turned(upright, tmp_path, 3)
    stated = {views[0].name: Gravity(views[0].cam_from_map[:, :3] @ [0.0, 0.0, -1.0], "the gravity file", 0.02)}
    lines = gravity_by_lines(views, quiet, stated)
    assert views[0].name not in lines.found and lines.other is None and len(lines.found) >= 4
    assert max(off_deg(view, lines.found[view.name]) for view in views[1:] if view.name in lines.found) < 1.0


def stated_of(views: list[View], turn: np.ndarray, **changes) -> StatedGravity:
    """True gravity of the views, turned in the camera frame."""
    downs = {view.name: turn @ view.cam_from_map[:, :3] @ [0.0, 0.0, -1.0] for view in views}
    found = {name: Gravity(down, "the gravity file", np.radians(1.5)) for name, down in downs.items()}
    return replace(StatedGravity(found, Path("gravity.txt"), None, ()), **changes)


@pytest.mark.parametrize("quarters", [0, 1])
def test_stated_gravity_that_is_right_contradicts_no_lines(upright, tmp_path, quarters):
    views = turned(upright, tmp_path, quarters)
    assert check_stated(stated_of(views, np.eye(3)), views, quiet) == []


def test_stated_gravity_that_contradicts_the_lines_is_told(upright):
    off = so3_exp(np.radians([0.0, 0.0, 7.0]))
    (said,) = check_stated(stated_of(upright, off), upright, quiet)
    assert "differs from the vertical lines of 7 of 7 images by 7.1° (median), more than both bounds allow" in said
    assert check_stated(stated_of(upright[:1], off), upright, quiet) == []  # one image may be wrong
    (said,) = check_stated(stated_of(upright, -np.eye(3)), upright, quiet)
    assert "points to the upper edge of 7 of 7 images: if the camera was not upside down, it is up" in said


def test_stated_gravity_that_contradicts_the_down_of_panoramas(tmp_path, rng):
    """Their camera made them upright. That of an accelerometer is refused, since the map would be upside down."""
    assert cv2.imwrite(str(tmp_path / "a.png"), rng.integers(0, 255, (100, 200), np.uint8))
    pose = np.column_stack([[[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]], np.zeros(3)])
    views = [View(f"{k}.png", Equirectangular(200, 100), tmp_path / "a.png", pose) for k in range(3)]
    assert check_stated(stated_of(views, np.eye(3)), views, quiet) == []
    with pytest.raises(InputError, match=r"seems to point up in 3 of 3 panoramas, as an accelerometer measures; give"):
        check_stated(stated_of(views, -np.eye(3)), views, quiet)
    (said,) = check_stated(stated_of(views, -np.eye(3), in_map_folder=True), views, quiet)
    assert said.endswith("check how the IMU is turned to the camera.")
    (said,) = check_stated(stated_of(views, so3_exp(np.radians([90.0, 0.0, 0.0]))), views, quiet)
    assert "differs from the panoramas' own down by 90° (median) and seems wrong" in said


def test_edges_of_paving_stones_lay_no_image_on_its_side():
    """More images show them than vertical edges, but they run both ways."""
    names = [f"{number}.png" for number in range(24)]
    poses = {name: pose(np.eye(3), np.array([float(number), 0.0, 0.0])) for number, name in enumerate(names)}
    vertical = {name: Gravity(DOWN, "lines of the image") for name in names[:8]}
    ahead = np.array([0.0, 0.0, 1.0])
    paving = {name: Gravity(RIGHT if k < 14 else ahead, "lines of the image") for k, name in enumerate(names)}
    other = GravityByLines(paving, {}, sideways=True)
    known = GravityByLines(vertical, {}, unsure=True, other=other).in_maps([poses], np.zeros((1, 3)))
    assert not known.sideways and known.found == vertical and not known.unsure
    on_side = replace(other, found=dict.fromkeys(names, Gravity(RIGHT, "lines of the image")))
    assert GravityByLines(vertical, {}, unsure=True, other=on_side).in_maps([poses], np.zeros((1, 3))).sideways
