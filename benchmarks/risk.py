"""How often accepted poses are wrong, by how many are accepted: the rule's score beside the inlier count, as a table.

.venv/bin/python -m benchmarks.risk [ESTIMATOR] [SEEDS]

Problems from easy to hopeless: the simulation at many outlier rates, with gravity errors and with repeated structure
that is as large as the true consensus, cases that are made to fail, and parts of real sets with wrong matches. Left out
is what no rule can know from one image's matches: a wrong pose that explains clearly more than the true one. Seeds are
held out: nothing was tuned on them.
"""

import sys
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from benchmarks.machine import ROOT
from benchmarks.nees import SHARED
from spherloc.datasets import load_scene
from spherloc.datasets.failures import MAKERS, failure_case
from spherloc.datasets.synthetic import SyntheticScene
from spherloc.estimators import estimate
from spherloc.estimators.base import default_options
from spherloc.metrics import evaluate
from spherloc.outcome import Outcome, judge
from spherloc.problem import Problem

LEFT_OUT = ("ok", "larger false consensus", "iterations ran out", "search missed the best pose")
FIRST_SEED = 110_000
MAX_RISK = 0.01
LIMITS_M_DEG = {"aria_adt_fisheye": (1.5, 0.1), "aria_gen2": (1.0, 0.1)}
"""Errors up to which a pose of a real set is right: slam_right's truth and calibration disagree by 0.7 degrees."""


def simulated(seed: int) -> Problem:
    """A random kind of simulation."""
    rng = np.random.default_rng(seed)
    scene = load_scene(ROOT / "scenes" / f"{rng.choice(['mei', 'fisheye', 'panorama'])}_outliers_80.toml")
    assert isinstance(scene, SyntheticScene)
    changes = {
        "correspondences": int(rng.integers(20, 200)),
        "outlier_rate": float(rng.choice([0.5, 0.8, 0.9, 0.95, 0.97, 0.99, 1.0])),
        "gravity_error_deg": float(rng.choice([0.0, 0.5, 1.0])),
        "noise_px": float(rng.choice([0.3, 1.0])),
    }
    if rng.random() < 0.2:
        changes |= {"outlier_kind": "coherent", "outlier_rate": 0.5}
    return replace(scene, **changes).problem(seed)


def real(seed: int) -> tuple[Problem, str] | None:
    """A part of a real problem with some points exchanged among each other; None if there is no real data."""
    rng = np.random.default_rng(seed)
    paths = [path for folder in LIMITS_M_DEG for path in sorted((SHARED / folder).glob("*.toml"))]
    if not paths:
        return None
    path = paths[int(rng.integers(len(paths)))]
    whole = load_scene(path).problem()
    rows = np.sort(rng.choice(len(whole), min(int(rng.integers(15, 200)), len(whole)), replace=False))
    points, wrong = whole.points[rows].copy(), rng.random(len(rows)) < rng.choice([0.0, 0.5, 0.8, 0.9, 1.0])
    points[wrong] = rng.permutation(points[wrong])
    part = replace(whole, pixels=whole.pixels[rows], points=points, truth_inliers=None, name=f"{whole.name}, part")
    return part, path.parent.name


def runs(estimator: str, seeds: int) -> Iterator[tuple[str, bool, int, float, bool]]:
    """Kind, whether it is right, inliers, score, and whether it is called localized; of runs with a pose."""
    causes = [cause for cause in MAKERS if cause not in LEFT_OUT]
    for seed in range(FIRST_SEED, FIRST_SEED + seeds):
        problems = [("simulation", simulated(seed), (1.0, 0.1))]
        problems.append(("made to fail", failure_case(causes[seed % len(causes)], seed).problem, (1.0, 0.1)))
        if (drawn := real(seed)) is not None:
            problems.append(("real", drawn[0], LIMITS_M_DEG[drawn[1]]))
        for kind, problem, (degrees, metres) in problems:
            bound = {} if problem.bound_px is not None else {"bound_px": 3.0}
            trace = estimate(problem, estimator, replace(default_options(estimator, problem), **bound))
            if trace.cam_from_map is None:
                continue
            errors, judged = evaluate(trace), judge(trace)
            assert errors.rotation_error_deg is not None and errors.translation_error_m is not None
            right = errors.rotation_error_deg < degrees and errors.translation_error_m < metres
            yield (
                kind,
                right,
                int(np.count_nonzero(trace.inlier_mask)),
                judged.score,
                judged.outcome == Outcome.LOCALIZED,
            )


def curve(right: np.ndarray, scores: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coverage and risk where all from a score on are accepted, the best first; equals are accepted together."""
    order = np.argsort(-scores, kind="stable")
    ends = np.flatnonzero(np.append(np.diff(scores[order]) != 0, True))
    wrong = np.cumsum(~right[order])[ends]
    return (ends + 1) / len(right), wrong / (ends + 1)


def main(estimator: str, seeds: int) -> None:
    """Print the rule's own point, the largest coverage at 1 % risk, and the curves."""
    rows = list(runs(estimator, seeds))
    kinds, right = np.array([row[0] for row in rows]), np.array([row[1] for row in rows])
    inliers, score = np.array([float(row[2]) for row in rows]), np.array([row[3] for row in rows])
    said = np.array([row[4] for row in rows])
    print(f"{estimator}: {len(rows)} poses, {np.count_nonzero(right)} right.\n")
    for kind in sorted(set(kinds)):
        some = kinds == kind
        accepted, wrong = np.count_nonzero(some & said), np.count_nonzero(some & said & ~right)
        good = np.count_nonzero(some & said & right) / max(np.count_nonzero(some & right), 1)
        print(
            f"{kind}: {accepted} of {np.count_nonzero(some)} called localized, {wrong} of them wrong; "
            f"{100 * good:.1f} % of the right poses are."
        )
    print("\n| score | coverage at 1 % risk | risk at 30 % | 40 % | 50 % | 60 % coverage |\n|---|---|---|---|---|---|")
    for name, values in (("the rule's", score), ("inlier count", inliers)):
        coverage, risk = curve(right, values)
        most = float(coverage[risk <= MAX_RISK].max(initial=0.0))
        cells = [f"{100 * np.interp(share, coverage, risk):.1f} %" for share in (0.3, 0.4, 0.5, 0.6)]
        print(f"| {name} | {100 * most:.1f} % | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "ransac-2p", int(sys.argv[2]) if len(sys.argv) > 2 else 300)
