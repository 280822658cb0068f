"""The causes of failed and doubtful runs, and the result of a diagnosis."""

from dataclasses import dataclass
from enum import StrEnum

from spherloc.types import FloatArray


class Cause(StrEnum):
    """Why a run failed or is doubtful."""

    OK = "ok"
    """The pose explains more than chance and nothing speaks against it; if the truth is used: the pose is right."""
    TOO_FEW_INLIERS = "too few inliers"
    """So few matches are right that as many agree with some wrong pose by chance: no method can find the answer."""
    FALSE_CONSENSUS = "larger false consensus"
    """A wrong pose explains more matches than the true one, so that no method by consensus finds the true one. Without
    the truth: a second pose explains many of the matches that the best one does not explain, but fewer than that
    one; or what agrees lies on one thing in the view, and nothing else in it agrees."""
    WRONG_REFERENCE = "wrong reference image"
    """No match is right. Without the truth: no pose stands out, though there are so many matches that a right
    reference image would have given one."""
    MAP_TOO_SPARSE = "map too sparse"
    """The reference image is the right one, since many matches with it agree with one motion of the camera; but hardly
    any of them has a map point."""
    GRAVITY_OFF = "gravity prior off"
    """Gravity is off by more than its bound, or by more than the refinement allows for, and the effect in the image is
    larger than the noise bound."""
    BOUND_TOO_SMALL = "noise bound too small"
    """Many right matches are beyond the noise bound: within twice the bound there are at least 1.5 times as many."""
    BOUND_TOO_LARGE = "noise bound too large"
    """So many wrong matches are within the noise bound that no pose stands out; within a lower bound one does."""
    DEGENERATE = "degenerate geometry"
    """Enough matches agree, but they do not fix the pose to within the errors of a success."""
    ITERATIONS_RAN_OUT = "iterations ran out"
    """RANSAC drew too few samples to find the best pose; another run would find it."""
    AMBIGUOUS = "ambiguous"
    """Two clearly different poses explain (nearly) as many matches."""
    SEARCH_MISSED = "search missed the best pose"
    """A search without random samples ended at a pose that explains clearly fewer matches than another pose."""
    UNKNOWN = "unknown"
    """The pose is wrong, and no measurement shows why."""


@dataclass(frozen=True)
class Measures:
    """A run's evidence in numbers; None for a number that the run does not have."""

    residual_median: float | None = None
    """Median reprojection error of the inliers, in noise bounds (0 to 1)."""
    residual_p90: float | None = None
    """Their 90 % quantile, in noise bounds."""
    alternative_support: float | None = None
    """Support of the best clearly different pose, as a share of that of the best pose."""
    certificate_gap: float | None = None
    """Upper bound of the certificate minus the lower bound, as a share of the upper bound; 0 is a proof."""
    tilt_deg: float | None = None
    """Angle between the given gravity and that of the best pose that ignores the given one, degrees."""
    coverage: float | None = None
    """Share of the directions with matches, in 48 cells of the sphere, that have inliers too."""
    rotation_sd_deg: float | None = None
    """Standard deviation of the best pose's rotation in its worst direction, degrees."""
    position_sd_m: float | None = None
    """Standard deviation of its position in the worst direction, in the map's unit."""


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """The cause that explains a run best, and why."""

    cause: Cause
    """The cause."""
    doubtful: bool
    """False only if the run looks right."""
    summary: str
    """The diagnosis in one sentence."""
    evidence: tuple[str, ...]
    """Sentences with this run's numbers."""
    advice: str
    """What to do, in a sentence."""
    used_truth: bool
    """Whether the true pose or true labels were used."""
    alternative_cam_from_map: FloatArray | None = None
    """Another pose (3, 4) to look at beside the run's own: the second one where two are ambiguous, the better or the
    true one where it is known; else None."""
    measures: Measures = Measures()
    """The evidence in numbers."""
