"""``spherloc localize``: sequences of queries against a map, resumable, and tables and pictures that compare them."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from spherloc.datasets import load_scene
from spherloc.datasets.map_scene import MapScene
from spherloc.errors import InputError, RecordingError, shorten, show
from spherloc.estimators import options_type
from spherloc.experiments.configuration import Configuration, configuration_of
from spherloc.experiments.results import (
    LOCALIZED,
    PICTURE,
    POSED,
    SUMMARY,
    TRAJECTORY,
    TRUE_TRAJECTORY,
    VEHICLE_TRAJECTORY,
    ResultsLog,
    SequenceResults,
    folder_for,
)
from spherloc.experiments.sequence import How, chosen_queries, has_changed, localize_by_each
from spherloc.experiments.several_maps import outdone
from spherloc.experiments.summary import (
    estimated_trajectory,
    summarize,
    true_trajectory,
    vehicle_trajectory,
)
from spherloc.frontend.view import View
from spherloc.mapping.scenes.joint_outcome import judged_together
from spherloc.trace import Trace
from spherloc.trajectory import write_tum
from spherloc.warm_up import warm_up
from spherloc_viz.commands.flags import RECORDINGS
from spherloc_viz.commands.progress import prepare, progress, say
from spherloc_viz.commands.run import Records, parse_settings, store_of
from spherloc_viz.commands.sequence_comparison import Compared, write_comparison
from spherloc_viz.commands.sequence_text import maps_text, sequence_text
from spherloc_viz.options import json_text
from spherloc_viz.recording.origin import Origin

if TYPE_CHECKING:
    from spherloc_viz.plots.trajectories import Backdrop
    from spherloc_viz.recording.storage.store import RecordingStore


@dataclass(frozen=True)
class Solving:
    """An estimator that localizes a sequence, and the folder of its results."""

    estimator: str
    """Registered name of the estimator."""
    settings: tuple[str, ...]
    """Its options as "KEY=VALUE"."""
    output: Path
    """Folder of the results."""
    records: Records | None
    """Settings with which queries are recorded; None if they are not recorded."""
    initialise: str | None = None
    """Registered name of the estimator that solves the first query and those after a loss; None if there is none."""
    numbered: bool = False
    """Whether another folder is taken, with a number, if this one holds results of another configuration."""

    def placed(self, configuration: Configuration) -> "Solving":
        """The same with the folder that the results go to; raises ``InputError`` if a configuration is damaged."""
        output, records = self.output, self.records
        if not self.numbered or (folder := folder_for(output, configuration)) == output:
            return self
        say(f"{output}: holds results of another configuration; those of this one go to {folder}.")
        if records is not None and records.folder == output / RECORDINGS:
            records = replace(records, folder=folder / RECORDINGS)
        return replace(self, output=folder, records=records)

    @property
    def label(self) -> str:
        """Its name in tables and pictures."""
        first = () if self.initialise is None else (f"{self.initialise} +",)
        return " ".join((*first, self.estimator, *self.settings))


def localize_sequence(
    path: Path, solvings: Sequence[Solving], seed: int, queries: Sequence[str], retry_failed: bool
) -> int:
    """Localize the chosen queries that have no result yet, by each estimator; returns the exit code.

    0 if every chosen query is localized by each, 1 if one is doubtful or has no pose. Raises ``InputError`` for
    whatever makes all of it impossible.
    """
    done = localized(path, solvings, seed, queries, retry_failed, together=True)
    for found in done.results:
        print(sequence_text(found, summarize(found), done.scene), flush=True)
    return _code(done)


def localize_in_maps(solvings: Mapping[Path, Solving]) -> int:
    """Localize the same photographs in several maps, each scene file with its solving, and doubt a pose where another
    map explains more of a photograph's matches; returns the exit code.

    0 if every photograph is localized in one of the maps. Raises ``InputError`` as ``localize_sequence`` does.
    """
    done = {path: localized(path, [solving], 0, (), False, together=True) for path, solving in solvings.items()}
    changed = outdone([one.results[0] for one in done.values()])
    for one, rows in zip(done.values(), changed, strict=True):
        found = one.results[0]
        if rows:
            with ResultsLog(found.folder, found.configuration) as log:
                log.change(rows)
                found = log.results()
                _finish(log, found, one.scene, one.backdrop)
            one.results[0] = found
        print(sequence_text(found, summarize(found), one.scene), flush=True)
    if len(done) > 1:
        print(maps_text([one.results[0] for one in done.values()]), flush=True)
    sure = {row.query for one in done.values() for row in one.results[0].rows if row.status == LOCALIZED}
    return 0 if all(one.chosen <= sure for one in done.values()) else 1


def compare_sequences(
    solvings: Mapping[Path, Sequence[Solving]], seed: int, queries: Sequence[str], retry_failed: bool, output: Path
) -> int:
    """Localize several sequences, each by the ``solvings`` of its path, and put them into one table, written to
    ``output``; returns the exit code of ``localize_sequence``. Raises ``InputError`` as that does."""
    code, found = 0, []
    for path, several in solvings.items():
        done = localized(path, several, seed, queries, retry_failed)
        if done.scene.about_truth:
            say(f"{path}: {done.scene.about_truth}")
        labels = [solving.label for solving in several]
        found += [
            Compared(label, item, summarize(item), done.backdrop)
            for label, item in zip(labels, done.results, strict=True)
        ]
        code = max(code, _code(done))
    print(write_comparison(output, found), flush=True)
    return code


@dataclass(frozen=True, eq=False)
class Localized:
    """A sequence that several estimators localized."""

    results: list[SequenceResults]
    """One for each estimator."""
    chosen: set[str]
    """Names of the chosen queries."""
    scene: MapScene
    """The sequence and its map."""
    backdrop: "Backdrop"
    """What pictures show of the map."""


def localized(
    path: Path,
    solvings: Sequence[Solving],
    seed: int,
    queries: Sequence[str],
    retry_failed: bool,
    *,
    together: bool = False,
) -> Localized:
    """The results of a sequence by each of the estimators; each query is matched once for all.

    With ``together``, queries are judged by each other in the end; a comparison of estimators tells what each finds by
    itself. Raises ``InputError`` as ``localize_sequence`` does.
    """
    from spherloc_viz.plots.trajectories import backdrop_of

    scene = load_scene(path)
    if not isinstance(scene, MapScene):
        raise InputError(f"{path}: is one problem, no sequence of query images; solve it by: spherloc run {path}")
    if not 0 <= seed < 2**63:
        raise InputError(f"seed is {seed}; give a number from 0 to 2^63 - 1.")
    chosen = chosen_queries(scene, queries)
    hows = [_how(scene, item, seed) for item in solvings]
    for remark in scene.remarks:
        say(remark)
    with ExitStack() as stack:
        logs: list[ResultsLog] = []
        settings = [
            configuration_of(scene, path, how.estimator, how.options, seed, item.initialise)
            for item, how in zip(solvings, hows, strict=True)
        ]
        solvings = [item.placed(setting) for item, setting in zip(solvings, settings, strict=True)]
        for item, setting in zip(solvings, settings, strict=True):
            logs.append(stack.enter_context(ResultsLog(item.output, setting)))
        todo = [{view.name for view in _todo(scene, chosen, log, retry_failed)} for log in logs]
        wanted = [(view, [k for k, names in enumerate(todo) if view.name in names]) for view in chosen]
        wanted = [(view, indices) for view, indices in wanted if indices]

        @cache
        def recorders() -> tuple[_Recorder | None, ...]:
            stores = [stack.enter_context(store_of(item.records)) for item in solvings]
            return tuple(
                None if store is None else _Recorder(store, path.resolve(), log)
                for store, log in zip(stores, logs, strict=True)
            )

        if wanted:
            warm_up(say, {name for item in solvings for name in (item.estimator, item.initialise) if name is not None})
            _work(scene, wanted, logs, hows, recorders())
        for index in range(len(logs)) if together else ():
            _judge_together(scene, logs[index], hows[index], lambda index=index: recorders()[index])
        results = [log.results() for log in logs]
        backdrop = backdrop_of(scene)
        for log, found in zip(logs, results, strict=True):
            _finish(log, found, scene, backdrop)
    return Localized(results, {view.name for view in chosen}, scene, backdrop)


def _code(done: Localized) -> int:
    rows = [row for found in done.results for row in found.rows if row.query in done.chosen]
    return 0 if all(row.status == LOCALIZED for row in rows) else 1


def _how(scene: MapScene, item: Solving, seed: int) -> How:
    first = None if item.initialise is None else (item.initialise, _options(scene, item.initialise, ()))
    return How(item.estimator, _options(scene, item.estimator, item.settings), seed, first)


def _options(scene: MapScene, estimator: str, settings: Sequence[str]) -> Any:
    """The options of ``resolved_options``, which are the same for every query of the scene."""
    given = {} if scene.bound_px is None else {"bound_px": scene.bound_px}
    return options_type(estimator)(**(given | parse_settings(estimator, settings)))


def _todo(scene: MapScene, chosen: Sequence[View], log: ResultsLog, retry_failed: bool) -> list[View]:
    known = {view.name for view in scene.queries}
    strange = next((name for name in log.rows if name not in known), None)
    if strange is not None:
        raise InputError(
            f"{log.folder}: holds a result of {show(strange)}, no query of this scene; give another folder."
        )
    if log.repaired:
        say(f"{log.folder}: removed a half written line; its query is done again.")
    changed = [view.name for view in chosen if view.name in log.rows and has_changed(view, log.rows[view.name])]
    if changed:
        log.forget(changed)
        some = f"{shorten(changed[0])}{f' and {len(changed) - 1} more' if len(changed) > 1 else ''}"
        say(f"{log.folder}: the image, camera, gravity or true pose of {some} has changed: done again.")
    if retry_failed and (again := log.forget_failures()):
        say(f"{log.folder}: queries without a pose that are done again: {again}.")
    todo = [view for view in chosen if view.name not in log.rows]
    if len(todo) < len(chosen):
        say(f"{log.folder}: {len(chosen) - len(todo)} of {len(chosen)} queries are done already.")
    return todo


def _work(
    scene: MapScene,
    wanted: Sequence[tuple[View, Sequence[int]]],
    logs: Sequence[ResultsLog],
    hows: Sequence[How],
    recorders: "Sequence[_Recorder | None]",
) -> None:
    failed = 0
    with _told_if_stopped(logs):
        prepare(scene)
        with progress(sum(len(indices) for _, indices in wanted), "queries") as advance:
            for index, row, trace in localize_by_each(scene, wanted, hows):
                recorder = recorders[index]
                if recorder is not None and trace is not None:
                    row = replace(row, recording=recorder.record(trace, row.query))
                # Written after the recording, so that a row never names one that a killed process left unfinished.
                logs[index].append(row)
                failed += row.status not in POSED
                advance(f"{failed} without a pose")


def _judge_together(scene: MapScene, log: ResultsLog, how: How, recorder_of: "Callable[[], _Recorder | None]") -> None:
    """Judge the queries of a log by each other; what is changed is written at once, and what was tried anew is recorded
    where ``recorder_of`` gives a recorder, in the place of the recording before."""
    with _told_if_stopped([log]), ExitStack() as stack:
        bars: list[Callable[[str], None]] = []

        def report(done: int, count: int) -> None:
            if not bars:
                bars.append(stack.enter_context(progress(count, "times compared")))
            bars[0]("")

        for row, trace in judged_together(scene, log.results().rows, how, report, say):
            first, recorder = log.rows[row.query].recording, recorder_of() if trace is not None else None
            if trace is not None and recorder is not None:
                row = replace(row, recording=recorder.record(trace, row.query))
            log.change([row])
            if recorder is not None and first is not None and row.recording not in (None, first):
                recorder.forget(first, row.query)


@contextmanager
def _told_if_stopped(logs: Sequence[ResultsLog]) -> Iterator[None]:
    """Say what is kept if Ctrl-C stops what is done inside."""
    try:
        yield
    except KeyboardInterrupt:
        for log in logs:
            so_far = f"{len(log.rows)} of {log.configuration.queries} queries are done"
            say(f"stopped; {so_far} in {log.folder}, and the same command goes on from there.")
        raise


@dataclass(frozen=True)
class _Recorder:
    """Records the queries of a sequence."""

    store: "RecordingStore"
    """Store of the folder of the recordings."""
    scene_path: Path
    """Absolute path of the scene file."""
    log: ResultsLog
    """Log of the sequence's results."""

    def record(self, trace: Trace, query: str) -> str | None:
        """Record a query and return the path for the results; None if this run cannot be drawn.

        Raises ``InputError`` where there is no room, since the next ones would be lost too.
        """
        log = self.log
        try:
            path = self.store.record(trace, Origin("sequence", str(self.scene_path), trace.seed, query))
        except RecordingError as error:
            if isinstance(error.__cause__, OSError):
                raise InputError(
                    f"{error} What is done is kept ({len(log.rows)} of {log.configuration.queries} queries), and the "
                    "same command goes on from there."
                ) from None
            say(str(error))
            return None
        try:
            return path.resolve().relative_to(log.folder.resolve()).as_posix()
        except ValueError:
            return str(path.resolve())

    def forget(self, recording: str, query: str) -> None:
        """Delete the recording, a path of the results, of a query that was recorded anew."""
        path = self.log.folder / recording
        try:
            gone = self.store.delete(path)
        except RecordingError as error:
            say(f"{path}: stays, although {query} was tried anew and recorded since: {error}")
            return
        if not gone:
            say(f"{path}: stays, although {query} was tried anew and recorded since; delete it if you do not need it.")


def _finish(log: ResultsLog, results: SequenceResults, scene: MapScene, backdrop: "Backdrop") -> None:
    """Write trajectories, picture and summary of all results so far."""
    from spherloc_viz.plots.trajectories import trajectory_png

    truth = true_trajectory(results)
    write_tum(log.folder / TRAJECTORY, estimated_trajectory(results))
    if len(truth):
        write_tum(log.folder / TRUE_TRAJECTORY, truth)
    if scene.vehicle_from_camera is not None:
        write_tum(log.folder / VEHICLE_TRAJECTORY, vehicle_trajectory(results, scene.vehicle_from_camera))
    log.write(PICTURE, trajectory_png(results, backdrop))
    log.write(SUMMARY, (json_text(asdict(summarize(results))) + "\n").encode())
