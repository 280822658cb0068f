"""The paper's figures, drawn from our own runs: Figs. 5 to 7 as SVG, Figs. 8 to 10 from sessions of a dataset."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.collections import PathCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from numpy.typing import NDArray

from spherloc.datasets import load_scene
from spherloc.datasets.map_scene import MapScene
from spherloc.estimators import estimate
from spherloc.experiments.results import LOCALIZED, SequenceResults, read_results
from spherloc.experiments.sweep_plan import AXES
from spherloc.frontend.view import Matches
from spherloc.geometry import align_to_down
from spherloc.metrics import SUCCESS_DEG, SUCCESS_M
from spherloc.types import BoolArray, FloatArray
from spherloc.verification.experiments import METHODS, PHASE_GRAVITY_DEG, PHASE_METHODS, phase_key
from spherloc.verification.measured import Cell, Measured
from spherloc.verification.sessions import DATASETS, TABLE_METHODS
from spherloc_viz.plots.saving import png_of, svg_of
from spherloc_viz.style import ERROR_RAMP, css

DPI = 110
PANEL_INCHES = (4.2, 4.4)
MAX_COLUMNS = 3
FIGURE_METHODS = ("MC", "2P100", "ML100", "mc-exact")
"""Methods in the figures; those of the paper are the first three."""
RIGHT, WRONG, REJECTED = "#1a9850", "#f28e2b", "#d73027"
"""Colours of a right inlier, a wrong inlier, and a match that is not an inlier."""


FAILURES = """\
## Fig. 9: why queries fail

The paper shows three kinds: too few inliers, too many outliers, and a wrong reference image. Every failure of a run
gets its cause by the [diagnosis](../failures.md), here of all queries of the sessions above:

"""
METHOD_FIGURES = """\
## Figs. 8 and 10: several methods in one picture

![Inliers by several methods]({fig8})

Session {session}, query {query}, which has the most outliers ({share:.0f} % of {matches} matches): green, inliers that
are right; orange, inliers that are not; red, all other matches.

![Trajectories by several methods]({fig10})

