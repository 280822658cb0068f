"""The contracts of solvers and of estimators."""

import math
from dataclasses import FrozenInstanceError, is_dataclass, replace
from typing import Any

import numpy as np

from spherloc.bounds import Bounds
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.datasets.synthetic import SyntheticScene
from spherloc.errors import InputError, ProblemError, show
from spherloc.estimators.base import Clock, Outcome, estimator_of, outcome_faults, run_estimator
from spherloc.geometry import pose, so3_exp
from spherloc.metrics import evaluate, rotation_error_deg, translation_error_m
from spherloc.problem import AlignedProblem, Problem
from spherloc.refine import RefinementOptions
from spherloc.solvers.base import Solver, solver_of
from spherloc.testing.saying import Saying, difference, name_of
from spherloc.trace import Trace
from spherloc.types import FloatArray
from spherloc.watch import Cancelled, Watch


def check_solver(solver: Solver | str) -> None:
    """Raise ``AssertionError`` unless a solver, or the one registered under a name, keeps the contract of
    ``spherloc.solvers.base.Solver``.

    Of noise-free correspondences one of its poses is the true one, within 1e-6 rad and m, for one more than
    ``sample_size`` always and for a minimal sample in 9 of 10; solutions are rotations and finite, also of degenerate
    input; the same input gives the same bits; its arrays are left alone; and wrong input is a ``ProblemError``.
    """
    say = Saying(f"the solver {show(solver if isinstance(solver, str) else getattr(solver, 'name', solver))}")
    solver = solver_of(solver) if isinstance(solver, str) else solver
    rng, size = np.random.default_rng(0), solver.sample_size
    minimal = 0
    for round_ in range(40):
        for count in (size, size + 1, size + 10):
            bearings, points, truth = _correspondences(rng, count, solver.pinhole)
            before = bearings.copy(), points.copy()
            found = solver.solve(bearings, points)
            where = f"of {count} correspondences (round {round_})"
            say.need(np.ndim(found) == 3 and np.shape(found)[1:] == (3, 4), f"gives no (S, 3, 4) array {where}")
            say.need(np.array_equal(before, (bearings, points)), f"changes its input {where}")
            say.need(np.array_equal(found, solver.solve(bearings, points)), f"is not deterministic {where}")
            _check_rotations(found, say, where)
            exact = any(math.radians(rotation_error_deg(truth, one)) < 1e-6 and translation_error_m(truth, one) < 1e-6
                        for one in found)  # fmt: skip
            minimal += exact and count == size
            say.need(exact or count == size, f"does not find the true pose {where} without noise")
    say.need(minimal >= 36, f"finds the true pose of {size} correspondences without noise {minimal} times in 40")
    bearings, points, _ = _correspondences(rng, size + 6, solver.pinhole)
    line = points[0] + np.arange(len(points))[:, None] * (points[1] - points[0])
    for what, one, other in (
        ("one point", bearings, np.repeat(points[:1], len(points), axis=0)),
        ("one bearing", np.repeat(bearings[:1], len(points), axis=0), points),
        ("points on a line", bearings, line),
    ):
        found = solver.solve(one, other)
        say.need(np.ndim(found) == 3 and bool(np.isfinite(found).all()), f"gives numbers that are not finite of {what}")
    wrong = [("bearings of shape (N, 2)", bearings[:, :2], points), ("a point too few", bearings, points[:-1])]
    wrong.append((f"{size - 1} correspondences", bearings[: size - 1], points[: size - 1]))
    if solver.pinhole:
        wrong.append(("a bearing behind the camera", -bearings, points))
    for what, one, other in wrong:
        say.raises(ProblemError, lambda one=one, other=other: solver.solve(one, other), f"of {what}")


