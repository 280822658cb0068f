"""The card about the selected matches: whether the run kept them and why, and how they can be changed."""

import math
from collections.abc import Callable
from html import escape
from pathlib import Path

import cv2
import numpy as np
import viser
from numpy.typing import NDArray

from spherloc.diagnosis.words import px_text
from spherloc.problem import Problem
from spherloc.trace import Trace
from spherloc.types import FloatArray
from spherloc_viz import style
from spherloc_viz.app.matches.image_panel import jpeg_uri
from spherloc_viz.app.paging import chip
from spherloc_viz.app.text import DIM, box, table_html
from spherloc_viz.app.web.viser_internals import update_widget
from spherloc_viz.layers.explanation import Explanation, Pairs, explain
from spherloc_viz.layers.primitives import Table, true_minus
from spherloc_viz.layers.query_image import photograph
from spherloc_viz.layers.selection import Traits, explain_many

SIDE_PX, CROP_WIDTH_PX, CROP_HEIGHT_PX = 48, 156, 104
"""Pixels of the photograph that a crop shows vertically, and width and height of the crop's picture."""


def crops_html(problem: Problem, number: int) -> str:
    """Crops around the pixels of a match in the query and in its reference, side by side; empty without images."""
    crops = [_crop_html(problem.image, problem.pixels[number], "query")]
    if problem.reference_index is not None and problem.reference_pixels is not None and problem.reference_images:
        path = problem.reference_images[int(problem.reference_index[number])]
        crops.append(_crop_html(path, problem.reference_pixels[number], "reference"))
    if not any(crops):
        return ""
    return f'<div style="display:flex;gap:.6em;padding-top:.5em">{"".join(crops)}</div>'


def _crop_html(path: Path | None, pixel: FloatArray, name: str) -> str:
    photo = photograph(path)
    if photo is None or not np.isfinite(pixel).all():
        return ""
    middle = photo.scale * pixel
    side = max(8, round(photo.scale * SIDE_PX))
    # The middle of the picture is the pixel itself, to a fraction of a pixel; beyond the border it is grey.
    zoom = CROP_WIDTH_PX / side
    shift = np.array([CROP_WIDTH_PX, CROP_HEIGHT_PX]) / 2.0 - zoom * middle + 0.5 * zoom - 0.5
    warp = np.array([[zoom, 0.0, shift[0]], [0.0, zoom, shift[1]]])
    crop = cv2.warpAffine(
        np.asarray(photo.image), warp, (CROP_WIDTH_PX, CROP_HEIGHT_PX), flags=cv2.INTER_LINEAR, borderValue=(96, 96, 96)
    )
    x, y, arm, gap = CROP_WIDTH_PX // 2, CROP_HEIGHT_PX // 2, 26, 10
    cross = (
        f'<svg viewBox="0 0 {CROP_WIDTH_PX} {CROP_HEIGHT_PX}" style="position:absolute;inset:0;width:100%;height:100%">'
        f'<path d="M{x - gap} {y}h{-arm}M{x + gap} {y}h{arm}M{x} {y - gap}v{-arm}M{x} {y + gap}v{arm}" '
        f'stroke="{style.css(style.SELECTED)}" stroke-width="2" fill="none"/></svg>'
    )
    return (
        '<div style="flex:1;min-width:0;max-width:50%"><div style="position:relative;aspect-ratio:3/2">'
        f'<img alt="{name} around the match" src="{jpeg_uri(np.asarray(crop, np.uint8))}" '
        f'style="width:100%;height:100%;border-radius:3px;display:block">{cross}</div>'
        f'<div style="font-size:12px;opacity:.65">{name}</div></div>'
    )


WIDTH_PX, HEIGHT_PX = 310.0, 290.0
"""Width of the card, and about its height while it is folded, for text of the usual size."""
LEAST_PX = 200.0
"""Least width of the card, where the canvas is narrower."""
MARGIN_PX = 8.0
EDGES_PX = 8.0
"""Of the panels beside the canvas, which are so much wider than they are told to be, both together."""