Session {session}: the bluer, the smaller the error (up to {limit:g} m); crosses have no pose. Roughness is the median
second difference of the positions, small where the way is what the paper calls smooth.
"""
LIMIT_M = 0.5
"""Error beyond which all have one colour in Fig. 10."""


def failure_table(results: Path) -> str:
    """Fig. 9 as Markdown: causes of failure by method, of all sessions in the folder of ``run_sessions``."""
    counts: dict[str, Counter[str]] = {name: Counter() for name in FIGURE_METHODS}
    for dataset in DATASETS:
        for name in FIGURE_METHODS:
            for path in sorted(results.glob(f"{dataset.key}_*/{name}/results.jsonl")):
                rows = read_results(path.parent).rows
                counts[name].update(row.diagnosis or "no problem to solve" for row in rows if row.status != LOCALIZED)
    lines = ["| cause | " + " | ".join(FIGURE_METHODS) + " |", "|---|" + "---|" * len(FIGURE_METHODS)]
    for cause in sorted({cause for counter in counts.values() for cause in counter}):
        lines.append(f"| {cause} | " + " | ".join(str(counts[name][cause]) for name in FIGURE_METHODS) + " |")
    return FAILURES + "\n".join(lines) + "\n"


def session_pictures(results: Path, dataset: str, session: str) -> tuple[dict[str, bytes], str]:
    """Figs. 8 and 10 of a session in the folder of ``run_sessions``: PNG by file name, and the Markdown about them.

    Nothing and an empty text if no query's truth is known.
    """
    folder = results / f"{dataset}_{session}"
    several = [(name, read_results(folder / name)) for name in FIGURE_METHODS]
    shares = {row.query: row.true_outlier_rate for row in several[0][1].rows if row.true_outlier_rate is not None}
    scene = load_scene(folder / "scene.toml")
    if not shares or not isinstance(scene, MapScene):
        return {}, ""
    hardest = max(shares, key=lambda name: shares[name])
    view = scene.query(hardest)
    matches = scene.matches(view)
    problem = scene.problem_of(view, matches)
    shown = []
    for name in FIGURE_METHODS:
        entrant = TABLE_METHODS[name]
        trace = estimate(problem, entrant.estimator, entrant.options(problem), 0)
        shown.append(Inliers(name, trace.inlier_mask))
    files = {
        f"fig8_{dataset}_{session}.png": inliers_png(
            view.read(), matches.references[0].read(), matches, problem.truth_inliers, shown
        ),
        f"fig10_{dataset}_{session}.png": trajectories_by_error_png(several, LIMIT_M),
    }
    fig8, fig10 = files
    words = METHOD_FIGURES.format(
        fig8=fig8,
        fig10=fig10,
        session=session,
        query=hardest,
        share=100 * shares[hardest],
        matches=len(matches.pixels),
        limit=LIMIT_M,
    )
    return files, words


@dataclass(frozen=True, eq=False)
class Inliers:
    """Result of one method for the matches of a query."""

    label: str
    """The method."""
    mask: BoolArray
    """(N,) mask of its inliers."""


def inliers_png(
    query: NDArray[np.uint8],
    reference: NDArray[np.uint8],
    matches: Matches,
    right: BoolArray | None,
    several: Sequence[Inliers],
) -> bytes:
    """PNG of Fig. 8: query and first reference side by side with a line for each match, and a panel for each method.

    Inliers are green, those that are not ``right`` (N,) orange, all other matches thin and red. Matches with other
    references are left out. The same input gives the same bytes.
    """
    shown = (matches.reference_index == 0) & np.isfinite(matches.reference_pixels).all(axis=1)
    scale = query.shape[0] / reference.shape[0]
    side = cv2.resize(reference, (round(scale * reference.shape[1]), query.shape[0]))
    both = np.hstack([query, side])[:, :, ::-1]
    starts, ends = matches.pixels, scale * matches.reference_pixels + [query.shape[1], 0.0]
    columns = min(len(several), 2)
    rows = -(-len(several) // columns)
    size = (6.4 * columns, 6.4 * columns / columns * both.shape[0] / both.shape[1] * rows + 0.35 * rows)
    figure = Figure(figsize=size, dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    panels = list(figure.subplots(rows, columns, squeeze=False).flat)
    for axes, item in zip(panels, several, strict=False):
        axes.imshow(both)
        good = item.mask if right is None else item.mask & right
        for mask, color, width in ((~item.mask, REJECTED, 0.25), (item.mask & ~good, WRONG, 0.8), (good, RIGHT, 0.8)):
            for place in np.flatnonzero(mask & shown):
                axes.plot(*np.stack([starts[place], ends[place]]).T, color=color, linewidth=width)
        count, of_them = int(np.count_nonzero(item.mask)), int(np.count_nonzero(good))
        words = f"{count} inliers" if right is None else f"{of_them} right of {count} inliers"
        axes.set_title(f"{item.label}: {words}", parse_math=False, fontsize=9)
    for axes in panels:
        axes.set_axis_off()
    return png_of(figure)


def trajectories_by_error_png(several: Sequence[tuple[str, SequenceResults]], limit_m: float) -> bytes:
    """PNG of Fig. 10: a panel a method, its positions from above, joined and coloured by their error, blue where it is
    small; beyond ``limit_m`` one colour; the true way is grey, queries without a pose are crosses.

    The same results give the same bytes.
    """
    columns = min(len(several), MAX_COLUMNS)
    rows = -(-len(several) // columns)
    figure = Figure(figsize=(PANEL_INCHES[0] * columns, PANEL_INCHES[1] * rows), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    panels = list(figure.subplots(rows, columns, squeeze=False).flat)
    first = several[0][1]
    turn = align_to_down(first.configuration.gravity_map)
    truth = (first.true_positions_m @ turn.T)[:, [0, 2]]
    colors = LinearSegmentedColormap.from_list("error", [css(color) for color in ERROR_RAMP])
    drawn = None
    for axes, (label, results) in zip(panels, several, strict=False):
        drawn = _panel(axes, label, results, truth, turn, limit_m, colors) or drawn
    for axes in panels[len(several) :]:
        axes.set_visible(False)
    if drawn is not None:
        figure.colorbar(drawn, ax=panels[: len(several)], label="position error (m)", shrink=0.8)
    return png_of(figure)


def _panel(
    axes: Axes,
    label: str,
    results: SequenceResults,
    truth: FloatArray,
    turn: FloatArray,
    limit_m: float,
    colors: LinearSegmentedColormap,
) -> PathCollection | None:
    """Draw one method; returns the coloured artist for the colour bar, None if there is no pose."""
    places = (results.positions_m @ turn.T)[:, [0, 2]]
    errors = np.linalg.norm(results.positions_m - results.true_positions_m, axis=1)
    axes.plot(*truth.T, color="0.7", linewidth=2.5, zorder=1)
    there = np.isfinite(places).all(axis=1)
    middle, half = np.nanmean(truth, axis=0), 0.6 * np.nanmax(np.ptp(truth, axis=0)) + limit_m
    axes.plot(*places[there].T, color="0.4", linewidth=0.7, zorder=2)
    drawn = None
    if there.any():
        drawn = axes.scatter(
            *places[there].T, c=np.minimum(errors[there], limit_m), vmin=0.0, vmax=limit_m, cmap=colors, s=26, zorder=3
        )
    if not there.all():
        axes.plot(*truth[~there].T, "x", color=REJECTED, markersize=7, zorder=3)
    axes.set_xlim(middle[0] - half, middle[0] + half)
    axes.set_ylim(middle[1] - half, middle[1] + half)
    axes.set_aspect("equal")
    steps = np.diff(places[there], axis=0)
    rough = float(np.median(np.linalg.norm(np.diff(steps, axis=0), axis=1))) if len(steps) > 1 else np.nan
    seen = errors[there]
    words = f"median error {np.median(seen):.2g} m, roughness {rough:.2g} m" if len(seen) else "no pose"
    axes.set_title(f"{label}\n{words}", parse_math=False, fontsize=9)
    axes.tick_params(labelsize=7)
    return drawn


FIGURES = ("fig5", "fig6", "fig7", "fig6-normal", "fig7-normal")
"""Experiments that are drawn."""
BOXES: Mapping[str, str] = {"MC": "#7b2d8b", "2P100": "#1b6ca8", "SVD100": "#c77d0a", "ML100": "#3a8a3a"}
"""Methods of Fig. 5 and their colours."""
COLORS = ("#7b2d8b", "#c06fd0", "#1b6ca8", "#5fb3e6", "#c77d0a", "#3a8a3a", "#8fce6b", "#b02a30", "#111111", "#777777")
DASHES: Mapping[bool, tuple[int, tuple[int, ...]]] = {True: (0, ()), False: (0, (4, 2))}
"""Line styles of methods as printed, and of this project's own forms."""
MIN_ERROR = {"rotation_error_deg": 1e-3, "t_error_m": 1e-4}
"""Lower ends of the logarithmic axes of errors; smaller errors are rounding."""
WIDTH_INCHES, HEIGHT_INCHES = 11.0, 4.2
ENOUGH = 0.95
"""Least success rate of a method that can be recommended."""
PHASE_CAMERA = "MEI"
CANNOT_BE_KNOWN = "cannot be known: chance gives as large a set"
NONE_IS_ENOUGH = "no method in 95 %"
PHASE_COLORS: Mapping[str, str] = {
    "ransac-2p 1k": "#9ecae1",
    "mc": "#dcb8e6",
    "mc-exact": "#a8dba8",
    NONE_IS_ENOUGH: "#ffffff",
    CANNOT_BE_KNOWN: "#c8c8c8",
}


