"""Pictures of localized sequences from above: the map, the positions with their directions of view, and failures."""

import textwrap
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from math import ceil

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from spherloc.datasets.map_scene import MapScene
from spherloc.errors import shorten
from spherloc.experiments.results import DOUBTFUL, FAILED, LOCALIZED, POSED, SequenceResults
from spherloc.experiments.summary import timed
from spherloc.geometry import align_to_down, camera_centre
from spherloc.types import BoolArray, FloatArray
from spherloc_viz.plots.frames import Frame, around, corners, frames_of, with_room
from spherloc_viz.plots.labels import MAX_LETTERS, PlaceName, write_labels
from spherloc_viz.plots.saving import png_of
from spherloc_viz.plots.sweeps import CURVE_MARKERS
from spherloc_viz.style import ERROR_RAMP, ESTIMATE, OUTLIER, REFERENCE, TRUTH, css, error_scale

WIDTH_INCHES, WIDE_INCHES = 9.0, 14.0
"""Width of a picture with one panel and with two."""
HEIGHT_INCHES = (4.0, 9.0)
DPI = 150
MAX_POINTS = 20_000
"""Largest number of points of the map that are drawn."""
WITHIN = 0.9
"""Share of the points that the picture shows: a few far points would make the others too small."""
MAP_GREY = "0.6"

MAX_NAMED = 12
"""Largest number of queries that are named beside their places: all of them if there are no more, else the doubtful and
wrong ones and those without a pose."""
MAX_LISTED = 4
"""Largest number of queries without a place that are named in the legend."""
MAX_HEADINGS = 60
"""About how many directions of view are drawn."""
ARROWS = 20.0
"""So many arrows of directions of view are as long as the picture is wide."""
BESIDE = 2.0
"""Images of the map this near to the middle of the queries, in halves of their extent, are framed with them."""
FEWEST_FRAMED = 3
"""Number of believed poses from which on the picture is framed by them, and not by doubtful ones too."""


@dataclass(frozen=True, eq=False)
class Backdrop:
    """What is drawn of the map below the positions."""

    points: FloatArray
    """(P, 3), map frame, metres; none if the map has no points."""
    images: FloatArray
    """(R, 3) positions of the map's images, map frame, metres."""
    names: tuple[str, ...] = ()
    """(R,) their names; none if they are not known."""


def backdrop_of(scene: MapScene) -> Backdrop:
    """The points and images of a scene's map."""
    taken = {view.name: camera_centre(view.cam_from_map) for view in scene.references if view.cam_from_map is not None}
    images = np.reshape(list(taken.values()), (-1, 3))
    points = np.zeros((0, 3)) if scene.cloud is None else np.asarray(scene.cloud, dtype=np.float64)
    if len(points) and len(images):
        away = np.linalg.norm(points - np.median(images, axis=0), axis=1)
        points = points[away <= np.quantile(away, WITHIN)]
    return Backdrop(points[:: ceil(max(1, len(points)) / MAX_POINTS)], images, tuple(taken))


