"""Long tables page by page: small buttons, and the page on which a selected row lies."""

from html import escape

from spherloc.types import IntArray
from spherloc_viz.app.text import DIM

PAGE = 25
"""Rows of a page."""
LEAP = 10
"""Pages that a button goes on or back, besides those to the next page and the one before."""


def chip(words: str, touch: str, on: bool, hint: str = "") -> str:
    """A button; ``on`` highlights the one that is active."""
    look = "background:rgba(80,130,220,.28)" if on else "background:rgba(128,136,150,.16)"
    title = f' title="{escape(hint)}"' if hint else ""
    return (
        f'<span role="button" tabindex="0" data-touch="{escape(touch)}"{title} style="display:inline-block;'
        f'margin:0 .35em .35em 0;padding:.12em .6em;border-radius:1em;{look}">{escape(words)}</span>'
    )


def page_of(selected: IntArray, page: int) -> int:
    """The current page if it holds one of the selected rows, else the page of the first of them."""
    if not len(selected) or (selected // PAGE == page).any():
        return page
    return int(selected[0]) // PAGE


def pages_html(page: int, count: int, touch: str, note: str = "", size: int = PAGE) -> str:
    """Buttons to the pages beside the current one of ``count`` rows, to those ten before and after it, to the first
    and to the last, and which rows are shown; ``size`` is the number of rows of a page."""
    first, last, final = page * size + 1, min((page + 1) * size, count), max(0, count - 1) // size
    some = f"{first:,}–{last:,} of {count:,}" if count else "none"
    back = chip("‹", f"{touch}:{page - 1}", False, "Previous page") if page > 0 else ""
    on = chip("›", f"{touch}:{page + 1}", False, "Next page") if page < final else ""
    far = sorted({0, page, final} | {to for to in (page - LEAP, page + LEAP) if 0 < to < final})
    jumps = (chip(str(to + 1), f"{touch}:{to}", to == page, f"Page {to + 1} of {final + 1}") for to in far)
    numbers = "".join(jumps) if final > 1 else ""
    return f'<div style="padding-top:.4em">{back}{numbers}{on}<span style="{DIM}">{some}{escape(note)}</span></div>'
