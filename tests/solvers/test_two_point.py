"""The 2P solver against the paper's own formulas, against an independent solver, and where the paper breaks."""

import numpy as np
import poselib
import pytest

from spherloc.errors import ProblemError
from spherloc.geometry import rotation_angle, yaw_rotation
from spherloc.solvers.two_point import two_point, yaw_coefficients

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

HORIZONTAL, POLE, SEAM = "one bearing horizontal", "one bearing vertical", "bearings at both sides of the seam"
KINDS = ("random", "near-horizontal", HORIZONTAL, POLE, SEAM, "near-antipodal", "z = 0", "far", "behind")


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def turned(yaws, points):
    """R_y(yaw) p for yaws (B,) and points (B, 2, 3)."""
    rotations = np.array([yaw_rotation(yaw) for yaw in yaws]).reshape(-1, 3, 3)
    return np.einsum("bij,bkj->bki", rotations, points)


def bearings_of(rng, kind, count):
    """Pairs of true bearings (count, 2, 3)."""
    v = unit(rng.normal(size=(count, 2, 3)))
    if kind == "near-horizontal":
        v[:, :, 1] *= 10 ** rng.uniform(-5, -3, (count, 1))
    elif kind == HORIZONTAL:
        v[:, 0, 1] = 0.0
    elif kind == POLE:
        v[:, 0] = [0.0, 1.0, 0.0]
        v[::2, 0, 1] = -1.0
    elif kind == SEAM:
        lon = np.pi + np.array([1.0, -1.0]) * 10 ** rng.uniform(-6, -2, (count, 2))
        v[..., 0], v[..., 2] = np.sin(lon), np.cos(lon)
    elif kind == "near-antipodal":
        # Positions lose digits with the square of this angle, whatever the formula.
        v[:, 1] = -v[:, 0] + 10 ** rng.uniform(-2, -1, (count, 1)) * v[:, 1]
    elif kind == "z = 0":
        v[:, 0, 2] = 0.0
    elif kind == "behind":
        v[..., 2] = -np.abs(v[..., 2])
    return unit(v)


def problems(rng, kind, count=400):
    """(yaws, translations, bearings, points, depths) without noise, and not at a double root of Eq. 22."""
    v = bearings_of(rng, kind, count)
    depths = 10 ** (rng.uniform(2, 4, (count, 2)) if kind == "far" else rng.uniform(-1, 1, (count, 2)))
    yaws, translations = rng.uniform(-np.pi, np.pi, count), rng.uniform(-5, 5, (count, 3))
    points = turned(-yaws, depths[..., None] * v - translations[:, None, :])
    d1, d2, d3 = np.array([yaw_coefficients.py_func(*pair[0], *pair[1])[:3] for pair in zip(v, points, strict=True)]).T
    good = np.abs(d3) < 0.99 * np.hypot(d1, d2)  # else the root is worth only half the digits
    assert good.sum() > count / 2
    return yaws[good], translations[good], v[good], points[good], depths[good]


def yaw_error(a, b):
    return np.abs((a - b + np.pi) % (2 * np.pi) - np.pi)


@pytest.mark.parametrize("kind", KINDS)
def test_recovers_the_pose_exactly_without_noise(rng, kind):
    """The true pose is one of the roots, wherever the bearings are."""
    yaws, translations, v, p, depths = problems(rng, kind)
    found, t, valid = two_point(v, p)
    error = np.where(valid, yaw_error(found, yaws[:, None]), np.inf)
    best = np.argmin(error, axis=1)
    assert error.min(axis=1).max() < 1e-9
    distance = np.linalg.norm(t[np.arange(len(t)), best] - translations, axis=1)
    scale = np.linalg.norm(translations, axis=1) + depths.max(axis=1)
    assert (distance / scale).max() < 1e-9


