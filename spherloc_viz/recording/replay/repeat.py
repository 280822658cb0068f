"""Repeats a recorded run and compares: the same to the last bit, or what differs and what may be why."""

import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from spherloc.errors import InputError, RecordingError, SpherlocError
from spherloc.estimators import estimate
from spherloc.metrics import rotation_error_deg, translation_error_m
from spherloc.problem import Problem
from spherloc.trace import Certificate, Trace
from spherloc.types import FloatArray
from spherloc.warm_up import warm_up
from spherloc_viz.options import json_text
from spherloc_viz.recording.content.reader import RecordedRun
from spherloc_viz.recording.origin import machine
from spherloc_viz.recording.replay.scene import load_recorded_scene, missing_options, recorded_options

WORDS = {"name", "scene", "image", "reference_images", "remarks"}
"""Fields that only people read."""


def same_bits(a: Any, b: Any) -> bool:
    """Whether two arrays or numbers, or None, are equal in type, shape and every bit; NaN equals itself."""
    if a is None or b is None:
        return a is b
    left, right = np.asarray(a), np.asarray(b)
    return left.dtype == right.dtype and left.shape == right.shape and left.tobytes() == right.tobytes()


def different_fields(a: Problem, b: Problem) -> tuple[str, ...]:
    """Names of the fields in which two problems differ, but for the words about them."""
    names = [item.name for item in fields(Problem) if item.name not in WORDS | {"camera"}]
    changed = [name for name in names if not same_bits(getattr(a, name), getattr(b, name))]
    same_camera = type(a.camera) is type(b.camera) and a.camera.to_dict() == b.camera.to_dict()
    return (*([] if same_camera else ["camera"]), *changed)


ROUNDING = 1e-9
"""Numbers that differ by no more, relative to the largest of a pose's, differ by rounding."""
MACHINE = "machine"
Solve = Callable[[Problem, str, Any, int], Trace]


@dataclass(frozen=True)
class Difference:
    """One thing in which a run and its repetition differ."""

    what: str
    """Pose, inliers, certificate or message."""
    sentence: str
    """How, in numbers."""
    rounding: bool = False
    """Whether it is in the last digits only."""


@dataclass(frozen=True)
class OtherVersion:
    """Something that can change a number and is not what it was."""

    name: str
    """Package, "python" or "machine"."""
    recorded: str | None
    """None if the recording does not say."""
    here: str | None
    """None if it is not here."""


@dataclass(frozen=True, eq=False)
class Repeated:
    """A recorded run and what it gives here."""

    path: Path
    """The recording."""
    run: RecordedRun
    """What was recorded."""
    trace: Trace
    """What the same problem, options and seed give here."""
    differences: tuple[Difference, ...]
    """Nothing if it is the same run to the last bit."""
    rounding: bool
    """Whether the runs differ, but only in the last digits of numbers."""
    versions: tuple[OtherVersion, ...]
    """What is not what it was."""
    assumed: tuple[str, ...]
    """Options that the recording does not know; they have their defaults."""

    @property
    def same(self) -> bool:
        """Whether pose, inliers, certificate and message are the same, the pose in every bit."""
        return not self.differences


def repeat(path: Path, solve: Solve | None = None) -> Repeated:
    """Solve the problem of a recording again with its estimator, options and seed, and compare.

    ``solve`` does it in the place of ``estimate``: of untrusted options that may take hours.

    Raises ``RecordingError`` if there is no such recording, or this spherloc has no such estimator or option.
    """
    scene = load_recorded_scene(path)
    run, options = scene.run, recorded_options(scene.run, path)
    try:
        trace = (solve or estimate)(run.problem, run.estimator, options, run.seed)
    except InputError as error:
        raise RecordingError(f"{path}: cannot be repeated: {error}") from None
    differences = tuple(compare(run, trace))
    return Repeated(
        path=Path(path),
        run=run,
        trace=trace,
        differences=differences,
        rounding=bool(differences) and all(item.rounding for item in differences),
        versions=other_versions(run.versions, {**trace.versions, MACHINE: machine()}),
        assumed=missing_options(run),
    )


def compare(run: RecordedRun, trace: Trace) -> list[Difference]:
    """In what a run and its repetition differ."""
    found: list[Difference] = []
    if not same_bits(run.cam_from_map, trace.cam_from_map):
        found.append(_poses(run.cam_from_map, trace.cam_from_map))
    before, now = run.inlier_mask, trace.inlier_mask
    if not np.array_equal(before, now):
        gained, lost = (int(np.count_nonzero(mask)) for mask in (now & ~before, before & ~now))
        counts = f"{np.count_nonzero(before)} were recorded, {np.count_nonzero(now)} are found now"
        found.append(Difference("inliers", f"{counts}: {gained} more, {lost} no longer."))
    if run.certificate != trace.certificate:
        found.append(_certificates(run.certificate, trace.certificate))
    if run.message != trace.message:
        found.append(Difference("message", f"it was “{run.message}” and is “{trace.message}”"))
    return found


