"""``spherloc sweep``: success, errors and time of estimators over a property of a simulation, resumable."""

from collections.abc import Sequence
from pathlib import Path

from spherloc.datasets import load_scene
from spherloc.datasets.variation_text import parse_variation
from spherloc.estimators import warm_up
from spherloc.experiments.sweep import Entrant, SweepPlan, planned, run_sweep
from spherloc.experiments.sweep_log import SweepLog
from spherloc.experiments.sweep_summary import summarize
from spherloc.experiments.sweep_text import parse_values
from spherloc_viz.batch import parse_settings
from spherloc_viz.layers.primitives import Table
from spherloc_viz.layers.sweep import sweep_table
from spherloc_viz.progress import progress, say


def sweep(
    scene: Path,
    over: str,
    values: Sequence[str],
    estimators: Sequence[str],
    settings: Sequence[str],
    runs: int,
    seed: int,
    workers: int,
    scheduler: str | None,
    out: Path,
) -> int:
    """Do the runs that ``out`` has not got; returns the exit code, which is 0.

    Raises ``InputError`` for whatever makes the sweep impossible.
    """
    entrants = [parse_entrant(text) for text in estimators]
    plan = planned(scene, over, parse_values(values), entrants, runs, parse_variation(settings), seed)
    with SweepLog(out, plan) as log:
        left = plan.rows - log.done_of_plan()
        if log.rows:
            say(f"{out}: {plan.rows - left:,} of {plan.rows:,} runs are done already.")
        try:
            if left:
                _work(plan, log, left, workers, scheduler)
        except KeyboardInterrupt:
            say(f"stopped; {len(log.rows):,} runs are in {out}, and the same command goes on from there.")
            raise
        log.finish()
        points = summarize(plan.labels, log.rows)
        from spherloc_viz.sweep_plot import sweep_png

        log.write(log.beside(".png"), sweep_png(load_scene(scene).name, over, plan.labels, points))
        print(text_of(sweep_table(over, points)))
        print(f"written to {out}, {log.beside('.summary.csv').name} and {log.beside('.png').name}", flush=True)
    return 0


def _work(plan: SweepPlan, log: SweepLog, left: int, workers: int, scheduler: str | None) -> None:
    if scheduler is None:
        warm_up(say)  # once, before all workers do it
    with progress(left, "runs") as advance:
        for row in run_sweep(plan, log.done, workers, scheduler):
            log.append(row)
            advance("")


def parse_entrant(text: str) -> Entrant:
    """An estimator from its name and options, such as "ransac-2p,iterations=1000".

    Raises ``InputError`` for a name or option that does not exist.
    """
    name, *settings = text.split(",")
    return Entrant(name, tuple(parse_settings(name, settings).items()))


def text_of(table: Table) -> str:
    """A table for a terminal, its columns aligned."""
    rows = [table.columns, *table.rows]
    widths = [max(len(str(row[k])) for row in rows) for k in range(len(table.columns))]
    return "\n".join("  ".join(f"{cell!s:<{w}}" for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows)
