"""The way in for programs: from arrays to a pose, whatever describes the camera, and one sentence for what is wrong."""

import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

import spherloc
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.errors import InputError
from spherloc.geometry import camera_centre
from spherloc.localization import Localization, as_camera
from spherloc.outcome import Outcome
from spherloc.trace import RefinementStage
from spherloc_viz.recording.content.data import read_recording
from spherloc_viz.recording.content.writer import write_recording

README = Path(__file__).resolve().parents[1] / "README.md"
FISHEYE = KannalaBrandt(640, 480, 300.0, 310.0, 320.0, 240.0, (0.01, -0.02, 0.003, 0.0))
COLMAP = {"model": "OPENCV_FISHEYE", "width": 640, "height": 480, "params": [300, 310, 320, 240, 0.01, -0.02, 0.003, 0]}


@pytest.fixture(scope="module")
def problem():
    return spherloc.load_scene(spherloc.bundled_scenes()["mei_outliers_80"]).problem(3)


def arguments(problem):
    return problem.pixels, problem.points, problem.camera, problem.gravity_camera


def test_it_is_estimate_with_a_judgement(problem):
    found = spherloc.localize(
        *map(np.ndarray.tolist, (problem.pixels, problem.points)),
        problem.camera,
        5.0 * problem.gravity_camera,
        gravity_map=problem.gravity_map,
        gravity_bound_deg=np.degrees(problem.gravity_bound_rad),
        estimator="mc-exact",
        seed=4,
    )
    trace = spherloc.estimate(problem, "mc-exact", seed=4)
    np.testing.assert_allclose(found.cam_from_map, trace.cam_from_map, atol=1e-9)
    np.testing.assert_array_equal(found.inliers, trace.inlier_mask)
    assert found.outcome is Outcome.LOCALIZED and found.certificate == trace.certificate
    assert found.covariance is found.trace.stage(RefinementStage).covariance and found.covariance.shape == (6, 6)
    np.testing.assert_allclose(found.cam_from_map[:, :3] @ found.position, -found.cam_from_map[:, 3], atol=1e-9)
    assert not found.diagnosis.doubtful
    for text in (repr(problem), repr(trace), trace._repr_html_()):
        assert problem.name in text and len(text) < 1000
    for text in (repr(found), found._repr_html_()):
        assert f"{np.count_nonzero(found.inliers)} of {len(problem)}" in text and len(text.splitlines()) < 10
    assert len(repr(trace).splitlines()) == 1 and "mc-exact" in repr(trace)


def test_options_and_bounds_reach_the_estimator(problem):
    given = {"iterations": 33, "confidence": 0.9}
    found = spherloc.localize(*arguments(problem), estimator="ransac-2p", options=given, bound_px=5.0)
    assert given.items() <= asdict(found.trace.options).items() and found.trace.options.bound_px == 5.0
    again = spherloc.localize(*arguments(problem), estimator="ransac-2p", options=found.trace.options)
    assert again.trace.options == found.trace.options
    uncertain = spherloc.localize(*arguments(problem), gravity_bound_deg=3.0, gravity_sd_deg=0.5)
    assert uncertain.trace.problem.gravity_sd_rad == np.radians(0.5)


def test_a_pose_that_chance_gives_is_doubtful(rng):
    pixels, points = rng.uniform([0, 0], [640, 480], (30, 2)), rng.uniform(-5, 5, (30, 3))
    found = spherloc.localize(pixels, points, FISHEYE, (0, 1, 0))
    assert found.outcome is Outcome.DOUBTFUL and "but" in repr(found)
    behind = spherloc.localize(pixels[:2], np.zeros((2, 3)), FISHEYE, (0, 1, 0))
    assert behind.outcome is not Outcome.LOCALIZED and isinstance(behind, Localization)


@pytest.mark.parametrize(
    "described",
    [
        FISHEYE,
        COLMAP,
        pycolmap.Camera(**COLMAP),
        pycolmap.Camera(**COLMAP).todict(),
        FISHEYE.to_dict(),
    ],
)
def test_cameras_are_described_in_many_ways(described):
    assert as_camera(described) == FISHEYE


def test_a_calibration_file_is_read(problem):
    path = spherloc.bundled_scenes()["mei_outliers_80"]
    assert as_camera(path) == as_camera(str(path)) == problem.camera