def figure_svg(experiment: str, camera: str, over: str, measured: Measured) -> str:
    """SVG of an experiment of ``FIGURES`` through a camera; the same runs give the same text."""
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "spherloc", "font.size": 9}):
        figure = Figure(figsize=(WIDTH_INCHES, HEIGHT_INCHES), layout="constrained")
        FigureCanvasSVG(figure)
        if experiment == "fig5":
            _noise(figure, experiment, camera, measured)
        else:
            _rates(figure, experiment, camera, over, measured)
        return svg_of(figure)


def phase_svg(measured: Measured) -> str:
    """SVG of the quickest estimator that is right in 95 % of the problems, over outlier rate and number of matches, and
    of the region where the answer cannot be known: where chance gives sets as large as the right one."""
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "spherloc", "font.size": 9}):
        figure = Figure(figsize=(WIDTH_INCHES, HEIGHT_INCHES), layout="constrained")
        FigureCanvasSVG(figure)
        for axes, (gravity_deg, counts) in zip(figure.subplots(1, 2), PHASE_GRAVITY_DEG.items(), strict=True):
            _phases(axes, measured, gravity_deg, counts)
        handles = [Patch(facecolor=color, edgecolor="0.4", label=name) for name, color in PHASE_COLORS.items()]
        figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize=8.5, frameon=False)
        return svg_of(figure)


def _phases(axes: Axes, measured: Measured, gravity_deg: float, counts: Sequence[int]) -> None:
    for row, count in enumerate(counts):
        key = phase_key(count, gravity_deg)
        for column, value in enumerate(measured.values(key, PHASE_CAMERA)):
            cells = [measured.cell(key, PHASE_CAMERA, name, value) for name in PHASE_METHODS]
            known = [cell for cell in cells if cell is not None]
            color = PHASE_COLORS[_phase_of(known)]
            axes.add_patch(
                Rectangle((column - 0.5, row - 0.5), 1.0, 1.0, facecolor=color, edgecolor="0.4", linewidth=0.5)
            )
            rates = "\n".join(f"{100 * cell.rate:.0f}" for cell in known)
            axes.text(column, row, rates, ha="center", va="center", fontsize=6.0, linespacing=0.95)
    values = measured.values(phase_key(counts[0], gravity_deg), PHASE_CAMERA)
    axes.set_xlim(-0.5, len(values) - 0.5)
    axes.set_ylim(-0.5, len(counts) - 0.5)
    axes.set_xticks(range(len(values)), [f"{100 * value:g}" for value in values])
    axes.set_yticks(range(len(counts)), [f"{count}" for count in counts])
    axes.set_xlabel("outliers (%)")
    axes.set_ylabel("matches")
    what = "gravity exact" if gravity_deg == 0.0 else f"gravity off by {gravity_deg:g}° (sd of roll and pitch)"
    axes.set_title(f"{what}; success in % of {', '.join(PHASE_METHODS)}", fontsize=8.5)


