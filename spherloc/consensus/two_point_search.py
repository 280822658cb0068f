"""The search of 2P-RANSAC (Algorithm 1): sample two correspondences, solve, score, keep the best, stop by Eq. 28.

Sample k is a function of the seed and of k alone, so no sample is stored and every machine draws the same ones.

With a confidence, a hypothesis may be rejected after a part of the correspondences, in an order that is random but
fixed: if a set of K correspondences is spread over M at random, then fewer than f of them fall among the first n with
probability at most exp(-n KL((f - 1) / n || K / M)) (Hoeffding, 1963, which holds for drawing without replacement).
The chance to lose the best set by that is at most ``REJECTED_SHARE`` of the chance that the confidence leaves, and
is accounted for. Without a confidence nothing is left to chance: a hypothesis is rejected only when all remaining
correspondences could not make it the best.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from spherloc.consensus.inliers import BLOCK, pack_blocks, reaches, score_inliers
from spherloc.consensus.level_pose import fit, write_level_pose, write_translation
from spherloc.gauss_newton import AlignedMatches
from spherloc.kernel_cache import kernel
from spherloc.problem import AlignedProblem
from spherloc.small_arrays import copy_matrix, copy_vector
from spherloc.solvers.two_point import solve_pair
from spherloc.types import BoolArray, FloatArray, IndexArray
from spherloc.watch import DONE, TOTAL, Watch, stopped

Scoring = Literal["count", "msac"]

REJECTED_SHARE = 1e-3
"""Share of 1 - confidence that may be lost by rejecting hypotheses early; the samples must earn the rest."""

OPTIMIZATION_ROUNDS, OPTIMIZATION_STEPS = 3, 2
"""Choices of inliers, and Gauss-Newton steps on each; more steps change nothing (measured)."""
WATCH_MASK = 15
"""The search looks at its watch where these bits of the number of samples are 0."""


@dataclass(frozen=True, eq=False)
class TwoPointSearch:
    """The hypotheses that improved on the best one so far, J of them; the last one is the result."""

    drawn: int
    """Samples drawn."""
    confidence_reached: float
    """Probability by Eq. 28 that two of the last hypothesis's inliers were sampled together and not lost since."""
    improved_at: IndexArray
    """(J,) the sample of each improvement, from 0."""
    samples: IndexArray
    """(J, 2) indices of its two correspondences in the aligned problem."""
    yaws_rad: FloatArray
    """(J,) yaws."""
    translations: FloatArray
    """(J, 3) translations, metres; p_cam = R_y(yaw) p_map + t."""
    support: IndexArray
    """(J,) correspondences within their bound."""
    locally_optimized: BoolArray
    """(J,) whether it is a fit to the inliers of the improvement before it, instead of the pose of the sample."""

    @property
    def found(self) -> bool:
        """Whether any sampled pair has a solution."""
        return len(self.support) > 0


def search_two_point(
    aligned: AlignedProblem,
    bound_px: FloatArray,
    seed: int,
    iterations: int,
    confidence: float | None = None,
    scoring: Scoring = "count",
    local_optimization: bool = False,
    watch: Watch | None = None,
) -> TwoPointSearch:
    """Draw up to ``iterations`` pairs of the M >= 2 correspondences, until ``confidence`` (None: all of them).

    ``bound_px`` (M,) is each one's pixel bound. ``scoring`` "count" takes the hypothesis with most inliers, "msac" the
    one with the least MSAC cost. ``local_optimization`` fits yaw and translation to the inliers of each improvement.
    ``watch`` counts the samples, and expects all or, with a confidence, as many as the best hypothesis asks for; raises
    ``Cancelled``.
    """
    watch = watch or Watch()
    watch.expect(iterations)
    log, drawn, reached = _search(
        AlignedMatches(aligned.bearings, aligned.points, aligned.pixel_from_bearing),
        np.array(bound_px),  # a copy: for a read-only array numba would compile the kernel once more
        np.uint64(seed),
        iterations,
        np.nan if confidence is None else 1.0 - confidence,
        scoring == "msac",
        local_optimization,
        watch.board,
    )
    watch.check()
    return TwoPointSearch(
        drawn=drawn,
        confidence_reached=reached,
        improved_at=log[:, 0].astype(np.int32),
        samples=log[:, 1:3].astype(np.int32),
        yaws_rad=log[:, 3].copy(),
        translations=log[:, 4:7].copy(),
        support=log[:, 7].astype(np.int32),
        locally_optimized=log[:, 8] != 0.0,
    )


@kernel()
def _mixed(state):
    """SplitMix64's output function of a ``state`` (uint64).

    Steele et al., "Fast splittable pseudorandom number generators", 2014.
    """
    state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return state ^ (state >> np.uint64(31))


@kernel()
def _random(stream, k):
    """Random number k, 64 bits, of a ``stream`` (uint64)."""
    return _mixed(stream + np.uint64(k + 1) * np.uint64(0x9E3779B97F4A7C15))


@kernel()
def _below(bits, count):
    """A number from 0 to count - 1 from 32 random bits, uniform to within a share of count / 2^32."""
    return np.int64((bits * np.uint64(count)) >> np.uint64(32))


@kernel()
def sample_pair(seed, k, count):
    """Sample k of a seed (uint64): two different numbers below ``count``, every ordered pair equally likely."""
    bits = _random(_mixed(seed), k)
    i = _below(bits >> np.uint64(32), count)
    j = _below(bits & np.uint64(0xFFFFFFFF), count - 1)
    return i, j + 1 if j >= i else j


