"""What is said of a run without its pictures: the properties of its recording, and texts in Markdown.

Labels and a note lie in a second file beside it, ``<stem>.review.rrd``, with the same recording id: a chunk of the
property ``REVIEW_PROPERTY`` and, for people, a text document at ``REVIEW_ENTITY``. The layout has a view for it.
"""

import hashlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, fields
from datetime import datetime
from functools import lru_cache
from pathlib import Path
from typing import Any, cast, get_args, get_type_hints

import pyarrow as pa
import rerun as rr
from rerun.chunk import Chunk

from spherloc.datasets.variation import Variation
from spherloc.diagnosis import Cause, Diagnosis
from spherloc.metrics import Metrics
from spherloc.problem import Problem
from spherloc.trace import Trace
from spherloc_viz.layers.primitives import Step, Table
from spherloc_viz.options import json_text
from spherloc_viz.recording.content.columns import Values, encoded_image, static_chunk
from spherloc_viz.recording.origin import Origin
from spherloc_viz.recording.run_row import STORED_AS, RunRow

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


APPLICATION_ID = "spherloc"
"""What Rerun keeps our recordings, and their layout, apart from others by."""
FORMAT_VERSION = 4
"""Version of what is recorded and how. A reader opens this one and older ones."""
OLDEST_VERSION = 1

RUN_PROPERTY = "run"
"""Its row: see ``RunRow``."""
THUMBNAIL_PROPERTY = "thumbnail"
"""A small PNG."""
QUERY_IMAGE = "/query/image"
"""The query image, a JPEG."""
REVIEW_ENTITY = "/review"
"""Text document, Markdown, of labels and note, in the review file."""
REVIEW_PROPERTY = "review"
"""Property of the review file: ``labels``, a list of texts, and ``note``, a text."""

MAX_CHARACTERS = 2_000
"""Longest text in a row; a longer one is cut."""
NOT_RECORDED = {"file", "run_id", "labels", "note", "size_bytes", "thumbnail"}
"""Fields of a row that are not part of the property ``run``: they belong to the file or the review, or are a
picture."""

_KINDS: dict[type, pa.DataType] = {str: pa.utf8(), int: pa.int64(), float: pa.float64(), bool: pa.bool_()}
RUN_TYPES: dict[str, pa.DataType] = {
    STORED_AS.get(name, name): _KINDS[(get_args(hint) or (hint,))[0]]
    for name, hint in get_type_hints(RunRow).items()
    if name not in NOT_RECORDED
} | {"upper_bound": pa.int64(), "lower_bound": pa.int64(), "chance_sets": pa.float64(), "versions": pa.utf8()}
"""Columns of the property ``run`` and their types; the last four are the certificate's and JSON."""


def outcome(metrics: Metrics) -> str:
    """Success or failure by the limits of Sec. VI, or unknown where there is no truth to compare with."""
    return {True: "success", False: "failure", None: "unknown"}[metrics.success]


def problem_key(problem: Problem) -> str:
    """A hash of the numbers that an estimator sees: equal keys mean the same problem, whatever it is called."""
    told = hashlib.blake2b(digest_size=16)
    for array in (problem.pixels, problem.points, problem.gravity_camera, problem.gravity_map):
        told.update(array.tobytes())
    rest = [problem.gravity_bound_rad, problem.gravity_sd_rad, problem.bound_px, problem.estimated_outlier_rate]
    told.update(json_text([len(problem), problem.camera.to_dict(), *rest]).encode())
    return told.hexdigest()


def outlier_rate(problem: Problem) -> float | None:
    """Share of wrong correspondences: by their labels, else what the front end expects."""
    if problem.truth_inliers is None:
        return problem.estimated_outlier_rate
    return 1.0 - float(problem.truth_inliers.mean())


def run_row(
    trace: Trace, metrics: Metrics, diagnosis: Diagnosis, origin: Origin, created: datetime, **known: Any
) -> RunRow:
    """The row of a run; ``known`` are the fields that do not follow from it."""
    problem, certificate = trace.problem, trace.certificate
    return RunRow(
        created=created.isoformat(timespec="milliseconds"),
        source=origin.source,
        scene=_cut(problem.scene if origin.scene_path is None else Path(origin.scene_path).name),
        name=_cut(problem.name),
        query=_cut(problem.image.name) if origin.query is None and problem.image is not None else origin.query,
        estimator=trace.estimator,
        seed=trace.seed,
        options=json_text(asdict(trace.options)),
        problem_key=problem_key(problem),
        outcome=outcome(metrics),
        diagnosis=diagnosis.cause.value,
        doubtful=diagnosis.doubtful,
        summary=_cut(diagnosis.summary),
        message=_cut(trace.message),
        correspondences=len(problem),
        inliers=int(trace.inlier_mask.sum()),
        outlier_rate=outlier_rate(problem),
        rotation_error_deg=metrics.rotation_error_deg,
        translation_error_m=metrics.translation_error_m,
        time_ms=trace.timings_ms.get("total", 0.0),
        proven=None if certificate is None else certificate.proven,
        changes=_cut(changes_text(origin.variation)),
        metric=problem.metric,
        **asdict(diagnosis.measures),
        title=_cut(origin.title),
        format_version=FORMAT_VERSION,
        **known,
    )


