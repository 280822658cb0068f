"""One run, one frozen ``Trace``: what an estimator computed at every stage, and nothing to draw."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from html import escape
from types import MappingProxyType
from typing import Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from spherloc.errors import show
from spherloc.problem import Problem
from spherloc.types import BoolArray, FloatArray, IndexArray

StageT = TypeVar("StageT", bound="Stage")


@dataclass(frozen=True, eq=False)
class Stage:
    """Base of every stage. Arrays become read-only."""

    kind: ClassVar[str]

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, np.ndarray):
                value.setflags(write=False)


@dataclass(frozen=True, eq=False)
class RansacStage(Stage):
    """Algorithm 1: the J hypotheses that were better than the best one before."""

    kind = "ransac"
    iterations: int
    """Number of samples drawn."""
    confidence_reached: float
    """Probability by Eq. 28 that one of them had only inliers of the last hypothesis; the probability that an early
    test rejected it is subtracted."""
    improved_at: IndexArray
    """(J,) iteration of each improvement."""
    samples: IndexArray
    """(J, n) indices of the sampled correspondences in the problem; n is 2 for 2P."""
    cam_from_map: FloatArray
    """(J, 3, 4) hypotheses."""
    inlier_masks: BoolArray
    """(J, N) correspondences within the bound."""
    locally_optimized: BoolArray
    """(J,) true where the hypothesis is a fit to the inliers of the one before it, whose iteration and sample it has;
    false where it is the pose of its sample."""


@dataclass(frozen=True, eq=False)
class YawStage(Stage):
    """Algorithm 2, lines 3-13: an arc of feasible yaw for each root of each pair, and where most of them overlap.

    A arcs; yaw is that between the aligned frames. Arc ends satisfy -pi <= lo < pi and
    lo <= hi <= lo + 2 pi, so an arc with hi > pi wraps.
    """

    kind = "yaw"
    pairs_total: int
    """Number of pairs of usable correspondences, K."""
    rule: str
    """The rule by which arcs were left out, in words."""
    pairs: IndexArray
    """(A, 2) indices of the arc's two correspondences in the problem."""
    lo_rad: FloatArray
    """(A,) lower ends."""
    hi_rad: FloatArray
    """(A,) upper ends."""
    overlap: IndexArray
    """(1440,) the most arcs that cover any one yaw in each quarter of a degree, from -pi upwards."""
    best_rad: tuple[float, float]
    """The interval that most arcs cover."""
    yaw_rad: float
    """The middle of that interval: the estimated yaw."""
    clique: IndexArray
    """Indices of the arcs that cover ``yaw_rad``: the maximum clique of the rotation graph (Eq. 37)."""


@dataclass(frozen=True, eq=False)
class TranslationStage(Stage):
    """Algorithm 2, lines 14-23: a ball of feasible camera positions for each pair, and the maximum clique of the balls.

    M balls, in the aligned map frame.
    """

    kind = "translation"
    candidates: int
    """Number of pairs in the rotation clique, before some are left out."""
    rule: str
    """The rule by which candidates became balls, in words with this run's numbers."""
    pairs: IndexArray
    """(M, 2) indices of the ball's two correspondences in the problem."""
    centres_m: FloatArray
    """(M, 3) camera positions in the aligned map frame."""
    radii_m: FloatArray
    """(M,) radii."""
    edges: IndexArray
    """(E, 2) overlapping balls (Eq. 38), each pair in ascending order and the pairs sorted."""
    clique: IndexArray
    """Indices of the balls in the maximum clique."""
    proven: bool
    """Whether the clique was proven to be maximum (false if the search reached its limit)."""
    cam_from_map: FloatArray
    """(3, 4) pose from the yaw and the clique, before refinement."""


@dataclass(frozen=True, eq=False)
class ConsensusStage(Stage):
    """Exact consensus: correspondences are nodes, and a pair is an edge where one of its arcs covers the yaw.

    The consensus set of any pose is a clique of the graph at its yaw, so the largest clique bounds every consensus.
    """

    kind = "consensus"
    arcs: int
    """Number of arcs of feasible yaw of all pairs."""
    seed_support: int
    """Number of correspondences that the first pose explained: only larger cliques are searched for."""
    bound: IndexArray
    """(1440,) no pose with a yaw in that quarter of a degree explains more correspondences, from -pi upwards."""
    effort: int
    """Number of 64-bit words of bitsets that all clique searches used together."""
    finished: bool
    """False if the search ended at its budget, so that ``bound`` may be larger than necessary."""
    yaw_rad: float
    """Yaw of the best pose."""
    clique: IndexArray
    """The largest clique found: (S,) indices of correspondences in the problem. Larger than the best support if no
    pose explains all of it."""
    cam_from_map: FloatArray
    """(C, 3, 4) verified poses, best first; of poses that are not clearly different only the best."""
    support: IndexArray
    """(C,) number of correspondences that each of them explains."""


