"""Decides whether a claim of the paper holds in the runs that were made: one function per kind of claim.

A claim about a rate holds if chance alone may explain the difference between the paper's runs and ours; a claim about
the order of two methods holds if the runs on the same problems show it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import fisher_exact

from spherloc.datasets import load_scene, scene_path
from spherloc.datasets.synthetic import SyntheticScene
from spherloc.estimators import estimate
from spherloc.geometry import pose, yaw_rotation
from spherloc.metrics import ransac_success_probability
from spherloc.problem import Problem
from spherloc.solvers.two_point import two_point
from spherloc.verification.experiments import CAMERAS, CASES, METHODS, OWN
from spherloc.verification.measured import Cell, Measured, SweepPoint, at, smaller_share

PAPER_RUNS = 100
"""Number of problems at each point of the paper's figures."""
CHANCE = 0.05
"""Probability below which chance does not explain a difference, shared by the points of a claim."""
NEARLY_ALL = 0.95
"""Least success rate that counts as "nearly 100 %"."""
DROP = 0.9
"""A success rate below this has dropped significantly."""
PAPERS_CAMERA = "MEI"
EXACT = 1e-6
"""Largest error of each number of a pose without noise, where only rounding is left."""
SAME_RUNS = 20


@dataclass(frozen=True)
class Finding:
    """Whether a claim holds for a choice of methods."""

    holds: bool
    """Whether it does."""
    ours: str
    """The measured result, in words and numbers."""
    decided_by: SweepPoint | None = None
    """The point that decides it, if there is one."""
    seed: int = 0
    """Seed of the run at that point that shows it."""


Check = Callable[[Measured], Finding | None]
"""Checks a claim; None if runs that it needs are missing."""


def _percent(cell: Cell) -> str:
    low, high = cell.interval
    return f"{100 * cell.rate:.0f} % ({100 * low:.0f} to {100 * high:.0f}, {cell.successes} of {cell.runs})"


def _name(value: float, experiment: str) -> str:
    return f"{value:g} px" if experiment == "fig5" else f"{100 * value:g} % outliers"


def rate_is(
    experiment: str, method: str, values: Sequence[float], rate: float, camera: str = PAPERS_CAMERA, least: bool = False
) -> Check:
    """The success rate is the paper's ``rate`` at each of the values, or, with ``least``, no lower."""

    def finding(measured: Measured) -> Finding | None:
        cells = at(measured.curve(experiment, camera, method), values)
        if not cells:
            return None
        chance = CHANCE / len(cells)
        off = [cell for cell in cells if differs(cell, rate, least) < chance]
        worst = min(off or cells, key=lambda cell: cell.rate if least else -abs(cell.rate - rate))
        where = _name(worst.place.value, experiment)
        what = f"{method}: {_percent(worst)} at {where}"
        if len(cells) > 1:
            what += f", the farthest off of {len(cells)} rates"
        return Finding(not off, what, worst.place, worst.decisive())

    return finding


def differs(cell: Cell, rate: float, least: bool = False) -> float:
    """p-value of Fisher's exact test of whether the paper's runs, at ``rate``, and ours have the same rate."""
    theirs = round(rate * PAPER_RUNS)
    table = [[cell.successes, cell.runs - cell.successes], [theirs, PAPER_RUNS - theirs]]
    tested: Any = fisher_exact(table, alternative="less" if least else "two-sided")
    return float(tested.pvalue)


def drops_at(experiment: str, method: str, value: float, before: Sequence[float], camera: str = PAPERS_CAMERA) -> Check:
    """The success rate is nearly 100 % at the values ``before`` and below 90 % at ``value``."""

    def finding(measured: Measured) -> Finding | None:
        curve = measured.curve(experiment, camera, method)
        there, earlier = at(curve, [value]), at(curve, before)
        if not there or not earlier:
            return None
        lowest = min(earlier, key=lambda cell: cell.rate)
        holds = there[0].rate < DROP and lowest.interval[1] >= NEARLY_ALL
        ours = (
            f"{method}: {_percent(there[0])} at {_name(value, experiment)}, before it no less than {_percent(lowest)}"
        )
        return Finding(holds, ours, there[0].place, there[0].decisive())

    return finding


