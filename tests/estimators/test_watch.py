"""A run that is watched: it can be ended from another thread, says how far it is, and is the same run."""

import threading
import time
from dataclasses import fields

import numpy as np
import pytest
from numba.misc.quicksort import make_py_quicksort

from spherloc import registry
from spherloc.consensus.long_sort import order_of
from spherloc.errors import SpherlocError
from spherloc.estimators import default_options, estimate, options_type
from spherloc.watch import DONE, Cancelled, Watch
from tests.waiting import LIMIT_S

"""After which a run that does not begin, move or end is taken to be stuck."""

LONG = {
    # estimator: (correspondences, options) of a run of many seconds
    "ransac-2p": (500, {"iterations": 10_000_000}),
    "ransac-svd": (50, {"iterations": 1_000_000}),
    "ransac-mlpnp": (50, {"iterations": 1_000_000}),
    "ransac-p3p": (50, {"iterations": 1_000_000}),
    "ransac-epnp": (50, {"iterations": 1_000_000}),
    "ransac-odlt": (50, {"iterations": 1_000_000}),
    "ransac-epropnp": (50, {"iterations": 1_000_000}),
    "mc": (4000, {}),
    "mc-exact": (4000, {}),
    "auto": (4000, {}),
}


class Run(threading.Thread):
    """``estimate`` in a thread of its own; ``trace`` or ``error`` is what came of it."""

    def __init__(self, *arguments):
        super().__init__(daemon=True)
        self.watch, self.arguments, self.trace, self.error = Watch(), arguments, None, None
        self.start()

    def run(self):
        try:
            self.trace = estimate(*self.arguments, watch=self.watch)
        except Exception as error:
            self.error = error

    def until(self, reached):
        """Wait until the watch says so."""
        deadline = time.monotonic() + LIMIT_S
        while not reached(self.watch):
            assert self.is_alive() and time.monotonic() < deadline, (self.watch.stage, self.watch.fraction)
            time.sleep(0.001)
        return self

    def ended(self):
        """The error of the run, or None, once it is over."""
        self.join(LIMIT_S)
        assert not self.is_alive(), "the run does not end"
        return self.error


def long_run(scene_of, estimator):
    count, options = LONG[estimator]
    problem = scene_of("panorama", correspondences=count, outlier_rate=0.98).problem()
    return Run(problem, estimator, options_type(estimator)(**options))


def same(first, second):
    """Whether two traces, stages or arrays have the same numbers; timings do not count."""
    if isinstance(first, np.ndarray):
        return first.dtype == second.dtype and np.array_equal(first, second, equal_nan=first.dtype.kind == "f")
    if hasattr(first, "__dataclass_fields__"):
        names = [item.name for item in fields(first) if item.name not in ("problem", "timings_ms")]
        return type(first) is type(second) and all(same(getattr(first, n), getattr(second, n)) for n in names)
    if isinstance(first, tuple):
        return len(first) == len(second) and all(same(a, b) for a, b in zip(first, second, strict=True))
    return first == second or (first != first and second != second)


def test_every_estimator_is_tried():
    assert set(LONG) == set(registry.names("estimators"))


@pytest.mark.parametrize("estimator", LONG)
def test_cancelled_in_the_middle(scene_of, estimator):
    """Wherever it is: it ends, and much is left undone."""
    run = long_run(scene_of, estimator).until(lambda watch: watch.fraction > 0.0)
    assert run.watch.stage
    run.watch.cancel()
    assert isinstance(run.ended(), Cancelled)
    assert run.watch.fraction < 0.9, "it went on to its end"
    assert run.watch.cancelled


class Impatient(Watch):
    """Cancels as soon as a stage begins."""

    def __init__(self, stage):
        super().__init__()
        self.unwanted = stage

    def begin(self, stage, until=None):
        super().begin(stage, until)
        if stage == self.unwanted:
            self.cancel()


@pytest.mark.parametrize(
    "estimator, stage",
    [("ransac-2p", "ransac"), ("ransac-2p", "refinement"), ("ransac-epnp", "ransac")]
    + [("mc", stage) for stage in ("yaw", "sweep", "translation", "refinement")]
    + [("mc-exact", stage) for stage in ("guess", "pairs", "bins", "largest_bin_cliques", "search", "refinement")]
    + [("auto", stage) for stage in ("decision", "guess", "pairs")],
)
@pytest.mark.parametrize("outlier_rate", [0.5, 0.98])
def test_cancelled_in_a_stage(scene_of, estimator, stage, outlier_rate):
    """No later stage begins, and kernels that are told to stop at once leave nothing that breaks what follows."""
    watch = Impatient(stage)
    problem = scene_of("panorama", correspondences=200, outlier_rate=outlier_rate).problem()
    with pytest.raises(Cancelled):
        estimate(problem, estimator, watch=watch)
    assert watch.stage == stage and watch.fraction < 1.0


def test_cancelled_sampling_draws_no_more(scene_of):
    """Of ten million samples, some thousands or a few hundred thousand were drawn: the counter says so."""
    run = long_run(scene_of, "ransac-2p").until(lambda watch: watch.board[DONE] > 1000)
    run.watch.cancel()
    assert isinstance(run.ended(), Cancelled)
    drawn = int(run.watch.board[DONE])
    assert 1000 < drawn < 5_000_000
    assert run.watch.fraction == pytest.approx(0.99 * drawn / 10_000_000, rel=0.01)


