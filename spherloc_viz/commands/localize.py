"""``spherloc localize``: sequences of queries against a map, resumable, and tables and pictures that compare them."""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from itertools import chain, count
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

from spherloc.datasets import load_scene
from spherloc.datasets.map_scene import MapScene
from spherloc.diagnosis.causes import Cause
from spherloc.errors import InputError, RecordingError, reason, shorten, show
from spherloc.estimators import options_type
from spherloc.experiments.configuration import Configuration, configuration_of
from spherloc.experiments.results import (
    LOCALIZED,
    PICTURE,
    POSED,
    SUMMARY,
    TRAJECTORY,
    TRUE_TRAJECTORY,
    UNREADABLE,
    VEHICLE_TRAJECTORY,
    QueryResult,
    ResultsLog,
    SequenceResults,
    folder_for,
)
from spherloc.experiments.sequence import INITIALISED, How, chosen_queries, has_changed, localize_by_each
from spherloc.experiments.summary import (
    SuccessRate,
    Summary,
    TrajectoryError,
    estimated_trajectory,
    summarize,
    timed,
    true_trajectory,
    vehicle_trajectory,
)
from spherloc.experiments.sweep_rows import csv_line
from spherloc.frontend.gravity_from_lines import why_not_found
from spherloc.frontend.pipeline import NO_POINT
from spherloc.frontend.view import View
from spherloc.trace import Trace
from spherloc.trajectory import write_tum
from spherloc.warm_up import warm_up
from spherloc_viz.commands.flags import RECORDINGS
from spherloc_viz.commands.progress import prepare, progress, say
from spherloc_viz.commands.run import Records, parse_settings, store_of
from spherloc_viz.commands.sweep import text_of
from spherloc_viz.layers.primitives import Table
from spherloc_viz.options import json_text
from spherloc_viz.recording.origin import Origin

if TYPE_CHECKING:
    from spherloc_viz.plots.trajectories import Backdrop
    from spherloc_viz.recording.storage.store import RecordingStore

MAX_TOLD, MAX_EACH = 5, 20


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
    done = localized(path, solvings, seed, queries, retry_failed)
    for found in done.results:
        print(_text(found, summarize(found)), flush=True)
    return _code(done)


def compare_sequences(
    solvings: Mapping[Path, Sequence[Solving]], seed: int, queries: Sequence[str], retry_failed: bool, output: Path
) -> int:
    """Localize several sequences, each by the ``solvings`` of its path, and put them into one table, written to
    ``output``; returns the exit code of ``localize_sequence``. Raises ``InputError`` as that does."""
    code, found = 0, []
    for path, several in solvings.items():
        done = localized(path, several, seed, queries, retry_failed)
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
    backdrop: "Backdrop"
    """What pictures show of the map."""