def below(experiment: str, method: str, values: Sequence[float], rate: float, camera: str = PAPERS_CAMERA) -> Check:
    """The success rate is below ``rate`` at each of the values."""

    def finding(measured: Measured) -> Finding | None:
        cells = at(measured.curve(experiment, camera, method), values)
        if not cells:
            return None
        highest = max(cells, key=lambda cell: cell.rate)
        return Finding(
            highest.interval[0] < rate and highest.rate <= rate,
            f"{method}: at most {_percent(highest)}, at {_name(highest.place.value, experiment)}",
            highest.place,
            highest.decisive(),
        )

    return finding


def smaller(
    column: str,
    experiment: str,
    methods: tuple[str, str],
    values: Sequence[float],
    most: float = 1.0,
    camera: str = PAPERS_CAMERA,
    share_of_values: float = 1.0,
) -> Check:
    """The first method's median of a column is less than ``most`` times the second's, and most paired runs confirm it,
    at least at a share ``share_of_values`` of the values."""

    def finding(measured: Measured) -> Finding | None:
        firsts, seconds = (at(measured.curve(experiment, camera, name), values) for name in methods)
        pairs = [(a, b) for a in firsts for b in seconds if a.place.value == b.place.value]
        if not pairs:
            return None
        ratios, good = [], 0
        for first, second in pairs:
            ratios.append(first.median(column) / max(second.median(column), 1e-300))
            _, chance = smaller_share(first, second, column)
            good += ratios[-1] < most and chance < CHANCE / len(pairs)
        worst = int(np.argmax(ratios))
        a, b = pairs[worst]
        ours = (
            f"{methods[0]} {_quantity(a.median(column), column)}, {methods[1]} {_quantity(b.median(column), column)} "
            f"at {_name(a.place.value, experiment)}; smaller at {good} of {len(pairs)} values"
        )
        return Finding(good >= share_of_values * len(pairs), ours, a.place, a.rows[0].seed)

    return finding


def _quantity(value: float, column: str) -> str:
    if not np.isfinite(value):
        return "no pose"
    unit = {"time_ms": " ms", "rotation_error_deg": "°", "t_error_m": " m"}.get(column, "")
    return f"{value:.3g}{unit}"


def precision_is(experiment: str, method: str, values: Sequence[float], least: float) -> Check:
    """The median precision of the inliers is ``least`` or more at each of the values."""

    def finding(measured: Measured) -> Finding | None:
        cells = at(measured.curve(experiment, PAPERS_CAMERA, method), values)
        if not cells:
            return None
        worst = min(cells, key=lambda cell: cell.median("precision"))
        mean = float(worst.values("precision").mean())
        ours = (
            f"{method}: median {100 * worst.median('precision'):.0f} %, mean {100 * mean:.0f} % "
            f"at {_name(worst.place.value, experiment)}"
        )
        return Finding(worst.median("precision") >= least and mean >= least, ours, worst.place, worst.decisive())

    return finding


def order_of_error(experiment: str, methods: Sequence[str], value: float, most: float) -> Check:
    """The median |t_true - t| of every method is below ``most``, m."""

    def finding(measured: Measured) -> Finding | None:
        cells = [measured.cell(experiment, PAPERS_CAMERA, name, value) for name in methods]
        known = [cell for cell in cells if cell is not None]
        if not known:
            return None
        worst = max(known, key=lambda cell: cell.median("t_error_m"))
        ours = "; ".join(f"{cell.place.method} {cell.median('t_error_m'):.1e} m" for cell in known)
        return Finding(worst.median("t_error_m") < most, ours, worst.place, worst.rows[0].seed)

    return finding


