"""Loads or compiles the numeric kernels before they are needed, so that the first run does not have to wait.

A kernel is compiled for the types of its arguments, so a kernel that is loaded here is useful only if later calls have
the same types. That is why kernels pass constants to each other as ``np.int64(MAX_STEPS)``: for numba, a constant of a
module is a literal with a type of its own, for which the callee would be compiled again. For the same reason, a kernel
always gets arrays with the same layout, and always writable or always read-only ones.

numba compiles only one kernel at a time in a process, so parts of the work are done in processes of their own.
"""

import contextlib
import gc
import os
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spherloc import kernel_cache, registry
from spherloc.bounds import bounds_of
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.consensus.exact import MAX_POSES, certify
from spherloc.consensus.inliers import mark_each
from spherloc.consensus.level_pose import BestPoses, BoundedMatches, bounded_matches, empty_list
from spherloc.consensus.pair_arcs import yaws_between
from spherloc.consensus.translation_balls import apart_balls
from spherloc.consensus.two_point_search import search_two_point
from spherloc.consensus.yaw_bins import BIN_TURN, degree_bounds, largest_bin_cliques, sort_into_bins
from spherloc.datasets.synthetic import SyntheticScene
from spherloc.errors import InputError
from spherloc.estimators.base import estimate, options_type
from spherloc.narrowing import MAX_DESCENTS, NARROWINGS, descend, narrow, search_nearby, truncated_squares
from spherloc.problem import Problem
from spherloc.processors import processor_count
from spherloc.refine import (
    MAX_RESCUES,
    MAX_STEPS,
    fitted_path,
    matches_of,
    noise_of,
    record,
    refined_path,
    rescue,
    residuals_px,
)
from spherloc.solvers.p3p import p3p
from spherloc.watch import Watch

FASTEST = "ransac-2p"
"""The estimator with the fewest kernels."""
MAX_PROCESSES = 4
"""Largest number of processes that compile at the same time: each takes 300 MB."""


def warm_up(announce: Callable[[str], None] | None = None, estimators: Iterable[str] | None = None) -> None:
    """Run estimators once on a tiny problem: a minute or so after an installation, a fraction of a second later.

    ``estimators`` are the names of those that will be needed; all if it is None. ``announce`` is called with a sentence
    for the user if it will take long, and with one for every extension that fails here, without effect on others.
    """
    runs: dict[str, Callable[[], object]] = {}
    for name in registry.names("estimators") if estimators is None else estimators:
        runs |= _runs(name)
    own = [part for part in (*SHARED, *runs) if not registry.extension_of("estimators", part)]
    cold = [part for part in own if not _is_compiled(part)]
    if cold:
        if announce is not None:
            how_often = "once after an installation"
            if kernel_cache.is_temporary():
                how_often = "at every start, as no folder to keep them can be written (NUMBA_CACHE_DIR names another)"
            announce(f"compiling the solvers, {how_often}: {_expected(cold)} …")
        if processor_count() > 1:
            # The rest of the fastest estimator is compiled here, before another process would have started.
            apart = [part for part in cold if not part.startswith(FASTEST)]
            _compile_in_order(apart, told=lambda done: announce and announce(f"{done} of {len(cold)} parts compiled"))
    for part, run in runs.items():
        try:
            run()
        except InputError as error:
            if not registry.extension_of("estimators", part):
                raise
            if announce is not None:
                announce(f"{error} The others work.")
    for part in cold:
        _note_compiled(part)


def compile_apart(estimator: str, stopped: Callable[[], bool]) -> None:
    """Compile the kernels of an estimator in processes of low priority, and none in this process.

    Returns when that is done, at once if nothing is missing, or soon after ``stopped`` returns true.
    """
    _compile_in_order([part for part in (*SHARED, *_runs(estimator)) if not _is_compiled(part)], stopped, niceness=10)


@contextlib.contextmanager
def compiled_meanwhile(estimator: str) -> Iterator[None]:
    """Compile the kernels of an estimator on processors that what is done within leaves idle, as long as it lasts."""
    stopped = threading.Event()
    compilation = threading.Thread(target=compile_apart, args=(estimator, stopped.is_set), daemon=True)
    compilation.start()
    try:
        yield
    finally:
        stopped.set()
        compilation.join()