@contextmanager
def _without_glyph_warnings() -> Iterator[None]:
    """No warnings of names in scripts that the font lacks."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing")
        yield


@_without_glyph_warnings()
def trajectory_png(results: SequenceResults, backdrop: Backdrop) -> bytes:
    """PNG of the estimated positions over the map, coloured by their error, with the true path and failures as crosses.

    Errors beyond the loosest limit of success have one colour. Where the truth is unknown, errors are those of the
    registration, if there are any. Doubtful poses are circles. Few queries are named, of many those that failed. If
    the queries lie in a small part of the map, a second panel shows them alone. The same results give the same bytes.
    """
    places = _from_above(results, results.positions_m)
    true_places = _from_above(results, results.true_positions_m)
    believed = np.where(_are_doubtful(results)[:, None], np.nan, places)
    framed = believed if np.isfinite(believed).all(axis=1).sum() >= FEWEST_FRAMED else places
    images = _from_above(results, backdrop.images)
    own = _with_near(_true_if_known(framed, true_places), images)
    figure, panels = _panels(results, _frames(results, own, backdrop), 1.6)
    for axes in panels:
        _map(axes, results, backdrop)
    if len(panels) > 1:
        _overview(panels[0], panels[1], places, true_places)
    axes = panels[-1]
    _truth(axes, true_places, timed(results.rows))
    arrows = _directions(axes, results, places)
    _estimates(figure, axes, results, places, true_places)
    _without_place(axes, results, places, true_places)
    _title(figure, f"{results.configuration.name}: {_about(results)}")
    _legend(figure, axes)
    free = np.concatenate([places[np.isfinite(places).all(axis=1)], arrows])
    named = _named(axes, results, places, true_places)
    write_labels(axes, [*named, *_named_images(axes, backdrop.names, images)], free)
    return png_of(figure)


def _with_near(places: FloatArray, images: FloatArray) -> Frame:
    """The frame of the queries' places (N, 2), with those of the map's images (R, 2) that are beside it."""
    middle, half = around(places)
    near = (np.abs(images - middle) <= BESIDE * half.max()).all(axis=1)
    return around(np.concatenate([places, images[near]]))


def _named_images(axes: Axes, names: Sequence[str], images: FloatArray) -> list[PlaceName]:
    """The names of the map's images in the picture, if they are few."""
    drawn = np.flatnonzero(_inside(axes, images)).tolist() if names else []
    few = drawn if len(drawn) <= MAX_NAMED else []
    return [PlaceName((names[k],), images[k], css(REFERENCE)) for k in few]


def _frames(results: SequenceResults, own: Frame, backdrop: Backdrop) -> list[Frame]:
    """The frame that holds the map and the queries, whose frame is ``own``, and ``own`` too if it is far smaller.

    Of a map of images they are framed, and points far from them are cut.
    """
    points, images = _from_above(results, backdrop.points), _from_above(results, backdrop.images)
    if not len(points) and not len(images):
        return [own]
    if not len(images):
        return frames_of(around(np.concatenate([points, corners(own)])), own)
    return frames_of(with_room(np.concatenate([images, corners(own)]), points), own)


