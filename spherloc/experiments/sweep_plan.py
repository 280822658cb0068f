"""The plan of a sweep: estimators on problems of one simulated scene, of which one property takes several values.

Figs. 5 to 7 are sweeps: errors against pixel noise, success and time against the outlier rate.
"""

import dataclasses
import hashlib
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from spherloc import registry
from spherloc.datasets import load_scene, scene_file
from spherloc.datasets.synthetic import SyntheticScene
from spherloc.datasets.variation import Variation
from spherloc.errors import InputError, show
from spherloc.estimators import default_options, estimate, options_type
from spherloc.estimators.base import versions
from spherloc.experiments.sweep_rows import SweepRow, lost_row, row_of
from spherloc.files import read_file, reading
from spherloc.problem import Problem
from spherloc.trace import Trace

AXES: Mapping[str, str] = {
    "outlier_rate": "outlier rate",
    "noise_px": "pixel noise (px)",
    "correspondences": "correspondences",
    "gravity_error_deg": "gravity error (deg)",
}
"""Properties that a sweep can vary, with their names for users."""

MAX_VALUES, MAX_ENTRANTS, MAX_RUNS, MAX_ROWS = 200, 20, 100_000, 2_000_000
FORMAT = 2


@dataclass(frozen=True)
class Entrant:
    """An estimator with options."""

    estimator: str
    """Registered name of the estimator."""
    changes: tuple[tuple[str, Any], ...] = ()
    """Options that differ from the defaults, by name."""

    @property
    def label(self) -> str:
        """Its name in tables and pictures, such as "ransac-2p iterations=1000"."""
        return " ".join([self.estimator, *(f"{key}={value}" for key, value in self.changes)])

    def options(self, problem: Problem | None = None) -> Any:
        """The options for a problem, whose own pixel bound is the default; raises ``InputError`` for a wrong value."""
        given = options_type(self.estimator)() if problem is None else default_options(self.estimator, problem)
        return replace(given, **dict(self.changes))


@dataclass(frozen=True, order=True, slots=True)
class Job:
    """One run of a sweep. Jobs in ascending order fill all points evenly: one run of each, then the next."""

    run: int
    """Number of the problem at each point, from 0; it determines the seed."""
    value: int
    """Index of the value."""
    entrant: int
    """Index of the estimator; it is the last field, so that all estimators solve a problem one after another."""


