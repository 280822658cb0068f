"""Two sets of runs on the same problems, compared pair by pair, with statistical tests of the differences."""

import math
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from spherloc.errors import InputError, show
from spherloc_viz.recording.run_row import RunRow

KEYS: tuple[Callable[[RunRow], tuple[object, ...]], ...] = (
    lambda row: (row.problem_key, row.estimator, row.options, row.seed),
    lambda row: (row.problem_key, row.estimator, row.seed),
    lambda row: (row.problem_key, row.estimator),
    lambda row: (row.problem_key, row.seed),
    lambda row: (row.problem_key,),
)
"""Keys by which two runs can be a pair; the one that gives most pairs is used, of several such the first."""
MEASURED: Mapping[str, str] = {
    "rotation_error_deg": "rotation error, deg",
    "translation_error_m": "position error, {unit}",
    "time_ms": "time, ms",
}
"""Numbers that are compared pair by pair, with their names; ``unit`` is that of the maps."""


@dataclass(frozen=True)
class Pair:
    """Two runs on the same problem."""

    before: RunRow
    after: RunRow


@dataclass(frozen=True)
class Change:
    """How a number has changed over the pairs."""

    title: str
    """Name of the number, with its unit."""
    pairs: int
    """Number of pairs in which both runs have it."""
    before: float
    """Median before; NaN without pairs."""
    after: float
    """Median after."""
    difference: float
    """Median of the differences, after minus before."""
    p: float
    """p-value of Wilcoxon's signed-rank test, two-sided; 1 if no pair differs, NaN without pairs."""


@dataclass(frozen=True)
class OutcomeChanges:
    """How the outcomes of paired runs changed from one set to the other."""

    pairs: tuple[Pair, ...]
    """All pairs, in the order of the second set."""
    only_before: int
    """Number of runs of the first set without a partner in the second one."""
    only_after: int
    """Number of runs of the second set without a partner in the first one."""
    broken: tuple[Pair, ...]
    """Pairs that are right before and wrong after."""
    mended: tuple[Pair, ...]
    """Pairs that are wrong before and right after."""
    right_before: int
    """Number of judged pairs that are right before."""
    right_after: int
    """Number of judged pairs that are right after."""
    judged: int
    """Number of pairs of which both runs can be judged."""
    p: float
    """p-value of McNemar's exact test of broken against mended, two-sided; 1 if there are none."""
    changes: tuple[Change, ...]
    """Changes of the numbers in ``MEASURED``."""


def is_right(row: RunRow) -> bool | None:
    """Whether a run is right by the truth or, if that is unknown, by its diagnosis; None if it has neither."""
    if row.outcome != "unknown":
        return row.outcome == "success"
    return None if row.doubtful is None else not row.doubtful


def compare(before: Sequence[RunRow], after: Sequence[RunRow]) -> OutcomeChanges:
    """Pair the runs of two sets, and test what has changed.

    Of several runs with the same key the newest one counts. Raises ``InputError`` if no run has a partner.
    """
    pairs = _paired(before, after)
    only_before = len({row.file for row in before} - {pair.before.file for pair in pairs})
    only_after = len({row.file for row in after} - {pair.after.file for pair in pairs})
    if not pairs:
        raise InputError(
            "no problem occurs in both sets of runs, so there is nothing to compare: run the same scenes and seeds."
        )
    return compare_pairs(pairs, only_before, only_after)


def compare_pairs(pairs: tuple[Pair, ...], only_before: int = 0, only_after: int = 0) -> OutcomeChanges:
    """Test what has changed in pairs that are known; the counts are of runs without a partner."""
    from scipy import stats  # takes most of a second

    judged = [(pair, is_right(pair.before), is_right(pair.after)) for pair in pairs]
    known = [(pair, was, now) for pair, was, now in judged if was is not None and now is not None]
    broken = tuple(pair for pair, was, now in known if was and not now)
    mended = tuple(pair for pair, was, now in known if now and not was)
    changed = len(broken) + len(mended)
    return OutcomeChanges(
        pairs=pairs,
        only_before=only_before,
        only_after=only_after,
        broken=broken,
        mended=mended,
        right_before=sum(was for _, was, _ in known),
        right_after=sum(now for _, _, now in known),
        judged=len(known),
        p=float(stats.binomtest(len(broken), changed).pvalue) if changed else 1.0,
        changes=tuple(_change(name, pairs) for name in MEASURED),
    )