@kernel()
def _shuffled(seed, count):
    """A random order (``count``,) of so many things, independent of the samples of the same seed (uint64)."""
    stream = _mixed(~seed)
    order = np.arange(count)
    for k in range(count - 1, 0, -1):
        other = _below(_random(stream, k) >> np.uint64(32), k + 1)
        order[k], order[other] = order[other], order[k]
    return order


@kernel()
def _least_of_first(seen, target, count, miss):
    """The f for which fewer than f of ``target`` out of ``count`` are in ``seen`` random ones with chance <= miss."""
    rate, enough = target / count, -np.log(miss)
    low, high = -1, int(seen * rate)  # at least ``low`` + 1 may be asked for, ``high`` + 1 may not
    while high - low > 1:
        middle = (low + high) // 2
        share = middle / seen
        divergence = (1.0 - share) * np.log((1.0 - share) / (1.0 - rate))
        if middle > 0:
            divergence += share * np.log(share / rate)
        if seen * divergence >= enough:
            low = middle
        else:
            high = middle
    return low + 1


@kernel()
def _set_floors(floors, target, count, miss):
    """Write what a pose with ``target`` inliers of ``count`` must have after each block to ``floors`` (B,).

    See ``reaches``; this fails with probability ``miss``.
    """
    checks = np.int64(np.log2(len(floors))) + 1
    for b in range(len(floors)):
        seen = min(count, (b + 1) * BLOCK)
        floors[b] = target - (count - seen)
        if miss > 0.0 and target < count and seen < count and (b + 1) & b == 0:  # after 1, 2, 4, 8 ... blocks
            floors[b] = max(floors[b], _least_of_first(seen, target, count, miss / checks))


@kernel()
def _optimize(yaw, translation, matches, bound_px, mask):
    """Fit yaw, rad (returned), and translation (3,), m (in place), to the inliers, choose these anew, and so on.

    ``matches`` are ``gauss_newton.AlignedMatches``, ``bound_px`` (M,); ``mask`` (M,) is written.

    The pose of two noisy correspondences explains those around them; each fit reaches farther. A wider bound at first
    would reach farther still, but where gravity's error has widened the bounds it lets in too many false ones
    (measured).
    """
    pose, weights = np.empty(5), np.empty(len(mask))
    write_level_pose(yaw, translation, pose)
    for _ in range(OPTIMIZATION_ROUNDS):
        score_inliers(yaw, translation, matches, bound_px, mask)
        copy_vector(mask, weights)
        fit(matches.points, matches.pixel_jacobian, weights, pose, np.int64(OPTIMIZATION_STEPS))
        yaw = np.arctan2(pose[1], pose[0])
        write_translation(pose, translation)
    return yaw


@kernel()
def _search(matches, bound_px, seed, iterations, miss, msac, local, board):
    """Rows (sample, i, j, yaw, translation, inliers, optimized) of all improvements, samples drawn, confidence reached.

    ``matches`` are ``AlignedMatches``, ``bound_px`` (M,), ``seed`` is uint64; at most ``iterations`` samples are
    drawn; ``miss`` is 1 - confidence, or NaN to draw them all; ``msac`` and ``local`` are switches. Rows (J, 9) are
    float64. A watch's ``board`` counts the samples and can end it.
    """
    bearings, points, count = matches.bearings, matches.points, len(matches.points)
    bounded = not np.isnan(miss)
    rejected_share = REJECTED_SHARE * miss if bounded else 0.0
    blocks = pack_blocks(matches, bound_px, _shuffled(seed, count))
    floors = np.empty((count + BLOCK - 1) // BLOCK, np.int64)
    _set_floors(floors, np.int64(1), count, rejected_share)
    yaws, translations, mask = np.empty(2), np.empty((2, 3)), np.empty(count, np.bool_)
    log, rows, best, drawn = np.empty((32, 9)), 0, 0.0, np.int64(0)
    log_unclean = 0.0  # logarithm of the chance that one sample is not of the best hypothesis's inliers only
    while drawn < iterations and not (bounded and rows > 0 and drawn * log_unclean <= np.log(miss - rejected_share)):
        if drawn & WATCH_MASK == 0:
            board[DONE] = drawn
            if stopped(board):
                break
        i, j = sample_pair(seed, drawn, count)
        for root in range(solve_pair(bearings[i], bearings[j], points[i], points[j], yaws, translations)):
            yaw, translation = yaws[root], translations[root]
            if not reaches(yaw, translation, blocks, floors):
                continue
            for optimized in range(2 if local else 1):
                if optimized:
                    yaw = _optimize(yaw, translation, matches, bound_px, mask)
                inliers, support = score_inliers(yaw, translation, matches, bound_px, mask)
                score = support if msac else float(inliers)
                if score <= best:
                    break
                if rows == len(log):
                    longer = np.empty((2 * rows, 9))
                    copy_matrix(log, longer[:rows])
                    log = longer
                log[rows, 0], log[rows, 1], log[rows, 2], log[rows, 3] = drawn, i, j, yaw
                copy_vector(translation, log[rows, 4:7])
                log[rows, 7], log[rows, 8] = inliers, optimized
                rows, best = rows + 1, score
                log_unclean = np.log1p(-((inliers / count) ** 2))
                _set_floors(floors, int(np.floor(best)) + 1, count, rejected_share)
                if bounded and log_unclean < 0.0:
                    needed = np.ceil(np.log(miss - rejected_share) / log_unclean)
                    board[TOTAL] = np.int64(min(float(iterations), max(needed, 1.0)))
        drawn += 1
    board[DONE] = drawn
    reached = -np.expm1(drawn * log_unclean) - rejected_share if rows > 0 else 0.0
    return log[:rows], drawn, max(0.0, reached)