def test_in_the_place_of_pycolmap(problem, rng):
    points = rng.uniform((-5, -5, 5), (5, 5, 15), (40, 3))
    pixels = FISHEYE.project(points)[0]
    pixels[:10] = rng.uniform([0, 0], [640, 480], (10, 2))
    camera = pycolmap.Camera(**COLMAP)
    theirs = pycolmap.estimate_absolute_pose(pixels, points, camera)
    ours = spherloc.estimate_absolute_pose(pixels, points, camera, (0, 1, 0), gravity_map=(0, 1, 0))
    assert ours is not None and set(theirs) <= set(ours)
    assert type(ours["cam_from_world"]) is type(theirs["cam_from_world"])
    np.testing.assert_allclose(ours["cam_from_world"].matrix(), np.eye(3, 4), atol=1e-6)
    np.testing.assert_array_equal(ours["inlier_mask"], theirs["inlier_mask"])
    assert ours["num_inliers"] == theirs["num_inliers"] == 30


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"camera": 3}, "the camera is 'int'; give a camera,"),
        ({"camera": {"model": "OPENCV", "params": [1.0]}}, "the camera: width is missing"),
        ({"camera": COLMAP | {"params": [1.0]}}, "the camera: camera key 'params' is [1.0]: give a list of 8"),
        ({"camera": COLMAP | {"model": "MAGIC"}}, "the COLMAP model 'MAGIC' is not supported"),
        ({"camera": {"model": "magic"}}, "magic"),
        ({"camera": "nowhere.yaml"}, "nowhere.yaml"),
        ({"gravity": (0, 1)}, "gravity is [0, 1]; give three numbers"),
        ({"gravity": (0, 0, 0)}, "give three numbers"),
        ({"gravity": ("a", "b", "c")}, "give three numbers"),
        ({"gravity_map": [0, np.nan, 0]}, "gravity_map is"),
        ({"gravity_bound_deg": "3"}, "gravity_bound_deg is '3'; give a number of degrees."),
        ({"gravity_bound_deg": 90.0}, "an angle from 0 to below pi / 2"),
        ({"points": [[1.0, 2.0, 3.0]]}, "pixels but 1 points"),
        ({"points": [[1.0, 2.0], [1.0]]}, "points has rows of different lengths"),
        ({"pixels": [["a", "b"]]}, "pixels"),
        ({"options": {"speed": 1}}, "estimator auto has no option 'speed'; it has"),
        ({"estimator": "magic"}, "magic"),
        ({"bound_px": -1.0}, "bound_px"),
    ],
)
def test_what_is_wrong_is_one_sentence(problem, changes, sentence):
    given = dict(zip(("pixels", "points", "camera", "gravity"), arguments(problem), strict=True)) | changes
    with pytest.raises(InputError) as caught:
        spherloc.localize(**given)
    assert sentence in str(caught.value) and "\n" not in str(caught.value)


def test_the_package_is_light_until_it_is_used():
    """Whatever it offers is there, and asking for its version imports no solver."""
    script = "import sys, spherloc; spherloc.__version__; print('numba' in sys.modules, 'scipy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "False"]
    assert set(spherloc.EXPORTS) <= set(dir(spherloc))
    assert all(getattr(spherloc, name) is not None for name in spherloc.EXPORTS)
    with pytest.raises(AttributeError, match="no attribute 'magic'"):
        _ = spherloc.magic


def test_the_readme_runs(capsys):
    (code,) = (part.split("```")[0] for part in README.read_text().split("```python\n")[1:])
    exec(compile(code, str(README), "exec"), {})
    assert "localized by mc-exact" in capsys.readouterr().out


def turned_by(turn, problem):
    """Bearings, points and gravity of a problem whose camera frame is turned by ``turn`` (3, 3)."""
    return problem.bearings @ turn.T, problem.points, turn @ problem.gravity_camera


