"""One row: every method of a case on the same problems in turn, so that a busy machine is busy for all of them."""

import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from benchmarks.cases import OUR_BUDGET_S, PEER_BUDGET_S, Case
from benchmarks.methods import BOUND_PX, Answer, Method
from spherloc.bounds import bounds_of
from spherloc.metrics import rotation_error_deg, translation_error_m
from spherloc.problem import Problem

MIN_PROBLEMS = 20
"""A method gets as many even if that takes it longer than its budget, ..."""
PATIENCE = 3.0
"""... but not longer than as many budgets."""
WARM_UP_SEED = 10**9


@dataclass
class Tally:
    """What one method did so far."""

    times_ms: list[float] = field(default_factory=list)
    errors: list[tuple[float, float]] = field(default_factory=list)
    gaps: list[int] = field(default_factory=list)
    inside_ms: list[float] = field(default_factory=list)

    def add(self, elapsed_s: float, problem: Problem, answer: Answer) -> None:
        """Count one answer; no pose is an infinite error."""
        self.times_ms.append(1e3 * elapsed_s)
        truth, estimate = problem.truth_cam_from_map, answer.cam_from_map
        assert truth is not None
        errors = (np.inf, np.inf)
        if estimate is not None:
            errors = rotation_error_deg(truth, estimate), translation_error_m(truth, estimate)
        self.errors.append(errors)
        if answer.certificate is not None:
            self.gaps.append(answer.certificate.gap)
        if answer.inside_ms is not None:
            self.inside_ms.append(answer.inside_ms)

    def summary(self, case: Case) -> dict[str, Any]:
        """Success, times and errors, as written to the results."""
        degrees, metres = np.array(self.errors).T
        right = (degrees < case.success_deg) & (metres < case.success_m)
        summary = {
            "problems": len(right),
            "success": float(np.mean(right)),
            "median_ms": _round(np.median(self.times_ms)),
            "quartiles_ms": [_round(value) for value in np.percentile(self.times_ms, (25, 75))],
            "p95_ms": _round(np.percentile(self.times_ms, 95)),
            "slowest_ms": _round(max(self.times_ms)),
        }
        if right.any():
            summary["median_error_deg"] = _round(np.median(degrees[right]))
            summary["median_error_m"] = _round(np.median(metres[right]))
        if self.inside_ms:
            summary["median_inside_ms"] = _round(np.median(self.inside_ms))
        if self.gaps:
            summary["proven_optimal"] = float(np.mean(np.array(self.gaps) <= 0))
            summary["mean_gap"] = float(np.mean(self.gaps))
            summary["largest_gap"] = max(self.gaps)
        return summary


def _round(value: Any) -> float:
    return float(f"{float(value):.4g}")


def prepared(problem: Problem) -> float:
    """Compute what estimators take as given, bearings and their Jacobians in the aligned frames; the time, ms."""
    start = time.perf_counter()
    bounds_of(problem.aligned, BOUND_PX)
    return 1e3 * (time.perf_counter() - start)


def measure(case: Case, methods: dict[str, Method], counts: dict[str, int]) -> dict[str, Any]:
    """Run the case; ``counts`` is how many problems each method gets, those of seeds 0, 1, ...

    A method that has used its budget of seconds gets no further problems (``MIN_PROBLEMS`` at least): the summary
    says how many it had. Every method first solves a problem that is not counted.
    """
    names = [name for name, count in counts.items() if count > 0]
    tallies = {name: Tally() for name in names}
    preparation_ms = []
    warm_up = case.problem(WARM_UP_SEED)
    for name in names:
        methods[name].prepare(warm_up, 0)()
    for seed in range(max(counts[name] for name in names)):
        active = [name for name in names if seed < counts[name] and not _spent(tallies[name], methods[name])]
        if not active:
            break
        problem = case.problem(seed)
        preparation_ms.append(prepared(problem))
        turn = seed % len(active)
        for name in active[turn:] + active[:turn]:
            solve = methods[name].prepare(problem, seed)
            start = time.perf_counter()
            answer = solve()
            tallies[name].add(time.perf_counter() - start, problem, answer)
    return {
        "preparation_ms": _round(np.median(preparation_ms)),
        "methods": {name: tally.summary(case) for name, tally in tallies.items()},
    }


def _spent(tally: Tally, method: Method) -> bool:
    budget_s = OUR_BUDGET_S if method.ours else PEER_BUDGET_S
    budgets = 1e-3 * sum(tally.times_ms) / budget_s
    return budgets > (1.0 if len(tally.times_ms) >= MIN_PROBLEMS else PATIENCE)
