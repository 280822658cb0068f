"""What is measured: a method takes a problem in its own convention and returns a pose; ours first."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

from spherloc import registry
from spherloc.estimators import estimate
from spherloc.estimators.base import options_type
from spherloc.problem import Problem
from spherloc.trace import Certificate
from spherloc.types import FloatArray

BOUND_PX = 3.0
"""The noise bound of every method, px of the scene's camera; noise is 1 px."""
CONFIDENCE = 0.999
MAX_ITERATIONS = 100_000


@dataclass(frozen=True, eq=False)
class Answer:
    """What a method says about one problem."""

    cam_from_map: FloatArray | None
    """Pose (3, 4), or None."""
    certificate: Certificate | None = None
    """What is proven, by the methods that prove anything."""
    inside_ms: float | None = None
    """Time inside a compiled library whose RANSAC is a loop written in Python here, ms."""


Solve = Callable[[], Answer]


@dataclass(frozen=True, eq=False)
class Method:
    """One way to solve a problem."""

    name: str
    """As in the tables."""
    prepare: Callable[[Problem, int], Solve]
    """Puts a problem and a seed into the method's own form. Only the call of what it returns is timed."""
    settings: dict[str, Any]
    """What it was told, for the record."""
    ours: bool = False
    """Whether it is spherloc's."""


def _ours(name: str, estimator: str, **given: Any) -> Method:
    options = options_type(estimator)(**given)

    def prepare(problem: Problem, seed: int) -> Solve:
        run = partial(estimate, problem, estimator, options, seed)

        def solve() -> Answer:
            trace = run()
            return Answer(trace.cam_from_map, trace.certificate)

        return solve

    return Method(name, prepare, {"estimator": estimator, **asdict(options)}, ours=True)


def our_methods() -> dict[str, Method]:
    """Every registered estimator with the options that the tables show, by name.

    Baselines, whose solvers need 3 to 6 points a sample, take the 100 iterations of the paper's comparison.
    """
    methods = [_ours("mc", "mc", bound_px=BOUND_PX), _ours("ransac-2p", "ransac-2p", bound_px=BOUND_PX)]
    if "mc-exact" in registry.names("estimators"):
        methods.insert(0, _ours("mc-exact", "mc-exact", bound_px=BOUND_PX))
        methods.append(_ours("auto", "auto", bound_px=BOUND_PX))
    methods.append(
        _ours(
            "ransac-2p to 99.9 %",
            "ransac-2p",
            bound_px=BOUND_PX,
            confidence=CONFIDENCE,
            iterations=MAX_ITERATIONS,
            local_optimization=True,
        )
    )
    for name in baseline_names():
        methods.append(_ours(name, name, bound_px=BOUND_PX, iterations=100))
    return {method.name: method for method in methods}


def baseline_names() -> tuple[str, ...]:
    """The registered baselines of the paper: RANSAC around other solvers."""
    return tuple(name for name in registry.names("estimators") if name.startswith("ransac-") and name != "ransac-2p")
