"""The table of all matches, page by page; it can be filtered, and a press on a heading sorts it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path

import numpy as np
import viser
from numpy.typing import NDArray

from spherloc.errors import InputError, shorten, show
from spherloc.problem import Problem
from spherloc.trace import Trace
from spherloc.types import BoolArray, IntArray
from spherloc_viz import style
from spherloc_viz.app.paging import PAGE, chip, page_of, pages_html
from spherloc_viz.app.text import WITHHELD, box, status_html
from spherloc_viz.app.web.touch import Touch, Touches
from spherloc_viz.app.web.viser_internals import update_widget
from spherloc_viz.layers.matches import (
    FILTERS,
    IN_CLIQUE,
    SORTS,
    MatchColumns,
    match_rows,
    offered,
    order,
    reference_votes,
)

MAX_REFERENCES = 8
MAX_LETTERS = 18
"""Longest name of a reference that its button shows in full; where names are alike, they may be longer."""


def chips_html(problem: Problem, inlier_mask: BoolArray, shown: int | None) -> str:
    """Buttons for the references, those with most inliers first; empty if there is no choice."""
    inliers, matches = reference_votes(problem, inlier_mask)
    if shown is None or len(matches) < 2:
        return ""
    order = np.lexsort((-matches, -inliers))
    offered = [int(k) for k in order[:MAX_REFERENCES]]
    offered += [] if shown in offered else [shown]
    names = _names_apart([problem.reference_images[k] for k in offered])
    chips = "".join(
        chip(
            f"{short}: {inliers[k]}/{matches[k]}",
            f"image-reference:{k}",
            k == shown,
            f"{name}: {inliers[k]} inliers of {matches[k]} matches",
        )
        for k, (name, short) in zip(offered, names, strict=True)
    )
    left = f" {len(offered)} of {len(matches)} are offered." if len(offered) < len(matches) else ""
    note = f"References, inliers of matches.{left}"
    return box(f'<div style="opacity:.65;padding-bottom:.2em">{note}</div>{chips}', "font-size:12px")


def _names_apart(paths: Sequence[Path]) -> list[tuple[str, str]]:
    """Name of each file, with as many folders as tell it from the others, and as much of that name as does so."""
    deepest = max(len(path.parts) for path in paths)
    parts = next((n for n in range(1, deepest) if len({path.parts[-n:] for path in paths}) == len(paths)), deepest)
    names = [Path(*path.parts[-parts:]).as_posix() for path in paths]
    longest = max(map(len, names))
    most = next(
        (n for n in range(MAX_LETTERS, longest) if len({shorten(name, n) for name in names}) == len(names)),
        max(longest, MAX_LETTERS),
    )
    return [(name, shorten(name, most)) for name in names]


COLUMNS = (
    ("number", "match", "Its number"),
    ("run", "run", "Whether the run calls it an inlier"),
    ("truth", "truth", "Whether it truly is one"),
    ("px", "px", "Reprojection error at the estimated pose, px; there is none more than 90° from its bearing"),
    ("deg", "deg", "Angle between its bearing and its point at the estimated pose, degrees"),
    ("agrees", "agrees", "With how many of {} it makes a pair that agrees at the estimated yaw"),
)
"""Name, heading and hint of each column."""


@dataclass(frozen=True)
class TableLook:
    """Filter, order and page of the table."""

    shown: str = "all"
    by: str = "number"
    down: bool = False
    page: int = 0

    def text(self) -> str:
        """Filter and order as text for a link, such as "outliers,-px"; empty for those of a new page."""
        same = replace(self, page=0) == NEW_TABLE
        return "" if same else f"{self.shown},{'-' if self.down else ''}{self.by}"


NEW_TABLE = TableLook()
"""The look of a new page's table."""


def look_of(text: str) -> TableLook:
    """The look of which ``text`` is the text. Raises ``InputError`` for an unknown filter or column."""
    if not text:
        return NEW_TABLE
    shown, _, by = text.partition(",")
    column = by.removeprefix("-")
    if shown not in FILTERS or column not in SORTS:
        raise InputError(
            f"table is {show(text)}; give a filter ({', '.join(FILTERS)}), a comma and a column "
            f"({', '.join(SORTS)}), with a minus in front for descending order."
        )
    return TableLook(shown, column, by != column)


