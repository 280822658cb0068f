"""mc-exact: the largest consensus of all poses within the gravity bound, with a certificate.

Two exact searches share what they find: one over yaw that compares pairs of correspondences
(``consensus.exact``; gravity exact, few correspondences or few inliers), and one over camera positions, yaw and tilt
(``consensus.positions``), which needs memory for the correspondences only. Each starts from the other's best pose;
after a comparison of pairs the search over positions leaves out the yaws that it has excluded. Both begin with a pose
within the gravity bound that explains many matches within the noise bound alone, from 2P-RANSAC and, where gravity is
uncertain, robust fits to its hypotheses.
"""

from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np
from numpy.typing import NDArray

from spherloc.bounds import Bounds
from spherloc.consensus.chance import chance_rate, nfa
from spherloc.consensus.exact import ExactConsensus, exact_consensus
from spherloc.consensus.level_pose import SAME_CONSENSUS
from spherloc.consensus.pose_cells import TILT_A, PackedMatches, pack_matches, parameters_of, pose_of
from spherloc.consensus.positions import PositionSearch, search_positions
from spherloc.consensus.two_point_search import TwoPointSearch, search_two_point
from spherloc.errors import InputError
from spherloc.estimators.base import Clock, Estimate, check_positive
from spherloc.gauss_newton import MIN_FOR_SIX_DOF, ROBUST_CAUCHY, Noise, polish
from spherloc.geometry import level_poses, pose, yaw_of, yaw_rotation
from spherloc.last_step import conclude
from spherloc.problem import AlignedProblem
from spherloc.refine import RefinementOptions, matches_of, residuals_px
from spherloc.solvers.p3p import p3p
from spherloc.solvers.two_point import two_point
from spherloc.trace import Certificate, ConsensusStage, PositionStage, Stage
from spherloc.types import FloatArray, IntArray
from spherloc.watch import working_s

MAX_CORRESPONDENCES = 200_000
"""Some ten seconds and 1 GB."""
MAX_FOR_PAIRS = 200
"""Correspondences up to which pairs are compared first: they decide in milliseconds where most matches are wrong."""
FEW_INLIERS, FEW_TIMES_ALL = 35, 65_000
"""Of more correspondences pairs come first where the best known pose explains so few, and few times all is no more:
there they are faster by far, and with more they would be slow where the noise is large (measured for 250 to 3000)."""
SEED_SAMPLES = 20_000
"""Most samples of the 2P-RANSAC that finds the first lower bound: enough at 1.5 % inliers, and some milliseconds."""
PAIR_SAMPLES, MAX_FOR_PAIR_SAMPLES = 500, 1000
"""Most samples where so many correspondences or fewer have an exact gravity: they miss what pairs find as fast."""
MIN_SAMPLES = 100
SEED_CONFIDENCE = 0.99
FIRST_STARTS = 3
"""Hypotheses of the sampling, the last ones, that are tried where gravity is uncertain."""
FIRST_BOUNDS, ROUNDS_PER_BOUND, STEPS_PER_ROUND = 5, 2, 10
"""Of their fits: bounds from the widened one to that of the noise, choices of inliers at each, and steps on each
choice."""
MAX_PAIR_STARTS, PAIR_STARTS_EFFORT = 100, 5000
"""Pairs whose 2P poses are tried where the search takes long and gravity is uncertain: the most, and the most matches
that all of them are fitted to."""
MAX_TRIPLES, MAX_TILT_IN_BOUNDS = 1000, 2.0
"""Triples whose P3P poses are tried there too, at most, and the largest tilt of such a pose, in gravity bounds: with
noise in three matches it may be beyond the bound although that of the best pose is not."""
YAW_BINS = 1440
MAX_LEVELS, MAX_BOXES = 12, 200
"""Of the boxes that are kept for the picture."""


@dataclass(frozen=True)
class McExactOptions(RefinementOptions):
    """Options of mc-exact."""

    bound_px: float = 3.0
    """Bound on the noise of an inlier, px."""
    effort: float = 1.0
    """Share of the usual effort after which the search stops and reports the gap that is left; usual is some seconds,
    and more than all but very repetitive problems, or those with hardly an inlier, need."""
    time_budget_s: float = 60.0
    """Seconds after which it stops too, compiling not counted. Runs that do not reach it give the same result on every
    machine."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(self)


PAIR_EFFORT = 20_000_000
"""Words touched by the search over pairs for an ``effort`` of 1."""
POSITION_EFFORT, EACH_POSITION_EFFORT = 60_000_000, 1000
"""Matches tested by the search over positions for an ``effort`` of 1: in all, or for each match if that is more."""
MAX_EFFORT = 1 << 50
"""Months of work; more does not fit into the kernels' counters."""


