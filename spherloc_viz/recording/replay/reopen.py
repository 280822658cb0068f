"""What a page needs to open a recorded run exactly as it was: its live scene, or else the recorded problem."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from spherloc.datasets import Scene, load_scene
from spherloc.datasets.variation import Variation
from spherloc.errors import SpherlocError, show
from spherloc.problem import Problem
from spherloc_viz.given_files import is_recording
from spherloc_viz.recording.content.reader import RecordedRun
from spherloc_viz.recording.origin import Origin
from spherloc_viz.recording.replay.repeat import different_fields
from spherloc_viz.recording.replay.scene import RecordedScene, recorded_options


@dataclass(frozen=True, eq=False)
class Reopened:
    """A run as it can be asked for again: these words give the same trace to the last bit."""

    scene: Scene
    """The live one, or a ``RecordedScene``."""
    path: Path
    """The scene file, or the recording; absolute."""
    label: str
    """What to call it."""
    seed: int
    """Of the simulation, of spoiled matches, and of the estimator."""
    query: str | None
    """Name of the query image; None for the first, or if there is none."""
    variation: Variation
    """What is changed about the scene; nothing about a recorded one, whose problem is changed already."""
    estimator: str
    """Registered name."""
    options: Any
    """An instance of its options."""
    sentence: str = ""
    """Why it is not the live scene; empty if it is."""

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
        return f"{show(file)} is no path"
