"""A run as a recording gives it back."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from spherloc.diagnosis import Diagnosis
from spherloc.problem import Problem
from spherloc.trace import Certificate
from spherloc.types import BoolArray, FloatArray
from spherloc_viz.recording.origin import Origin
from spherloc_viz.recording.run_row import RunRow


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
    """The diagnosis of the run; None in recordings of format 1."""
    query_image: bytes | None
    """The query image as it is shown, a JPEG; None if there was none to be read."""
