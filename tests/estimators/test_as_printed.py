"""The paper's own form of its algorithms: what is printed and nothing else, checked against scipy and networkx."""

from dataclasses import replace

import networkx as nx
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from spherloc.errors import InputError
from spherloc.estimators import estimate, options_type
from spherloc.estimators.mc import MAX_PRINTED_BALLS
from spherloc.geometry import camera_centre, pose
from spherloc.refine import residuals_px

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


def run(problem, estimator, seed=0, **options):
    return estimate(problem, estimator, options_type(estimator)(as_printed=True, bound_px=8.0, **options), seed)


def six_dof_fit(problem, start, members):
    """Least squares over all six degrees of freedom, by scipy, of first-order reprojection errors."""
    jacobian, points = problem.pixel_from_bearing[members], problem.points[members]

    def residuals(x):
        rays = points @ (Rotation.from_rotvec(x[:3]).as_matrix() @ start[:, :3]).T + start[:, 3] + x[3:]
        return np.einsum("nij,nj->ni", jacobian, rays / np.linalg.norm(rays, axis=1, keepdims=True)).ravel()

    x = least_squares(residuals, np.zeros(6), xtol=1e-14, ftol=1e-14, gtol=1e-14).x
    return pose(Rotation.from_rotvec(x[:3]).as_matrix() @ start[:, :3], start[:, 3] + x[3:])


def within_8_px(problem, cam_from_map):
    return residuals_px(problem.aligned, problem.aligned.align_pose(cam_from_map)) <= 8.0


@pytest.mark.parametrize("camera", ["mei", "fisheye", "panorama"])
def test_mc_takes_every_arc_and_every_pair_of_the_rotation_clique(camera, scene_of):
    problem = replace(scene_of(camera), outlier_rate=0.6, correspondences=40).problem(3)
    trace = run(problem, "mc")
    yaw, balls, refinement = trace.stages
    assert (yaw.hi_rad - yaw.lo_rad).max() > np.radians(60.0)
    assert len(balls.pairs) == balls.candidates == len(yaw.clique)
    graph = nx.Graph(balls.edges.tolist())
    assert balls.proven
    assert len(balls.clique) == max(map(len, nx.find_cliques(graph)))
    centres, weights = balls.centres_m[balls.clique], balls.radii_m[balls.clique] ** -2.0
    np.testing.assert_allclose(camera_centre(balls.cam_from_map), weights @ centres / weights.sum(), atol=1e-9)
    fitted = six_dof_fit(problem, balls.cam_from_map, within_8_px(problem, balls.cam_from_map))
    np.testing.assert_allclose(trace.cam_from_map, fitted, atol=1e-6)
    np.testing.assert_array_equal(trace.inlier_mask, within_8_px(problem, trace.cam_from_map))
    assert refinement.gravity_sd_rad == np.inf


@pytest.mark.parametrize("estimator", ["ransac-2p", "ransac-svd", "ransac-mlpnp"])
def test_ransac_ends_with_one_fit_to_the_inliers_of_its_best_sample(estimator, scene_of):
    problem = replace(scene_of("mei"), outlier_rate=0.3).problem(1)
    trace = run(problem, estimator, iterations=300)
    ransac = trace.stages[0]
    fitted = six_dof_fit(problem, ransac.cam_from_map[-1], ransac.inlier_masks[-1])
    np.testing.assert_allclose(trace.cam_from_map, fitted, atol=1e-6)
    np.testing.assert_array_equal(trace.inlier_mask, within_8_px(problem, trace.cam_from_map))


def test_the_default_keeps_known_gravity_and_the_printed_form_does_not(scene_of):
    """Algorithm 1 ends in 6 DoF: its pose is no longer level although gravity is exact."""
    problem = scene_of("mei").problem(2)
    printed = run(problem, "ransac-2p")
    own = estimate(problem, "ransac-2p", options_type("ransac-2p")(), 0)
    assert abs(own.cam_from_map[1, 1] - 1.0) < 1e-12
    assert printed.cam_from_map[1, 1] < 1.0 - 1e-9


def test_of_too_many_pairs_the_smallest_balls_are_taken_and_said(scene_of):
    problem = replace(scene_of("panorama"), outlier_rate=0.0, correspondences=120).problem(0)
    balls = run(problem, "mc").stages[1]
    assert balls.candidates > MAX_PRINTED_BALLS == len(balls.pairs)
    assert balls.rule == f"The 5,000 smallest balls of the {balls.candidates:,} pairs in the rotation clique."


@pytest.mark.parametrize("estimator", ["mc", "ransac-2p", "ransac-svd"])
def test_a_switch_is_true_or_false(estimator):
    with pytest.raises(InputError, match=r"option as_printed is 1; give true or false\."):
        options_type(estimator)(as_printed=1)
