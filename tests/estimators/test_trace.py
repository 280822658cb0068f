"""One run, one frozen record, which nobody can change afterwards."""

from dataclasses import FrozenInstanceError, fields, is_dataclass, replace

import numpy as np
import pytest

from spherloc import registry
from spherloc.errors import InputError
from spherloc.estimators import default_options, estimate, options_type
from spherloc.trace import RansacStage, RefinementStage, TranslationStage, YawStage

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

ESTIMATORS = registry.names("estimators")


def leaves(value, path):
    """(path, value) of everything in a trace, arrays as they are."""
    if is_dataclass(value):
        for item in fields(value):
            yield from leaves(getattr(value, item.name), f"{path}.{item.name}")
    elif isinstance(value, tuple):
        for k, item in enumerate(value):
            yield from leaves(item, f"{path}[{k}]")
    else:
        yield path, value


@pytest.fixture(scope="module", params=ESTIMATORS)
def trace(request, scene_of):
    return estimate(scene_of("mei").problem(), request.param, seed=7)


def test_both_estimators_are_registered():
    assert {"mc", "ransac-2p"} <= set(ESTIMATORS)


def test_every_array_is_read_only(trace):
    arrays = [(path, value) for path, value in leaves(trace, "trace") if isinstance(value, np.ndarray)]
    assert [path for path, array in arrays if array.flags.writeable] == []


def test_nothing_can_be_reassigned(trace):
    for owner in (trace, trace.problem, trace.options, *trace.stages):
        for item in fields(owner):
            with pytest.raises(FrozenInstanceError):
                setattr(owner, item.name, None)
    for mapping in (trace.versions, trace.timings_ms):
        with pytest.raises(TypeError):
            mapping["numpy"] = 1


def test_solving_leaves_the_problem_alone(scene_of):
    problem = scene_of("fisheye").problem()
    before = {name: np.array(getattr(problem, name)) for name in ("pixels", "points", "bearings", "usable")}
    for estimator in ESTIMATORS:
        estimate(problem, estimator)
    for name, array in before.items():
        np.testing.assert_array_equal(getattr(problem, name), array)


def test_record_is_complete(trace):
    assert trace.seed == 7
    assert trace.options == options_type(trace.estimator)()
    assert {"spherloc", "numpy", "numba", "python"} <= trace.versions.keys()
    assert trace.timings_ms["total"] >= max(trace.timings_ms.values())
    assert all(time >= 0 for time in trace.timings_ms.values())
    assert [stage.kind for stage in trace.stages if stage.kind in trace.timings_ms] == [s.kind for s in trace.stages]
    assert trace.inlier_mask.shape == (len(trace.problem),) and trace.inlier_mask.dtype == bool
    assert trace.message.endswith(".") and "\n" not in trace.message


def test_stage_is_found_by_type(scene_of):
    problem = scene_of("mei").problem()
    mc, ransac = estimate(problem, "mc"), estimate(problem, "ransac-2p")
    assert mc.stage(YawStage) is mc.stages[0] and mc.stage(RansacStage) is None
    assert ransac.stage(RansacStage) is ransac.stages[0] and ransac.stage(TranslationStage) is None
    assert mc.stage(RefinementStage) is mc.stages[-1]


def test_defaults_take_the_scenes_bound(scene_of):
    problem = scene_of("mei", bound_px=2.5).problem()
    for estimator in ESTIMATORS:
        assert default_options(estimator, problem).bound_px == 2.5
        assert estimate(problem, estimator).options.bound_px == 2.5
        assert default_options(estimator, replace(problem, bound_px=None)) == options_type(estimator)()


def test_wrong_arguments_are_input_errors(scene_of):
    problem = scene_of("mei").problem()
    with pytest.raises(InputError, match="unknown estimator 'nothing': choose one of auto, mc, mc-exact, ransac-2p, "):
        estimate(problem, "nothing")
    with pytest.raises(InputError, match="takes McOptions, not RansacOptions"):
        estimate(problem, "mc", options_type("ransac-2p")())
    for seed in (-1, 2**63):
        with pytest.raises(InputError, match=f"seed is {seed}"):
            estimate(problem, "mc", seed=seed)
    assert estimate(problem, "ransac-2p", seed=2**63 - 1).seed == 2**63 - 1