def check_estimator(estimator: str | Any) -> None:
    """Raise ``AssertionError`` unless an estimator, by its registered name or the object itself, keeps the contract of
    ``spherloc.estimators.base.Estimator``.

    It finds the pose of easy problems (60 matches, 20 % wrong, 100 degrees wide); the same seed gives the same bits;
    what it returns has the right forms; too few, wrong and equal matches end in a sentence or a finite pose; options
    are frozen and refuse nonsense with ``InputError``; and a cancelled run begins no further stage.
    """
    name = estimator if isinstance(estimator, str) else name_of(estimator)
    say = Saying(f"the estimator {show(name)}")
    kept = _Kept(estimator_of(estimator) if isinstance(estimator, str) else estimator, say)
    kept.check_options()
    camera = Equirectangular(2048, 1024)
    easy = SyntheticScene("easy", camera, 60, 0.2, 0.5, 0, field_of_view_deg=100.0)
    for seed in range(3):
        problem = easy.problem(seed)
        trace = kept.solve(problem, seed)
        say.need(bool(evaluate(trace).success), f"does not find the pose of an easy problem (seed {seed})")
        changed = difference(trace, kept.solve(problem, seed), "the trace")
        say.need(not changed, f"is not deterministic: {changed} changes from run to run with seed {seed}")
    alike = replace(easy, correspondences=6).problem()
    alike = replace(alike, points=np.repeat(alike.points[:1], len(alike), axis=0), truth_cam_from_map=None)
    for what, hard in (
        ("two matches", replace(easy, correspondences=2, outlier_rate=0.0).problem()),
        ("three matches", replace(easy, correspondences=3).problem()),
        ("outliers only", replace(easy, correspondences=20, outlier_rate=1.0).problem()),
        ("matches with one point", alike),
    ):
        try:
            kept.solve(hard, 0)
        except AssertionError:
            raise
        except Exception as error:
            say.fail(f"raises {error!r} of {what}; return an Outcome without a pose and the reason")
    watch = _Impatient()
    try:
        kept.solve(problem, 0, watch)
    except Cancelled:
        say.need(len(watch.begun) <= 1, f"goes on to the stage {show(watch.begun[-1])} after it was cancelled")
    else:
        say.fail("is not ended by its watch: do not catch Cancelled")


def _correspondences(rng: np.random.Generator, count: int, ahead: bool) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Unit bearings (N, 3) all around or within 120 degrees, points (N, 3), and their pose (3, 4)."""
    plane = np.column_stack([rng.uniform(-1.7, 1.7, (count, 2)), np.ones(count)])
    rays = plane * rng.uniform(1.0, 8.0, (count, 1)) if ahead else 4.0 * rng.standard_normal((count, 3))
    truth = pose(so3_exp(rng.normal(size=3)), rng.uniform(-20.0, 20.0, 3))
    return rays / np.linalg.norm(rays, axis=1, keepdims=True), (rays - truth[:, 3]) @ truth[:, :3], truth


def _check_rotations(found: FloatArray, say: Saying, where: str) -> None:
    rotations = found[:, :, :3]
    good = np.isfinite(found).all() and np.allclose(rotations @ rotations.transpose(0, 2, 1), np.eye(3), atol=1e-9)
    say.need(good and (np.linalg.det(rotations) > 0.0).all(), f"gives a pose whose left block is no rotation {where}")


class _Impatient(Watch):
    """Cancels the run as soon as a stage begins."""

    def __init__(self) -> None:
        super().__init__()
        self.begun: list[str] = []

    def begin(self, stage: str, until: float | None = None) -> None:
        super().begin(stage, until)
        self.begun.append(stage)
        self.cancel()


class _Kept:
    """An estimator whose outcomes are looked at."""

    def __init__(self, estimator: Any, say: Saying) -> None:
        self._estimator, self._say = estimator, say
        self.Options: Any = getattr(estimator, "Options", None)

    def check_options(self) -> None:
        say, options = self._say, self.Options
        derived = isinstance(options, type) and issubclass(options, RefinementOptions) and is_dataclass(options)
        say.need(derived, "has no Options, a dataclass that derives from RefinementOptions")
        default = options()
        say.need(hasattr(default, "bound_px"), "has no option bound_px")
        try:
            default.noise_px = 1.0  # pyright: ignore[reportAttributeAccessIssue]
        except FrozenInstanceError:
            pass
        else:
            say.fail("has Options that can be changed; make it a frozen dataclass")
        for value in (0.0, -1.0, math.nan, "x", None):
            say.raises(InputError, lambda value=value: self.Options(bound_px=value), f"for bound_px = {show(value)}")

    def solve(self, problem: Problem, seed: int, watch: Watch | None = None) -> Trace:
        return run_estimator(self, "checked", problem, None, seed, watch)

    def run(self, aligned: AlignedProblem, options: Any, bounds: Bounds, seed: int, clock: Clock) -> Outcome:
        outcome, say = self._estimator.run(aligned, options, bounds, seed, clock), self._say
        faults = outcome_faults(outcome, len(aligned.index))
        say.need(not faults, f"returns {' and '.join(faults)} of a wrong form")
        if outcome.cam_from_map is None:
            say.need(outcome.reason.endswith("."), "gives no pose and no reason, which is a sentence")
            say.need(not outcome.inlier_mask.any(), "has inliers without a pose")
        else:
            say.need(not outcome.reason, f"has a pose and the reason {show(outcome.reason)} why there is none")
            _check_rotations(np.asarray(outcome.cam_from_map)[None], say, "of its result")
        return outcome
