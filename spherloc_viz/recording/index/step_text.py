"""Steps that were found in recordings, as text: a table for people, JSON and CSV for programs."""

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from spherloc_viz.recording.index.catalog import StepFound
from spherloc_viz.recording.index.run_text import csv_text, json_lines, number_text, one_line
from spherloc_viz.recording.index.step_condition import RUN_COLUMNS, STEP_COLUMNS


def steps_text(folder: Path, found: Sequence[StepFound], form: str) -> str:
    """Steps as a table below each run, or as JSON or CSV with a row a step."""
    if form == "table":
        return "".join(_run(folder, list(steps)) for _, steps in groupby(found, lambda step: step.run.file))
    tables = [_plain(step) for step in found]
    return json_lines(tables) if form == "json" else csv_text(tables, ["file", *STEP_COLUMNS, *RUN_COLUMNS])


def _plain(found: StepFound) -> dict[str, Any]:
    step = {name: getattr(found, name) for name in STEP_COLUMNS}
    return {"file": found.run.file} | step | {name: getattr(found.run, name) for name in RUN_COLUMNS}


def _run(folder: Path, found: Sequence[StepFound]) -> str:
    run = found[0].run
    told = f"{run.title or run.name}, {run.estimator}: {run.outcome}, {run.diagnosis or 'not diagnosed'}"
    lines = [one_line(told), f"    {one_line(str(folder / run.file))}"]
    for step in found:
        mark = "  <- key step" if step.step == run.key_step else ""
        off = f"{number_text(step.rotation_error_deg):>8} deg {number_text(step.position_error_m):>8} m"
        where = f"step {step.step:>3} of {run.steps:<3} {one_line(step.stage):<14.14} {one_line(step.key):<24.24}"
        lines.append(f"    {where} {step.agreeing:>5} agree {off}{mark}")
    return "".join(f"{line}\n" for line in lines)