def other_versions(recorded: Any, here: Any) -> tuple[OtherVersion, ...]:
    """What is not what it was, by two tables of versions."""
    names = dict.fromkeys([*here, *recorded])
    pairs = [OtherVersion(name, recorded.get(name), here.get(name)) for name in names]
    return tuple(pair for pair in pairs if pair.recorded != pair.here)


def _poses(before: FloatArray | None, now: FloatArray | None) -> Difference:
    if before is None or now is None:
        some = ["no pose" if pose is None else "a pose" for pose in (before, now)]
        return Difference("pose", f"{some[0]} was recorded, {some[1]} is found now.")
    turn_deg, shift_m = rotation_error_deg(before, now), translation_error_m(before, now)
    near = bool(np.abs(before - now).max() <= ROUNDING * max(1.0, float(np.abs(before).max())))
    return Difference("pose", f"turned by {turn_deg:.3g} deg and moved by {shift_m:.3g} m.", near)


def _certificates(before: Certificate | None, now: Certificate | None) -> Difference:
    said = [
        "none"
        if item is None
        else f"{item.lower_bound} to {item.upper_bound} inliers and {item.nfa:.6g} sets by chance"
        for item in (before, now)
    ]
    near = (
        before is not None
        and now is not None
        and (before.lower_bound, before.upper_bound) == (now.lower_bound, now.upper_bound)
        and bool(np.isclose(before.nfa, now.nfa, rtol=ROUNDING, atol=0.0, equal_nan=True))
    )
    return Difference("certificate", f"{said[0]} was recorded, {said[1]} is found now.", near)


def repeat_all(paths: Sequence[Path], as_json: bool, solve: Solve | None = None) -> int:
    """Repeat recordings and print the outcome of each; returns the exit code.

    0 if all are the same, 1 if one differs, 2 if one cannot be repeated, which is reported while the others still are.
    ``solve`` does it in the place of ``estimate``. Raises ``InputError`` if there is none.
    """
    if not paths:
        raise InputError("no recording given; name one or more files (.rrd).")
    warm_up(_say)
    worst = 0
    for done, path in enumerate(paths):
        try:
            repeated = repeat(path, solve)
        except KeyboardInterrupt:
            _say(f"stopped in {path}; {done} of {len(paths)} recordings were repeated.")
            raise
        except SpherlocError as error:
            _say(str(error))
            worst = 2
            continue
        print(json_text(as_record(repeated)) if as_json else as_text(repeated), flush=True)
        worst = max(worst, 0 if repeated.same else 1)
    return worst


def _say(sentence: str) -> None:
    print(f"spherloc: {sentence}", file=sys.stderr, flush=True)


def as_text(repeated: Repeated) -> str:
    """A few lines; the first says whether it is the same run."""
    run = repeated.run
    what = f"{run.problem.name}, {run.estimator}, seed {run.seed}"
    lines = [f"{repeated.path}: {verdict(repeated)}", f"  {what}"]
    lines += [f"  {item.what}: {item.sentence}" for item in repeated.differences]
    if repeated.assumed:
        lines.append(f"  the recording does not know {', '.join(repeated.assumed)}: taken as by default")
    for item in repeated.versions:
        if repeated.same and item.recorded is None:
            continue  # what an older recording does not say has changed nothing
        lines.append(f"  {item.name}: {item.recorded or 'not recorded'} then, {item.here or 'none'} now")
    # What an untrusted file says must not steer the terminal.
    return "\n".join("".join(letter if letter.isprintable() else " " for letter in line) for line in lines)


def verdict(repeated: Repeated) -> str:
    """Whether it is the same run, as the end of a sentence."""
    if repeated.same:
        return "the same to the last bit"
    return "differs by rounding only" if repeated.rounding else "differs"


def as_record(repeated: Repeated) -> dict[str, Any]:
    """The same as what ``json_text`` writes."""
    run, trace = repeated.run, repeated.trace
    poses = [None if pose is None else pose.tolist() for pose in (run.cam_from_map, trace.cam_from_map)]
    return {
        "recording": str(repeated.path),
        "name": run.problem.name,
        "estimator": run.estimator,
        "seed": run.seed,
        "options": asdict(trace.options),
        "same": repeated.same,
        "rounding": repeated.rounding,
        "differences": [asdict(item) for item in repeated.differences],
        "recorded_cam_from_map": poses[0],
        "cam_from_map": poses[1],
        "assumed_options": list(repeated.assumed),
        "versions": [asdict(item) for item in repeated.versions],
    }
