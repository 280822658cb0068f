"""The exact search: no pose explains more than its bounds say, and its poses explain what they are said to."""

from dataclasses import replace

import numpy as np
import pytest
from small_problems import Tight, explained, good_poses, tight_problem

from spherloc.bounds import bounds_of
from spherloc.consensus.chance import chance_rate
from spherloc.consensus.exact import exact_consensus
from spherloc.consensus.pair_arcs import pair_arcs, turn_of
from spherloc.consensus.yaw_bins import BIN_TURN, BINS
from spherloc.geometry import yaw_of, yaw_rotation

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

EFFORT = 20_000_000
YAW_BINS = 1440


def search(problem, guesses=(), effort=EFFORT, budget_s=60.0):
    rate = chance_rate(problem.aligned.bearings, problem.bounds.radians)
    return exact_consensus(problem.aligned, problem.bounds, rate, list(guesses), effort, budget_s)


def of_scene(scene, seed, bound_px):
    """A problem of the simulation as one of ``small_problems``."""
    problem = scene.problem(seed)
    aligned = problem.aligned
    truth = aligned.align_pose(problem.truth_cam_from_map)
    yaw = yaw_of(truth[:, :3])
    centre = -truth[:, :3].T @ truth[:, 3]
    bounds = bounds_of(aligned, bound_px)
    return Tight(aligned, bounds, yaw, centre, explained(aligned, bounds, np.array([yaw]), centre[None])[0])


def compatible(problem, clique):
    """Whether arcs of all pairs of the clique have a yaw in common."""
    pairs, lo, hi = pair_arcs(problem.aligned, problem.bounds.radians)
    mine = np.isin(pairs, clique).all(axis=1)
    pairs, lo, hi = pairs[mine], lo[mine], hi[mine]
    # If they have, then at the first end of one of them, too.
    ends = np.append(lo, 0.0)
    inside = (ends - lo[:, None]) % 4.0 <= (hi - lo)[:, None]
    edges = [len({tuple(pair) for pair in pairs[column].tolist()}) for column in inside.T]
    return max(edges, default=0) == len(clique) * (len(clique) - 1) // 2


def check(problem, found):
    """Everything that was found or proven; returns the largest consensus that is known."""
    aligned, bounds = problem.aligned, problem.bounds
    # What it found.
    yaws = np.array([yaw_of(p[:, :3]) for p in found.poses])
    centres = np.array([-p[:, :3].T @ p[:, 3] for p in found.poses]).reshape(-1, 3)
    assert all(np.allclose(p[:, :3], yaw_rotation(yaw_of(p[:, :3])), atol=1e-12) for p in found.poses), "not level"
    if len(yaws):
        masks = explained(aligned, bounds, yaws, centres)
        np.testing.assert_array_equal(masks.sum(axis=1), found.supports)
        np.testing.assert_array_equal(masks[0], found.mask)
    assert (np.diff(found.supports) <= 0).all()
    # What it proved, against every pose that others found.
    more = good_poses(aligned, bounds)
    yaws, centres = np.concatenate([yaws, more[0], [problem.yaw]]), np.vstack([centres, more[1], problem.centre])
    most = explained(aligned, bounds, yaws, centres).sum(axis=1)
    bins = np.floor(turn_of(yaws) / BIN_TURN).astype(int) % BINS
    late = np.flatnonzero(most > found.bound[bins])
    assert len(late) == 0, (
        f"a pose explains {most[late].max()}, more than the bound {found.bound[bins[late]]} of its bin"
    )
    over_yaw = found.bound_over_yaw(YAW_BINS)
    places = np.floor((yaws + np.pi) % (2 * np.pi) / (2 * np.pi) * YAW_BINS).astype(int) % YAW_BINS
    assert (most <= over_yaw[places]).all()
    assert over_yaw.max() == found.bound.max()
    # The clique.
    assert compatible(problem, found.clique)
    assert len(found.clique) >= found.supports.max(initial=0)
    assert len(found.clique) <= max(found.bound.max(), found.supports.max(initial=0))
    return int(most.max())


@pytest.mark.parametrize("gravity_bound_rad", [0.0, 0.01])
@pytest.mark.parametrize("bound_px", [0.5, 3.0, 10.0, 30.0])
def test_nothing_explains_more_than_the_bound(rng, bound_px, gravity_bound_rad):
    """Residuals on the edge of their bounds, points seen twice, level bearings, near points, only outliers."""
    proven, missed, trials = 0, 0, 8
    for k in range(trials):
        count = int(rng.integers(3, 15))
        outliers = int(rng.integers(0, count + 1)) if k % 4 else count
        problem = tight_problem(rng, count, outliers, bound_px, gravity_bound_rad, rng.choice([1 - 1e-6, 0.9]))
        found = search(problem)
        most = check(problem, found)
        best = int(found.supports.max(initial=0))
        proven += found.bound.max() <= max(best, 1)
        missed += most > best
    # Bounds that hold are easily had by proving nothing.
    assert proven >= 0.5 * trials, f"{proven} of {trials} proven"
    assert missed <= 0.25 * trials, f"{missed} of {trials} not found"