@dataclass(frozen=True, eq=False)
class PositionStage(Stage):
    """The search over camera positions: boxes that might hold a better pose than the best one and were therefore split.

    B boxes, by level; corners in the aligned map frame.
    """

    kind = "positions"
    boxes_m: NDArray[np.float32]
    """(B, 2, 3) lower and upper corners, metres; of a level with many boxes only those with the largest bounds."""
    level: IndexArray
    """(B,) how often the first box, which holds the map, was halved to get each box; ascending."""
    bound: IndexArray
    """(B,) upper bound on the correspondences that a camera in the box explains, at any yaw and any tilt within the
    gravity bound."""
    left: IndexArray
    """(B,) number of boxes of the same level that were split."""
    support: int
    """Number of correspondences that the best pose explains."""
    upper_bound: int
    """Largest number of correspondences that any pose explains, as proven by the search."""


@dataclass(frozen=True, eq=False)
class DecisionStage(Stage):
    """Which estimator was chosen for this problem, and why."""

    kind = "decision"
    chosen: str
    """Registered name of the chosen estimator."""
    reason: str
    """A sentence with this problem's numbers."""
    samples: int
    """Number of pairs that the trial before the choice sampled."""
    inlier_rate: float
    """Share of the correspondences that the best pose of that trial explains."""


@dataclass(frozen=True, eq=False)
class RefinementStage(Stage):
    """Gauss-Newton on the sphere: I + 1 states, from the initial pose to the result."""

    kind = "refinement"
    dof: int
    """6, or 4 (yaw and translation) where gravity is exact or, unknown, too few inliers would fix all six."""
    cam_from_map: FloatArray
    """(I + 1, 3, 4) poses."""
    cost_px2: FloatArray
    """(I + 1,) mean squared residual of the last state's inliers at each state, px^2."""
    inlier_counts: IndexArray
    """(I + 1,) number of correspondences at each state within the bound by which the last inliers were chosen."""
    covariance: FloatArray
    """Covariance (6, 6) of the last pose's error, given its inliers: first the rotation vector w, rad, in the problem's
    camera frame (true R = Exp(w) R), then the camera's position, m, in the problem's map frame (true C = C + error).
    Roll and pitch have no variance where gravity is exact, so that it is singular there. NaN where inliers and gravity
    do not
    determine the pose."""
    gravity_sd_rad: float
    """Standard deviation of each tilt by which the given gravity was weighted: 0 kept it, inf ignored it."""
    tilt_rad: float
    """Angle between the given gravity and that of the last pose."""

    @property
    def expected_errors(self) -> tuple[float, float] | None:
        """Root mean square of the angle (degrees) and of the distance (m) by which the last pose is off; None if
        unknown."""
        variance = np.diagonal(self.covariance)
        if not np.isfinite(variance).all():
            return None
        return float(np.degrees(np.sqrt(variance[:3].sum()))), float(np.sqrt(variance[3:].sum()))


@dataclass(frozen=True)
class Certificate:
    """Proven bounds on the consensus of a run.

    Both bounds count correspondences within the noise bound at a pose whose tilt is within the gravity bound.
    """

    upper_bound: int
    """No pose explains more correspondences."""
    lower_bound: int
    """Some pose explains as many."""
    nfa: float
    """Expected number of sets of ``lower_bound`` outliers that agree with some pose by chance. If it is not far below
    1, no method can know the answer."""

    @property
    def gap(self) -> int:
        """Number of further correspondences that another pose might explain."""
        return self.upper_bound - self.lower_bound

    @property
    def proven(self) -> bool:
        """Whether no pose explains more than the one that was found."""
        return self.gap <= 0


@dataclass(frozen=True, eq=False)
class Trace:
    """Everything about one run with N correspondences."""

    problem: Problem
    """The problem that was solved."""
    estimator: str
    """Registered name of the estimator."""
    options: Any
    """The estimator's frozen options dataclass with the values that were really used."""
    seed: int
    """Seed of every random draw."""
    versions: Mapping[str, str]
    """Versions of spherloc, python and the numeric libraries."""
    stages: tuple[Stage, ...]
    """The stages in the order in which they ran."""
    timings_ms: Mapping[str, float]
    """Wall time of each stage, and ``total``."""
    cam_from_map: FloatArray | None
    """Estimated pose (3, 4); None if no pose was found."""
    inlier_mask: BoolArray
    """(N,) correspondences within the bound of the estimated pose."""
    message: str
    """The outcome in one sentence."""
    certificate: Certificate | None = None
    """Proven bounds on the consensus; None if the estimator proves nothing."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "versions", MappingProxyType(dict(self.versions)))
        object.__setattr__(self, "timings_ms", MappingProxyType(dict(self.timings_ms)))
        for array in (self.cam_from_map, self.inlier_mask):
            if array is not None:
                array.setflags(write=False)

    def __repr__(self) -> str:
        return f"<Trace of {self.estimator} on {show(self.problem.name)}: {self.message}>"

    def _repr_html_(self) -> str:
        """HTML for notebooks: a table with a row for each stage."""
        rows = [("problem", self.problem.name), ("estimator", f"{self.estimator}, seed {self.seed}")]
        rows += [(f"stage {number}", stage.kind) for number, stage in enumerate(self.stages, 1)]
        rows += [("outcome", self.message), ("time", f"{self.timings_ms['total']:.1f} ms")]
        cells = (f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in rows)
        return f"<table>{''.join(cells)}</table>"

    def stage(self, kind: type[StageT]) -> StageT | None:
        """The stage of that type, or None if the run did not reach it."""
        return next((stage for stage in self.stages if isinstance(stage, kind)), None)
