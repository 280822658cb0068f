"""Questions about single steps over many runs, answered by rerun's catalog of the recordings themselves."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import pyarrow as pa

from spherloc.errors import InputError, RecordingError, show
from spherloc.registry import require
from spherloc_viz.recording.content.names import NUMBERS
from spherloc_viz.recording.index.run_text import csv_text, json_lines, number_text, one_line
from spherloc_viz.recording.run_row import COUNTED_FROM_1, STORED_AS, RunRow

STEP_COLUMNS = {
    "step": pa.int64(),
    "stage": pa.string(),
    "key": pa.string(),
    "agreeing": pa.int64(),
    "rotation_error_deg": pa.float64(),
    "position_error_m": pa.float64(),
}
"""What is known of a step: its number from 1, the stage that it belongs to, its name within that, matches that agree,
and how far its pose is off."""
RUN_COLUMNS = {
    "created": pa.string(),
    "source": pa.string(),
    "scene": pa.string(),
    "name": pa.string(),
    "estimator": pa.string(),
    "seed": pa.int64(),
    "outcome": pa.string(),
    "diagnosis": pa.string(),
    "doubtful": pa.bool_(),
    "correspondences": pa.int64(),
    "inliers": pa.int64(),
    "outlier_rate": pa.float64(),
    "steps": pa.int64(),
    "key_step": pa.int64(),
    "time_ms": pa.float64(),
}
"""What is known of its run."""
COLUMNS = STEP_COLUMNS | RUN_COLUMNS
WORDS = ("and", "or", "not", "in", "is", "null", "between", "like", "true", "false")
"""All of SQL that a condition may say: no word that reads a file, names a table, or asks a second question."""
MAX_CHARACTERS = 1_000
MAX_PARENTHESES = 50

_PIECE = re.compile(
    r"\s+|(?P<word>[A-Za-z_]\w*)|(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)(?![\w.])|(?P<text>'(?:[^']|'')*')"
    r"|<=|>=|<>|!=|[<>=+\-*/%(),]",
    re.ASCII,
)


def checked_condition(text: str) -> str:
    """The condition, if it compares columns, numbers and texts and does nothing else.

    Raises ``InputError``, which says what cannot be understood and what there is.
    """
    if len(text) > MAX_CHARACTERS or text.count("(") > MAX_PARENTHESES:
        raise InputError(
            f"a condition may have {MAX_CHARACTERS:,} characters and {MAX_PARENTHESES} parentheses: shorten it."
        )
    pieces: list[str] = []
    place = 0
    while place < len(text):
        piece = _PIECE.match(text, place)
        if piece is None:
            raise InputError(
                f"the condition cannot be understood at {show(text[place : place + 20])}: "
                "give one such as position_error_m < 0.1 AND stage = 'Refinement'."
            )
        word = piece["word"]
        if word is not None and word not in COLUMNS and word.lower() not in WORDS:
            raise InputError(f"unknown column {show(word)}: a condition knows {', '.join(COLUMNS)}.")
        # Two minus signs would begin a comment.
        pieces.append(" - " if piece[0] == "-" else " / " if piece[0] == "/" else piece[0])
        place = piece.end()
    if not text.strip():
        raise InputError("the condition is empty: give one such as position_error_m < 0.1 AND stage = 'Refinement'.")
    return "".join(pieces)


FIRST_VERSION = 2
"""Recordings of this format and later have numbers for every step."""
_RENAMED = {"position_error_m": "translation_error_m"} | STORED_AS
"""What a condition calls differently than a recording."""
_RUN, _FORMAT = "rerun_segment_id", "format_version"


@dataclass(frozen=True)
class StepFound:
    """A step that a condition holds for."""

    run: RunRow
    step: int
    """Its number, from 1."""
    stage: str
    """Named stage."""
    key: str
    """Which step of it."""
    agreeing: int
    """Matches that it shows as agreeing."""
    rotation_error_deg: float | None
    """Rotation error of the step's pose; None if it has no pose or the truth is unknown."""
    position_error_m: float | None
    """Likewise, metres."""


@dataclass(frozen=True)
class Steps:
    """What was found."""

    found: tuple[StepFound, ...]
    """The newest run first."""
    refused: tuple[str, ...]
    """Files that the catalog cannot have beside the others."""


