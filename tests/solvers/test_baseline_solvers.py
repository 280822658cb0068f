"""What every solver of a full pose must do: exact without noise, silent about nonsense, and clear about its limits."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pose_samples import SOLVERS, ahead, angular_cost, around, errors, plane, random_rotation, sample_for

from spherloc.geometry import pose
from spherloc.solvers.epnp import Epnp
from spherloc.solvers.mlpnp import Mlpnp
from spherloc.solvers.svd import Svd
from spherloc.testing import check_solver

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

each_solver = pytest.mark.parametrize("solver", SOLVERS, ids=lambda solver: solver.name)


@each_solver
@given(seed=st.integers(0, 2**32 - 1), more=st.integers(0, 30))
def test_exact_without_noise(solver, seed, more):
    """Any pose, any number of points from the least one on, over the whole field that the solver claims."""
    rng = np.random.default_rng(seed)
    bearings, points, truth = sample_for(solver, rng, solver.sample_size + 1 + more)
    rotation_rad, position_m = errors(truth, solver.solve(bearings, points))
    assert rotation_rad < 1e-6 and position_m < 1e-6


@each_solver
def test_smallest_sample(solver, rng):
    """The least number fixes the pose but for rare bad configurations."""
    exact = 0
    for _ in range(100):
        bearings, points, truth = sample_for(solver, rng, solver.sample_size)
        exact += max(errors(truth, solver.solve(bearings, points))) < 1e-6
    assert exact >= 97


@each_solver
def test_the_contract(solver):
    """Rotations, also of noisy bearings; errors; nothing changed; no randomness."""
    check_solver(solver)
    rng = np.random.default_rng(1)
    for _ in range(50):
        bearings, points, _ = sample_for(solver, rng, 12, noise_rad=0.01)
        for solution in solver.solve(bearings, points):
            rotation = solution[:, :3]
            np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
            assert np.linalg.det(rotation) > 0.0


@each_solver
def test_the_frame_of_the_map_does_not_matter(solver, rng):
    """Another origin, orientation and unit of the map turn, move and scale the noisy solution with it."""
    for _ in range(10):
        bearings, points, _ = sample_for(solver, rng, 20, noise_rad=2e-3)
        turn, shift, unit = random_rotation(rng), rng.uniform(-100, 100, 3), 10.0 ** rng.uniform(-2, 2)
        first = solver.solve(bearings, points)[0]
        second = solver.solve(bearings, unit * points @ turn.T + shift)[0]
        expected = pose(first[:, :3] @ turn.T, unit * first[:, 3] - first[:, :3] @ turn.T @ shift)
        # oDLT weighs the entries of A one by one, and EPnP picks its control points along axes that nearly tie.
        tolerance = 2e-2 if solver.name in ("oDLT", "oDLT on the sphere", "EPnP", "EPnP on the sphere") else 1e-6
        assert errors(expected, second[None])[0] < tolerance
        assert errors(expected, second[None])[1] < 10 * tolerance * unit


@pytest.mark.parametrize("solver", [Svd(), Mlpnp()], ids=lambda solver: solver.name)
def test_the_frame_of_the_bearings_does_not_matter(solver, rng):
    """Behind the camera is no other direction than in front of it."""
    for _ in range(10):
        bearings, points, _ = around(rng, 15, noise_rad=2e-3)
        turn = random_rotation(rng)
        first, second = solver.solve(bearings, points)[0], solver.solve(bearings @ turn.T, points)[0]
        np.testing.assert_allclose(second, turn @ first, atol=1e-8)


@pytest.mark.parametrize(
    ("solver", "case"),
    [
        pytest.param(solver, case, id=f"{case}-{solver.name}")
        for case in ("one point", "one bearing", "line", "opposite bearings")
        for solver in SOLVERS
        if not (solver.pinhole and case == "opposite bearings")  # which a pinhole does not see
    ],
)
def test_degenerate_input_is_no_nan(solver, case, rng):
    bearings, points, _ = sample_for(solver, rng, 12)
    if case == "one point":
        points = np.repeat(points[:1], 12, axis=0)
    elif case == "one bearing":
        bearings = np.repeat(bearings[:1], 12, axis=0)
    elif case == "line":
        points = points[0] + np.arange(12.0)[:, None] * (points[1] - points[0])
    else:
        bearings = np.where(np.arange(12)[:, None] % 2, -bearings[:1], bearings[:1])
    solutions = solver.solve(bearings, points)
    assert solutions.shape[1:] == (3, 4) and np.isfinite(solutions).all()
    if case == "one point" or (case == "line" and solver.name in ("SVD", "MLPnP", "oDLT")):
        assert len(solutions) == 0, "no pose is better than another"


@pytest.mark.parametrize("name", ["SVD", "oDLT"])
def test_linear_solvers_refuse_a_plane(name, rng):
    """Points in one plane leave the linear system a family of solutions."""
    solver = next(solver for solver in SOLVERS if solver.name == name)
    for _ in range(20):
        bearings, points, _ = plane(rng, 20)
        if (bearings[:, 2] > 0.1).all():
            assert len(solver.solve(bearings, points)) == 0


def test_epnp_is_that_of_opencv(rng):
    bearings, points, _ = ahead(rng, 30, noise_rad=1e-3, offset_m=2.0)
    image = bearings[:, :2] / bearings[:, 2:]
    _, turn, translation = cv2.solvePnP(points, image, np.eye(3), None, flags=cv2.SOLVEPNP_EPNP)
    np.testing.assert_allclose(Epnp().solve(bearings, points)[0], pose(cv2.Rodrigues(turn)[0], translation), atol=1e-12)


def test_svd_comes_close_to_maximum_likelihood(rng):
    """It must profit from more points: its error falls, and is at most a few times that of the best estimate."""
    medians = {}
    for count in (12, 100):
        found = []
        for _ in range(40):
            bearings, points, truth = around(rng, count, noise_rad=1e-3)
            found.append([errors(truth, solver.solve(bearings, points)) for solver in (Svd(), Mlpnp())])
            costs = [angular_cost(bearings, points, s.solve(bearings, points)[0]) for s in (Svd(), Mlpnp())]
            assert costs[1] <= costs[0]
        medians[count] = np.median(found, axis=0)
    assert (medians[100][0] < 0.6 * medians[12][0]).all()
    assert (medians[100][0] < 3.0 * medians[100][1]).all()
