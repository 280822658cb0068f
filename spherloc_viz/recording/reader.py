"""Reads a recording back: the problem bit for bit, and what the run found."""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rerun.chunk import Chunk, LazyStore, RrdReader
from rerun.error_utils import RerunWarning

from spherloc.cameras.base import BoolArray, FloatArray
from spherloc.errors import InputError, RecordingError
from spherloc.problem import Problem
from spherloc.trace import Certificate
from spherloc_viz.recording.data import problem_from_row, read_row
from spherloc_viz.recording.layout import APPLICATION_ID
from spherloc_viz.recording.properties import FORMAT_VERSION, read_properties

STAGES = "/data/stages/"
PROPERTIES = "/__properties/run"


@dataclass(frozen=True, eq=False)
class RecordedRun:
    """A run as its recording has it."""

    properties: Mapping[str, Any]
    """What lists show: scene, name, estimator, seed, options and versions (JSON), outcome ("success", "failure" or
    "unknown"), message, errors (absent if unknown), inliers, correspondences, created (ISO, UTC), format_version; of
    runs with a certificate also upper_bound, lower_bound, proven and chance_sets."""
    problem: Problem
    """What was solved, equal to the original in every bit."""
    estimator: str
    """Registered name."""
    options: Mapping[str, Any]
    """Fields of the estimator's options."""
    seed: int
    """Seed of every random draw."""
    versions: Mapping[str, str]
    """Versions of spherloc, python and the numeric libraries that computed it."""
    timings_ms: Mapping[str, float]
    """Wall time a stage, and ``total``."""
    cam_from_map: FloatArray | None
    """Estimated pose (3, 4), or None."""
    inlier_mask: BoolArray
    """(N,) correspondences within the bound of the estimated pose."""
    message: str
    """The outcome in one sentence."""
    stages: Mapping[str, Mapping[str, Any]]
    """Fields of each stage by its kind; large arrays are left out, as they follow from the rest."""
    certificate: Certificate | None
    """What is proven about the consensus; None if nothing is, as in recordings older than certificates."""


def read_recording(path: Path) -> RecordedRun:
    """Read a recording that ``write_recording`` made.

    Raises ``RecordingError``, in one sentence, if there is no such file or it is not a whole recording of ours.
    """
    store = _open(Path(path))
    try:
        chunks = store.stream().filter(content=[PROPERTIES, "/data/**"]).to_chunks()
        return _run({chunk.entity_path: chunk for chunk in chunks}, str(path))
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        reason = "a part of the run is missing or has a wrong form"
        raise RecordingError(f"{path}: {reason} ({error}); record the run again.") from error
    except InputError as error:
        raise RecordingError(f"{path}: describes no problem that can be solved: {error}") from error


def check_recording(path: Path) -> None:
    """Raise ``RecordingError``, in one sentence, unless ``path`` is a whole recording of ours."""
    _open(Path(path))


def _open(path: Path) -> LazyStore:
    if not path.is_file():
        raise RecordingError(f"{path}: no such file; give the path of a recording (.rrd).")
    try:
        with warnings.catch_warnings():
            # rerun only warns where a file has no index at its end.
            warnings.simplefilter("error", RerunWarning)
            reader = RrdReader(path)
            entries = reader.recordings()
            store = next((reader.store(store=e) for e in entries if e.application_id == APPLICATION_ID), None)
    except (OSError, ValueError, RuntimeError, RerunWarning) as error:
        raise RecordingError(f"{path}: not a whole recording (.rrd); give one that spherloc wrote.") from error
    if store is None:
        raise RecordingError(f"{path}: a recording of another program; give one that spherloc wrote.")
    return store


def _run(chunks: Mapping[str, Chunk], where: str) -> RecordedRun:
    properties = read_properties(chunks[PROPERTIES])
    version = properties["format_version"]
    if version != FORMAT_VERSION:
        advice = f"this spherloc reads format {FORMAT_VERSION}; record the run again"
        raise RecordingError(f"{where}: has format {version}, and {advice}.")
    run = read_row(chunks["/data/run"])
    stages = {path[len(STAGES) :]: read_row(chunk) for path, chunk in chunks.items() if path.startswith(STAGES)}
    problem = problem_from_row(read_row(chunks["/data/problem"]), where)
    found = run.pop("certificate", None)
    certificate = None if found is None else Certificate(**found)
    return RecordedRun(properties=properties, problem=problem, stages=stages, certificate=certificate, **run)
