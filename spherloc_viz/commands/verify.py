"""``spherloc verify``: the paper's simulations and tables on your datasets, and pages that say which claims hold."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from spherloc.errors import InputError, reason, show
from spherloc.experiments.summary import Summary, summarize
from spherloc.experiments.sweep import run_sweep
from spherloc.experiments.sweep_log import SweepLog
from spherloc.experiments.sweep_plan import SweepPlan
from spherloc.experiments.sweep_rows import SweepRow
from spherloc.files import is_file, read_file
from spherloc.verification.claims import CLAIMS, Checked, check
from spherloc.verification.experiments import EXPERIMENTS, Experiment
from spherloc.verification.kept import kept_text, with_kept
from spherloc.verification.measured import Measured
from spherloc.verification.printed import printed_findings
from spherloc.verification.sessions import (
    DATASETS,
    TABLE_METHODS,
    Dataset,
    DatasetSession,
    iterations,
    printed_tables,
    sessions_of,
)
from spherloc.warm_up import warm_up
from spherloc_viz.commands.localize import Solving, localized
from spherloc_viz.commands.progress import progress, say
from spherloc_viz.commands.verify_page import PHASES, part_pages, verification_page
from spherloc_viz.commands.verify_pictures import FIGURES, failure_table, figure_svg, phase_svg, session_pictures

PAGE, TABLES, RESULTS, RUNS = "index.md", "tables.md", "claims.json", "runs"
MAX_BYTES = 10_000_000
"""Largest file of earlier results."""


def verify(
    output: Path,
    quick: bool,
    workers: int,
    scheduler: str | None,
    only: Sequence[str] = (),
    datasets: Mapping[str, Path] | None = None,
) -> int:
    """Do the runs that ``output`` does not have yet, and write the page; returns the exit code, which is 0.

    ``only`` are keys of experiments and datasets; all if there are none. ``datasets`` are folders, by key. Raises
    ``InputError`` for an experiment that does not exist, and for whatever makes the runs or the page impossible.
    """
    experiments = _chosen(only)
    plans = {
        (experiment.key, camera): experiment.plan(camera, quick)
        for experiment in experiments
        for camera in experiment.cameras
    }
    total = sum(plan.rows for plan in plans.values())
    if plans:
        say(f"{total:,} runs → {output}. Ctrl-C stops them; the same command goes on.")
    if plans and scheduler is None:
        warm_up(say, {entrant.estimator for plan in plans.values() for entrant in plan.entrants})
    rows: dict[tuple[str, str], list[SweepRow]] = {}
    for place, (key, plan) in enumerate(plans.items(), 1):
        title = f"{key[0]}, {key[1]} ({place} of {len(plans)})"
        rows[key] = _runs(output / RUNS / f"{_file_name(*key)}.csv", title, plan, workers, scheduler)
    sessions = run_sessions(datasets or {}, output / RUNS, quick)
    tables = tables_text(sessions)
    pictures: dict[str, bytes] = {}
    if sessions:
        tables += "\n" + failure_table(output / RUNS)
        for dataset, session in dict.fromkeys((item.dataset, item.session) for item in sessions):
            files, words = session_pictures(output / RUNS, dataset, session)
            pictures |= files
            tables += "\n" + words
    measured = Measured(rows)
    checked = [check(claim, measured) for claim in CLAIMS]
    if only and is_file(output / RESULTS):
        text = read_file(output / RESULTS, MAX_BYTES).decode("utf-8", "replace")
        checked = with_kept(checked, text, str(output / RESULTS))
    _write(output, measured, checked, plans, tables, pictures, quick)
    for item in checked:
        say(_line(item))
    print(f"written to {output / PAGE}, {RESULTS} and figures", flush=True)
    return 0


def _chosen(only: Sequence[str]) -> list[Experiment]:
    known = [*(experiment.key for experiment in EXPERIMENTS), *(dataset.key for dataset in DATASETS)]
    for key in only:
        if key not in known:
            raise InputError(f"there is no experiment {show(key)}; choose from {', '.join(known)}.")
    return [experiment for experiment in EXPERIMENTS if not only or experiment.key in only]


def _file_name(experiment: str, camera: str) -> str:
    return f"{experiment}_{camera.lower().replace(', ', '_').replace(' ', '_')}"


def _runs(path: Path, title: str, plan: SweepPlan, workers: int, scheduler: str | None) -> list[SweepRow]:
    """All rows of a plan: those of earlier runs of the command, and those that are done now."""
    with SweepLog(path, plan) as log:
        left = plan.rows - log.done_of_plan()
        if left:
            say(f"{title}: {left:,} runs")
            try:
                with progress(left, "runs") as advance:
                    for row in run_sweep(plan, log.done, workers, scheduler, warn=say):
                        log.append(row)
                        advance(title)
            except KeyboardInterrupt:
                say("stopped; what is done is kept, and the same command goes on from there.")
                raise
            log.finish()
        return list(log.rows)


def _line(item: Checked) -> str:
    condition = f" {item.condition}" if item.condition else ""
    return f"{item.claim.place}: {item.claim.sentence} {item.verdict.value.upper()}{condition}"


def _write(
    output: Path,
    measured: Measured,
    checked: Sequence[Checked],
    plans: dict[tuple[str, str], SweepPlan],
    tables: str,
    images: Mapping[str, bytes],
    quick: bool,
) -> None:
    files: dict[str, str] = {}
    for (experiment, camera), plan in plans.items():
        if experiment in FIGURES:
            files[f"{_file_name(experiment, camera)}.svg"] = figure_svg(experiment, camera, plan.over, measured)
    if any(experiment.startswith("phase-") for experiment, _ in plans):
        files[PHASES] = phase_svg(measured)
    pictures = {key: f"{_file_name(*key)}.svg" for key in plans if key[0] in FIGURES}
    files |= part_pages(measured, plans, pictures, quick)
    files[TABLES] = tables
    files[PAGE] = verification_page(checked, quick, sorted({experiment for experiment, _ in plans}))
    files[RESULTS] = kept_text(checked)
    for name, content in {**{name: text.encode() for name, text in files.items()}, **images}.items():
        path = output / name
        try:
            path.write_bytes(content)
        except OSError as error:
            raise InputError(f"{path}: cannot be written ({reason(error)}); give another --output.") from None


EPRO_WORDS = (
    "EPro-PnP learns weights of the matches, which are not published for these features: R+EPro and EPro here are its "
    "solver with equal weights, and EProPNP alone has no counterpart.\n"
)
TABLES_HEAD = """\
# Tables I to VI

