"""All runs of a folder as columns, which a browser filters and sorts by itself."""

import json
from collections.abc import Mapping, Sequence
from datetime import datetime
from math import isfinite
from typing import Any

from spherloc_viz.app.desk.run_map import FEATURES, run_map

TEXTS = ("source", "scene", "name", "query", "estimator", "outcome", "diagnosis", "changes", "title", "problem_key")
"""Columns of texts, each sent as a list of its different texts and a number per run."""
ANSWERS = ("doubtful", "proven")
"""Columns whose values are yes, no or unknown; they are sent as texts."""
UNITS = {None: "m", 1: "m", 0: "units"}
"""Unit of a map's lengths, by whether the map is metric; sent as the text ``units``."""
NUMBERS = (
    *("created", "seed", "correspondences", "inliers", "outlier_rate", "rotation_error_deg", "translation_error_m"),
    *("time_ms", "steps", "key_step", "size_bytes", *FEATURES),
)
READ = ("file", "labels", "created", *TEXTS, *ANSWERS, "metric", *NUMBERS[1:])
"""Columns of the run index that are read."""
DIGITS = 5
"""Digits with which a number is sent: more than a plot or a table shows."""


def columns_json(columns: Mapping[str, Sequence[Any]], notes: Mapping[str, str], version: str) -> str:
    """The columns as JSON: ``texts`` (values and a code per run), ``numbers`` (null if unknown), files, labels and
    notes.

    ``columns`` are those of ``READ``; ``notes`` are by file. ``version`` says which state of the list it is.
    """
    table = dict(columns)
    table["created"] = [_seconds(text) for text in columns["created"]]
    for name in ANSWERS:
        table[name] = [{None: "", 0: "no", 1: "yes"}[value] for value in columns[name]]
    table["units"] = [UNITS[value] for value in columns["metric"]]
    table["key_step"] = [index + 1 for index in columns["key_step"]]
    drawn = run_map(columns)
    numbers = {name: [_short(value) for value in table[name]] for name in NUMBERS}
    numbers |= {"map_x": [_short(x) for x in drawn.x], "map_y": [_short(y) for y in drawn.y]}
    answer = {
        "version": version,
        "files": list(columns["file"]),
        "texts": {name: _coded(table[name]) for name in (*TEXTS, *ANSWERS, "units")},
        "labels": _coded(columns["labels"]),
        "notes": dict(notes),
        "numbers": numbers,
        "axes": [drawn.x_words, drawn.y_words],
    }
    return json.dumps(answer, separators=(",", ":"), allow_nan=False)


def _coded(values: Sequence[Any]) -> dict[str, list[Any]]:
    codes: dict[str, int] = {}
    numbers = [codes.setdefault(value or "", len(codes)) for value in values]
    return {"values": list(codes), "codes": numbers}


def _short(value: float | None) -> float | None:
    if value is None or not isfinite(value):
        return None
    if isinstance(value, int) or value == int(value):
        return int(value)
    return float(f"{value:.{DIGITS}g}")


def _seconds(created: str) -> float | None:
    try:
        return int(datetime.fromisoformat(created).timestamp())
    except ValueError:
        return None
