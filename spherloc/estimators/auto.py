"""auto: chooses between ``mc-exact`` and ``ransac-2p`` from what can be measured beforehand, and says why.

Where what comes out contradicts the given gravity, the pose is found without it.
"""

from dataclasses import dataclass, fields, replace

import numpy as np

from spherloc.bounds import Bounds, bounds_of
from spherloc.consensus.chance import chance_rate, nfa
from spherloc.consensus.two_point_search import TwoPointSearch, search_two_point
from spherloc.estimators.base import Clock, Estimate, check_positive
from spherloc.estimators.mc_exact import MAX_CORRESPONDENCES, ExactMaximumConsensus, McExactOptions
from spherloc.estimators.ransac import RansacOptions, TwoPointRansac
from spherloc.free_gravity import Contradiction, contradicts, without_gravity
from spherloc.geometry import pose, yaw_rotation
from spherloc.last_step import conclude
from spherloc.problem import AlignedProblem
from spherloc.refine import RefinementOptions, noise_of
from spherloc.trace import DecisionStage
from spherloc.types import BoolArray, FloatArray

PROBE_SAMPLES = 500
MAX_PROBE_SAMPLES = 5000
PROBE_CONFIDENCE = 0.99
MAX_FOR_CHEAP_PROOF = 500
"""Correspondences up to which the proof takes a few hundredths of a second where gravity is exact."""
SHARE_FOR_SAMPLING = 0.4
"""Share of matches within the noise bound of the probe's refined pose from which on sampling is safe though gravity is
uncertain: one sampled pair in six is right, and the proof would cost seconds."""
MAX_NFA_BY_CHANCE = 1e-6
"""Expected number of false alarms (NFA) of the size of the probe's consensus below which it is no chance."""
RANSAC_CONFIDENCE = 0.9999
RANSAC_SAMPLES = 100_000


@dataclass(frozen=True)
class AutoOptions(RefinementOptions):
    """Options of auto: those that all estimators share."""

    bound_px: float = 3.0
    """Bound on the noise of an inlier, px."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(self)


class Auto:
    """Registered as "auto"."""

    Options = AutoOptions

    @staticmethod
    def run(aligned: AlignedProblem, options: AutoOptions, bounds: Bounds, seed: int, clock: Clock) -> Estimate:
        """Probe, choose, run what was chosen; its stages follow the decision."""
        with clock.stage("decision"):
            probe = search_two_point(
                aligned,
                bounds.pixels,
                seed,
                _probe_samples(aligned),
                PROBE_CONFIDENCE,
                local_optimization=True,
                watch=clock.watch,
            )
            decision = _decide(aligned, bounds, probe)
        # With uncertain gravity the exact search takes seconds: too much where sampling is safe, or gravity is wrong.
        early = decision.chosen == "mc-exact" and aligned.gravity_bound_rad > 0.0
        if early:
            best, inliers = _best_of(aligned, bounds, probe, options)
            share = np.count_nonzero(inliers) / len(inliers)
            if share >= SHARE_FOR_SAMPLING:
                early, decision = False, _sampled(decision, share, len(inliers))
            elif wrong := _gravity_fault(aligned, best, inliers, options, clock):
                return _without_gravity(aligned, wrong, decision, options)
        shared = {item.name: getattr(options, item.name) for item in fields(options)}
        if decision.chosen == "mc-exact":
            result = ExactMaximumConsensus.run(aligned, McExactOptions(**shared), bounds, seed, clock)
        else:
            sampling = RansacOptions(
                **shared,
                iterations=RANSAC_SAMPLES,
                confidence=RANSAC_CONFIDENCE,
                scoring="msac",
                local_optimization=True,
            )
            result = TwoPointRansac.run(aligned, sampling, bounds, seed, clock)
        if not early and (wrong := _gravity_fault(aligned, result.cam_from_map, result.inlier_mask, options, clock)):
            return _without_gravity(aligned, wrong, decision, options)
        return Estimate(
            (decision, *result.stages),
            result.cam_from_map,
            result.inlier_mask,
            result.reason,
            result.note,
            result.certificate,
        )


def _sampled(decision: DecisionStage, share: float, count: int) -> DecisionStage:
    """The decision for sampling where a proof would cost seconds and this ``share`` of ``count`` matches agrees."""
    reason = (
        f"{100 * share:.0f} % of {count:,} matches agree within the noise bound, so that sampling finds the pose. With "
        "uncertain gravity the proof would take seconds; mc-exact gives it."
    )
    return replace(decision, chosen="ransac-2p", reason=reason)


def _best_of(
    aligned: AlignedProblem, bounds: Bounds, probe: TwoPointSearch, options: AutoOptions
) -> tuple[FloatArray | None, BoolArray]:
    """The probe's best pose (3, 4), refined, if it has one, and the mask (M,) of its inliers."""
    if not probe.found:
        return None, np.zeros(len(aligned.points), dtype=bool)
    best = int(np.argmax(probe.support))
    start = pose(yaw_rotation(probe.yaws_rad[best]), probe.translations[best])
    return conclude(aligned, [start], bounds, options)[:2]


