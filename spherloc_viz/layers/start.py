"""The steps before any estimate: the matches, their bearings on the unit sphere, and the unknowns that remain."""

from collections.abc import Callable
from functools import partial

import numpy as np

from spherloc.cameras.base import model_name
from spherloc.geometry import camera_centre
from spherloc.problem import Problem
from spherloc_viz import style
from spherloc_viz.layers import ring
from spherloc_viz.layers.frame import CAMERA_ROOM, Frame, Plan, RunView, one_color, sphere_box
from spherloc_viz.layers.primitives import Focus, Label, SceneItem, Segments


def plans(view: RunView) -> list[Plan]:
    """Steps for the problem, the bearings, one match, gravity, and the four unknowns. None of them tells what came
    out."""
    drawn: tuple[tuple[str, str, Callable[[RunView], Frame]], ...] = (
        ("problem", "The matches", _problem),
        ("bearings", "Bearings on the unit sphere", _bearings),
        ("match", "One match is one ray", _match),
        ("gravity", "What gravity gives", _gravity),
        ("unknowns", "What gravity leaves open", _unknowns),
    )
    return [Plan(key, title, partial(draw, view), untold=partial(draw, view)) for key, title, draw in drawn]


def _lost(problem: Problem) -> int:
    """Number of matches whose pixels have no bearing."""
    return int(np.count_nonzero(~problem.usable))


def _problem(view: RunView) -> Frame:
    problem = view.trace.problem
    count, lost = len(problem), _lost(problem)
    known = ""
    if problem.truth_inliers is not None:
        wrong = count - int(np.count_nonzero(problem.truth_inliers))
        how = "by construction" if problem.image is None else "by the true pose"
        known = f", {wrong} of them wrong {how} (red)" if wrong else f", all of them right {how}"
    return Frame(
        f"{count} pixels are matched to map points{known}; each line ties a bearing to its point. "
        f"Nothing is known about yaw or position yet, so the camera stands in the middle of the map.",
        "s v = R p + t   (Eq. 18)",
        view.standing(np.eye(3)),
        view.colors(style.UNDECIDED),
        ~view.no_matches(),
        note=_problem_note(problem, count, lost),
    )


def _problem_note(problem: Problem, count: int, lost: int) -> str:
    note = f"{lost} pixels lie where the camera sees nothing and count as outliers." if lost else ""
    if count - lost > style.MAX_DRAWN_RAYS:
        note = f"{style.MAX_DRAWN_RAYS} of {count - lost:,} lines are drawn, evenly. {note}".strip()
    if problem.estimated_outlier_rate is not None:
        note += f" The front end expects about {100 * problem.estimated_outlier_rate:.0f} % to be wrong."
    return " ".join([note, *problem.remarks]).strip()


def _bearings(view: RunView) -> Frame:
    problem = view.trace.problem
    return Frame(
        f"The {model_name(problem.camera)} camera turns each of its {len(problem) - _lost(problem)} usable "
        "pixels into a direction, a dot on the unit sphere, whatever its lens. "
        "Gravity is known, so the sphere stands upright and only its yaw and position are open.",
        _lens_equation(problem.camera.model),
        view.standing(np.eye(3)),
        view.colors(style.UNDECIDED),
        view.no_matches(),
        items=(_name("sphere", view, "unit sphere: a dot is the direction of a pixel"),),
    )


def _name(layer: str, view: RunView, words: str) -> Label:
    """A label above the sphere."""
    return Label("sphere/name", layer, view.middle - np.array([0.0, 1.2 * view.sphere_m, 0.0]), words)


def example(view: RunView) -> int:
    """The match that serves as an example: the first that agrees with the pose, or else the first with a bearing."""
    agreeing = np.flatnonzero(view.trace.inlier_mask)
    return int(agreeing[0] if len(agreeing) else view.trace.problem.aligned.index[0])


def _match(view: RunView) -> Frame:
    number, problem = example(view), view.trace.problem
    (u, v), mask = problem.pixels[number], view.mask(np.array(number))
    subject = [sphere_box(view.middle, view.sphere_m), _ray(view, number).points[0]]
    if view.truth is not None:
        subject.append(sphere_box(camera_centre(view.truth), CAMERA_ROOM * view.sphere_m))
    return Frame(
        f"Match {number} says that the pixel ({u:.1f}, {v:.1f}) shows the map point {view.place(view.points[number])}, "
        "so the camera stands somewhere on the ray that ends there. "
        "Which way that ray runs depends on how the camera is turned; it is drawn for a yaw of 0°.",
        "p = C + s Rᵀ v,  s > 0",
        view.standing(np.eye(3)),
        view.colors(style.UNDECIDED, (mask, style.SAMPLE)),
        mask,
        items=(_ray(view, number),),
        focus=Focus("Overview", np.vstack(subject)),
    )


