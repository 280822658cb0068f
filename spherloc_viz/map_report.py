"""The report of a map as one HTML file: what is in it, from above, and why the other images are not."""

import base64
import html
import io

import cv2
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from spherloc.errors import InputError
from spherloc.frontend.view import View
from spherloc.geometry import camera_centre
from spherloc.mapping.make import Map
from spherloc.mapping.pairs import MIN_MATCHES
from spherloc.mapping.photographs import Photographs
from spherloc.types import FloatArray

THUMBNAIL_PX = 240
MAX_THUMBNAILS = 40
MAX_POINTS = 20_000
WITHIN = 0.98
"""Share of the points that the picture shows: a few far ones would make the rest small."""

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; color: #1b1f24; }
table { border-collapse: collapse; } td, th { padding: .2rem .8rem .2rem 0; text-align: left; vertical-align: top; }
td.number { text-align: right; } img { max-width: 100%; } .out { color: #a11; }
"""


def map_report(made: Map, found: Photographs) -> str:
    """A page without any other file."""
    written, views = made.written, found.views
    names = [view.name for view in views]
    scale = made.scale.source or "unknown: one unit is the usual distance between two neighbouring images"
    if made.scale.why_unknown:
        scale += f" ({made.scale.why_unknown.rstrip('.')})"
    facts = {
        "Images in the map": f"{len(written.poses)} of {len(views)}",
        "Points": f"{len(written.points):,}",
        "Mean reprojection error": f"{written.error_px:.2f} px",
        "Down": f"from {made.level.source}; single images differ from it by {made.level.spread_deg:.1f}° in the median",
        "Scale": scale,
    }
    rows = [_row(made, names, index) for index in range(len(views))]
    left = [view for view in views if view.name not in written.poses]
    unit = "metres" if made.scale.source else "units"
    return "\n".join(
        [
            '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>Map</title>',
            f"<style>{STYLE}</style></head><body><h1>Map of {len(written.poses)} images</h1>",
            "<table>",
            *(f"<tr><th>{key}</th><td>{html.escape(value)}</td></tr>" for key, value in facts.items()),
            "</table>",
            *(f'<p class="out">{html.escape(remark)}</p>' for remark in found.remarks),
            *_doubts(made),
            "<h2>From above</h2>",
            f'<img alt="Points and cameras of the map from above" src="{_from_above(made, unit)}">',
            "<h2>Not in the map</h2>" if left else "",
            *(_thumbnail(view, made, names) for view in left[:MAX_THUMBNAILS]),
            "<h2>Images</h2><table><tr><th>image</th><th>in the map</th><th>best partner</th><th>matches</th></tr>",
            *rows,
            "</table></body></html>",
        ]
    )


def _doubts(made: Map) -> list[str]:
    against = made.made.contradictions
    if not against:
        return []
    pairs = "; ".join(f"{first} and {second}" for first, second in against[:10])
    return [
        '<p class="out">These images lie side by side in the map, in sight of each other, and hardly match. The map '
        "may take two places that look alike for one: "
        f"{html.escape(pairs)}{' …' if len(against) > 10 else ''}</p>"
    ]


def _row(made: Map, names: list[str], index: int) -> str:
    counts = made.made.matches[index]
    best = int(counts.argmax())
    inside = names[index] in made.written.poses
    partner = names[best] if counts[best] else "none"
    return (
        f"<tr><td>{html.escape(names[index])}</td><td{'' if inside else ' class=out'}>{'yes' if inside else 'no'}</td>"
        f'<td>{html.escape(partner)}</td><td class="number">{counts[best]:,}</td></tr>'
    )


def why_not(made: Map, names: list[str], index: int) -> str:
    """Why an image is not in the map, in a sentence."""
    counts = made.made.matches[index]
    inside = np.array([name in made.written.poses for name in names])
    group = next((group for group in made.groups if names[index] in group.written.poses), None)
    if group is not None:
        return (
            f"It is one of {len(group.written.poses)} images that fit together, but not with the map: take some in "
            f"between. They are a map of their own, {group.written.scene.parent.name}."
        )
    if names[index] in made.level.leaning:
        return (
            f"COLMAP placed it so that it leans {made.level.leaning[names[index]]:.1f}° against the map, at a place "
            "that looks like the right one: take more images around it."
        )
    if counts.max() < MIN_MATCHES:
        return f"No other image has {MIN_MATCHES} matches with it that fit together: take images closer to it."
    best = int(np.where(inside, counts, -1).argmax())
    return (
        f"It has {counts[best]} matches with {names[best]}, too few of which have a point in the map: take "
        "one more image near it."
    )


def _thumbnail(view: View, made: Map, names: list[str]) -> str:
    reason = html.escape(f"{view.name}: {why_not(made, names, names.index(view.name))}")
    try:
        pixels = view.read()
    except InputError:
        return f"<p>{reason}</p>"
    scale = THUMBNAIL_PX / pixels.shape[1]
    _, content = cv2.imencode(".jpg", cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))
    return f'<p><img alt="" src="{_data("jpeg", content.tobytes())}"><br>{reason}</p>'


def _from_above(made: Map, unit: str) -> str:
    """Address of a PNG."""
    points = made.written.points
    centres = np.stack([camera_centre(pose) for pose in made.written.poses.values()])
    figure = Figure(figsize=(9, 6.5), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot(aspect="equal")
    shown = points[_near(points, centres)]
    shown = shown[:: max(1, len(shown) // MAX_POINTS)]
    axes.scatter(shown[:, 0], shown[:, 1], s=1.5, c="#8fa3b8", linewidths=0)
    axes.plot(centres[:, 0], centres[:, 1], color="#d08a1c", linewidth=0.8)
    axes.scatter(centres[:, 0], centres[:, 1], s=28, c="#c0392b", zorder=3)
    axes.set_xlabel(unit)
    axes.set_ylabel(unit)
    file = io.BytesIO()
    figure.savefig(file, format="png", metadata={"Software": None})
    return _data("png", file.getvalue())


def _near(points: FloatArray, centres: FloatArray) -> np.ndarray:
    away = np.linalg.norm(points - np.median(centres, axis=0), axis=1)
    return away <= np.quantile(away, WITHIN) if len(points) else np.zeros(0, bool)


def _data(kind: str, content: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode('ascii')}"