def _size_px(text_scale: float, canvas_px: float) -> tuple[float, float]:
    """Width and about the height of the card: not over the panels beside the canvas, where that is wide enough."""
    full_px, room_px = WIDTH_PX * text_scale, canvas_px - EDGES_PX - 2.0 * MARGIN_PX
    width_px = min(full_px, max(LEAST_PX * text_scale, room_px))
    return width_px, HEIGHT_PX * text_scale * full_px / width_px


class MatchCard:
    """A floating panel that is shown while matches are selected. Its buttons are touches that the session handles.

    It lies over the canvas, so the longer parts are folded until the user opens them.
    """

    def __init__(
        self, gui: viser.GuiApi, editable: bool = True, text_scale: float = 1.0, canvas_px: float = math.inf
    ) -> None:
        """``editable`` says whether the page may change matches; ``text_scale`` is the factor of the text size, and
        ``canvas_px`` the width of the page between its panels."""
        self._editable = editable
        self._width_px, self._height_px = _size_px(text_scale, canvas_px)
        self._panel = gui.add_panel(visible=False)
        with self._panel.add_tab("Selection"):
            self._html = gui.add_html("")
            self._more = gui.add_folder("Numbers and pairs", expand_by_default=False)
            with self._more:
                self._details = gui.add_html("")
        self._drawn: tuple | None = None
        self._right = False
        self._place()

    def fit(self, text_scale: float, canvas_px: float) -> None:
        """Be as wide as text of another size needs it, if there is room for that between the panels."""
        size_px = _size_px(text_scale, canvas_px)
        if size_px != (self._width_px, self._height_px):
            self._width_px, self._height_px = size_px
            self._place()

    def _place(self) -> None:
        self._panel.float(x=-MARGIN_PX if self._right else MARGIN_PX, y=MARGIN_PX, width=self._width_px)

    def draw(
        self,
        trace: Trace,
        selected: tuple[int, ...],
        kept: NDArray,
        alternative_cam_from_map: FloatArray | None = None,
        right: Callable[[float, float], bool] = lambda width_px, height_px: False,
        hidden: bool = False,
    ) -> None:
        """Show the selected matches, indices in the problem; ``kept`` (N,) are their original numbers. ``right`` is
        asked, when the card opens or its matches change, whether one of that width and height, px, belongs on the right
        of the canvas.

        ``alternative_cam_from_map`` (3, 4) is another pose from a diagnosis, with which a match is compared. ``hidden``
        leaves out whether the run kept the matches.
        """
        if self._panel.visible != bool(selected):
            self._panel.visible = bool(selected)
            if not selected:
                self._drawn = None
                update_widget(self._html, content="")
        drawn = (
            trace,
            selected,
            kept.tobytes(),
            None if alternative_cam_from_map is None else alternative_cam_from_map.tobytes(),
            hidden,
        )
        if not selected or (self._drawn is not None and self._drawn[0] is trace and self._drawn[1:] == drawn[1:]):
            return
        belongs_right = right(self._width_px, self._height_px)
        if belongs_right != self._right:
            self._right = belongs_right
            self._place()
        self._drawn = drawn
        if hidden:
            html, details = untold_html(trace, selected, kept, self._editable), ""
        elif len(selected) == 1:
            what = explain(trace, selected[0], alternative_cam_from_map)
            html, details = one_html(trace, what, kept, self._editable), details_html(what, kept)
        else:
            numbers, traits = kept[list(selected)], explain_many(trace, np.array(selected))
            html, details = many_html(trace, traits, numbers, self._editable), ""
        if self._more.visible != bool(details):
            self._more.visible = bool(details)
        for element, content in ((self._html, html), (self._details, details)):
            update_widget(element, content=content)


