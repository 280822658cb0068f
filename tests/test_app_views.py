"""Where a view stands: in the camera, along its axis; elsewhere, where no wall hides its subject."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from trimesh.exchange.gltf import export_glb

from spherloc.datasets.synthetic import SyntheticScene
from spherloc.estimators import estimate
from spherloc.geometry import camera_centre, so3_exp
from spherloc.problem import Problem
from spherloc.trace import Trace
from spherloc_viz.app.stage import views
from spherloc_viz.app.stage.walls import Walls
from spherloc_viz.layers import paint, steps
from spherloc_viz.layers.point_cloud import REFERENCES
from spherloc_viz.layers.primitives import Focus, Label, Mesh, Points, Segments


@pytest.fixture(scope="module")
def trace(scene_of: Callable[..., SyntheticScene]) -> Trace:
    problem = scene_of("panorama", correspondences=40, outlier_rate=0.3).problem()
    lean = so3_exp(np.array([0.2, 0.0, 0.3]))
    assert problem.truth_cam_from_map is not None
    leaning = Problem(
        "leaning", problem.camera, problem.camera.project(problem.bearings @ lean.T)[0], problem.points,
        lean @ problem.gravity_camera, problem.gravity_map, truth_cam_from_map=lean @ problem.truth_cam_from_map,
    )  # fmt: skip
    return estimate(leaning, "ransac-2p")


def test_one_stands_in_the_estimated_camera_and_looks_along_its_axis(trace: Trace) -> None:
    view = views.find(views.INSIDE, paint(trace, len(steps(trace)) - 1), 1.5)
    assert trace.cam_from_map is not None
    aligned = trace.problem.aligned.align_pose(trace.cam_from_map)
    np.testing.assert_allclose(view.position, camera_centre(aligned), atol=1e-9)
    axis = (view.target - view.position) / np.linalg.norm(view.target - view.position)
    np.testing.assert_allclose(axis, aligned[2, :3], atol=1e-9)
    assert view.field_of_view_rad > np.radians(80)


def test_without_an_estimate_one_stands_in_the_sphere(trace: Trace) -> None:
    picture = paint(trace, 0)
    view = views.find(views.INSIDE, picture, 1.5)
    (surface,) = (item for item in picture.scene if item.name == "sphere/surface")
    assert isinstance(surface, Mesh)
    reach = np.linalg.norm(surface.vertices - view.position, axis=1)
    np.testing.assert_allclose(reach, reach[0], rtol=1e-6)
    assert 0 < np.linalg.norm(view.target - view.position) < 0.1 * reach[0], "so that the mouse turns the head"


def test_who_stands_in_a_camera_does_not_see_its_lines(trace: Trace) -> None:
    picture = paint(trace, len(steps(trace)) - 1)
    inside, outside = (views.find(name, picture, 1.5).position for name in (views.INSIDE, "Overview"))
    around = {item.name for item in picture.scene if item.layer == "uncertainty"}
    assert around and views.before_the_eyes(picture, outside) == frozenset()
    hidden = views.before_the_eyes(picture, inside)
    words = {item.name for item in picture.scene if isinstance(item, Label)}
    assert hidden == around | words | {"cameras/estimate", "cameras/truth", "cameras/error"}
    truth = next(item for item in picture.scene if item.name == "cameras/truth")
    assert isinstance(truth, Segments)
    far = replace(truth, points=truth.points + 1e3)
    apart = replace(picture, scene=tuple(far if item is truth else item for item in picture.scene))
    assert "cameras/truth" not in views.before_the_eyes(apart, inside), "it may be seen if it is elsewhere"


def test_every_view_is_found_at_every_step(trace: Trace) -> None:
    for index in range(len(steps(trace))):
        for name in views.NAMES:
            view = views.find(name, paint(trace, index), 1.5)
            assert np.isfinite(view.position).all() and np.linalg.norm(view.target - view.position) > 1e-6


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> trimesh.Trimesh:
    return trimesh.creation.box(bounds=np.array([low, high]))


def glb(*boxes: trimesh.Trimesh) -> bytes:
    return bytes(export_glb(trimesh.Scene(boxes)))


def test_a_wall_hides_what_is_behind_it_and_nothing_before_it() -> None:
    walls = Walls(glb(box((-5, -2, 1.0), (5, 2, 1.1)), box((-5, 2, -5), (5, 2.1, 5))), np.eye(3))
    targets = np.array([[x, 0.0, 3.0] for x in (-1.0, 0.0, 1.0)])
    assert walls.blocked(np.array([0.0, 0.0, -3.0]), targets) == 1.0
    assert walls.blocked(np.array([0.0, 0.0, 4.5]), targets) == 0.0
    assert walls.blocked(np.array([0.0, -9.0, 3.0]), targets) == 0.0, "over the wall, beyond all of the mesh"
    turn = so3_exp(np.array([0.0, np.pi, 0.0]))
    turned = Walls(glb(box((-5, -2, 1.0), (5, 2, 1.1))), turn)
    assert turned.blocked(np.array([0.0, 0.0, -3.0]), -targets) == 0.0, "the wall is in the map's frame"
    assert turned.blocked(np.array([0.0, 0.0, 3.0]), -targets) == 1.0


def test_a_step_is_seen_from_a_side_where_no_wall_hides_it(trace: Trace) -> None:
    index = next(k for k in range(1, len(steps(trace))) if paint(trace, k).focus.view == "Sphere")
    picture = paint(trace, index)
    subject, free = picture.focus.points, views.follow(picture, 1.5)
    middle, toward = subject.mean(axis=0), free.position - subject.mean(axis=0)
    wall = middle + 0.6 * toward
    size_m = 0.4 * float(np.linalg.norm(toward))
    mesh = glb(box(tuple(wall - size_m * np.array([1, 1, 0.1])), tuple(wall + size_m * np.array([1, 1, 0.1]))))
    walls = Walls(mesh, np.eye(3))
    assert walls.blocked(free.position, subject) > 0.5
    assert walls.blocked(views.follow(picture, 1.5, walls).position, subject) < 0.2


def test_a_post_before_the_middle_of_the_subject_is_seen_around(trace: Trace) -> None:
    picture = next(one for one in (paint(trace, k) for k in range(1, 9)) if one.focus.view == "Sphere")
    subject, free = picture.focus.points, views.follow(picture, 1.5)
    middle = subject.mean(axis=0)
    toward = free.position - middle
    post, half_m = middle + 0.3 * toward, 0.03 * float(np.linalg.norm(toward))
    ground = box(tuple(middle + np.array([-9, 5, -9])), tuple(middle + np.array([9, 5.1, 9])))
    walls = Walls(glb(box(tuple(post - half_m), tuple(post + half_m)), ground), np.eye(3))
    assert not walls.blocked(free.position, subject) and walls.blocked(free.position, middle[None])
    assert not walls.blocked(views.follow(picture, 1.5, walls).position, middle[None])


def test_the_sphere_does_not_stand_before_a_ball(trace: Trace) -> None:
    """Wherever the ball of a step is, behind the sphere as seen from the first direction too."""
    picture = paint(trace, 1)
    surface = next(item for item in picture.scene if isinstance(item, Mesh) and item.name == "sphere/surface")
    centre, radius_m = surface.vertices.mean(axis=0), float(np.ptp(surface.vertices[:, 0])) / 2
    for turn in np.radians(np.arange(0.0, 360.0, 45.0)):
        ball = centre + 1.8 * radius_m * np.array([np.cos(turn), 0.1, np.sin(turn)])
        moved = replace(picture, focus=Focus("Balls", ball + 0.7 * radius_m * np.vstack([np.eye(3), -np.eye(3)])))
        position = views.follow(moved, 1.5).position
        along = np.linspace(0.0, 1.0, 200)[:, None]
        apart_m = np.linalg.norm(position + along * (ball - position) - centre, axis=1)
        assert apart_m.min() > radius_m, np.degrees(turn)


def test_from_above_a_street_lies_along_the_longer_side_of_the_canvas(trace: Trace) -> None:
    picture = paint(trace, len(steps(trace)) - 1)
    (camera,) = (item for item in picture.scene if item.name == "cameras/estimate")
    assert isinstance(camera, Segments)
    here = camera.points[0, 0]
    for street, square in ((0, 2), (2, 0)):
        walk = here + np.linspace(-0.5, 0.5, 9)[:, None] * np.eye(3)[street]
        dots = Points(REFERENCES, "cloud", walk, np.zeros((9, 3), np.uint8), 0.1)
        for aspect, longer in ((2.0, 0), (0.5, 1)):
            view = views.find("Above", replace(picture, scene=(*picture.scene, dots)), aspect)
            spread = np.ptp(views.projected(view, walk), axis=0)
            assert spread[longer] > 5 * spread[1 - longer], (street, aspect)
        view = views.find("Above", replace(picture, scene=(*picture.scene, dots)), 1.0)
        spread = np.ptp(views.projected(view, np.vstack([here, here + 0.1 * np.eye(3)[square]])), axis=0)
        assert spread[0 if square == 0 else 1] > spread[1 if square == 0 else 0], "else the x axis is level"


def test_from_above_one_sees_where_the_photographs_were_taken(trace: Trace) -> None:
    """If that is a small part of the map, and the camera has a position; else the whole map."""
    picture = paint(trace, len(steps(trace)) - 1)
    (camera,) = (item for item in picture.scene if item.name == "cameras/estimate")
    assert isinstance(camera, Segments)
    here, whole = camera.points[0, 0], views.find("Above", picture, 1.5)

    def seen(metres: float) -> tuple[views.Viewpoint, np.ndarray]:
        walk = here + metres * np.array([[-0.5, 0.0, 0.0], [0.0, 0.0, 0.2], [0.5, 0.0, 0.0]])
        dots = Points(REFERENCES, "cloud", walk, np.zeros((3, 3), np.uint8), 0.1)
        view = views.find("Above", replace(picture, scene=(*picture.scene, dots)), 1.5)
        return view, views.projected(view, walk) / np.tan(view.field_of_view_rad / 2)

    near, at = seen(1.0)
    walk = here + np.array([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]])
    dots = Points(REFERENCES, "cloud", walk, np.zeros((2, 3), np.uint8), 0.1)
    outcome = replace(picture, scene=(*picture.scene, dots))
    view = views.follow(outcome, 1.5)
    half = views.projected(view, walk) / np.tan(view.field_of_view_rad / 2)
    assert np.all(np.abs(half) < [1.5, 1.0]) and np.ptp(half[:, 0]) > 0.5, "so does the view of the outcome"
    assert views.fits(None, view, outcome, 1.5) and not views.fits(None, views.follow(picture, 1.5), outcome, 1.5)
    names = views.over_the_walk(outcome, view.position)
    assert {"sphere/surface", "sphere/bearings"} <= names and "map/points" not in names, "it would cover them"
    assert not views.over_the_walk(outcome, here) and not views.over_the_walk(picture, view.position)
    assert np.all(np.abs(at) < [1.5, 1.0]) and np.ptp(at[:, 0]) > 1.0
    assert near.position[1] > whole.position[1] + 5.0
    np.testing.assert_allclose(seen(8.0)[0].position, whole.position, atol=0.1)
    first = paint(trace, 0)
    before, after = (
        views.find("Above", replace(first, scene=(*first.scene, *dots)), 1.5)
        for dots in ((), (Points(REFERENCES, "cloud", here + np.eye(3), np.zeros((3, 3), np.uint8), 0.1),))
    )
    np.testing.assert_allclose(before.position, after.position, atol=1.0)


def test_a_card_is_counted_to_cover_what_is_selected_more_than_names(trace: Trace) -> None:
    view, letter = views.Viewpoint(np.zeros(3), np.array([0.0, 0.0, 1.0]), np.pi / 2), 0.01
    there = np.array([[0.8, -0.8, 1.0], [-0.8, -0.8, 1.0]])  # y points down
    aside = views.projected(view, there)[:, 0]
    dots = Points("selection/points", "selection", there[:1], np.zeros((1, 3), np.uint8), 0.1)
    picture = replace(paint(trace, 0), scene=(dots, Label("name", "axes", there[1], "name")))
    for middle, share in zip(aside, (1.0, 0.1), strict=True):
        low, high = np.array([middle - 0.2, 0.4]), np.array([middle + 0.2, 1.0])
        assert views.covered(picture, view, low, high, letter) == share
        assert views.covered(picture, view, low - [0.0, 0.7], high - [0.0, 0.7], letter) == 0.0


def test_names_that_would_lie_over_others_give_way_to_the_more_important_ones(trace: Trace) -> None:
    picture = paint(trace, len(steps(trace)) - 1)
    view = views.follow(picture, 1.5)
    layers = ("scale bar", "point cloud", "uncertainty", "cameras")
    labels = [Label(layer, layer, view.target, "2.jpg") for layer in layers]
    for count in range(2, len(layers) + 1):
        crowded = replace(picture, scene=tuple(labels[:count]))
        assert views.cut(crowded, view, 1.5, 0.02) == set(layers[: count - 1])
    lower = 0.15 * float(np.linalg.norm(view.target - view.position)) * np.array([0.0, 1.0, 0.0])
    apart = replace(labels[1], position=view.target + lower)
    assert views.cut(replace(picture, scene=(labels[3], apart)), view, 1.5, 0.02) == frozenset()
