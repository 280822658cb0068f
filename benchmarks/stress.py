"""Real matches made harder in the ways real ones are hard: ours beside PoseLib and pycolmap, as a Markdown table.

    .venv/bin/python -m benchmarks.stress [--data FOLDER] [--draws N] [--method NAME ...] [--kind NAME ...]

Every method gets the same matches and the same bound of 3 px in the same process. A success: within 1 degree and 10 cm.
"""

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.methods import BOUND_PX, our_methods
from benchmarks.peers import peers, use_one_thread
from benchmarks.real import DATA, FOLDERS, HEADER, lines, real_problems
from benchmarks.real_failures import part, right_ones
from spherloc.geometry import so3_exp
from spherloc.problem import Problem
from spherloc.types import BoolArray, FloatArray
from spherloc.warm_up import warm_up

Change = Callable[[Problem, BoolArray, np.random.Generator], Problem]

METHODS = ("auto", "ransac-2p", "mc", "PoseLib rig", "pycolmap rig")
MAX_MATCHES = 400
"""Of a problem; of larger ones an even choice."""
GRID_PX = 4.0
STEP_M = 1.0
"""Between a facade and its repetition."""


def _noisy(problem: Problem, noise_px: FloatArray) -> Problem:
    return replace(problem, pixels=problem.pixels + noise_px, truth_inliers=None)


def _quantised(problem: Problem, _right: BoolArray, _rng: np.random.Generator) -> Problem:
    return replace(problem, pixels=(np.floor(problem.pixels / GRID_PX) + 0.5) * GRID_PX, truth_inliers=None)


def _laplace(problem: Problem, _right: BoolArray, rng: np.random.Generator) -> Problem:
    return _noisy(problem, rng.laplace(scale=1.5, size=problem.pixels.shape))


def _bound_too_small(problem: Problem, _right: BoolArray, rng: np.random.Generator) -> Problem:
    return _noisy(problem, BOUND_PX * rng.normal(size=problem.pixels.shape))


def _shuffled(share: float) -> Change:
    """Right matches lose their points to each other until ``share`` of all are right."""

    def change(problem: Problem, right: BoolArray, rng: np.random.Generator) -> Problem:
        rows, keep = rng.permutation(np.flatnonzero(right)), max(8, round(share * len(problem)))
        lost = rows[keep:]
        points = problem.points.copy()
        points[lost] = points[np.roll(lost, 1)]
        return part(problem, np.arange(len(problem)), points)

    return change


def _repeated_facade(problem: Problem, right: BoolArray, rng: np.random.Generator) -> Problem:
    """Two of five right matches are with the same structure a metre aside."""
    rows = rng.permutation(np.flatnonzero(right))
    side = np.cross(problem.gravity_map, rng.normal(size=3))
    points = problem.points.copy()
    points[rows[: 2 * len(rows) // 5]] += STEP_M * side / np.linalg.norm(side)
    return part(problem, np.arange(len(problem)), points)


def _wrong_clusters(problem: Problem, right: BoolArray, rng: np.random.Generator) -> Problem:
    """Seven of ten right matches are wrong alike: neighbours in the image have points near one wrong place."""
    rows = np.flatnonzero(right)
    lost = rows[np.argsort(problem.pixels[rows] @ rng.normal(size=2))][: 7 * len(rows) // 10]
    points = problem.points.copy()
    for cluster in np.array_split(lost, max(1, len(lost) // 20)):
        points[cluster] = points[rng.choice(rows)] + 0.1 * rng.normal(size=(len(cluster), 3))
    return part(problem, np.arange(len(problem)), points)


def _gravity(factor: float) -> Change:
    """Gravity is off by ``factor`` times its bound, or as many degrees if that is exact."""

    def change(problem: Problem, _right: BoolArray, rng: np.random.Generator) -> Problem:
        assert problem.truth_cam_from_map is not None
        down = problem.truth_cam_from_map[:, :3] @ problem.gravity_map
        axis = np.cross(down, rng.normal(size=3))
        angle = factor * (problem.gravity_bound_rad or np.radians(1.0))
        return replace(problem, gravity_camera=so3_exp(angle * axis / np.linalg.norm(axis)) @ down)

    return change


KINDS: dict[str, Change] = {
    "as they are": lambda problem, right, rng: problem,
    "pixels on a grid of 4 px": _quantised,
    "Laplace noise, sd 2.1 px": _laplace,
    "normal noise, sd 3 px": _bound_too_small,
    "10 % right, shuffled": _shuffled(0.1),
    "5 % right, shuffled": _shuffled(0.05),
    "repeated facade": _repeated_facade,
    "wrong clusters": _wrong_clusters,
    "gravity off by its bound": _gravity(1.0),
    "gravity off by twice its bound": _gravity(2.0),
}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DATA, metavar="FOLDER", help=f"holds {' and '.join(FOLDERS)}")
    parser.add_argument("--draws", type=int, default=2, metavar="N", help="of each kind a problem (2)")
    parser.add_argument("--method", action="append", metavar="NAME", help=f"of {', '.join(METHODS)}; may be repeated")
    parser.add_argument("--kind", action="append", choices=KINDS, metavar="NAME", help="only this; may be repeated")
    given = parser.parse_args()
    use_one_thread()
    warm_up()
    known = our_methods() | peers()
    methods = [known[name] for name in given.method or METHODS]
    problems = [problem for folder in FOLDERS for problem in real_problems(given.data / folder)]
    problems = [
        part(one, np.linspace(0, len(one) - 1, MAX_MATCHES).astype(int)) if len(one) > MAX_MATCHES else one
        for one in problems
    ]
    print(HEADER)
    for name in given.kind or KINDS:
        number = list(KINDS).index(name)
        changed = [
            KINDS[name](one, right_ones(one), np.random.default_rng([number, draw]))
            for one in problems
            for draw in range(given.draws)
        ]
        for line in lines(name, changed, methods):
            print(line, flush=True)


if __name__ == "__main__":
    main()
