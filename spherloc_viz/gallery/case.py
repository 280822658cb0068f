"""What a case of the gallery is: a run that is described wholly, the story it tells, and what shows that it is true."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from spherloc.datasets import Scene, load_scene
from spherloc.datasets.staged import StagedScene
from spherloc.datasets.variation import Variation
from spherloc.diagnosis import Cause
from spherloc.estimators import estimate
from spherloc.problem import Problem
from spherloc.trace import Trace
from spherloc_viz.recording.origin import Origin


@dataclass(frozen=True, kw_only=True, eq=False)
class Play:
    """All that a run depends on. It has a scene file or a staged scene, not both."""

    scene_path: Path | None
    """A scene file that comes with the project."""
    staged: StagedScene | None
    """A problem that was put together for the case."""
    query: str | None
    """Name of the query image, in scenes made of images."""
    variation: Variation
    """What is changed about the scene."""
    seed: int
    """Of the estimator and, in synthetic scenes, of the simulation."""
    estimator: str
    """Registered name."""
    options: Any
    """The estimator's options dataclass."""
    facts: Mapping[str, float] = field(default_factory=dict)
    """Numbers of its run that the story tells, by what they measure: see ``measures.MEASURES``."""

    @cached_property
    def scene(self) -> Scene:
        """The scene without the variation. Raises ``InputError`` if its file cannot be used."""
        if self.staged is not None:
            return self.staged
        assert self.scene_path is not None
        return load_scene(self.scene_path)

    def problem(self) -> Problem:
        """What is solved; the same every time."""
        return self.variation.problem(self.scene, self.seed, self.query)

    def run(self) -> Trace:
        """Solve it."""
        return estimate(self.problem(), self.estimator, self.options, self.seed)


@dataclass(frozen=True, kw_only=True, eq=False)
class Beside(Play):
    """Another run that shows what the case's depends on: another method, or the cause taken away."""

    name: str
    """What is different, in a word or two."""
    succeeds: bool
    """Whether its pose is right."""
    recorded: bool
    """Whether it is worth a recording of its own."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GalleryCase(Play):
    """A run that fails, why, and how one can tell."""

    key: str
    """Names its recording."""
    title: str
    """A few words."""
    story: str
    """What one sees, why it fails, what would help: a few sentences. Its numbers are facts, settings or quoted."""
    cause: Cause
    """What the diagnosis says, knowing the truth."""
    without_truth: Cause | None
    """What it says without, if that is told."""
    fails: tuple[str, ...]
    """How: "position", "rotation" (each worse than a success may be) or "no pose"."""
    step: str
    """Key of the step at which it goes wrong, see ``layers.key_step``."""
    quoted: tuple[float, ...]
    """Numbers that the story has from elsewhere: from the paper, or from how the problem is made."""
    beside: tuple[Beside, ...]
    """Runs to compare with."""

    @property
    def origin(self) -> Origin:
        """What its recording says of where it comes from."""
        return origin_of(self, self.title, self.story)


def origin_of(play: Play, title: str, story: str) -> Origin:
    """The origin of a run of the gallery."""
    staged = play.staged is not None
    return Origin(
        source="gallery",
        scene_path=None if play.scene_path is None else str(play.scene_path),
        scene_seed=None if staged else play.seed,
        query=play.query,
        variation=play.variation,
        title=title,
        story=story,
    )
