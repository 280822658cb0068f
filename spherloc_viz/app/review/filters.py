"""The filters of the list of recordings as HTML: counts that are pressed to see those runs only."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

from spherloc_viz import style
from spherloc_viz.app.review.look import AGES, OUTLIERS, SORTS, UNFOLDED, Look
from spherloc_viz.app.review.words import COLORS
from spherloc_viz.app.text import DIM, box, dot_html

Groups = Sequence[tuple[str, int]]

MOST_CHIPS = 24
"""Values that are offered at once, the most frequent ones."""
MOST_LETTERS = 40
"""Of a value; the whole of it is in its hint."""
NOT_DIAGNOSED, NOTHING = "not diagnosed", "none"


@dataclass(frozen=True)
class Counts:
    """How many runs each value of a filter would leave, with all other filters as they are."""

    total: int
    outcome: Groups
    diagnosis: Groups
    doubtful: int
    unfolded: Groups = ()
    """Of the filter that is unfolded, if its values can be counted."""


def filters_html(look: Look, counts: Counts) -> str:
    """Outcomes, diagnoses, and a row of further filters with the values of the one that is unfolded."""
    outcomes = {value: count for value, count in counts.outcome}
    chips = [
        _chip("outcome", value, value, outcomes.get(value, 0), look.outcome, COLORS[value])
        for value in ("failure", "success", "unknown")
        if outcomes.get(value, 0) or look.outcome == value
    ]
    if counts.doubtful or look.judged:
        chips.append(_chip("judged", "doubtful", "doubtful", counts.doubtful, look.judged))
    causes = [
        _chip("diagnosis", value, value or NOT_DIAGNOSED, count, look.diagnosis)
        for value, count in counts.diagnosis
        if count or value == look.diagnosis
    ]
    lines = [_line(chips), _line(causes), _handles(look)]
    if look.unfolded:
        lines.append(_line(_values(look, counts.unfolded)))
    return box("".join(lines), "font-size:11.5px;padding-bottom:.2em")


def _line(chips: Sequence[str]) -> str:
    return f'<div style="display:flex;flex-wrap:wrap;gap:.3em;padding-bottom:.4em">{"".join(chips)}</div>'


def _chip(
    name: str, value: str, words: str, count: int | None, chosen: str | None, color: style.RGB | None = None
) -> str:
    """A value with its count; a press sees those only, or all again."""
    on = chosen == value
    short = words if len(words) <= MOST_LETTERS else f"…{words[1 - MOST_LETTERS :]}"
    number = "" if count is None else f' <span style="{DIM}">{count:,}</span>'
    dot = "" if color is None else dot_html(color)
    return pill(f"{dot}{escape(short)}{number}", f"runs-filter:{name}:{value}", on, words)


def pill(content: str, touch: str, on: bool, hint: str, extra: str = "") -> str:
    """A small round button; ``content`` is HTML, ``extra`` are more attributes."""
    look = (
        "background:rgba(60,130,230,.32);box-shadow:inset 0 0 0 1px rgba(80,150,250,.7)"
        if on
        else "background:rgba(128,136,150,.16)"
    )
    return (
        f'<span role="button" tabindex="0" aria-pressed="{str(on).lower()}" title="{escape(hint)}" '
        f'data-touch="{escape(touch)}" {extra} style="white-space:nowrap;border-radius:1em;padding:.08em .6em;{look}">'
        f"{content}</span>"
    )


def key_html(key: str) -> str:
    """The sign of a key on a button."""
    look = "border:1px solid currentColor;border-radius:.25em;padding:0 .3em;opacity:.6;font:inherit;font-size:10px"
    return f'<kbd style="{look}">{escape(key)}</kbd>'


def keyed(key: str) -> str:
    """The attribute of an element that is pressed by a key too."""
    return f'data-key="{escape(key)}"'


def _handles(look: Look) -> str:
    """What else can be chosen, with what is chosen now."""
    parts = []
    for name in UNFOLDED[:-1]:  # the last one, how the list is sorted, stands above the list
        chosen = getattr(look, name)
        bold = "font-weight:600" if chosen is not None else DIM
        words = name if chosen is None else f"{name}: {chosen or NOTHING}"
        arrow = "▴" if look.unfolded == name else "▾"
        parts.append(
            f'<span role="button" tabindex="0" data-touch="runs-unfold:{name}" aria-expanded="'
            f'{str(look.unfolded == name).lower()}" title="{escape(words)}" style="white-space:nowrap;max-width:14em;'
            f'overflow:hidden;text-overflow:ellipsis;{bold}">{escape(words)} {arrow}</span>'
        )
    if look.filtered:
        parts.append(
            '<span role="button" tabindex="0" data-touch="runs-clear:" style="text-decoration:underline">clear</span>'
        )
    return f'<div style="display:flex;flex-wrap:wrap;gap:.1em .8em;padding-bottom:.4em">{"".join(parts)}</div>'


def sorting_html(look: Look) -> str:
    """How the list is sorted; a press offers other ways."""
    words = f"by {SORTS[look.sort]} {'↓' if look.descending else '↑'}"
    return pill(words, "runs-unfold:sort", look.unfolded == "sort", "How the list is sorted")


def _values(look: Look, groups: Groups) -> list[str]:
    """The values of the filter that is unfolded."""
    name = look.unfolded
    if name == "sort":
        arrow = " ↓" if look.descending else " ↑"
        return [
            pill(escape(words) + (arrow if key == look.sort else ""), f"runs-sort:{key}", key == look.sort, words)
            for key, words in SORTS.items()
        ]
    fixed: Mapping[str, Mapping[str, str]] = {"outliers": OUTLIERS, "when": AGES}
    if name in fixed:
        return [_chip(name, words, words, None, getattr(look, name)) for words in fixed[name]]
    chosen = getattr(look, name)
    shown = list(groups[:MOST_CHIPS])
    if chosen is not None and chosen not in dict(shown):
        shown.append((chosen, 0))
    chips = [_chip(name, value, value or NOTHING, count, chosen) for value, count in shown]
    if len(groups) > MOST_CHIPS:
        chips.append(f'<span style="{DIM}">and {len(groups) - MOST_CHIPS:,} more: search for them</span>')
    return chips or [f'<span style="{DIM}">{NOTHING}</span>']
