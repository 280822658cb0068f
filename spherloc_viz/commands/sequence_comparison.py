"""The table and the pictures in which ``spherloc localize`` compares estimators and sequences."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING

from spherloc.errors import InputError, reason
from spherloc.experiments.configuration import Configuration
from spherloc.experiments.results import SequenceResults
from spherloc.experiments.summary import SuccessRate, Summary
from spherloc.experiments.sweep_rows import csv_line
from spherloc_viz.commands.sweep import text_of
from spherloc_viz.layers.primitives import Table

if TYPE_CHECKING:
    from spherloc_viz.plots.trajectories import Backdrop

TABLE, MARKDOWN = "comparison.csv", "comparison.md"
NONE = "–"


@dataclass(frozen=True)
class Compared:
    """The results of one estimator for a sequence."""

    label: str
    """Name of the estimator with its options."""
    results: SequenceResults
    """Results of all finished queries."""
    summary: Summary
    """Summary of these results."""
    backdrop: "Backdrop"
    """What the picture shows of the sequence's map."""


def write_comparison(folder: Path, found: Sequence[Compared]) -> str:
    """Write the table (CSV and Markdown) and a picture of each sequence to a folder; returns the table as text.

    Raises ``InputError`` if they cannot be written.
    """
    from spherloc_viz.plots.trajectories import trajectories_png

    table = comparison_table(found)
    files = {
        TABLE: "".join(csv_line(line) for line in (table.columns, *table.rows)).encode(),
        MARKDOWN: markdown(table).encode(),
    }
    scenes: dict[str, list[Compared]] = {}  # by the path: two can have one name
    for item in found:
        scenes.setdefault(item.results.configuration.scene, []).append(item)
    for of_scene in scenes.values():
        name = re.sub(r"[^A-Za-z0-9-]+", "_", of_scene[0].results.configuration.name).strip("_") or "scene"
        numbered = chain([f"{name}.png"], (f"{name}_{number}.png" for number in count(2)))
        picture = trajectories_png([(item.label, item.results) for item in of_scene], of_scene[0].backdrop)
        files[next(file for file in numbered if file not in files)] = picture
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
        _quantity(told.median_rotation_error_deg, "deg"),
        _length(told.median_translation_error_m, item.results.configuration),
        " / ".join(NONE if score is None else f"{100 * score:.1f}" for score in scores),
        _quantity(told.median_estimating_ms, "ms"),
    )


def _limit(rate: SuccessRate, unit: str) -> str:
    return f"{rate.metres:g} {unit}" if rate.degrees is None else f"{rate.metres:g} {unit} {rate.degrees:g}°"


def _length(value: float | None, setting: Configuration) -> str:
    return NONE if value is None else setting.length(value)


def _quantity(value: float | None, unit: str) -> str:
    return NONE if value is None else f"{value:.3g} {unit}"


def markdown(table: Table) -> str:
    """The table in Markdown."""
    lines = [table.columns, ["---"] * len(table.columns), *table.rows]
    return "".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |\n" for line in lines)