def follows_eq_28(method: str, iterations: int, camera: str = PAPERS_CAMERA) -> Check:
    """The success rate of 2P at every outlier rate is that of Eq. 28 for two inliers in ``iterations`` samples."""

    def finding(measured: Measured) -> Finding | None:
        cells = measured.curve("fig6", camera, method)
        if not cells:
            return None
        predicted = [ransac_success_probability(1.0 - cell.place.value, 2, iterations) for cell in cells]
        chance = CHANCE / len(cells)
        gaps = [cell.rate - probability for cell, probability in zip(cells, predicted, strict=True)]
        off = [differs(cell, probability) < chance for cell, probability in zip(cells, predicted, strict=True)]
        worst = int(np.argmax(np.abs(gaps)))
        ours = (
            f"{method}: {_percent(cells[worst])} at {_name(cells[worst].place.value, 'fig6')}, where Eq. 28 gives "
            f"{100 * predicted[worst]:.0f} %"
        )
        return Finding(not any(off), ours, cells[worst].place, cells[worst].decisive())

    return finding


def best_of_case(key: str, method: str, others: Sequence[str]) -> Check:
    """No other method finds the pose of a case of Table VI more often."""

    def finding(measured: Measured) -> Finding | None:
        count = float(CASES[key][1])
        cell = measured.cell(key, "Kannala-Brandt", method, count)
        cell = cell or measured.cell(key + OWN, "Kannala-Brandt", method, count)
        rivals = [measured.cell(key, "Kannala-Brandt", name, count) for name in others]
        known = [rival for rival in rivals if rival is not None]
        if cell is None or not known:
            return None
        best = max(known, key=lambda rival: rival.rate)
        ours = f"{method}: {_percent(cell)}; best of the others: {best.place.method}, {_percent(best)}"
        return Finding(cell.rate >= best.rate, ours, cell.place, cell.decisive())

    return finding


def two_points_suffice(measured: Measured) -> Finding:
    """2P finds the true yaw and translation from two correspondences without noise, through each camera model."""
    found: list[str] = []
    right = total = 0
    for camera, name in CAMERAS.items():
        scene = load_scene(scene_path(Path(name)))
        assert isinstance(scene, SyntheticScene)
        exact = replace(scene, correspondences=2, outlier_rate=0.0, noise_px=0.0)
        here = sum(_solved_by_two(exact.problem(seed)) for seed in range(PAPER_RUNS))
        right, total = right + here, total + PAPER_RUNS
        found.append(f"{camera}: {here} of {PAPER_RUNS}")
    return Finding(right == total, "random pairs solved: " + ", ".join(found))


def _solved_by_two(problem: Problem) -> bool:
    aligned, truth = problem.aligned, problem.truth_cam_from_map
    assert truth is not None
    yaws, translations, exists = two_point(aligned.bearings[None], aligned.points[None])
    poses = [pose(yaw_rotation(yaw), t) for yaw, t in zip(yaws[exists], translations[exists], strict=True)]
    return any(np.abs(aligned.unalign_pose(one) - truth).max() < EXACT for one in poses)


def same_for_every_seed(measured: Measured) -> Finding:
    """MC gives the same pose to the last bit whatever seed it is given."""
    scene = load_scene(scene_path(Path(CAMERAS[PAPERS_CAMERA])))
    assert isinstance(scene, SyntheticScene)
    same = 0
    for seed in range(SAME_RUNS):
        problem = scene.problem(seed)
        options = METHODS["MC"].options(problem)
        one, other = (estimate(problem, "mc", options, seed=s).cam_from_map for s in (0, 1))
        same += one is not None and other is not None and np.array_equal(one, other)
    return Finding(
        same == SAME_RUNS, f"MC: the same pose to the last bit for two seeds in {same} of {SAME_RUNS} problems"
    )


def quicker_than(experiment: str, method: str, values: Sequence[float], most_ms: float) -> Check:
    """The median time is below ``most_ms`` at each of the values."""

    def finding(measured: Measured) -> Finding | None:
        cells = at(measured.curve(experiment, PAPERS_CAMERA, method), values)
        if not cells:
            return None
        slowest = max(cells, key=lambda cell: cell.median("time_ms"))
        took_ms = slowest.median("time_ms")
        ours = f"{method}: {took_ms:.3g} ms at {_name(slowest.place.value, experiment)}, the slowest"
        return Finding(took_ms < most_ms, ours, slowest.place, slowest.rows[0].seed)

    return finding