def changes_text(variation: Variation) -> str:
    """What is changed of a scene, in a few words; edits of single matches are counted."""
    named = {"spoiled": variation.spoiled, "mended": variation.mended, "hidden": variation.hidden}
    values = (f"{name} {_short(value)}" for name, value in variation.simulation.items())
    return ", ".join([*values, *(f"{len(matches)} {name}" for name, matches in named.items() if matches)])


def _short(value: Any) -> str:
    if isinstance(value, tuple):
        return " ".join(map(_short, value))
    return Path(value).name if isinstance(value, str) else f"{value:.4g}" if isinstance(value, float) else str(value)


def _cut(text: str) -> str:
    return text if len(text) <= MAX_CHARACTERS else text[: MAX_CHARACTERS - 1] + "…"


def property_chunks(trace: Trace, row: RunRow, created: datetime) -> Iterator[Chunk]:
    """The properties ``run`` and ``thumbnail``, and the name and time that the Rerun viewer shows for the recording.

    Unknown values are absent, so that a query finds nulls. In ``options``, which is JSON, infinity is the text "inf".
    """
    kept = [item.name for item in fields(row) if item.name not in NOT_RECORDED]
    values = {STORED_AS.get(name, name): getattr(row, name) for name in kept}
    certificate = trace.certificate
    if certificate is not None:
        values["upper_bound"] = certificate.upper_bound
        values["lower_bound"] = certificate.lower_bound
        values["chance_sets"] = certificate.nfa
    values["versions"] = json.dumps(dict(trace.versions))
    yield static_chunk(f"/__properties/{RUN_PROPERTY}", _named(values))
    if row.thumbnail:
        yield static_chunk(f"/__properties/{THUMBNAIL_PROPERTY}", encoded_image(row.thumbnail, "image/png"))
    name = legible(" ".join(f"{row.name}, {trace.estimator}, seed {trace.seed}".split()))
    info = rr.archetypes.RecordingInfo
    start_ns = pa.array([int(created.timestamp() * 1e9)], pa.int64())
    columns = [Values(info.descriptor_name(), pa.array([name]), [1])]
    yield static_chunk("/__properties", [*columns, Values(info.descriptor_start_time(), start_ns, [1])])


def _named(values: Mapping[str, Any]) -> list[Values]:
    """Numbers and texts by name, as one row; what is None is left out."""
    return [
        Values(rr.ComponentDescriptor(name), pa.array([value], RUN_TYPES[name]), [1])
        for name, value in values.items()
        if value is not None
    ]


def read_properties(batch: pa.RecordBatch) -> dict[str, Any]:
    """The values of a chunk of ``property_chunks`` by name."""
    # Whole columns as Python's lists: three times as fast as a scalar of Arrow for each.
    cells = zip(batch.schema.names, (column.to_pylist()[0] for column in batch.columns), strict=True)
    return {name: cell[0] for name, cell in cells if isinstance(cell, list) and cell}


def read_image(batch: pa.RecordBatch) -> bytes:
    """The file in a chunk with an encoded image."""
    column = batch.column("EncodedImage:blob")
    return column[0].values[0].values.to_numpy(zero_copy_only=False).tobytes()


_EMPTY: Mapping[type, Any] = {str: "", int: 0, float: 0.0}
_FIELDS = tuple(
    (item.name, STORED_AS.get(item.name, item.name), get_args(item.type) or (cast(type, item.type),))
    for item in fields(RunRow)
    if item.name not in NOT_RECORDED
)
"""Fields of a row that are recorded: their names, those by which they are recorded, and their types."""


def row_from_properties(values: Mapping[str, Any], **known: Any) -> RunRow:
    """The row that a recording's properties say; what older ones lack is unknown.

    Raises ``TypeError`` for a value of a wrong type.
    """
    row: dict[str, Any] = dict(known)
    values = {"source": "unknown", **values}
    for name, stored_as, kinds in _FIELDS:
        if name in known:
            continue
        value = values.get(stored_as)
        if value is None:
            row[name] = None if type(None) in kinds else _EMPTY[kinds[0]]
        elif isinstance(value, kinds) or (float in kinds and isinstance(value, int)):
            row[name] = _cut(value) if isinstance(value, str) else value
        else:
            raise TypeError(f"{name} is of type {type(value).__name__}")
    return RunRow(**row)