@pytest.mark.parametrize("kind", KINDS)
def test_every_root_is_a_pose_that_sees_both_points(rng, kind):
    """Both roots reproject exactly with positive depths; a missing root is NaN and follows the found ones."""
    _, _, v, p, _ = problems(rng, kind)
    yaws, t, valid = two_point(v, p)
    for root in range(2):
        has = valid[:, root]
        camera = turned(yaws[has, root], p[has]) + t[has, root][:, None, :]
        assert np.linalg.norm(unit(camera) - v[has], axis=2).max(initial=0.0) < 1e-8
        assert np.isnan(yaws[~has, root]).all() and np.isnan(t[~has, root]).all()
    assert not (valid[:, 1] & ~valid[:, 0]).any()


def test_two_roots_are_common_and_one_is_commoner(rng):
    """A solver that dropped the second root, or kept one with a negative depth, would show here."""
    _, _, v, p, _ = problems(rng, "random", 4000)
    roots = np.count_nonzero(two_point(v, p)[2], axis=1)
    assert roots.min() == 1
    assert 0.1 < np.mean(roots == 2) < 0.5


def paper_eq_23(v, p):
    """The paper's d1, d2, d3 as printed."""
    (xci, yci, zci), (xcj, ycj, zcj) = v
    (xi, yi, zi), (xj, yj, zj) = p
    gamma = (xcj * yci - xci * ycj) / (zcj * yci - zci * ycj)
    d1 = yci * ycj * (xi - xj - gamma * (zi - zj))
    d2 = yci * ycj * (zi - zj - gamma * (xj - xi))
    d3 = yj * yci * (xcj - gamma * zcj) + yi * ycj * (gamma * zci - xci)
    return np.array([d1, d2, d3])


def paper_eq_24_to_27(v, p, yaw):
    """The paper's translation by least squares."""
    c, s = np.cos(yaw), np.sin(yaw)
    H, b = [], []
    for (xc, yc, zc), (x, y, z) in zip(v, p, strict=True):
        H += [[yc, -xc, 0.0], [0.0, -zc, yc]]
        b += [y * xc - yc * x * c - yc * z * s, y * zc - yc * z * c + yc * x * s]
    return np.linalg.lstsq(np.array(H), np.array(b), rcond=None)[0]


def test_coefficients_are_the_papers_times_a_factor(rng):
    """Ours = Eq. 23 times n_x / (y_ci y_cj): the same equation without its divisions."""
    for v, p in zip(unit(rng.normal(size=(300, 2, 3))), rng.uniform(-5, 5, (300, 2, 3)), strict=True):
        ours = np.array(yaw_coefficients(v[0], v[1], p[0], p[1])[:3])
        factor = np.cross(v[0], v[1])[0] / (v[0, 1] * v[1, 1])
        np.testing.assert_allclose(ours, factor * paper_eq_23(v, p), rtol=1e-9, atol=1e-11)


def test_roots_solve_eq_22_and_translations_are_eq_27(rng):
    """The paper's two steps, written out, give our poses."""
    _, _, v, p, _ = problems(rng, "random", 300)
    yaws, t, valid = two_point(v, p)
    for k, root in np.argwhere(valid):
        yaw = yaws[k, root]
        d = paper_eq_23(v[k], p[k])
        assert abs(d @ [np.cos(yaw), np.sin(yaw), 1.0]) < 1e-9 * np.linalg.norm(d)
        np.testing.assert_allclose(t[k, root], paper_eq_24_to_27(v[k], p[k], yaw), atol=1e-8)


@pytest.mark.parametrize("kind", ["near-horizontal", HORIZONTAL])
def test_stays_exact_where_eq_23_loses_its_digits(rng, kind):
    """Horizontal bearings, the commonest on a vehicle: the printed formula divides by their y."""
    yaws, _, v, p, _ = problems(rng, kind)
    with np.errstate(all="ignore"):
        printed = np.array([paper_eq_23(*pair) for pair in zip(v, p, strict=True)])
    residual = printed[:, 0] * np.cos(yaws) + printed[:, 1] * np.sin(yaws) + printed[:, 2]
    size = np.abs(printed).max(axis=1)
    # Exactly horizontal: Eq. 23 says 0 = 0 for every yaw.
    assert (size == 0).any() if kind == HORIZONTAL else np.abs(residual / size).max() < 1e-6
    found, _, valid = two_point(v, p)
    assert np.where(valid, yaw_error(found, yaws[:, None]), np.inf).min(axis=1).max() < 1e-9


