"""Success against the error of gravity, for every source of it, on the bundled scenes made of images: a Markdown table.

.venv/bin/python -m benchmarks.gravity [ESTIMATOR ...]

All sources get the same matches. "sensor" is the true gravity with a normal error of both tilts, and a bound of three
times its standard deviation, or of what is claimed.
"""

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from spherloc.datasets import bundled_scenes
from spherloc.datasets.map_scene import MapScene
from spherloc.datasets.scene_file import load_scene
from spherloc.errors import InputError
from spherloc.estimators import estimate
from spherloc.frontend.gravity_from_lines import gravity_from_lines
from spherloc.frontend.view import Gravity, View
from spherloc.geometry import so3_exp, tangent_basis
from spherloc.metrics import evaluate
from spherloc.problem import Problem
from spherloc.types import FloatArray
from spherloc.warm_up import warm_up

ESTIMATORS = ("mc", "mc-exact", "ransac-2p")
Source = Callable[[View, Problem], Gravity]


@dataclass(frozen=True, eq=False)
class Case:
    """One query with its matches."""

    view: View
    problem: Problem
    """With the gravity of the most similar reference."""


def cases() -> Iterator[Case]:
    """Those of all bundled scenes made of images that have enough matches."""
    for path in bundled_scenes().values():
        scene = load_scene(path)
        if not isinstance(scene, MapScene):
            continue
        for view in scene.queries:
            try:
                problem = scene.stored_problem(view.name)
            except InputError:
                continue
            if problem is not None:
                view.make_file()
                yield Case(view, problem)


def true_down(problem: Problem) -> FloatArray:
    """Down (3,) in the camera at the true pose."""
    assert problem.truth_cam_from_map is not None
    return problem.truth_cam_from_map[:, :3] @ problem.gravity_map


def sensor(sd_deg: float, claimed_deg: float | None = None) -> Source:
    """A gravity that is off by ``sd_deg`` in each tilt and says that it is by ``claimed_deg``."""
    sd_rad = float(np.radians(sd_deg if claimed_deg is None else claimed_deg))

    def measured(view: View, problem: Problem) -> Gravity:
        down = true_down(problem)
        random = np.random.default_rng([sum(map(ord, problem.name)), 7])
        turn = np.radians(sd_deg) * random.normal(size=2) @ tangent_basis(down[None])[0]
        return Gravity(so3_exp(turn) @ down, "sensor", 3.0 * sd_rad, sd_rad)

    return measured


def of_reference(view: View, problem: Problem) -> Gravity:
    """What the problem has."""
    return Gravity(problem.gravity_camera, "reference", problem.gravity_bound_rad, problem.gravity_sd_rad)


def of_lines(view: View, problem: Problem) -> Gravity:
    """Of the image, else of the reference."""
    try:
        return gravity_from_lines(view, problem.gravity_camera)
    except InputError:
        return of_reference(view, problem)


SOURCES: dict[str, Source] = {
    "true pose": sensor(0.0),
    "lines of the image": of_lines,
    "most similar reference": of_reference,
    **{f"sensor, {sd:g} deg": sensor(sd) for sd in (0.25, 0.5, 1.0, 2.0, 4.0)},
    "sensor, 1 deg, claims 0.1": sensor(1.0, 0.1),
    "sensor, 2 deg, claims 0.1": sensor(2.0, 0.1),
}


def row(name: str, source: Source, all_cases: list[Case], estimators: tuple[str, ...]) -> str:
    """A line of the table."""
    errors_deg, bounds_deg, problems = [], [], []
    for case in all_cases:
        found = source(case.view, case.problem)
        problem = replace(
            case.problem,
            gravity_camera=found.down,
            gravity_bound_rad=found.bound_rad,
            gravity_sd_rad=found.sd_rad,
        )
        problems.append(problem)
        errors_deg.append(np.degrees(problem.gravity_error_rad or 0.0))
        bounds_deg.append(np.degrees(problem.gravity_bound_rad))
    errors, bounds = np.array(errors_deg), np.array(bounds_deg)
    cells = [
        name,
        f"{np.median(errors):.2f} / {errors.max():.2f}",
        f"{np.median(bounds):.2f}",
        f"{100 * np.mean(errors <= bounds + 1e-9):.0f} %",
    ]
    for estimator in estimators:
        scores = [evaluate(estimate(problem, estimator, seed=0)) for problem in problems]
        turns = [score.rotation_error_deg for score in scores if score.success and score.rotation_error_deg is not None]
        median = f"{np.median(turns):.3f} deg" if turns else "-"
        cells.append(f"{sum(bool(score.success) for score in scores)} of {len(scores)}, {median}")
    return "| " + " | ".join(cells) + " |"


def main(estimators: tuple[str, ...]) -> None:
    """Print the table."""
    warm_up(None, estimators)
    all_cases = list(cases())
    heads = ["gravity from", "error (deg): median / largest", "bound (deg)", "within", *(f"`{e}`" for e in estimators)]
    print(f"{len(all_cases)} queries; successes (1 deg, 0.1 m) and their median rotation error\n")
    print("| " + " | ".join(heads) + " |\n" + "|---" * len(heads) + "|")
    for name, source in SOURCES.items():
        print(row(name, source, all_cases, estimators), flush=True)


if __name__ == "__main__":
    main(tuple(sys.argv[1:]) or ESTIMATORS)
