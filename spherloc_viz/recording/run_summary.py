"""A run summed up in the row that lists show of it."""

import hashlib
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import Any

from spherloc.datasets.variation import Variation
from spherloc.diagnosis import Diagnosis
from spherloc.metrics import Metrics
from spherloc.problem import Problem
from spherloc.trace import Trace
from spherloc_viz.options import json_text
from spherloc_viz.recording.content.names import FORMAT_VERSION
from spherloc_viz.recording.origin import Origin
from spherloc_viz.recording.run_row import RunRow

MAX_CHARACTERS = 2_000
"""Longest text in a row; a longer one is cut."""


def outcome(metrics: Metrics) -> str:
    """Success or failure by the limits of Sec. VI, or unknown where there is no truth to compare with."""
    return {True: "success", False: "failure", None: "unknown"}[metrics.success]


def problem_key(problem: Problem) -> str:
    """A hash of the numbers that an estimator sees: equal keys mean the same problem, whatever it is called."""
    told = hashlib.blake2b(digest_size=16)
    for array in (problem.pixels, problem.points, problem.gravity_camera, problem.gravity_map):
        told.update(array.tobytes())
    rest = [problem.gravity_bound_rad, problem.gravity_sd_rad, problem.bound_px, problem.estimated_outlier_rate]
    told.update(json_text([len(problem), problem.camera.to_dict(), *rest]).encode())
    return told.hexdigest()


def outlier_rate(problem: Problem) -> float | None:
    """Share of wrong correspondences: by their labels, else what the front end expects."""
    if problem.truth_inliers is None:
        return problem.estimated_outlier_rate
    return 1.0 - float(problem.truth_inliers.mean())


def run_row(
    trace: Trace, metrics: Metrics, diagnosis: Diagnosis, origin: Origin, created: datetime, **known: Any
) -> RunRow:
    """The row of a run; ``known`` are the fields that do not follow from it."""
    problem, certificate = trace.problem, trace.certificate
    return RunRow(
        created=created.isoformat(timespec="milliseconds"),
        source=origin.source,
        scene=cut(problem.scene if origin.scene_path is None else Path(origin.scene_path).name),
        name=cut(problem.name),
        query=cut(problem.image.name) if origin.query is None and problem.image is not None else origin.query,
        estimator=trace.estimator,
        seed=trace.seed,
        options=json_text(asdict(trace.options)),
        problem_key=problem_key(problem),
        outcome=outcome(metrics),
        diagnosis=diagnosis.cause.value,
        doubtful=diagnosis.doubtful,
        summary=cut(diagnosis.summary),
        message=cut(trace.message),
        correspondences=len(problem),
        inliers=int(trace.inlier_mask.sum()),
        outlier_rate=outlier_rate(problem),
        rotation_error_deg=metrics.rotation_error_deg,
        translation_error_m=metrics.translation_error_m,
        time_ms=trace.timings_ms.get("total", 0.0),
        proven=None if certificate is None else certificate.proven,
        changes=cut(changes_text(origin.variation)),
        metric=problem.metric,
        **asdict(diagnosis.measures),
        title=cut(origin.title),
        format_version=FORMAT_VERSION,
        **known,
    )


def changes_text(variation: Variation) -> str:
    """What is changed of a scene, in a few words; edits of single matches are counted."""
    named = {"spoiled": variation.spoiled, "mended": variation.mended, "hidden": variation.hidden}
    values = (f"{name} {_short(value)}" for name, value in variation.simulation.items())
    return ", ".join([*values, *(f"{len(matches)} {name}" for name, matches in named.items() if matches)])


def _short(value: Any) -> str:
    if isinstance(value, tuple):
        return " ".join(map(_short, value))
    return Path(value).name if isinstance(value, str) else f"{value:.4g}" if isinstance(value, float) else str(value)


def cut(text: str) -> str:
    """A text as rows have it."""
    return text if len(text) <= MAX_CHARACTERS else text[: MAX_CHARACTERS - 1] + "…"
