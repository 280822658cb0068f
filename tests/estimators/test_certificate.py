"""The certificate of mc-exact counts what it says: against poses that others find, and its stage against its poses."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from small_problems import explained, good_poses, level_poses

from spherloc.bounds import bounds_of
from spherloc.consensus.chance import chance_rate, nfa
from spherloc.datasets import load_scene
from spherloc.estimators import estimate, options_type
from spherloc.geometry import pose, rotation_angle, so3_exp, yaw_of, yaw_rotation
from spherloc.problem import Problem
from spherloc.refine import residuals_px
from spherloc.trace import ConsensusStage
from tests.needs import real_data

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

Options: Any = options_type("mc-exact")


def solve(problem: Problem, options: Any = None, seed: int = 0) -> Any:
    """The trace of mc-exact, which has a certificate and its stage."""
    return estimate(problem, "mc-exact", options, seed)


def tilt_of(rotation):
    return rotation_angle(rotation @ yaw_rotation(yaw_of(rotation)).T)


def check(trace, bound_px):
    """Upper bound over level and tilted poses, lower bound, stage. Returns the largest consensus of a level pose."""
    aligned, certificate = trace.problem.aligned, trace.certificate
    bounds = bounds_of(aligned, bound_px)
    stage = trace.stage(ConsensusStage)
    assert certificate.lower_bound <= certificate.upper_bound == max(stage.bound.max(), certificate.lower_bound)
    assert certificate.gap == certificate.upper_bound - certificate.lower_bound
    assert certificate.proven == (certificate.gap == 0)
    rate = chance_rate(aligned.bearings, bounds.radians)
    assert certificate.nfa == pytest.approx(nfa(len(aligned.bearings), certificate.lower_bound, rate))
    # Level poses of pairs and of fits at the widened bounds, counted at the noise's.
    yaws, centres = good_poses(aligned, bounds)
    level = level_poses(yaws, centres)
    noise = replace(bounds, pixels=np.full(len(bounds.pixels), bound_px))
    counts = explained(aligned, noise, yaws, centres).sum(axis=1)
    assert counts.max(initial=0) <= certificate.upper_bound
    # Tilted ones within the bound on gravity, at the noise's bound.
    truth = aligned.align_pose(trace.problem.truth_cam_from_map)
    found = [] if trace.cam_from_map is None else [aligned.align_pose(trace.cam_from_map)]
    tilted = [truth, *found]
    generator = np.random.default_rng(trace.seed)
    for p in [*level[np.argsort(-counts)[:20]], truth]:
        turn = so3_exp(aligned.gravity_bound_rad * generator.random() * horizontal(generator))
        tilted.append(pose(turn @ p[:, :3], turn @ p[:, 3]))
    for p in tilted:
        if tilt_of(p[:, :3]) <= aligned.gravity_bound_rad + 1e-12:
            assert np.count_nonzero(residuals_px(aligned, p) <= bound_px) <= certificate.upper_bound
    # The stage's poses: what they explain, and one of them or the result has the lower bound.
    verified = [aligned.align_pose(p) for p in stage.cam_from_map]
    assert len(verified) == len(stage.support) and (np.diff(stage.support) <= 0).all()
    for p, support in zip(verified, stage.support, strict=True):
        if aligned.gravity_bound_rad > 0.0:
            assert tilt_of(p[:, :3]) <= aligned.gravity_bound_rad + 1e-9
            continue
        assert tilt_of(p[:, :3]) < 1e-9
        mine = explained(aligned, bounds, np.array([yaw_of(p[:, :3])]), (-p[:, :3].T @ p[:, 3])[None])
        assert mine.sum() == support
    sure = [p for p in (*verified[:1], *found) if tilt_of(p[:, :3]) <= aligned.gravity_bound_rad + 1e-9]
    if sure:
        assert certificate.lower_bound == max(np.count_nonzero(residuals_px(aligned, p) <= bound_px) for p in sure)
    assert set(stage.clique) <= set(aligned.index)
    assert stage.bound.shape == (1440,)
    if verified:
        assert stage.yaw_rad == pytest.approx(yaw_of(verified[0][:, :3]), abs=1e-9)
    return int(counts.max(initial=0))


def horizontal(generator):
    """A horizontal direction."""
    angle = generator.uniform(0, 2 * np.pi)
    return np.array([np.cos(angle), 0.0, np.sin(angle)])


@pytest.mark.parametrize("gravity_error_deg", [0.0, 0.3])
@pytest.mark.parametrize("camera", ["mei", "fisheye", "panorama"])
def test_small_problems(rng, scene_of, camera, gravity_error_deg):
    """Of every kind: few inliers or none, wide bounds, points and pixels used several times."""
    plain, proven, missed = 0, 0, 0
    for seed in range(8):
        count, rate = int(rng.integers(4, 15)), rng.choice([0.0, 0.4, 0.7, 1.0])
        scene = scene_of(
            camera, correspondences=count, outlier_rate=rate, noise_px=0.5, gravity_error_deg=gravity_error_deg
        )
        problem = scene.problem(seed)
        points, pixels = problem.points.copy(), problem.pixels.copy()
        kind = seed % 4
        if kind == 1:
            points[: count // 2] = points[0]
        elif kind == 2:
            pixels[: count // 2] = pixels[0]
        elif kind == 3:
            points[:2], pixels[:2] = points[-1], pixels[-1]
        problem = replace(problem, points=points, pixels=pixels, truth_inliers=None)
        bound_px = float(rng.choice([0.5, 2.0, 8.0, 30.0]))
        # With points at one place the search ends at its limit, whatever that is.
        trace = solve(problem, Options(bound_px=bound_px, effort=0.05 if kind == 1 else 1.0), seed)
        known = check(trace, bound_px)
        # Of what lies at one point or in one pixel often nothing is proven, and nothing is said to be.
        if kind in (0, 3) and gravity_error_deg == 0.0:
            plain += 1
            proven += trace.certificate.proven
            missed += known > trace.certificate.lower_bound
    assert proven >= plain - 1 and missed == 0, f"{proven} proven and {missed} missed of {plain}"


def test_tilt_from_the_options_is_no_level_pose(scene_of):
    """A result that may tilt though gravity is exact explains more than any level pose, and must not count."""
    beyond = 0
    for seed in range(5):
        problem = scene_of("mei", correspondences=20, outlier_rate=0.5).problem(seed)
        turn = so3_exp(np.array([0.03, 0.0, 0.02]))
        tilted = replace(problem, gravity_camera=turn @ problem.gravity_camera)
        trace = solve(tilted, Options(bound_px=3.0, gravity_sd_deg=5.0), seed)
        beyond += np.count_nonzero(trace.inlier_mask) > trace.certificate.upper_bound
        check(trace, 3.0)
    assert beyond >= 2


def test_simulation_is_proven(scene_of):
    """The paper's problems are closed: nothing explains more than what was found, and chance explains none of it."""
    for camera in ("mei", "fisheye", "panorama"):
        for seed in range(4):
            problem = scene_of(camera, outlier_rate=0.8).problem(seed)
            certificate = solve(problem, Options(bound_px=4.0), seed).certificate
            assert certificate.proven and certificate.lower_bound >= 18
            assert certificate.nfa < 1e-6


def test_only_outliers_are_called_chance(scene_of):
    for seed in range(3):
        trace = solve(scene_of("panorama", outlier_rate=1.0).problem(seed), seed=seed)
        assert trace.certificate.nfa > 1e-3


@pytest.mark.parametrize(("folder", "scenes"), [("aria_adt_fisheye", 3), ("aria_gen2", 12)])
def test_real_images_true_pose_never_explains_more(folder, scenes):
    """No less is found than it explains, even by a twentieth of the usual effort, with which not all is proven."""
    options = Options(bound_px=3.0, effort=0.05)
    counts = []
    for path in sorted(real_data(folder).glob("*.toml")):
        problem = load_scene(path).problem()
        assert problem.truth_cam_from_map is not None
        aligned, truth = problem.aligned, problem.aligned.align_pose(problem.truth_cam_from_map)
        assert tilt_of(truth[:, :3]) <= aligned.gravity_bound_rad + 1e-9
        of_truth = np.count_nonzero(residuals_px(aligned, truth) <= options.bound_px)
        counts.append((of_truth, solve(problem, options).certificate.lower_bound))
    assert len(counts) == scenes and all(of_truth <= found for of_truth, found in counts), counts
