"""``spherloc sweep --by``: a sweep over two properties, as one table and one map an estimator."""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from spherloc.errors import InputError, reason, show
from spherloc.experiments.sweep_plan import AXES, parse_values
from spherloc.experiments.sweep_rows import Point
from spherloc_viz.batch import Records
from spherloc_viz.sweep import sweep

Points = Mapping[float, Sequence[Point]]
"""Of each value of the second property."""
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
    file = io.BytesIO()
    figure.savefig(file, format="png", metadata={"Software": None})
    return file.getvalue()
