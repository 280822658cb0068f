"""``spherloc run``: solve scenes one after another, print and record each."""

import json
import sys
import typing
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, fields, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from spherloc.datasets import load_scene
from spherloc.errors import InputError, SpherlocError
from spherloc.estimators import default_options, estimate, options_type, warm_up
from spherloc.metrics import evaluate
from spherloc.problem import Problem
from spherloc.trace import Trace


def run_scenes(
    paths: Sequence[Path],
    estimator: str,
    seed: int | None,
    settings: Sequence[str],
    as_json: bool,
    recordings: Path | None,
) -> int:
    """Solve every scene; returns the exit code. A wrong input is reported and the others are still solved."""
    if not paths:
        raise InputError("no scene given; name one or more scene files, such as scenes/mei_outliers_80.toml.")
    changes = parse_settings(estimator, settings)
    warm = False
    jobs: list[Future[int]] = []
    worst = 0
    # One thread writes and prints, in order, while the next scene is being solved.
    with ThreadPoolExecutor(1) as finisher:
        for path in paths:
            try:
                scene = load_scene(path)
                problem = scene.problem(seed)
                if not warm:
                    warm_up(_say)
                    warm = True
                used = getattr(scene, "seed", 0) if seed is None else seed
                trace = estimate(problem, estimator, resolved_options(estimator, problem, changes), used)
            except SpherlocError as error:
                jobs.append(finisher.submit(_report, error))
                continue
            jobs.append(finisher.submit(_finish, path, trace, as_json, recordings))
        for job in jobs:
            worst = max(worst, job.result())
    return worst


def parse_settings(estimator: str, settings: Sequence[str]) -> dict[str, Any]:
    """Option values from "key=value" texts; raises ``InputError`` for an unknown key or a value of another type."""
    kind = options_type(estimator)
    hints = typing.get_type_hints(kind)
    known = {item.name for item in fields(kind)}
    changes: dict[str, Any] = {}
    for setting in settings:
        key, equals, value = setting.partition("=")
        if not equals or key not in known:
            raise InputError(f"option '{setting}' is unknown to {estimator}; give KEY=VALUE with {_names(known)}.")
        try:
            changes[key] = int(value) if hints[key] is int else float(value)
        except ValueError:
            raise InputError(f"option {key} is '{value}'; give a number.") from None
    return changes


def resolved_options(estimator: str, problem: Problem, changes: dict[str, Any]) -> Any:
    """The estimator's options for a problem, with the user's changes last."""
    return replace(default_options(estimator, problem), **changes)


def _names(known: set[str]) -> str:
    return ", ".join(sorted(known))


def _say(sentence: str) -> None:
    print(f"spherloc: {sentence}", file=sys.stderr, flush=True)


def _report(error: SpherlocError) -> int:
    _say(str(error))
    return 2


def _finish(path: Path, trace: Trace, as_json: bool, recordings: Path | None) -> int:
    """Record and print one run; returns its exit code."""
    code = 0 if trace.cam_from_map is not None else 1
    recording = None
    if recordings is not None:
        from spherloc_viz.recording.background import file_name
        from spherloc_viz.recording.writer import write_recording

        try:
            recording = write_recording(trace, recordings / file_name(trace, datetime.now(UTC)))
        except SpherlocError as error:
            code = _report(error)
    print(json.dumps(as_record(path, trace, recording)) if as_json else as_text(path, trace, recording), flush=True)
    return code


def as_record(path: Path, trace: Trace, recording: Path | None) -> dict[str, Any]:
    """A run as a JSON object."""
    pose = trace.cam_from_map
    return {
        "scene": str(path),
        "name": trace.problem.name,
        "estimator": trace.estimator,
        "seed": trace.seed,
        "options": asdict(trace.options),
        "cam_from_map": None if pose is None else pose.tolist(),
        "inliers": int(np.count_nonzero(trace.inlier_mask)),
        "correspondences": len(trace.problem),
        "time_ms": trace.timings_ms["total"],
        **asdict(evaluate(trace)),
        "message": trace.message,
        "recording": None if recording is None else str(recording),
    }


def as_text(path: Path, trace: Trace, recording: Path | None) -> str:
    """A run as a few lines for people."""
    metrics, pose = evaluate(trace), trace.cam_from_map
    lines = [f"{trace.problem.name} ({path}), {trace.estimator}, seed {trace.seed}"]
    if pose is None:
        lines.append(f"  {trace.message}")
    else:
        rows = "\n".join("    " + " ".join(f"{value: .6f}" for value in row) for row in pose)
        lines.append(f"  cam_from_map\n{rows}")
    lines.append(
        f"  {np.count_nonzero(trace.inlier_mask)} of {len(trace.problem)} correspondences are inliers, "
        f"{trace.timings_ms['total']:.1f} ms"
    )
    if metrics.rotation_error_deg is not None and metrics.translation_error_m is not None:
        verdict = "success" if metrics.success else "failure"
        lines.append(
            f"  {verdict}: {metrics.rotation_error_deg:.3f} deg and {100 * metrics.translation_error_m:.2f} cm "
            "off the truth"
        )
    if metrics.precision is not None and metrics.recall is not None and metrics.f1 is not None:
        lines.append(f"  precision {metrics.precision:.3f}, recall {metrics.recall:.3f}, F1 {metrics.f1:.3f}")
    if recording is not None:
        lines.append(f"  recorded: {recording}")
    return "\n".join(lines)