def _phase_of(cells: Sequence[Cell]) -> str:
    """The quickest method that is right often enough, or why there is none."""
    for cell in cells:
        if cell.rate >= ENOUGH:
            return cell.place.method
    exact = next((cell for cell in cells if cell.place.method == "mc-exact"), None)
    false_sets = 0.0 if exact is None else exact.median("nfa")
    return CANNOT_BE_KNOWN if false_sets >= 1.0 else NONE_IS_ENOUGH


def _noise(figure: Figure, experiment: str, camera: str, measured: Measured) -> None:
    """Fig. 5: boxes of both errors at each noise level; boxes hold the quartiles, whiskers 5 to 95 %."""
    shown = [name for name in measured.methods(experiment, camera) if name in BOXES]
    columns = (("rotation_error_deg", "rotation error (°)"), ("t_error_m", "|t_true − t| (m)"))
    for axes, (column, label) in zip(figure.subplots(1, 2), columns, strict=True):
        for place, name in enumerate(shown):
            cells = measured.curve(experiment, camera, name)
            width = 0.8 / len(shown)
            middle = [cell.place.value + (place - 0.5 * (len(shown) - 1)) * width for cell in cells]
            boxes = [np.clip(_finite(cell.values(column)), MIN_ERROR[column], None) for cell in cells]
            drawn = axes.boxplot(
                boxes,
                positions=middle,
                widths=0.85 * width,
                whis=(5.0, 95.0),
                showfliers=False,
                manage_ticks=False,
                patch_artist=True,
                medianprops={"color": "black", "linewidth": 1.0},
            )
            for box in drawn["boxes"]:
                box.set(facecolor=BOXES[name], alpha=0.75, linewidth=0.5)
            axes.plot([], [], color=BOXES[name], linewidth=6, label=name)
        axes.set_yscale("log")
        axes.set_ylim(bottom=0.8 * MIN_ERROR[column])
        axes.set_xticks(measured.values(experiment, camera))
        axes.set_xlabel("standard deviation of the noise (px)")
        axes.set_ylabel(label)
        axes.grid(axis="y", color="0.9", linewidth=0.6)
        axes.legend(fontsize=8, frameon=False, ncols=2)


def _finite(values: FloatArray) -> FloatArray:
    return values[np.isfinite(values)]


def _rates(figure: Figure, experiment: str, camera: str, over: str, measured: Measured) -> None:
    """Figs. 6 and 7: success with its Wilson interval, median precision, and time."""
    names = measured.methods(experiment, camera)
    parts: Sequence[tuple[str, Callable[[Cell], float]]] = (
        (f"success within {SUCCESS_DEG:g}° and {SUCCESS_M:g} m (%)", lambda cell: 100.0 * cell.rate),
        ("mean precision of the inliers (%)", lambda cell: 100.0 * float(cell.values("precision").mean())),
        ("median time (ms)", lambda cell: cell.median("time_ms")),
    )
    for axes, (label, value) in zip(figure.subplots(1, 3), parts, strict=True):
        for place, name in enumerate(names):
            cells = measured.curve(experiment, camera, name)
            x = 100.0 * np.array([cell.place.value for cell in cells])
            color, dash = COLORS[place % len(COLORS)], DASHES[("as_printed", True) in METHODS[name].changes]
            if value is parts[0][1]:
                low, high = 100.0 * np.array([cell.interval for cell in cells]).T
                axes.fill_between(x, low, high, color=color, alpha=0.08, linewidth=0)
            axes.plot(
                x, [value(cell) for cell in cells], color=color, linestyle=dash, marker="o", markersize=3, label=name
            )
        _finish(axes, AXES[over], label, log="time" in label)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(6, len(labels)), fontsize=8, frameon=False)


def _finish(axes: Axes, x_label: str, y_label: str, log: bool) -> None:
    axes.set_xlabel(f"{x_label} (%)")
    axes.set_title(y_label, fontsize=9)
    axes.grid(color="0.9", linewidth=0.6)
    if log:
        axes.set_yscale("log")
    else:
        axes.set_ylim(-3.0, 103.0)