def one_html(trace: Trace, what: Explanation, kept: NDArray, editable: bool) -> str:
    """The card of one match: whether the run kept it and why, and how it can be changed."""
    title = f'<span style="font-size:15px;font-weight:600">Match {kept[what.number]}</span>'
    color = style.OUTLIER if "wrongly" in what.verdict else style.INLIER if what.kept else None
    look = f"color:{style.css_text(color)};font-weight:600" if color else "font-weight:600"
    head = f'<div>{_walk(what.number, kept)}{title} <span style="{look}">{escape(what.verdict)}</span></div>'
    body = f'<div style="padding-top:.3em">{escape(what.reason)}</div>{crops_html(trace.problem, what.number)}'
    return _words(head + body) + _actions(trace, 1, editable)


def untold_html(trace: Trace, selected: tuple[int, ...], kept: NDArray, editable: bool) -> str:
    """The card of matches whose results are hidden: their numbers, and how they can be changed."""
    number = selected[0]
    if len(selected) == 1:
        head, crops = f"{_walk(number, kept)}Match {kept[number]}", crops_html(trace.problem, number)
    else:
        head, crops = f"{len(selected):,} matches", ""
    title = f'<div style="font-size:15px;font-weight:600">{head}</div>'
    return _words(f"{title}{crops}") + _actions(trace, len(selected), editable)


def details_html(what: Explanation, kept: NDArray) -> str:
    """The folded part of the card of one match."""
    return _measures(what) + _notes(what, kept)


def many_html(trace: Trace, what: Traits, numbers: NDArray, editable: bool) -> str:
    """The card of several matches with these original numbers."""
    shown = ", ".join(map(str, numbers[:12].tolist())) + (" …" if len(numbers) > 12 else "")
    head = f'<div style="font-size:15px;font-weight:600">{what.count:,} matches</div>'
    body = "".join(f"<div>{escape(sentence)}</div>" for sentence in what.sentences)
    rows = [("numbers", shown), ("kept by the run", f"{what.kept:,} of {what.count:,}")]
    if what.right is not None:
        rows.append(("truly inliers", f"{what.right:,} of {what.count:,}"))
    if what.median_px is not None:
        rows.append(("median residual", _px(what.median_px)))
    if trace.cam_from_map is not None and what.pairs:
        rows.append(("pairs that agree", f"{what.agree:,} of {what.pairs:,} at the estimated yaw"))
    table = Table("selection", ("", "these"), tuple(rows))
    return _words(head + body) + table_html(table) + _actions(trace, what.count, editable)


def _words(content: str) -> str:
    """What a phone shows beside the words of the step too (``captions.js``)."""
    return box(f'<div class="match-words">{content}</div>')


def _walk(number: int, kept: NDArray) -> str:
    """Buttons to the match before and after this one."""
    before, after = (int(kept[(number + step) % len(kept)]) for step in (-1, 1))
    back, on = chip("‹", f"select:{before}", False, "Previous match"), chip("›", f"select:{after}", False, "Next match")
    return f'<span style="float:right;white-space:nowrap">{back}{on}</span>'


def _actions(trace: Trace, count: int, editable: bool) -> str:
    deselect = chip("Deselect", "deselect:", False)
    if not editable:
        changes = (
            _disabled(words, "Only the presenter changes matches") for words in ("Make wrong", "Make right", "Hide")
        )
        return box("".join(changes) + deselect)
    it = "this match" if count == 1 else "these matches"
    mend = (
        chip("Make right", "mend:", False, f"Put {it} where the true pose sees the point")
        if trace.problem.truth_cam_from_map is not None
        else _disabled("Make right", "The true pose is unknown, and so is the right pixel")
    )
    spoil = chip("Make wrong", "spoil:", False, f"Give {it} a wrong pixel at random")
    hide = chip("Hide", "hide:", False, f"Leave {it} out of the problem")
    return box(f"{spoil}{mend}{hide}{deselect}")


