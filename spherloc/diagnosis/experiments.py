"""Further runs on a problem that show what its own run could not. Poses are between the aligned frames."""

from dataclasses import dataclass, fields, replace

import numpy as np

from spherloc.bounds import bounds_of
from spherloc.consensus.two_point_search import search_two_point
from spherloc.estimators.base import estimate
from spherloc.estimators.mc_exact import McExactOptions
from spherloc.gauss_newton import tilt_of
from spherloc.geometry import pose, yaw_rotation
from spherloc.problem import AlignedProblem
from spherloc.refine import RefinementOptions, refine, residuals_px
from spherloc.trace import Certificate, Trace
from spherloc.types import BoolArray, FloatArray

SAMPLES = 20_000
"""Most samples of a search: 99 % sure to draw two of 1.5 % right matches together. A confidence ends it earlier."""
MOST_WORK = 20_000_000
"""Samples times correspondences; above it the search draws fewer."""
CONFIDENCE = 0.9999
MOST_TILT_RAD = np.radians(12.0)
"""Gravity errors up to this are looked for."""
WIDER = 4.0
"""A noise bound that is too small is looked for up to this many times as much."""
MOST_CERTIFIED = 500
"""Correspondences up to which a run without a certificate is given one."""
EFFORT = 0.3
"""Of an exact search: enough where a pose stands out, and little where many are alike."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A pose and what it explains."""

    cam_from_map: FloatArray
    """(3, 4)."""
    errors_px: FloatArray
    """(M,) reprojection errors."""

    def support(self, bound_px: float) -> int:
        """How many correspondences are within a bound."""
        return int(np.count_nonzero(self.errors_px <= bound_px))

    @property
    def tilt_rad(self) -> float:
        """Angle between the given gravity and the pose's."""
        return float(tilt_of(self.cam_from_map))


def fit_of(aligned: AlignedProblem, cam_from_map: FloatArray) -> Fit:
    """A pose (3, 4) with its errors."""
    return Fit(cam_from_map, residuals_px(aligned, cam_from_map))


def search(aligned: AlignedProblem, bound_px: float, options: RefinementOptions) -> FloatArray | None:
    """The pose (3, 4) that a long 2P-RANSAC finds, refined; None if no sample has a pose."""
    bounds = bounds_of(aligned, bound_px)
    samples = min(SAMPLES, MOST_WORK // len(aligned.points))
    found = search_two_point(aligned, bounds.pixels, 0, samples, CONFIDENCE, local_optimization=True)
    if not found.found:
        return None
    best = int(np.argmax(found.support))
    start = pose(yaw_rotation(found.yaws_rad[best]), found.translations[best])
    return refine(aligned, start, bounds, options)[0]


def subset(aligned: AlignedProblem, mask: BoolArray) -> AlignedProblem:
    """The masked correspondences alone."""
    names = ("index", "bearings", "points", "pixel_from_bearing", "radians_per_pixel")
    return replace(aligned, **{name: np.ascontiguousarray(getattr(aligned, name)[mask]) for name in names})


def alternative(aligned: AlignedProblem, best: Fit, bound_px: float, options: RefinementOptions) -> Fit | None:
    """The pose that explains most of what ``best`` is far from explaining, with its support among all."""
    rest = best.errors_px > 3.0 * bound_px
    if np.count_nonzero(rest) < 2:
        return None
    found = search(subset(aligned, rest), bound_px, options)
    return None if found is None else fit_of(aligned, found)


def certify(trace: Trace) -> Certificate | None:
    """The run's certificate, or that of an exact search of its problem; None if that has too many correspondences."""
    if trace.certificate is not None or len(trace.problem) > MOST_CERTIFIED:
        return trace.certificate
    given = {item.name: getattr(trace.options, item.name) for item in fields(RefinementOptions)}
    options = McExactOptions(bound_px=trace.options.bound_px, effort=EFFORT, **given)
    return estimate(trace.problem, "mc-exact", options).certificate


def free_fit(aligned: AlignedProblem, starts: list[FloatArray], bound_px: float) -> Fit | None:
    """The pose with the most support within ``WIDER`` times the bound where gravity is not believed.

    From ``starts``, and from a search that allows for a wrong gravity and tightens its bound step by step.
    """
    free = replace(aligned, gravity_bound_rad=0.0, gravity_sd_rad=np.inf)
    wide, options = WIDER * bound_px, RefinementOptions(gravity_sd_deg=np.inf)
    steps = wide + float(np.median(aligned.pixels_per_radian)) * MOST_TILT_RAD * 0.5 ** np.arange(5)
    loose = search(replace(aligned, gravity_bound_rad=MOST_TILT_RAD), wide, options)
    fits = []
    for start, levels in [(start, ()) for start in starts] + ([] if loose is None else [(loose, steps)]):
        for level in (*levels, wide):
            start = refine(free, start, bounds_of(free, float(level)), options)[0]
        fits.append(fit_of(aligned, start))
    return max(fits, key=lambda fit: fit.support(wide), default=None)
