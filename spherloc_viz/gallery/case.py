"""What a case of the gallery is: a run that is described wholly, the story it tells, and what shows that it is true."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from math import comb
from pathlib import Path
from typing import Any

import numpy as np

from spherloc.datasets import Scene, load_scene
from spherloc.datasets.map_scene import MapScene
from spherloc.datasets.staged import StagedScene
from spherloc.datasets.variation import Variation
from spherloc.diagnosis import Cause, Diagnosis, diagnose
from spherloc.estimators import estimate
from spherloc.geometry import yaw_of
from spherloc.metrics import SUCCESS_DEG, SUCCESS_M, evaluate, ransac_success_probability
from spherloc.problem import Problem
from spherloc.refine import residuals_px
from spherloc.trace import ConsensusStage, RansacStage, StageT, Trace, YawStage
from spherloc.types import BoolArray, FloatArray
from spherloc_viz.layers import steps
from spherloc_viz.layers.key_step import key_step
from spherloc_viz.recording.origin import Origin


def _count(mask: BoolArray) -> int:
    return int(np.count_nonzero(mask))


def _right(trace: Trace) -> BoolArray:
    """(N,) labels; of the gallery's problems they are known."""
    labels = trace.problem.truth_inliers
    return np.zeros(len(trace.problem), dtype=bool) if labels is None else labels


def _true_errors_px(trace: Trace) -> FloatArray:
    """(N,) reprojection errors at the true pose; inf where the camera cannot see the pixel."""
    problem, truth = trace.problem, trace.problem.truth_cam_from_map
    errors = np.full(len(problem), np.inf)
    if truth is not None:
        errors[problem.aligned.index] = residuals_px(problem.aligned, problem.aligned.align_pose(truth))
    return errors


def _agree_with_truth(trace: Trace, wider: float = 1.0) -> int:
    return _count(_true_errors_px(trace) <= wider * trace.options.bound_px)


def _median_error_px(trace: Trace, rim: bool) -> float:
    """Median error of the right matches in the outer or the inner half of the view, at the true pose."""
    right, errors = _right(trace), _true_errors_px(trace)
    if not right.any():
        return np.nan
    forward = trace.problem.bearings[:, 2]
    outer = forward < np.median(forward[right])
    return float(np.median(errors[right & (outer if rim else ~outer)]))


def _gravity_off_deg(trace: Trace) -> float:
    error_rad = trace.problem.gravity_error_rad
    return np.nan if error_rad is None else float(np.degrees(error_rad))


def _from_axis_deg(trace: Trace) -> float:
    """Largest angle between gravity and the bearing of a right match."""
    cosines = trace.problem.bearings[_right(trace)] @ trace.problem.gravity_camera
    return float(np.degrees(np.arccos(np.clip(cosines.min(initial=1.0), -1.0, 1.0))))


def stage_of(trace: Trace, kind: type[StageT]) -> StageT:
    """The stage of a run that a number is of; raises ``ValueError`` if it has none."""
    stage = trace.stage(kind)
    if stage is None:
        raise ValueError(f"the run of {trace.estimator} has no {kind.__name__}")
    return stage


def _samples(trace: Trace) -> RansacStage:
    return stage_of(trace, RansacStage)


def _samples_per_right_one(trace: Trace) -> float:
    """How many samples it takes on average until one has right matches only."""
    size = _samples(trace).samples.shape[1]
    return comb(len(trace.problem), size) / comb(_count(_right(trace)), size)


def _hit_percent(trace: Trace) -> float:
    """Eq. 28, with a sample of different matches."""
    rate = 1.0 / _samples_per_right_one(trace)
    return 100.0 * ransac_success_probability(rate, 1, _samples(trace).iterations)


def _yaw(trace: Trace) -> YawStage:
    return stage_of(trace, YawStage)


def _right_pairs_chosen(trace: Trace) -> int:
    """Pairs of two right matches in the rotation clique."""
    stage = _yaw(trace)
    return _count(np.all(_right(trace)[stage.pairs[stage.clique]], axis=1))


def _pairs_at_truth(trace: Trace) -> int:
    """Arcs that cover the true yaw."""
    stage, truth = _yaw(trace), trace.problem.truth_cam_from_map
    if truth is None:
        return 0
    yaw = yaw_of(trace.problem.aligned.align_pose(truth)[:, :3])
    turns = np.stack([yaw + turn * 2.0 * np.pi for turn in (-1.0, 0.0, 1.0)])[:, None]
    return _count(np.any((stage.lo_rad <= turns) & (turns <= stage.hi_rad), axis=0))


def _least_bound(trace: Trace) -> int:
    """What some pose may explain at the yaw where that is least."""
    return int(stage_of(trace, ConsensusStage).bound.min())


def _known(value: float | None) -> float:
    return np.nan if value is None else value


