"""What every estimator offers, and the one function that runs one."""

import platform
from collections.abc import Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from importlib.metadata import version
from numbers import Real
from typing import Any, ClassVar, Protocol

import numpy as np

from spherloc import registry
from spherloc.bounds import Bounds, bounds_of
from spherloc.errors import InputError, show
from spherloc.problem import AlignedProblem, Problem
from spherloc.ranges import check_options, check_seed
from spherloc.refine import RefinementOptions
from spherloc.trace import Certificate, Stage, Trace
from spherloc.types import BoolArray, FloatArray
from spherloc.watch import Cancelled, Watch, working_s

REFINEMENT_FIELDS = {item.name for item in fields(RefinementOptions)}


@dataclass(frozen=True, eq=False)
class Estimate:
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
    """A frozen dataclass that derives from ``RefinementOptions``, with a default for every field; ``bound_px`` is one
    of them."""

    @staticmethod
    def run(aligned: AlignedProblem, options: Any, bounds: Bounds, seed: int, clock: "Clock") -> Estimate:
        """Solve; take every random draw from ``seed`` and report each stage's time to ``clock``.

        What may take longer than some hundredths of a second looks at ``clock.watch`` so often.
        """
        ...


class Clock:
    """Collects the time that named stages work, ms, without that of compiling kernels, and carries the run's watch."""

    def __init__(self, watch: Watch | None = None) -> None:
        self.timings_ms: dict[str, float] = {}
        self.watch = watch or Watch()

    @contextmanager
    def stage(self, name: str, until: float | None = None):
        """Time the body as ``name``, at whose end the watch's fraction is ``until`` (None: as it was).

        Raises ``Cancelled`` if the run shall end.
        """
        self.watch.begin(name, until)
        start = working_s()
        yield
        self.timings_ms[name] = _since_ms(start)


def _since_ms(start_s: float) -> float:
    """Milliseconds of work since ``start_s`` (``working_s``); another thread may have compiled for longer than that."""
    return max(0.0, working_s() - start_s) * 1e3


@lru_cache(maxsize=1)
def versions() -> dict[str, str]:
    """Versions of everything that can change a number."""
    packages = ("spherloc", "numpy", "scipy", "numba")
    return {"python": platform.python_version()} | {name: version(name) for name in packages}


def options_type(estimator: str) -> type:
    """The options dataclass of a registered estimator.

    Raises ``InputError`` if there is none of that name, or if it is an extension that cannot be used.
    """
    return estimator_of(estimator).Options


@lru_cache
def estimator_of(name: str) -> Any:
    """A registered estimator. Raises ``InputError`` if there is none of that name or it is no ``Estimator``."""
    kind = registry.lookup("estimators", name)
    options = getattr(kind, "Options", None)
    if not (
        isinstance(options, type) and issubclass(options, RefinementOptions) and callable(getattr(kind, "run", None))
    ):
        what = registry.title("estimators", name)
        raise InputError(f"{what} has no Options that derive from RefinementOptions, or no run(); tell its authors.")
    with registry.guarded("estimators", name):
        if not hasattr(options(), "bound_px"):
            raise InputError(f"{registry.title('estimators', name)} has no option bound_px; tell its authors.")
    return kind


def default_options(estimator: str, problem: Problem) -> Any:
    """The estimator's default options, with the problem's own pixel bound if it states one."""
    return _default_options(options_type(estimator), problem)


def _default_options(kind: type, problem: Problem) -> Any:
    return _options_with(kind, problem.bound_px)


@lru_cache
def _options_with(kind: type, bound_px: float | None) -> Any:
    return kind(**({} if bound_px is None else {"bound_px": bound_px}))


def _changed(estimator: str, default: Any, changes: Mapping[str, Any]) -> Any:
    """The default options with some of them changed; raises ``InputError`` for an unknown one."""
    known = [item.name for item in fields(default)]
    unknown = [key for key in changes if key not in known]
    if unknown:
        raise InputError(f"estimator {estimator} has no option {show(unknown[0])}; it has {', '.join(known)}.")
    return replace(default, **changes) if changes else default


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