@dataclass(frozen=True)
class SweepPlan:
    """All that determines a sweep's results: plain data, so that other processes and machines can build its problems.

    Made by ``planned``, which checks it.
    """

    scene: str
    """Absolute path of the file of a synthetic scene."""
    scene_sha256: str
    """Hash of its content."""
    variation: Variation
    """Changes to the scene that hold at all points."""
    camera_sha256: str | None
    """Hash of the file of the variation's camera, if it has one."""
    over: str
    """The varied property, a key of ``AXES``."""
    values: tuple[float, ...]
    """Values of the property, ascending."""
    entrants: tuple[Entrant, ...]
    """The estimators, each with its options."""
    runs: int
    """Number of problems per point."""
    first_seed: int
    """Run k has this seed + k, for simulation and estimator, at all points, so that points are compared in pairs."""
    versions: tuple[tuple[str, str], ...]
    """Versions of all software that can change a number; the workers must have the same."""

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the entrants."""
        return tuple(entrant.label for entrant in self.entrants)

    @property
    def rows(self) -> int:
        """Number of runs in all."""
        return self.runs * len(self.values) * len(self.entrants)

    def jobs(self) -> Iterator[Job]:
        """All runs in the order in which they are done."""
        for run in range(self.runs):
            for value in range(len(self.values)):
                for entrant in range(len(self.entrants)):
                    yield Job(run, value, entrant)

    def place(self, job: Job) -> str:
        """A run in words."""
        at = f"{AXES[self.over]} {self.values[job.value]:g}"
        return f"{self.entrants[job.entrant].label} at {at}, seed {self.first_seed + job.run}"

    def variation_at(self, value: int) -> Variation:
        """The changes to the scene at the value of that index."""
        number = self.values[value]
        return replace(self.variation, **{self.over: int(number) if self.over == "correspondences" else number})

    def solve(
        self,
        jobs: Sequence[Job],
        done: Callable[[Job, Trace], None] | None = None,
        failed: Callable[[Job, str], None] = lambda job, sentence: None,
    ) -> list[SweepRow]:
        """Do some of the runs in this process; ``done`` is called with each of them, outside the measured time.

        A run in which an extension's estimator fails is a failure without a pose; ``failed`` gets a sentence on it.

        Raises ``InputError`` if the scene file or the software is not what the plan was made with, or a run is
        impossible.
        """
        for name, version in self.versions:
            if versions().get(name) != version:
                raise InputError(
                    f"{name} is {versions().get(name)} where the runs are done and {version} where the sweep was "
                    "started; install the same version there."
                )
        scene = self._load()
        rows: list[SweepRow] = []
        drawn: tuple[tuple[int, int], Problem] | None = None
        for job in jobs:
            seed, entrant = self.first_seed + job.run, self.entrants[job.entrant]
            try:
                if drawn is None or drawn[0] != (job.run, job.value):
                    drawn = (job.run, job.value), self.variation_at(job.value).problem(scene, seed)
            except InputError as error:
                raise InputError(f"{self.place(job)}: {error}") from None
            start = time.perf_counter()
            try:
                trace = estimate(drawn[1], entrant.estimator, entrant.options(drawn[1]), seed)
            except InputError as error:
                sentence = f"{self.place(job)}: {error}"
                if not registry.extension_of("estimators", entrant.estimator):
                    raise InputError(sentence) from None
                failed(job, sentence)
                took_ms = 1e3 * (time.perf_counter() - start)
                rows.append(lost_row(entrant.label, self.values[job.value], seed, took_ms, len(drawn[1])))
                continue
            rows.append(row_of(trace, entrant.label, self.values[job.value]))
            if done is not None:
                done(job, trace)
        return rows

    def check(self) -> None:
        """Draw the first problem of every value, so that errors are found before workers are started.

        Raises ``InputError``.
        """
        scene = self._load()
        for number, value in enumerate(self.values):
            try:
                problem = self.variation_at(number).problem(scene, self.first_seed)
                for entrant in self.entrants:
                    entrant.options(problem)
            except InputError as error:
                raise InputError(f"{AXES[self.over]} {value:g}: {error}") from None

    def _load(self) -> SyntheticScene:
        camera = self.variation.camera
        if camera is not None and content_hash(Path(camera)) != self.camera_sha256:
            raise InputError(f"{camera}: has changed since the sweep was planned; start the sweep anew.")
        return _scene(self.scene, self.scene_sha256)

    def record(self) -> dict[str, Any]:
        """The plan as a table of plain JSON values; infinity is the text "inf"."""
        table = asdict(self)
        table["entrants"] = [{"estimator": item.estimator, "options": dict(item.changes)} for item in self.entrants]
        table |= {"variation": self.variation.simulation, "versions": dict(self.versions)}
        return {"format": FORMAT} | _plain(table)


def planned(
    scene: Path,
    over: str,
    values: Sequence[float],
    entrants: Sequence[Entrant],
    runs: int,
    variation: Variation | None = None,
    first_seed: int = 0,
) -> SweepPlan:
    """A plan that has been checked: the first problem of every value is drawn.

    Raises ``InputError`` for whatever would make the sweep impossible.
    """
    path = Path(scene).resolve()
    variation = Variation() if variation is None else variation
    if variation.camera is not None:
        variation = replace(variation, camera=str(Path(variation.camera).resolve()))
    if over not in AXES:
        raise InputError(f"a sweep cannot go over {show(over)}; choose one of {', '.join(AXES)}.")
    if getattr(variation, over) is not None:
        raise InputError(f"{over} is set, and the sweep goes over it; leave one of the two out.")
    if variation.edited:
        raise InputError(
            "a sweep draws new problems for every run, so single matches cannot be edited; leave that out."
        )
    plan = SweepPlan(
        scene=str(path),
        scene_sha256=content_hash(path),
        variation=variation,
        camera_sha256=None if variation.camera is None else content_hash(Path(variation.camera)),
        over=over,
        values=_checked_values(over, values),
        entrants=_checked_entrants(entrants),
        runs=runs,
        first_seed=first_seed,
        versions=tuple(versions().items()),
    )
    _check_counts(plan)
    plan.check()
    return plan


def _checked_values(over: str, values: Sequence[float]) -> tuple[float, ...]:
    found = tuple(sorted({float(value) for value in values}))
    if not 1 <= len(found) <= MAX_VALUES:
        raise InputError(f"the sweep has {len(found)} values; give 1 to {MAX_VALUES} of them.")
    strange = next((value for value in found if not np.isfinite(value)), None)
    if strange is None and over == "correspondences":
        strange = next((value for value in found if value != int(value)), None)
    if strange is not None:
        kind = "whole numbers" if over == "correspondences" else "numbers"
        raise InputError(f"the sweep over {over} has the value {strange:g}; give {kind}.")
    return found


def _checked_entrants(entrants: Sequence[Entrant]) -> tuple[Entrant, ...]:
    labels = [entrant.label for entrant in entrants]
    if not 1 <= len(labels) <= MAX_ENTRANTS:
        raise InputError(f"the sweep has {len(labels)} estimators; give 1 to {MAX_ENTRANTS} of them.")
    twice = next((label for label in labels if labels.count(label) > 1), None)
    if twice is not None:
        raise InputError(f"the sweep has the estimator {show(twice)} twice; give it once, or with other options.")
    for entrant in entrants:
        known = {item.name for item in dataclasses.fields(options_type(entrant.estimator))}
        unknown = next((key for key, _ in entrant.changes if key not in known), None)
        if unknown is not None:
            raise InputError(f"{entrant.estimator} has no option {show(unknown)}; it has {', '.join(sorted(known))}.")
    return tuple(entrants)


def _check_counts(plan: SweepPlan) -> None:
    if not 1 <= plan.runs <= MAX_RUNS:
        raise InputError(f"the sweep has {plan.runs} runs a point; give a number from 1 to {MAX_RUNS:,}.")
    if plan.rows > MAX_ROWS:
        raise InputError(f"the sweep has {plan.rows:,} runs in all; ask for {MAX_ROWS:,} or fewer.")
    if not 0 <= plan.first_seed <= 2**63 - 1 - plan.runs:
        raise InputError(f"the first seed is {plan.first_seed}; give a number from 0 to 2^62.")


@lru_cache(maxsize=4)
def _scene(path: str, sha256: str) -> SyntheticScene:
    """The scene of a plan. Raises ``InputError`` if its file is missing, has changed, or is not a simulation."""
    if content_hash(Path(path)) != sha256:
        raise InputError(f"{path}: has changed since the sweep was planned; start the sweep anew.")
    scene = load_scene(Path(path))
    if not isinstance(scene, SyntheticScene):
        raise InputError(f"{path}: is not a simulation, so it cannot be swept; give a synthetic scene.")
    return scene


def content_hash(path: Path) -> str:
    """SHA-256 of a file's content; raises ``InputError`` if it cannot be read."""
    with reading(path, "give a path that all workers can read"):
        return hashlib.sha256(read_file(path, scene_file.MAX_BYTES)).hexdigest()


