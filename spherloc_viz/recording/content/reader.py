"""Reads a recording back: the problem bit for bit, and what the run found."""

import contextlib
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rerun.chunk import Chunk, LazyStore, RrdReader, StoreEntry
from rerun.error_utils import RerunWarning

from spherloc.diagnosis import Diagnosis
from spherloc.errors import InputError, RecordingError, show
from spherloc.problem import Problem
from spherloc.trace import Certificate
from spherloc.types import BoolArray, FloatArray
from spherloc_viz.given_files import check_recording_file
from spherloc_viz.recording.content.data import (
    DATA,
    Row,
    certificate_from_row,
    diagnosis_from_row,
    origin_from_row,
    problem_from_row,
    read_rows,
)
from spherloc_viz.recording.content.properties import (
    APPLICATION_ID,
    FORMAT_VERSION,
    OLDEST_VERSION,
    QUERY_IMAGE,
    RUN_PROPERTY,
    THUMBNAIL_PROPERTY,
    read_image,
    read_properties,
    row_from_properties,
)
from spherloc_viz.recording.origin import Origin
from spherloc_viz.recording.reviews import read_review
from spherloc_viz.recording.run_row import RunRow

STAGES = "stages/"
PROPERTIES = f"/__properties/{RUN_PROPERTY}"
THUMBNAIL = f"/__properties/{THUMBNAIL_PROPERTY}"


@dataclass(frozen=True, eq=False)
class RecordedRun:
    """A run as its recording has it."""

    row: RunRow
    """What lists show."""
    properties: Mapping[str, Any]
    """The same as it is written, which queries of Rerun's catalog see, without what is unknown; beside it ``versions``
    (JSON) and, of runs with a certificate, upper_bound, lower_bound and chance_sets."""
    problem: Problem
    """What was solved, equal to the original in every bit."""
    estimator: str
    """Registered name."""
    options: Mapping[str, Any]
    """Fields of the estimator's options."""
    seed: int
    """Seed of every random draw."""
    versions: Mapping[str, str]
    """Versions of spherloc, python and the numeric libraries that computed it, and the machine."""
    timings_ms: Mapping[str, float]
    """Wall time a stage, and ``total``."""
    cam_from_map: FloatArray | None
    """Estimated pose (3, 4), or None."""
    inlier_mask: BoolArray
    """(N,) correspondences within the bound of the estimated pose."""
    message: str
    """The outcome in one sentence."""
    stages: Mapping[str, Mapping[str, Any]]
    """Fields of each stage by its kind; a lean recording has no large arrays, which follow from the rest."""
    certificate: Certificate | None
    """What is proven about the consensus; None if nothing is, as in recordings older than certificates."""
    origin: Origin | None
    """Where the run came from; None in recordings of format 1."""
    scene_text: str | None
    """The scene file as it was; None if there was none, or none of moderate size."""
    diagnosis: Diagnosis | None
    """What was wrong with it; None in recordings of format 1."""
    query_image: bytes | None
    """The query image as it is shown, a JPEG; None if there was none to be read."""


def read_recording(path: Path) -> RecordedRun:
    """Read a recording that ``write_recording`` made.

    Raises ``RecordingError``, in one sentence, if there is no such file or it is not a whole recording of ours.
    """
    path = Path(path)
    with _sentences(path):
        entry, chunks = _load(path, [PROPERTIES, THUMBNAIL, f"{DATA}/**", QUERY_IMAGE])
        return _run(path, entry, chunks)


def read_run_row(path: Path) -> RunRow:
    """What a list of runs shows about a recording, with its labels and note if it has some. Reads little of the file.

    Raises ``RecordingError`` as ``read_recording`` does.
    """
    path = Path(path)
    with _sentences(path):
        entry, chunks = _load(path, [PROPERTIES, THUMBNAIL])
        row = _row(path, entry, chunks)
    with contextlib.suppress(RecordingError):  # without labels a run is still a run
        review = read_review(path)
        row = replace(row, labels=review.labels, note=review.note)
    return row


def check_recording(path: Path) -> None:
    """Raise ``RecordingError``, in one sentence, unless ``path`` is a whole recording of ours."""
    _open(Path(path))


@contextlib.contextmanager
def _sentences(path: Path) -> Iterator[None]:
    """Whatever a file makes rerun or us stumble over, as a sentence."""
    try:
        yield
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, RuntimeError, OSError) as error:
        reason = "a part of the run is missing or has a wrong form"
        raise RecordingError(f"{path}: {reason} ({show(str(error))}); record the run again.") from error
    except InputError as error:
        raise RecordingError(f"{path}: describes no problem that can be solved: {error}") from error


def _open(path: Path) -> tuple[StoreEntry, LazyStore]:
    check_recording_file(path)
    try:
        with warnings.catch_warnings():
            # rerun only warns where a file has no index at its end.
            warnings.simplefilter("error", RerunWarning)
            reader = RrdReader(path)
            entry = next((e for e in reader.recordings() if e.application_id == APPLICATION_ID), None)
            store = None if entry is None else reader.store(store=entry)
    except (OSError, ValueError, RuntimeError, RerunWarning) as error:
        raise RecordingError(f"{path}: not a whole recording (.rrd); give one that spherloc wrote.") from error
    if entry is None or store is None:
        raise RecordingError(f"{path}: a recording of another program; give one that spherloc wrote.")
    return entry, store


def _load(path: Path, content: list[str]) -> tuple[StoreEntry, dict[str, Chunk]]:
    """Some chunks of a recording by their entities, if it has a format that we know."""
    entry, store = _open(path)
    chunks = {chunk.entity_path: chunk for chunk in store.stream().filter(content=content).to_chunks()}
    version = read_properties(chunks[PROPERTIES])["format_version"]
    if version not in range(OLDEST_VERSION, FORMAT_VERSION + 1):
        advice = f"this spherloc reads formats up to {FORMAT_VERSION}; install the one that wrote it"
        raise RecordingError(f"{path}: has format {version}, and {advice}.")
    return entry, chunks


def _row(path: Path, entry: StoreEntry, chunks: Mapping[str, Chunk]) -> RunRow:
    thumbnail = read_image(chunks[THUMBNAIL]) if THUMBNAIL in chunks else b""
    return row_from_properties(
        read_properties(chunks[PROPERTIES]),
        file=path.name,
        run_id=entry.recording_id,
        size_bytes=path.stat().st_size,
        thumbnail=thumbnail,
    )


def _run(path: Path, entry: StoreEntry, chunks: Mapping[str, Chunk]) -> RecordedRun:
    rows: dict[str, Row] = {}
    for name, chunk in chunks.items():
        if name == DATA or name.startswith(f"{DATA}/"):
            rows |= read_rows(chunk)
    run, told = rows["run"], rows.get("diagnosis")
    found = run.pop("certificate", None)
    origin, scene = origin_from_row(rows["origin"]) if "origin" in rows else (None, None)
    return RecordedRun(
        row=_row(path, entry, chunks),
        properties=read_properties(chunks[PROPERTIES]),
        problem=problem_from_row(rows["problem"], str(path)),
        stages={name[len(STAGES) :]: row for name, row in rows.items() if name.startswith(STAGES)},
        certificate=None if found is None else certificate_from_row(found),
        origin=origin,
        scene_text=scene,
        diagnosis=None if told is None else diagnosis_from_row(told),
        query_image=read_image(chunks[QUERY_IMAGE]) if QUERY_IMAGE in chunks else None,
        **run,
    )