def tiny_problem() -> Problem:
    """A problem that every estimator must be able to solve: 8 matches, 2 of them wrong."""
    return _scene().problem()


def _scene() -> SyntheticScene:
    camera = Equirectangular(width=2048, height=1024)  # sharp enough for every stage to be run
    return SyntheticScene("warm-up", camera, correspondences=8, outlier_rate=0.25, noise_px=0.1, seed=0)


def _uncertain_problem() -> Problem:
    """A problem with uncertain gravity and enough matches for the whole last step."""
    return replace(_scene(), correspondences=40, noise_px=0.5, gravity_error_deg=0.5).problem()


def _uncertain(estimator: str) -> None:
    """An estimator on it, and what the exact search does only where it takes long."""
    problem = _uncertain_problem()
    estimate(problem, estimator)
    if estimator == "mc-exact":
        p3p(problem.aligned.bearings[None, :3], problem.aligned.points[None, :3])


def _noisy_problem() -> Problem:
    """A problem so noisy that the exact search uses its whole effort."""
    return replace(_scene(), correspondences=12, outlier_rate=0.6, noise_px=10.0).problem()


def _refine() -> None:
    """The refinement of a pose, which all estimators share."""
    problem = _uncertain_problem()
    assert problem.truth_cam_from_map is not None
    aligned, options = problem.aligned, options_type(FASTEST)()
    bounds, start = bounds_of(aligned, 3.0), aligned.align_pose(problem.truth_cam_from_map)
    path, _ = refined_path(aligned, start, bounds, options)
    fitted_path(aligned, path[-1], bounds.pixels, options)
    residuals_px(aligned, path[-1])
    record(aligned, path, bounds.pixels, options, measured=True)
    limits, states = np.full(len(aligned.points), bounds.noise_px), np.tile(start, (1 + MAX_RESCUES * MAX_STEPS, 1, 1))
    everything = np.ones(len(limits), np.bool_)
    rescue(matches_of(aligned), limits, everything, states, 1, noise_of(aligned, options))


def _search() -> None:
    """The search of two matches, which all estimators share."""
    aligned, options = _uncertain_problem().aligned, options_type(FASTEST)()
    bounds = bounds_of(aligned, 3.0)
    found = search_two_point(aligned, bounds.pixels, 0, 100, 0.99, options.scoring, True, Watch())
    rays = aligned.bearings, aligned.points, aligned.pixel_from_bearing
    mark_each(found.yaws_rad, found.translations, *rays, bounds.pixels)


def _narrow() -> None:
    """The fits at narrowing bounds, which all estimators share."""
    problem = _uncertain_problem()
    assert problem.truth_cam_from_map is not None
    aligned, options = problem.aligned, options_type(FASTEST)()
    bounds, matches, noise = bounds_of(aligned, 3.0), matches_of(aligned), noise_of(aligned, options)
    start, limits = aligned.align_pose(problem.truth_cam_from_map), np.full(len(aligned.points), bounds.noise_px)
    narrow(matches, bounds.pixels.copy(), limits, start.copy(), noise, np.empty((len(NARROWINGS), 3, 4)))
    _, cost = descend(matches, limits, start.copy(), noise, np.empty((MAX_DESCENTS, 3, 4)))
    search_nearby(matches, bounds.pixels.copy(), limits, start.copy(), noise, start.copy(), cost)
    truncated_squares(matches, limits, start.copy(), noise, np.inf)


def _proofs() -> None:
    """The kernels with which the exact search proves the bounds of yaw bins."""
    matches, best, nodes = _exact_search()
    yaws = yaws_between(0.0, BIN_TURN)
    certify(matches, yaws, nodes, apart_balls(matches, yaws, nodes, 2), best, Watch().board)


def _cliques() -> None:
    """The exact search for cliques of whole bins."""
    matches, best, nodes = _exact_search()
    pairs = np.array([(i, j) for j in nodes for i in range(j)], np.int32)
    board, ends = Watch().board, np.zeros(len(pairs))
    starts, edges = sort_into_bins(pairs, ends, ends.copy(), board)
    bound = degree_bounds(len(nodes), starts, edges, board)
    largest_bin_cliques(matches, starts, edges, bound, np.argsort(-bound), 1, best, board)


