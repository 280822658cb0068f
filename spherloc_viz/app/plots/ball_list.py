"""The list of a step's balls, page by page: the clique's first, with radius and overlaps; a press selects a ball."""

import numpy as np
from numpy.typing import NDArray

from spherloc_viz import style
from spherloc_viz.app.paging import PAGE, pages_html
from spherloc_viz.app.text import DIM
from spherloc_viz.layers.primitives import BallRows

PAGES = "ball-page"
CELL = "padding:.08em .3em"
RIGHT = f"{CELL};text-align:right"


def selected_rows(rows: BallRows, selected: tuple[int, ...]) -> NDArray[np.int64]:
    """Rows of the selected correspondences: for one, all balls with it; for several, the balls of two of them."""
    inside = np.isin(rows.pairs, selected).sum(axis=1)
    return np.flatnonzero(inside >= max(1, min(2, len(selected))))


def ball_list_html(
    rows: BallRows, page: int, lit: NDArray[np.int64], kept: NDArray[np.int64], color: style.RGB, marks: str
) -> str:
    """A page of the list. ``lit`` are the selected rows, ``kept`` (N,) the numbers of the matches on the page;
    ``marks`` says what the first ``rows.marked`` balls, told in a ``color``, are."""
    count, chosen = len(rows.radii), frozenset(lit.tolist())
    shown = range(page * PAGE, min((page + 1) * PAGE, count))
    revealed = next((k for k in shown if k in chosen), -1)
    body = "".join(_row(rows, k, k in chosen, k == revealed, kept, color) for k in shown)
    member = f'<th style="text-align:left;{CELL}">{marks}</th>' if rows.marked else ""
    head = (
        f'<th style="text-align:left;{CELL}">matches</th><th style="{RIGHT}">radius</th>'
        f'<th style="{RIGHT}" title="Other balls of this list that it overlaps">overlaps</th>{member}'
    )
    table = '<table style="border-collapse:collapse;width:100%;font-variant-numeric:tabular-nums;font-size:12.5px">'
    order = f"{rows.marked:,} {marks}, then the others; small ones first." if rows.marked else "Small ones first."
    note = f'<div style="font-size:12px;{DIM};padding:.2em 0 .3em">{order} Press a row to select its ball.</div>'
    return f"{note}{table}<tr>{head}</tr>{body}</table>{pages_html(page, count, PAGES)}"


def _row(rows: BallRows, k: int, chosen: bool, revealed: bool, kept: NDArray[np.int64], color: style.RGB) -> str:
    a, b = kept[rows.pairs[k]].tolist()
    violet = style.css(style.SELECTED)
    look = f"background:{violet}1c;box-shadow:inset 3px 0 {violet}" if chosen else ""
    reveal = f' data-reveal="ball-{a}-{b}"' if revealed else ""
    word, shade = ("yes", f"color:{style.css_text(color)}") if k < rows.marked else ("no", DIM)
    member = f'<td style="{CELL};{shade}">{word}</td>' if rows.marked else ""
    return (
        f'<tr tabindex="0" data-touch="select:{a},{b}" style="{look}"{reveal}><td style="{CELL}">{a} and {b}</td>'
        f'<td style="{RIGHT}">{rows.radii[k]}</td><td style="{RIGHT}">{rows.overlaps[k]:,}</td>'
        f"{member}</tr>"
    )
