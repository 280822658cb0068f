"""What of the list of recordings is shown: filters, order and page."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime

from spherloc_viz.recording.index.query import MAX_TEXT, OUTCOMES, Range, RunQuery, parse_range, parse_when

PAGE = 20
"""Rows that are shown at once."""
MOST_PAGES = 10**6
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
FILTERS = (*EXACT, "judged", "outliers", "when")
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
    sort: str = "created"
    descending: bool = True
    page: int = 0
    """From 0."""
    unfolded: str = ""
    """The filter whose values are offered."""

    def query(self, now: datetime) -> RunQuery:
        """What to ask the index for; raises ``InputError`` for a range that is none."""
        exact = {name: getattr(self, name) for name in EXACT}
        return RunQuery(
            text=self.text.strip()[:MAX_TEXT] or None,
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
        fits = page.isascii() and page.isdigit() and int(page) < MOST_PAGES if len(page) < 8 else False
        return replace(self, page=int(page)) if fits else self

    def at(self, place: int) -> "Look":
        """The page that has the run at that place of the list."""
        return replace(self, page=place // PAGE)

    def cleared(self) -> "Look":
        """The list with no filters."""
        return Look(sort=self.sort, descending=self.descending)

    @property
    def filtered(self) -> bool:
        """Whether anything is left out."""
        return bool(self.text.strip()) or any(getattr(self, name) is not None for name in FILTERS)
