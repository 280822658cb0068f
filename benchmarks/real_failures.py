"""Diagnoses of real matches that were made to fail for one known cause each, with the truth and without, as tables.

    .venv/bin/python -m benchmarks.real_failures [--data FOLDER] [--estimator NAME ...] [--draws N]

Each cause changes real problems by itself alone: gravity is turned, pixels are blurred beyond the bound, matches are
given other matches' points, and so on. Cells count what each was called.
"""

import argparse
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.methods import BOUND_PX
from benchmarks.real import DATA, FOLDERS, real_problems
from spherloc.diagnosis import Cause, diagnose
from spherloc.estimators import default_options, estimate
from spherloc.geometry import so3_exp
from spherloc.problem import Problem
from spherloc.refine import residuals_px
from spherloc.types import BoolArray, FloatArray, IntArray
from spherloc.warm_up import warm_up

Maker = Callable[[Problem, BoolArray, np.random.Generator], Problem]

MAX_MATCHES = 300
"""Of a problem; of larger ones an even choice."""
TURN_RAD = np.radians(8.0)
"""By which gravity is turned, beyond its bound."""
BLUR = 1.2
"""Standard deviation of the noise that is added where the bound is too small, in bounds."""
FEW_RIGHT = 2
MOVED_M, MOVED_RAD = 2.0, 0.5
"""How far a false structure moves the camera."""


def part(problem: Problem, rows: IntArray, points: FloatArray | None = None) -> Problem:
    """Some matches (K,) of a problem, with other points (K, 3) if any are given, and no labels."""
    return replace(
        problem,
        pixels=problem.pixels[rows],
        points=problem.points[rows] if points is None else points,
        truth_inliers=None,
        reference_index=None,
        reference_pixels=None,
    )


def right_ones(problem: Problem) -> BoolArray:
    """Mask (N,) of the matches within the bound at the true pose."""
    aligned, truth = problem.aligned, problem.truth_cam_from_map
    assert truth is not None
    right = np.zeros(len(problem), dtype=bool)
    right[aligned.index] = residuals_px(aligned, aligned.align_pose(truth)) <= BOUND_PX
    return right


def _gravity_off(problem: Problem, _right: BoolArray, rng: np.random.Generator) -> Problem:
    axis = np.cross(problem.gravity_camera, rng.normal(size=3))
    turn = so3_exp((TURN_RAD + problem.gravity_bound_rad) * axis / np.linalg.norm(axis))
    return replace(problem, gravity_camera=turn @ problem.gravity_camera)


def _bound_too_small(problem: Problem, _right: BoolArray, rng: np.random.Generator) -> Problem:
    return replace(problem, pixels=problem.pixels + BLUR * BOUND_PX * rng.normal(size=problem.pixels.shape))


def _shuffled(problem: Problem, rows: IntArray, rng: np.random.Generator) -> FloatArray:
    """The points (K, 3) of these rows, each given to another one."""
    return problem.points[np.roll(rng.permutation(rows), 1)]


def _wrong_reference(problem: Problem, _right: BoolArray, rng: np.random.Generator) -> Problem:
    rows = rng.permutation(len(problem))
    return part(problem, rows, problem.points[np.roll(rows, 1)])


def _too_few(problem: Problem, right: BoolArray, rng: np.random.Generator) -> Problem:
    kept = rng.choice(np.flatnonzero(right), FEW_RIGHT, replace=False)
    rest = np.setdiff1d(np.arange(len(problem)), kept)[:60]
    return part(
        problem, np.concatenate([kept, rest]), np.concatenate([problem.points[kept], _shuffled(problem, rest, rng)])
    )


def _false_structure(share: float) -> Maker:
    """Right matches, and others whose points agree with another pose, ``share`` times as many."""

    def make(problem: Problem, right: BoolArray, rng: np.random.Generator) -> Problem:
        rows = rng.permutation(np.flatnonzero(right))
        false = rows[: round(len(rows) * share / (1.0 + share))]
        side = np.cross(problem.gravity_map, rng.normal(size=3))
        turn = so3_exp(MOVED_RAD * problem.gravity_map)
        middle = problem.points[rows].mean(axis=0)
        moved = (problem.points[false] - middle) @ turn.T + middle + MOVED_M * side / np.linalg.norm(side)
        points = problem.points[rows].copy()
        points[: len(false)] = moved
        return part(problem, rows, points)

    return make


MAKERS: dict[Cause, Maker] = {
    Cause.OK: lambda problem, right, rng: problem,
    Cause.TOO_FEW_INLIERS: _too_few,
    Cause.FALSE_CONSENSUS: _false_structure(2.0),
    Cause.WRONG_REFERENCE: _wrong_reference,
    Cause.GRAVITY_OFF: _gravity_off,
    Cause.BOUND_TOO_SMALL: _bound_too_small,
    Cause.AMBIGUOUS: _false_structure(1.0),
}


def cases(problem: Problem, draw: int) -> dict[Cause, Problem]:
    """A problem changed for each cause."""
    if len(problem) > MAX_MATCHES:
        problem = part(problem, np.linspace(0, len(problem) - 1, MAX_MATCHES).astype(int))
    right = right_ones(problem)
    return {
        cause: make(problem, right, np.random.default_rng([draw, k])) for k, (cause, make) in enumerate(MAKERS.items())
    }


def print_matrix(title: str, called: dict[Cause, Counter[Cause]]) -> None:
    """One row a cause: how often it was called what, and the share that is right."""
    names = sorted({name for count in called.values() for name in count}, key=list(Cause).index)
    right, total = sum(count[cause] for cause, count in called.items()), sum(count.total() for count in called.values())
    print(f"\n{title}: {right} of {total} right\n")
    print("| made as | " + " | ".join(names) + " |\n|---" + "|---" * len(names) + "|")
    for cause, count in called.items():
        print(f"| {cause} | " + " | ".join(str(count[name] or "") for name in names) + " |")


def main() -> None:
    """Print both tables for each estimator."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DATA, metavar="FOLDER", help=f"holds {' and '.join(FOLDERS)}")
    parser.add_argument("--estimator", action="append", metavar="NAME", help="ransac-2p; may be repeated")
    parser.add_argument("--draws", type=int, default=1, metavar="N", help="of each cause a problem (1)")
    given = parser.parse_args()
    warm_up()
    problems = [problem for folder in FOLDERS for problem in real_problems(given.data / folder)]
    for estimator in given.estimator or ["ransac-2p"]:
        called = {used: {cause: Counter() for cause in MAKERS} for used in (True, False)}
        for problem in problems:
            for draw in range(given.draws):
                for cause, case in cases(problem, draw).items():
                    trace = estimate(case, estimator, replace(default_options(estimator, case), bound_px=BOUND_PX))
                    for used, matrix in called.items():
                        matrix[cause][diagnose(trace, use_truth=used).cause] += 1
        print_matrix(f"{estimator}, with the truth", called[True])
        print_matrix(f"{estimator}, without the truth", called[False])


if __name__ == "__main__":
    main()
