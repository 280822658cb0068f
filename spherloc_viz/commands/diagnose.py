"""``spherloc diagnose``: poses that another program found become recorded runs with a diagnosis."""

import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from spherloc.datasets import load_scene
from spherloc.datasets.colmap import some
from spherloc.datasets.map_scene import MapScene
from spherloc.datasets.match_table import MatchTable
from spherloc.datasets.variation import used_seed
from spherloc.diagnosis import Diagnosis, diagnose
from spherloc.errors import InputError, SpherlocError, show
from spherloc.estimators import default_options, estimate
from spherloc.estimators.given_pose import LEAST
from spherloc.files import is_folder
from spherloc.formats.pose_files import read_poses
from spherloc.metrics import evaluate
from spherloc.outcome import Outcome, judge
from spherloc.problem import Problem
from spherloc.trace import Trace
from spherloc.trajectory import wxyz_from_rotation
from spherloc.types import FloatArray
from spherloc_viz.commands.progress import prepare, progress, say
from spherloc_viz.commands.run import Records, as_record, store_of
from spherloc_viz.options import json_text
from spherloc_viz.recording.origin import Origin

ESTIMATOR = "given-pose"
WITHOUT_POSE = "auto"
"""Estimator for queries without a pose of the other program."""


def diagnose_poses(
    poses: Path,
    scenes: Sequence[Path | MatchTable],
    bound_px: float | None,
    label: str | None,
    as_json: bool,
    records: Records | None,
) -> int:
    """Diagnose every pose whose image is a query of one of the scenes or tables; returns the exit code.

    Queries of a table without a pose are solved by ``WITHOUT_POSE``, where their gravity is stated.
    0 if all are localized, 1 if one is doubtful, 2 if something had to be left out. Raises ``InputError`` if no pose
    has a query.
    """
    given = read_poses(poses)
    if not given:
        raise InputError(f"{poses}: has no pose; give the results of a program that localized some of the images.")
    code, used = 0, set[str]()
    with store_of(records) as store:
        for scene in scenes:
            for name, problem, origin in _problems(scene, given):
                if isinstance(problem, SpherlocError):
                    say(f"{name}: {problem} It is left out.")
                    code = 2
                    continue
                used.add(name)
                trace = _run(problem, given[name], bound_px) if name in given else estimate(problem, WITHOUT_POSE)
                diagnosis, recording = diagnose(trace), None
                if store is not None:
                    recording = store.record(trace, origin, diagnosis)
                    if label:
                        store.index.set_review(recording.name, [label], "")
                _print(name, trace, diagnosis, recording, as_json)
                code = max(code, 0 if judge(trace).outcome is Outcome.LOCALIZED else 1)
    if not used and code == 0:
        some = ", ".join(list(given)[:3])
        raise InputError(
            f"{poses}: no image of a pose is a query of these scenes or matches; its images are such as {show(some)}."
        )
    # A COLMAP model has the images of the map beside the queries.
    if not is_folder(poses) and (left := [name for name in given if name not in used]):
        say(f"{len(left):,} of {len(given):,} poses have no query in these scenes, such as {show(left[0])}.")
    return code


def _problems(
    path: Path | MatchTable, given: Mapping[str, FloatArray]
) -> Iterator[tuple[str, Problem | SpherlocError, Origin]]:
    """For each query that has a pose: the name of the pose, the problem, and its origin.

    What is remarkable about the scene or its cameras is printed first.
    """
    if isinstance(path, MatchTable):
        _say_all(path.remarks)
        for name in path.matches:
            if name in given or path.gravity is not None:
                yield name, path.problem(name, given.get(name)), Origin("command")
        if path.gravity is None and (lost := [name for name in path.matches if name not in given]):
            say(
                f"{path.path}: {len(lost):,} queries have no pose, such as {show(lost[0])}; give --gravity, a file "
                "that says where down is, to see what their matches allow."
            )
        return
    scene = load_scene(path)
    origin = Origin("command", str(path.resolve()), used_seed(scene, None))
    if not isinstance(scene, MapScene):
        problem = scene.problem(None)
        _say_all(problem.remarks)
        image = None if problem.image is None else problem.image.name
        name = next((name for name in (problem.name, image, path.stem) if name in given), None)
        if name is not None:
            yield name, problem, origin
        return
    views = [view for view in scene.queries if view.name in given]
    if views:
        _say_all(scene.remarks)
        if lost := [view.name for view in scene.queries if view.name not in given]:
            say(
                f"{path}: {some(lost, 'query')} of {len(scene.queries):,} have no pose that is given, so nothing is "
                f"told of them; localize them with: spherloc localize {shlex.quote(str(path))}"
            )
        prepare(scene)
    with progress(len(views), "queries") as advance:
        for view in views:
            try:
                problem: Problem | SpherlocError = scene.problem(None, view.name)
            except SpherlocError as error:
                problem = error
            yield view.name, problem, replace(origin, query=view.name)
            advance("")


def _say_all(remarks: Sequence[str]) -> None:
    for remark in remarks:
        say(remark)


def _run(problem: Problem, cam_from_map: FloatArray, bound_px: float | None) -> Trace:
    """The pose (3, 4) as a run; numbers that are rounding are 0."""
    values = dict(
        zip(
            ("qw", "qx", "qy", "qz", "tx", "ty", "tz"),
            (*wxyz_from_rotation(cam_from_map[:, :3]), *cam_from_map[:, 3]),
            strict=True,
        )
    )
    numbers = {name: float(value) if abs(value) >= LEAST else 0.0 for name, value in values.items()}
    options = replace(default_options(ESTIMATOR, problem), **numbers)
    return estimate(problem, ESTIMATOR, options if bound_px is None else replace(options, bound_px=bound_px))


def _print(name: str, trace: Trace, diagnosis: Diagnosis, recording: Path | None, as_json: bool) -> None:
    if as_json:
        print(json_text(as_record(Path(name), trace, diagnosis, recording)), flush=True)
        return
    metrics = evaluate(trace)
    errors = ""
    if metrics.rotation_error_deg is not None and metrics.translation_error_m is not None:
        errors = (
            f", {metrics.rotation_error_deg:.3g} deg and {metrics.translation_error_m:.3g} {trace.problem.unit} off"
        )
    cause = f"{diagnosis.cause.value}. {diagnosis.summary}"
    solved = "" if trace.estimator == ESTIMATOR else f"no pose was given, {trace.estimator} finds one with which "
    print(f"{name}: {solved}{int(trace.inlier_mask.sum())} of {len(trace.problem)} agree{errors}: {cause}", flush=True)
    if recording is not None:
        print(f"    {recording}", flush=True)