def _panels(results: SequenceResults, frames: Sequence[Frame], more_inches: float) -> tuple[Figure, list[Axes]]:
    """An empty picture with a panel a frame; its height follows from the frames and ``more_inches`` for the rest."""
    width = WIDE_INCHES if len(frames) > 1 else WIDTH_INCHES
    tall = max(half[1] / half[0] for _, half in frames)
    height = float(np.clip(0.75 * width / len(frames) * tall + more_inches, *HEIGHT_INCHES))
    figure = Figure(figsize=(width, height), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    panels = [figure.add_subplot(1, len(frames), k + 1, aspect="equal", axisbelow=True) for k in range(len(frames))]
    across, up = _axis_names(results)
    for axes, (middle, half) in zip(panels, frames, strict=True):
        axes.grid(color="0.9", linewidth=0.6)
        axes.set_xlim(middle[0] - half[0], middle[0] + half[0])
        axes.set_ylim(middle[1] - half[1], middle[1] + half[1])
        axes.set_xlabel(across)
        axes.set_ylabel(up)
    return figure, panels


def _axis_names(results: SequenceResults) -> tuple[str, str]:
    """Names of the axes to the right and up: those of the map's frame, if they are parallel to them."""
    unit = _unit(results)
    names = []
    for row in align_to_down(results.configuration.gravity_map)[[0, 2]]:
        axis = int(np.abs(row).argmax())
        along = f"{'−' if row[axis] < 0.0 else ''}{'xyz'[axis]} of the map"
        names.append(f"{along}, {unit}" if abs(row[axis]) > 1.0 - 1e-6 else f"{unit}, in the map")
    return names[0], names[1]


def _unit(results: SequenceResults) -> str:
    return "metres" if results.configuration.metric else "units (scale unknown)"


def _title(figure: Figure, words: str) -> None:
    letters = int(11 * figure.get_figwidth())
    figure.suptitle(textwrap.fill(words, letters), parse_math=False, fontsize=11)


def _legend(figure: Figure, axes: Axes) -> None:
    handles, names = axes.get_legend_handles_labels()
    if names:
        columns = 2 if figure.get_figwidth() < WIDE_INCHES else 3
        legend = figure.legend(handles, names, loc="outside lower center", ncols=columns, fontsize=9, frameon=False)
        for text in legend.get_texts():
            text.set_parse_math(False)  # names of queries may have dollar signs


def _map(axes: Axes, results: SequenceResults, backdrop: Backdrop) -> None:
    points, images = (_from_above(results, places) for places in (backdrop.points, backdrop.images))
    if len(points):
        axes.plot(*points.T, ".", color=MAP_GREY, markersize=1.8, markeredgewidth=0.0, zorder=0.5)
        axes.plot([], [], ".", color=MAP_GREY, markersize=4.0, label="points of the map")
    if len(images):
        style = {"color": css(REFERENCE), "markersize": 5.0, "zorder": 0.6}
        axes.plot(*images.T, "+", label=f"images of the map: {len(images)}", **style)


def _overview(axes: Axes, detail: Axes, places: FloatArray, true_places: FloatArray) -> None:
    """Mark in the panel of the whole map where the other panel is, and the positions."""
    axes.set_title("in the map", fontsize=10)
    detail.set_title("the queries: the frame on the left", fontsize=10)
    (left, right), (bottom, top) = detail.get_xlim(), detail.get_ylim()
    axes.add_patch(Rectangle((left, bottom), right - left, top - bottom, fill=False, linewidth=1.0, color="0.2"))
    axes.plot(*true_places.T, ".", color=css(TRUTH), markersize=3.0)
    axes.plot(*places.T, ".", color=css(ESTIMATE), markersize=4.0)


def _directions(axes: Axes, results: SequenceResults, places: FloatArray) -> FloatArray:
    """Draw the directions of view of the poses, of many only every n-th; returns places (A, 2) on the arrows."""
    posed = np.flatnonzero(np.isfinite(places).all(axis=1) & _inside(axes, places))
    drawn = posed[:: ceil(max(1, len(posed)) / MAX_HEADINGS)]
    if not len(drawn):
        return np.zeros((0, 2))
    ahead = _headings(results)[drawn]
    axes.quiver(
        *places[drawn].T, *ahead.T, color="0.25", scale=ARROWS, width=0.0025, headwidth=5.0, headlength=6.0,
        headaxislength=5.0, zorder=2.5,
    )  # fmt: skip
    axes.plot([], [], color="0.25", marker=r"$\rightarrow$", markersize=11, linestyle="none", label="direction of view")
    left, right = axes.get_xlim()
    return np.concatenate([places[drawn] + share * (right - left) / ARROWS * ahead for share in (0.5, 1.0)])


def _named(axes: Axes, results: SequenceResults, places: FloatArray, true_places: FloatArray) -> list[PlaceName]:
    """The queries that are named in the picture; failures first, as the places beside their marks are free then."""
    errors_m, _, limit_m = _errors(results)
    lost = ~np.array([status in POSED for status in results.status], dtype=bool)
    wrong = lost | _are_doubtful(results) | (errors_m > limit_m)
    at = np.where(np.isfinite(places) & _inside(axes, places)[:, None], places, true_places)
    drawn = np.isfinite(at).all(axis=1) & _inside(axes, at)
    chosen = list(np.flatnonzero(drawn & wrong))
    if np.count_nonzero(drawn) <= MAX_NAMED:
        chosen += list(np.flatnonzero(drawn & ~wrong))
    colors = {True: css(OUTLIER), False: "black"}
    return [PlaceName((results.rows[k].query,), at[k], colors[bool(wrong[k])]) for k in chosen[:MAX_NAMED]]


SEVERAL_COLORS = ("#1b6ca8", "#c77d0a", "#7b2d8b", "#3a8a3a", "#b02a30", "#5fb3e6", "#8c6d31", "#555555")
ANY_COLOR = "0.25"
"""In the legend, the colour of what is drawn in each estimator's."""
DASHES = (0, (4, 3))
LARGEST_MARKER = 10.0
MAX_LOST_NAMED = 6
"""Largest number of failures of an estimator whose names are written into the picture."""


@_without_glyph_warnings()
def trajectories_png(several: Sequence[tuple[str, SequenceResults]], backdrop: Backdrop) -> bytes:
    """PNG of one sequence as several estimators localized it: positions and directions of view by colour over the map.

    ``several`` are labels with results of the same scene, not all of which need have every query. A query whose pose is
    outside the picture or missing is a cross at its true position, named if there are few; a wrong position is joined
    to the true one. Positions are joined only where the queries follow each other in time. The same results give the
    same bytes.
    """
    first = max((results for _, results in several), key=lambda results: len(results.rows))
    true_places = _from_above(first, first.true_positions_m)
    places = [_from_above(results, results.positions_m) for _, results in several]
    everywhere = np.concatenate(places)
    below = 0.25 * ((len(several) + 6) // 2)
    framed = np.concatenate(
        [
            _true_if_known(seen, _from_above(results, results.true_positions_m))
            for (_, results), seen in zip(several, places, strict=True)
        ]
    )
    figure, panels = _panels(first, _frames(first, around(framed), backdrop), 1.3 + below)
    for axes in panels:
        _map(axes, first, backdrop)
    if len(panels) > 1:
        _overview(panels[0], panels[1], everywhere, true_places)
    axes = panels[-1]
    _truth(axes, true_places, timed(first.rows))
    labels: list[PlaceName] = []
    for number, ((label, results), seen) in enumerate(zip(several, places, strict=True)):
        style = _Style(
            SEVERAL_COLORS[number % len(SEVERAL_COLORS)],
            CURVE_MARKERS[number % len(CURVE_MARKERS)],
            LARGEST_MARKER - (LARGEST_MARKER - 3.0) * number / max(1, len(several) - 1),
        )
        labels += _one_of_several(axes, label, results, seen, style)
    _legend_of_failures(axes, [results for _, results in several], places)
    _title(figure, first.configuration.name)
    _legend(figure, axes)
    write_labels(axes, labels, everywhere[np.isfinite(everywhere).all(axis=1)])
    return png_of(figure)


@dataclass(frozen=True)
class _Style:
    """How an estimator's positions are drawn: sizes differ, so that several at one place can all be seen."""

    color: str
    marker: str
    size: float
    """Size of its markers, points."""


def _one_of_several(
    axes: Axes, label: str, results: SequenceResults, seen: FloatArray, style: _Style
) -> list[PlaceName]:
    """Draw one estimator's positions ``seen`` from above (Q, 2), its directions of view and failures; returns the names
    of the failures if these are few."""
    true_places = _from_above(results, results.true_positions_m)
    errors_m, _, limit_m = _errors(results)
    inside = np.isfinite(seen).all(axis=1) & _inside(axes, seen)
    with_truth = np.isfinite(true_places).all(axis=1)
    if np.isfinite(errors_m).any():
        limit = f"{limit_m:g} {results.configuration.unit}"
        words = f"{label}: {np.count_nonzero(errors_m <= limit_m)} of {len(seen)} within {limit}"
    else:  # there is no truth
        words = f"{label}: {results.status.count(LOCALIZED)} of {len(seen)} localized"
    line, color = "-" if timed(results.rows) else "none", style.color
    axes.plot(
        *seen[inside].T, color=color, linestyle=line, linewidth=0.9, marker=style.marker, markersize=style.size,
        fillstyle="none", label=words,
    )  # fmt: skip
    ahead = _headings(results)[inside]
    axes.quiver(
        *seen[inside].T,
        *ahead.T,
        color=color,
        scale=38.0,
        width=0.002,
        headwidth=1.0,
        headlength=0.0,
        headaxislength=0.0,
    )
    wrong = _wrong(results, inside, true_places)
    for start, end in zip(true_places[wrong], seen[wrong], strict=True):
        axes.plot(*np.stack([start, end]).T, color=color, linewidth=0.7, linestyle=DASHES)
    lost = ~inside & with_truth
    if lost.any():
        axes.plot(*true_places[lost].T, "x", color=color, markersize=8.0, markeredgewidth=1.4)
    if np.count_nonzero(lost) > MAX_LOST_NAMED:
        return []
    return [PlaceName((results.rows[place].query,), true_places[place], color) for place in np.flatnonzero(lost)]


def _wrong(results: SequenceResults, inside: BoolArray, true_places: FloatArray) -> BoolArray:
    """(Q,) which of the positions ``inside`` the picture are too far from the true ones."""
    errors_m, _, limit_m = _errors(results)
    return inside & np.isfinite(true_places).all(axis=1) & (errors_m > limit_m)


def _legend_of_failures(axes: Axes, several: Sequence[SequenceResults], places: Sequence[FloatArray]) -> None:
    """Put into the legend what dashed lines and crosses are, whatever their colour, if there are some.

    ``places`` are the positions (Q, 2) of each estimator's results, seen from above.
    """
    wrong = lost = 0
    for results, seen in zip(several, places, strict=True):
        true_places = _from_above(results, results.true_positions_m)
        inside = np.isfinite(seen).all(axis=1) & _inside(axes, seen)
        wrong += np.count_nonzero(_wrong(results, inside, true_places))
        lost += np.count_nonzero(~inside & np.isfinite(true_places).all(axis=1))
    if wrong:
        limit = f"{_errors(several[0])[2]:g} {several[0].configuration.unit}"
        words = f"error beyond {limit}, to the true position"
        axes.plot([], [], color=ANY_COLOR, linewidth=0.9, linestyle=DASHES, label=words)
    if lost:
        words = "without a pose, or with one outside the picture"
        axes.plot([], [], "x", color=ANY_COLOR, markersize=8.0, markeredgewidth=1.4, label=words)


def _headings(results: SequenceResults) -> FloatArray:
    """Directions (Q, 2) of the optical axes, seen from above; zero without a pose."""
    ahead = np.zeros((len(results.rows), 3))
    for place, row in enumerate(results.rows):
        if row.cam_from_map is not None:
            ahead[place] = row.cam_from_map[2, :3]
    return _from_above(results, ahead)


def _from_above(results: SequenceResults, positions_m: FloatArray) -> FloatArray:
    """Positions (Q, 2) on the page, right and up: seen from above, in the direction of gravity, not mirrored."""
    turned = positions_m @ align_to_down(results.configuration.gravity_map).T
    return turned[:, [0, 2]]


def _true_if_known(places: FloatArray, true_places: FloatArray) -> FloatArray:
    """Where queries (Q, 2) are expected in the picture: one wrong pose far away must not shrink all others to a dot."""
    return np.where(np.isfinite(true_places), true_places, places)


def _truth(axes: Axes, true_places: FloatArray, ordered: bool) -> None:
    """Draw the true positions, joined where they follow each other in time."""
    if np.isfinite(true_places).any():
        line, size = ("-", 3.0) if ordered else ("none", 6.0)
        axes.plot(
            *true_places.T, color=css(TRUTH), linestyle=line, linewidth=1.4, marker=".", markersize=size, label="truth",
            zorder=2,
        )  # fmt: skip


def _estimates(
    figure: Figure, axes: Axes, results: SequenceResults, places: FloatArray, true_places: FloatArray
) -> None:
    errors_m, what, limit_m = _errors(results)
    plain = np.isfinite(places).all(axis=1) & np.isnan(errors_m)
    doubtful = plain & _are_doubtful(results)
    looks = ((plain & ~doubtful, ESTIMATE, "full", "localized"), (doubtful, OUTLIER, "none", "doubtful"))
    for mask, color, fill, name in looks:
        if mask.any():
            label = f"{name}, error unknown: {np.count_nonzero(mask)}"
            axes.plot(*places[mask].T, "o", color=css(color), fillstyle=fill, markersize=6, label=label, zorder=3)
    coloured = np.isfinite(places).all(axis=1) & ~np.isnan(errors_m)
    if not coloured.any():
        return
    good, bad = coloured & (errors_m <= limit_m), coloured & ~(errors_m <= limit_m)
    if (doubted := coloured & _are_doubtful(results)).any():
        style = {"color": css(OUTLIER), "fillstyle": "none", "markersize": 10, "markeredgewidth": 1.4, "zorder": 3.5}
        axes.plot(*places[doubted].T, "o", label=f"doubtful: {np.count_nonzero(doubted)}", **style)
    ramp = LinearSegmentedColormap.from_list("errors", [css(color) for color in ERROR_RAMP])
    dots = axes.scatter(
        *places[good].T, c=errors_m[good], vmin=0.0, vmax=error_scale(errors_m[coloured], limit_m), s=30,
        cmap=ramp, edgecolors="0.2", linewidths=0.4, label="estimate" if good.any() else None, zorder=3,
    )  # fmt: skip
    figure.colorbar(dots, ax=axes, shrink=0.75).set_label(f"{what}, {_unit(results)}")
    if bad.any():
        unit = results.configuration.unit
        label = f"{np.count_nonzero(bad)} beyond {limit_m:g} {unit}, up to {errors_m[bad].max():.3g} {unit}"
        axes.plot(*places[bad].T, "o", color=css(OUTLIER), markersize=5.5, label=label, zorder=3)
        for start, end in zip(true_places[bad], places[bad], strict=True):
            axes.plot(*np.stack([start, end]).T, color=css(OUTLIER), linewidth=0.8, zorder=1)


def _are_doubtful(results: SequenceResults) -> BoolArray:
    """(Q,) whether a query's pose is not believed."""
    return np.array([status == DOUBTFUL for status in results.status], dtype=bool)


def _errors(results: SequenceResults) -> tuple[FloatArray, str, float]:
    """(Q,) errors in metres, what they are, and the loosest limit of success."""
    setting = results.configuration
    limits_m = setting.registration_thresholds_m
    if limits_m and not np.isfinite(results.translation_errors_m).any():
        return results.registration_errors_m, "registration error", max(limits_m)
    return results.translation_errors_m, "position error", max(metres for _, metres in setting.thresholds)


def _without_place(axes: Axes, results: SequenceResults, places: FloatArray, true_places: FloatArray) -> None:
    """Mark the true positions of queries without a pose, or with one outside the picture; others are only listed."""
    failed = np.array([status == FAILED for status in results.status], dtype=bool)
    outside = np.isfinite(places).all(axis=1) & ~_inside(axes, places)
    known = np.isfinite(true_places).all(axis=1)
    marks = ((failed, "x", "without a pose"), (outside, "s", "with a pose outside the picture"))
    for mask, marker, what in marks:
        style = {"markersize": 7, "markeredgewidth": 1.8, "fillstyle": "none", "color": css(OUTLIER), "zorder": 4}
        if (mask & known).any():
            label = f"{what}: {np.count_nonzero(mask & known)}"
            axes.plot(*true_places[mask & known].T, marker, label=label, **style)
        if (mask & ~known).any():
            axes.plot([], [], " ", label=f"{what}, place unknown: {_listed(results, mask & ~known)}")


def _listed(results: SequenceResults, mask: BoolArray) -> str:
    names = [row.query for row, chosen in zip(results.rows, mask, strict=True) if chosen]
    more = f" and {len(names) - MAX_LISTED} more" if len(names) > MAX_LISTED else ""
    return ", ".join(shorten(name, MAX_LETTERS) for name in names[:MAX_LISTED]) + more


def _inside(axes: Axes, places: FloatArray) -> BoolArray:
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    return (places[:, 0] >= left) & (places[:, 0] <= right) & (places[:, 1] >= bottom) & (places[:, 1] <= top)


def _about(results: SequenceResults) -> str:
    setting = results.configuration
    return f"{setting.estimator}, seed {setting.seed}, {len(results.rows)} of {setting.queries} queries"
