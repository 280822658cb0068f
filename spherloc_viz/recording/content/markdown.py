"""Texts of a recording, as Markdown in which nothing that a scene file says can become markup."""

import re
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

from spherloc.diagnosis import Cause, Diagnosis
from spherloc_viz.layers.primitives import Step, Table
from spherloc_viz.recording.content.letters import legible
from spherloc_viz.recording.run_row import RunRow

_MARKUP = re.compile(r"([\\`*_{}\[\]<>#+\-!|~$&])")


@lru_cache(maxsize=2048)
def plain(text: str) -> str:
    """``text`` on one line, shown as it is, as far as the viewer has letters for it."""
    return _MARKUP.sub(r"\\\1", legible(" ".join(text.split())))


def step_text(step: Step) -> str:
    """Title, caption, equation and note of a step."""
    # Not as code, which the viewer does not wrap, and sets in a font that lacks some letters of mathematics.
    equation = "\n\n".join(f"**{plain(line)}**" for line in step.equation.splitlines() if line.strip())
    parts = (f"## {plain(step.title)}", plain(step.caption), equation, plain(step.note))
    return "\n\n".join(part for part in parts if part)


def table_text(table: Table) -> str:
    """A table with its name above it."""
    return f"### {plain(table.name)}\n\n{_rows(table.columns, table.rows)}"


def outcome_text(row: RunRow, diagnosis: Diagnosis, story: str, remark: str, tables: Sequence[Table]) -> str:
    """How a run ended and why: its story, verdict and message, the diagnosis, and the tables of its last step."""
    title = f"# {plain(row.title)}" if row.title else ""
    cause = f"## {plain(diagnosis.cause.value.capitalize())}" if diagnosis.cause is not Cause.OK else ""
    evidence = "\n".join(f"- {plain(sentence)}" for sentence in diagnosis.evidence)
    advice = f"**{plain(diagnosis.advice)}**" if diagnosis.advice else ""
    parts = [title, plain(story), f"## {row.outcome.capitalize()}", plain(row.message)]
    parts += [cause, plain(diagnosis.summary), evidence, advice, plain(remark)]
    parts += [_rows(table.columns, table.rows) for table in tables]
    return "\n\n".join(part for part in parts if part)


def _rows(columns: tuple[str, ...], rows: tuple[tuple[Any, ...], ...]) -> str:
    lines = ["---|" * len(columns) if row is None else _line(row) for row in (columns, None, *rows)]
    return "\n".join(f"|{line}" for line in lines)


def _line(row: tuple[Any, ...]) -> str:
    return "".join(f" {plain(_cell(value))} |" for value in row)


def _cell(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else "" if value is None else str(value)