MEASURES: Mapping[str, Callable[[Trace], float]] = {
    "matches": lambda trace: len(trace.problem),
    "right": lambda trace: _count(_right(trace)),
    "inliers": lambda trace: _count(trace.inlier_mask),
    "right_inliers": lambda trace: _count(trace.inlier_mask & _right(trace)),
    "wrong_inliers": lambda trace: _count(trace.inlier_mask & ~_right(trace)),
    "agree_with_truth": _agree_with_truth,
    "agree_within_twice": lambda trace: _agree_with_truth(trace, 2.0),
    "rim_px": lambda trace: _median_error_px(trace, rim=True),
    "middle_px": lambda trace: _median_error_px(trace, rim=False),
    "off_m": lambda trace: _known(evaluate(trace).translation_error_m),
    "off_deg": lambda trace: _known(evaluate(trace).rotation_error_deg),
    "gravity_off_deg": _gravity_off_deg,
    "from_axis_deg": _from_axis_deg,
    "samples": lambda trace: _samples(trace).iterations,
    "sample_size": lambda trace: _samples(trace).samples.shape[1],
    "samples_per_right_one": _samples_per_right_one,
    "hit_percent": _hit_percent,
    "pairs": lambda trace: comb(len(trace.problem), 2),
    "right_pairs": lambda trace: comb(_count(_right(trace)), 2),
    "pairs_at_yaw": lambda trace: len(_yaw(trace).clique),
    "right_pairs_at_yaw": _right_pairs_chosen,
    "pairs_at_true_yaw": _pairs_at_truth,
    "least_bound": _least_bound,
    "at_most": lambda trace: _known(None if trace.certificate is None else trace.certificate.upper_bound),
    "nfa": lambda trace: _known(None if trace.certificate is None else trace.certificate.nfa),
}
"""Facts by name: counts of matches, pairs and samples, errors against the truth, and proven bounds."""


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
    """Seed of the estimator and, in synthetic scenes, of the simulation."""
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


PICTURES_SLACK = 0.15
"""Share by which facts of a run on pictures may be off: other processors round otherwise when pictures are drawn and
described, so that some matches come and go."""


@dataclass(frozen=True, eq=False)
class Played:
    """A case that was run."""

    case: GalleryCase
    """What is told."""
    trace: Trace
    """Its run."""
    diagnosis: Diagnosis
    """With the truth."""
    beside: tuple[tuple[Beside, Trace], ...]
    """The runs to compare with."""


def play(case: GalleryCase) -> Played:
    """Run a case and all that is beside it."""
    trace = case.run()
    return Played(case, trace, diagnose(trace), tuple((item, item.run()) for item in case.beside))


def faults(played: Played) -> Iterator[str]:
    """What happened otherwise than it is told, in sentences; nothing if the story is true."""
    case, trace = played.case, played.trace
    if played.diagnosis.cause != case.cause:
        yield f"{case.key}: the diagnosis is {played.diagnosis.cause}, and not {case.cause}."
    if case.without_truth is not None and (blind := diagnose(trace, use_truth=False).cause) != case.without_truth:
        yield f"{case.key}: without the truth the diagnosis is {blind}, and not {case.without_truth}."
    if sorted(happened := failures(trace)) != sorted(case.fails):
        yield f"{case.key}: what fails is {', '.join(happened) or 'nothing'}, and not {', '.join(case.fails)}."
    if (key := steps(trace)[key_step(trace, played.diagnosis)].key) != case.step:
        yield f"{case.key}: it goes wrong at the step {key}, and not at {case.step}."
    yield from _wrong_facts(case.key, case, trace)
    for item, other in played.beside:
        where = f"{case.key}, beside {item.name}"
        if bool(evaluate(other).success) != item.succeeds:
            yield f"{where}: it {'fails' if item.succeeds else 'succeeds'}, against what is told."
        yield from _wrong_facts(where, item, other)


def failures(trace: Trace) -> list[str]:
    """How a run with a known true pose fails; empty if it does not."""
    metrics = evaluate(trace)
    if metrics.rotation_error_deg is None or metrics.translation_error_m is None:
        return ["no pose"]
    found = {
        "position": metrics.translation_error_m >= SUCCESS_M,
        "rotation": metrics.rotation_error_deg >= SUCCESS_DEG,
    }
    return [name for name, so in found.items() if so]


def _wrong_facts(where: str, told: Play, trace: Trace) -> Iterator[str]:
    slack = PICTURES_SLACK if isinstance(told.scene, MapScene) else 0.0
    for name, value in told.facts.items():
        if not agrees(value, measured := MEASURES[name](trace), slack):
            yield f"{where}: {name} is {measured:.6g}, and not {value}."


def agrees(told: float, measured: float, slack: float = 0.0) -> bool:
    """Whether a number was measured as it is told: whole ones when rounded, others up to one in their last digit.

    ``slack`` is a share by which it may be off besides.
    """
    if isinstance(told, int):
        return bool(abs(told - np.round(measured)) <= np.ceil(slack * (abs(told) + 1)))
    decimals = len(repr(told).partition(".")[2])
    return bool(abs(told - measured) <= 10.0**-decimals + slack * abs(told))
