"""What the refinement claims about its error: checked by Monte Carlo, and what weights and gravity are worth."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from spherloc.bounds import bounds_of
from spherloc.geometry import camera_centre, rotation_angle, so3_exp, tangent_basis
from spherloc.refine import RefinementOptions, refine

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

CAMERAS = ("mei", "fisheye", "panorama")
GRAVITY_SD_RAD = np.radians(0.5)
RUNS = 120


def with_gravity_error(problem, rng, sd_rad):
    """The problem with each of gravity's two tilts drawn with ``sd_rad``; its truth stays."""
    tilt = so3_exp(np.array([rng.normal(0, sd_rad), 0.0, rng.normal(0, sd_rad)]))
    gravity = tilt @ problem.gravity_camera
    return replace(problem, gravity_camera=gravity, gravity_bound_rad=4 * sd_rad, gravity_sd_rad=sd_rad)


def turned_map(problem, rng):
    """The same problem in a map of another orientation, so that no frame is the aligned one."""
    turn, truth = so3_exp(rng.normal(size=3)), problem.truth_cam_from_map
    return replace(
        problem,
        points=problem.points @ turn.T,
        gravity_map=turn @ problem.gravity_map,
        truth_cam_from_map=np.column_stack([truth[:, :3] @ turn.T, truth[:, 3]]),
    )


def pose_error(problem, found):
    """(6,) as the covariance has it: Exp(w) R is true in the camera frame, and what is missing to the true position."""
    truth = problem.truth_cam_from_map
    turn = Rotation.from_matrix(truth[:, :3] @ found[:, :3].T).as_rotvec()
    return np.concatenate([turn, camera_centre(truth) - camera_centre(found)])


def refined(problem, bound_px, **options):
    """Stage of a refinement from the true pose, as the given gravity levels it where that is exact."""
    aligned = problem.aligned
    start = aligned.align_pose(problem.truth_cam_from_map)
    return refine(aligned, start, bounds_of(aligned, bound_px), RefinementOptions(**options))[2]


def rotation_rms(errors):
    return np.sqrt(np.mean(np.sum(np.square(errors)[:, :3], axis=1)))


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("gravity_sd_rad", [0.0, GRAVITY_SD_RAD, np.inf])
def test_normalised_error_squared(rng, scene_of, camera, gravity_sd_rad):
    """The mean of e' C^-1 e over many runs lies in its 95 % band: the covariance is neither proud nor shy."""
    scene = scene_of(camera, outlier_rate=0.0, noise_px=1.5, correspondences=40)
    dof, total = 4 if gravity_sd_rad == 0.0 else 6, 0.0
    for seed in range(RUNS):
        problem = turned_map(scene.problem(seed), rng)
        if gravity_sd_rad == GRAVITY_SD_RAD:
            problem = with_gravity_error(problem, rng, gravity_sd_rad)
        stage = refined(problem, 50.0, noise_px=1.5, gravity_sd_deg=np.degrees(gravity_sd_rad))
        error, covariance = pose_error(problem, stage.cam_from_map[-1]), stage.covariance
        assert stage.dof == dof and stage.inlier_counts[-1] == 40
        np.testing.assert_allclose(covariance, covariance.T, atol=0)
        rotation_rad, position_m = np.sqrt(np.trace(covariance[:3, :3])), np.sqrt(np.trace(covariance[3:, 3:]))
        scale = np.repeat([rotation_rad, position_m], 3)
        inverse = np.linalg.pinv(covariance / np.outer(scale, scale), rcond=1e-9, hermitian=True)
        assert np.linalg.matrix_rank(inverse) == dof
        total += (error / scale) @ inverse @ (error / scale)
    low, high = chi2.ppf([0.025, 0.975], RUNS * dof) / RUNS
    assert low < total / RUNS < high, f"{total / RUNS:.2f} is outside {low:.2f} to {high:.2f}"


