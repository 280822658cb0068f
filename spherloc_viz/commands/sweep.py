"""``spherloc sweep``: success, errors and time over one property of a simulation or two, resumable."""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from spherloc.datasets import bundled_scenes, load_scene
from spherloc.datasets.synthetic import SyntheticScene
from spherloc.datasets.variation import parse_variation
from spherloc.errors import InputError, RecordingError, reason, show
from spherloc.experiments.sweep import Entrant, Keep, SweepPlan, planned, run_sweep
from spherloc.experiments.sweep_log import PICTURE, SUMMARY, SweepLog
from spherloc.experiments.sweep_plan import AXES, parse_values
from spherloc.experiments.sweep_rows import Point, summarize
from spherloc.warm_up import warm_up
from spherloc_viz.commands.progress import progress, say
from spherloc_viz.commands.run import Records, parse_settings, store_of
from spherloc_viz.layers.primitives import Table
from spherloc_viz.layers.sweep import sweep_table
from spherloc_viz.options import usable_estimators
from spherloc_viz.plots.saving import png_of

if TYPE_CHECKING:
    from spherloc_viz.recording.storage.store import RecordingStore

PRUNE_EVERY = 100
"""Number of recorded runs between two checks of the folder's size; workers record several runs a second."""


def sweep(
    scene: Path,
    over: str,
    values: Sequence[str],
    estimators: Sequence[str],
    *,
    settings: Sequence[str],
    runs: int,
    seed: int,
    workers: int,
    scheduler: str | None,
    out: Path,
    records: Records | None = None,
) -> tuple[Point, ...]:
    """Do the runs that ``out`` does not have yet; returns the summary of all runs.

    Without ``records`` they are not recorded. Raises ``InputError`` for whatever makes the sweep impossible.
    """
    entrants = [parse_entrant(text) for text in estimators]
    plan = planned(scene, over, parse_values(values), entrants, runs, parse_variation(settings), seed)
    with SweepLog(out, plan) as log:
        left = plan.rows - log.done_of_plan()
        if log.rows:
            say(f"{out}: {plan.rows - left:,} of {plan.rows:,} runs are done already.")
        try:
            if left:
                with store_of(records) as store:
                    _work(plan, log, left, workers, scheduler, store)
        except KeyboardInterrupt:
            say(f"stopped; {len(log.rows):,} runs are in {out}, and the same command goes on from there.")
            raise
        log.finish()
        points = summarize(plan.labels, log.rows)
        from spherloc_viz.plots.sweeps import sweep_png

        log.write(log.beside(PICTURE), sweep_png(load_scene(scene).name, over, plan.labels, points))
        print(text_of(sweep_table(over, points)))
        print(f"written to {out}, {log.beside(SUMMARY).name} and {log.beside(PICTURE).name}", flush=True)
    return points


def _work(
    plan: SweepPlan, log: SweepLog, left: int, workers: int, scheduler: str | None, store: "RecordingStore | None"
) -> None:
    if scheduler is None:
        warm_up(say, {entrant.estimator for entrant in plan.entrants})  # once, before all workers do it
    recorded = None if store is None else SweepRecordings(store)
    keep = None if recorded is None else recorded.keep(scheduler is not None)
    complain = say if recorded is None else recorded.complain
    with progress(left, "runs") as advance:
        for count, row in enumerate(run_sweep(plan, log.done, workers, scheduler, None, keep, complain, say)):
            log.append(row)
            advance("")
            if recorded is not None and count % PRUNE_EVERY == 0:
                recorded.prune()
    if recorded is not None:
        recorded.finish()


class SweepRecordings:
    """The recordings of a sweep, which its workers write: makes room for them, and says once what fails."""

    def __init__(self, store: "RecordingStore") -> None:
        self._store, self._lost = store, 0

    def keep(self, cluster: bool) -> Keep:
        """The function that records a run in its worker."""
        from spherloc_viz.recording.storage.store import SweepStore

        folder = self._store.folder.resolve()
        if cluster:
            say(f"runs of the cluster's workers on this machine are recorded in {folder}, those of others are not.")
        return SweepStore(folder)

    def complain(self, sentence: str) -> None:
        """Note that a run could not be recorded; only for the first one the reason is printed."""
        self._lost += 1
        if self._lost == 1:
            say(f"{sentence} The sweep goes on.")

    def prune(self) -> None:
        """Delete old successes where there are too many."""
        try:
            self._store.prune()
        except RecordingError as error:
            self.complain(str(error))

    def finish(self) -> None:
        """Delete old successes for the last time, and print how many runs could not be recorded."""
        self.prune()
        if self._lost > 1:
            say(f"{self._lost:,} times something could not be recorded or listed, the first of which was said.")


