"""A recorded run as a scene: opened as it was, changed, and solved again to see whether every bit is the same."""

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from spherloc.datasets import Scene, load_scene
from spherloc.datasets.variation import Variation, used_seed
from spherloc.errors import InputError, RecordingError, SpherlocError, show
from spherloc.estimators import estimate, options_type
from spherloc.metrics import rotation_error_deg, translation_error_m
from spherloc.problem import Problem
from spherloc.ranges import check_options
from spherloc.trace import Certificate, Trace
from spherloc.types import FloatArray
from spherloc.warm_up import warm_up
from spherloc_viz.given_files import check_recording_file, is_recording
from spherloc_viz.options import OptionField, json_text, option_fields
from spherloc_viz.recording.origin import Origin, Source, machine
from spherloc_viz.recording.recorded_run import RecordedRun
from spherloc_viz.recording.sandbox.examiner import examine


@dataclass(frozen=True, eq=False)
class RecordedScene:
    """Gives the problem of a recording, bit for bit. Satisfies ``spherloc.datasets.Scene``."""

    run: RecordedRun
    """What was recorded."""
    path: Path
    """Its file."""

    @property
    def name(self) -> str:
        """That of the recorded problem."""
        return self.run.problem.name

    @property
    def seed(self) -> int:
        """The recorded one, which an estimator takes if it is given no other."""
        return self.run.seed

    def problem(self, seed: int | None = None) -> Problem:
        """The recorded problem; nothing about it is random, so ``seed`` changes nothing."""
        return self.run.problem


def load_recorded_scene(path: Path) -> RecordedScene:
    """The scene of a recording (.rrd), which may be untrusted: another process reads it first.

    Raises ``RecordingError``, in one sentence, if there is no such file or it is not a complete recording of spherloc.
    """
    path = Path(path)
    check_recording_file(path)
    examine(path)
    # Here, since it imports rerun, which takes a quarter of a second: a page should not wait for it.
    from spherloc_viz.recording.content.data import read_recording

    return RecordedScene(read_recording(path), path)


def origin_of(
    source: Source, path: Path, scene: Scene, seed: int | None, query: str | None, variation: Variation
) -> Origin:
    """Where a run of this scene comes from. That of an unchanged recorded problem comes from where the problem does."""
    if isinstance(scene, RecordedScene) and variation == Variation() and scene.run.origin is not None:
        return replace(scene.run.origin, source=source, title="", story="")
    if variation.camera is not None:
        variation = replace(variation, camera=str(Path(variation.camera).resolve()))
    return Origin(source, str(Path(path).resolve()), used_seed(scene, seed), query, variation)


def recorded_options(run: RecordedRun, where: Path) -> Any:
    """The options that a run was solved with, as its estimator takes them.

    What an older recording lacks has its default. Raises ``RecordingError`` if this spherloc has no such estimator or
    no such option, or a value is none that the option takes.
    """
    try:
        kind = options_type(run.estimator)
    except InputError as error:
        raise RecordingError(f"{where}: {error}") from None
    if not isinstance(run.options, Mapping):
        raise RecordingError(f"{where}: its options are not a table; record the run again.")
    known = {item.name: item for item in option_fields(kind)}
    for name, value in run.options.items():
        if name not in known:
            raise RecordingError(f"{where}: {run.estimator} has no option {show(name)} here; record the run again.")
        if not _takes(known[name], value):
            raise RecordingError(f"{where}: option {name} is {show(value)}, which it cannot be; record the run again.")
    try:
        options = kind(**run.options)
        check_options(options)
        return options
    except (InputError, TypeError, ValueError) as error:
        raise RecordingError(f"{where}: has options that cannot be: {error}") from None


def missing_options(run: RecordedRun) -> tuple[str, ...]:
    """Options of its estimator that a recording knows nothing of, since it is older than they are."""
    return tuple(item.name for item in fields(options_type(run.estimator)) if item.name not in run.options)