def _gravity_fault(
    aligned: AlignedProblem, cam_from_map: FloatArray | None, inliers: BoolArray, options: AutoOptions, clock: Clock
) -> Contradiction | None:
    """What shows the given gravity to be beyond its bound; None where nothing does, or nothing is known of gravity."""
    noise = noise_of(aligned, options)
    if not np.isfinite(noise.gravity_sd_rad):
        return None
    with clock.stage("gravity"):
        return contradicts(aligned, cam_from_map, inliers, float(options.bound_px), noise.sd_px)


def _without_gravity(
    aligned: AlignedProblem, wrong: Contradiction, decision: DecisionStage, options: AutoOptions
) -> Estimate:
    """The estimate where gravity is beyond its bound: the pose that shows it, refined without gravity."""
    more = f": {wrong.support} different matches agree without it, {wrong.believed_support} with it"
    note = (
        f"Gravity is off by {np.degrees(wrong.tilt_rad):.3g}°, beyond its bound of "
        f"{np.degrees(aligned.gravity_bound_rad):.2g}°{more if wrong.support > wrong.believed_support else ''}. The "
        "pose is found without it."
    )
    free = without_gravity(aligned)
    state, mask, refinement = conclude(
        free, [wrong.cam_from_map], bounds_of(free, float(options.bound_px)), replace(options, gravity_sd_deg=np.inf)
    )
    told = replace(decision, reason=f"{decision.reason} {note}")
    return Estimate((told, refinement), state, mask, note=note)


def _probe_samples(aligned: AlignedProblem) -> int:
    """Enough to meet two inliers (Eq. 28) if there are as few as the front end expects, and never less than usual."""
    if aligned.estimated_outlier_rate is None:
        return PROBE_SAMPLES
    clean = (1.0 - aligned.estimated_outlier_rate) ** 2
    needed = np.log1p(-PROBE_CONFIDENCE) / np.log1p(-clean) if 0.0 < clean < 1.0 else 0.0 if clean else np.inf
    return int(np.clip(needed, PROBE_SAMPLES, MAX_PROBE_SAMPLES))


def _decide(aligned: AlignedProblem, bounds: Bounds, probe: TwoPointSearch) -> DecisionStage:
    count = len(aligned.bearings)
    support = int(probe.support.max(initial=0))
    chance = nfa(count, support, chance_rate(aligned.bearings, bounds.radians))
    expected = aligned.estimated_outlier_rate
    guess = "" if expected is None else f", and the front end expects {100 * (1 - expected):.0f} %"
    share = (
        f"{100 * support / count:.0f} % of {count:,} matches agree with the best of {probe.drawn} sampled pairs{guess}"
    )
    if count > MAX_CORRESPONDENCES:
        chosen, reason = "ransac-2p", f"{count:,} matches are too many for an exact search."
    elif count <= MAX_FOR_CHEAP_PROOF:
        chosen, reason = "mc-exact", f"{count:,} matches are few enough to prove the answer in a moment."
    elif chance < MAX_NFA_BY_CHANCE:
        chosen, reason = "ransac-2p", f"{share}, which is no chance: sampling finds the pose and is faster."
    else:
        chosen, reason = "mc-exact", f"only {share}, which may be chance: all poses must be searched."
    return DecisionStage(
        chosen=chosen,
        reason=reason[0].upper() + reason[1:],
        samples=probe.drawn,
        inlier_rate=float(np.float64(support) / count),
    )