def find_steps(folder: Path, rows: Sequence[RunRow], condition: str, limit: int | None = None) -> Steps:
    """The steps of some runs of a folder for which a condition in SQL holds.

    ``rows`` are runs as the index of the folder lists them, so that their files are known to be sound. The condition
    is one of ``checked_condition``; nothing else of SQL is run. Raises ``InputError`` if it cannot be understood or
    the catalog is not installed, ``RecordingError`` if the recordings cannot be read.
    """
    checked = checked_condition(condition)
    known = {row.run_id: row for row in reversed(rows) if row.format_version >= FIRST_VERSION}
    require("datafusion", "catalog", "asking about steps")
    from rerun.server import Server

    if not known:
        return Steps((), ())
    files = [str(folder / row.file) for row in known.values()]
    try:
        # Only for this machine; by default others could read the recordings.
        with Server(host="127.0.0.1", datasets={"runs": files}) as server:
            client = server.client()  # kept, since tables know their catalog only as long as it lives
            runs = client.get_dataset("runs")
            taken = set(runs.segment_ids())
            found = _filtered(_frame(runs), checked, limit) if taken else []
    except (OSError, ValueError, RuntimeError, ConnectionError) as error:
        raise RecordingError(f"{folder}: rerun's catalog cannot read the recordings ({_first_line(error)}).") from error
    steps = tuple(StepFound(known[row.pop(_RUN)], **{name: row[name] for name in STEP_COLUMNS}) for row in found)
    return Steps(steps, tuple(row.file for row in known.values() if row.run_id not in taken))


def _frame(dataset: Any) -> Any:
    """A table with a row a step, and what is known of its run beside it."""
    from datafusion import col, lit

    # A column that is empty in one recording would else be missing for all.
    steps = dataset.filter_contents([NUMBERS]).reader(index="step", include_semantically_empty_columns=True)
    runs = dataset.segment_table()
    of_step = [_first(steps, f"{NUMBERS}:{_RENAMED.get(name, name)}", name) for name in STEP_COLUMNS if name != "step"]
    names = {**RUN_COLUMNS, _FORMAT: pa.int64()}
    of_run = [_first(runs, f"property:run:{_RENAMED.get(name, name)}", name) for name in names]
    steps = steps.select(col(_RUN), col("step"), *of_step)
    table = steps.join(runs.select(col(_RUN).alias("run"), *of_run), left_on=_RUN, right_on="run")
    # Recordings have the index of the key step, and timelines of older ones indices of all steps.
    table = table.with_column("key_step", col("key_step") + lit(1))
    older = (col(_FORMAT) < lit(COUNTED_FROM_1)).cast(pa.int64())
    return table.with_column("step", col("step") + older).drop(_FORMAT)


def _first(frame: Any, column: str, name: str) -> Any:
    """The single value in each cell; unknown where no recording has the column."""
    from datafusion import col, functions, lit

    if column not in frame.schema().names:
        return lit(None).cast(COLUMNS.get(name, pa.int64())).alias(name)
    return functions.array_element(col(f'"{column}"'), lit(1)).alias(name)


def _filtered(frame: Any, condition: str, limit: int | None) -> list[dict[str, Any]]:
    from datafusion import col

    try:
        found = frame.filter(frame.parse_sql_expr(condition))
        found = found.sort(col("created").sort(ascending=False), col(_RUN).sort(), col("step").sort())
        return (found if limit is None else found.limit(limit)).to_pylist()
    except Exception as error:  # DataFusion has no class of its own for errors in a condition
        raise InputError(
            f"the condition cannot be answered ({_first_line(error)}): compare columns with numbers, or with texts in "
            "single quotes."
        ) from error


def _first_line(error: Exception) -> str:
    # What has caused it comes last.
    text = str(error).rpartition("\ncaused by\n")[2].removeprefix("DataFusion error: ").strip()
    return text.splitlines()[0][:200].rstrip(".") if text else type(error).__name__


def steps_text(folder: Path, found: Sequence[StepFound], form: str) -> str:
    """Steps as a table below each run, or as JSON or CSV with a row a step."""
    if form == "table":
        return "".join(_run(folder, list(steps)) for _, steps in groupby(found, lambda step: step.run.file))
    tables = [_plain(step) for step in found]
    return json_lines(tables) if form == "json" else csv_text(tables, ["file", *STEP_COLUMNS, *RUN_COLUMNS])


def _plain(found: StepFound) -> dict[str, Any]:
    step = {name: getattr(found, name) for name in STEP_COLUMNS}
    run = {name: getattr(found.run, name) for name in RUN_COLUMNS}
    return {"file": found.run.file} | step | run | {"key_step": found.run.key_step + 1}


def _run(folder: Path, found: Sequence[StepFound]) -> str:
    run = found[0].run
    told = f"{run.title or run.name}, {run.estimator}: {run.outcome}, {run.diagnosis or 'not diagnosed'}"
    lines = [one_line(told), f"    {one_line(str(folder / run.file))}"]
    for step in found:
        mark = "  <- key step" if step.step == run.key_step + 1 else ""
        off = f"{number_text(step.rotation_error_deg):>8} deg {number_text(step.position_error_m):>8} m"
        where = f"step {step.step:>3} of {run.steps:<3} {one_line(step.stage):<14.14} {one_line(step.key):<24.24}"
        lines.append(f"    {where} {step.agreeing:>5} agree {off}{mark}")
    return "".join(f"{line}\n" for line in lines)
