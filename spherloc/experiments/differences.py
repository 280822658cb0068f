"""What differs between two tables that describe an experiment, in words."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

from spherloc.errors import show

MAX_TOLD = 3


def differences(before: Mapping[str, Any], now: Mapping[str, Any], uncompared: Collection[str]) -> dict[str, str]:
    """Phrases such as "seed is 1, was 0" by dotted keys such as "options.bound_px"; absent is the same as None.

    ``uncompared`` are keys of the tables themselves that may differ.
    """
    tables = [{key: value for key, value in table.items() if key not in uncompared} for table in (before, now)]
    a, b = (dict(_flat(table)) for table in tables)
    different = [key for key in {**a, **b} if a.get(key) != b.get(key)]
    return {key: f"{key} is {_shown(b, key)}, was {_shown(a, key)}" for key in different}


def in_short(phrases: Sequence[str]) -> str:
    """The first few, and how many more there are."""
    more = len(phrases) - MAX_TOLD
    return "; ".join([*phrases[:MAX_TOLD], *([f"and {more} more"] if more > 0 else [])])


def _flat(table: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{above}{key}.")
        else:
            yield above + key, value


def _shown(table: Mapping[str, Any], key: str) -> str:
    return show(table[key]) if key in table else "absent"
