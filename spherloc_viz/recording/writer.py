"""Writes a run as one ``.rrd`` file that any Rerun viewer opens."""

import contextlib
import re
import subprocess
import tempfile
import time
import uuid
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import rerun as rr
from rerun.chunk import Chunk, LazyChunkStream

from spherloc.diagnosis import Diagnosis, diagnose
from spherloc.errors import RecordingError
from spherloc.metrics import evaluate
from spherloc.trace import Trace
from spherloc_viz.layers import paint, steps
from spherloc_viz.layers.decisive import decisive_step
from spherloc_viz.layers.primitives import Picture, Stop
from spherloc_viz.recording.data import data_chunks
from spherloc_viz.recording.drawing import drawing_chunks
from spherloc_viz.recording.layout import APPLICATION_ID, chart_labels, layout_file, table_names, with_layout
from spherloc_viz.recording.markdown import outcome_text
from spherloc_viz.recording.origin import Origin
from spherloc_viz.recording.properties import property_chunks, run_row
from spherloc_viz.recording.run_row import RunRow

STALE_AFTER_S = 600.0
"""An unfinished file this old belongs to a process that was killed."""

_PART = re.compile(r".+\.rrd\.[0-9a-f]{8}\.part")


def write_recording(
    trace: Trace, path: Path, origin: Origin | None = None, diagnosis: Diagnosis | None = None, full: bool = False
) -> RunRow:
    """Write the recording of a run to ``path``, whose folder is made if it is missing, and return its row.

    A run that was not diagnosed is diagnosed here. ``full`` keeps every array of the stages, arcs and edges too.
    A reader never sees half a file: it is written under another name and then moved.
    Raises ``RecordingError`` if that fails, and then leaves nothing behind.
    """
    path = Path(path)
    part = path.with_name(f"{path.name}.{uuid.uuid4().hex[:8]}.part")
    run = _Run(trace, origin or Origin(), diagnosis or diagnose(trace), full, datetime.now(UTC), str(uuid.uuid4()))
    try:
        row, content = _content(run, path.name)
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_bytes(content)
        part.replace(path)
    except OSError as error:
        reason = error.strerror or error
        raise RecordingError(
            f"{path}: the run cannot be recorded ({reason}); make room or choose another folder."
        ) from error
    except (RuntimeError, ValueError, subprocess.SubprocessError) as error:
        raise RecordingError(f"{path}: the run cannot be recorded, since rerun failed: {error}.") from error
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
    return replace(row, size_bytes=len(content))


@dataclass(frozen=True, eq=False)
class _Run:
    """What is recorded."""

    trace: Trace
    origin: Origin
    diagnosis: Diagnosis
    full: bool
    created: datetime
    recording_id: str


def recorded_steps(stops: Sequence[Stop]) -> list[int]:
    """The steps that a recording shows: all but those of a series, of which it has three.

    Series are steps whose keys differ in a number only, as "yaw-arcs-10" and "yaw-arcs-30" do. Of more and more arcs,
    balls or members of a clique, and of one peak after another, the first, the middle and the last say it all. The
    samples of RANSAC have no such order and are all there. Between two steps a viewer shows the earlier one.
    """
    series: dict[str, list[int]] = {}
    for index, stop in enumerate(stops):
        name = stop.key if stop.key.startswith("sample-") else re.sub(r"\d+$", "#", stop.key)
        series.setdefault(name, []).append(index)
    return sorted({own[k] for own in series.values() for k in (0, len(own) // 2, -1)})


def _content(run: _Run, file: str) -> tuple[RunRow, bytes]:
    """The row and the bytes of the file."""
    trace, metrics = run.trace, evaluate(run.trace)
    stops, decisive = steps(trace), decisive_step(trace, run.diagnosis)
    row = run_row(
        trace,
        metrics,
        run.diagnosis,
        run.origin,
        run.created,
        file=file,
        run_id=run.recording_id,
        steps=len(stops),
        decisive_step=decisive,
    )
    pictures = {index: paint(trace, index) for index in recorded_steps(stops)}
    with tempfile.TemporaryDirectory(prefix="spherloc-") as folder:
        path = Path(folder) / "run.rrd"
        shown = list(pictures.values())
        stream = LazyChunkStream.from_iter(_chunks(run, row, pictures))
        stream.write_rrd(path, application_id=APPLICATION_ID, recording_id=run.recording_id)
        return row, with_layout(path, layout_file(chart_labels(shown), table_names(shown)))


def _chunks(run: _Run, row: RunRow, pictures: Mapping[int, Picture]) -> Iterator[Chunk]:
    yield from property_chunks(run.trace, row, run.created)
    yield from data_chunks(run.trace, run.origin, run.diagnosis, run.full)
    yield from drawing_chunks(pictures)
    text = outcome_text(run.trace.message, row.outcome, pictures[max(pictures)].tables)
    document = rr.TextDocument.columns(text=[text], media_type=[rr.MediaType.MARKDOWN])
    yield Chunk.from_columns("/outcome", [], document)


def sweep(folder: Path) -> None:
    """Delete unfinished recordings that killed processes left in ``folder``."""
    with contextlib.suppress(OSError):
        for path in folder.iterdir():
            if _PART.fullmatch(path.name) and time.time() - path.stat().st_mtime > STALE_AFTER_S:
                path.unlink()
