"""A query as SQL: conditions with parameters, and the order. No value of a query is ever part of the SQL."""

from typing import Any

from spherloc_viz.recording.index.query import GROUP_KEYS, SORT_KEYS, Range, RunQuery
from spherloc_viz.recording.index.rows import NULLABLE

_EXACT = ("estimator", "outcome", "diagnosis", "source", "problem_key", "doubtful")
_RANGES = ("outlier_rate", "rotation_error_deg", "translation_error_m", "inliers", "correspondences", "time_ms")

Condition = tuple[str, list[Any]]
"""SQL that follows WHERE, and its parameters."""


def condition(query: RunQuery) -> Condition:
    """What must be true of a row of ``runs``."""
    parts: list[Condition] = [("TRUE", [])]
    for name in _EXACT:
        if (value := getattr(query, name)) is not None:
            parts.append((f"{name} = ?", [value]))
    for name in _RANGES:
        if (limits := getattr(query, name)) is not None:
            parts.append(_within(name, limits))
    if query.scene is not None:
        parts.append(_scene(query.scene))
    if query.label is not None:
        parts.append(("id IN (SELECT id FROM labels WHERE label = ?)", [query.label]))
    if query.since is not None:
        parts.append(("created >= ?", [query.since]))
    if query.until is not None:
        parts.append(("created < ?", [query.until]))
    if wanted := (query.text or "").casefold().split():
        # instr() knows no wildcards, so that nothing must be escaped.
        tests = " AND ".join(["instr(words, ?)"] * len(wanted))
        parts.append((f"id IN (SELECT id FROM words WHERE {tests})", list(wanted)))
    return " AND ".join(sql for sql, _ in parts), [value for _, values in parts for value in values]


def _within(name: str, limits: Range) -> Condition:
    low, high = ">" if limits.low_open else ">=", "<" if limits.high_open else "<="
    return f"{name} {low} ? AND {name} {high} ?", [limits.low, limits.high]


def _scene(scene: str) -> Condition:
    endings = [f"/{scene}", f"/{scene}.toml"]
    sql = " OR ".join(["name = ?", "scene IN (?, ?)", *["substr(scene, -length(?)) = ?"] * len(endings)])
    return f"({sql})", [scene, scene, f"{scene}.toml", *(ending for ending in endings for _ in range(2))]


def order(query: RunQuery) -> str:
    """The order of the answer; the file's name, which sorts by time, makes it the same every time."""
    assert query.sort in SORT_KEYS
    direction = "DESC" if query.descending else "ASC"
    # Only where it can be null, since an index cannot sort by more than columns.
    nulls_last = f"{query.sort} IS NULL, " if query.sort in NULLABLE else ""
    return f"{nulls_last}{query.sort} {direction}, file {direction}"


def groups(query: RunQuery, by: str) -> Condition:
    """A whole statement that counts runs by the value of ``by``, most of them first."""
    assert by in GROUP_KEYS
    where, values = condition(query)
    table = f"labels WHERE id IN (SELECT id FROM runs WHERE {where})" if by == "label" else f"runs WHERE {where}"
    return f"SELECT {by}, count(*) FROM {table} GROUP BY {by} ORDER BY count(*) DESC, {by}", values