@pytest.mark.parametrize("camera", CAMERAS)
def test_exact_gravity_has_no_variance(rng, scene_of, camera):
    """Turns about the two horizontal axes have none; the turn about gravity has some, in the camera's own frame."""
    problem = scene_of(camera, outlier_rate=0.0).problem(1)
    turn, truth = so3_exp(np.array([0.3, 0.0, -0.2])), problem.truth_cam_from_map
    down = turn @ problem.gravity_camera
    level = problem.aligned
    aligned = replace(level, camera_turn=level.camera_turn @ turn.T)  # as if the camera's frame were another one
    covariance = refine(aligned, truth, bounds_of(aligned, 8.0), RefinementOptions())[2].covariance
    across = tangent_basis(down[None])[0]
    assert down @ covariance[:3, :3] @ down > 1e-9
    assert np.abs(across @ covariance[:3, :]).max() < 1e-12
    assert np.linalg.matrix_rank(covariance[3:, 3:]) == 3


@pytest.mark.parametrize("camera", CAMERAS)
def test_noise_scales_the_covariance(scene_of, camera):
    problem = scene_of(camera, outlier_rate=0.0).problem(1)
    one, two = (refined(problem, 50.0, noise_px=noise, gravity_sd_deg=np.inf) for noise in (1.0, 2.0))
    np.testing.assert_allclose(two.covariance, 4.0 * one.covariance, rtol=1e-3)
    weighed = refined(problem, 50.0, gravity_sd_deg=0.5).covariance
    assert np.trace(weighed[:3, :3]) < np.trace(one.covariance[:3, :3])


@pytest.mark.parametrize("camera", CAMERAS)
def test_perfect_gravity_halves_the_error(scene_of, camera):
    """With few matches, roll and pitch are what the pixels fix worst."""
    scene = scene_of(camera, outlier_rate=0.0, correspondences=10)
    four, six = [], []
    for seed in range(80):
        problem = scene.problem(seed)
        for errors, sd in ((four, 0.0), (six, np.inf)):
            errors.append(pose_error(problem, refined(problem, 50.0, gravity_sd_deg=sd).cam_from_map[-1]))
    ratio = rotation_rms(four) / rotation_rms(six)
    assert 0.3 < ratio < 0.7, f"{ratio:.2f}"


@pytest.mark.parametrize("camera", CAMERAS)
def test_weighted_gravity_beats_both_of_its_limits(rng, scene_of, camera):
    """Gravity off by 0.5 degrees (1 sigma) and pixels that know as little: to weigh them beats to choose."""
    scene = scene_of(camera, outlier_rate=0.0, correspondences=10, noise_px=4.0)
    errors = {None: [], 0.0: [], np.inf: []}
    for seed in range(80):
        problem = with_gravity_error(scene.problem(seed), rng, GRAVITY_SD_RAD)
        for sd, found in errors.items():
            stage = refined(problem, 80.0, noise_px=4.0, gravity_sd_deg=sd)
            found.append(pose_error(problem, stage.cam_from_map[-1]))
    rms = {sd: np.degrees(rotation_rms(found)) for sd, found in errors.items()}
    assert rms[None] < 0.95 * min(rms[0.0], rms[np.inf]), rms


def test_each_bearing_counts_by_its_own_noise(scene_of):
    """Towards a panorama's poles a column is a small angle: one weight for the whole image would waste that."""
    scene = scene_of("panorama", outlier_rate=0.0, correspondences=30, noise_px=3.0)
    weighed, alike = [], []
    for seed in range(80):
        problem = scene.problem(seed)
        weighed.append(pose_error(problem, refined(problem, 200.0, gravity_sd_deg=np.inf).cam_from_map[-1]))
        aligned = problem.aligned
        isotropic = tangent_basis(aligned.bearings) * np.median(aligned.pixels_per_radian)
        same = replace(aligned, pixel_from_bearing=isotropic)
        options = RefinementOptions(gravity_sd_deg=np.inf)
        found, _, _ = refine(same, problem.truth_cam_from_map, bounds_of(same, 200.0), options)
        alike.append(pose_error(problem, found))
    assert rotation_rms(weighed) < 0.95 * rotation_rms(alike)


def test_error_is_what_an_angle_says(rng, scene_of):
    """The error vector that these tests judge by is as long as the rotation error that users see."""
    problem = scene_of("mei").problem()
    found = problem.truth_cam_from_map.copy()
    found[:, :3] = so3_exp(rng.normal(0, 0.01, 3)) @ found[:, :3]
    angle = rotation_angle(found[:, :3].T @ problem.truth_cam_from_map[:, :3])
    assert np.linalg.norm(pose_error(problem, found)[:3]) == pytest.approx(angle)
