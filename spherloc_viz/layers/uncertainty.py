"""How far a refined pose may be off, by its covariance, in words and as a table."""

import numpy as np

from spherloc.trace import RefinementStage
from spherloc_viz.layers.primitives import FloatArray, Table


def rms(stage: RefinementStage) -> tuple[float, float] | None:
    """Root mean square of the angle (degrees) and the distance (cm) by which the pose is off; None if unknown."""
    variance = np.diagonal(stage.covariance)
    if not np.isfinite(variance).all():
        return None
    return float(np.degrees(np.sqrt(variance[:3].sum()))), float(100.0 * np.sqrt(variance[3:].sum()))


def spread(stage: RefinementStage) -> str:
    """The same in words."""
    known = rms(stage)
    return "unknown: the inliers leave it open" if known is None else f"{known[0]:.3f}° and {known[1]:.2f} cm RMS"


def tilt(stage: RefinementStage) -> str:
    """What became of the given gravity, as a sentence."""
    if stage.gravity_sd_rad == 0.0:
        return "The given gravity is kept."
    leans = f"The camera leans {np.degrees(stage.tilt_rad):.3f}° from the given gravity"
    if np.isinf(stage.gravity_sd_rad):
        return f"{leans}, which was not used."
    return f"{leans}, which was trusted to {np.degrees(stage.gravity_sd_rad):.3g}° (standard deviation)."


def table(stage: RefinementStage) -> Table:
    """Standard deviations by axis."""
    deviations = np.sqrt(np.diagonal(stage.covariance))
    rows = (
        ("rotation about x, y, z", _listed(np.degrees(deviations[:3]), "{:.3f}°")),
        ("position x, y, z", _listed(100.0 * deviations[3:], "{:.2f} cm")),
        ("tilt", f"{np.degrees(stage.tilt_rad):.3f}°"),
    )
    return Table("standard deviations", ("", "camera, map frame"), rows)


def _listed(values: FloatArray, form: str) -> str:
    return ", ".join(form.format(value) if np.isfinite(value) else "open" for value in values)