class ExactMaximumConsensus:
    """Registered as "mc-exact"."""

    Options = McExactOptions

    @staticmethod
    def run(aligned: AlignedProblem, options: McExactOptions, bounds: Bounds, seed: int, clock: Clock) -> Estimate:
        """Guess by 2P-RANSAC, search all poses, refine, certify. ``seed`` is that of the RANSAC."""
        count = len(aligned.bearings)
        if count > MAX_CORRESPONDENCES:
            raise InputError(
                f"mc-exact takes up to {MAX_CORRESPONDENCES:,} correspondences, not {count:,}; thin them or use "
                "ransac-2p."
            )
        is_quick = aligned.gravity_bound_rad == 0.0 and count <= MAX_FOR_PAIR_SAMPLES
        most = PAIR_SAMPLES if is_quick else SEED_SAMPLES
        samples = max(MIN_SAMPLES, round(min(1.0, options.effort) * most))
        with clock.stage("guess", until=0.1):
            guess = search_two_point(
                aligned, bounds.pixels, seed, samples, SEED_CONFIDENCE, local_optimization=True, watch=clock.watch
            )
            start = first_pose(aligned, bounds, guess)
        rate = chance_rate(aligned.bearings, bounds.radians)
        with clock.stage("consensus"):
            found = _search(aligned, bounds, rate, guess, start, options, clock)
        stage = _stage(aligned, bounds, start, found)
        stages: tuple[Stage, ...] = (stage,) if found.positions is None else (stage, found.positions)
        if found.pose is None:
            certificate = Certificate(found.upper, 1, nfa(count, 1, rate))
            reason = "No pose: no pair of correspondences has a solution in front of the camera."
            return Estimate(stages, None, np.zeros(count, dtype=bool), reason, certificate=certificate)
        with clock.stage("refinement", until=1.0):
            starts = [
                found.pose,
                *_alternatives(found.pairs),
                *(pose(yaw_rotation(yaw), at) for yaw, at in _poses(guess)),
            ]
            refined, inliers, refinement = conclude(aligned, starts, bounds, options)
        lower = _lower_bound(aligned, bounds, int(stage.support[0]), refined, refinement.tilt_rad)
        certificate = Certificate(max(found.upper, lower), lower, nfa(count, lower, rate))
        return Estimate((*stages, refinement), refined, inliers, certificate=certificate)


@dataclass(frozen=True, eq=False)
class _Found:
    """What both searches found together."""

    pose: FloatArray | None
    """(3, 4) between the aligned frames, within the gravity bound."""
    upper: int
    """No pose explains more."""
    pairs: ExactConsensus | None
    """Of the search over pairs, if it ran."""
    effort: int
    """Of both."""
    positions: PositionStage | None = None
    """Boxes of the search over positions, if it ran and split any."""


def _search(
    aligned: AlignedProblem,
    bounds: Bounds,
    rate: float,
    guess: TwoPointSearch,
    start: tuple[FloatArray, int] | None,
    options: McExactOptions,
    clock: Clock,
) -> _Found:
    """Pairs where they are faster, then positions unless all is proven."""
    deadline = working_s() + options.time_budget_s
    count, known = len(aligned.bearings), 1 if start is None else start[1]
    few = known <= FEW_INLIERS and known * count <= FEW_TIMES_ALL
    pairs, effort, yaw_bound = None, 0, None
    if aligned.gravity_bound_rad == 0.0 and (count <= MAX_FOR_PAIRS or few):
        pairs = exact_consensus(
            aligned,
            bounds,
            rate,
            _poses(guess),
            int(min(options.effort * PAIR_EFFORT, MAX_EFFORT)),
            options.time_budget_s,
            clock.watch,
        )
        effort, yaw_bound = pairs.effort, pairs.bound
        if len(pairs.poses):
            support = supported(aligned, pairs.poses[0], bounds.noise_px)
            if support > known:
                start = pairs.poses[0], support
        upper = int(pairs.bound.max(initial=1))
        if upper <= (1 if start is None else start[1]):
            return _Found(None if start is None else start[0], upper, pairs, effort)
    clock.watch.begin("search", 0.98)
    matches = pack_matches(aligned, bounds.noise_px)
    found = search_positions(
        aligned,
        matches,
        start,
        int(min(options.effort * max(POSITION_EFFORT, EACH_POSITION_EFFORT * len(aligned.points)), MAX_EFFORT)),
        deadline,
        yaw_bound,
        clock.watch,
        lambda: _another(aligned, bounds, matches, guess),
    )
    upper = found.upper if pairs is None else min(found.upper, int(pairs.bound.max(initial=1)))
    return _Found(found.pose, upper, pairs, effort + found.effort, _boxes(found))


