"""A recorded run as a scene: its problem can be solved again, or otherwise, without the scene that it came from."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from spherloc.datasets import Scene
from spherloc.datasets.variation import Variation, used_seed
from spherloc.errors import InputError, RecordingError, show
from spherloc.estimators import options_type
from spherloc.problem import Problem
from spherloc.ranges import check_options
from spherloc_viz.given_files import check_recording_file
from spherloc_viz.options import OptionField, option_fields
from spherloc_viz.recording.content.reader import RecordedRun, read_recording
from spherloc_viz.recording.origin import Origin, Source
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

    Raises ``RecordingError``, in one sentence, if there is no such file or it is no whole recording of ours.
    """
    path = Path(path)
    check_recording_file(path)
    examine(path)
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
        raise RecordingError(f"{where}: its options are no table; record the run again.")
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
