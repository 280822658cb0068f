"""The paper's Figs. 5 to 7, drawn of our own runs, as SVG."""

import io
from collections.abc import Callable, Mapping, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

from spherloc.experiments.sweep_plan import AXES
from spherloc.metrics import SUCCESS_DEG, SUCCESS_M
from spherloc.types import FloatArray
from spherloc.verification.experiments import METHODS, PHASE_GRAVITY_DEG, PHASE_METHODS, phase_key
from spherloc.verification.measured import Cell, Measured

FIGURES = ("fig5", "fig6", "fig7", "fig6-normal", "fig7-normal")
"""Experiments that are drawn."""
BOXES: Mapping[str, str] = {"MC": "#7b2d8b", "2P100": "#1b6ca8", "SVD100": "#c77d0a", "ML100": "#3a8a3a"}
"""Methods of Fig. 5 and their colours."""
COLORS = ("#7b2d8b", "#c06fd0", "#1b6ca8", "#5fb3e6", "#c77d0a", "#3a8a3a", "#8fce6b", "#b02a30", "#111111", "#777777")
DASHES: Mapping[bool, tuple[int, tuple[int, ...]]] = {True: (0, ()), False: (0, (4, 2))}
"""Of methods as printed, and of this project's own forms."""
MIN_ERROR = {"rotation_error_deg": 1e-3, "t_error_m": 1e-4}
"""Where the logarithmic axes of errors start: what is below is rounding."""
WIDTH_INCHES, HEIGHT_INCHES = 11.0, 4.2
ENOUGH = 0.95
"""Success from which on a method is one to choose."""
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
        file = io.StringIO()
        figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    return file.getvalue()


def phase_svg(measured: Measured) -> str:
    """SVG of which estimator is the quickest that is right in 95 % of the problems, over outlier rate and number of
    matches, and of where the right answer cannot be known: where chance gives sets as large as the right one."""
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "spherloc", "font.size": 9}):
        figure = Figure(figsize=(WIDTH_INCHES, HEIGHT_INCHES), layout="constrained")
        FigureCanvasSVG(figure)
        for axes, (gravity_deg, counts) in zip(figure.subplots(1, 2), PHASE_GRAVITY_DEG.items(), strict=True):
            _phases(axes, measured, gravity_deg, counts)
        handles = [Patch(facecolor=color, edgecolor="0.4", label=name) for name, color in PHASE_COLORS.items()]
        figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize=8.5, frameon=False)
        file = io.StringIO()
        figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    return file.getvalue()


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
