"""What holds for every camera model: its contract, the optical axis, odd input."""

import numpy as np
import pytest
from camera_samples import EVERY, INLINE, pixel_grid, sample

from spherloc import registry
from spherloc.cameras.base import in_image
from spherloc.errors import ProblemError
from spherloc.testing import check_camera

pytestmark = pytest.mark.filterwarnings("error")


@pytest.mark.parametrize("name", EVERY)
def test_every_camera_keeps_the_contract(name):
    """Inverses over the whole image and all around, unit bearings, Jacobians, NaN, tables."""
    camera = sample(name)
    check_camera(camera)
    assert camera.unproject(pixel_grid(camera))[1].mean() > 0.5
    assert registry.lookup("cameras", camera.model) is type(camera)
    assert list(camera.to_dict())[:3] == ["model", "width", "height"]


def test_every_model_has_a_sample():
    assert {camera.model for camera in INLINE.values()} == set(registry.names("cameras"))


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
def test_scale_does_not_matter_from_the_tiniest_to_the_largest_points(name):
    camera = INLINE[name]
    points = np.array([[0.1, 0.2, 1.0], [-0.3, 0.1, 0.9]])
    expected = camera.project(points)[0]
    for scale in (1e-290, 1e290):
        pixels, valid = camera.project(points * scale)
        assert valid.all()
        np.testing.assert_allclose(pixels, expected, rtol=1e-12)


@pytest.mark.parametrize("name", INLINE)
def test_other_number_types_work(name):
    camera = INLINE[name]
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


def test_in_image_is_separate_from_validity():
    camera = INLINE["mei-pinhole"]
    pixels, valid = camera.project(np.array([[0.0, 0.0, 1.0], [5.0, 0.0, 1.0], [0.0, 0.0, -1.0]]))
    np.testing.assert_array_equal(valid, [True, True, False])
    np.testing.assert_array_equal(in_image(camera, pixels), [True, False, False])
