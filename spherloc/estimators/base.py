"""What every estimator offers, and the one function that runs one."""

import platform
import time
from contextlib import contextmanager
from dataclasses import dataclass, fields
from functools import lru_cache
from importlib.metadata import version
from numbers import Real
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from spherloc import registry
from spherloc.bounds import Bounds, bounds_of
from spherloc.errors import InputError, show
from spherloc.problem import AlignedProblem, Problem
from spherloc.refine import RefinementOptions
from spherloc.trace import Certificate, Stage, Trace
from spherloc.watch import Cancelled, Watch

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

REFINEMENT_FIELDS = {item.name for item in fields(RefinementOptions)}


@dataclass(frozen=True, eq=False)
class Outcome:
    """What an estimator returns to ``estimate``: stages, and the pose and inliers in the aligned frames."""

    stages: tuple[Stage, ...]
    """In the order in which they ran."""
    cam_from_map: FloatArray | None
    """Aligned pose (3, 4), or None."""
    inlier_mask: BoolArray
    """(M,) over the usable correspondences."""
    reason: str = ""
    """Why there is no pose, as a sentence; empty if there is one."""
    note: str = ""
    """What should be known about a pose that was found, as sentences."""
    certificate: Certificate | None = None
    """What is proven about the consensus, if the estimator proves anything."""


class Estimator(Protocol):
    """A robust pose estimator, registered by entry point."""

    Options: ClassVar[type]
    """A frozen dataclass with a default for every field; ``bound_px`` is one of them."""

    @staticmethod
    def run(aligned: AlignedProblem, options: Any, bounds: Bounds, seed: int, clock: "Clock") -> Outcome:
        """Solve; take every random draw from ``seed`` and report each stage's time to ``clock``.

        What may take longer than some hundredths of a second looks at ``clock.watch`` so often.
        """
        ...


class Clock:
    """Collects the wall time of named stages, ms, and carries the run's watch."""

    def __init__(self, watch: Watch | None = None) -> None:
        self.timings_ms: dict[str, float] = {}
        self.watch = watch or Watch()

    @contextmanager
    def stage(self, name: str, until: float | None = None):
        """Time the body as ``name``, at whose end the watch's fraction is ``until`` (None: as it was).

        Raises ``Cancelled`` if the run shall end.
        """
        self.watch.begin(name, until)
        start = time.perf_counter()
        yield
        self.timings_ms[name] = (time.perf_counter() - start) * 1e3


@lru_cache(maxsize=1)
def versions() -> dict[str, str]:
    """Versions of everything that can change a number."""
    packages = ("spherloc", "numpy", "scipy", "numba")
    return {"python": platform.python_version()} | {name: version(name) for name in packages}


def options_type(estimator: str) -> type:
    """The options dataclass of a registered estimator; ``InputError`` if there is none of that name."""
    return registry.lookup("estimators", estimator).Options


def default_options(estimator: str, problem: Problem) -> Any:
    """The estimator's default options, with the problem's own pixel bound if it states one."""
    given = {} if problem.bound_px is None else {"bound_px": problem.bound_px}
    return options_type(estimator)(**given)


def check_positive(options: Any) -> None:
    """Raise ``InputError`` if a field of ``options`` is no finite positive number."""
    for item in fields(options):
        value = getattr(options, item.name)
        if item.name in REFINEMENT_FIELDS:
            continue  # RefinementOptions checks its own
        if isinstance(item.default, bool | str):
            continue  # words and switches are their estimator's to check
        if value is None and item.default is None:
            continue
        if isinstance(value, bool) or not isinstance(value, Real) or not 0 < float(value) < np.inf:
            raise InputError(f"option {item.name} is {show(value)}; give a positive number.")


def estimate(
    problem: Problem, estimator: str = "mc", options: Any = None, seed: int = 0, watch: Watch | None = None
) -> Trace:
    """Solve a problem and return the record of the run.

    ``options`` is an instance of ``options_type(estimator)``; None takes the defaults. The same arguments give the
    same trace but for its timings. ``watch``, a new one, follows the run and can cancel it from any thread.

    Raises ``Cancelled`` if it did, ``InputError`` for an unknown estimator, options of another estimator, or a
    seed outside 0 to 2^63 - 1.
    """
    kind = registry.lookup("estimators", estimator)
    options = default_options(estimator, problem) if options is None else options
    if not isinstance(options, kind.Options):
        raise InputError(f"estimator {estimator} takes {kind.Options.__name__}, not {type(options).__name__}.")
    if not 0 <= seed < 2**63:
        raise InputError(f"seed is {seed}; give a number from 0 to 2^63 - 1.")
    aligned = problem.aligned
    bounds = bounds_of(aligned, options.bound_px)
    clock = Clock(watch)
    start = time.perf_counter()
    try:
        clock.watch.check()
        outcome = kind.run(aligned, options, bounds, seed, clock)
        clock.watch.finish()
    except Cancelled as cancelled:
        raise cancelled.with_traceback(None) from None  # whose frames would keep the gigabytes of the run alive
    clock.timings_ms["total"] = (time.perf_counter() - start) * 1e3
    pose = None if outcome.cam_from_map is None else aligned.unalign_pose(outcome.cam_from_map)
    mask = aligned.full_mask(outcome.inlier_mask)
    found = f"Pose found: {np.count_nonzero(mask)} of {len(problem)} correspondences agree with it."
    return Trace(
        problem=problem,
        estimator=estimator,
        options=options,
        seed=seed,
        versions=versions(),
        stages=outcome.stages,
        timings_ms=clock.timings_ms,
        cam_from_map=pose,
        inlier_mask=mask,
        message=outcome.reason or " ".join(filter(None, (found, outcome.note))),
        certificate=outcome.certificate,
    )
