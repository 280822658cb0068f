"""Several estimators and sequences side by side: one table, and a picture of each sequence with all trajectories."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from spherloc.errors import InputError, reason
from spherloc.experiments.configuration import Configuration
from spherloc.experiments.results import SequenceResults
from spherloc.experiments.summary import SuccessRate, Summary, summarize
from spherloc.experiments.sweep_rows import csv_line
from spherloc_viz.layers.primitives import Table
from spherloc_viz.sweep import text_of

TABLE, MARKDOWN = "comparison.csv", "comparison.md"
NONE = "–"


@dataclass(frozen=True)
class Compared:
    """A sequence as one estimator localized it."""

    label: str
    """Of the estimator with its options."""
    results: SequenceResults
    """Of all queries that are done."""
    summary: Summary
    """Of these."""


def compared(label: str, results: SequenceResults) -> Compared:
    """The results with their summary."""
    return Compared(label, results, summarize(results))


def write_comparison(folder: Path, found: Sequence[Compared]) -> str:
    """Write the table (CSV and Markdown) and a picture a sequence to a folder; gives the table as text for people.

    Raises ``InputError`` if they cannot be written.
    """
    from spherloc_viz.plots import trajectories_png

    table = comparison_table(found)
    files = {
        TABLE: "".join(csv_line(line) for line in (table.columns, *table.rows)).encode(),
        MARKDOWN: markdown(table).encode(),
    }
    names = list(dict.fromkeys(item.results.configuration.name for item in found))
    for name in names:
        of_scene = [(item.label, item.results) for item in found if item.results.configuration.name == name]
        files[f"{re.sub(r'[^A-Za-z0-9-]+', '_', name).strip('_') or 'scene'}.png"] = trajectories_png(of_scene)
    for name, content in files.items():
        try:
            folder.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)
        except OSError as error:
            raise InputError(f"{folder / name}: cannot be written ({reason(error)}); give another --output.") from None
    return "\n".join([text_of(table), f"written to {folder}: {', '.join(files)}"])


def comparison_table(found: Sequence[Compared]) -> Table:
    """A row for each sequence and estimator. Limits are those of the sequence's scene."""
    columns = (
        "scene", "estimator", "localized", "doubtful", "no pose", "success within the limits (%)", "limits",
        "rotation error", "position error", "precision / recall / F1 (%)", "time",
    )  # fmt: skip
    return Table("localize", columns, tuple(_row(item) for item in found))


def _row(item: Compared) -> tuple[str, ...]:
    told = item.summary
    rates = told.success or told.registration_success
    scores = (told.median_precision, told.median_recall, told.median_f1)
    return (
        item.results.configuration.name,
        item.label,
        f"{told.localized} of {told.done}",
        str(told.doubtful),
        str(told.failed),
        " / ".join(NONE if rate.rate is None else f"{100 * rate.rate:.1f}" for rate in rates) or NONE,
        " / ".join(_limit(rate, item.results.configuration.unit) for rate in rates) or NONE,
        _quantity(told.median_rotation_error_deg, 1.0, "deg"),
        _length(told.median_translation_error_m, item.results.configuration),
        " / ".join(NONE if score is None else f"{100 * score:.1f}" for score in scores),
        _quantity(told.median_estimating_ms, 1.0, "ms"),
    )


def _limit(rate: SuccessRate, unit: str) -> str:
    return f"{rate.metres:g} {unit}" if rate.degrees is None else f"{rate.metres:g} {unit} {rate.degrees:g}°"


def _length(value: float | None, setting: Configuration) -> str:
    return NONE if value is None else setting.length(value)


def _quantity(value: float | None, factor: float, unit: str) -> str:
    return NONE if value is None else f"{factor * value:.3g} {unit}"


def markdown(table: Table) -> str:
    """The table in Markdown."""
    lines = [table.columns, ["---"] * len(table.columns), *table.rows]
    return "".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |\n" for line in lines)
