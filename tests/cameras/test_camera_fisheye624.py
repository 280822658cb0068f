"""FISHEYE624: real calibrations against COLMAP and against a fit of another model; limits; random calibrations."""

import json

import numpy as np
import pycolmap
import pytest
from camera_samples import INLINE, angle_rad, check_invertible, pixel_grid, random_directions, require_shared, sample
from hypothesis import given, settings
from hypothesis import strategies as st

from spherloc.cameras.fisheye624 import Fisheye624
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.errors import CalibrationError

pytestmark = pytest.mark.filterwarnings("error")

ARIA = ("rgb", "slam-left", "slam-right")


def aria(name: str) -> Fisheye624:
    """A real calibration, with one focal length and the principal point of the file, as the fits of it have it."""
    table = json.loads(require_shared("aria_adt_fisheye/calibration_fisheye624.json").read_text())[f"camera-{name}"]
    f, cx, cy, *distortion = table["params"]
    return Fisheye624(*table["size"], f, f, cx, cy, tuple(distortion))


@pytest.mark.parametrize("name", ARIA)
def test_real_calibrations_agree_with_colmap(name):
    camera = aria(name)
    params = [camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion]
    colmap = pycolmap.Camera(
        model="RAD_TAN_THIN_PRISM_FISHEYE", width=camera.width, height=camera.height, params=params
    )
    points = random_directions(seed=31, count=10_000)
    points = points[(points[:, 2] > 0.05 * np.linalg.norm(points, axis=1)) & camera.project(points)[1]]
    pixels = camera.project(points)[0]
    assert len(points) > 1000
    np.testing.assert_allclose(pixels, colmap.img_from_cam(points), atol=1e-9)
    # COLMAP knows no validity limit (see the test of Kannala-Brandt): compare what it solved.
    expected = np.column_stack([colmap.cam_from_img(pixels), np.ones(len(pixels))])
    solved = np.isfinite(expected).all(axis=1)
    solved[solved] = np.abs(colmap.img_from_cam(expected[solved]) - pixels[solved]).max(axis=1) < 1e-6
    solved &= camera.project(expected)[1]
    assert solved.mean() > 0.7
    assert angle_rad(camera.unproject(pixels)[0], expected)[solved].max() < 1e-7


@pytest.mark.parametrize("name", ARIA)
def test_the_kannala_brandt_fit_of_the_real_lens_is_half_a_pixel_away(name):
    camera, fit = aria(name), sample(f"aria_adt_fisheye/{name.replace('-', '_')}.toml")
    pixels = pixel_grid(camera, step=9.0)
    pixels = pixels[np.hypot(*(pixels - [camera.cx, camera.cy]).T) < 0.45 * camera.height]
    both = camera.unproject(pixels)[1]
    error = np.linalg.norm(fit.project(camera.unproject(pixels)[0])[0] - pixels, axis=1)[both]
    assert both.all() and np.sqrt(np.mean(error**2)) < 0.6


def test_without_prism_and_tangential_terms_it_is_kannala_brandt():
    lens = (-0.02, 0.003, -0.0008, 0.00001)
    ours = Fisheye624(1200, 1200, 300.0, 301.0, 600.5, 598.0, (*lens, *[0.0] * 8))
    kannala_brandt = KannalaBrandt(1200, 1200, 300.0, 301.0, 600.5, 598.0, lens)
    points = random_directions(seed=32, count=5000)
    pixels, valid = ours.project(points)
    np.testing.assert_array_equal(valid, kannala_brandt.project(points)[1])
    np.testing.assert_allclose(pixels, kannala_brandt.project(points)[0], rtol=1e-14)
    np.testing.assert_allclose(ours.unproject(pixels)[0], kannala_brandt.unproject(pixels)[0], atol=1e-14)


def test_a_prism_that_folds_ends_the_valid_range():
    camera = Fisheye624(1000, 1000, 300.0, 300.0, 500.0, 500.0, (*[0.0] * 8, 0.5, 0.0, 0.0, 0.0))
    # 2 s0 r reaches 1/2 at r = 1/2; without other terms r is the angle
    assert camera.max_angle_rad == pytest.approx(0.5, rel=1e-6)
    theta = np.array([0.49, 0.51])
    points = np.column_stack([-np.sin(theta), np.zeros(2), np.cos(theta)])
    pixels, valid = camera.project(points)
    np.testing.assert_array_equal(valid, [True, False])
    assert pixels[0, 0] == pytest.approx(500.0 + 300.0 * (-0.49 + 0.5 * 0.49**2))
    np.testing.assert_allclose(camera.unproject(pixels[:1])[0], points[:1], atol=1e-14)


@pytest.mark.parametrize("lens", [[0.0] * 11, [0.0] * 13, [*[0.0] * 11, np.nan], None, [-1e9, *[0.0] * 11]])
def test_a_bad_lens_is_named(lens):
    with pytest.raises(CalibrationError, match=r"^x: camera key 'distortion' is "):
        Fisheye624.from_dict(INLINE["624-aria-rgb"].to_dict() | {"distortion": lens}, "x")


def cameras() -> st.SearchStrategy[Fisheye624]:
    def build(scale, radial, others, cx, cy):
        try:
            lens = (*(scale * k for k in radial), *(0.1 * scale * k for k in others))
            return Fisheye624(800, 700, 300.0, 310.0, cx, cy, lens)
        except CalibrationError:
            return None

    unit = st.floats(-1.0, 1.0)
    return st.builds(
        build,
        st.sampled_from([0.0, 1e-4, 0.01, 0.1, 1.0, 10.0]),
        st.tuples(*[unit] * 6),
        st.tuples(*[unit] * 6),
        st.floats(200.0, 600.0),
        st.floats(200.0, 500.0),
    ).filter(lambda camera: camera is not None)


@settings(max_examples=200)
@given(cameras(), st.integers(0, 2**32 - 1))
def test_any_calibration_is_invertible_exactly_where_it_says_so(camera, seed):
    check_invertible(camera, seed)
