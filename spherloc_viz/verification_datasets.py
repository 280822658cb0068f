"""Tables II to V of the paper, on a user's copy of the datasets."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from spherloc.errors import InputError, reason
from spherloc.experiments.summary import Summary, summarize
from spherloc.files import is_file
from spherloc.verification.printed import printed_findings
from spherloc.verification.sessions import (
    DATASETS,
    TABLE_METHODS,
    Dataset,
    Session,
    iterations,
    printed_tables,
    sessions_of,
)
from spherloc_viz.localize import Solving, localized
from spherloc_viz.progress import say

EPRO_WORDS = (
    "EPro-PnP learns weights of the matches, which are not published for these features: R+EPro and EPro here are its "
    "solver with equal weights, and EProPNP alone has no counterpart.\n"
)
TABLES_HEAD = """\
# Tables I to VI

As printed in the paper; below each of those on real images, what your copy of the dataset gives by the same methods, by
one command. Numbers of iterations: 2P100, SVD100, ML100 and all R+* of Tables II to V draw 100 samples, 2P1k 1,000; in
Table VI 2P10k, SVD10k, ML10k and R+* draw 10,000; MC draws none. That one command fills these tables is shown by
[rendered copies of the three datasets](applications.md).
"""


@dataclass(frozen=True)
class SessionResult:
    """A session as one method localized it."""

    dataset: str
    """Key of the dataset."""
    session: str
    """As the paper's tables have it."""
    method: str
    """Key of ``TABLE_METHODS``."""
    summary: Summary
    """Of its queries."""


def run_sessions(folders: Mapping[str, Path], output: Path, quick: bool) -> list[SessionResult]:
    """Localize every session of the datasets in ``folders`` (by key) by every method; what is done is not done again.

    Scene files and results go to ``output``; a scene file that is there already stays, so that it can say what a copy
    of a dataset has elsewhere. Raises ``InputError`` for a folder that is not the dataset's.
    """
    todo = [
        (dataset, session)
        for dataset in DATASETS
        if dataset.key in folders
        for session in sessions_of(dataset, folders[dataset.key])
    ]
    found: list[SessionResult] = []
    for dataset, session in todo:
        say(f"{dataset.title}, {session.name}")
        found += _session(dataset, session, output, quick)
    return found


def _session(dataset: Dataset, session: Session, output: Path, quick: bool) -> list[SessionResult]:
    folder = output / f"{dataset.key}_{session.name}"
    scene = folder / "scene.toml"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not is_file(scene):
            scene.write_text(session.scene, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{scene}: cannot be written ({reason(error)}); give another --output.") from None
    solvings = []
    for name in dataset.methods:
        entrant = TABLE_METHODS[name]
        settings = tuple(f"{key}={str(value).lower()}" for key, value in entrant.changes)
        solvings.append(Solving(entrant.estimator, settings, folder / name, None))
    results, _ = localized(scene, solvings, 0, ("0:10",) if quick else (), False)
    return [
        SessionResult(dataset.key, session.name, name, summarize(found))
        for name, found in zip(dataset.methods, results, strict=True)
    ]


def tables_text(found: Sequence[SessionResult]) -> str:
    """Markdown of the paper's tables as printed, each with what was measured here below it, or how to."""
    parts = [TABLES_HEAD]
    for key, table in printed_tables().items():
        limits = f" ({table['limits']})" if "limits" in table else ""
        parts.append(f"## {table['title']}{limits}\n")
        parts.append(_markdown(table["columns"], table["rows"]))
        dataset = table.get("dataset")
        if dataset is None:
            continue
        ours = [item for item in found if item.dataset == dataset]
        if ours:
            parts.append("Here:\n")
            parts.append(measured_table(ours))
        else:
            parts.append(
                f"Here: data needed. `spherloc verify --{dataset} DIR` adds the table of your copy, with the same "
                "methods.\n"
            )
        if key in ("table4", "table5"):
            parts.append(EPRO_WORDS)
    parts.append(_statements())
    return "\n".join(parts)


def _statements() -> str:
    """What the paper's text says of its tables, each with a verdict."""
    lines = ["## What the text says of the tables\n", "| where | sentence | printed | verdict |", "|---|---|---|---|"]
    for statement, holds, ours in printed_findings():
        verdict = "the table says so" if holds else "**the table does not**"
        lines.append(f"| {statement.place} | {statement.sentence} | {ours} | {verdict} |")
    return "\n".join(lines) + "\n"


def measured_table(found: Sequence[SessionResult]) -> str:
    """Markdown of what was measured."""
    return _markdown(*_measured(found))


def _measured(found: Sequence[SessionResult]) -> tuple[list[str], list[list[str]]]:
    columns = ["session", "method", "iterations", "queries", "success (%)", "time (s)", "recall", "precision", "F1"]
    rows = []
    for item in found:
        told = item.summary
        rates = told.registration_success or told.success
        scores = (told.median_recall, told.median_precision, told.median_f1)
        rows.append(
            [
                item.session,
                item.method,
                iterations(TABLE_METHODS[item.method]),
                str(told.done),
                " / ".join("–" if rate.rate is None else f"{100 * rate.rate:.1f}" for rate in rates) or "–",
                "–" if told.median_estimating_ms is None else f"{1e-3 * told.median_estimating_ms:.4f}",
                *("–" if score is None else f"{100 * score:.2f}" for score in scores),
            ]
        )
    return columns, rows


def _markdown(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [columns, ["---"] * len(columns), *rows]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)