def localized(
    path: Path, solvings: Sequence[Solving], seed: int, queries: Sequence[str], retry_failed: bool
) -> Localized:
    """The results of a sequence by each of the estimators; each query is matched once for all.

    Raises ``InputError`` as ``localize_sequence`` does.
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
    if scene.truth_source:
        say(f"the true poses are those of {scene.truth_source}.")
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
        if wanted:
            warm_up(say, {name for item in solvings for name in (item.estimator, item.initialise) if name is not None})
            stores = [stack.enter_context(store_of(item.records)) for item in solvings]
            recorders = [
                None if store is None else _Recorder(store, path.resolve(), log)
                for store, log in zip(stores, logs, strict=True)
            ]
            _work(scene, wanted, logs, hows, recorders)
        results = [log.results() for log in logs]
        backdrop = backdrop_of(scene)
        for log, found in zip(logs, results, strict=True):
            _finish(log, found, scene, backdrop)
    return Localized(results, {view.name for view in chosen}, backdrop)


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
    try:
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


def _text(results: SequenceResults, summary: Summary) -> str:
    """The summary as text for users."""
    setting = results.configuration
    lines = [
        f"{setting.name} ({setting.scene}), {setting.estimator}, seed {setting.seed}",
        f"  {summary.localized} of {summary.done} queries are localized, {summary.doubtful} more have a doubtful pose"
        + (f", of {summary.queries} in the scene" if summary.done < summary.queries else ""),
    ]
    if not setting.metric:
        lines.append("  units are unknown: lengths are in units of the map, and so are the limits")
    first = sum(any(remark.startswith(INITIALISED) for remark in row.remarks) for row in results.rows)
    if first:
        lines.append(f"  {first} initialised by {setting.options['initialise']}, the others tracked")
    lines += [f"  {line}" for line in _wrong(results)]
    rates = (*summary.success, *summary.registration_success)
    lines += [f"  success {_rate(rate, setting.unit)}" for rate in rates if rate.judged or not summary.without_truth]
    if summary.median_rotation_error_deg is not None and summary.median_translation_error_m is not None:
        lines.append(
            f"  median error {summary.median_rotation_error_deg:.3f} deg and "
            f"{setting.length(summary.median_translation_error_m)}, of queries with a pose"
        )
    lines += [f"  {line}" for line in _trajectory_lines(summary.trajectory, setting)]
    if summary.median_registration_error_m is not None:
        lines.append(f"  median registration error {setting.length(summary.median_registration_error_m)}")
    if summary.mean_f1 is not None:
        lines.append(
            f"  inliers against matches within 8 px of the truth: mean precision {summary.mean_precision:.3f}, "
            f"recall {summary.mean_recall:.3f}, F1 {summary.mean_f1:.3f}"
        )
    if summary.median_estimating_ms is not None:
        lines.append(
            f"  median time {summary.median_matching_ms or 0:.0f} ms for matching, "
            f"{summary.median_estimating_ms:.1f} ms for estimating"
        )
    lines += [f"  {line}" for line in (*gravity_by_source(results.rows), *_without_lines(results.rows))]
    lines += [
        f"  {line}"
        for line in (*_skipped(summary), *_each(results), *_without_pose(results.rows), *_remarks(results.rows))
    ]
    if not timed(results):
        lines.append("  trajectory: times are places in the sequence, as the queries have no growing times")
    if (picture := results.folder / PICTURE).exists():
        lines.append(f"  picture: {picture}")
    return "\n".join([*lines, f"  written to {results.folder}"])


def _wrong(results: SequenceResults) -> Iterator[str]:
    """A line on the queries that are localized with an error beyond all limits of the scene."""
    limits, wrong = results.configuration.thresholds, []
    for row in results.rows:
        turned, moved = row.rotation_error_deg, row.translation_error_m
        if row.status != LOCALIZED or turned is None or moved is None or not limits:
            continue
        if all(turned > degrees or moved > metres for degrees, metres in limits):
            wrong.append(f"{row.query}: {turned:.3g} deg and {results.configuration.length(moved)} off")
    if wrong:
        more = f"; and {len(wrong) - MAX_TOLD} more, see results.csv" if len(wrong) > MAX_TOLD else ""
        yield f"wrong by the truth, though localized: {'; '.join(wrong[:MAX_TOLD])}{more}"


def _each(results: SequenceResults) -> Iterator[str]:
    """A line for each query with a pose, where these are few."""
    posed = [row for row in results.rows if row.status in POSED]
    if len(posed) > MAX_EACH:
        return
    told = False
    for row in posed:
        turned, moved = row.expected_rotation_error_deg, row.expected_translation_error_m
        off = ""
        if row.status == LOCALIZED and turned is not None and moved is not None:
            told = True
            off = f", expected error {turned:.2g} deg and {results.configuration.length(moved)}"
        at = ", ".join(f"{value:.2f}" for value in row.position_m)
        why = f" ({row.diagnosis})" if row.diagnosis not in (None, str(Cause.OK)) else ""
        agree = f"{row.inliers or 0:,} of {row.matches or 0:,} matches agree"
        yield f"{row.query}: {row.status}{why}, at ({at}), {agree}{off}"
    if told:
        yield "expected errors are what the noise of the matches leaves; errors of the map and of the lens add to them"


def _trajectory_lines(error: TrajectoryError | None, setting: Configuration) -> Iterator[str]:
    """Lines on ATE and RPE of all poses."""
    if error is None:
        return
    aligned = [
        f"{setting.length(value)} {how}"
        for value, how in ((error.ate_rigid_m, "aligned rigidly"), (error.ate_similarity_m, "with scale"))
        if value is not None
    ]
    yield f"ATE of all {error.poses} poses: {', '.join([setting.length(error.ate_m), *aligned])}"
    if error.rpe_m is not None:
        yield f"RPE from pose to pose: {setting.length(error.rpe_m)}, {error.rpe_deg:.3f} deg"


def gravity_by_source(rows: Sequence[QueryResult]) -> Iterator[str]:
    """A line for each source of gravity: its number of queries, its bounds and its true errors."""
    by_source: dict[str, list[QueryResult]] = {}
    for row in rows:
        if row.gravity_source:
            by_source.setdefault(row.gravity_source, []).append(row)
    for source, told in by_source.items():
        bounds = [row.gravity_bound_deg for row in told if row.gravity_bound_deg is not None]
        errors = [row.gravity_error_deg for row in told if row.gravity_error_deg is not None]
        most = f" to {max(bounds):.2g}" if max(bounds) > min(bounds) else ""
        off = f"; off the truth by {median(errors):.3g} deg in the median, {max(errors):.3g} at most" if errors else ""
        queries = "query" if len(told) == 1 else "queries"
        yield f"gravity from {shorten(source)} in {len(told)} {queries}, within {min(bounds):.2g}{most} deg{off}"


def _without_lines(rows: Sequence[QueryResult]) -> Iterator[str]:
    """A line for each of the first queries whose lines gave no gravity."""
    reasons = {row.query: why for row in rows for remark in row.remarks if (why := why_not_found(remark))}
    for query, why in list(reasons.items())[:MAX_TOLD]:
        yield f"no gravity from lines of {query}: {why}"
    if len(reasons) > MAX_TOLD:
        yield f"no gravity from lines of {len(reasons) - MAX_TOLD} more, see results.csv"


def _remarks(rows: Sequence[QueryResult]) -> Iterator[str]:
    """Lines on what was wrong with the files or the gravity of queries, each of which may be of several queries."""
    about: dict[str, list[str]] = {}
    for row in rows:
        known = (NO_POINT, INITIALISED) if row.status in POSED else (INITIALISED,)
        for remark in row.remarks:
            if not why_not_found(remark) and not any(word in remark for word in known):
                about.setdefault(remark, []).append(row.query)
    for remark, queries in list(about.items())[:MAX_TOLD]:
        more = f" and {len(queries) - 1} more" if len(queries) > 1 else ""
        yield f"{queries[0]}{more}: {remark.removesuffix('.')}"
    if len(about) > MAX_TOLD:
        yield f"and {len(about) - MAX_TOLD} more remarks, see results.csv"


def _rate(rate: SuccessRate, unit: str) -> str:
    length = f"{rate.metres:g} {unit}"
    limits = length if rate.degrees is None else f"{rate.degrees:g} deg, {length}"
    what = "registration within " if rate.degrees is None else "within "
    if rate.rate is None or rate.low is None or rate.high is None:
        return f"{what}{limits}: nothing to judge"
    interval = f"{100 * rate.low:.1f} to {100 * rate.high:.1f} %"
    return f"{what}{limits}: {100 * rate.rate:.1f} % ({rate.successes} of {rate.judged}; 95 %: {interval})"


def _skipped(summary: Summary) -> Iterator[str]:
    if summary.unreadable:
        yield f"not judged: {summary.unreadable} with an unreadable image"
    if summary.without_truth:
        none = not any(rate.judged for rate in summary.success)
        yield (
            "errors are unknown: these queries have no true poses"
            if none
            else f"not judged by the truth: {summary.without_truth} whose true pose is unknown"
        )
    if summary.not_registered:
        yield f"not judged by registration: {summary.not_registered} that could not be registered"


def _without_pose(rows: Sequence[QueryResult]) -> Iterator[str]:
    lost = [row for row in rows if row.status not in POSED]
    for row in lost[:MAX_TOLD]:
        what = row.message if row.query in row.message else f"{row.query}: {row.message}"
        yield f"{'unreadable' if row.status == UNREADABLE else 'no pose'}: {what}"
    if len(lost) > MAX_TOLD:
        yield f"and {len(lost) - MAX_TOLD} more without a pose, see results.csv"


TABLE, MARKDOWN = "comparison.csv", "comparison.md"
NONE = "–"


@dataclass(frozen=True)
class Compared:
    """The results of one estimator for a sequence."""

    label: str
    """Name of the estimator with its options."""
    results: SequenceResults
    """Results of all finished queries."""
    summary: Summary
    """Summary of these results."""
    backdrop: "Backdrop"
    """What the picture shows of the sequence's map."""


