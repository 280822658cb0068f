"""Peak memory of one run, in a process of its own: python -m benchmarks.memory CORRESPONDENCES [ESTIMATOR]"""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.machine import ROOT
from spherloc.problem import Problem

STATUS = Path("/proc/self/status")
REPORTED = "memory: "
TRUE_CAMERA = (30.0, 1.0, 0.0, 2.0)
"""Yaw (deg) and position (m) where a problem is made of several."""


def measure(sizes: tuple[int, ...]) -> dict[str, Any]:
    """One run for each number of correspondences, each in a process of its own."""
    return {"runs": [_measured(size, "mc-exact") for size in sizes]}


def _measured(correspondences: int, estimator: str) -> dict[str, Any]:
    """Peak resident memory, MB, and its growth over that of the warmed-up process, at 90 % outliers; or why not."""
    if not STATUS.is_file():
        return {"skipped": f"this system has no {STATUS}, which knows the peak of a process"}
    command = [sys.executable, "-m", "benchmarks.memory", str(correspondences), estimator]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    lines = [line for line in done.stdout.splitlines() if line.startswith(REPORTED)]
    if done.returncode != 0 or not lines:
        return {"skipped": f"the run ended with code {done.returncode}: {done.stderr.strip()[-300:]}"}
    return json.loads(lines[-1].removeprefix(REPORTED))


def _status_mb(key: str) -> float:
    """``VmRSS`` (now) or ``VmHWM`` (peak of this process; ``getrusage`` would count that of the parent too)."""
    line = next(line for line in STATUS.read_text(encoding="utf-8").splitlines() if line.startswith(key))
    return float(line.split()[1]) / 1024.0


def _problem(correspondences: int) -> Problem:
    """Of the simulation at 90 % outliers; beyond what that draws at once, several clouds seen by the same camera."""
    from benchmarks.cases import simulated
    from spherloc.datasets.synthetic import MAX_CORRESPONDENCES

    if correspondences <= MAX_CORRESPONDENCES:
        return simulated(correspondences, 0.9)(0)
    draw = simulated(MAX_CORRESPONDENCES, 0.9, true_camera=TRUE_CAMERA)
    parts = [draw(seed) for seed in range(-(-correspondences // MAX_CORRESPONDENCES))]
    joined = {
        name: np.concatenate([getattr(part, name) for part in parts])[:correspondences]
        for name in ("pixels", "points", "truth_inliers")
    }
    return replace(parts[0], **joined)


def _run(correspondences: int, estimator: str) -> dict[str, Any]:
    from spherloc.estimators import estimate
    from spherloc.warm_up import warm_up

    warm_up()
    problem = _problem(correspondences)
    before = _status_mb("VmRSS")
    trace = estimate(problem, estimator)
    peak = _status_mb("VmHWM")
    return {
        "estimator": estimator,
        "correspondences": correspondences,
        "peak_mb": round(peak),
        "growth_mb": round(peak - before),
        "time_ms": round(trace.timings_ms["total"], 1),
        "gap": None if trace.certificate is None else trace.certificate.gap,
    }


if __name__ == "__main__":
    print(REPORTED + json.dumps(_run(int(sys.argv[1]), sys.argv[2] if len(sys.argv) > 2 else "mc-exact")))
