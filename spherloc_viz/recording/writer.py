"""Writes a run as one ``.rrd`` file that any Rerun viewer opens."""

import contextlib
import re
import subprocess
import tempfile
import time
import uuid
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import rerun as rr
from rerun.chunk import Chunk, LazyChunkStream

from spherloc.errors import RecordingError
from spherloc.metrics import evaluate
from spherloc.trace import Trace
from spherloc_viz.layers import paint, steps
from spherloc_viz.layers.primitives import Picture
from spherloc_viz.recording.data import data_chunks
from spherloc_viz.recording.drawing import drawing_chunks
from spherloc_viz.recording.layout import APPLICATION_ID, chart_labels, layout_file, table_names, with_layout
from spherloc_viz.recording.markdown import outcome_text
from spherloc_viz.recording.properties import outcome, property_chunks

STALE_AFTER_S = 600.0
"""An unfinished file this old belongs to a process that was killed."""

_PART = re.compile(r".+\.rrd\.[0-9a-f]{8}\.part")


def write_recording(trace: Trace, path: Path) -> Path:
    """Write the recording of a run to ``path`` and return it; the folder is made if it is missing.

    A reader never sees half a file: it is written under another name and then moved.
    Raises ``RecordingError`` if that fails, and then leaves nothing behind.
    """
    path = Path(path)
    part = path.with_name(f"{path.name}.{uuid.uuid4().hex[:8]}.part")
    pictures = [paint(trace, index) for index in range(len(steps(trace)))]
    try:
        content = _content(trace, pictures)
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
    return path


def _content(trace: Trace, pictures: list[Picture]) -> bytes:
    with tempfile.TemporaryDirectory(prefix="spherloc-") as folder:
        path = Path(folder) / "run.rrd"
        stream = LazyChunkStream.from_iter(_chunks(trace, pictures))
        stream.write_rrd(path, application_id=APPLICATION_ID, recording_id=str(uuid.uuid4()))
        return with_layout(path, layout_file(chart_labels(pictures), table_names(pictures)))


def _chunks(trace: Trace, pictures: list[Picture]) -> Iterator[Chunk]:
    metrics = evaluate(trace)
    yield from property_chunks(trace, metrics, datetime.now(UTC))
    yield from data_chunks(trace)
    yield from drawing_chunks(pictures)
    text = outcome_text(trace.message, outcome(metrics), pictures[-1].tables)
    document = rr.TextDocument.columns(text=[text], media_type=[rr.MediaType.MARKDOWN])
    yield Chunk.from_columns("/outcome", [], document)


def sweep(folder: Path) -> None:
    """Delete unfinished recordings that killed processes left in ``folder``."""
    with contextlib.suppress(OSError):
        for path in folder.iterdir():
            if _PART.fullmatch(path.name) and time.time() - path.stat().st_mtime > STALE_AFTER_S:
                path.unlink()