def check_switches(options: Any) -> None:
    """Raise ``InputError`` if a field of ``options`` whose default is true or false is neither."""
    for item in fields(options):
        value = getattr(options, item.name)
        if isinstance(item.default, bool) and not isinstance(value, bool):
            raise InputError(f"option {item.name} is {show(value)}; give true or false.")


def check_sampling(options: Any, most: int) -> None:
    """Raise ``InputError`` if ``iterations`` is no whole number up to ``most``, or ``confidence`` no probability."""
    if options.iterations != int(options.iterations) or options.iterations > most:
        raise InputError(f"option iterations is {options.iterations}; give a whole number up to {most:,}.")
    if options.confidence is not None and options.confidence >= 1.0:
        raise InputError(f"option confidence is {options.confidence}; give a probability below 1.")


def estimate_faults(result: Any, count: int) -> list[str]:
    """What of an estimator's result has a form that cannot become a trace of ``count`` usable matches, in words."""
    pose = result.cam_from_map
    good = {
        "stages": all(isinstance(stage, Stage) and isinstance(stage.kind, str) for stage in result.stages),
        "a pose": pose is None or (np.shape(pose) == (3, 4) and bool(np.isfinite(pose).all())),
        "an inlier mask": np.shape(result.inlier_mask) == (count,) and np.asarray(result.inlier_mask).dtype == bool,
    }
    return [what for what, fits in good.items() if not fits]


def estimate(
    problem: Problem, estimator: str = "mc", options: Any = None, seed: int = 0, watch: Watch | None = None
) -> Trace:
    """Solve a problem and return the record of the run.

    ``options`` are an instance of ``options_type(estimator)``, or a dict of what differs from the defaults. The same
    arguments give the same trace but for its timings. ``watch``, a new one, follows the run and can cancel it from any
    thread.

    Raises ``Cancelled`` if it did, ``InputError`` for an unknown estimator, options of another estimator or beyond
    ``spherloc.ranges``, a seed outside 0 to 2^63 - 1, and for whatever an extension raises.
    """
    return run_estimator(estimator_of(estimator), estimator, problem, options, seed, watch)


def run_estimator(
    kind: Any, estimator: str, problem: Problem, options: Any = None, seed: int = 0, watch: Watch | None = None
) -> Trace:
    """``estimate`` by the estimator ``kind``, which need not be registered; ``estimator`` is what it is called.

    Raises ``InputError`` for options of another type, and for what ``estimate`` raises it.
    """
    if options is None or isinstance(options, Mapping):
        options = _changed(estimator, _default_options(kind.Options, problem), options or {})
    if not isinstance(options, kind.Options):
        raise InputError(f"estimator {estimator} takes {kind.Options.__name__}, not {type(options).__name__}.")
    check_options(options)
    check_seed(seed)
    aligned = problem.aligned
    bounds = bounds_of(aligned, float(options.bound_px))
    clock = Clock(watch)
    start = working_s()
    try:
        clock.watch.check()
        with registry.guarded("estimators", estimator):
            result = kind.run(aligned, options, bounds, seed, clock)
            is_extension = bool(registry.extension_of("estimators", estimator))
            if is_extension and (faults := estimate_faults(result, len(aligned.index))):
                what = f"{registry.title('estimators', estimator)} returned {' and '.join(faults)}"
                raise InputError(f"{what} of a wrong form; tell its authors.")
        clock.watch.finish()
    except Cancelled as cancelled:
        raise cancelled.with_traceback(None) from None  # whose frames would keep the gigabytes of the run alive
    clock.timings_ms["total"] = _since_ms(start)
    pose = None if result.cam_from_map is None else aligned.unalign_pose(result.cam_from_map)
    mask = aligned.full_mask(result.inlier_mask)
    found = f"Pose found: {np.count_nonzero(mask)} of {len(problem)} correspondences agree with it."
    return Trace(
        problem=problem,
        estimator=estimator,
        options=options,
        seed=seed,
        versions=versions(),
        stages=result.stages,
        timings_ms=clock.timings_ms,
        cam_from_map=pose,
        inlier_mask=mask,
        message=result.reason or " ".join(filter(None, (found, result.note))),
        certificate=result.certificate,
    )
