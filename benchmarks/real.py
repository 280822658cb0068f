"""Real matches, as they are and with most of the right ones taken away: ours beside PoseLib and pycolmap.

    .venv/bin/python -m benchmarks.real [--data FOLDER] [--draws N] [--method NAME ...]

A problem keeps all of its wrong matches and so many of its right ones (within 3 px at the true pose) that they are the
share that its row names. Every method gets the same matches in the same process. A success: within 1 degree and 10 cm.
"""

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.methods import BOUND_PX, Answer, Method, our_methods
from benchmarks.peers import peers, use_one_thread
from spherloc.bounds import bounds_of
from spherloc.datasets import load_scene
from spherloc.metrics import rotation_error_deg, translation_error_m
from spherloc.narrowing import truncated_squares
from spherloc.problem import Problem
from spherloc.refine import RefinementOptions, matches_of, noise_of, refine, residuals_px
from spherloc.warm_up import warm_up

DATA = Path(__file__).parents[2] / "shared" / "data"
FOLDERS = ("aria_adt_fisheye", "aria_gen2")
METHODS = ("mc-exact", "mc", "auto", "ransac-2p", "PoseLib rig", "pycolmap rig")
SHARES = (None, 0.2, 0.1, 0.05)
"""Of right matches that a row keeps; None keeps all."""
MIN_RIGHT = 6
"""Right matches that every problem keeps."""
SUCCESS_DEG, SUCCESS_M = 1.0, 0.1
COLUMNS = (
    "problems",
    "method",
    "right",
    "median deg",
    "median cm",
    "median ms",
    "proven, largest gap",
    "misses that matches speak for",
)
HEADER = f"| {' | '.join(COLUMNS)} |\n{'|---' * len(COLUMNS)}|"


@dataclass(frozen=True)
class Result:
    """One method on one problem."""

    degrees: float
    metres: float
    seconds: float
    gap: float
    """Share by which the proven bound exceeds what was found; NaN where nothing is proven."""
    squares: float = np.inf
    """Truncated squares of the pose less those of the true one, refined: below 0, the matches speak for the pose."""


def real_problems(folder: Path) -> list[Problem]:
    """The problems of a folder's scenes that have a true pose."""
    problems = [load_scene(path).problem(0) for path in sorted(folder.glob("*.toml"))]
    return [problem for problem in problems if problem.truth_cam_from_map is not None]


def thinned(problem: Problem, share: float, seed: int) -> Problem:
    """The problem with right matches taken away at random until they are ``share`` of what is left."""
    aligned, truth = problem.aligned, problem.truth_cam_from_map
    assert truth is not None
    right = np.zeros(len(problem), dtype=bool)
    right[aligned.index] = residuals_px(aligned, aligned.align_pose(truth)) <= BOUND_PX
    wrong = len(problem) - int(right.sum())
    keep = max(MIN_RIGHT, round(share / (1.0 - share) * wrong))
    kept = ~right
    kept[np.random.default_rng(seed).permutation(np.flatnonzero(right))[:keep]] = True
    labels = problem.truth_inliers
    return replace(
        problem,
        pixels=problem.pixels[kept],
        points=problem.points[kept],
        truth_inliers=None if labels is None else labels[kept],
        reference_index=None,
        reference_pixels=None,
    )


def run(method: Method, problem: Problem, seed: int) -> Result:
    """Solve a problem and measure how far off the pose is."""
    solve = method.prepare(problem, seed)
    start = time.perf_counter()
    answer: Answer = solve()
    seconds = time.perf_counter() - start
    proven, gap = answer.certificate, np.nan
    if proven is not None:
        gap = proven.gap / max(proven.lower_bound, 1)
    if answer.cam_from_map is None or problem.truth_cam_from_map is None:
        return Result(np.inf, np.inf, seconds, gap)
    pair = answer.cam_from_map, problem.truth_cam_from_map
    aligned, options = problem.aligned, RefinementOptions()
    found, truth = (aligned.align_pose(one) for one in pair)
    truth = refine(aligned, truth, bounds_of(aligned, BOUND_PX), options)[0]
    limits, noise = np.full(len(aligned.points), BOUND_PX), noise_of(aligned, options)
    cost, of_truth = (truncated_squares(matches_of(aligned), limits, one, noise, np.inf) for one in (found, truth))
    return Result(rotation_error_deg(*pair), translation_error_m(*pair), seconds, gap, float(cost - of_truth))


def lines(name: str, problems: list[Problem], methods: list[Method]) -> Iterator[str]:
    """Rows of the table for one kind of problems."""
    for method in methods:
        results = [run(method, problem, seed) for seed, problem in enumerate(problems)]
        right = [one for one in results if one.degrees <= SUCCESS_DEG and one.metres <= SUCCESS_M]
        degrees, metres, seconds = (
            float(np.median([getattr(one, which) for one in results])) for which in ("degrees", "metres", "seconds")
        )
        explained = sum(one.squares < 0.0 for one in results if one not in right)
        gaps = np.array([one.gap for one in results])
        proven = "" if np.isnan(gaps).all() else f"{np.count_nonzero(gaps == 0)}, {100 * np.nanmax(gaps):.0f} %"
        yield (
            f"| {name} | {method.name} | {len(right)} of {len(results)} | {degrees:.3f} | {100 * metres:.2f} "
            f"| {1000 * seconds:.1f} | {proven} | {explained} of {len(results) - len(right)} |"
        )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DATA, metavar="FOLDER", help=f"holds {' and '.join(FOLDERS)}")
    parser.add_argument("--draws", type=int, default=3, metavar="N", help="draws of right matches a problem (3)")
    parser.add_argument("--method", action="append", metavar="NAME", help=f"of {', '.join(METHODS)}; may be repeated")
    parser.add_argument("--set", action="append", choices=FOLDERS, help="only this folder; may be repeated")
    given = parser.parse_args()
    use_one_thread()
    warm_up()
    known = our_methods() | peers()
    methods = [known[name] for name in given.method or METHODS]
    print(HEADER)
    for folder in given.set or FOLDERS:
        problems = real_problems(given.data / folder)
        if not problems:
            print(f"{folder}: left out, since {given.data / folder} has no scenes with a true pose.")
            continue
        for share in SHARES:
            chosen = problems
            if share is not None:
                chosen = [thinned(one, share, draw) for one in problems for draw in range(given.draws)]
            name = folder if share is None else f"{folder}, {100 * share:.0f} % right"
            for line in lines(name, chosen, methods):
                print(line, flush=True)


if __name__ == "__main__":
    main()