def _boxes(found: PositionSearch) -> PositionStage | None:
    """Some levels of the search's boxes, of each those that might explain most."""
    levels, left = np.unique(found.level, return_counts=True)
    if not len(levels):
        return None
    rows, counts = [], []
    for k in np.unique(np.linspace(0, len(levels) - 1, MAX_LEVELS).round().astype(int)):
        mine = np.flatnonzero(found.level == levels[k])
        mine = mine[np.argsort(-found.box_bound[mine], kind="stable")][:MAX_BOXES]
        rows.append(mine)
        counts.append(np.full(len(mine), left[k], np.int32))
    chosen = np.concatenate(rows)
    return PositionStage(
        boxes_m=found.boxes_m[chosen].astype(np.float32),
        level=found.level[chosen],
        bound=found.box_bound[chosen],
        left=np.concatenate(counts),
        support=found.support,
        upper_bound=found.upper,
    )


def _alternatives(pairs: ExactConsensus | None) -> list[FloatArray]:
    """The clearly different poses (3, 4) that the search over pairs verified beside the best one."""
    return [] if pairs is None else list(pairs.poses[1:])


def _poses(guess: TwoPointSearch) -> list[tuple[float, FloatArray]]:
    """The best pose of a search, if it found any."""
    if not guess.found:
        return []
    best = int(np.argmax(guess.support))
    return [(float(guess.yaws_rad[best]), guess.translations[best])]


def _lower_bound(aligned: AlignedProblem, bounds: Bounds, lower: int, refined: FloatArray, tilt_rad: float) -> int:
    """What a pose within the gravity bound surely explains: ``lower``, or as much as the refined one."""
    if tilt_rad <= aligned.gravity_bound_rad + 1e-12:
        lower = max(lower, supported(aligned, refined, bounds.noise_px))
    return lower


def _stage(
    aligned: AlignedProblem, bounds: Bounds, start: tuple[FloatArray, int] | None, found: _Found
) -> ConsensusStage:
    pairs, best = found.pairs, 1 if start is None else start[1]
    poses = [] if found.pose is None else [found.pose]
    poses += [] if pairs is None else list(pairs.poses)
    poses, masks = _different(aligned, bounds, poses)
    supports = np.array([np.count_nonzero(mask) for mask in masks], dtype=np.int32)
    most = int(supports.max(initial=1))
    bound = np.full(YAW_BINS, found.upper, np.int32)
    clique = np.flatnonzero(masks[0]) if masks else np.empty(0, np.int64)
    if pairs is not None:
        bound = np.minimum(pairs.bound_over_yaw(YAW_BINS), found.upper)
        clique = pairs.clique if len(pairs.clique) > len(clique) else clique
    return ConsensusStage(
        arcs=0 if pairs is None else pairs.arcs,
        seed_support=best if start is not None else 0,
        bound=bound,
        effort=found.effort,
        finished=found.upper <= most,
        yaw_rad=yaw_of(poses[0][:, :3]) if poses else 0.0,
        clique=aligned.index[clique].astype(np.int32),
        cam_from_map=aligned.unalign_poses(np.array(poses).reshape(-1, 3, 4)),
        support=supports,
    )


def _different(
    aligned: AlignedProblem, bounds: Bounds, poses: list[FloatArray]
) -> tuple[list[FloatArray], list[NDArray[np.bool_]]]:
    """Poses that explain mostly other matches than better ones do, best first, and masks (M,) of what they explain."""
    masks = [residuals_px(aligned, pose) <= bounds.noise_px for pose in poses]
    kept: list[int] = []
    for k in sorted(range(len(poses)), key=lambda k: -np.count_nonzero(masks[k])):
        fewest = SAME_CONSENSUS * np.count_nonzero(masks[k])
        if all(np.count_nonzero(masks[k] & masks[other]) < fewest for other in kept):
            kept.append(k)
    return [poses[k] for k in kept], [masks[k] for k in kept]


def supported(aligned: AlignedProblem, cam_from_map: FloatArray, bound_px: float) -> int:
    """How many matches a pose (3, 4) explains."""
    return int(np.count_nonzero(residuals_px(aligned, cam_from_map) <= bound_px))


def first_pose(aligned: AlignedProblem, bounds: Bounds, guess: TwoPointSearch) -> tuple[FloatArray, int] | None:
    """A pose (3, 4) within the gravity bound and what it explains, from a search that took gravity as exact."""
    if not guess.found:
        return None
    best = np.argsort(-guess.support, kind="stable")[: FIRST_STARTS if aligned.gravity_bound_rad > 0.0 else 1]
    poses = list(level_poses(guess.yaws_rad[best], guess.translations[best]))
    if aligned.gravity_bound_rad > 0.0:
        matches = pack_matches(aligned, bounds.noise_px)
        poses += [tilted for level in poses for tilted in _narrowed(aligned, bounds, matches, level)]
    counts = [supported(aligned, one, bounds.noise_px) for one in poses]
    most = int(np.argmax(counts))
    return (poses[most], counts[most]) if counts[most] > 1 else None


