"""Localizes the query images of a map scene, one after another; while one is solved, the next one is matched."""

import hashlib
import re
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar

import numpy as np

from spherloc.datasets.map_scene import MapScene
from spherloc.diagnosis import diagnose
from spherloc.errors import InputError, SpherlocError, show
from spherloc.estimators import estimate
from spherloc.experiments.configuration import DIGITS
from spherloc.experiments.results import FAILED, LOCALIZED, UNREADABLE, QueryResult
from spherloc.frontend.view import Matches, View
from spherloc.metrics import evaluate
from spherloc.outcome import judge
from spherloc.trace import RefinementStage, Trace
from spherloc.types import FloatArray

T = TypeVar("T")
R = TypeVar("R")

INITIALISED = "Initialised by"
"""Beginning of the remark of a query that the initialiser solved."""
_SLICE = re.compile(r"(-?\d{0,9}):(-?\d{0,9})(?::(-?\d{0,9}))?")


def chosen_queries(scene: MapScene, words: Sequence[str]) -> tuple[View, ...]:
    """The queries that ``words`` choose, in the order of the sequence; all of them without words.

    A word is a query's name or a slice FIRST:LAST:STEP as in Python: indices from 0, LAST excluded. Raises
    ``InputError`` for a name that does not exist and for a slice that chooses nothing.
    """
    places = {view.name: place for place, view in enumerate(scene.queries)}
    chosen: set[int] = set() if words else set(places.values())
    for word in words:
        match = _SLICE.fullmatch(word)
        if word in places or match is None:
            chosen.add(places[scene.query(word).name])
            continue
        first, last, step = (int(part) if part else None for part in match.groups())
        found = range(len(places))[slice(first, last, step)] if step != 0 else range(0)
        if not found:
            raise InputError(
                f"{show(word)} chooses none of the {len(places)} queries of {scene.where}; give FIRST:LAST:STEP, "
                "counted from 0."
            )
        chosen.update(found)
    return tuple(scene.queries[place] for place in sorted(chosen))


class How(NamedTuple):
    """Estimator, options and seed with which queries are solved."""

    estimator: str
    """Registered name of the estimator."""
    options: Any
    """The estimator's options, its dataclass."""
    seed: int
    """Seed, the same for every query."""
    initialiser: tuple[str, Any] | None = None
    """Estimator and options that solve the first query, every query after one that was not localized, and every query
    that ``estimator`` does not localize (Sec. VI-C); None leaves all queries to ``estimator``."""


def localize_queries(
    scene: MapScene, queries: Iterable[View], estimator: str, options: Any, seed: int
) -> Iterator[tuple[QueryResult, Trace | None]]:
    """Match and solve queries of the scene in their order; ``options`` is the estimator's dataclass.

    Gives each query's result, and its trace if there was a problem to solve. An error of one query is reported in its
    result and does not stop the others. Raises ``InputError`` for an unknown estimator, wrong options or seed.
    """
    wanted = ((view, (0,)) for view in queries)
    for _, row, trace in localize_by_each(scene, wanted, [How(estimator, options, seed)]):
        yield row, trace


def localize_by_each(
    scene: MapScene, queries: Iterable[tuple[View, Sequence[int]]], hows: Sequence[How]
) -> Iterator[tuple[int, QueryResult, Trace | None]]:
    """Like ``localize_queries``, but each query is matched once and solved by several estimators.

    Each query comes with the indices of the ``hows`` that are to solve it, each result with the index of its own.
    """
    places = {view.name: place for place, view in enumerate(scene.queries)}
    tracking = [False] * len(hows)
    for (view, chosen), (matches, matching_ms) in _one_ahead(lambda item: _match(scene, item[0]), queries):
        row = _unsolved(places[view.name], view, matching_ms)
        for index in chosen:
            found, trace = _solve(scene, view, matches, row, hows[index], tracking[index])
            tracking[index] = found.status == LOCALIZED
            yield index, found, trace


def solve_again(
    scene: MapScene, view: View, index: int, matched: Callable[[], Matches], how: How
) -> tuple[QueryResult, Trace | None]:
    """The result of one query, the scene's number ``index``, with the matches that ``matched`` finds for it, and its
    trace if there was a problem to solve. An error is reported in the result."""
    matches, matching_ms = _timed(matched)
    return _solve(scene, view, matches, _unsolved(index, view, matching_ms), how, tracking=True)


def _unsolved(index: int, view: View, matching_ms: float) -> QueryResult:
    """The row of a query that is matched."""
    row = QueryResult(index, view.name, FAILED, view.timestamp_s, matching_ms=matching_ms)
    return replace(row, truth_cam_from_map=_array(view.cam_from_map), inputs=inputs_of(view))


def has_changed(view: View, row: QueryResult) -> bool:
    """Whether a query is not what it was when its result was made; unknown for results of earlier versions."""
    return row.inputs is not None and row.inputs != inputs_of(view)


