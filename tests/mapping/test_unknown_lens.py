"""Fisheyes without a calibration: their image circle, their lens by matches, and what is said where those do not do."""

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from spherloc import registry
from spherloc.cameras.calibration import load_camera
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.datasets import load_scene
from spherloc.errors import InputError
from spherloc.frontend.view import View
from spherloc.geometry import so3_exp
from spherloc.mapping.images import lens_fit, unknown_lens
from spherloc.mapping.images.folder_cameras import CalibratedLens
from spherloc.mapping.images.image_circle import image_circle
from spherloc.mapping.images.lens_fit import Circle, RadialLens, fit_lens
from spherloc.mapping.images.photographs import Photographs, photographs
from spherloc.mapping.images.unknown_lens import MAX_OFF_RAD, find_lens
from spherloc.mapping.scenes.scene_files import LENS, lenses_given, write_lenses
from spherloc_viz.commands.map import _lens_finder, _lens_told

TRUE = KannalaBrandt(900, 700, 270.0, 270.0, 458.0, 343.0, (-1 / 24, 1 / 1920, 0.0, 0.0))
RIM = Circle(450.0, 350.0, float(np.hypot(450, 350)))


@pytest.fixture
def few_fields(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fewer lenses are tried, which takes most of the time of a fit."""
    monkeypatch.setattr(lens_fit, "HALF_FIELDS_RAD", np.radians([70.0, 90.0, 110.0]))


def matched(rng: np.random.Generator, *, turned: bool, count: int = 12) -> list[tuple[np.ndarray, np.ndarray]]:
    """Matches of so many pairs of images, a fifth of them wrong, with noise of 0.3 px."""
    pairs = []
    for _ in range(count):
        points = rng.uniform((-6.0, -6.0, -4.0), (6.0, 6.0, 8.0), (600, 3))
        turn = so3_exp(rng.normal(0.0, 0.3, 3)) if turned else np.eye(3)
        move = rng.normal(0.0, 0.5, 3) if turned else np.array([0.0, 0.0, -rng.uniform(0.5, 1.0)])
        seen, inside = zip(*(TRUE.project(place) for place in (points, points @ turn.T + move)), strict=True)
        both = inside[0] & inside[1]
        for pixels in seen:
            both &= np.all((pixels > 0) & (pixels < (TRUE.width, TRUE.height)), axis=1)
        first, second = (pixels[both] + rng.normal(0.0, 0.3, (np.count_nonzero(both), 2)) for pixels in seen)
        wrong = rng.random(len(first)) < 0.2
        second[wrong] = rng.uniform((0, 0), (TRUE.width, TRUE.height), (np.count_nonzero(wrong), 2))
        pairs.append((first[:150], second[:150]))
    return pairs


def angles(lens: RadialLens | KannalaBrandt, radii: np.ndarray) -> np.ndarray:
    pixels = np.column_stack([lens.cx + radii, np.full(len(radii), lens.cy)])
    rays = lens.bearings(pixels)[0] if isinstance(lens, RadialLens) else lens.unproject(pixels)[0]
    return np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])


def test_a_lens_is_found_by_matches(rng):
    pycolmap = registry.require("pycolmap", "colmap", "a test")
    pairs = matched(rng, turned=True)
    fit, off_rad = fit_lens(pycolmap, pairs, RIM, lambda *_: None, is_circle=False)
    radii = np.linspace(0.0, 450.0, 10)
    assert np.degrees(np.abs(angles(fit.lens, radii) - angles(TRUE, radii)).max()) < 0.3
    assert np.hypot(fit.lens.cx - TRUE.cx, fit.lens.cy - TRUE.cy) < 2.0
    assert np.degrees(off_rad) < 0.5
    assert 0.6 * 12 * 150 < fit.matches < 0.9 * 12 * 150
    same, again = (
        lens_fit._refined(pycolmap, pairs, fit.lens, lens_fit.Expected(RIM, None), lens_fit.BOUNDS_PX[-1:])
        for _ in range(2)
    )
    assert same.lens == again.lens, "what is done is used again only if the lens is the same to the last bit"


@pytest.mark.usefixtures("few_fields")
def test_a_camera_that_only_went_straight_ahead_does_not_tell_its_lens(rng):
    pycolmap = registry.require("pycolmap", "colmap", "a test")
    _, off_rad = fit_lens(pycolmap, matched(rng, turned=False, count=8), RIM, lambda *_: None, is_circle=False)
    assert off_rad > MAX_OFF_RAD


@pytest.mark.usefixtures("few_fields")
def test_a_kind_of_lens_that_fits_nothing_in_the_end_is_no_rival(rng, monkeypatch):
    refined, seen = lens_fit._refined, []

    def fails_for_rivals(pycolmap, pairs, lens, expected, bounds_px):
        if bounds_px is lens_fit.BOUNDS_PX and len(pairs) == lens_fit.FIRST_PAIRS:
            seen.append(lens)
            raise ValueError
        return refined(pycolmap, pairs, lens, expected, bounds_px)

    monkeypatch.setattr(lens_fit, "FIRST_PAIRS", 5)
    monkeypatch.setattr(lens_fit, "NEARLY", 0.0)  # all are rivals
    monkeypatch.setattr(lens_fit, "_refined", fails_for_rivals)
    pycolmap = registry.require("pycolmap", "colmap", "a test")
    fit, _ = fit_lens(pycolmap, matched(rng, turned=True), RIM, lambda *_: None, is_circle=False)
    assert seen and fit.matches > 0.6 * 12 * 150


def test_bearings_of_a_lens_and_their_slopes(rng):
    lens = RadialLens(270.0, 458.0, 343.0, -1 / 24, 1 / 1920)
    pixels = rng.uniform((0, 0), (900, 700), (200, 2))
    rays, outwards, sideways = lens.bearings(pixels)
    np.testing.assert_allclose(rays, TRUE.unproject(pixels)[0], atol=1e-9)
    out = pixels - (lens.cx, lens.cy)
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    for way, slope in ((out, outwards), (np.column_stack([-out[:, 1], out[:, 0]]), sideways)):
        np.testing.assert_allclose((lens.bearings(pixels + 1e-3 * way)[0] - rays) / 1e-3, slope, atol=1e-5)


def circular(rng: np.random.Generator, size: tuple[int, int], centre: tuple[float, float], radius: float) -> np.ndarray:
    """A picture that is dark outside of a circle, but for noise."""
    columns, rows = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    image = rng.integers(30, 255, (size[1], size[0])).astype(np.uint8)
    outside = np.hypot(columns + 0.5 - centre[0], rows + 0.5 - centre[1]) > radius
    image[outside] = rng.integers(0, 8, np.count_nonzero(outside))
    return image


@pytest.mark.parametrize("radius", [190.0, 260.0])
def test_an_image_circle_is_found(rng, radius):
    """Also one that the image cuts above and below, and though part of it is dark in one of the images."""
    images = [circular(rng, (640, 480), (330.0, 236.0), radius) for _ in range(3)]
    images[0][:, 300:] = 0
    circle = image_circle(images)
    assert circle is not None
    assert np.hypot(circle.x - 330.0, circle.y - 236.0) < 1.5 and abs(circle.radius - radius) < 2.5


def test_an_image_without_a_circle_has_none(rng):
    full = rng.integers(30, 255, (480, 640)).astype(np.uint8)
    dark = np.zeros((480, 640), np.uint8)
    window = dark.copy()
    window[150:300, 200:420] = 200
    assert image_circle([full]) is None and image_circle([dark]) is None and image_circle([window]) is None
    assert image_circle([]) is None


def test_photographs_without_a_calibration_are_given_the_lens_that_they_tell(tmp_path, rng):
    for name in ("1.png", "2.png", "3.png"):
        cv2.imwrite(str(tmp_path / name), rng.integers(0, 255, (300, 400), dtype=np.uint8))
    cv2.imwrite(str(tmp_path / "other.png"), rng.integers(0, 255, (300, 300), dtype=np.uint8))
    lens = KannalaBrandt(400, 300, 90.0, 90.0, 200.0, 150.0, (0.01, 0.0, 0.0, 0.0))
    asked = []

    def finds(paths: list[Path], size: tuple[int, int]) -> CalibratedLens:
        asked.append(([path.name for path in paths], size))
        return CalibratedLens(lens, "It was found.")

    found = photographs(tmp_path, {}, find_lens=finds)
    assert asked == [(["1.png", "2.png", "3.png"], (400, 300))]
    assert [view.camera for view in found.views] == [lens] * 3 and found.calibrated == {
        "": CalibratedLens(lens, "It was found.")
    }
    assert found.remarks[0] == "It was found." and "1 of 4 images were left out" in found.remarks[1]
    write_lenses(tmp_path, found.calibrated)
    assert load_camera(tmp_path / LENS) == lens
    assert (tmp_path / LENS).read_text().startswith("# It was found.\n")
    asked.clear()
    beside = photographs(tmp_path, {}, find_lens=finds)
    assert [view.camera for view in beside.views] == [lens] * 3 and not asked and not beside.calibrated
    (tmp_path / LENS).unlink()

    def refuses(paths: list[Path], size: tuple[int, int]) -> CalibratedLens:
        raise InputError("they are too few")

    told = r"3 of 400 x 300 pixels, 1 of 300 x 300 pixels, .* have no calibration, and they are too few\. Or .*--camera"
    with pytest.raises(InputError, match=told):
        photographs(tmp_path, {}, find_lens=refuses)


def test_a_map_that_is_made_again_keeps_its_lens(tmp_path):
    """Of its images and of those in a folder, if they have the size; the file keeps how it was found."""
    lens = KannalaBrandt(400, 300, 90.0, 90.0, 200.0, 150.0, (0.01, 0.0, 0.0, 0.0))
    left = CalibratedLens(replace(lens, fx=95.0), "It was found, too.")
    write_lenses(tmp_path, {"": CalibratedLens(lens, "It was found."), "left": left})
    images = tmp_path / "images"
    find = _lens_finder(lambda *_: None, images, tmp_path, None)
    found, how, _ = find([images / "a.png"], (400, 300))
    assert found == lens and str(tmp_path / LENS) in how
    assert find([images / "left" / "a.png"], (400, 300))[0] == replace(lens, fx=95.0)
    write_lenses(tmp_path, {"": CalibratedLens(lens, how)})
    assert (tmp_path / LENS).read_text().startswith("# It was found.\n")
    views = [View(name, replace(lens, fx=fx), Path(name)) for name, fx in (("a", 91.0), ("up/a", 92.0), ("up/b", 93.0))]
    write_lenses(tmp_path, lenses_given(views))
    assert find([images / "a.png"], (400, 300))[0] == replace(lens, fx=91.0)
    assert "Given as the calibration" in (tmp_path / LENS).read_text()
    assert not (tmp_path / "lens_up.toml").exists()  # its images have two
    for name, size in (("a.png", (400, 301)), ("right/a.png", (400, 300))):
        with pytest.raises(InputError, match="too few to calibrate"):
            find([images / name], size)
    (tmp_path / LENS).write_text("[camera]\nmodel = 3")
    with pytest.raises(InputError, match="too few to calibrate"):
        find([images / "a.png"], (400, 300))


def test_what_is_said_where_photographs_do_not_tell_their_lens(tmp_path, rng):
    paths = []
    for number in range(7):
        paths.append(tmp_path / f"{number}.png")
        cv2.imwrite(str(paths[-1]), rng.integers(0, 255, (200, 300), dtype=np.uint8))
    with pytest.raises(InputError, match="too few to calibrate their lens by them, which takes 6 or more"):
        find_lens(paths[:5], (300, 200), lambda *_: None)
    with pytest.raises(InputError, match="only 0 pairs of them match"):
        find_lens(paths, (300, 200), lambda *_: None)


def test_a_lens_that_pairs_do_not_tell_is_left_to_the_map(tmp_path, monkeypatch):
    """Of all photographs of a map, but not of those of one of several cameras."""
    images = tmp_path / "images"
    (images / "left").mkdir(parents=True)
    paths = [images / f"{number}.png" for number in range(6)]
    for path in (*paths, images / "left" / "0.png"):
        cv2.imwrite(str(path), np.zeros((700, 900), np.uint8))
    lens = RadialLens(270.0, 450.0, 350.0, 0.0, 0.0)
    fit = lens_fit.LensFit(lens, 500, np.array([100.0, 400.0]), 100.0)
    monkeypatch.setattr(unknown_lens, "_features", lambda *_: [])
    monkeypatch.setattr(unknown_lens, "_pairs", lambda *_: [None] * 6)
    monkeypatch.setattr(unknown_lens, "fit_lens", lambda *_, **__: (fit, np.radians(7.0)))
    found = find_lens(paths, (900, 700), lambda *_: None)
    assert found.camera == KannalaBrandt(900, 700, 270.0, 270.0, 450.0, 350.0, (0.0, 0.0, 0.0, 0.0))
    assert "differ by 7.0°" in found.untold and "there is a map only if that tells the lens better" in found.how
    finder = _lens_finder(lambda *_: None, images, tmp_path, None)
    assert finder(paths, (900, 700)) == found
    with pytest.raises(InputError, match=r"lenses that differ by 7\.0° fit them"):
        finder([images / "left" / "0.png"] * 6, (900, 700))


def test_only_a_lens_that_the_photographs_told_is_left_to_the_map(tmp_path):
    lens = CalibratedLens(TRUE, "It was found.")
    views = tuple(View(name, TRUE, Path(name)) for name in ("a.png", "b.png"))
    found = Photographs(views, (), {}, {"": lens})
    assert _lens_told(found, tmp_path) == lens
    assert _lens_told(replace(found, calibrated={}), tmp_path) is None
    other = View("c.png", replace(TRUE, fx=271.0), Path("c.png"))
    assert _lens_told(replace(found, views=(*views, other)), tmp_path) is None
    write_lenses(tmp_path, {"": lens})
    assert _lens_told(found, tmp_path) == lens
    write_lenses(tmp_path, lenses_given([other]))
    assert _lens_told(found, tmp_path) is None


SCENE = """
kind = "rendered"
name = "flat"
provenance = "spherloc"
world = "apartment"
[camera]
model = "kannala_brandt"
width = 420
height = 420
fx = 150.0
fy = 150.0
cx = 206.0
cy = 213.0
distortion = [-0.0416667, 0.00052083, 0.0, 0.0]
[references]
count = 14
[queries]
count = 1
start = 0.5
stop = 0.6
"""


def test_a_lens_is_found_by_images(tmp_path, monkeypatch):
    """Rendered fisheyes of a flat; the principal point may be off as if the camera were turned."""
    path = tmp_path / "flat.toml"
    path.write_text(SCENE)
    images = []
    for view in load_scene(path).references:
        images.append(tmp_path / f"{view.name}.png")
        cv2.imwrite(str(images[-1]), view.read())
        true = view.camera
    stages, fitted = [], []

    def fits(pycolmap, pairs, *rim, **kind):
        fitted.append((pairs, fit_lens(pycolmap, pairs, *rim, **kind) if not fitted else fitted[0][1]))
        return fitted[-1][1]

    monkeypatch.setattr(unknown_lens, "fit_lens", fits)
    camera, remark, untold = find_lens(images, (420, 420), lambda kind, done, count: stages.append((kind, done, count)))
    radii = np.linspace(0.0, 200.0, 10)
    assert np.degrees(np.abs(angles(camera, radii) - angles(true, radii)).max()) < 1.5
    assert abs(camera.cx - true.cx) < 4 and abs(camera.cy - true.cy) < 4
    assert re.fullmatch(
        r"There was no calibration, so the lens was calibrated by [0-9,]+ matches between the photographs, which are "
        r"spread over \d+° of its view\. Lenses that fit as well, or halves of them, give directions that differ by "
        r"\d\.\d° at most; 2° would be too much\.",
        remark,
    )
    assert [kind for kind, done, count in stages if done == count] == [
        "images searched for features of their lens",
        "pairs matched for the lens",
        "fits of the lens to the matches",
    ]
    assert not untold
    find_lens(images, (420, 420), lambda *_: None)
    (first, _), (again, _) = fitted
    for one, other in zip(first, again, strict=True):  # and so what is done is used again
        np.testing.assert_array_equal(one, other)
