"""Decides on a cause from the evidence. The order of the tests matters: each cause is easily confused with those that
are tested later, seldom with those that are tested before it."""

from dataclasses import replace

import numpy as np

from spherloc.diagnosis.causes import Cause, Diagnosis
from spherloc.diagnosis.evidence import (
    MIN_SDS,
    MISSED,
    STRONG,
    WIDER,
    Evidence,
    Fit,
    Narrow,
    Truth,
    certify,
    different,
    gather,
    gather_truth,
    measures_of,
    narrow_fit,
    undetermined,
)
from spherloc.diagnosis.words import describe
from spherloc.trace import RansacStage, Trace

MAX_NFA = 0.01
"""Largest NFA of a consensus that is believed."""
MIN_SUPPORT = 4
"""Least size of a consensus that is believed: two matches fix a pose, and a third one agrees too easily."""
MIN_RIGHT_RATE = 0.04
"""Least share of right matches that a right reference image gives: if no pose stands out although this share of the
matches would, the reference is wrong. Without the truth nothing else distinguishes this from too few inliers."""
MAX_FEW = 20
"""Of so few matches none may be right, whatever they were matched with."""
SPREAD = 1.5
"""The bound is too small if within twice the bound there are this many times more matches than within it: so it is with
a noise of 0.75 times the bound."""
CHANCE_SDS = 2.0
"""No match is right if the true pose explains no more than chance, plus this many standard deviations."""
TILT_SDS = 4.0
"""Gravity is off if the matches show a tilt beyond what the run allows for by this many standard deviations ..."""
MIN_TILT_IN_BOUNDS = 1.0
"""... and by this many noise bounds in the image: less does no harm. (A slightly wrong calibration tilts real images by
some tenths of a degree.)"""
AS_GOOD = 0.9
"""The tilted pose must have at least this share of the best level pose's support: the true one has more, but wrong
matches within the wider bound may have pulled it away."""
EQUAL = 0.88
"""Least ratio of the supports of two poses that count as equal; noise moves matches over the bound."""
TILT_RAD = np.radians(0.05)
"""A true gravity that is beyond what the run allows for by more than this explains a wrong, well supported pose."""
TO_BE_PROVEN = (Cause.FALSE_CONSENSUS, Cause.AMBIGUOUS, Cause.ITERATIONS_RAN_OUT, Cause.SEARCH_MISSED)
"""Causes whose evidence is complete only with a bound on every pose's support."""


def diagnose(trace: Trace, use_truth: bool = True) -> Diagnosis:
    """The cause that explains a run best, with evidence.

    Runs further experiments on the problem, some tens of milliseconds for 200 correspondences. ``use_truth`` looks at
    the problem's true pose and labels too, if it has them.
    """
    evidence = gather(trace)
    truth = gather_truth(trace, evidence.bound_px) if use_truth else None
    cause = without_truth(evidence) if truth is None else with_truth(evidence, truth)
    if cause is Cause.ITERATIONS_RAN_OUT and trace.stage(RansacStage) is None:
        cause = Cause.SEARCH_MISSED
    narrow = narrow_fit(trace) if cause in (Cause.TOO_FEW_INLIERS, Cause.WRONG_REFERENCE) else None
    if narrow is not None and believes(narrow, truth):
        cause = Cause.BOUND_TOO_LARGE
    certificate = certify(trace) if cause in TO_BE_PROVEN else trace.certificate
    diagnosis = describe(trace, evidence, truth, cause, certificate, narrow)
    return replace(diagnosis, measures=measures_of(evidence, certificate))


def without_truth(e: Evidence) -> Cause:
    """The cause as far as the matches alone show it."""
    best = 0 if e.best is None else e.best.support(e.bound_px)
    believed = stands_out(e, best)
    if believed and undetermined(e.rotation_sd_rad, e.position_sd_m):
        return Cause.DEGENERATE
    wide = e.free is not None and e.nfa(int(e.found(WIDER)), WIDER, fixed_by=3) < MAX_NFA
    tilt_rad = 0.0
    if e.tilted is not None and e.tilted.support(e.bound_px) >= max(MIN_SUPPORT, AS_GOOD * best):
        tilt_rad = e.tilted.tilt_rad
    if (believed or wide) and tilts(e, tilt_rad, TILT_SDS * e.tilted_sd_rad):
        return Cause.GRAVITY_OFF
    if e.free is not None and wide:
        free = e.free.support(e.bound_px)
        if e.found(2.0) >= SPREAD * max(1, free, best):
            return Cause.BOUND_TOO_SMALL
    if not believed and map_is_sparse(e, best):
        return Cause.MAP_TOO_SPARSE
    if not believed:
        expected = int(MIN_RIGHT_RATE * len(e.aligned.points))
        return Cause.WRONG_REFERENCE if stands_out(e, expected) else Cause.TOO_FEW_INLIERS
    second = 0 if e.alternative is None else e.alternative.support(e.bound_px)
    if stands_out(e, second) and second >= EQUAL * best:
        return Cause.AMBIGUOUS
    if stands_out(e, own := e.alternatives_own()) and own >= STRONG * best:
        return Cause.FALSE_CONSENSUS
    if missed(e, best):
        return Cause.ITERATIONS_RAN_OUT
    if looks_alike(e):
        return Cause.FALSE_CONSENSUS
    # The outcome asks for more: a pose that it doubts for that is not "ok".
    return Cause.DEGENERATE if e.reported_sd and undetermined(*(MIN_SDS * sd for sd in e.reported_sd)) else Cause.OK


