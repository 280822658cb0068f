"""What a recording says in words: texts in Markdown, in letters that the Rerun viewer has."""

import re
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

from spherloc.diagnosis import Cause, Diagnosis
from spherloc_viz.layers.primitives import Step, Table
from spherloc_viz.recording.run_row import RunRow

DRAWN = (
    "\n\x20-\x7e\xa0-\u0148\u014a-\u01c3\u01c5-\u031e\u0384-\u038a\u038e-\u03a1\u03a3-\u03e1\u03f0-\u049d\u04a0-\u04ff"
    "\u1d4f\u2010-\u2027\u202f-\u205e\u2070\u2071\u2074-\u208e\u2090-\u209c\u20a0-\u20bf\u2190-\u2199\u21d0\u21d2\u21d4"
    "\u2202\u2205\u2206\u220f\u2211\u2212\u221a\u221e\u222b\u2248\u2260\u2264\u2265"
)
"""Ranges of what its font, Inter, has of Latin, Greek and Cyrillic letters and of signs."""
INSTEAD = str.maketrans({"ᵀ": "^T", "∝": "~", "∈": "in"})
"""What our own words have beside those."""
UNKNOWN = "?"

_OTHERS = re.compile(f"[^{DRAWN}]")


def legible(text: str) -> str:
    """The text with a question mark for every letter that the viewer's font lacks."""
    return _OTHERS.sub(UNKNOWN, text.translate(INSTEAD))


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
