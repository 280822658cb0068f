"""``spherloc run``: solve scenes one after another, print and record each."""

from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from spherloc.datasets import Scene, load_scene
from spherloc.datasets.correspondences import CorrespondencesScene
from spherloc.datasets.map_scene import MapScene
from spherloc.datasets.variation import Variation, used_seed
from spherloc.diagnosis import Diagnosis, diagnose
from spherloc.errors import InputError, RecordingError, SpherlocError, legible
from spherloc.estimators import default_options, options_type
from spherloc.metrics import evaluate, extent_of, said_length
from spherloc.outcome import Outcome, count_within_noise, judge
from spherloc.problem import Problem
from spherloc.trace import Trace
from spherloc.warm_up import warm_up
from spherloc_viz.commands.progress import prepare, say, solve
from spherloc_viz.given_files import is_recording
from spherloc_viz.options import json_text, option_fields
from spherloc_viz.recording.origin import Origin
from spherloc_viz.recording.storage.room import kept_bytes

if TYPE_CHECKING:
    from spherloc_viz.recording.storage.store import RecordingStore


@dataclass(frozen=True)
class Records:
    """Settings of the recording of runs."""

    folder: Path
    """Folder of the recordings."""
    full: bool = False
    """Whether every arc and edge is kept."""
    keep_gigabytes: float | None = None
    """Size beyond which old successes are deleted; None for the usual, or what is there if that is more."""


def run_scenes(
    paths: Sequence[Path],
    estimator: str,
    seed: int | None,
    settings: Sequence[str],
    as_json: bool,
    records: Records | None,
    *,
    query: str | None = None,
    variation: Variation | None = None,
    proof: Path | None = None,
) -> int:
    """Solve every scene; returns the exit code. A wrong input is reported and the others are still solved.

    ``query`` chooses a query image of scenes made of images, by default their first; ``variation`` changes every
    scene. A recording (.rrd) is a scene too, whose problem is the recorded one. Without ``records`` nothing is
    recorded. ``proof`` is a file for the proof of the only scene's certificate.
    """
    if proof is not None and len(paths) > 1:
        raise InputError(f"--proof takes one scene, not {len(paths)}; write a file for each.")
    if not paths:
        raise InputError("no scene given; name one or more scene files or bundled scenes, such as mei_outliers_80.")
    changes, variation = parse_settings(estimator, settings), variation or Variation()
    jobs: list[Future[int]] = []
    warm = False
    # One thread writes and prints, in order, while the next scene is being solved.
    with store_of(records) as store, ThreadPoolExecutor(1) as finisher:
        for path in paths:
            try:
                scene = open_scene(path)
                problem = _problem(path, scene, seed, query, variation)
                if not warm:
                    warm_up(say, [estimator])
                    warm = True
                options = resolved_options(estimator, problem, changes)
                trace = solve(problem, estimator, options, used_seed(scene, seed))
                origin = None if store is None else _origin(path, scene, seed, query, variation)
                if proof is not None:
                    _prove(trace, proof)
            except KeyboardInterrupt:
                say(f"stopped in {path}; {len(jobs)} of {len(paths)} scenes were solved.")
                raise
            except SpherlocError as error:
                jobs.append(finisher.submit(_report, error))
                continue
            jobs.append(finisher.submit(_finish, path, trace, origin, as_json, store))
        return max(job.result() for job in jobs)


def _prove(trace: Trace, path: Path) -> None:
    from spherloc.proof import write_proof

    try:
        cells = write_proof(trace, path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); check path and disk.") from None
    say(f"{path}: {cells:,} cells; check them with python -m spherloc.proof_check {path}")


def open_scene(path: Path) -> Scene:
    """The scene of a scene file or of a recording; raises ``SpherlocError`` if it is neither."""
    if not is_recording(path):
        return load_scene(path)
    from spherloc_viz.recording.replay import load_recorded_scene

    return load_recorded_scene(path)


def _origin(path: Path, scene: Scene, seed: int | None, query: str | None, variation: Variation) -> Origin:
    from spherloc_viz.recording.replay import origin_of

    return origin_of("command", path, scene, seed, query, variation)


@contextmanager
def store_of(records: Records | None) -> "Iterator[RecordingStore | None]":
    """The store of recordings, after unfinished files of killed processes in its folder have been recovered.

    Raises ``InputError`` for a wrong size to be kept.
    """
    if records is None:
        yield None
        return
    keep_bytes = kept_bytes(records.keep_gigabytes, records.folder)
    # Only now, since it takes most of a second.
    from spherloc_viz.recording.storage.store import RecordingStore

    with RecordingStore(records.folder, say, records.full, keep_bytes) as store:
        with suppress(OSError):  # an unreadable folder is reported when a run cannot be written
            try:
                store.tidy()
            except RecordingError as error:
                say(f"what killed processes left is not recovered: {error}")
        yield store


def _problem(path: Path, scene: Scene, seed: int | None, query: str | None, variation: Variation) -> Problem:
    """A scene's problem; the remarks of its loader and its front end are printed."""
    try:
        changed = variation.scene(scene)
        if not isinstance(changed, MapScene):
            for remark in changed.measured.remarks if isinstance(changed, CorrespondencesScene) else ():
                say(remark)
            return variation.problem(scene, seed, query)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    for remark in changed.problem_remarks:
        say(remark)
    view = changed.query(query)
    say(f"{path}: reading and matching images; what is new to this machine takes a while")
    prepare(changed)
    matches = changed.matches(view)
    for remark in matches.remarks:
        say(remark)
    problem = changed.problem_of(view, matches)
    for remark in problem.remarks[len(changed.problem_remarks) + len(matches.remarks) :]:
        say(remark)
    return variation.edit(problem, used_seed(scene, seed))