def _plain(value: Any) -> Any:
    if isinstance(value, float) and not np.isfinite(value):
        return "inf" if value > 0 else "-inf"
    if isinstance(value, Mapping):
        return {str(key): _plain(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    return value


def parse_values(texts: Sequence[str]) -> tuple[float, ...]:
    """Numbers from texts such as "0.5:0.9:0.1" (first, last, step; the last one included) and "0.5,0.7".

    Raises ``InputError`` for a text of another form.
    """
    found: list[float] = []
    for text in (part for whole in texts for part in whole.split(",")):
        try:
            numbers = [float(word) for word in text.split(":")]
        except ValueError:
            numbers = []
        if len(numbers) == 1:
            found += numbers
        elif len(numbers) == 3 and all(map(math.isfinite, numbers)) and numbers[2] > 0 and numbers[1] >= numbers[0]:
            first, last, step = numbers
            count = math.floor((last - first) / step + 1e-6) + 1 if last - first < MAX_VALUES * step else math.inf
            if count > MAX_VALUES:
                raise InputError(f"the values {show(text)} are more than {MAX_VALUES}; give a larger step.")
            found += [round(first + k * step, 10) for k in range(int(count))]
        else:
            raise InputError(f"the values are {show(text)}; give numbers, or FIRST:LAST:STEP such as 0.5:0.9:0.1.")
    return tuple(found)