class MatchTablePanel:
    """The table of one page."""

    def __init__(self, gui: viser.GuiApi, touches: Touches, changed: Callable[[object], None]) -> None:
        self._html = gui.add_html("")
        self._changed = changed
        self.look = NEW_TABLE
        """As chosen by a person or a link."""
        self._followed: tuple[int, ...] = ()
        self._drawn: tuple | None = None
        for action, handler in (
            ("match-sort", self._sort),
            ("match-filter", self._filter),
            ("match-page", self._turn),
        ):
            touches.on(action, handler)

    def draw(self, trace: Trace, selected: tuple[int, ...], kept: NDArray, hidden: bool = False) -> None:
        """Show the matches of a run. ``selected`` are indices in the problem, ``kept`` (N,) the original numbers.

        If a match was just selected elsewhere, the table turns to its page and is scrolled to its row. ``hidden`` shows
        no matches, since all columns are answers.
        """
        if hidden:
            self._drawn = None
            update_widget(self._html, content=status_html(WITHHELD))
            return
        drawn = (trace, selected, kept.tobytes(), self.look)
        if self._drawn is not None and self._drawn[0] is trace and self._drawn[1:] == drawn[1:]:
            return
        rows, look = match_rows(trace), self.look
        look = look if look.shown in offered(rows) else replace(look, shown="all")
        listed = order(rows, look.shown, look.by, look.down)
        pages = max(1, -(-len(listed) // PAGE))
        page = min(look.page, pages - 1)
        if selected != self._followed:
            self._followed = selected
            page = page_of(np.flatnonzero(np.isin(listed, selected)), page)
        self.look = look = replace(look, page=page)
        self._drawn = (*drawn[:3], look)
        html = table_html(rows, listed, look, frozenset(selected), kept)
        update_widget(self._html, content=html)

    def _sort(self, touch: Touch) -> None:
        if touch.argument in SORTS:
            down = not self.look.down if self.look.by == touch.argument else False
            self._show(replace(self.look, by=touch.argument, down=down, page=0))

    def _filter(self, touch: Touch) -> None:
        if touch.argument in FILTERS:
            self._show(replace(self.look, shown=touch.argument, page=0))

    def _turn(self, touch: Touch) -> None:
        if touch.argument.isdecimal():
            self._show(replace(self.look, page=min(int(touch.argument), 10**6)))

    def _show(self, look: TableLook) -> None:
        self.look = look
        self._changed(look)


def table_html(rows: MatchColumns, listed: IntArray, look: TableLook, selected: frozenset[int], kept: NDArray) -> str:
    """The current page of the matches ``listed``, with the buttons above and below it."""
    shown = listed[look.page * PAGE : (look.page + 1) * PAGE]
    revealed = next((k for k in shown.tolist() if k in selected), -1)
    body = "".join(_row(rows, k, k in selected, k == revealed, int(kept[k])) for k in shown.tolist())
    table = (
        '<table style="border-collapse:collapse;width:100%;font-variant-numeric:tabular-nums;margin-top:.3em">'
        f"<tr>{_headings(rows, look)}</tr>{body}</table>"
    )
    return box(_filters(rows, look) + table + _pages(rows, listed, look), "font-size:12.5px")


def _filters(rows: MatchColumns, look: TableLook) -> str:
    chips = []
    for name in offered(rows):
        count = np.count_nonzero(FILTERS[name](rows))
        words = f"matches {name} of balls" if name == IN_CLIQUE and rows.of_balls else name
        chips.append(chip(f"{words} {count:,}", f"match-filter:{name}", name == look.shown))
    return "".join(chips)


def _headings(rows: MatchColumns, look: TableLook) -> str:
    cells = []
    is_sample = rows.partners < np.count_nonzero(rows.kept)
    asked = f"{rows.partners} inliers, evenly chosen," if is_sample else f"{rows.partners} inliers"
    for place, (name, heading, hint) in enumerate(COLUMNS):
        if name == "agrees" and rows.partners:
            heading = f"agrees /{rows.partners}"
        arrow = "" if name != look.by else " ▾" if look.down else " ▴"
        align = "left" if place < 3 else "right"
        cells.append(
            f'<th data-touch="match-sort:{name}" role="button" tabindex="0" title="{escape(hint.format(asked))}" '
            f'style="text-align:{align};font-weight:600;padding:.15em .3em;white-space:nowrap">{heading}{arrow}</th>'
        )
    return "".join(cells)


def _row(rows: MatchColumns, k: int, chosen: bool, revealed: bool, number: int) -> str:
    cell, right = '<td style="padding:.08em .3em">', '<td style="padding:.08em .3em;text-align:right">'
    mark = (
        f"background:{style.css(style.SELECTED)}1c;box-shadow:inset 3px 0 {style.css(style.SELECTED)}" if chosen else ""
    )
    reveal = f' data-reveal="match-{number}"' if revealed else ""
    truth = "–" if rows.right is None else _word(bool(rows.right[k]))
    agree = "–" if rows.agree[k] < 0 else f"{rows.agree[k]}"
    return (
        f'<tr tabindex="0" data-touch="select:{number}" style="{mark}"{reveal}>{cell}{number}</td>'
        f"{cell}{_word(bool(rows.kept[k]))}</td>{cell}{truth}</td>{right}{_number(rows.px[k])}</td>"
        f"{right}{_number(rows.deg[k])}</td>{right}{agree}</td></tr>"
    )


def _word(inlier: bool) -> str:
    color, word = (style.INLIER, "inlier") if inlier else (style.OUTLIER, "outlier")
    return f'<span style="color:{style.css_text(color)}">{word}</span>'


def _number(value: float) -> str:
    if np.isnan(value):
        return "–"
    return "> 90°" if np.isinf(value) else f"{value:.2f}" if value < 100 else f"{value:,.0f}"


def _pages(rows: MatchColumns, listed: IntArray, look: TableLook) -> str:
    inliers = np.count_nonzero(rows.kept)
    asked = f"; agrees: of {rows.partners} inliers{', evenly chosen' if rows.partners < inliers else ''}"
    return pages_html(look.page, len(listed), "match-page", asked if rows.partners else "")
