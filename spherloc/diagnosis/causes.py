"""What can be wrong with a run, and the record of what was found."""

from dataclasses import dataclass
from enum import StrEnum

from spherloc.cameras.base import FloatArray


class Cause(StrEnum):
    """Why a run failed or is doubtful; what each means is in docs of ``spherloc.diagnosis``."""

    OK = "ok"
    TOO_FEW_INLIERS = "too few inliers"
    FALSE_CONSENSUS = "larger false consensus"
    WRONG_REFERENCE = "wrong reference image"
    GRAVITY_OFF = "gravity prior off"
    BOUND_TOO_SMALL = "noise bound too small"
    DEGENERATE = "degenerate geometry"
    ITERATIONS_RAN_OUT = "iterations ran out"
    AMBIGUOUS = "ambiguous"


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """The cause that explains a run best, and why."""

    cause: Cause
    """What it is."""
    doubtful: bool
    """False only if the run looks right."""
    summary: str
    """One sentence."""
    evidence: tuple[str, ...]
    """Sentences with this run's numbers."""
    advice: str
    """What to do."""
    used_truth: bool
    """Whether the true pose or true labels were looked at."""
    rival_cam_from_map: FloatArray | None = None
    """Another pose (3, 4) to look at beside the run's own: the second one where two are ambiguous, the better or the
    true one where it is known; else None."""
