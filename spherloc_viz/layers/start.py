"""The steps before any estimate: the matches as they come, and their bearings on the unit sphere."""

import numpy as np

from spherloc_viz import style
from spherloc_viz.layers.frame import Frame, RunView
from spherloc_viz.layers.primitives import Step


def frames(view: RunView) -> list[Frame]:
    """Problem and bearings."""
    problem = view.trace.problem
    count, lost = len(problem), int(np.count_nonzero(~problem.usable))
    grey = view.colors(style.UNDECIDED)
    everybody = ~view.nobody()
    known = ""
    if problem.truth_inliers is not None:
        wrong = count - int(np.count_nonzero(problem.truth_inliers))
        how = "by construction" if problem.image is None else "by the true pose"
        known = f", {wrong} of them wrong {how}" if wrong else f", all of them right {how}"
    note = f"{lost} pixels lie where the camera sees nothing and count as outliers." if lost else ""
    if count - lost > style.MAX_DRAWN_RAYS:
        note = f"The first {style.MAX_DRAWN_RAYS} of {count - lost:,} lines are drawn. {note}".strip()
    if problem.estimated_outlier_rate is not None:
        note += f" The front end expects about {100 * problem.estimated_outlier_rate:.0f} % to be wrong."
    note = " ".join([note, *problem.remarks]).strip()
    start = view.standing(np.eye(3))
    return [
        Frame(
            Step(
                "problem",
                "The matches",
                f"{count} pixels are matched to map points{known}; each line ties a bearing to its point. "
                f"Nothing is known about yaw or position yet, so the camera stands in the middle of the map.",
                "s v = R p + t   (Eq. 18)",
                note,
            ),
            start,
            grey,
            everybody,
        ),
        Frame(
            Step(
                "bearings",
                "Bearings on the unit sphere",
                f"The {problem.camera.model.replace('_', ' ')} camera turns each of its {count - lost} usable pixels "
                "into a direction, a dot on the unit sphere, whatever its lens. "
                "Gravity is known, so the sphere stands upright and only its yaw and position are open.",
                _lens_equation(problem.camera.model),
            ),
            start,
            grey,
            view.nobody(),
        ),
    ]


def _lens_equation(model: str) -> str:
    return {
        "mei": "v = (λx, λy, λ − ξ)   (Eq. 8-14)",
        "kannala_brandt": "θd = θ(1 + k1θ² + k2θ⁴ + k3θ⁶ + k4θ⁸)   (Eq. 3-7)",
        "double_sphere": "m = (x, y), mz from ξ and α; v = s (m, mz) − (0, 0, ξ)   (Usenko et al. 2018)",
        "eucm": "v ∝ (x, y, mz(α, β, x² + y²))   (Khomutenko et al. 2015)",
        "equirectangular": "lon = 2π(u/W − ½), lat = π(½ − v/H)   (Eq. 15-17)",
    }.get(model, "")