def inputs_of(view: View) -> str:
    """A digest of what a query's result depends on: its camera, gravity, true pose and size of the image file."""
    down, bound = (None, None) if view.gravity is None else (view.gravity.down, view.gravity.bound_rad)
    size_bytes = 0  # of an image that is rendered when it is needed, which depends on nothing else
    if type(view) is View:
        with suppress(OSError):
            size_bytes = view.path.stat().st_size
    given = (down, bound, view.cam_from_map)
    numbers = [None if array is None else (np.round(array, DIGITS) + 0.0).tolist() for array in given]
    return hashlib.sha256(f"{view.camera!r} {numbers} {size_bytes}".encode()).hexdigest()[:16]


def _match(scene: MapScene, view: View) -> tuple[Matches | SpherlocError, float]:
    return _timed(lambda: scene.matches(view))


def _timed(matched: Callable[[], Matches]) -> tuple[Matches | SpherlocError, float]:
    """The matches, or why there are none, and the time that took, ms."""
    start = time.perf_counter()
    try:
        found: Matches | SpherlocError = matched()
    except SpherlocError as error:
        found = error
    return found, (time.perf_counter() - start) * 1e3


def _solve(
    scene: MapScene, view: View, matches: Matches | SpherlocError, row: QueryResult, how: How, tracking: bool
) -> tuple[QueryResult, Trace | None]:
    """Solve one query. ``tracking`` says that the query before was localized: then the initialiser is used only if the
    estimator does not localize this one."""
    if isinstance(matches, SpherlocError):
        return replace(row, status=_status_without_matches(view), message=str(matches)), None
    row = replace(row, matches=len(matches.pixels), references=len(matches.references), remarks=matches.remarks)
    try:
        problem = scene.problem_of(view, matches)
    except InputError as error:
        return replace(row, message=str(error), estimated_outlier_rate=matches.estimated_outlier_rate), None
    if how.initialiser is None or tracking:
        trace = estimate(problem, how.estimator, how.options, how.seed)
        judged = _judged(scene, view, matches.references, trace, row)
        if how.initialiser is None or judged.status == LOCALIZED:
            return judged, trace
        row = replace(row, estimating_ms=judged.estimating_ms)
    name, options = how.initialiser
    trace = estimate(problem, name, options, how.seed)
    row = replace(row, remarks=(*row.remarks, f"{INITIALISED} {name}."))
    return _judged(scene, view, matches.references, trace, row), trace


def _status_without_matches(view: View) -> str:
    """The status of a query without matches: "unreadable" if its image cannot be used, else "failed"."""
    try:
        view.read()
        view.usable_pixels()
    except InputError:
        return UNREADABLE
    return FAILED


def _judged(scene: MapScene, view: View, references: tuple[View, ...], trace: Trace, row: QueryResult) -> QueryResult:
    """The row, filled in from the trace."""
    problem, metrics, pose = trace.problem, evaluate(trace), trace.cam_from_map
    judged, registration_error_m = judge(trace), None
    refinement = trace.stage(RefinementStage)
    expected = None if refinement is None or pose is None else refinement.expected_errors
    remarks = tuple(dict.fromkeys((*row.remarks, *problem.remarks[len(scene.problem_remarks) :])))
    if scene.registration is not None and pose is not None:
        try:
            registration_error_m = float(scene.registration(view, pose, references))
        except InputError as error:
            remarks = (*remarks, f"Not registered: {error}")
    return replace(
        row,
        status=str(judged.outcome),
        inliers=int(np.count_nonzero(trace.inlier_mask)),
        estimated_outlier_rate=problem.estimated_outlier_rate,
        true_outlier_rate=None if problem.truth_inliers is None else float(np.mean(~problem.truth_inliers)),
        rotation_error_deg=metrics.rotation_error_deg,
        translation_error_m=metrics.translation_error_m,
        expected_rotation_error_deg=None if expected is None else expected[0],
        expected_translation_error_m=None if expected is None else expected[1],
        registration_error_m=registration_error_m,
        gravity_source=problem.gravity_source,
        gravity_bound_deg=float(np.degrees(problem.gravity_bound_rad)),
        gravity_error_deg=None if problem.gravity_error_rad is None else float(np.degrees(problem.gravity_error_rad)),
        precision=metrics.precision,
        recall=metrics.recall,
        f1=metrics.f1,
        estimating_ms=trace.timings_ms["total"] + (row.estimating_ms or 0.0),
        diagnosis=str(diagnose(trace).cause),
        message=trace.message if pose is None else " ".join((trace.message, *judged.reasons)),
        remarks=remarks,
        cam_from_map=pose,
    )


def _array(value: Any) -> FloatArray | None:
    return None if value is None else np.asarray(value, dtype=np.float64)


def _one_ahead(work: Callable[[T], R], items: Iterable[T]) -> Iterator[tuple[T, R]]:
    """Each item with the result of ``work``, in order; a thread works on the next item while the caller uses one.

    It is a pool's, which Ctrl-C does not make Python forget: stopping a thread inside OpenCV would crash.
    """
    pool = ThreadPoolExecutor(1, "spherloc-matching")
    waiting: tuple[T, Future[R]] | None = None
    try:
        for item in items:
            done = None if waiting is None else (waiting[0], waiting[1].result())
            waiting = item, pool.submit(work, item)
            if done is not None:
                yield done
        if waiting is not None:
            yield waiting[0], waiting[1].result()
    finally:
        pool.shutdown(wait=False)
