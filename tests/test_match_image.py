"""The picture of the matches between a query and its reference shows what is there, in the colours it is given."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.problem import Problem
from spherloc_viz import style
from spherloc_viz.layers.match_image import GAP_PX, WIDTH_PX, match_image

CAMERA = Equirectangular(300, 150)
SCALE = WIDTH_PX / 300
LIGHT, DARK = (0, 0, 200), 40


@pytest.fixture
def problem(tmp_path: Path, rng: np.random.Generator) -> Problem:
    """Ten matches: the first six with reference 0, the rest with reference 1. Photographs of one colour each."""
    cv2.imwrite(str(tmp_path / "query.png"), np.full((150, 300, 3), LIGHT, np.uint8))  # red, as OpenCV orders colours
    for number in (0, 1):
        cv2.imwrite(str(tmp_path / f"reference{number}.png"), np.full((100, 200), DARK + number, np.uint8))
    return Problem(
        name="pair",
        camera=CAMERA,
        pixels=np.column_stack([20.0 + 25.0 * np.arange(10), np.full(10, 75.0)]),
        points=rng.normal(size=(10, 3)),
        gravity_camera=np.array([0.0, 1.0, 0.0]),
        gravity_map=np.array([0.0, 1.0, 0.0]),
        image=tmp_path / "query.png",
        reference_images=(tmp_path / "reference0.png", tmp_path / "reference1.png"),
        reference_index=np.repeat([0, 1], [6, 4]),
        reference_pixels=np.column_stack([10.0 + 15.0 * np.arange(10), np.full(10, 50.0)]),
    )


def colors_of(inliers: np.ndarray) -> np.ndarray:
    return np.where(inliers[:, None], np.uint8(style.INLIER), np.uint8(style.OUTLIER))


def at(image: np.ndarray, pixel: tuple[float, float], down: int = 0) -> tuple[int, ...]:
    return tuple(image[int(pixel[1]) + down, int(pixel[0])].tolist())


def test_the_reference_with_most_inliers_and_the_colours_of_the_step(problem: Problem) -> None:
    inliers = np.array([True, False, False, False, False, False, True, True, True, False])
    shown = match_image(problem, colors_of(inliers), inliers)
    assert shown is not None and problem.reference_pixels is not None
    assert "query.png and reference1.png, one of 2 references: 4 matches" in shown.caption
    height = round(SCALE * 150)
    assert shown.image.shape == (height + GAP_PX + WIDTH_PX // 2, WIDTH_PX, 3)
    red, green, blue = at(shown.image, (10.0, 10.0))
    assert red > 120 and green < 20 and blue < 20, "colours must arrive in the screen's order"
    for k in range(6, 10):
        color = style.INLIER if inliers[k] else style.OUTLIER
        assert at(shown.image, tuple(SCALE * problem.pixels[k])) == color
        assert at(shown.image, tuple(4.5 * problem.reference_pixels[k]), height + GAP_PX) == color
    assert at(shown.image, tuple(SCALE * problem.pixels[0])) != style.INLIER, "a match with the other reference"


def test_lines_join_inliers_only(problem: Problem) -> None:
    inliers = np.zeros(10, dtype=bool)
    inliers[2] = True
    with_line = match_image(problem, colors_of(inliers), inliers)
    without = match_image(problem, colors_of(np.zeros(10, dtype=bool)), inliers)
    assert with_line is not None and without is not None and problem.reference_pixels is not None
    height = round(SCALE * 150)
    gap = slice(height, height + GAP_PX)
    assert not without.image[gap].any()
    columns = np.flatnonzero(with_line.image[gap].any(axis=(0, 2)))
    start, end = SCALE * problem.pixels[2], 4.5 * problem.reference_pixels[2] + [0.0, height + GAP_PX]
    crossing = start[0] + (end[0] - start[0]) * (height + GAP_PX / 2 - start[1]) / (end[1] - start[1])
    assert len(columns) and abs(columns.mean() - crossing) < 3.0


def test_nothing_to_show_without_images(problem: Problem) -> None:
    assert match_image(replace(problem, image=None), colors_of(np.zeros(10, bool)), np.zeros(10, bool)) is None


def test_a_query_alone(problem: Problem) -> None:
    alone = replace(problem, reference_images=(), reference_index=None, reference_pixels=None)
    shown = match_image(alone, colors_of(np.ones(10, bool)), np.ones(10, bool))
    assert shown is not None and shown.image.shape == (round(SCALE * 150), WIDTH_PX, 3)
    assert shown.caption == "query.png with its 10 matches."
    assert at(shown.image, tuple(SCALE * problem.pixels[9])) == style.INLIER


def test_an_image_that_has_gone_is_said(problem: Problem) -> None:
    problem.reference_images[0].unlink()
    inliers = np.repeat([True, False], [6, 4])
    shown = match_image(problem, colors_of(inliers), inliers)
    assert shown is not None and "reference0.png cannot be read any more." in shown.caption


def test_unknown_reference_pixels_are_left_out(problem: Problem) -> None:
    inliers = np.repeat([True, False], [6, 4])
    unknown = replace(problem, reference_pixels=np.full((10, 2), np.nan))
    shown = match_image(unknown, colors_of(inliers), inliers)
    assert shown is not None
    below = shown.image[round(SCALE * 150) + GAP_PX :]
    assert len(np.unique(below)) == 1, "the reference must stay as it is"


def test_many_inliers_are_thinned_and_counted(problem: Problem, rng: np.random.Generator) -> None:
    count = 3 * style.MAX_DRAWN_MATCHES + 1
    many = replace(
        problem,
        pixels=rng.uniform([0, 0], [300, 150], (count, 2)),
        points=rng.normal(size=(count, 3)),
        reference_index=np.zeros(count, np.int64),
        reference_pixels=rng.uniform([0, 0], [200, 100], (count, 2)),
    )
    shown = match_image(many, colors_of(np.ones(count, bool)), np.ones(count, bool))
    assert shown is not None
    drawn = int(shown.caption.split("Lines for ")[1].split()[0])
    assert style.MAX_DRAWN_MATCHES / 2 < drawn <= style.MAX_DRAWN_MATCHES
    assert f"of its {count} inliers" in shown.caption
