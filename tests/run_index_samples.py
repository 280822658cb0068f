"""What a query of the list of runs means, in plain Python, and queries to try."""

from typing import Any

import numpy as np

from spherloc_viz.recording.index.query import SORT_KEYS, Range, RunQuery
from spherloc_viz.recording.run_row import RunRow

RANGES = ("outlier_rate", "rotation_error_deg", "translation_error_m", "inliers", "correspondences", "time_ms")


def within(limits: Range, value: float | None) -> bool:
    if value is None:
        return False
    low = value > limits.low if limits.low_open else value >= limits.low
    return low and (value < limits.high if limits.high_open else value <= limits.high)


def wanted(query: RunQuery, row: RunRow) -> bool:
    """What a query means, in plain Python."""
    exact = ("estimator", "outcome", "diagnosis", "doubtful", "source", "problem_key")
    if any(getattr(query, name) is not None and getattr(query, name) != getattr(row, name) for name in exact):
        return False
    for name in RANGES:
        if (limits := getattr(query, name)) is not None and not within(limits, getattr(row, name)):
            return False
    texts = (row.scene, row.name, row.query or "", row.message, row.summary, row.note, row.file, row.title, *row.labels)
    haystack = "\n".join(texts).casefold()
    return (
        all(word in haystack for word in (query.text or "").casefold().split())
        and (query.label is None or query.label in row.labels)
        and (query.since is None or row.created >= query.since)
        and (query.until is None or row.created < query.until)
    )


def in_order(query: RunQuery, rows: list[RunRow]) -> list[str]:
    """The files of a query's answer, in plain Python."""
    found = [row for row in rows if wanted(query, row)]
    known = [row for row in found if getattr(row, query.sort) is not None]
    unknown = [row for row in found if getattr(row, query.sort) is None]
    known.sort(key=lambda row: (getattr(row, query.sort), row.file), reverse=query.descending)
    unknown.sort(key=lambda row: row.file, reverse=query.descending)
    return [row.file for row in known + unknown]


def random_query(rng: np.random.Generator, rows: list[RunRow]) -> RunQuery:
    """One to four filters, each with a value that some run has, and any order."""
    row = rows[rng.integers(len(rows))]
    names = [
        "text",
        "estimator",
        "outcome",
        "diagnosis",
        "doubtful",
        "label",
        "source",
        "problem_key",
        "since",
        "until",
    ]
    chosen: dict[str, Any] = {}
    for name in rng.choice([*names, *RANGES], size=rng.integers(1, 5), replace=False).tolist():
        if name == "text":
            chosen[name] = f"{row.name.upper()} {row.summary[1:3]}"
        elif name == "label":
            chosen[name] = (*row.labels, "none")[0]
        elif name in ("since", "until"):
            chosen[name] = row.created
        elif name in RANGES:
            low, high = sorted(getattr(rows[k], name) or 0.0 for k in rng.integers(len(rows), size=2))
            open_ends = rng.random(2) < 0.5
            chosen[name] = Range(low, high, bool(open_ends[0]), bool(open_ends[1]))
        else:
            chosen[name] = getattr(row, name)
    return RunQuery(**chosen, sort=SORT_KEYS[rng.integers(len(SORT_KEYS))], descending=bool(rng.random() < 0.5))
