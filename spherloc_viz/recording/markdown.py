"""Texts of a recording, as Markdown in which nothing that a scene file says can become markup."""

import re
from collections.abc import Sequence
from typing import Any

from spherloc_viz.layers.primitives import Step, Table

_MARKUP = re.compile(r"([\\`*_{}\[\]<>#+\-!|~$&])")


def plain(text: str) -> str:
    """``text`` on one line, shown as it is."""
    return _MARKUP.sub(r"\\\1", " ".join(text.split()))


def step_text(step: Step) -> str:
    """Title, caption, equation and note of a step."""
    # Not as code, which the viewer does not wrap, and sets in a font that lacks some letters of mathematics.
    equation = "\n\n".join(f"**{plain(line)}**" for line in step.equation.splitlines() if line.strip())
    parts = (f"## {plain(step.title)}", plain(step.caption), equation, plain(step.note))
    return "\n\n".join(part for part in parts if part)


def table_text(table: Table) -> str:
    """A table with its name above it."""
    return f"### {plain(table.name)}\n\n{_rows(table.columns, table.rows)}"


def outcome_text(message: str, outcome: str, tables: Sequence[Table]) -> str:
    """How a run ended: its message and the tables of its last step."""
    parts = (f"## {outcome.capitalize()}", plain(message), *(_rows(table.columns, table.rows) for table in tables))
    return "\n\n".join(parts)


def _rows(columns: tuple[str, ...], rows: tuple[tuple[Any, ...], ...]) -> str:
    lines = ["---|" * len(columns) if row is None else _line(row) for row in (columns, None, *rows)]
    return "\n".join(f"|{line}" for line in lines)


def _line(row: tuple[Any, ...]) -> str:
    return "".join(f" {plain(_cell(value))} |" for value in row)


def _cell(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else "" if value is None else str(value)
