"""What there is to say of a map: a summary in lines, and a report as a page that needs no other files."""

import base64
import html
from collections.abc import Mapping

import cv2
import numpy as np

from spherloc.errors import InputError
from spherloc.frontend import trained
from spherloc.frontend.masks import Masks
from spherloc.frontend.view import View
from spherloc.geometry import camera_centre
from spherloc.mapping.advice import advice
from spherloc.mapping.alignment.line_gravity import LEANING_DEG, share_below
from spherloc.mapping.images.photographs import Photographs, cameras_of
from spherloc.mapping.make import Map
from spherloc.mapping.rig import shots_of, words
from spherloc.mapping.two_view.pairs import MIN_MATCHES
from spherloc.types import FloatArray
from spherloc_viz.plots.map_above import map_above

MAP_FEATURES = {
    "sift": "SIFT",
    "aliked": "ALIKED, matched by LightGlue",
    "sift+aliked": "SIFT, and ALIKED matched by LightGlue",
}
"""Kinds of features and what they are called."""
UP = np.array([0.0, 0.0, 1.0])
"""In every map that is written."""
MOST_ABOVE = 0.65
"""If more of the points are above the cameras, stated gravity may point up."""
USUAL_M = (0.05, 200.0)
"""Metres from images to the points that they see, in the median, between which the scale of a map is believed: from a
camera on a table to one in the air. Millimetres and mostly centimetres that were given for metres are beyond."""
_UNSURE = "hardly more matches fit the poses of two images than other poses; images closer to each other are surer"


def summary(made: Map, found: Photographs) -> list[str]:
    """The result in lines of text."""
    written = made.written
    placed = {name for one in (made, *made.groups) for name in one.written.poses}
    missing = [view.name for view in found.views if view.name not in placed]
    lines = [
        f"in the map    {len(written.poses)} of {len(found.views)} images, {len(written.points):,} points, "
        f"{written.error_px:.2f} px mean error",
        *(f"joined        {said}" for said in _joined_words(made, found)),
        f"down          {_down(made)}",
        *_about_lines(made),
        *([f"lens          {_corrected_words(made)}"] if made.corrected_rad else []),
        f"features      {about_features(made)}",
        f"scale         {made.scale.source or _units_unknown(made)}",
    ]
    if said := _scale_words(made):
        lines.append(f"in doubt      {said}")
    if made.lines.unsure:
        lines.append(
            "in doubt      whether down is right: by their lines, most images lean by more than "
            f"{LEANING_DEG:.0f}° or are stored sideways; {advice('sideways')}"
        )
    if made.stated and (above := 1.0 - share_below(written.poses, written.points, -UP)) > MOST_ABOVE:
        lines.append(
            f"in doubt      whether down is right: {100 * above:.0f} % of the points are above the cameras; the stated "
            "gravity must point down, with x right, y down and z forward"
        )
    lines += [f"in doubt      {doubt}" for doubt in made.doubts]
    if said := _masked_words(made):
        lines.append(f"masked        {said}")
    if missing:
        lines.append(f"left out      {', '.join(missing[:5])}{', …' if len(missing) > 5 else ''}: see the report")
    for group in made.groups:
        lines.append(
            f"on its own    {len(group.written.poses)} images that could not be joined{other_units(group, made)}: "
            f"{group.written.scene}"
        )
    if made.made.unsure:
        lines.append(f"in doubt      {_UNSURE}")
    if made.opposed:
        lines.append(f"in doubt      {_opposed_words(*made.opposed)}")
    if made.made.contradictions:
        first, second = made.made.contradictions[0]
        lines.append(
            f"in doubt      {len(made.made.contradictions)} pairs of images see each other and hardly match (such as "
            f"{first}, {second}): places that look alike may have been taken for one"
        )
    if far := made.scale.misplaced:
        lines.append(f"in doubt      {_far_words(far)}")
    return lines


def _joined_words(made: Map, found: Photographs) -> list[str]:
    """Which maps of single cameras were joined, and which parts of the map by a single pair of images."""
    poses = made.written.poses
    said = [words(poses, shots_of(found.views))] if made.made.joined else []
    said += [
        f"two parts, by {first} and {second} alone: images in between would make that surer"
        for first, second in made.made.joints
        if first in poses and second in poses
    ]
    return said


def _opposed_words(first: str, second: str) -> str:
    return (
        f"{first} and {second} took images together, but went different ways as they are mapped: if they are fixed to "
        "each other, a map is wrong"
    )