def with_truth(e: Evidence, t: Truth) -> Cause:
    """The cause, given the true pose and which matches are right."""
    right = int(np.count_nonzero(t.right))
    many = stands_out(e, right, t.within)
    if not many and map_is_sparse(e, right):
        return Cause.MAP_TOO_SPARSE
    if right < 1 or right <= t.by_chance + CHANCE_SDS * np.sqrt(t.by_chance):
        return Cause.WRONG_REFERENCE if len(t.right) > MAX_FEW else Cause.TOO_FEW_INLIERS
    if not many:
        return Cause.TOO_FEW_INLIERS
    if undetermined(t.rotation_sd_rad, t.position_sd_m):
        return Cause.DEGENERATE
    if tilts(e, t.exact.tilt_rad, 0.0):
        return Cause.GRAVITY_OFF
    errors = t.fit.errors_px[t.right]
    within, twice = (np.count_nonzero(errors <= factor * e.bound_px) for factor in (1.0, 2.0))
    if twice >= SPREAD * max(1, within):
        return Cause.BOUND_TOO_SMALL
    true, other = t.fit.support(e.bound_px), _wrong_support(e, t.fit)
    if stands_out(e, other) and other >= EQUAL * true:
        return Cause.FALSE_CONSENSUS if true < EQUAL * other else Cause.AMBIGUOUS
    if t.success:
        return Cause.OK
    if missed(e, true):
        return Cause.ITERATIONS_RAN_OUT
    if t.exact.tilt_rad > e.believed_rad + TILT_RAD:
        return Cause.GRAVITY_OFF
    return Cause.DEGENERATE if undetermined(e.rotation_sd_rad, e.position_sd_m) else Cause.UNKNOWN


def stands_out(e: Evidence, size: int, wider: float = 1.0) -> bool:
    """Whether a consensus of that size, within ``wider`` times the noise bound, is more than chance explains."""
    return size >= MIN_SUPPORT and e.nfa(size, wider) < MAX_NFA


def believes(narrow: Narrow, truth: Truth | None) -> bool:
    """Whether the pose within a lower bound is more than chance explains and, where the truth is known, right."""
    wrong = truth is not None and different(narrow.fit.cam_from_map, truth.exact.cam_from_map)
    return narrow.fit.support(narrow.bound_px) >= MIN_SUPPORT and narrow.nfa < MAX_NFA and not wrong


def map_is_sparse(e: Evidence, right: int) -> bool:
    """Whether more matches are verified between the images but have no map point than there are ``right`` ones."""
    return e.verified_without_point > right


def tilts(e: Evidence, tilt_rad: float, slack_rad: float) -> bool:
    """Whether gravity is off by more than the run allows for, and by enough to matter."""
    excess = tilt_rad - e.believed_rad
    harm_px = excess * float(np.median(e.aligned.pixels_per_radian))
    return excess > slack_rad and harm_px > MIN_TILT_IN_BOUNDS * e.bound_px


def looks_alike(e: Evidence) -> bool:
    """Whether the run's pose rests on one thing in the view, which may stand elsewhere."""
    return e.spread is not None and e.spread.margin < 0.0


def missed(e: Evidence, best: int) -> bool:
    """Whether the run's pose explains clearly less than the best one."""
    return e.run is None or e.run.support(e.bound_px) < MISSED * best


def _wrong_support(e: Evidence, true: Fit) -> int:
    """Largest support of a pose that is clearly different from the true one."""
    fits = [fit for fit in (e.run, e.best, e.alternative) if fit is not None]
    wrong = [fit for fit in fits if different(fit.cam_from_map, true.cam_from_map)]
    return max((fit.support(e.bound_px) for fit in wrong), default=0)
