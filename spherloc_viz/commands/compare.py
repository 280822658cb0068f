"""``spherloc compare`` and ``rerun``: what changed between two sets of runs on the same problems."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from spherloc.diagnosis import diagnose
from spherloc.errors import InputError, RecordingError, SpherlocError, show
from spherloc.estimators import default_options
from spherloc.ranges import check_options
from spherloc.warm_up import warm_up
from spherloc_viz.app.desk.comparison import (
    QUANTITIES,
    Condition,
    OutcomeChanges,
    Pair,
    compare,
    compare_pairs,
    parse_condition,
)
from spherloc_viz.app.desk.report import comparison_html, comparison_text
from spherloc_viz.commands.progress import progress, say, solve
from spherloc_viz.commands.run import Records, parse_settings, store_of
from spherloc_viz.commands.runs import rows_at
from spherloc_viz.options import json_text
from spherloc_viz.recording.index.query import RunQuery
from spherloc_viz.recording.origin import Origin
from spherloc_viz.recording.replay import load_recorded_scene, recorded_options
from spherloc_viz.recording.run_row import RunRow
from spherloc_viz.recording.sandbox.examiner import examine
from spherloc_viz.recording.storage.store import RecordingStore


@dataclass(frozen=True)
class Wanted:
    """Settings of the report of a comparison."""

    fail_if: tuple[Condition, ...]
    """Conditions; if one of them holds, the exit code is 1."""
    report: Path | None
    """An HTML file to be written."""
    as_json: bool
    """Whether it is printed as JSON for programs."""


def wanted(fail_if: Sequence[str], report: Path | None, as_json: bool) -> Wanted:
    """Checked before anything is read; raises ``InputError`` for a condition or file that cannot be."""
    if report is not None and report.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"--report {report}: give the name of an HTML file, such as night.html.")
    return Wanted(tuple(map(parse_condition, fail_if)), report, as_json)


def compare_runs(before: Path, after: Path, labels: tuple[str | None, str | None], asked: Wanted) -> int:
    """Compare two folders, sets or labels, and print it; returns the exit code.

    Raises ``SpherlocError`` if one has no runs, or none on a problem of the other.
    """
    sides = [rows_at(place, RunQuery(label=label))[1] for place, label in zip((before, after), labels, strict=True)]
    names = [
        str(place) if label is None else f"{place}, label {label}"
        for place, label in zip((before, after), labels, strict=True)
    ]
    return _tell(compare(*sides), names[0], names[1], asked)


def rerun(
    places: Sequence[Path],
    query: RunQuery,
    estimator: str | None,
    settings: Sequence[str],
    seed: int | None,
    records: Records,
    asked: Wanted,
) -> int:
    """Solve recorded problems again and compare the results with the recorded ones; returns the exit code.

    A recording that cannot be read, or not be solved, is reported and left out. Raises ``SpherlocError`` if no run is
    left, and for options that no run can have.
    """
    runs = [(folder / row.file, row) for place in places for folder, rows in [rows_at(place, query)] for row in rows]
    estimators = {estimator or row.estimator for _, row in runs}
    if settings and len(estimators) > 1:
        raise InputError(
            f"the runs are of {', '.join(sorted(estimators))}, which take different options: give one with --estimator."
        )
    changes = parse_settings(next(iter(estimators)), settings) if settings else {}
    warm_up(say, estimators)
    pairs: list[Pair] = []
    with store_of(records) as store, ThreadPoolExecutor(1) as writer, progress(len(runs), "runs") as advance:
        assert store is not None
        written = []
        for path, row in runs:
            try:
                done = _again(path, estimator, changes, seed)
            except SpherlocError as error:
                say(f"{error} It is left out.")
            else:
                written.append((row, writer.submit(_record, store, *done)))
            advance("")
        for row, job in written:
            try:
                pairs.append(Pair(row, job.result()))
            except RecordingError as error:
                say(f"{error} The run is left out.")
    if not pairs:
        raise InputError("none of the recorded problems could be solved again.")
    say(f"{len(pairs):,} runs are recorded in {records.folder}.")
    return _tell(compare_pairs(tuple(pairs), len(runs) - len(pairs)), "as recorded", "run again", asked)


def _again(path: Path, estimator: str | None, changes: dict[str, Any], seed: int | None) -> tuple[Any, Origin]:
    """Solve a recorded problem; other options than those of another estimator stay as they were recorded."""
    scene = load_recorded_scene(path)
    run = scene.run
    name = estimator or run.estimator
    options = recorded_options(run, path) if name == run.estimator else default_options(name, run.problem)
    options = replace(options, **changes)
    check_options(options)
    trace = solve(run.problem, name, options, run.seed if seed is None else seed)
    return trace, replace(run.origin or Origin(), source="command", title="", story="")


def _record(store: RecordingStore, trace: Any, origin: Origin) -> RunRow:
    path = store.record(trace, origin, diagnose(trace))
    return store.index.get(path.name) or examine(path)


def _tell(found: OutcomeChanges, before: str, after: str, asked: Wanted) -> int:
    """Print a comparison, and write its report; returns 1 if one of the conditions holds."""
    if asked.report is not None:
        _write(asked.report, comparison_html(found, before, after, datetime.now(UTC)))
    failed = [condition for condition in asked.fail_if if condition.holds(found)]
    if asked.as_json:
        table: dict[str, Any] = {name: quantity(found) for name, quantity in QUANTITIES.items()}
        table["broken"] = [[pair.before.file, pair.after.file] for pair in found.broken]
        table["mended_runs"] = [[pair.before.file, pair.after.file] for pair in found.mended]
        table["failed_conditions"] = [condition.text for condition in failed]
        print(json_text(table), flush=True)
    else:
        print(comparison_text(found, before, after), end="", flush=True)
    for condition in failed:
        say(f"fails, since {show(condition.text)} holds.")
    return 1 if failed else 0


def _write(path: Path, text: str) -> None:
    try:
        with suppress(FileExistsError):
            path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"{path}: the report cannot be written ({reason}); choose another place.") from error
    say(f"report written to {path}")