def about_features(made: Map) -> str:
    """A sentence on the features that were used, and on others that could be used."""
    if made.features != "sift":
        return MAP_FEATURES[made.features]
    more = advice("more features")
    return f"SIFT{more}" if trained.installed() or not more else f"SIFT{more}, with the extra 'learned'"


def _scale_words(made: Map) -> str:
    """Why the scale may have been given in another unit than metres; empty if nothing speaks for that."""
    depths = made.made.depths()  # the model has the scale since it was written
    usual_m = float(np.median(depths)) if len(depths) else USUAL_M[0]
    if not made.scale.source or USUAL_M[0] <= usual_m <= USUAL_M[1]:
        return ""
    usual = f"{usual_m:,.0f}" if usual_m > 1.0 else f"{usual_m:.2g}"
    return (
        f"whether the scale was given in metres: points of the map are {usual} m from the images that see them (median)"
    )


def _units_unknown(made: Map) -> str:
    why = made.scale.why_unknown
    if why and made.carried_deg:
        why += f" (what was masked around straight down may be the ground{advice('carried')})"
    return f"units unknown; {why or advice('any scale')}"


def other_units(group: Map, made: Map) -> str:
    """What the units of the map of a group are, if the scale was measured in one of the two maps alone."""
    if bool(group.scale.source) == bool(made.scale.source):
        return ""
    return f", in metres ({group.scale.source})" if group.scale.source else ", units unknown"


def _down(made: Map) -> str:
    sideways = ", which are stored sideways" if made.lines.sideways else ""
    return f"from {made.level.source}{sideways}; single images differ by {made.level.spread_deg:.1f}° (median)"


def _about_lines(made: Map) -> list[str]:
    """A line on the photographs whose lines gave no gravity; none if all did."""
    without = made.lines.why_not
    if not without:
        return []
    name, why = next(iter(without.items()))
    count = f"{len(without)} of {len(without) + len(made.lines.found)} images"
    return [f"no gravity    from the lines of {count} (see the report), such as {name}: {why}"]


def _corrected_words(made: Map) -> str:
    return (
        f"corrected by up to {np.degrees(made.corrected_rad):.1f}°, as that fits a first map better; the map was made "
        "anew with the corrected lens"
    )


def _masked_words(made: Map) -> str:
    """What was left out of the photographs; empty if nothing was."""
    masks = made.masks or Masks()
    said = [] if masks.images is None else [f"what is black in {masks.images.name}"]
    if made.carried_deg:
        said.append(_carried_words(made.carried_deg))
    elif masks.nadir_deg:
        said.append(f"{masks.nadir_deg:g}° around straight down")
    if masks.seam_deg:
        said.append(f"{masks.seam_deg:g}° on both sides of the seam of two lenses")
    return "; ".join(said)


def _carried_words(degrees: float) -> str:
    return (
        f"{degrees:g}° around straight down, where all images show the same: what carries the camera{advice('carried')}"
    )


def _far_words(far: Mapping[str, float]) -> str:
    told = ", ".join(f"{name} {off:.2f} m" for name, off in list(far.items())[:5])
    more = f" and {len(far) - 5} more" if len(far) > 5 else ""
    return f"far from the given positions: {told}{more}; the map is wrong there, or the position is"