def _paired(before: Sequence[RunRow], after: Sequence[RunRow]) -> tuple[Pair, ...]:
    best: tuple[Pair, ...] = ()
    for key in KEYS:
        # A later run replaces an earlier one with the same key.
        old = {key(row): row for row in sorted(before, key=lambda row: row.created)}
        new = {key(row): row for row in sorted(after, key=lambda row: row.created)}
        pairs = tuple(Pair(old[k], row) for k, row in new.items() if k in old and old[k] != row)
        if len(pairs) > len(best):
            best = pairs
    return best


def _change(name: str, pairs: Sequence[Pair]) -> Change:
    from scipy import stats  # takes most of a second

    values = [(getattr(pair.before, name), getattr(pair.after, name)) for pair in pairs]
    known = np.array([pair for pair in values if None not in pair], dtype=np.float64).reshape(-1, 2)
    unit = " or ".join(sorted({pair.after.unit for pair in pairs}))
    title = MEASURED[name].format(unit=unit)
    if not len(known):
        return Change(title, 0, math.nan, math.nan, math.nan, math.nan)
    difference = known[:, 1] - known[:, 0]
    p = float(cast(Any, stats.wilcoxon(difference)).pvalue) if np.any(difference) else 1.0
    was, now = np.median(known, axis=0)
    return Change(title, len(known), float(was), float(now), float(np.median(difference)), p)


_CONDITION = re.compile(r"\s*([a-z ]+?)\s*(<=|>=|<|>|=)\s*([0-9.]+(?:e-?[0-9]+)?)\s*(%?)\s*")
QUANTITIES: Mapping[str, Callable[[OutcomeChanges], float]] = {
    "new failures": lambda c: len(c.broken),
    "mended": lambda c: len(c.mended),
    "net failures": lambda c: len(c.broken) - len(c.mended),
    "pairs": lambda c: len(c.pairs),
    "unpaired": lambda c: c.only_before + c.only_after,
    "failures": lambda c: c.judged - c.right_after,
    "success": lambda c: c.right_after / c.judged if c.judged else math.nan,
    "p": lambda c: c.p,
}
"""Quantities of a condition, by name."""
_COMPARE: Mapping[str, Callable[[float, float], bool]] = {
    "<": lambda a, b: a < b,
    "<=": lambda a, b: a <= b,
    ">": lambda a, b: a > b,
    ">=": lambda a, b: a >= b,
    "=": lambda a, b: a == b,
}


@dataclass(frozen=True)
class Condition:
    """A condition such as "new failures > 0"; if several are joined by "and", all of them must hold."""

    text: str
    """The condition as the user gave it."""
    parts: tuple[tuple[str, str, float], ...]
    """Quantity, comparison sign and number of each part."""

    def holds(self, comparison: OutcomeChanges) -> bool:
        """Whether it holds for a comparison; false if a quantity is unknown."""
        return all(_COMPARE[sign](QUANTITIES[name](comparison), number) for name, sign, number in self.parts)


def parse_condition(text: str) -> Condition:
    """A condition from its text; raises ``InputError``, with all quantities, if it cannot be understood."""
    parts = []
    for part in text.casefold().split(" and "):
        found = _CONDITION.fullmatch(part)
        if found is None or found[1] not in QUANTITIES or found[3].count(".") > 1 or found[3] == ".":
            known = ", ".join(QUANTITIES)
            raise InputError(
                f"{show(text)} is not a condition: give a quantity, a sign (<, <=, >, >=, =) and a number, such as "
                f"'new failures > 0'; quantities are {known}; several are joined by 'and'."
            )
        parts.append((found[1], found[2], float(found[3]) / (100.0 if found[4] else 1.0)))
    return Condition(text, tuple(parts))


def causes(pairs: Sequence[Pair]) -> tuple[tuple[str, int], ...]:
    """Diagnoses of the runs after, and how often each occurs, the most frequent ones first."""
    return tuple(Counter(pair.after.diagnosis or "not diagnosed" for pair in pairs).most_common())