def _ray(view: RunView, number: int) -> Segments:
    """The possible camera positions for a yaw of 0: the line from the point backwards along its bearing."""
    aligned, point = view.trace.problem.aligned, view.points[number]
    bearing = aligned.bearings[int(np.searchsorted(aligned.index, number))]
    reach = 2.0 * float(np.linalg.norm(point - view.middle))
    ends = np.array([[point, point - reach * bearing]])
    return Segments("pairs/ray", "pairs", ends, one_color(style.SAMPLE, 1), 3.0)


def _gravity(view: RunView) -> Frame:
    problem = view.trace.problem
    lean = np.degrees(np.arctan2(np.hypot(*problem.gravity_camera[[0, 2]]), problem.gravity_camera[1]))
    bound = problem.gravity_bound_rad
    source = f" from {problem.gravity_source}" if problem.gravity_source else ""
    known = (
        f"{source} exactly" if bound == 0.0 else f"{source} to within {np.degrees(bound):.2g}°{_deviations(problem)}"
    )
    return Frame(
        f"Gravity is known{known} in the camera, where it points {lean:.1f}° away from the image's down, and in the "
        "map. Both frames are turned until it points straight down, which settles roll and pitch.",
        "R = A_camᵀ R_y(θ) A_map,  A g = e_y   (Eq. 1)",
        view.standing(np.eye(3)),
        view.colors(style.UNDECIDED),
        view.no_matches(),
        items=_upright(view),
    )


def _deviations(problem: Problem) -> str:
    """How many standard deviations of gravity the bound on its error is, as part of a sentence; empty if that is
    unknown."""
    sd_rad = problem.gravity_sd_rad
    if not sd_rad or not np.isfinite(sd_rad):
        return ""
    return f" ({problem.gravity_bound_rad / sd_rad:.2g} standard deviations of {np.degrees(sd_rad):.2g}°)"


def _upright(view: RunView) -> tuple[SceneItem, ...]:
    """The horizon of the sphere, and down."""
    down = view.middle + view.sphere_m * np.array([[0.0, 0.0, 0.0], [0.0, 1.5, 0.0]])
    heads = [[[0.0, 1.5, 0.0], [x, 1.25, z]] for x, z in ((0.12, 0.0), (-0.12, 0.0), (0.0, 0.12), (0.0, -0.12))]
    arrow = np.concatenate([down[None], view.middle + view.sphere_m * np.array(heads)])
    return (
        Segments("sphere/gravity", "sphere", arrow, one_color(style.SPHERE, len(arrow)), 4.0),
        ring.loop("sphere/horizon", "sphere", ring.circle_of(view, view.middle, 1.02), style.SPHERE),
    )


def _unknowns(view: RunView) -> Frame:
    usable = len(view.trace.problem.aligned.index)
    return Frame(
        "One angle and a position are left: yaw, around the ring, and where the camera stands, 4 numbers instead of 6. "
        f"A match gives 2 equations, so 2 of the {usable} matches leave two poses, and the other "
        f"{usable - 2} confirm one of them.",
        "θ, C:  1 + 3 = 2 · 2   (Eq. 18-22)",
        view.standing(np.eye(3)),
        view.colors(style.UNDECIDED),
        view.no_matches(),
        items=(
            *_upright(view),
            *_compass(view),
            _name("yaw ring", view, "yaw ring: every direction in which the camera may look"),
        ),
    )


def _compass(view: RunView) -> tuple[SceneItem, ...]:
    """The ring that yaw turns on, with a tick every 10 degrees."""
    yaws = np.radians(np.arange(-180, 180, 10))
    radii = np.tile([1.9, 2.05], (len(yaws), 1))
    radii[::3, 0] = 1.7
    ticks = view.middle + view.sphere_m * radii[:, :, None] * ring.directions(yaws)[:, None]
    return (
        Segments("ring/ticks", "yaw ring", ticks, one_color(style.SPHERE, len(ticks)), 2.0),
        ring.loop("ring/circle", "yaw ring", ring.circle_of(view, view.middle, ring.FOOT), style.SPHERE),
    )


def _lens_equation(model: str) -> str:
    return {
        "mei": "v = (λx, λy, λ − ξ)   (Eq. 8-14)",
        "kannala_brandt": "θd = θ(1 + k1θ² + k2θ⁴ + k3θ⁶ + k4θ⁸)   (Eq. 3-7)",
        "double_sphere": "m = (x, y), mz from ξ and α; v = s (m, mz) − (0, 0, ξ)   (Usenko et al. 2018)",
        "eucm": "v ∝ (x, y, mz(α, β, x² + y²))   (Khomutenko et al. 2015)",
        "ocam": "v ∝ (x, y, a0 + a1 r + a2 r² + …)   (Scaramuzza et al. 2006)",
        "radial_poly": "θd = θ(1 + d1θ + d2θ² + d3θ³)   (Yogamani et al. 2019)",
        "equirectangular": "lon = 2π(u/W − ½), lat = π(½ − v/H)   (Eq. 15-17)",
    }.get(model, "")