THUMBNAIL_PX = 240
MAX_THUMBNAILS = 40
STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; color: #1b1f24; }
table { border-collapse: collapse; } td, th { padding: .2rem .8rem .2rem 0; text-align: left; vertical-align: top; }
td.number { text-align: right; } img { max-width: 100%; } .out { color: #a11; }
"""


def map_report(made: Map, found: Photographs) -> str:
    """The report as a page that needs no other files."""
    written, views = made.written, found.views
    names = [view.name for view in views]
    scale = made.scale.source or "unknown: ten units are the usual distance of a point to an image"
    if made.scale.why_unknown:
        scale += f" ({made.scale.why_unknown.rstrip('.')})"
    facts = {
        "Images in the map": f"{len(written.poses)} of {len(views)}",
        "Points": f"{len(written.points):,}",
        "Mean reprojection error": f"{written.error_px:.2f} px",
        **({"Joined": joined} if (joined := "; ".join(_joined_words(made, found))) else {}),
        "Down": _down(made),
        **({"Lens": _corrected_words(made)} if made.corrected_rad else {}),
        "Features": MAP_FEATURES[made.features],
        **({"Masked": masked} if (masked := _masked_words(made)) else {}),
        "Scale": scale,
    }
    rows = [_row(made, names, index) for index in range(len(views))]
    left = [view for view in views if view.name not in written.poses]
    unit, centres = "metres" if made.scale.source else "units", _centres(made)
    joined = len(cameras_of(views)) == 1  # those of several do not follow each other by their names
    above, without_name = map_above(written.points, centres, joined, unit)
    return "\n".join(
        [
            '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>Map</title>',
            f"<style>{STYLE}</style></head><body><h1>Map of {len(written.poses)} images</h1>",
            "<table>",
            *(f"<tr><th>{key}</th><td>{html.escape(value)}</td></tr>" for key, value in facts.items()),
            "</table>",
            *(f"<p>{html.escape(remark)}</p>" for remark in found.remarks),
            *_doubts(made),
            "<h2>From above</h2>",
            f'<img alt="Points and cameras of the map from above" src="{_data("png", above)}">',
            f"<p>Without a name for lack of room: {without_name} of {len(centres)} images. The table says where each "
            "image is.</p>"
            if without_name
            else "",
            "<h2>Not in the map</h2>" if left else "",
            *(_thumbnail(view, made, names) for view in left[:MAX_THUMBNAILS]),
            "<h2>Images</h2><table><tr><th>image</th><th>in the map</th><th>best partner</th><th>matches</th>"
            f"<th>gravity</th><th>x, y, z in {unit}</th>"
            f"{'<th>off its position</th>' if made.scale.off_m else ''}</tr>",
            *rows,
            "</table></body></html>",
        ]
    )


def _doubts(made: Map) -> list[str]:
    against, far = made.made.contradictions, made.scale.misplaced
    said = [f'<p class="out">Images {html.escape(_far_words(far))}.</p>'] if far else []
    if words := _scale_words(made):
        said.append(f'<p class="out">In doubt: {html.escape(words)}.</p>')
    said += [f'<p class="out">In doubt: {html.escape(doubt)}</p>' for doubt in made.doubts]
    if made.opposed:
        said.append(f'<p class="out">In doubt: {html.escape(_opposed_words(*made.opposed))}.</p>')
    if made.made.unsure:
        said.append(f'<p class="out">In doubt: {_UNSURE}.</p>')
    if not against:
        return said
    pairs = "; ".join(f"{first} and {second}" for first, second in against[:10])
    return [
        *said,
        '<p class="out">These images lie side by side in the map, in sight of each other, and hardly match. The map '
        "may take two places that look alike for one: "
        f"{html.escape(pairs)}{' …' if len(against) > 10 else ''}</p>",
    ]


def _row(made: Map, names: list[str], index: int) -> str:
    name, counts = names[index], made.made.matches[index]
    best = int(counts.argmax())
    inside = name in made.written.poses
    cells = [
        f"<td>{html.escape(name)}</td>",
        f"<td{'' if inside else ' class=out'}>{'yes' if inside else 'no'}</td>",
        f"<td>{html.escape(names[best] if counts[best] else 'none')}</td>",
        f'<td class="number">{counts[best]:,}</td>',
        f"<td>{html.escape(_gravity_of(made, name))}</td>",
        f"<td>{_place(made, name)}</td>",
        _off(made, name),
    ]
    return f"<tr>{''.join(cells)}</tr>"


def _centres(made: Map) -> dict[str, FloatArray]:
    """Centres (3,) of the images by name."""
    return {name: camera_centre(pose) for name, pose in made.written.poses.items()}


def _place(made: Map, name: str) -> str:
    """Where an image is in the map; empty if it is not in it."""
    pose = made.written.poses.get(name)
    return "" if pose is None else ", ".join(f"{value:.2f}" for value in camera_centre(pose))


def _gravity_of(made: Map, name: str) -> str:
    """Where gravity of an image is from, and its bound, or why its lines tell nothing."""
    if name in made.lines.why_not:
        return f"none from its lines: {made.lines.why_not[name]}"
    known = made.stated.get(name) or made.lines.found[name]
    return f"{known.source}, at most {np.degrees(known.bound_rad or 0.0):.1f}° off"


def _off(made: Map, name: str) -> str:
    """A cell with the distance of an image to the position that was given for it."""
    if not made.scale.off_m:
        return ""
    off_m = made.scale.off_m.get(name)
    return f'<td class="number">{"" if off_m is None else f"{off_m:.2f} m"}</td>'


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
    if counts[best] < MIN_MATCHES:
        other = int(counts.argmax())
        return (
            f"It has {counts[other]:,} matches with {names[other]}, which is not in the map either, and no image of "
            f"the map has {MIN_MATCHES} matches with it that fit together: take images in between."
        )
    return (
        f"It has {counts[best]:,} matches with {names[best]}, but too few matches fit a place in the map, or images "
        "next to that place do not match it: take one more image near it."
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


def _data(kind: str, content: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode('ascii')}"