def bundled_simulations() -> tuple[Path, ...]:
    """Bundled scenes whose properties a sweep can vary."""
    return tuple(path for path in bundled_scenes().values() if isinstance(load_scene(path), SyntheticScene))


def all_estimators() -> tuple[str, ...]:
    """Registered estimators that can be used."""
    return usable_estimators()


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


Points = Mapping[float, Sequence[Point]]
"""Points of the sweep for each value of the second property."""
PANEL_INCHES, DPI = (5.6, 4.2), 120
MAX_COLUMNS = 3


def sweep_two(
    scene: Path,
    over: str,
    values: Sequence[str],
    estimators: Sequence[str],
    *,
    by: str,
    by_values: Sequence[str],
    settings: Sequence[str],
    runs: int,
    seed: int,
    workers: int,
    scheduler: str | None,
    out: Path,
    records: Records | None = None,
) -> int:
    """A sweep over the first property at each value of the second one, each in a CSV beside ``out``, which gets a row a
    point; ``out`` with ``.png`` gets the maps. Goes on as ``sweep`` does; returns the exit code, which is 0.

    Raises ``InputError`` for whatever makes it impossible.
    """
    if by not in AXES or by == over:
        others = ", ".join(name for name in AXES if name != over)
        raise InputError(f"a sweep over {over} cannot go by {show(by)} too; choose one of {others}.")
    found: dict[float, Sequence[Point]] = {}
    for value in parse_values(by_values):
        word = f"{int(value)}" if by == "correspondences" and value == int(value) else f"{value:g}"
        part = out.with_name(f"{out.stem}_{by}_{word}.csv")
        changed = [*settings, f"{by}={word}"]
        found[value] = sweep(
            scene,
            over,
            values,
            estimators,
            settings=changed,
            runs=runs,
            seed=seed,
            workers=workers,
            scheduler=scheduler,
            out=part,
            records=records,
        )
    files = {out: table_text(over, by, found).encode(), out.with_suffix(".png"): maps_png(over, by, found)}
    for path, content in files.items():
        try:
            path.write_bytes(content)
        except OSError as error:
            raise InputError(f"{path}: cannot be written ({reason(error)}); give another --out.") from None
    print(f"written to {out} and {out.with_suffix('.png').name}", flush=True)
    return 0


def table_text(over: str, by: str, found: Points) -> str:
    """CSV with a row a point."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(["estimator", by, over, "runs", "successes", "rate", "low", "high", "median_time_ms"])
    for value, points in found.items():
        for point in points:
            rates = (f"{rate:.4f}" for rate in (point.rate, point.low, point.high))
            time = f"{point.time_ms.median:.4g}"
            writer.writerow([point.estimator, value, point.value, point.runs, point.successes, *rates, time])
    return file.getvalue()


def maps_png(over: str, by: str, found: Points) -> bytes:
    """PNG of the success of each estimator over both properties; the same points give the same bytes."""
    names = list(dict.fromkeys(point.estimator for points in found.values() for point in points))
    across = sorted({point.value for points in found.values() for point in points})
    columns = min(len(names), MAX_COLUMNS)
    rows = -(-len(names) // columns)
    size = (PANEL_INCHES[0] * columns, PANEL_INCHES[1] * rows)
    figure = Figure(figsize=size, dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(rows, columns, squeeze=False).flat
    image = None
    for axes, name in zip(panels, names, strict=False):
        rates = np.full((len(found), len(across)), np.nan)
        for row, points in enumerate(found.values()):
            for point in points:
                if point.estimator == name:
                    rates[row, across.index(point.value)] = 100.0 * point.rate
        image = axes.imshow(rates, vmin=0.0, vmax=100.0, cmap="viridis", origin="lower", aspect="auto")
        for (row, column), rate in np.ndenumerate(rates):
            color = "black" if rate > 60.0 else "white"
            axes.text(column, row, f"{rate:.0f}", ha="center", va="center", fontsize=8, color=color)
        axes.set_xticks(range(len(across)), [f"{value:g}" for value in across])
        axes.set_yticks(range(len(found)), [f"{value:g}" for value in found])
        axes.set_xlabel(AXES[over])
        axes.set_ylabel(AXES[by])
        axes.set_title(name, parse_math=False, fontsize=10)
    for axes in list(panels):
        axes.set_visible(False)
    if image is not None:
        figure.colorbar(image, ax=figure.axes[: len(names)], label="success (%)")
    return png_of(figure)