def write_comparison(folder: Path, found: Sequence[Compared]) -> str:
    """Write the table (CSV and Markdown) and a picture of each sequence to a folder; returns the table as text.

    Raises ``InputError`` if they cannot be written.
    """
    from spherloc_viz.plots.trajectories import trajectories_png

    table = comparison_table(found)
    files = {
        TABLE: "".join(csv_line(line) for line in (table.columns, *table.rows)).encode(),
        MARKDOWN: markdown(table).encode(),
    }
    scenes: dict[str, list[Compared]] = {}  # by the path: two can have one name
    for item in found:
        scenes.setdefault(item.results.configuration.scene, []).append(item)
    for of_scene in scenes.values():
        name = re.sub(r"[^A-Za-z0-9-]+", "_", of_scene[0].results.configuration.name).strip("_") or "scene"
        numbered = chain([f"{name}.png"], (f"{name}_{number}.png" for number in count(2)))
        picture = trajectories_png([(item.label, item.results) for item in of_scene], of_scene[0].backdrop)
        files[next(file for file in numbered if file not in files)] = picture
    for name, content in files.items():
        try:
            folder.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)
        except OSError as error:
            raise InputError(f"{folder / name}: cannot be written ({reason(error)}); give another --output.") from None
    return "\n".join([text_of(table), f"written to {folder}: {', '.join(files)}"])