def _another(
    aligned: AlignedProblem, bounds: Bounds, matches: PackedMatches, guess: TwoPointSearch
) -> tuple[FloatArray, int] | None:
    """Where gravity is uncertain, the best of the robust fits to 2P poses of pairs and to P3P poses of triples: a pose
    (3, 4) within the gravity bound, and what it explains. All pairs and triples are tried or, if these are many, some
    of the matches that the guess explains."""
    size = len(aligned.points)
    most = min(MAX_PAIR_STARTS, PAIR_STARTS_EFFORT // size)
    if aligned.gravity_bound_rad == 0.0 or not guess.found or most == 0:
        return None
    ((yaw, translation),) = _poses(guess)
    explained = np.flatnonzero(residuals_px(aligned, pose(yaw_rotation(yaw), translation)) <= bounds.pixels)
    pairs = _samples(size, 2, explained, most)
    yaws, translations, exists = two_point(aligned.bearings[pairs], aligned.points[pairs])
    triples = _samples(size, 3, explained, MAX_TRIPLES)
    tilted, _ = p3p(aligned.bearings[triples], aligned.points[triples])
    tilts = np.arccos(np.clip(tilted[:, 1, 1], -1.0, 1.0))
    upright = np.argsort(tilts, kind="stable")[:most]
    tilted = tilted[upright[tilts[upright] <= MAX_TILT_IN_BOUNDS * aligned.gravity_bound_rad]]
    best = None
    for start in (*level_poses(yaws[exists], translations[exists]), *tilted):
        within = within_gravity(matches, start, aligned.gravity_bound_rad)
        for found in (within, *_narrowed(aligned, bounds, matches, start)):
            count = supported(aligned, found, bounds.noise_px)
            if best is None or count > best[1]:
                best = found, count
    return best


def _samples(size: int, each: int, explained: IntArray, most: int) -> IntArray:
    """All samples (S, ``each``) of that many of ``size`` matches or, if they are more than ``most``, up to as many of
    the ``explained`` ones (K,) at random."""
    if comb(size, each) <= most:
        return np.array(list(combinations(range(size), each)), dtype=np.int64).reshape(-1, each)
    drawn = np.random.default_rng(0).choice(explained, (most, each))
    ordered = np.sort(drawn, axis=1)
    return drawn[(np.diff(ordered, axis=1) > 0).all(axis=1)]


def within_gravity(matches: PackedMatches, cam_from_map: FloatArray, gravity_bound_rad: float) -> FloatArray:
    """The pose (3, 4), or one with the same position whose tilt is just within the gravity bound."""
    chart, at = parameters_of(matches, cam_from_map)
    tilt = float(np.arccos(min(1.0, np.cos(at[TILT_A]) * np.cos(at[TILT_A + 1]))))
    if tilt <= gravity_bound_rad:
        return cam_from_map
    # cos a cos c falls with both, and (a, c) scaled by bound / tilt is within.
    at[TILT_A:] *= gravity_bound_rad / tilt * (1.0 - 1e-9)
    while np.cos(at[TILT_A]) * np.cos(at[TILT_A + 1]) < np.cos(gravity_bound_rad):
        at[TILT_A:] *= 1.0 - 1e-3
    return pose_of(matches, chart, at)


def _narrowed(
    aligned: AlignedProblem, bounds: Bounds, matches: PackedMatches, cam_from_map: FloatArray
) -> list[FloatArray]:
    """Poses (3, 4) within the gravity bound from robust fits in six degrees of freedom at narrowing bounds."""
    plain_matches = matches_of(aligned)
    widest = float(np.median(bounds.pixels))
    rotation, translation = cam_from_map[:, :3].copy(), cam_from_map[:, 3].copy()
    found = []
    for limit_px in np.geomspace(widest, bounds.noise_px, FIRST_BOUNDS):
        for _ in range(ROUNDS_PER_BOUND):
            chosen = residuals_px(aligned, pose(rotation, translation)) <= limit_px
            if np.count_nonzero(chosen) < MIN_FOR_SIX_DOF:
                return found
            noise = Noise(float(limit_px / 3.0), aligned.gravity_bound_rad / 3.0)
            polish(plain_matches, chosen, rotation, translation, noise, ROBUST_CAUCHY, STEPS_PER_ROUND)
        found.append(within_gravity(matches, pose(rotation, translation), aligned.gravity_bound_rad))
    return found
