"""Whether the stated errors are true: NEES and the share of true poses within 1, 2 and 3 sigma, as a Markdown table.

.venv/bin/python -m benchmarks.nees [ESTIMATOR]

NEES is e' C^-1 e over the degrees of freedom, 1 if the covariance C is that of the errors. Real sets are judged twice:
by their truth as it is, and with the errors that the truth itself has (odometry, calibration) added to C.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from benchmarks.machine import ROOT
from spherloc.datasets import load_scene
from spherloc.datasets.synthetic import SyntheticScene
from spherloc.estimators import estimate
from spherloc.estimators.base import default_options
from spherloc.geometry import camera_centre
from spherloc.problem import Problem
from spherloc.trace import RefinementStage

SHARED = ROOT.parent / "shared" / "data"
SIGMAS = (0.6827, 0.9545, 0.9973)
TRUTH_DEG, TRUTH_M = 0.1, 0.003
"""Standard deviations of the real sets' truth, about: what a headset's odometry and calibration are good for."""
SIMULATED = {
    "simulation, N=200, 80 %": {"outlier_rate": 0.8},
    "simulation, N=200, 93 %": {"outlier_rate": 0.93},
    "simulation, N=200, 80 %, noise 0.3 px": {"outlier_rate": 0.8, "noise_px": 0.3},
    "simulation, N=200, 80 %, gravity 1 deg": {"outlier_rate": 0.8, "gravity_error_deg": 1.0},
}
SEEDS = range(9000, 9100)


def simulated(**changes: float) -> list[Problem]:
    """Held-out problems of the paper's simulation."""
    scene = load_scene(ROOT / "scenes" / "mei_outliers_80.toml")
    assert isinstance(scene, SyntheticScene)
    return [replace(scene, **{"correspondences": 200, "noise_px": 1.0, **changes}).problem(seed) for seed in SEEDS]


def real(folder: Path, most: int, draws: int) -> list[Problem]:
    """The problems of a folder; of larger ones ``draws`` random parts of ``most`` correspondences."""
    problems = []
    for path in sorted(folder.glob("*.toml")):
        whole = load_scene(path).problem()
        for seed in range(draws):
            rng = np.random.default_rng([17, seed])
            rows = np.sort(rng.choice(len(whole), min(most, len(whole)), replace=False))
            labels = None if whole.truth_inliers is None else whole.truth_inliers[rows]
            part = replace(whole, pixels=whole.pixels[rows], points=whole.points[rows], truth_inliers=labels)
            problems.append(part)
    return problems


def normalised(problem: Problem, estimator: str, truth_sd: tuple[float, float]) -> tuple[float, int] | None:
    """e' C^-1 e and degrees of freedom; None without a pose near the truth or without a covariance."""
    options = replace(default_options(estimator, problem), bound_px=3.0)
    trace = estimate(problem, estimator, options)
    stage, truth = trace.stage(RefinementStage), problem.truth_cam_from_map
    if trace.cam_from_map is None or stage is None or truth is None or not np.isfinite(stage.covariance).all():
        return None
    turn = Rotation.from_matrix(truth[:, :3] @ trace.cam_from_map[:, :3].T).as_rotvec()
    error = np.concatenate([turn, camera_centre(truth) - camera_centre(trace.cam_from_map)])
    if np.linalg.norm(turn) > np.radians(3.0) or np.linalg.norm(error[3:]) > 0.3:
        return None
    extra = np.repeat(np.square([np.radians(truth_sd[0]), truth_sd[1]]), 3)
    covariance = stage.covariance + np.diag(extra)
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-30))
    inverse = np.linalg.pinv(covariance / np.outer(scale, scale), rcond=1e-9, hermitian=True)
    dof = 6 if extra.any() else stage.dof
    return float((error / scale) @ inverse @ (error / scale)), dof


def row(name: str, problems: list[Problem], estimator: str, truth_sd: tuple[float, float] = (0.0, 0.0)) -> str:
    """One line of the table."""
    found = [pair for problem in problems if (pair := normalised(problem, estimator, truth_sd)) is not None]
    nees = np.array([square / dof for square, dof in found])
    share = np.array([chi2.cdf(square, dof) for square, dof in found])
    inside = " | ".join(f"{100 * np.mean(share <= sigma):.0f} %" for sigma in SIGMAS)
    return f"| {name} | {len(found)} of {len(problems)} | {np.mean(nees):.2f} | {np.median(nees):.2f} | {inside} |"


def main(estimator: str) -> None:
    """Print the table."""
    print(f"Estimator {estimator}, bound 3 px. Normal errors have 68, 95 and 99.7 % within 1, 2 and 3 sigma.\n")
    print("| problems | judged | NEES, mean | median | 1 sigma | 2 sigma | 3 sigma |\n|---|---|---|---|---|---|---|")
    for name, changes in SIMULATED.items():
        print(row(name, simulated(**changes), estimator), flush=True)
    for folder, most, draws in (("aria_gen2", 10_000, 1), ("aria_adt_fisheye", 300, 10)):
        if not (SHARED / folder).is_dir():
            print(f"{folder}: left out, since it is not beside the project.", file=sys.stderr)
            continue
        problems = real(SHARED / folder, most, draws)
        print(row(folder, problems, estimator), flush=True)
        name = f"{folder}, truth good to {TRUTH_DEG:g} deg and {1000 * TRUTH_M:g} mm"
        print(row(name, problems, estimator, (TRUTH_DEG, TRUTH_M)), flush=True)


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "ransac-2p")
