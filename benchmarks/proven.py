"""How often is the largest consensus proven? mc-exact over a grid of sizes and outlier rates of the simulation."""

from typing import Any

import numpy as np

from benchmarks.cases import simulated
from benchmarks.methods import Method, our_methods

COUNTS = {50: 200, 100: 200, 200: 200, 500: 200, 1000: 200, 2000: 100, 5000: 100}
"""Problems at each outlier rate, by N."""
RATES = (0.0, 0.5, 0.8, 0.9, 0.95, 0.97)
MIN_RIGHT = 8
"""Right matches that a problem has: of fewer, as many wrong ones may agree by chance."""


def measure(most: int) -> dict[str, Any]:
    """Gaps over the grid, with at most so many problems of each kind."""
    solver, sizes = our_methods()["mc-exact"], []
    for size, count in COUNTS.items():
        rates = [rate for rate in RATES if round((1.0 - rate) * size) >= MIN_RIGHT]
        gaps = np.array([[_gap(solver, size, rate, seed) for seed in range(min(count, most))] for rate in rates])
        sizes.append(
            {
                "correspondences": size,
                "outlier_rates": rates,
                "problems": gaps.size,
                "proven": int(np.count_nonzero(gaps <= 0)),
                "not_proven_by_rate": np.count_nonzero(gaps > 0, axis=1).tolist(),
                "largest_gap": int(gaps.max()),
            }
        )
    return {"sizes": sizes}


def _gap(solver: Method, size: int, rate: float, seed: int) -> int:
    certificate = solver.prepare(simulated(size, rate)(seed), seed)().certificate
    assert certificate is not None
    return certificate.gap
