"""What a click or a rectangle on the canvas means: the projection is viser's, and the nearest thing wins."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import viser.transforms as vtf
from hypothesis import given, settings
from hypothesis import strategies as st

from spherloc_viz import style
from spherloc_viz.app.stage.picking import DOT_PX, LINE_PX, Viewer, inside, nearest, photograph, viewer_of
from spherloc_viz.layers.frame import one_color
from spherloc_viz.layers.primitives import Balls, Points, Segments

PIXEL = 1e-3
"""Radians of a pixel in these tests; the viewer stands at the origin and looks along +z."""
AHEAD = np.array([0.0, 0.0, 1.0])


class Camera:
    """What a client tells of its viewer."""

    def __init__(self, rng: np.random.Generator, width: int = 900, height: int = 500, fov: float = 0.8) -> None:
        self.position, self.wxyz = rng.normal(size=3), vtf.SO3.sample_uniform(rng).wxyz
        self.image_width, self.image_height, self.fov = width, height, fov


def dots(*places: tuple[float, float, float], radius_m: float = 1e-4) -> Points:
    count = len(places)
    return Points("map/points", "map", np.array(places), one_color(style.INLIER, count), radius_m, np.arange(count))


def line(start: tuple[float, float, float], end: tuple[float, float, float], pair: tuple[int, int]) -> Segments:
    return Segments("arcs", "yaw ring", np.array([[start, end]]), one_color(style.CLIQUE, 1), 2.0, np.array([pair]))


def balls(*radii_m: float) -> Balls:
    count = len(radii_m)
    pairs = np.arange(2 * count).reshape(-1, 2)
    centers = np.tile([0.0, 0.0, 9.0], (count, 1))
    return Balls("balls", "balls", centers, np.array(radii_m), one_color(style.CLIQUE, count), 0.2, pairs)


def pick(*items: Points | Segments | Balls, at: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> tuple[int, ...]:
    return nearest(items, np.zeros(3), np.array(at), PIXEL)


def test_projection_is_a_pinhole_with_the_field_of_view_of_the_height(rng: np.random.Generator) -> None:
    """OpenCV's own projection with the intrinsics that viser documents (fov is vertical, axes are OpenCV's)."""
    camera = Camera(rng)
    viewer = viewer_of(camera)  # pyright: ignore[reportArgumentType]
    turn = vtf.SO3(camera.wxyz).as_matrix()
    points = camera.position + rng.uniform((-1, -1, 2), (1, 1, 4), (50, 3)) @ turn.T
    focal = 0.5 * camera.image_height / np.tan(0.5 * camera.fov)
    matrix = np.array([[focal, 0, camera.image_width / 2], [0, focal, camera.image_height / 2], [0, 0, 1.0]])
    spin = cv2.Rodrigues(turn.T)[0]
    pixels = cv2.projectPoints(points, spin, -turn.T @ camera.position, matrix, None)[0].reshape(-1, 2)  # pyright: ignore
    expected = pixels / [camera.image_width, camera.image_height]
    np.testing.assert_allclose(viewer.project(points), expected, atol=1e-9)
    assert viewer.radians_per_pixel == pytest.approx(1.0 / focal)


@settings(max_examples=50)
@given(x=st.floats(0.01, 0.99), y=st.floats(0.01, 0.99), depth=st.floats(0.01, 1e4), seed=st.integers(0, 99))
def test_what_lies_on_the_ray_of_a_place_is_at_that_place(x: float, y: float, depth: float, seed: int) -> None:
    """The ray as the page makes it: through the place on the plane at depth 1, half as high as the field of view's
    tangent."""
    camera = Camera(np.random.default_rng(seed))
    viewer = viewer_of(camera)  # pyright: ignore[reportArgumentType]
    slope = np.tan(0.5 * camera.fov)
    ndc = np.array([2 * x - 1, 1 - 2 * y])
    in_three = np.array([ndc[0] * slope * camera.image_width / camera.image_height, ndc[1] * slope, -1.0])
    ray = vtf.SO3(camera.wxyz).as_matrix() @ (in_three * [1, -1, -1])
    point = camera.position + depth * ray / np.linalg.norm(ray)
    np.testing.assert_allclose(viewer.project(point[None])[0], [x, y], atol=1e-6)
    item = Points("map/points", "map", point[None], one_color(style.INLIER, 1), 1e-6, np.array([5]))
    assert nearest([item], camera.position, ray, viewer.radians_per_pixel) == (5,)
    assert inside([item], viewer, (x - 1e-3, y - 1e-3), (x + 1e-3, y + 1e-3)) == (5,)
    assert inside([item], viewer, (x + 1e-3, y - 1e-3), (x + 2e-3, y + 1e-3)) == ()
    behind = Points("map/points", "map", (2 * camera.position - point)[None], item.colors, 1e-6, np.array([5]))
    assert inside([behind], viewer, (0.0, 0.0), (1.0, 1.0)) == ()
    assert nearest([behind], camera.position, ray, viewer.radians_per_pixel) == ()


def test_a_miss_by_some_pixels_still_means_the_dot() -> None:
    assert pick(dots((0.9 * DOT_PX * PIXEL * 5.0, 0, 5))) == (0,)
    assert pick(dots((1.1 * DOT_PX * PIXEL * 5.0, 0, 5))) == ()
    assert pick(dots((1.0, 0, 5), radius_m=0.99)) == (0,), "a large dot reaches farther"


def test_the_nearest_dot_wins_and_of_those_hit_the_first() -> None:
    assert pick(dots((0.02, 0, 5), (0.01, 0, 5), (0.03, 0, 5))) == (1,)
    assert pick(dots((0.0, 0, 9), (0.05, 0, 4), radius_m=0.1)) == (1,)
    assert pick(dots((0.0, 0, -5))) == () == pick(dots(*[(1.0, 1.0, 1.0)] * 3))


def test_dots_come_before_lines_and_lines_before_balls() -> None:
    arc, near = line((-1, 0, 3), (1, 0, 3), (4, 9)), dots((0, DOT_PX * PIXEL * 0.8, 1))
    assert pick(balls(1.0), arc, near) == (0,)
    assert pick(balls(1.0), arc) == (4, 9)
    assert pick(balls(1.0)) == (0, 1)


def test_a_line_is_where_it_is_seen() -> None:
    across = LINE_PX * PIXEL * 3.0
    assert pick(line((-1, 0.9 * across, 3), (1, 0.9 * across, 3), (4, 9))) == (4, 9)
    assert pick(line((-1, 1.1 * across, 3), (1, 1.1 * across, 3), (4, 9))) == ()
    assert pick(line((0.1, 0, 3), (1, 0, 3), (4, 9))) == (), "it ends before the click"
    # In perspective: halfway on the screen is not halfway along the line.
    slanted = line((-0.5, 0, 1), (3.0, 0, 6), (4, 9))
    assert pick(slanted, at=(0.0, 0.0, 1.0)) == (4, 9) and pick(slanted, at=(0.0, 0.1, 1.0)) == ()
    assert pick(line((0, 0, -1), (0, 0, -2), (4, 9))) == ()
    assert pick(line((0, 0, 2), (0, 0, 3), (4, 9))) == (4, 9), "seen end on it is a dot"


def test_of_balls_within_balls_the_smallest_that_is_hit() -> None:
    assert pick(balls(3.0, 1.0, 2.0)) == (2, 3)
    assert pick(balls(3.0, 1.0, 2.0), at=(1.5, 0.0, 9.0)) == (4, 5)
    assert pick(balls(3.0, 1.0, 2.0), at=(4.0, 0.0, 9.0)) == ()


def test_what_shows_no_correspondence_is_not_picked() -> None:
    plain = dots((0, 0, 5))
    for item in (
        Points(plain.name, plain.layer, plain.positions, plain.colors, 1.0),
        Segments("rays", "rays", np.array([[[-1.0, 0, 3], [1, 0, 3]]]), one_color(style.INLIER, 1), 2.0),
        replace(plain, ids=None, photographs=("first.jpg",)),
    ):
        assert pick(item) == ()
    viewer = Viewer(np.zeros(3), np.eye(3), np.ones(2), PIXEL)
    assert inside([replace(plain, ids=None)], viewer, (0, 0), (1, 1)) == ()
    empty = Segments("rays", "rays", np.zeros((0, 2, 3)), one_color(style.INLIER, 0), 2.0, np.zeros((0, 2), np.int64))
    assert nearest([empty], np.zeros(3), AHEAD, PIXEL) == ()


def test_the_dot_of_a_photograph_is_pressed_where_no_dot_of_a_match_is_nearer() -> None:
    places, colors = np.array([[0.0, 0.0, 5.0], [1.0, 0.0, 5.0]]), one_color(style.REFERENCE, 2)
    taken = Points("cloud/references", "point cloud", places, colors, 0.01, photographs=("first.jpg", "second.jpg"))
    around, match = balls(3.0), dots((1.02, 0.0, 5.0))

    def pressed(at: tuple[float, float, float], *items: Points | Balls) -> tuple[str, str] | None:
        return photograph(items, np.zeros(3), np.array(at), PIXEL)

    assert pressed((1.0, 0.0, 5.0), taken, around) == ("point cloud", "second.jpg")
    assert pressed((0.5, 0.0, 5.0), taken, around) is None
    assert pressed((1.03, 0.0, 5.0), taken, match) is None and pick(taken, match, at=(1.03, 0.0, 5.0)) == (0,)
    assert pick(taken, at=(1.0, 0.0, 5.0)) == (), "it is no match"
