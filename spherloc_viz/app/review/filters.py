"""The filters of the list of recordings as HTML: counts that are pressed to see those runs only."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from html import escape

from spherloc_viz import style
from spherloc_viz.app.glossary import help_html
from spherloc_viz.app.review.words import COLORS
from spherloc_viz.app.text import DIM, box, dot_html
from spherloc_viz.recording.index.query import MAX_TEXT, OUTCOMES, PAGE_KEPT, Range, RunQuery, parse_range, parse_when

KEPT = "kept"
"""The label of a run that a page made and somebody wants to keep."""
PAGE = 20
"""Rows that are shown at once."""
MAX_PAGES = 10**6
EXACT = ("outcome", "diagnosis", "estimator", "scene", "label", "source")
"""Filters that take a value which runs have, and by which they are counted."""
OUTLIERS: Mapping[str, str] = {
    "up to 50 %": "<=0.5",
    "50 to 80 %": "0.5..0.8",
    "80 to 90 %": "0.8..0.9",
    "90 to 95 %": "0.9..0.95",
    "above 95 %": ">0.95",
}
"""Ranges of the share of wrong matches that are offered."""
AGES: Mapping[str, str] = {"last hour": "1h", "last day": "1d", "last week": "1w", "last month": "30d"}
"""How old runs may be, as ``parse_when`` takes it."""
SORTS: Mapping[str, str] = {
    "created": "date",
    "rotation_error_deg": "rotation error",
    "translation_error_m": "position error",
    "outlier_rate": "outliers",
    "inliers": "inliers",
    "time_ms": "time",
    "name": "name",
}
"""What runs are sorted by, and what it is called."""
JUDGED = ("doubtful",)
"""What the diagnosis says of a run, also where the truth is not known."""
SUSPECT = "Runs whose diagnosis names a cause, by the truth where that is known; such a run may have been localized"
"""What the filter of ``JUDGED`` finds, said under a resting pointer."""
FILTERS = (*EXACT, "judged", "outliers", "when")
UNTOLD, UNTOLD_SORTS = ("estimator", "source", "when"), ("created",)
"""Filters and orders that give no answer away."""
UNFOLDED = (*EXACT[2:], "outliers", "when", "sort")
"""What is chosen in a row that is unfolded."""


@dataclass(frozen=True)
class Look:
    """The list of one page. None asks for nothing."""

    text: str = ""
    """Words to be found."""
    outcome: str | None = None
    diagnosis: str | None = None
    """Empty for runs that were not diagnosed."""
    estimator: str | None = None
    scene: str | None = None
    label: str | None = None
    source: str | None = None
    judged: str | None = None
    """One of ``JUDGED``."""
    outliers: str | None = None
    """One of ``OUTLIERS``, or a range as it is typed."""
    when: str | None = None
    """One of ``AGES``."""
    pages: bool = False
    """Whether runs that pages made by themselves are listed too."""
    sort: str = "created"
    descending: bool = True
    page: int = 0
    """Index of the page of the list, from 0."""
    unfolded: str = ""
    """The filter whose values are offered."""

    def query(self, now: datetime) -> RunQuery:
        """What to ask the index for; raises ``InputError`` for a range that is none."""
        exact = {name: getattr(self, name) for name in EXACT}
        return RunQuery(
            text=self.text.strip()[:MAX_TEXT] or None,
            pages=None if self.pages or self.source == "page" else False,
            doubtful=None if self.judged is None else True,
            outlier_rate=self._range(),
            since=None if self.when is None else parse_when(AGES[self.when], now),
            sort=self.sort,
            descending=self.descending,
            **exact,
        )

    def _range(self) -> Range | None:
        return None if self.outliers is None else parse_range(OUTLIERS.get(self.outliers, self.outliers))

    def choose(self, name: str, value: str) -> "Look":
        """The list with this filter set, or taken away if it was set to that; as it is if there is no such filter."""
        known = {"outcome": OUTCOMES, "judged": JUDGED, "outliers": tuple(OUTLIERS), "when": tuple(AGES)}
        if name not in FILTERS or (name in known and value not in known[name]):
            return self
        chosen = None if getattr(self, name) == value else value
        return replace(self, page=0, **{name: chosen})

    def sorted(self, key: str) -> "Look":
        """The list sorted by that, the other way round if it is already."""
        if key not in SORTS:
            return self
        down = not self.descending if key == self.sort else key != "name"
        return replace(self, sort=key, descending=down, page=0)

    def unfold(self, name: str) -> "Look":
        """Offer the values of a filter, or put them away."""
        return replace(self, unfolded="" if name == self.unfolded or name not in UNFOLDED else name)

    def turn(self, page: str) -> "Look":
        """Another page."""
        fits = page.isascii() and page.isdigit() and int(page) < MAX_PAGES if len(page) < 8 else False
        return replace(self, page=int(page)) if fits else self

    def at(self, place: int) -> "Look":
        """The page that has the run at that place of the list."""
        return replace(self, page=place // PAGE)

    def cleared(self) -> "Look":
        """The list with no filters."""
        return Look(sort=self.sort, descending=self.descending)

    def untold(self) -> "Look":
        """The list without filters and orders that give the outcome away."""
        kept = {name: getattr(self, name) for name in ("text", "page", "pages", *UNTOLD)}
        told = self.sort not in UNTOLD_SORTS
        order = {} if told else {"sort": self.sort, "descending": self.descending}
        return Look(**kept, **order, unfolded=self.unfolded if self.unfolded in (*UNTOLD, "sort") else "")

    @property
    def filtered(self) -> bool:
        """Whether anything is left out."""
        return bool(self.text.strip()) or any(getattr(self, name) is not None for name in FILTERS)


Groups = Sequence[tuple[str, int]]

MAX_CHIPS = 24
"""Values that are offered at once, the most frequent ones."""
MAX_LETTERS = 40
"""Longest value that is shown; a longer one is cut, and its hint shows all of it."""
NOT_DIAGNOSED, NOTHING = "not diagnosed", "none"


@dataclass(frozen=True)
class Counts:
    """How many runs each value of a filter would leave, with all other filters as they are."""

    total: int
    outcome: Groups
    diagnosis: Groups
    doubtful: int
    unfolded: Groups = ()
    """Values of the unfolded filter with their counts, if they can be counted."""
    pages: int | None = None
    """Runs that pages made by themselves; None if there are no others, so that they are listed anyway."""


def filters_html(look: Look, counts: Counts, hidden: bool = False) -> str:
    """Outcomes, diagnoses, and a row of further filters with the values of the one that is unfolded; ``hidden`` leaves
    out those that tell answers."""
    if hidden:
        values = [_line(_values(look, counts.unfolded, UNTOLD_SORTS))] if look.unfolded else []
        return box("".join([_handles(look, UNTOLD), *values]), "font-size:12px;padding-bottom:.2em")
    outcomes = {value: count for value, count in counts.outcome}
    chips = [
        _chip("outcome", value, value, outcomes.get(value, 0), look.outcome, COLORS[value])
        for value in ("failure", "success", "unknown")
        if outcomes.get(value, 0) or look.outcome == value
    ]
    if counts.doubtful or look.judged:
        words = f'suspect <span style="{DIM}">{counts.doubtful:,}</span>'
        chips.append(
            pill(words, f"runs-filter:judged:{JUDGED[0]}", look.judged == JUDGED[0], SUSPECT) + help_html("suspect")
        )
    if counts.pages:
        hint = f"Runs that pages made by themselves; the newest {PAGE_KEPT} are stored, and those that you keep"
        number = f'<span style="{DIM}">{counts.pages:,}</span>'
        words = "page runs" if look.pages else "show page runs"
        chips.append(pill(f"{words} {number}", "runs-pages:", look.pages, hint))
    causes = [
        _chip("diagnosis", value, value or NOT_DIAGNOSED, count, look.diagnosis)
        for value, count in counts.diagnosis
        if count or value == look.diagnosis
    ]
    lines = [_line(chips), _line(causes), _handles(look)]
    if look.unfolded:
        lines.append(_line(_values(look, counts.unfolded)))
    return box("".join(lines), "font-size:12px;padding-bottom:.2em")


def _line(chips: Sequence[str]) -> str:
    return f'<div style="display:flex;flex-wrap:wrap;gap:.3em;padding-bottom:.4em">{"".join(chips)}</div>'


def _chip(
    name: str, value: str, words: str, count: int | None, chosen: str | None, color: style.RGB | None = None
) -> str:
    """A value with its count; a press sees those only, or all again."""
    on = chosen == value
    short = words if len(words) <= MAX_LETTERS else f"…{words[1 - MAX_LETTERS :]}"
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


def keep_html(file: str) -> str:
    """A button that keeps a run that a page made."""
    return pill("keep", f"run-keep:{file}", False, f"Label this run “{KEPT}”: it stays, and is listed with the others")


def key_html(key: str) -> str:
    """The sign of a key on a button."""
    look = "border:1px solid currentColor;border-radius:.25em;padding:0 .3em;opacity:.6;font:inherit;font-size:12px"
    return f'<kbd style="{look}">{escape(key)}</kbd>'


def keyed(key: str) -> str:
    """The attribute of an element that is pressed by a key too."""
    return f'data-key="{escape(key)}"'


def _handles(look: Look, names: Sequence[str] = UNFOLDED[:-1]) -> str:
    """What else can be chosen, with what is chosen now; how the list is sorted stands above the list."""
    parts = []
    for name in names:
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


def _values(look: Look, groups: Groups, sorts: Sequence[str] = tuple(SORTS)) -> list[str]:
    """The values of the filter that is unfolded; of orders, the ``sorts``."""
    name = look.unfolded
    if name == "sort":
        arrow = " ↓" if look.descending else " ↑"
        return [
            pill(
                escape(SORTS[key]) + (arrow if key == look.sort else ""),
                f"runs-sort:{key}",
                key == look.sort,
                SORTS[key],
            )
            for key in sorts
        ]
    fixed: Mapping[str, Mapping[str, str]] = {"outliers": OUTLIERS, "when": AGES}
    if name in fixed:
        return [_chip(name, words, words, None, getattr(look, name)) for words in fixed[name]]
    chosen = getattr(look, name)
    shown = list(groups[:MAX_CHIPS])
    if chosen is not None and chosen not in dict(shown):
        shown.append((chosen, 0))
    chips = [_chip(name, value, value or NOTHING, count, chosen) for value, count in shown]
    if len(groups) > MAX_CHIPS:
        chips.append(f'<span style="{DIM}">and {len(groups) - MAX_CHIPS:,} more: search for them</span>')
    return chips or [f'<span style="{DIM}">{NOTHING}</span>']