def _exact_search() -> tuple[BoundedMatches, BestPoses, NDArray[np.int64]]:
    """Matches, an empty list of poses, and the numbers (M,) of all matches."""
    aligned = _noisy_problem().aligned
    count = len(aligned.points)
    return bounded_matches(aligned, bounds_of(aligned, 40.0)), empty_list(MAX_POSES, count), np.arange(count)


SHARED: dict[str, Callable[[], object]] = {"refinement": _refine, "search": _search, "narrowing": _narrow}
"""Parts that all estimators need, by name; they are compiled first. Parts that share kernels are not next to each
other, so that the later one finds them compiled."""


def _runs(estimator: str) -> dict[str, Callable[[], object]]:
    """Calls that together compile all kernels of an estimator, by name; the first is a run of the estimator itself."""
    runs: dict[str, Callable[[], object]] = {estimator: lambda: estimate(tiny_problem(), estimator)}
    if estimator == "mc-exact":  # first the parts that share few kernels with the run that is compiled at the same time
        runs |= {f"{estimator}, proofs": _proofs, f"{estimator}, cliques": _cliques}
    if estimator in (FASTEST, "mc-exact"):
        runs[f"{estimator}, uncertain gravity"] = lambda: _uncertain(estimator)
    if estimator == "mc-exact":
        options = options_type(estimator)(bound_px=40.0)
        runs[f"{estimator}, large bound"] = lambda: estimate(_noisy_problem(), estimator, options)
    return runs


def _compile_in_order(
    parts: Sequence[str],
    stopped: Callable[[], bool] = lambda: False,
    niceness: int = 0,
    told: Callable[[int], object] = lambda done: None,
) -> None:
    """Compile parts in processes of their own, first those that all estimators share; ``told`` is how many are done.

    A part that fails there is compiled later where it is needed, and the error is raised then.
    """
    shared = [part for part in parts if part in SHARED]
    _compile_at_once(shared, stopped, niceness, told)
    own = [part for part in parts if part not in SHARED]
    _compile_at_once(own, stopped, niceness, lambda done: told(len(shared) + done))


def _compile_at_once(
    parts: Sequence[str], stopped: Callable[[], bool], niceness: int, told: Callable[[int], object]
) -> None:
    """Compile parts in processes of their own, as many at once as there are processors."""
    lanes, done = min(MAX_PROCESSES, processor_count()), 0
    waiting, running = deque(parts), []
    try:
        while (waiting or running) and not stopped():
            while waiting and len(running) < lanes:
                command = [sys.executable, "-m", "spherloc.warm_up", waiting.popleft(), str(niceness)]
                nothing = subprocess.DEVNULL
                running.append(subprocess.Popen(command, stdin=nothing, stdout=nothing, stderr=nothing))
            time.sleep(0.02)
            running = [process for process in running if process.poll() is None]
            if len(parts) - len(waiting) - len(running) > done:
                done = len(parts) - len(waiting) - len(running)
                told(done)
    except OSError:
        return
    finally:
        for process in running:
            process.kill()
            process.wait()


def _expected(cold: Sequence[str]) -> str:
    """Expected time of compiling, in words."""
    one_estimator = len({part.partition(",")[0] for part in cold} - SHARED.keys()) <= 1
    return "half a minute to a minute" if one_estimator else "one to two minutes"


def _is_compiled(part: str) -> bool:
    return _mark(part).exists()


def _note_compiled(part: str) -> None:
    with contextlib.suppress(OSError):
        _mark(part).touch()


def _mark(part: str) -> Path:
    """The file that says that a part was compiled, by this numba for this Python."""
    return kernel_cache.kernel_folder() / f"{part}-{sys.implementation.cache_tag}-numba{version('numba')}.compiled"


if __name__ == "__main__":
    part = sys.argv[1]
    gc.disable()  # saves a twentieth of the time, and the process ends soon
    if hasattr(os, "nice"):
        os.nice(int(sys.argv[2]))
    (_runs(part.partition(",")[0]) | SHARED)[part]()
    _note_compiled(part)