@pytest.mark.parametrize("estimator", ["ransac-2p", "mc-exact"])
def test_bearings_are_as_good_as_pixels(problem, estimator, rng):
    """The same matches as pixels and as bearings, however the camera frame is turned: an angle is the same at the
    poles of the panorama in which the bearings are kept."""
    bound_deg = np.degrees(3.0 * np.median(problem.radians_per_pixel))
    settings = {"gravity_map": problem.gravity_map, "estimator": estimator}
    by_pixels = spherloc.localize(*arguments(problem), bound_px=3.0, **settings)
    truth = problem.truth_cam_from_map
    assert by_pixels.outcome is Outcome.LOCALIZED
    for turn in (np.eye(3), Rotation.random(random_state=rng).as_matrix()):
        found = spherloc.localize_bearings(*turned_by(turn, problem), bound_deg=bound_deg, **settings)
        np.testing.assert_allclose(found.position, by_pixels.position, atol=0.05)
        np.testing.assert_allclose(found.position, camera_centre(truth), atol=0.1)
        np.testing.assert_allclose(turn.T @ found.cam_from_map[:, :3], truth[:, :3], atol=np.radians(1.0))
        ray = problem.points @ found.cam_from_map[:, :3].T + found.cam_from_map[:, 3]
        sine = np.linalg.norm(np.cross(ray, problem.bearings @ turn.T), axis=1) / np.linalg.norm(ray, axis=1)
        ahead = np.einsum("ni,ni->n", ray, problem.bearings @ turn.T) > 0.0
        np.testing.assert_array_equal(found.inliers, ahead & (sine <= np.sin(np.radians(bound_deg))))


def test_a_panorama_with_angular_errors_is_kept_in_recordings(problem, tmp_path):
    found = spherloc.localize_bearings(*turned_by(np.eye(3), problem), bound_deg=0.5, estimator="ransac-2p")
    camera = found.trace.problem.camera
    assert camera.angular and as_camera(camera.to_dict()) == camera
    write_recording(found.trace, tmp_path / "run.rrd")
    assert read_recording(tmp_path / "run.rrd").problem.camera == camera


def test_bearings_in_the_place_of_pycolmap(problem):
    bearings, points, gravity = turned_by(np.eye(3), problem)
    settings = {"gravity_map": problem.gravity_map, "bound_deg": 0.5}
    found = spherloc.estimate_absolute_pose(bearings, points, None, gravity, **settings)
    again = spherloc.localize_bearings(bearings, points, gravity, **settings)
    np.testing.assert_allclose(found["cam_from_world"].matrix(), again.cam_from_map, atol=1e-12)
    with pytest.raises(InputError, match="bound_deg is missing"):
        spherloc.estimate_absolute_pose(bearings, points, None, gravity)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"bearings": [[0.0, 0.0, 2.0]]}, "bearings row 0 is [0.0, 0.0, 2.0]; give a unit vector."),
        ({"bearings": [[0.0, 0.0, np.nan]]}, "bearings row 0 is"),
        ({"bearings": [[0.0, 1.0]]}, "bearings have the shape (1, 2)"),
        ({"bearings": [["a", "b", "c"]]}, "bearings hold"),
        ({"bound_deg": 0.0}, "bound_deg is 0.0; give an angle above 0"),
        ({"bound_deg": np.nan}, "bound_deg is"),
        ({"bound_deg": "1"}, "bound_deg is '1'; give a number of degrees."),
        ({"bound_px": 3.0}, "give bound_deg alone"),
    ],
)
def test_what_is_wrong_with_bearings_is_one_sentence(problem, changes, sentence):
    bearings, points, gravity = turned_by(np.eye(3), problem)
    given = {"bearings": bearings, "points": points, "gravity": gravity, "bound_deg": 0.5} | changes
    with pytest.raises(InputError) as caught:
        spherloc.localize_bearings(**given)
    assert sentence in str(caught.value) and "\n" not in str(caught.value)


def test_gravity_from_an_image_refuses_what_is_no_image_of_the_camera(tmp_path):
    camera = {"model": "equirectangular", "width": 64, "height": 32}
    for image, said in (
        (np.zeros((32, 64), np.uint8), "the image: gravity cannot be found from its lines"),
        (np.zeros((32, 60), np.uint8), "60 x 32 pixels, its camera 64 x 32"),
        (np.zeros((32, 64)), "float64 of shape"),
        (tmp_path / "none.png", "none.png"),
    ):
        with pytest.raises(spherloc.InputError, match=said):
            spherloc.gravity_from_image(image, camera)
