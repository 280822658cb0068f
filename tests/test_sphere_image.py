"""The picture on the sphere: a marked pixel lands where its bearing points, in the aligned camera frame."""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from spherloc.cameras.base import Camera
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.datasets import load_scene
from spherloc.datasets.synthetic import SyntheticScene
from spherloc.geometry import so3_exp
from spherloc.problem import Problem
from spherloc_viz.layers.query_image import DIM, MAX_PIXELS, PANORAMA, UNSEEN, photograph, sphere_texture

BLOB_PX = 8


def problem_of(camera: Camera, image: Path | None, rng: np.random.Generator, lean_rad: float = 0.4) -> Problem:
    """Some matches of a camera that leans."""
    bearings = rng.normal(size=(400, 3))
    pixels, valid = camera.project(bearings)
    inside = valid & (pixels >= 0).all(axis=1) & (pixels < [camera.width, camera.height]).all(axis=1)
    down = so3_exp(rng.normal(size=3) * lean_rad)[:, 1]
    return Problem("p", camera, pixels[inside], bearings[inside], down, np.array([0.0, 1.0, 0.0]), image=image)


def marked(path: Path, camera: Camera, pixel: np.ndarray, share: float = 1.0) -> Path:
    """A dark image with a red blob around a pixel, of the camera's size times ``share``."""
    image = np.full((round(camera.height * share), round(camera.width * share), 3), 20, np.uint8)
    x, y = (share * pixel - 0.5).round().astype(int).tolist()
    cv2.circle(image, (x, y), round(share * BLOB_PX), (0, 0, 255), -1)  # red, as OpenCV orders colours
    cv2.imwrite(str(path), image)
    return path


@pytest.mark.parametrize("camera", ["mei", "fisheye", "panorama"])
@pytest.mark.parametrize("share", [1.0, 0.5])
def test_a_marked_pixel_lands_where_its_bearing_points(
    camera: str, share: float, scene_of: Callable[..., SyntheticScene], tmp_path: Path, rng: np.random.Generator
) -> None:
    model = scene_of(camera).camera
    plain = problem_of(model, None, rng)
    for number in range(3):
        pixel = plain.pixels[np.argmin(np.linalg.norm(plain.pixels - rng.uniform([200, 200], [900, 500]), axis=1))]
        problem = replace(plain, image=marked(tmp_path / f"{number}.png", model, pixel, share))
        texture = sphere_texture(problem)
        assert texture is not None and texture.shape == (PANORAMA.height, PANORAMA.width, 3)
        bearing, _ = model.unproject(pixel[None])
        (expected,), _ = PANORAMA.project(bearing @ problem.aligned.camera_turn.T)
        red = texture[..., 0].astype(float) - texture[..., 2] > 60
        assert red.any() and texture[red][:, 0].max() <= 255 * DIM + 1, "red in the screen's order, and dimmed"
        assert red[int(expected[1]), int(expected[0])]
        places, _ = PANORAMA.unproject((np.argwhere(red)[:, ::-1] + 0.5).astype(np.float64))
        back, valid = model.project(places @ problem.aligned.camera_turn)
        off = np.linalg.norm(back - pixel, axis=1)
        assert valid.all() and off.max() < BLOB_PX + 2.0 / share


def test_what_the_camera_does_not_see_is_grey(
    scene_of: Callable[..., SyntheticScene], tmp_path: Path, rng: np.random.Generator
) -> None:
    camera = scene_of("fisheye").camera
    path = tmp_path / "white.png"
    cv2.imwrite(str(path), np.full((camera.height, camera.width), 255, np.uint8))
    problem = problem_of(camera, path, rng)
    texture = sphere_texture(problem)
    assert texture is not None
    rows, columns = rng.integers(0, PANORAMA.height, 500), rng.integers(0, PANORAMA.width, 500)
    bearings, _ = PANORAMA.unproject((np.column_stack([columns, rows]) + 0.5).astype(np.float64))
    pixels, valid = camera.project(bearings @ problem.aligned.camera_turn)
    with np.errstate(invalid="ignore"):
        seen = valid & (pixels >= 0).all(axis=1) & (pixels < [camera.width, camera.height]).all(axis=1)
    assert 50 < seen.sum() < 450
    assert (texture[rows, columns][seen] == round(DIM * 255)).all()
    assert (texture[rows, columns][~seen] == UNSEEN).all()


def test_the_seam_of_a_panorama_does_not_show(tmp_path: Path, rng: np.random.Generator) -> None:
    camera = Equirectangular(400, 200)
    path = tmp_path / "smooth.png"
    waves = 128 + 100 * np.cos(2 * np.pi * (np.arange(400) + 0.5) / 400)
    cv2.imwrite(str(path), np.tile(waves.round().astype(np.uint8), (200, 1)))
    texture = sphere_texture(problem_of(camera, path, rng, lean_rad=0.0))
    assert texture is not None
    row = texture[PANORAMA.height // 2, :, 0].astype(int)
    assert np.abs(np.diff(np.append(row, row[0]))).max() <= 2


def test_it_is_made_once_for_an_image_camera_and_gravity(tmp_path: Path, rng: np.random.Generator) -> None:
    camera = Equirectangular(400, 200)
    path = marked(tmp_path / "a.png", camera, np.array([100.0, 100.0]))
    problem = problem_of(camera, path, rng)
    first = sphere_texture(problem)
    assert first is not None and not first.flags.writeable
    assert sphere_texture(replace(problem, pixels=problem.pixels + 1e-9)) is first
    turned = sphere_texture(replace(problem, gravity_camera=np.array([1.0, 0.0, 0.0])))
    assert turned is not None and not np.array_equal(turned, first)
    marked(path, camera, np.array([300.0, 60.0]))
    os.utime(path, ns=(1, 1))
    again = sphere_texture(problem)
    assert again is not None and not np.array_equal(again, first)


def test_nothing_to_wear_without_an_image(tmp_path: Path, rng: np.random.Generator) -> None:
    camera = Equirectangular(400, 200)
    assert sphere_texture(problem_of(camera, None, rng)) is None
    assert sphere_texture(problem_of(camera, tmp_path / "gone.png", rng)) is None
    (tmp_path / "text.png").write_text("no image")
    assert sphere_texture(problem_of(camera, tmp_path / "text.png", rng)) is None


def test_large_photographs_are_kept_small(tmp_path: Path) -> None:
    path = tmp_path / "large.png"
    cv2.imwrite(str(path), np.zeros((2000, 4000), np.uint8))
    photo = photograph(path)
    assert photo is not None and photo.image.shape[0] * photo.image.shape[1] <= 1.01 * MAX_PIXELS
    assert photo.scale == pytest.approx(photo.image.shape[1] / 4000)


def test_a_real_photograph_shows_its_colours_at_its_matches(aria: Path) -> None:
    problem = load_scene(aria / "rgb.toml").problem()
    texture, photo = sphere_texture(problem), photograph(problem.image)
    assert texture is not None and photo is not None
    aligned = problem.aligned
    places, _ = PANORAMA.project(aligned.bearings)
    shown = texture[places[:, 1].astype(int), places[:, 0].astype(int)].astype(float) / DIM
    blurred = cv2.GaussianBlur(photo.image, (0, 0), 2.0)
    pixels = problem.pixels[aligned.index].astype(int)
    true = blurred[pixels[:, 1], pixels[:, 0]].astype(float)
    assert np.median(np.abs(shown - true)) < 6.0
    assert np.median(np.abs(shown - rng_shuffled(true))) > 15.0


def rng_shuffled(values: np.ndarray) -> np.ndarray:
    return np.random.default_rng(0).permutation(values)
