"""What a ``Problem`` accepts, what it refuses in one sentence, and what it derives."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.errors import ProblemError
from spherloc.geometry import DOWN, pose
from spherloc.problem import Problem

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

CAMERA = Equirectangular(200, 100)
PIXELS = np.array([[20.0, 30.0], [120.0, 60.0], [150.0, 20.0], [199.5, 99.5]])
POINTS = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [-1.0, 2.0, 0.0], [3.0, 3.0, 3.0]])


def make(**changes):
    arguments = {"name": "p", "camera": CAMERA, "pixels": PIXELS, "points": POINTS}
    return Problem(**(arguments | {"gravity_camera": DOWN, "gravity_map": DOWN} | changes))


def with_nan(array):
    array = array.copy()
    array[2, 1] = np.nan
    return array


BAD = {
    "one correspondence": ({"pixels": PIXELS[:1], "points": POINTS[:1]}, "1 usable of 1"),
    "none": ({"pixels": np.empty((0, 2)), "points": np.empty((0, 3))}, "0 usable of 0"),
    "fewer points": ({"points": POINTS[:3]}, "4 pixels but 3 points"),
    "flat pixels": ({"pixels": PIXELS.ravel()}, r"pixels has shape \(8,\)"),
    "3-D pixels": ({"pixels": POINTS}, r"pixels has shape \(4, 3\)"),
    "2-D points": ({"points": PIXELS}, r"points has shape \(4, 2\)"),
    "NaN pixel": ({"pixels": with_nan(PIXELS)}, "pixels row 2"),
    "NaN point": ({"points": with_nan(POINTS)}, "points row 2"),
    "infinite point": ({"points": POINTS * [1.0, np.inf, 1.0]}, "points row 0"),
    "2-D gravity": ({"gravity_camera": DOWN[:2]}, "gravity_camera"),
    "NaN gravity": ({"gravity_map": [0.0, np.nan, 0.0]}, "gravity_map"),
    "zero gravity": ({"gravity_map": np.zeros(3)}, "length 0"),
    "long gravity": ({"gravity_camera": 9.81 * DOWN}, "length 9.81"),
    "negative gravity bound": ({"gravity_bound_rad": -0.1}, "gravity_bound_rad"),
    "NaN gravity bound": ({"gravity_bound_rad": np.nan}, "gravity_bound_rad"),
    "right-angle gravity bound": ({"gravity_bound_rad": np.pi / 2}, "gravity_bound_rad"),
    "zero bound": ({"bound_px": 0.0}, "bound_px"),
    "NaN bound": ({"bound_px": np.nan}, "bound_px"),
    "tiny bound": ({"bound_px": 1e-300}, "bound_px is 1e-300; give 1e-06 to 1,000,000 pixels"),
    "huge bound": ({"bound_px": 1e300}, "bound_px is 1e.300; give"),
    "infinite bound": ({"bound_px": np.inf}, "bound_px is inf; give"),
    "tiny map": ({"points": 1e-300 * POINTS}, r"points reach \S+e-300 m from the origin"),
    "huge map": ({"points": 1e300 * POINTS}, r"points reach \S+e.300 m from the origin; give metres, 1e-12 to 1e.12 m"),
    "truth beyond": ({"truth_cam_from_map": pose(np.eye(3), 1e300 * DOWN)}, "true position reaches 1e.300 m"),
    "3 x 3 truth": ({"truth_cam_from_map": np.eye(3)}, "truth_cam_from_map has shape"),
    "scaled truth": ({"truth_cam_from_map": pose(2 * np.eye(3), DOWN)}, "not a rotation matrix"),
    "mirrored truth": ({"truth_cam_from_map": pose(np.diag([1.0, 1.0, -1.0]), DOWN)}, "not a rotation matrix"),
    "NaN truth": ({"truth_cam_from_map": pose(np.eye(3), [0.0, np.nan, 0.0])}, "truth_cam_from_map row 1"),
    "too few labels": ({"truth_inliers": np.ones(3, bool)}, "3 inlier labels for 4"),
    "reference of nobody": ({"reference_index": [0, 0, 0, 1], "reference_images": (Path("a.png"),)}, "one of 1 ref"),
    "too few references": ({"reference_index": [0], "reference_images": (Path("a.png"),)}, "each of 4"),
    "too few reference pixels": ({"reference_pixels": PIXELS[:3]}, r"reference_pixels has shape \(3, 2\)"),
    "outlier rate": ({"estimated_outlier_rate": 1.5}, "estimated_outlier_rate is 1.5"),
    "pixels outside the image": ({"pixels": PIXELS + 1000.0}, "0 usable of 4"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_refused_in_one_sentence(case):
    changes, message = BAD[case]
    with pytest.raises(ProblemError, match=message) as caught:
        make(**changes)
    assert str(caught.value).startswith("p: ") and "\n" not in str(caught.value)


@pytest.mark.parametrize("pixels", [[[1.0, 2.0], [3.0]], [["a", "b"], ["c", "d"]], None])
def test_what_is_no_array_of_numbers_is_a_problem_error(pixels):
    with pytest.raises(ProblemError):
        make(pixels=pixels)


def test_arrays_are_copies():
    """Changing the caller's arrays afterwards must not change a problem that was already solved."""
    given = {"pixels": PIXELS.copy(), "points": POINTS.copy()}
    given |= {"gravity_camera": DOWN.copy(), "gravity_map": DOWN.copy()}
    given |= {"truth_cam_from_map": pose(np.eye(3), np.zeros(3)), "truth_inliers": np.ones(4, bool)}
    problem = make(**given)
    for name, array in given.items():
        before = getattr(problem, name).copy()
        assert array.flags.writeable
        array[...] = 0
        np.testing.assert_array_equal(getattr(problem, name), before)


