"""A run's evidence as a few numbers, alike for every problem and estimator, so that many runs can be compared."""

import numpy as np

from spherloc.diagnosis.causes import Measures
from spherloc.diagnosis.evidence import Evidence
from spherloc.problem import AlignedProblem
from spherloc.trace import Certificate
from spherloc.types import BoolArray

BANDS, SECTORS = 6, 8
"""Cells of equal area on the unit sphere: bands of equal height by sectors of equal angle."""


def measures_of(e: Evidence, certificate: Certificate | None) -> Measures:
    """The numbers of a run that has been looked at; those that it cannot have are None."""
    median = high = coverage = None
    best = 0 if e.best is None else e.best.support(e.bound_px)
    if e.run is not None:
        inliers = e.run.errors_px <= e.bound_px
        if inliers.any():
            median, high = (float(q) / e.bound_px for q in np.quantile(e.run.errors_px[inliers], (0.5, 0.9)))
            coverage = _coverage(e.aligned, inliers)
    other = None if e.alternative is None else e.alternative.support(e.bound_px)
    return Measures(
        residual_median=median,
        residual_p90=high,
        alternative_support=None if other is None or not best else other / best,
        certificate_gap=None
        if certificate is None or certificate.upper_bound <= 0
        else certificate.gap / certificate.upper_bound,
        tilt_deg=None if e.free is None else float(np.degrees(e.free.tilt_rad)),
        coverage=coverage,
        rotation_sd_deg=_finite(np.degrees(e.rotation_sd_rad)),
        position_sd_m=_finite(e.position_sd_m),
    )


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _coverage(aligned: AlignedProblem, inliers: BoolArray) -> float:
    """Share of the cells with bearings that have inliers (M,) too."""
    x, y, z = aligned.bearings.T
    band = np.clip((0.5 * (1.0 + y) * BANDS).astype(int), 0, BANDS - 1)
    sector = np.clip((0.5 * (1.0 + np.arctan2(x, z) / np.pi) * SECTORS).astype(int), 0, SECTORS - 1)
    cells = SECTORS * band + sector
    return len(np.unique(cells[inliers])) / len(np.unique(cells))
