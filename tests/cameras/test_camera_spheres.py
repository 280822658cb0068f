"""Double sphere and EUCM: the papers' formulas, MEI and COLMAP agree; limits; random calibrations."""

from math import pi

import numpy as np
import pycolmap
import pytest
from camera_samples import INLINE, angle_rad, check_invertible, pixel_grid, random_directions
from hypothesis import given, settings
from hypothesis import strategies as st

from spherloc.cameras.calibration import camera_from_table
from spherloc.cameras.double_sphere import DoubleSphere
from spherloc.cameras.eucm import Eucm
from spherloc.cameras.mei import Mei
from spherloc.errors import CalibrationError

pytestmark = pytest.mark.filterwarnings("error")

DS = [name for name in INLINE if name.startswith("ds-")]
EUCM = [name for name in INLINE if name.startswith("eucm-")]


def usenko_double_sphere(camera: DoubleSphere, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The formulas as they are printed: pixels and the mask of valid points."""
    x, y, z = points.T
    xi, alpha = camera.xi, camera.alpha
    d1 = np.sqrt(x**2 + y**2 + z**2)
    d2 = np.sqrt(x**2 + y**2 + (xi * d1 + z) ** 2)
    depth = alpha * d2 + (1 - alpha) * (xi * d1 + z)
    w1 = alpha / (1 - alpha) if alpha <= 0.5 else (1 - alpha) / alpha
    w2 = (w1 + xi) / np.sqrt(2 * w1 * xi + xi**2 + 1)
    return np.column_stack([camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy]), z > -w2 * d1


def usenko_eucm(camera: Eucm, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The formulas as they are printed: pixels and the mask of valid points."""
    x, y, z = points.T
    alpha = camera.alpha
    d = np.sqrt(camera.beta * (x**2 + y**2) + z**2)
    depth = alpha * d + (1 - alpha) * z
    w = alpha / (1 - alpha) if alpha <= 0.5 else (1 - alpha) / alpha
    return np.column_stack([camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy]), z > -w * d


@pytest.mark.parametrize("name", [name for name in (*DS, *EUCM) if name != "ds-far-centre"])
def test_projection_and_validity_are_the_papers(name):
    camera = INLINE[name]
    points = random_directions(seed=21, count=20_000)
    assert isinstance(camera, DoubleSphere | Eucm)
    is_double_sphere = isinstance(camera, DoubleSphere)
    expected, allowed = usenko_double_sphere(camera, points) if is_double_sphere else usenko_eucm(camera, points)
    pixels, valid = camera.project(points)
    # What is left out looks past a thousand focal lengths, or is within the margin of the fold. The printed limit of
    # the double sphere is not quite at the fold (``test_the_fold_is_where_the_radius_turns_back`` has it).
    assert (allowed & ~valid).mean() < 2e-3
    assert (valid & ~allowed).mean() <= (0.02 if is_double_sphere else 0.0)
    np.testing.assert_allclose(pixels[valid], expected[valid], rtol=1e-11, atol=1e-9)


@pytest.mark.parametrize("name", [*DS, *EUCM])
def test_the_fold_is_where_the_radius_turns_back(name):
    """Along a meridian the radius grows exactly as far as directions are valid."""
    camera = INLINE[name]
    assert isinstance(camera, DoubleSphere | Eucm)
    theta = np.linspace(1e-3, pi - 1e-6, 40_001)
    points = np.column_stack([np.sin(theta), np.zeros_like(theta), np.cos(theta)])
    valid = camera.project(points)[1]
    end = int(valid.sum())
    np.testing.assert_array_equal(valid, np.arange(len(theta)) < end)
    radius = (camera.project(points[:end])[0][:, 0] - camera.cx) / camera.fx
    assert (np.diff(radius) > 0.0).all()
    if camera.max_radius < 900.0:
        assert radius[-1] == pytest.approx(camera.max_radius, rel=1e-5)
        x, _, z = points.T
        if isinstance(camera, DoubleSphere):
            z = z + camera.xi
            depth = camera.alpha * np.hypot(x, z) + (1 - camera.alpha) * z
        else:
            depth = camera.alpha * np.hypot(np.sqrt(camera.beta) * x, z) + (1 - camera.alpha) * z
        turned = np.argmax(x / depth)
        assert abs(int(turned) - end) <= 40  # the fold is flat: its margin of 1e-6 is 0.001 rad wide


@pytest.mark.parametrize("alpha", [0.3, 0.5, 0.62])
def test_both_contain_the_unified_model(alpha):
    """Double sphere with xi = 0 and EUCM with beta = 1 are MEI with xi = alpha / (1 - alpha)."""
    xi = alpha / (1 - alpha)
    mei = Mei(640, 480, 300.0 * (1 + xi), 310.0 * (1 + xi), 320.0, 240.0, xi, (0.0, 0.0, 0.0, 0.0))
    points = random_directions(seed=22, count=5000)
    points = points[points[:, 2] > -0.2 * np.linalg.norm(points, axis=1)]
    for camera in (
        DoubleSphere(640, 480, 300.0, 310.0, 320.0, 240.0, 0.0, alpha),
        Eucm(640, 480, 300.0, 310.0, 320.0, 240.0, alpha, 1.0),
        DoubleSphere(640, 480, 300.0 * (1 + xi), 310.0 * (1 + xi), 320.0, 240.0, xi, 0.0),
    ):
        both = camera.project(points)[1] & mei.project(points)[1]
        assert both.sum() > 2000
        np.testing.assert_allclose(camera.project(points)[0][both], mei.project(points)[0][both], rtol=1e-11)
        pixels = pixel_grid(camera, step=20.0)
        np.testing.assert_allclose(camera.unproject(pixels)[0], mei.unproject(pixels)[0], atol=1e-13)
        jacobians = camera.unprojection_jacobian(pixels), mei.unprojection_jacobian(pixels)
        np.testing.assert_allclose(*jacobians, atol=1e-13)


@pytest.mark.parametrize("name", EUCM)
def test_eucm_agrees_with_colmap(name):
    camera = INLINE[name]
    assert isinstance(camera, Eucm)
    params = [camera.fx, camera.fy, camera.cx, camera.cy, camera.alpha, camera.beta]
    colmap = pycolmap.Camera(model="EUCM", width=camera.width, height=camera.height, params=params)
    points = random_directions(seed=23, count=5000)
    points = points[(points[:, 2] > 0.01) & camera.project(points)[1]]  # COLMAP leaves out what is behind
    pixels = camera.project(points)[0]
    np.testing.assert_allclose(pixels, colmap.img_from_cam(points), rtol=1e-12)
    plane = colmap.cam_from_img(pixels)
    assert angle_rad(camera.unproject(pixels)[0], np.column_stack([plane, np.ones(len(plane))])).max() < 1e-9


@pytest.mark.parametrize("key", ["alpha", "beta", "xi"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -1.5, "0.5", None, True, [0.5]])
def test_a_bad_shape_is_named(key, value):
    camera = INLINE["eucm-tum-vi" if key == "beta" else "ds-tum-vi"]
    with pytest.raises(CalibrationError) as caught:
        camera_from_table({**camera.to_dict(), key: value}, "scene.toml")
    assert str(caught.value).startswith(f"scene.toml: camera key '{key}' is ") and str(caught.value).endswith(".")


def test_a_lens_that_folds_at_once_is_refused():
    table = INLINE["eucm-tum-vi"].to_dict()
    with pytest.raises(
        CalibrationError, match=r"'alpha', 'beta' are 0\.62.*, 1e\+09, which cannot be inverted one pixel"
    ):
        camera_from_table({**table, "beta": 1e9}, "x")
    table = INLINE["ds-far-centre"].to_dict()
    with pytest.raises(CalibrationError, match=r"'xi', 'alpha' are 1000, 0\.55, which cannot be inverted one pixel"):
        camera_from_table({**table, "xi": 1000.0, "fx": 400.0}, "x")


def cameras() -> st.SearchStrategy[DoubleSphere | Eucm]:
    share = st.floats(0.0, 1.0) | st.sampled_from([0.0, 0.5, np.nextafter(0.5, 1), 1.0])
    offset = st.floats(-0.999, 3.0) | st.sampled_from([-0.999, 0.0, 1.0, np.nextafter(1.0, 0), np.nextafter(1.0, 2)])

    def build(kind, fx, ratio, cx, cy, first, second):
        try:
            return kind(800, 700, fx, fx * ratio, cx, cy, first, second)
        except CalibrationError:
            return None

    focal = (st.floats(50.0, 1500.0), st.floats(0.8, 1.25), st.floats(200.0, 600.0), st.floats(200.0, 500.0))
    double_spheres = st.builds(build, st.just(DoubleSphere), *focal, offset, share)
    eucms = st.builds(build, st.just(Eucm), *focal, share, st.floats(1e-3, 20.0))
    return (double_spheres | eucms).filter(lambda camera: camera is not None)


@settings(max_examples=250)
@given(cameras(), st.integers(0, 2**32 - 1))
def test_any_calibration_is_invertible_exactly_where_it_says_so(camera, seed):
    check_invertible(camera, seed, bound_px=1e-5)
