"""``spherloc verify``: the paper's simulations, its claims, and a page that says which hold."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from spherloc.errors import InputError, reason, show
from spherloc.experiments.sweep import run_sweep
from spherloc.experiments.sweep_log import SweepLog
from spherloc.experiments.sweep_plan import SweepPlan
from spherloc.experiments.sweep_rows import SweepRow
from spherloc.files import is_file, read_file
from spherloc.verification.claims import CLAIMS, Checked, check
from spherloc.verification.experiments import EXPERIMENTS, Experiment
from spherloc.verification.kept import kept_text, with_kept
from spherloc.verification.measured import Measured
from spherloc.verification.sessions import DATASETS
from spherloc.warm_up import warm_up
from spherloc_viz.progress import progress, say
from spherloc_viz.verification_datasets import run_sessions, tables_text
from spherloc_viz.verification_page import verification_page
from spherloc_viz.verification_parts import PHASES, part_pages
from spherloc_viz.verification_pictures import failure_table, session_pictures
from spherloc_viz.verification_plots import FIGURES, figure_svg, phase_svg

PAGE, TABLES, RESULTS, RUNS = "index.md", "tables.md", "claims.json", "runs"
MAX_BYTES = 10_000_000
"""Of the results of an earlier time."""


def verify(
    output: Path,
    quick: bool,
    workers: int,
    scheduler: str | None,
    only: Sequence[str] = (),
    datasets: Mapping[str, Path] | None = None,
) -> int:
    """Do the runs that ``output`` has not got, and write the page; returns the exit code, which is 0.

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
    """All rows of a plan: those of earlier times, and those that are done now."""
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