As printed in the paper; below each of those on real images, what your copy of the dataset gives by the same methods, by
one command. Numbers of iterations: 2P100, SVD100, ML100 and all R+* of Tables II to V draw 100 samples, 2P1k 1,000; in
Table VI 2P10k, SVD10k, ML10k and R+* draw 10,000; MC draws none. That one command fills these tables is shown by
[rendered copies of the three datasets](applications.md).
"""


@dataclass(frozen=True)
class SessionResult:
    """The result of one method for a session."""

    dataset: str
    """Key of the dataset."""
    session: str
    """Name of the session in the paper's tables."""
    method: str
    """Key of ``TABLE_METHODS``."""
    summary: Summary
    """Summary of its queries."""


def run_sessions(folders: Mapping[str, Path], output: Path, quick: bool) -> list[SessionResult]:
    """Localize every session of the datasets in ``folders`` (by key) by every method; finished queries are not
    repeated.

    Scene files and results go to ``output``; a scene file that is there already stays, so that it can say what a copy
    of a dataset has elsewhere. Raises ``InputError`` for a folder that is not the dataset's.
    """
    todo = [
        (dataset, session)
        for dataset in DATASETS
        if dataset.key in folders
        for session in sessions_of(dataset, folders[dataset.key])
    ]
    found: list[SessionResult] = []
    for dataset, session in todo:
        say(f"{dataset.title}, {session.name}")
        found += _session(dataset, session, output, quick)
    return found


def _session(dataset: Dataset, session: DatasetSession, output: Path, quick: bool) -> list[SessionResult]:
    folder = output / f"{dataset.key}_{session.name}"
    scene = folder / "scene.toml"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not is_file(scene):
            scene.write_text(session.scene, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{scene}: cannot be written ({reason(error)}); give another --output.") from None
    solvings = []
    for name in dataset.methods:
        entrant = TABLE_METHODS[name]
        settings = tuple(f"{key}={str(value).lower()}" for key, value in entrant.changes)
        solvings.append(Solving(entrant.estimator, settings, folder / name, None))
    results = localized(scene, solvings, 0, ("0:10",) if quick else (), False).results
    return [
        SessionResult(dataset.key, session.name, name, summarize(found))
        for name, found in zip(dataset.methods, results, strict=True)
    ]


def tables_text(found: Sequence[SessionResult]) -> str:
    """Markdown of the paper's tables as printed, each followed by the numbers measured here, or by how to measure
    them."""
    parts = [TABLES_HEAD]
    for key, table in printed_tables().items():
        limits = f" ({table['limits']})" if "limits" in table else ""
        parts.append(f"## {table['title']}{limits}\n")
        parts.append(_markdown(table["columns"], table["rows"]))
        dataset = table.get("dataset")
        if dataset is None:
            continue
        ours = [item for item in found if item.dataset == dataset]
        if ours:
            parts.append("Here:\n")
            parts.append(measured_table(ours))
        else:
            parts.append(
                f"Here: data needed. `spherloc verify --{dataset} DIR` adds the table of your copy, with the same "
                "methods.\n"
            )
        if key in ("table4", "table5"):
            parts.append(EPRO_WORDS)
    parts.append(_statements())
    return "\n".join(parts)


def _statements() -> str:
    """The paper's sentences about its tables, each with a verdict."""
    lines = ["## What the text says of the tables\n", "| where | sentence | printed | verdict |", "|---|---|---|---|"]
    for statement, holds, ours in printed_findings():
        verdict = "the table says so" if holds else "**the table does not**"
        lines.append(f"| {statement.place} | {statement.sentence} | {ours} | {verdict} |")
    return "\n".join(lines) + "\n"


def measured_table(found: Sequence[SessionResult]) -> str:
    """Markdown of the measured numbers."""
    return _markdown(*_measured(found))


def _measured(found: Sequence[SessionResult]) -> tuple[list[str], list[list[str]]]:
    columns = ["session", "method", "iterations", "queries", "success (%)", "time (s)", "recall", "precision", "F1"]
    rows = []
    for item in found:
        told = item.summary
        rates = told.registration_success or told.success
        scores = (told.median_recall, told.median_precision, told.median_f1)
        rows.append(
            [
                item.session,
                item.method,
                iterations(TABLE_METHODS[item.method]),
                str(told.done),
                " / ".join("–" if rate.rate is None else f"{100 * rate.rate:.1f}" for rate in rates) or "–",
                "–" if told.median_estimating_ms is None else f"{1e-3 * told.median_estimating_ms:.4f}",
                *("–" if score is None else f"{100 * score:.2f}" for score in scores),
            ]
        )
    return columns, rows


def _markdown(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [columns, ["---"] * len(columns), *rows]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)
