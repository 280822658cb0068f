"""Numbers that nobody can calculate with are refused in a sentence, by the same table wherever they come from."""

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from spherloc import registry
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.datasets.synthetic import SyntheticScene
from spherloc.diagnosis import diagnose
from spherloc.errors import InputError, ProblemError
from spherloc.estimators import estimate, options_type
from spherloc.problem import Problem
from spherloc.ranges import MAX_OTHER, MAX_PX
from spherloc_viz.options import option_fields

SCENE = SyntheticScene("small", Equirectangular(1024, 512), correspondences=12, outlier_rate=0.25, noise_px=0.5, seed=0)
NUMBERS = (1e-320, 1e-300, 1e-9, -1.0, 0.0, 1e13, 1.7e308, float("inf"), float("nan"), 10**400, True, None, "1", [1.0])
NUMBERS += (np.float32(1e-30), np.int64(2**62), 0.999, 3.7)


@pytest.mark.parametrize("name", registry.names("estimators"))
def test_every_option_takes_a_number_or_refuses_it(name: str) -> None:
    """Each alone: noise of 1e-300 px was a LinAlgError and an effort of 1.7e308 an OverflowError, somewhere inside."""
    kind, problem = options_type(name), SCENE.problem()
    for item in fields(kind):
        for value in NUMBERS:
            try:
                options = kind(**{item.name: value})
            except InputError as error:
                assert item.name in str(error) and "; give" in str(error) and len(str(error)) < 200
                continue
            if item.name == "time_budget_s" or (item.name == "iterations" and isinstance(value, int) and value > 10**5):
                continue  # a whole number that takes its time
            trace = estimate(problem, name, options)
            assert trace.cam_from_map is None or np.isfinite(trace.cam_from_map).all(), f"{item.name} = {value}"
            assert diagnose(trace).summary is not None


def test_the_page_and_the_command_line_have_the_same_ranges() -> None:
    by_name = {field.name: field for field in option_fields(options_type("mc-exact"))}
    for name, text in (("noise_px", "1e-300"), ("effort", "1e13"), ("bound_px", "2e6"), ("effort", "1e-13")):
        with pytest.raises(InputError) as typed:
            by_name[name].parse(text)
        with pytest.raises(InputError) as given:
            options_type("mc-exact")(**{name: float(text)})
        assert str(typed.value) == str(given.value)
    options = options_type("mc-exact")(effort=MAX_OTHER, bound_px=MAX_PX)
    assert estimate(SCENE.problem(), "mc-exact", options).certificate is not None


@pytest.mark.parametrize("seed", [-1, 2**63, 1.5, float("nan"), None, "1", True, 10**400])
def test_a_seed_is_a_whole_number(seed: Any) -> None:
    with pytest.raises(InputError, match=r"^seed is .*; give a whole number from 0"):
        estimate(SCENE.problem(), "ransac-2p", seed=seed)
    assert estimate(SCENE.problem(), "ransac-2p", seed=np.int64(7)).seed == 7  # type: ignore[arg-type]


ARRAYS: tuple[Any, ...] = (None, "x", [], [[]], 5, {}, [[1, 2], [3]], np.zeros((0, 2)), np.zeros((3, 3)))
ARRAYS += (np.full((12, 2), np.nan), np.full((12, 3), 1e300), np.full((12, 3), 1e-300), np.zeros((12, 2, 2)))
ARRAYS += (np.full((12, 2), 1j), np.array([["a", "b"]] * 12), [[10**400, 1]] * 12, np.zeros((12, 3)), np.zeros((3, 4)))
SCALARS = (float("nan"), float("inf"), -1.0, 1e-320, 1e300, "0.1", [0.1], None, 10**400, True, object(), np.zeros(3))


def test_hostile_problems_are_a_sentence_or_solved() -> None:
    """Every field of a problem, replaced by what is none: 300 problems."""
    problem, solved = SCENE.problem(), 0
    for name in ("pixels", "points", "gravity_camera", "gravity_map", "truth_cam_from_map", "truth_inliers"):
        solved += sum(_solved(problem, name, value) for value in ARRAYS)
    for name in ("reference_index", "reference_pixels"):
        solved += sum(_solved(problem, name, value) for value in ARRAYS)
    for name in ("gravity_bound_rad", "gravity_sd_rad", "bound_px", "estimated_outlier_rate"):
        solved += sum(_solved(problem, name, value) for value in SCALARS)
    assert solved >= 10


def test_hostile_pairs_of_values_are_a_sentence_or_solved() -> None:
    """Seeded: large and small pixels, points, bounds and noise together."""
    rng = np.random.default_rng(20)
    problem = SCENE.problem()
    for _ in range(30):
        points = problem.points * 10.0 ** rng.uniform(-14, 14) + rng.choice([0.0, 1e9]) * rng.standard_normal(3)
        points[rng.integers(12)] *= 10.0 ** rng.uniform(-20, 20)
        changes: dict[str, Any] = {
            "points": points,
            "gravity_bound_rad": float(rng.choice([0.0, 1e-300, 0.01, 1.5])),
            "gravity_sd_rad": float(rng.choice([0.0, 1e-300, 0.01, 1e300, np.inf])),
            "truth_cam_from_map": None,
        }
        name = str(rng.choice(["mc", "mc-exact", "ransac-2p", "auto", "ransac-odlt", "ransac-epnp"]))
        try:
            given = {"bound_px": 10.0 ** rng.uniform(-6, 6), "noise_px": 10.0 ** rng.uniform(-6, 6)}
            trace = estimate(replace(problem, **changes), name, options_type(name)(**given))
        except ProblemError:
            continue
        assert trace.cam_from_map is None or np.isfinite(trace.cam_from_map).all()
        assert diagnose(trace).summary is not None


def _solved(problem: Problem, name: str, value: Any) -> bool:
    try:
        changed = replace(problem, **{name: value})
    except ProblemError as error:
        assert len(str(error)) < 300 and str(error).isprintable()
        return False
    trace = estimate(changed, "ransac-2p")
    assert trace.cam_from_map is None or np.isfinite(trace.cam_from_map).all()
    return True
