"""Lists of runs as text: a table for people, JSON and CSV for programs."""

import contextlib
import csv
import io
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from spherloc_viz.options import json_text
from spherloc_viz.recording.run_row import RunRow

WIDTH = 112
"""Characters of a line of the table; only the name of a file may be longer."""
GAP = "  "
MIN_WIDTH = 8
"""Characters that a column which must give way keeps."""
_GIVE_WAY = ("Run", "Diagnosis", "Estimator")
"""Columns that are cut where the line is too long, in this order."""
_FORMULA = ("=", "+", "-", "@", "\t", "\r")


def rows_text(folder: Path, rows: Sequence[RunRow], form: str) -> str:
    """Runs as "table", "json" or "csv"; each line ends with a newline, and without runs a table is empty."""
    if form == "json":
        return json_lines([_plain(row) for row in rows])
    if form == "csv":
        names = [item.name for item in fields(RunRow) if item.name != "thumbnail"]
        return csv_text([_plain(row) for row in rows], names)
    if not rows:
        return ""
    lines = _table(_COLUMNS, [{name: one_line(cell(row)) for name, (cell, _) in _COLUMNS.items()} for row in rows])
    return "".join(f"{line}\n" for line in [lines[0], *_with_files(folder, rows, lines[1:])])


def counts_text(by: str, counts: Sequence[tuple[str, int]], form: str) -> str:
    """How many runs have each value, as "table", "json" or "csv"."""
    tables = [{by: value, "runs": count} for value, count in counts]
    if form == "json":
        return json_lines(tables)
    if form == "csv":
        return csv_text(tables, [by, "runs"])
    width = max((len(one_line(value)) for value, _ in counts), default=0)
    total = sum(count for _, count in counts)
    return "".join(
        f"{one_line(value) or '(none)':<{max(width, 6)}}{GAP}{count:>7,}{GAP}{count / total:>6.1%}\n"
        for value, count in counts
    )


def json_lines(tables: Sequence[Mapping[str, Any]]) -> str:
    """An array with one object a line; infinity is the text "inf"."""
    return "[\n" + ",\n".join(map(json_text, tables)) + "\n]\n"


def csv_text(tables: Sequence[Mapping[str, Any]], names: Sequence[str]) -> str:
    """Columns of these names; no text is a formula to a spreadsheet."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(names)
    writer.writerows([_cell(table[name]) for name in names] for table in tables)
    return text.getvalue()


def _cell(value: Any) -> Any:
    if isinstance(value, dict):
        return json_text(value)
    if isinstance(value, list):
        value = "; ".join(value)
    if not isinstance(value, str):
        return "" if value is None else value
    text = one_line(value)
    # A spreadsheet would run it as a formula.
    return f"'{text}" if text.startswith(_FORMULA) else text


def _plain(row: RunRow) -> dict[str, Any]:
    """All of a run but its picture."""
    table = asdict(row) | {"labels": list(row.labels), "key_step": row.key_step + 1}
    del table["thumbnail"]
    # Of a recording that somebody else wrote it may be anything.
    with contextlib.suppress(ValueError, RecursionError):
        options = json.loads(row.options, parse_constant=str)
        if isinstance(options, dict) and not any(isinstance(value, dict | list) for value in options.values()):
            table["options"] = options
    return table


def one_line(text: str) -> str:
    """Without what would move a terminal's cursor or fool the eye."""
    return " ".join("".join(character if character.isprintable() else " " for character in text).split())


def number_text(value: float | None) -> str:
    """An error as people read it; "-" if it is unknown."""
    if value is None:
        return "-"
    return f"{value:.3f}" if value < 10.0 else f"{value:.1f}" if value < 1e5 else f"{value:.0e}"


def _position_error(row: RunRow) -> str:
    """Metres; those of a map whose units are unknown say so."""
    text = number_text(row.translation_error_m)
    return text if row.metric is not False or row.translation_error_m is None else f"{text} {row.unit}"


_COLUMNS: dict[str, tuple[Callable[[RunRow], str], str]] = {
    "Run": (lambda row: row.title or row.name, "<"),
    "Estimator": (lambda row: row.estimator, "<"),
    "Outcome": (lambda row: row.outcome, "<"),
    "Diagnosis": (lambda row: row.diagnosis or "-", "<"),
    "Inliers": (lambda row: f"{row.inliers}/{row.correspondences}", ">"),
    "Outliers": (lambda row: "-" if row.outlier_rate is None else f"{100 * row.outlier_rate:.0f} %", ">"),
    "deg off": (lambda row: number_text(row.rotation_error_deg), ">"),
    "m off": (_position_error, ">"),
    "ms": (lambda row: f"{row.time_ms:.0f}", ">"),
}


def _table(columns: Mapping[str, tuple[Any, str]], rows: Sequence[Mapping[str, str]]) -> list[str]:
    """A heading and a line a row, aligned, and cut to the width where that must be."""
    widths = {name: max(len(name), *(len(row[name]) for row in rows)) for name in columns}
    excess = sum(widths.values()) + len(GAP) * (len(widths) - 1) - WIDTH
    for name in _GIVE_WAY:
        less = max(0, min(excess, widths[name] - max(MIN_WIDTH, len(name))))
        widths[name] -= less
        excess -= less
    heads = {name: name for name in columns}
    return [
        GAP.join(f"{_cut(row[name], width):{columns[name][1]}{width}}" for name, width in widths.items()).rstrip()
        for row in [heads, *rows]
    ]


def _cut(text: str, width: int) -> str:
    """The text, or its beginning and its end, where names of one scene differ."""
    if len(text) <= width:
        return text
    end = (width - 1) // 2
    return f"{text[: width - 1 - end]}…{text[-end:]}"


def _with_files(folder: Path, rows: Sequence[RunRow], lines: Sequence[str]) -> list[str]:
    """Below each line the file, as the other commands take it, its labels, and the start of its note."""
    told: list[str] = []
    for row, line in zip(rows, lines, strict=True):
        labels = "".join(f" [{one_line(label)}]" for label in row.labels)
        note = f" {one_line(row.note)}" if row.note else ""
        path = f"    {one_line(str(folder / row.file))}"
        rest = _cut(labels + note, max(0, WIDTH - len(path))) if len(path) < WIDTH - MIN_WIDTH else ""
        told += [line, path + rest]
        if labels and not rest:
            told.append(f"    {_cut((labels + note).strip(), WIDTH - 4)}")
    return told
