"""Writes a run as one ``.rrd`` file that any Rerun viewer opens."""

import contextlib
import re
import uuid
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from rerun.chunk import Chunk, LazyChunkStream

from spherloc.diagnosis import Diagnosis, diagnose
from spherloc.errors import RecordingError
from spherloc.metrics import evaluate
from spherloc.trace import Trace
from spherloc_viz.layers import paint, steps
from spherloc_viz.layers.key_step import key_step, step_numbers
from spherloc_viz.layers.outcome import outcome_table
from spherloc_viz.layers.primitives import Picture, StepHeading
from spherloc_viz.recording.content.columns import markdown, static_chunk
from spherloc_viz.recording.content.components import image_chunks, query_image, thumbnail
from spherloc_viz.recording.content.data import data_chunk, numbers_chunk
from spherloc_viz.recording.content.drawing import drawing_chunks
from spherloc_viz.recording.content.layout import append, layout_file, shown_in
from spherloc_viz.recording.content.names import APPLICATION_ID
from spherloc_viz.recording.content.panels import Panels, panel_chunks, panels_of
from spherloc_viz.recording.content.properties import property_chunks
from spherloc_viz.recording.content.texts import outcome_text
from spherloc_viz.recording.origin import Origin
from spherloc_viz.recording.run_row import RunRow
from spherloc_viz.recording.run_summary import run_row
from spherloc_viz.recording.storage.unfinished import unfinished

EXPLAINING = frozenset(
    {
        *("bearings", "match", "gravity", "unknowns", "yaw-pair", "yaw-roots", "balls-pair"),
        *("clique-greedy-smallest", "clique-greedy-degree"),
        *("refinement-inliers", "refinement-outliers", "refinement-error"),
    }
)
"""Keys of steps that explain the method, as the candidate yaws do: the page shows them, and a full recording."""

_DISK = re.compile(r"([^:(]+) \(os error \d+\)")
"""How rerun tells of what a disk cannot do."""


def write_recording(
    trace: Trace,
    path: Path,
    origin: Origin | None = None,
    diagnosis: Diagnosis | None = None,
    full: bool = False,
    run_id: str | None = None,
) -> RunRow:
    """Write the recording of a run to ``path``, whose folder is made if it is missing, and return its row.

    A run that was not diagnosed is diagnosed here. ``full`` keeps every step, and every array of the stages; ``run_id``
    is the recording's id in Rerun, a new one if it is not given.
    A reader never sees half a file: it is written under another name and then moved.
    Raises ``RecordingError`` if that fails, and then leaves nothing behind.
    """
    path = Path(path)
    part = unfinished(path)
    run = _Run(
        trace, origin or Origin(), diagnosis or diagnose(trace), full, datetime.now(UTC), run_id or str(uuid.uuid4())
    )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        row = _write(run, part, path.name)
        part.replace(path)
    except OSError as error:
        raise _no_room(path, error.strerror or str(error)) from error
    except (RuntimeError, ValueError) as error:
        reason = _DISK.search(str(error))
        if reason is not None:
            raise _no_room(path, reason[1].strip()) from error
        raise RecordingError(f"{path}: the run cannot be recorded, since rerun failed: {error}.") from error
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
    return row


def _no_room(path: Path, reason: str) -> RecordingError:
    return RecordingError(f"{path}: the run cannot be recorded ({reason}); make room or choose another folder.")


@dataclass(frozen=True, eq=False)
class _Run:
    """What is recorded."""

    trace: Trace
    origin: Origin
    diagnosis: Diagnosis
    full: bool
    created: datetime
    recording_id: str


def recorded_steps(headings: Sequence[StepHeading], key: int) -> list[int]:
    """The steps that a lean recording shows: what each stage came to, and the key step.

    Left out is what explains the method, alike in every run, and series: steps whose keys differ in a number only, as
    "yaw-arcs-10" and "yaw-arcs-30" do, more and more arcs until the step "yaw-arcs" has them all. Of a series without
    such a step there is the last. The samples of RANSAC are all there. Between two steps a viewer shows the earlier.
    """
    keys = {heading.key for heading in headings}
    last: dict[str, int] = {}
    for index, heading in enumerate(headings):
        series = heading.key if heading.key.startswith("sample-") else re.sub(r"-\d+$", "", heading.key)
        explains = (
            heading.key in EXPLAINING or heading.key.endswith("-pose") or heading.key.startswith("yaw-candidate-")
        )
        if not explains and (series == heading.key or series not in keys):
            last[series] = index
    return sorted({key, *last.values()})


def _write(run: _Run, part: Path, file: str) -> RunRow:
    """Write the recording to ``part`` and return its row, for the name that the ``file`` is to have."""
    trace, metrics = run.trace, evaluate(run.trace)
    headings, key = steps(trace), key_step(trace, run.diagnosis)
    row = run_row(
        trace,
        metrics,
        run.diagnosis,
        run.origin,
        run.created,
        file=file,
        run_id=run.recording_id,
        steps=len(headings),
        key_step=key,
        thumbnail=thumbnail(trace),
    )
    chosen = list(range(len(headings))) if run.full else recorded_steps(headings, key)
    pictures = {index: paint(trace, index) for index in chosen}
    end = max(chosen)
    pictures[end] = replace(pictures[end], tables=(*pictures[end].tables, outcome_table(trace)))
    panels = panels_of(trace)
    layout = layout_file(shown_in(list(pictures.values()), panels))
    stream = LazyChunkStream.from_iter(list(_chunks(run, row, pictures, panels)))
    stream.write_rrd(part, application_id=APPLICATION_ID, recording_id=run.recording_id)
    return replace(row, size_bytes=append(part, layout))


def _chunks(run: _Run, row: RunRow, pictures: Mapping[int, Picture], panels: Panels) -> Iterator[Chunk]:
    trace, image = run.trace, query_image(run.trace.problem)
    yield from property_chunks(trace, row, run.created)
    yield data_chunk(trace, run.origin, run.diagnosis, run.full)
    yield numbers_chunk(step_numbers(trace, pictures))
    yield from drawing_chunks(pictures, image.scale * trace.problem.pixels)
    yield from image_chunks(trace.problem, image)
    yield from panel_chunks(trace, panels)
    tables = pictures[max(pictures)].tables
    text = outcome_text(row, run.diagnosis, run.origin.story, image.remark, tables)
    yield static_chunk("/outcome", markdown([text]))
