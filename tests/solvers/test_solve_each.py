"""Many samples at once give what each gives alone, planes and degenerate samples included."""

import numpy as np
import pytest
from pose_samples import around

from spherloc.solvers.base import solve_each
from spherloc.solvers.epnp import Epnp
from spherloc.solvers.mlpnp import Mlpnp
from spherloc.solvers.p3p import P3p
from spherloc.solvers.svd import Svd


@pytest.mark.parametrize("solver", [Svd(), Mlpnp(), P3p(), Epnp()], ids=lambda solver: solver.name)
def test_many_samples_are_solved_as_each_alone(solver, rng):
    samples = [around(rng, 6, noise_rad=1e-3, offset_m=3.0) for _ in range(40)]
    bearings, points = np.array([one for one, _, _ in samples]), np.array([some for _, some, _ in samples])
    points[3:6, :, 2] = 1.0  # in a plane
    points[6] = points[6, 0]  # all in one place
    points[7] = np.outer(np.arange(6.0), [1.0, 2.0, 3.0])  # on a line
    bearings[8] = bearings[8, 0]  # one ray
    if solver.pinhole:
        bearings[:, :, 2] = 0.2 + np.abs(bearings[:, :, 2])
        bearings /= np.linalg.norm(bearings, axis=2, keepdims=True)
    many, sample = solve_each(solver, bearings, points)
    alone = [solver.solve(one, some) for one, some in zip(bearings, points, strict=True)]
    np.testing.assert_array_equal(sample, np.repeat(np.arange(40), list(map(len, alone))))
    np.testing.assert_allclose(many, np.concatenate(alone), rtol=1e-9, atol=1e-9)
    assert len(alone[6]) == 0


@pytest.mark.parametrize("solver", [Svd(), Mlpnp()], ids=lambda solver: solver.name)
def test_right_samples_among_many_give_the_truth(solver, rng):
    samples = [around(rng, 8) for _ in range(20)]
    bearings, points = np.array([one for one, _, _ in samples]), np.array([some for _, some, _ in samples])
    bearings[::2] = np.roll(bearings[::2], 1, axis=1)  # wrong
    many, sample = solve_each(solver, bearings, points)
    for cam_from_map, place in zip(many, sample, strict=True):
        if place % 2:
            np.testing.assert_allclose(cam_from_map, samples[place][2], atol=1e-6)
    assert set(range(1, 20, 2)) <= set(sample.tolist())