def comparison_table(found: Sequence[Compared]) -> Table:
    """A row for each sequence and estimator. Limits are those of the sequence's scene."""
    columns = (
        "scene", "estimator", "localized", "doubtful", "no pose", "success within the limits (%)", "limits",
        "rotation error", "position error", "precision / recall / F1 (%)", "time",
    )  # fmt: skip
    return Table("localize", columns, tuple(_row(item) for item in found))


def _row(item: Compared) -> tuple[str, ...]:
    told = item.summary
    rates = told.success or told.registration_success
    scores = (told.median_precision, told.median_recall, told.median_f1)
    return (
        item.results.configuration.name,
        item.label,
        f"{told.localized} of {told.done}",
        str(told.doubtful),
        str(told.failed),
        " / ".join(NONE if rate.rate is None else f"{100 * rate.rate:.1f}" for rate in rates) or NONE,
        " / ".join(_limit(rate, item.results.configuration.unit) for rate in rates) or NONE,
        _quantity(told.median_rotation_error_deg, "deg"),
        _length(told.median_translation_error_m, item.results.configuration),
        " / ".join(NONE if score is None else f"{100 * score:.1f}" for score in scores),
        _quantity(told.median_estimating_ms, "ms"),
    )


def _limit(rate: SuccessRate, unit: str) -> str:
    return f"{rate.metres:g} {unit}" if rate.degrees is None else f"{rate.metres:g} {unit} {rate.degrees:g}°"


def _length(value: float | None, setting: Configuration) -> str:
    return NONE if value is None else setting.length(value)


def _quantity(value: float | None, unit: str) -> str:
    return NONE if value is None else f"{value:.3g} {unit}"


def markdown(table: Table) -> str:
    """The table in Markdown."""
    lines = [table.columns, ["---"] * len(table.columns), *table.rows]
    return "".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |\n" for line in lines)
