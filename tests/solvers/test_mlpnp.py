"""MLPnP: it reaches the maximum of the likelihood, planes included, and compares well with its author's code."""

import numpy as np
import pytest
from pose_samples import ahead, angular_cost, around, errors, plane
from pytheia import sfm
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from spherloc.geometry import pose, tangent_basis, transform
from spherloc.solvers.mlpnp import PLANAR, Mlpnp

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


def refined_by_scipy(bearings, points, start):
    """An independent minimum of the tangential residuals."""
    basis = tangent_basis(bearings)

    def state(x):
        return pose(Rotation.from_rotvec(x[:3]).as_matrix() @ start[:, :3], start[:, 3] + x[3:])

    def residuals(x):
        rays = transform(state(x), points)
        return np.einsum("nij,nj->ni", basis, rays / np.linalg.norm(rays, axis=1, keepdims=True)).ravel()

    return state(least_squares(residuals, np.zeros(6), xtol=1e-15, ftol=1e-15, gtol=1e-15).x)


@pytest.mark.parametrize("count", [6, 10, 100])
def test_reaches_the_least_residuals(count, rng):
    for _ in range(20):
        bearings, points, truth = around(rng, count, noise_rad=2e-3, offset_m=2.0)
        found = Mlpnp().solve(bearings, points)[0]
        best = refined_by_scipy(bearings, points, truth)
        assert angular_cost(bearings, points, found) <= angular_cost(bearings, points, best) * (1 + 1e-6)


@pytest.mark.parametrize("count", [6, 8, 40])
def test_planes(count, rng):
    for _ in range(50):
        bearings, points, truth = plane(rng, count)
        assert max(errors(truth, Mlpnp().solve(bearings, points))) < 1e-6


@pytest.mark.parametrize("share", [0.2, 0.9, 1.1, 3.0])
def test_almost_planes(share, rng):
    """On both sides of the border between the two linear systems the answer is exact."""
    exact = 0
    for _ in range(50):
        bearings, points, truth = plane(rng, 30, thickness_m=4.0 * PLANAR * share)
        exact += max(errors(truth, Mlpnp().solve(bearings, points))) < 1e-6
    assert exact == 50


def test_planes_with_noise(rng):
    """As good as the best estimate there is, nearly always."""
    good = 0
    for _ in range(50):
        bearings, points, truth = plane(rng, 40, noise_rad=1e-3)
        best = refined_by_scipy(bearings, points, truth)
        good += errors(best, Mlpnp().solve(bearings, points))[0] < 1e-5
    assert good >= 48


def test_error_is_not_above_that_of_the_authors_code(rng):
    """pytheia's MLPnP is written by the method's first author; it takes bearings in front only."""
    ours, theirs = [], []
    for _ in range(60):
        bearings, points, truth = ahead(rng, 30, noise_rad=1e-3, offset_m=0.5)
        image = bearings[:, :2] / bearings[:, 2:]
        success, rotation, translation = sfm.MLPnP(list(image), [1e-6 * np.eye(3)] * 30, list(points))
        assert success
        ours.append(errors(truth, Mlpnp().solve(bearings, points)))
        theirs.append(errors(truth, pose(rotation, translation)[None]))
    assert (np.median(ours, axis=0) <= 1.05 * np.median(theirs, axis=0)).all()
    assert np.median(theirs, axis=0)[0] < 5e-3, "otherwise the comparison would mean nothing"


def test_covariances_weigh_each_bearing_in_each_direction(rng):
    """With noise of another size in each direction of each bearing: scipy's least squares in pixels, and a better pose
    than all alike; of equal noise the same pose as without."""
    alike, weighed = [], []
    for _ in range(40):
        bearings, points, truth = around(rng, 25, offset_m=2.0)
        basis = tangent_basis(bearings)
        pixels_per_radian = 10.0 ** rng.uniform(2.0, 4.0, (25, 2))
        moved = bearings + np.einsum("nij,ni->nj", basis, rng.standard_normal((25, 2)) / pixels_per_radian)
        moved /= np.linalg.norm(moved, axis=1, keepdims=True)
        jacobian = pixels_per_radian[:, :, None] * tangent_basis(moved)
        found = Mlpnp().solve_each(moved[None], points[None], jacobian[None])[0][0]

        def residuals(x, truth=truth, points=points, jacobian=jacobian):
            turned = Rotation.from_rotvec(x[:3]).as_matrix() @ truth[:, :3]
            rays = points @ turned.T + truth[:, 3] + x[3:]
            return np.einsum("nij,nj->ni", jacobian, rays / np.linalg.norm(rays, axis=1, keepdims=True)).ravel()

        x = least_squares(residuals, np.zeros(6), xtol=1e-15, ftol=1e-15, gtol=1e-15).x
        best = pose(Rotation.from_rotvec(x[:3]).as_matrix() @ truth[:, :3], truth[:, 3] + x[3:])
        np.testing.assert_allclose(found, best, atol=1e-5)
        weighed.append(errors(truth, found[None])[0])
        plain = Mlpnp().solve(moved, points)
        alike.append(errors(truth, plain)[0])
        same = Mlpnp().solve_each(moved[None], points[None], 300.0 * tangent_basis(moved)[None])[0]
        np.testing.assert_allclose(same, plain, atol=1e-9)
    assert np.median(weighed) < 0.6 * np.median(alike)
