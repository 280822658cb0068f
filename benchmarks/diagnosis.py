"""Confusion matrices of the diagnosis, with the truth and without, as Markdown tables. Rows: how a case was made.

.venv/bin/python benchmarks/diagnosis.py [CASES] [FIRST_SEED]
"""

import sys
import time
from collections import Counter
from dataclasses import replace

import numpy as np

from spherloc.datasets.failures import MAKERS, FailureCase, failure_case
from spherloc.diagnosis import Cause, diagnose
from spherloc.estimators import default_options, estimate
from spherloc.trace import Trace
from spherloc.warm_up import warm_up


def run(case: FailureCase) -> Trace:
    """The run that the case is about."""
    options = replace(default_options(case.estimator, case.problem), **case.options)
    return estimate(case.problem, case.estimator, options, case.seed)


def print_matrix(title: str, counts: dict[Cause, Counter[Cause]]) -> None:
    """One row a cause: how often it was called what, and the share that is right."""
    right = sum(count[cause] for cause, count in counts.items())
    total = sum(count.total() for count in counts.values())
    print(f"\n{title}: {right} of {total} right ({100 * right / total:.1f} %)\n")
    print("| made as | " + " | ".join(Cause) + " | right |")
    print("|---" * (len(Cause) + 2) + "|")
    for cause, count in counts.items():
        cells = [str(count[called] or "") for called in Cause]
        print(f"| {cause} | " + " | ".join(cells) + f" | {100 * count[cause] / count.total():.0f} % |")


def main(cases: int, first: int) -> None:
    """Print both matrices and the time that a diagnosis takes."""
    warm_up()
    diagnose(run(failure_case(Cause.AMBIGUOUS, 0)))
    made = [Cause(name) for name in MAKERS]
    counts = {used: {cause: Counter() for cause in made} for used in (True, False)}
    times_ms = []
    for cause in made:
        for seed in range(first, first + cases):
            trace = run(failure_case(cause, seed))
            for used, matrix in counts.items():
                start = time.perf_counter()
                matrix[cause][diagnose(trace, use_truth=used).cause] += 1
                times_ms.append((time.perf_counter() - start) * 1e3)
    print(f"{cases} cases a cause, seeds {first} to {first + cases - 1}.")
    print_matrix("With the truth", counts[True])
    print_matrix("Without the truth", counts[False])
    median, most = np.median(times_ms), np.max(times_ms)
    print(f"\nA diagnosis took {median:.0f} ms (median), {most:.0f} ms at most.")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100, int(sys.argv[2]) if len(sys.argv) > 2 else 0)
