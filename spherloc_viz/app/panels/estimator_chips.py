"""Estimators to be ticked, each with a dot of the colour that it has in comparisons and sweeps."""

from collections.abc import Sequence
from html import escape

from spherloc_viz.app.text import box, dot_html
from spherloc_viz.layers.comparison import FIRST, color_of


def ordered(names: Sequence[str]) -> tuple[str, ...]:
    """Estimators in the order in which they are offered."""
    return tuple(sorted(names, key=lambda name: (FIRST.index(name) if name in FIRST else len(FIRST), name)))


def chips_html(action: str, names: Sequence[str], ticked: set[str]) -> str:
    """Names to be ticked; a press is reported as ``action`` with the name."""
    chips = "".join(_chip(action, name, name in ticked) for name in names)
    return box(f'<div style="display:flex;flex-wrap:wrap;gap:.35em">{chips}</div>', "font-size:12px")


def _chip(action: str, name: str, ticked: bool) -> str:
    look = f"border:1px solid rgba(128,140,160,{0.8 if ticked else 0.3});opacity:{1 if ticked else 0.7}"
    return (
        f'<span role="checkbox" aria-checked="{str(ticked).lower()}" aria-label="{escape(name)}" tabindex="0" '
        f'data-touch="{escape(action)}:{escape(name)}" '
        f'style="white-space:nowrap;border-radius:1em;padding:.1em .6em;{look}">'
        f"{dot_html(color_of(name))}{escape(name)}</span>"
    )