def test_double_root_is_found():
    """Where both roots of Eq. 22 meet, rounding puts |d3| above rho as often as not: the pose must survive."""
    rng = np.random.default_rng(0)
    lost = 0
    for _ in range(500):
        n = unit(rng.normal(size=3))
        level = unit(np.cross([0.0, 1.0, 0.0], n))
        steepest = np.cross(n, level)  # of the plane through the camera and both points
        near = rng.uniform(-2, 2) * level + rng.uniform(1, 3) * steepest
        p = np.array([[near, near + rng.uniform(0.5, 2) * steepest]])
        yaws, _, valid = two_point(unit(p), p)
        lost += not (valid & (np.abs(np.sin(yaws / 2)) < 1e-6)).any()
    assert lost == 0, f"{lost} of 500 exact problems have no solution"


V = unit(np.array([[0.3, 0.2, 1.0], [-0.5, 0.4, 0.8]]))
P = np.array([[1.0, 2.0, 3.0], [-2.0, 1.0, 4.0]])
DEGENERATE = {
    "both bearings horizontal": (unit(V * [1, 0, 1]), P),
    "one point above the other": (V, np.array([[1.0, 2.0, 3.0], [1.0, -2.0, 3.0]])),
    "the same point": (V, P[[0, 0]]),
    "the same bearing": (V[[0, 0]], P),
    "opposite bearings": (np.array([V[0], -V[0]]), P),
    "everything the same": (V[[0, 0]], P[[0, 0]]),
    "no real root": (V, np.array([[0.0, 9.0, 0.0], [0.01, -9.0, 0.0]])),
    "zero bearings": (np.zeros((2, 3)), P),
}


@pytest.mark.parametrize("case", DEGENERATE)
def test_degenerate_pairs_have_no_root(case):
    """No pose is invented, no warning given and nothing infinite returned; the others of the batch are not harmed."""
    v, p = DEGENERATE[case]
    good = turned(np.array([0.4]), P[None])[0] + [0.0, 0.0, 9.0]
    yaws, t, valid = two_point(np.array([v, unit(good), v]), np.array([p, P, p]))
    assert valid[1].any() and not valid[[0, 2]].any()
    assert np.isnan(yaws[[0, 2]]).all() and np.isnan(t[[0, 2]]).all()


def test_agrees_with_poselib(rng):
    """An independent solver (no test of depths there): the same poses, also behind the image plane."""
    _, _, v, p, _ = problems(rng, "random", 2500)
    yaws, t, valid = two_point(v, p)
    compared = 0
    for k in range(len(v)):
        ours = [(yaw_rotation(yaws[k, r]), t[k, r]) for r in range(2) if valid[k, r]]
        theirs = []
        for pose in poselib.up2p(v[k], p[k]):
            depth = np.einsum("ki,ki->k", p[k] @ pose.R.T + pose.t, v[k])
            if (depth > 0).all():
                theirs.append((pose.R, pose.t))
        assert len(ours) == len(theirs)
        for R, position in ours:
            gaps = [rotation_angle(R.T @ R2) + np.linalg.norm(position - t2) for R2, t2 in theirs]
            assert min(gaps) < 1e-6
        compared += 1
    assert compared >= 1000
    assert (v[..., 2] < 0).any(axis=1).sum() > 500


def test_empty_batch():
    yaws, t, valid = two_point(np.empty((0, 2, 3)), np.empty((0, 2, 3)))
    assert (yaws.shape, t.shape, valid.shape) == ((0, 2), (0, 2, 3), (0, 2))


PAIRS = (5, 2, 3)
WRONG = [
    ((2, 3), (2, 3)),
    ((5, 3, 3), (5, 3, 3)),
    (PAIRS, (4, 2, 3)),
    ((5, 2, 2), PAIRS),
    (PAIRS, (5, 2)),
    ((0,), (0,)),
]


@pytest.mark.parametrize("bearings, points", WRONG)
def test_wrong_shapes_are_problem_errors(bearings, points):
    with pytest.raises(ProblemError, match="shape") as caught:
        two_point(np.ones(bearings), np.ones(points))
    assert "\n" not in str(caught.value)