def test_every_array_is_read_only():
    """One writable array is enough to let a drawing or a test change a run's record."""
    matched = {"reference_images": (Path("a.png"),), "reference_index": np.zeros(4), "reference_pixels": PIXELS}
    problem = make(truth_cam_from_map=pose(np.eye(3), np.zeros(3)), truth_inliers=np.ones(4, bool), **matched)
    names = ("reference_index", "reference_pixels")
    names += ("pixels", "points", "gravity_camera", "gravity_map", "truth_cam_from_map", "truth_inliers")
    names += ("bearings", "usable", "pixel_from_bearing", "radians_per_pixel")
    arrays = {name: getattr(problem, name) for name in names}
    aligned = vars(problem.aligned).items()
    arrays |= {f"aligned.{name}": value for name, value in aligned if isinstance(value, np.ndarray)}
    assert len(arrays) >= 16
    assert [name for name, array in arrays.items() if array.flags.writeable] == []
    with pytest.raises(AttributeError):
        problem.name = "other"


def test_gravity_is_normalised():
    np.testing.assert_allclose(np.linalg.norm(make(gravity_camera=1.0005 * DOWN).gravity_camera), 1.0, atol=1e-15)


def test_pixels_without_a_bearing_are_kept_and_unusable():
    """Beyond the rim of a fisheye: not an error, and always an outlier."""
    camera = KannalaBrandt(400, 400, 100.0, 100.0, 200.0, 200.0, (0.0, -0.05, 0.0, 0.0))
    pixels = np.array([[200.0, 200.0], [0.5, 0.5], [250.0, 210.0], [399.5, 399.5], [180.0, 160.0]])
    problem = make(camera=camera, pixels=pixels, points=np.vstack([POINTS, POINTS[:1]]))
    assert problem.usable.tolist() == [True, False, True, False, True]
    assert np.isnan(problem.bearings[~problem.usable]).all()
    assert np.isnan(problem.pixel_from_bearing[1]).all() and np.isnan(problem.radians_per_pixel[3])
    aligned = problem.aligned
    assert aligned.index.tolist() == [0, 2, 4] and aligned.count == 5
    np.testing.assert_array_equal(aligned.points, problem.points[[0, 2, 4]])
    assert aligned.full_mask(np.array([True, False, True])).tolist() == [True, False, False, False, True]


@pytest.mark.parametrize("camera", ["mei", "fisheye", "panorama"])
def test_pixel_weights_invert_the_unprojection(scene_of, camera):
    """One pixel aside is one pixel of residual, and no direction changes faster than ``radians_per_pixel``."""
    problem = scene_of(camera).problem()
    for k, shift in enumerate(([1e-4, 0.0], [0.0, 1e-4], [-1e-4, 1e-4])):
        beside, valid = problem.camera.unproject(problem.pixels + shift)
        ok = valid & problem.usable
        residual = np.einsum("nij,nj->ni", problem.pixel_from_bearing, beside)[ok]
        np.testing.assert_allclose(residual, np.tile(shift, (ok.sum(), 1)), atol=1e-7)
        angle = np.linalg.norm(beside - problem.bearings, axis=1)[ok]
        assert (angle <= problem.radians_per_pixel[ok] * np.linalg.norm(shift) * (1 + 1e-3)).all(), k


def test_alignment_turns_gravity_down_and_poses_back(rng):
    for _ in range(50):
        gravity = rng.normal(size=(2, 3))
        gravity /= np.linalg.norm(gravity, axis=1, keepdims=True)
        problem = make(gravity_camera=gravity[0], gravity_map=gravity[1])
        aligned = problem.aligned
        np.testing.assert_allclose(aligned.camera_turn @ gravity[0], DOWN, atol=1e-12)
        np.testing.assert_allclose(aligned.map_turn @ gravity[1], DOWN, atol=1e-12)
        np.testing.assert_allclose(aligned.bearings, problem.bearings @ aligned.camera_turn.T, atol=1e-15)
        cam_from_map = pose(Rotation.random(None, rng).as_matrix(), rng.normal(size=3))
        there = aligned.align_pose(cam_from_map)
        np.testing.assert_allclose(aligned.unalign_pose(there), cam_from_map, atol=1e-14)
        # The aligned pose takes aligned points to aligned camera coordinates.
        camera = problem.points @ cam_from_map[:, :3].T + cam_from_map[:, 3]
        aligned_camera = aligned.points @ there[:, :3].T + there[:, 3]
        np.testing.assert_allclose(aligned_camera, camera @ aligned.camera_turn.T, atol=1e-13)


@pytest.mark.parametrize("metres", [0.0, 1e-9, 1e9])
def test_maps_of_all_sizes_are_problems(metres):
    """Zero too: all points in the origin are told by the solvers, and single points may lie there."""
    assert len(make(points=metres * POINTS)) == 4
    assert len(make(points=np.vstack([1e-300 * POINTS[:1], POINTS[1:]]))) == 4
