"""What holds for every camera model: inverses, unit bearings, Jacobians, odd input."""

import dataclasses

import numpy as np
import pytest
from camera_samples import EVERY, INLINE, angle_rad, pixel_grid, random_directions, sample

from spherloc import registry
from spherloc.cameras.base import Camera, in_image
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.errors import ProblemError

pytestmark = pytest.mark.filterwarnings("error")


def pixel_error(camera: Camera, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Largest coordinate difference (N,); on a panorama the columns 0 and width are one, and its poles are rows."""
    error = np.abs(a - b)
    if isinstance(camera, Equirectangular):
        error[:, 0] = np.minimum(error[:, 0], camera.width - error[:, 0])
        error[(b[:, 1] == 0) | (b[:, 1] == camera.height), 0] = 0.0
    return error.max(axis=1)


@pytest.mark.parametrize("name", EVERY)
def test_project_inverts_unproject_over_the_whole_image(name):
    camera = sample(name)
    pixels = pixel_grid(camera)
    bearings, valid = camera.unproject(pixels)
    assert valid.mean() > 0.5
    assert np.isnan(bearings[~valid]).all()
    np.testing.assert_allclose(np.linalg.norm(bearings[valid], axis=1), 1.0, atol=1e-14)
    again, seen = camera.project(bearings)
    np.testing.assert_array_equal(seen, valid)
    assert pixel_error(camera, again[valid], pixels[valid]).max() < 1e-6


@pytest.mark.parametrize("name", EVERY)
def test_unproject_inverts_project_for_directions_all_around(name):
    camera = sample(name)
    points = random_directions(seed=7, count=20_000)
    pixels, valid = camera.project(points)
    assert valid.sum() > 1000
    assert np.isnan(pixels[~valid]).all()
    bearings, seen = camera.unproject(pixels)
    np.testing.assert_array_equal(seen, valid)
    # Close to a fold the angle has half the digits of the pixel, since the pixel hardly moves there.
    error = angle_rad(bearings[valid], points[valid])
    assert error.max() < 1e-6
    assert np.median(error) < 1e-13


@pytest.mark.parametrize("name", EVERY)
def test_jacobian_agrees_with_central_differences(name):
    camera = sample(name)
    pixels = pixel_grid(camera, step=17.3)
    step = 1e-2
    ahead, behind = [], []
    for axis in np.eye(2) * step:
        ahead.append(camera.unproject(pixels + axis))
        behind.append(camera.unproject(pixels - axis))
    numeric = np.stack([(a - b) / (2 * step) for (a, _), (b, _) in zip(ahead, behind, strict=True)], axis=-1)
    # The differences themselves fail where the rim is near, and the model bends without bound there.
    outward = pixels + 0.02 * (pixels - [camera.width / 2, camera.height / 2])
    inside = camera.unproject(outward)[1] & np.isfinite(numeric).all(axis=(1, 2))
    assert inside.sum() > 300
    analytic = camera.unprojection_jacobian(pixels)
    assert analytic.shape == (len(pixels), 3, 2)
    error = np.linalg.norm(analytic - numeric, axis=(1, 2)) / np.linalg.norm(analytic, axis=(1, 2))
    assert error[inside].max() < 1e-6


@pytest.mark.parametrize("name", INLINE)
def test_jacobian_is_finite_where_the_pixel_is_valid_and_nan_elsewhere(name):
    camera = INLINE[name]
    pixels = np.vstack([pixel_grid(camera, step=10.0), [[np.nan, 1.0], [-1e7, 3.0]]])
    valid = camera.unproject(pixels)[1]
    jacobian = camera.unprojection_jacobian(pixels)
    assert np.isfinite(jacobian[valid]).all()
    assert np.isnan(jacobian[~valid]).all()


@pytest.mark.parametrize("name", INLINE)
def test_the_optical_axis_is_exact(name):
    camera = INLINE[name]
    centre = np.array([[getattr(camera, "cx", camera.width / 2), getattr(camera, "cy", camera.height / 2)]])
    bearing, valid = camera.unproject(centre)
    assert valid.all()
    np.testing.assert_array_equal(bearing, [[0.0, 0.0, 1.0]])
    np.testing.assert_array_equal(camera.project(np.array([[0.0, 0.0, 5.0]]))[0], centre)
    below_right, _ = camera.unproject(centre + np.array([1e-3, 2e-3]))
    np.testing.assert_allclose(
        (below_right - bearing)[0], camera.unprojection_jacobian(centre)[0] @ [1e-3, 2e-3], atol=1e-9
    )
    assert below_right[0, 0] > 0 and below_right[0, 1] > 0


@pytest.mark.parametrize("name", INLINE)
def test_nan_infinity_and_the_origin_are_invalid_without_a_warning(name):
    camera = INLINE[name]
    nan, inf = np.nan, np.inf
    points = np.array(
        [[0, 0, 0], [nan, 0, 1], [0, nan, 1], [0, 0, nan], [inf, 0, 1], [0, -inf, 1], [0, 0, inf], [inf, inf, -inf]]
    )
    pixels, valid = camera.project(points)
    assert not valid.any() and np.isnan(pixels).all()
    bearings, valid = camera.unproject(np.array([[nan, 1.0], [1.0, nan], [inf, 1.0], [1.0, -inf], [1e300, 1e300]]))
    assert not valid.any() and np.isnan(bearings).all()


@pytest.mark.parametrize("name", INLINE)
def test_scale_does_not_matter_from_the_tiniest_to_the_largest_points(name):
    camera = INLINE[name]
    points = np.array([[0.1, 0.2, 1.0], [-0.3, 0.1, 0.9]])
    expected = camera.project(points)[0]
    for scale in (1e-290, 1e290):
        pixels, valid = camera.project(points * scale)
        assert valid.all()
        np.testing.assert_allclose(pixels, expected, rtol=1e-12)


@pytest.mark.parametrize("name", INLINE)
def test_empty_arrays_and_other_number_types_work(name):
    camera = INLINE[name]
    assert [part.shape for part in camera.project(np.empty((0, 3)))] == [(0, 2), (0,)]
    assert [part.shape for part in camera.unproject(np.empty((0, 2)))] == [(0, 3), (0,)]
    assert camera.unprojection_jacobian(np.empty((0, 2))).shape == (0, 3, 2)
    whole = np.array([[0, 0, 3], [1, 1, 9]])
    single = np.asfortranarray(whole, dtype=np.float32)
    expected = camera.project(whole.astype(float))[0]
    for points in (whole, single, whole.tolist()):
        np.testing.assert_array_equal(camera.project(points)[0], expected)
    np.testing.assert_array_equal(whole, [[0, 0, 3], [1, 1, 9]])


@pytest.mark.parametrize("name", INLINE)
@pytest.mark.parametrize("bad", [np.zeros(3), np.zeros((2, 4)), [["a", "b", "c"]], [[1, 2], [3]], [[1j, 0, 0]], None])
def test_wrong_shapes_are_one_sentence(name, bad):
    camera = INLINE[name]
    for call in (camera.project, camera.unproject, camera.unprojection_jacobian):
        with pytest.raises(ProblemError) as caught:
            call(bad)
        message = str(caught.value)
        assert message.startswith(("points ", "pixels ")) and message.endswith(".") and "give an array" in message
        assert "\n" not in message


@pytest.mark.parametrize("name", INLINE)
def test_cameras_are_registered_frozen_hashable_and_rebuilt_from_their_table(name):
    camera = INLINE[name]
    assert isinstance(camera, Camera)
    assert registry.lookup("cameras", camera.model) is type(camera)
    table = camera.to_dict()
    assert list(table)[:3] == ["model", "width", "height"] and table["model"] == camera.model
    again = type(camera).from_dict(table, "scene.toml")
    assert again == camera and hash(again) == hash(camera)
    with pytest.raises(dataclasses.FrozenInstanceError):
        camera.width = 3  # pyright: ignore[reportAttributeAccessIssue]


def test_in_image_is_separate_from_validity():
    camera = INLINE["mei-pinhole"]
    pixels, valid = camera.project(np.array([[0.0, 0.0, 1.0], [5.0, 0.0, 1.0], [0.0, 0.0, -1.0]]))
    np.testing.assert_array_equal(valid, [True, True, False])
    np.testing.assert_array_equal(in_image(camera, pixels), [True, False, False])