def parse_settings(estimator: str, settings: Sequence[str]) -> dict[str, Any]:
    """Option values from "key=value" texts; raises ``InputError`` for an unknown key or a value of another type."""
    known = {field.name: field for field in option_fields(options_type(estimator))}
    changes: dict[str, Any] = {}
    for setting in settings:
        key, equals, value = setting.partition("=")
        if not equals or key not in known:
            raise InputError(f"option '{setting}' is unknown to {estimator}; give KEY=VALUE with {', '.join(known)}.")
        changes[key] = known[key].parse(value)
    return changes


def resolved_options(estimator: str, problem: Problem, changes: dict[str, Any]) -> Any:
    """The estimator's options for a problem, with the user's changes last."""
    return replace(default_options(estimator, problem), **changes)


def _report(error: SpherlocError) -> int:
    say(str(error))
    return 2


def _finish(path: Path, trace: Trace, origin: Origin | None, as_json: bool, store: "RecordingStore | None") -> int:
    """Record and print one run; returns its exit code."""
    code = 0 if judge(trace).outcome is Outcome.LOCALIZED else 1
    recording, diagnosis = None, diagnose(trace)
    if store is not None:
        try:
            recording = store.record(trace, origin, diagnosis)
        except SpherlocError as error:
            code = _report(error)
    if as_json:
        print(json_text(as_record(path, trace, diagnosis, recording)), flush=True)
    else:
        print(as_text(path, trace, diagnosis, recording), flush=True)
    return code


def as_record(path: Path, trace: Trace, diagnosis: Diagnosis, recording: Path | None) -> dict[str, Any]:
    """A run as what ``json_text`` writes."""
    pose, certificate = trace.cam_from_map, trace.certificate
    judged = judge(trace)
    proven = {} if certificate is None else {"gap": certificate.gap, "proven": certificate.proven}
    return {
        "scene": str(path),
        "name": trace.problem.name,
        "estimator": trace.estimator,
        "seed": trace.seed,
        "options": asdict(trace.options),
        "cam_from_map": None if pose is None else pose.tolist(),
        "gravity_source": trace.problem.gravity_source,
        "gravity_bound_deg": float(np.degrees(trace.problem.gravity_bound_rad)),
        "inliers": int(np.count_nonzero(trace.inlier_mask)),
        "correspondences": len(trace.problem),
        "time_ms": trace.timings_ms["total"],
        **asdict(evaluate(trace)),
        "message": trace.message,
        "outcome": judged.outcome,
        "doubts": judged.reasons if pose is not None else (),
        "certificate": None if certificate is None else asdict(certificate) | proven,
        # Without "doubtful", which is the word for an outcome: the cause is "ok" or speaks against the pose.
        "diagnosis": {name: value for name, value in asdict(diagnosis).items() if name != "doubtful"},
        "recording": None if recording is None else str(recording),
    }


def _length(metres: float, problem: Problem) -> str:
    text = f"{100 * metres:.2f} cm" if problem.metric else f"{metres:.3g} {problem.unit}"
    return said_length(metres, extent_of(problem.points), text)


def _gravity(problem: Problem) -> str:
    error_rad = problem.gravity_error_rad
    off = "" if error_rad is None else f"; {np.degrees(error_rad):.3g} deg off the truth"
    return f"{problem.gravity_words}{off}"


def as_text(path: Path, trace: Trace, diagnosis: Diagnosis, recording: Path | None) -> str:
    """A run as a few lines of text for users."""
    metrics, pose = evaluate(trace), trace.cam_from_map
    # Texts of an untrusted recording must not control the terminal.
    name = "".join(letter if letter.isprintable() else " " for letter in trace.problem.name)
    lines = [f"{name} ({path}), {trace.estimator}, seed {trace.seed}"]
    if pose is None:
        lines.append(f"  {trace.message}")
    else:
        rows = "\n".join("    " + " ".join(f"{value: .6f}" for value in row) for row in pose)
        lines.append(f"  cam_from_map\n{rows}")
    inliers, explained = int(np.count_nonzero(trace.inlier_mask)), count_within_noise(trace)
    within = f", {explained} within the bound on the noise" if explained < inliers else ""
    lines.append(f"  {inliers} of {len(trace.problem)} matches are inliers{within}, {trace.timings_ms['total']:.1f} ms")
    if trace.problem.gravity_source:
        lines.append(f"  gravity {legible(_gravity(trace.problem))}")
    judged = judge(trace)
    if judged.outcome is Outcome.DOUBTFUL:
        lines.append(f"  doubtful: {' '.join(judged.reasons)}")
    if metrics.rotation_error_deg is not None and metrics.translation_error_m is not None:
        verdict = "success" if metrics.success else "failure"
        lines.append(
            f"  {verdict}: {metrics.rotation_error_deg:.3f} deg and "
            f"{_length(metrics.translation_error_m, trace.problem)} off the truth"
        )
    if metrics.precision is not None and metrics.recall is not None and metrics.f1 is not None:
        lines.append(f"  precision {metrics.precision:.3f}, recall {metrics.recall:.3f}, F1 {metrics.f1:.3f}")
    if trace.certificate is not None:
        # Only now: the layers take half a second.
        from spherloc_viz.layers.outcome import chance, proof, warning

        proven = proof(trace.certificate, explained)
        lines.append(f"  {proven}; NFA (expected number of false sets of this size): {chance(trace.certificate)}")
        lines += [f"  {sentence}" for sentence in (warning(trace.certificate),) if sentence]
    if diagnosis.doubtful:
        lines.append(f"  diagnosis: {diagnosis.cause}. {diagnosis.summary} {diagnosis.advice}".rstrip())
    if recording is not None:
        lines.append(f"  recorded: {recording}")
    return "\n".join(lines)