@pytest.mark.parametrize("camera", ["mei", "fisheye", "panorama"])
def test_cameras(rng, scene_of, camera):
    closed = 0
    for seed in range(5):
        tilt = rng.choice([0.0, 0.2])
        rate = rng.choice([0.5, 0.8, 1.0])
        scene = scene_of(camera, correspondences=14, outlier_rate=rate, noise_px=1.0, gravity_error_deg=tilt)
        problem = of_scene(scene, seed, rng.choice([2.0, 8.0, 25.0]))
        found = search(problem)
        check(problem, found)
        closed += found.bound.max() <= found.supports.max(initial=1)
    assert closed >= 3


def test_repeated_structure(rng):
    """Two copies of a scene: two poses explain half each, and one correspondence more decides."""
    for _ in range(6):
        problem = tight_problem(rng, 9, 0, 2.0, share=0.5, nearest=1.0)
        aligned = problem.aligned
        shift = np.array([20.0, 0.5, -7.0])
        twice = {
            name: np.concatenate([getattr(aligned, name), getattr(aligned, name)[:8]])
            for name in ("bearings", "pixel_from_bearing", "radians_per_pixel")
        }
        points = np.vstack([aligned.points, aligned.points[:8] + shift])
        both = replace(aligned, index=np.arange(17), count=17, points=points, **twice)
        for array in (*twice.values(), points):
            array.setflags(write=False)
        bounds = bounds_of(both, 2.0)
        doubled = replace(problem, aligned=both, bounds=bounds, inliers=np.arange(17) < 9)
        found = search(doubled)
        assert check(doubled, found) == 9 == found.bound.max()
        assert found.supports[0] == 9 and found.finished
        assert found.mask[:9].all() and not found.mask[9:].any()


def test_guesses_only_help(rng):
    """The truth or nonsense to start from: the same consensus is proven."""
    for _ in range(4):
        problem = tight_problem(rng, 12, 6, 2.0, share=0.9)
        turn = yaw_rotation(problem.yaw)
        truth = (problem.yaw, -turn @ problem.centre)
        nonsense = (rng.uniform(-3, 3), rng.uniform(-3, 3, 3))
        results = [search(problem, guesses) for guesses in ((), (truth,), (nonsense,), (nonsense, truth))]
        for found in results:
            check(problem, found)
        closed = {int(found.supports[0]) for found in results if found.bound.max() <= found.supports[0]}
        assert len(closed) <= 1, "two different numbers are both proven"
        assert results[1].supports[0] >= problem.inliers.sum()


def test_bounds_hold_when_effort_or_time_run_out(rng):
    """Of a search that stopped early the bounds are wider, never wrong."""
    stopped = 0
    for _ in range(3):
        problem = tight_problem(rng, 30, 24, 20.0)
        full = search(problem)
        for found in (search(problem, effort=1), search(problem, effort=20_000), search(problem, budget_s=1e-9)):
            check(problem, found)
            assert found.bound.max() >= full.supports[0]
            stopped += not found.finished
            if not found.finished:
                assert found.bound.max() > found.supports.max(initial=0), "stopped with nothing left to be done"
    assert stopped >= 3


def test_two_correspondences(rng):
    for _ in range(20):
        problem = tight_problem(rng, 2, 0, 2.0)
        found = search(problem)
        assert check(problem, found) == 2 == found.bound.max()


def test_one_correspondence_is_always_explained(rng):
    """Two that no pose explains together: at every yaw a camera can still be put in front of one of them."""
    problem = tight_problem(rng, 2, 0, 2.0)
    bearings = np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
    weights = 200.0 * np.array([[[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]] * 2)
    above = replace(problem.aligned, bearings=bearings, points=-bearings, pixel_from_bearing=weights)
    for array in (bearings, above.points, weights):
        array.setflags(write=False)
    found = search(replace(problem, aligned=above))
    assert len(found.poses) == 0 and (found.bound >= 1).all()


def test_bound_over_yaw_has_every_bin(rng):
    """The yaw bins that a bin of turn touches show at least its bound, and no bound is invented."""
    found = search(tight_problem(rng, 6, 3, 2.0))
    fine = np.linspace(-np.pi, np.pi, 60_001)
    turns = turn_of(fine) / BIN_TURN
    for bins in (2, 8, 360, 1440, 5000):
        for b in (0, 1, *(k * BINS // 4 + more for k in (1, 2, 3) for more in (-1, 0, 1)), BINS - 2, BINS - 1):
            peak = np.zeros(BINS, np.int32)
            peak[b] = 5
            shown = replace(found, bound=peak).bound_over_yaw(bins)
            assert shown.shape == (bins,) and set(shown.tolist()) <= {0, 5}
            yaws = fine[(turns > b + 1e-3) & (turns < b + 1 - 1e-3)]
            expected = np.unique(np.floor((yaws + np.pi) / (2 * np.pi) * bins).astype(int) % bins)
            assert (shown[expected] == 5).all()
            assert np.count_nonzero(shown) <= len(expected) + 2