def _takes(option: OptionField, value: Any) -> bool:
    """Whether a value that a file says is one that ``option`` can have."""
    if value is None:
        return option.optional
    if option.choices:
        return isinstance(value, str) and value in option.choices
    if option.kind is float:
        return isinstance(value, int | float) and not isinstance(value, bool) and not math.isnan(value)
    whole = isinstance(value, float) and value.is_integer()
    return type(value) is option.kind or (option.kind is int and whole)


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
    """A version or machine that differs from the recorded one, and can change numbers."""

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
    """Versions and machine that differ from the recorded ones."""
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
    """The results in which a run and its repetition differ."""
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
    """What differs between two tables of versions."""
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


@dataclass(frozen=True, eq=False)
class Reopened:
    """All that a recorded run depends on: solving it again gives the same trace to the last bit."""

    scene: Scene
    """The live one, or a ``RecordedScene``."""
    path: Path
    """The scene file, or the recording; absolute."""
    label: str
    """What to call it."""
    seed: int
    """Seed of the simulation, of spoiled matches, and of the estimator."""
    query: str | None
    """Name of the query image; None for the first, or if there is none."""
    variation: Variation
    """What is changed about the scene; nothing about a recorded one, whose problem is changed already."""
    estimator: str
    """Registered name."""
    options: Any
    """An instance of its options."""
    sentence: str = ""
    """Why the recorded problem is opened instead of the scene; empty if it is the scene."""

    @property
    def live(self) -> bool:
        """Whether it is the scene that the run came from."""
        return not self.sentence


def reopen(run: RecordedRun, file: Path, roots: Sequence[Path]) -> Reopened:
    """Open the recording ``file``, which was read as ``run``.

    The scene that it came from is opened if its file, and that of its camera, lie in one of the folders ``roots``
    (links count as what they point to) and its problem is still the recorded one in every bit; for scenes of images
    that takes seconds, since they are matched. Raises ``RecordingError`` if this spherloc has no such estimator or
    option.
    """
    file = Path(file).resolve()
    options = recorded_options(run, file)
    live = _live(run, roots)
    if isinstance(live, str):
        name = f"{run.problem.name} (recorded)"
        scene = RecordedScene(run, file)
        return Reopened(scene, file, name, run.seed, None, Variation(), run.estimator, options, live)
    scene, origin = live
    path = Path(origin.scene_path or "").resolve()
    return Reopened(scene, path, scene.name, run.seed, origin.query, origin.variation, run.estimator, options)


def _live(run: RecordedRun, roots: Sequence[Path]) -> tuple[Scene, Origin] | str:
    """The scene that a run came from, or why it cannot be opened, in a sentence."""
    instead = "so the recorded problem is opened instead"
    origin = run.origin
    if origin is not None and origin.scene_path is None and origin.source == "gallery":
        return "The case was put together match by match: what is opened is the recorded problem."
    if origin is None or origin.scene_path is None:
        return f"The recording does not say which scene file it came from, {instead}."
    if is_recording(Path(origin.scene_path)):
        return f"The run was of the problem of another recording, {instead}."
    if origin.scene_seed not in (None, run.seed):
        return (
            f"The scene was drawn with the seed {origin.scene_seed} and solved with {run.seed}, which a page cannot, "
            f"{instead}."
        )
    for file in (origin.scene_path, origin.variation.camera):
        if file is not None and (reason := _forbidden(file, roots)):
            return f"{reason}, {instead}."
    try:
        scene = load_scene(Path(origin.scene_path))
        problem = _drawn(scene, origin, run.seed)
    except SpherlocError as error:
        return f"The scene cannot be opened as it was ({str(error).rstrip('.')}), {instead}."
    changed = different_fields(problem, run.problem)
    if changed:
        return f"The scene {show(scene.name)} gives another problem by now ({', '.join(changed)}), {instead}."
    return scene, origin


def _drawn(scene: Scene, origin: Origin, seed: int) -> Problem:
    return origin.variation.problem(scene, seed, origin.query)


def _forbidden(file: str, roots: Sequence[Path]) -> str:
    """Why a file may not be opened, as the start of a sentence; empty if it may."""
    try:
        path = Path(file).resolve()
        if not any(path.is_relative_to(Path(root).resolve()) for root in roots):
            return f"{Path(file).name} lies outside the folders that pages may open scenes from"
        return "" if path.is_file() else f"{Path(file).name} is no longer there"
    except (OSError, ValueError, RuntimeError):  # a path with a NUL, or a loop of links
        return f"{show(file)} is not a path"