def _disabled(words: str, why: str) -> str:
    return (
        f'<span aria-disabled="true" title="{escape(why)}" style="display:inline-block;margin:0 .35em .35em 0;'
        f'padding:.12em .6em;border-radius:1em;opacity:.4;background:rgba(128,136,150,.16)">{escape(words)}</span>'
    )


def _measures(what: Explanation) -> str:
    """Numbers at the estimated and at the true pose, side by side."""
    sides = [
        (name, residual, pairs)
        for name, residual, pairs in (
            ("estimate", what.estimate, what.at_estimate),
            ("truth", what.truth, what.at_truth),
        )
        if residual is not None and pairs is not None
    ]
    if not sides:
        return ""
    rows: list[tuple[str, ...]] = [
        ("residual", *(_px(residual.px) for _, residual, _ in sides)),
        ("angle", *(f"{residual.deg:.3g}°" for _, residual, _ in sides)),
        ("yaw", *(true_minus(f"{pairs.yaw_deg:.2f}°") for _, _, pairs in sides)),
        ("pairs that agree", *(f"{pairs.agree:,} of {what.others:,}" for _, _, pairs in sides)),
        ("with inliers", *(f"{pairs.agree_inliers:,} of {what.inliers:,}" for _, _, pairs in sides)),
    ]
    # A heading is shown for three columns and more.
    columns = ("", *(name for name, _, _ in sides), *([] if len(sides) > 1 else [""]))
    return table_html(Table("measures", columns, tuple(rows)))


def _notes(what: Explanation, kept: NDArray) -> str:
    """In small type: its bound and label, the pairs that exclude the true yaw, and its part in the stages."""
    notes = []
    if what.usable:
        notes.append(_bounds(what))
    if what.right is not None and what.labelled:
        notes.append(f"Its label says {'inlier' if what.right else 'outlier'}.")
    if what.silent:
        many = f"{what.silent:,} pairs are too close to say anything, and count as agreeing."
        notes.append(many if what.silent > 1 else "One pair is too close to say anything, and counts as agreeing.")
    notes = [escape(note) for note in notes]
    if what.at_truth is not None:
        notes.append(_excluding(what.number, what.at_truth, kept))
    if what.stages:
        part = "; ".join(what.stages)
        notes.append(escape(f"{part[:1].upper()}{part[1:]}."))
    return box(f'<div style="{DIM}">{" ".join(notes)}</div>', "font-size:12px")


def _bounds(what: Explanation) -> str:
    """Both bounds, and whether gravity's error is in them."""
    px, bearing, gravity = (
        _px(what.bound_px),
        f"{what.bound_deg:.2f}°",
        f"gravity's error of up to {what.gravity_deg:.2g}°",
    )
    if what.gravity_deg == 0.0:
        return f"Its bound is {px}, or {bearing} for its bearing."
    if what.noise_only:
        return f"Its bound is {px} for noise alone; its bearing may be {bearing} off by noise and {gravity}."
    return f"Its bound for noise and {gravity} is {px}, or {bearing} for its bearing."


def _excluding(number: int, pairs: Pairs, kept: NDArray) -> str:
    excluding = "One pair excludes" if pairs.excluded == 1 else f"{pairs.excluded:,} pairs exclude"
    agreeing = "one agrees" if pairs.impossible == 1 else f"{pairs.impossible:,} agree"
    words = f"{excluding} the true yaw, and {agreeing} at none."
    if not pairs.worst:
        return words
    worst = ", ".join(
        f'{degrees:.0f}° with <span data-touch="select:{kept[number]},{kept[other]}" role="button" tabindex="0" '
        f'style="text-decoration:underline dotted">{kept[other]}</span>'
        for other, degrees in pairs.worst
    )
    return f"{words} Farthest off: {worst}."


def _px(value: float) -> str:
    return "over 90°" if np.isinf(value) else px_text(value)