@pytest.mark.parametrize("estimator", LONG)
def test_cancelled_before_it_begins(scene_of, estimator):
    watch = Watch()
    watch.cancel()
    with pytest.raises(SpherlocError, match=r"^The run was cancelled\.$"):
        estimate(scene_of("panorama").problem(), estimator, watch=watch)
    assert watch.stage == "" and watch.fraction == 0.0


def test_cancelled_run_keeps_nothing_alive(scene_of):
    """Who keeps the error would otherwise keep the gigabytes that the frames of its traceback refer to."""
    run = long_run(scene_of, "mc").until(lambda watch: watch.fraction > 0.1)
    run.watch.cancel()
    error, names = run.ended(), []
    traceback = error.__traceback__
    while traceback is not None:
        names.append(traceback.tb_frame.f_code.co_name)
        traceback = traceback.tb_next
    assert names == ["run", "estimate", "run_estimator"] and error.__context__ is None


@pytest.mark.parametrize("estimator", LONG)
@pytest.mark.parametrize("count, outlier_rate", [(2, 0.0), (40, 0.0), (120, 0.9)])
def test_same_trace_with_and_without(scene_of, estimator, count, outlier_rate):
    """And the fraction is 1 at the end, 0 before."""
    problem = scene_of("mei", correspondences=count, outlier_rate=outlier_rate).problem()
    watch = Watch()
    assert watch.fraction == 0.0 and watch.stage == ""
    watched = estimate(problem, estimator, seed=3, watch=watch)
    assert watch.fraction == 1.0 and watch.stage and not watch.cancelled
    assert same(watched, estimate(problem, estimator, seed=3))


@pytest.mark.parametrize(
    "estimator, options",
    [
        ("ransac-2p", {"iterations": 200_000}),
        ("ransac-2p", {"iterations": 10_000_000, "confidence": 0.9999, "scoring": "msac", "local_optimization": True}),
        ("ransac-svd", {"iterations": 2000, "confidence": 0.999}),
        ("mc", {}),
        ("mc-exact", {}),
        ("auto", {}),
    ],
)
def test_fraction_never_falls(scene_of, estimator, options):
    problem = scene_of("panorama", correspondences=800, outlier_rate=0.9).problem()
    run, seen = Run(problem, estimator, options_type(estimator)(**options)), [0.0]
    while run.is_alive():
        seen.append(run.watch.fraction)
        time.sleep(0.0005)
    assert run.ended() is None
    assert (np.diff(seen) >= 0.0).all() and max(seen) <= 1.0
    assert run.watch.fraction == 1.0


def test_confidence_is_what_is_nearer(scene_of):
    """A search that will be over after some hundred samples does not pretend that ten million lie ahead."""
    problem = scene_of("panorama", correspondences=100, outlier_rate=0.5).problem()
    options = options_type("ransac-2p")(iterations=10_000_000, confidence=0.99)
    stages = []

    class Listening(Watch):
        def begin(self, stage, until=None):
            stages.append((stage, self.fraction))
            super().begin(stage, until)

    watch = Listening()
    estimate(problem, "ransac-2p", options, watch=watch)
    assert [name for name, _ in stages][:2] == ["ransac", "refinement"]
    assert stages[1][1] > 0.9


def test_two_runs_at_once_do_not_disturb_each_other(scene_of):
    problem = scene_of("panorama", correspondences=700, outlier_rate=0.9).problem()
    options = default_options("mc", problem)
    long = long_run(scene_of, "ransac-2p").until(lambda watch: watch.fraction > 0.0)
    others = [Run(problem, "mc", options) for _ in range(2)]
    before = long.watch.fraction
    assert all(run.ended() is None for run in others)
    assert same(others[0].trace, others[1].trace) and same(others[0].trace, estimate(problem, "mc", options))
    assert long.is_alive() and before <= long.watch.fraction < 1.0
    third = Run(problem, "mc", options)
    long.watch.cancel()
    assert isinstance(long.ended(), Cancelled)
    assert third.ended() is None and same(third.trace, others[0].trace)


def test_a_stage_has_its_share():
    """The shares are fixed, and what a stage counts moves the fraction within its own."""
    watch = Watch()
    watch.begin("first", 0.5)
    assert (watch.stage, watch.fraction) == ("first", 0.0)
    watch.expect(4)
    for done, fraction in ((1, 0.125), (4, 0.5), (2, 0.5), (9, 0.5)):
        watch.reach(done)
        assert watch.fraction == fraction
    watch.begin("without a share")
    watch.expect(1)
    watch.reach(1)
    assert watch.fraction == 0.5
    watch.begin("second", 0.75)
    watch.expect(10**30)
    watch.reach(10**29)
    assert 0.5 <= watch.fraction <= 0.75
    watch.finish()
    assert watch.fraction == 1.0
    watch.cancel()
    for step in (watch.check, watch.finish, lambda: watch.reach(1), lambda: watch.begin("third", 1.0)):
        with pytest.raises(Cancelled):
            step()


def test_long_sort_is_the_sort_that_it_replaces(rng):
    """To the order of ties: the exact search depends on it."""
    board = Watch().board
    # The sort of compiled ``np.argsort``, here uncompiled.
    argsort = make_py_quicksort(is_argsort=True).run_quicksort
    for count in (0, 1, 2, 14, 15, 16, 17, 40, 1000, 5000):
        for values in (rng.random(count), rng.integers(0, max(1, count // 5), count) / 7.0, np.arange(count, 0.0, -1)):
            np.testing.assert_array_equal(order_of(values, board), argsort(values))
    stop = Watch()
    stop.cancel()
    assert sorted(order_of(rng.random(100), stop.board)) == list(range(100))
