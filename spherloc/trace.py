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
    """Algorithm 1: the hypotheses that improved on the best one so far. J of them."""

    kind = "ransac"
    iterations: int
    """Samples drawn."""
    confidence_reached: float
    """Probability by Eq. 28 that one of them held inliers of the last hypothesis only; what an early test may have lost
    is taken off."""
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
    """Algorithm 2, lines 3-13: one arc of feasible yaw a root and pair, and where most of them overlap.

    A arcs; the yaw is the one of the gravity-aligned frames. Arc ends satisfy -pi <= lo < pi and
    lo <= hi <= lo + 2 pi, so an arc with hi > pi wraps.
    """

    kind = "yaw"
    pairs_total: int
    """Pairs of usable correspondences, K."""
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
    """The interval covered most often."""
    yaw_rad: float
    """Its middle: the estimated yaw."""
    clique: IndexArray
    """Indices of the arcs that cover ``yaw_rad``: the maximum clique of the rotation graph (Eq. 37)."""


@dataclass(frozen=True, eq=False)
class TranslationStage(Stage):
    """Algorithm 2, lines 14-23: one ball of feasible camera positions a pair, and their maximum clique.

    M balls, in the gravity-aligned map frame.
    """

    kind = "translation"
    candidates: int
    """Pairs in the rotation clique, before thinning."""
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
    """Arcs of feasible yaw of all pairs."""
    seed_support: int
    """Correspondences that the first guess explained: cliques must be larger to be looked for."""
    bound: IndexArray
    """(1440,) no pose with a yaw in that quarter of a degree explains more correspondences, from -pi upwards."""
    effort: int
    """Words of bitsets that the clique searches touched, all together."""
    finished: bool
    """False if the search ran out of its budget, so that ``bound`` is larger than it might be."""
    yaw_rad: float
    """Yaw of the best pose."""
    clique: IndexArray
    """The largest clique found: (S,) indices of correspondences in the problem. Larger than the best support if no
    pose explains all of it."""
    cam_from_map: FloatArray
    """(C, 3, 4) poses that were verified, best first, the best of every clearly different one."""
    support: IndexArray
    """(C,) correspondences that each of them explains."""


@dataclass(frozen=True, eq=False)
class PositionStage(Stage):
    """The search over camera positions: boxes that could hold a better pose than the best one, and so were split.

    B boxes, by level; corners in the gravity-aligned map frame.
    """

    kind = "positions"
    boxes_m: NDArray[np.float32]
    """(B, 2, 3) lower and upper corners, metres. Of a level with many boxes those that might explain most."""
    level: IndexArray
    """(B,) how often the first box, which holds the map, was halved to get each; ascending."""
    bound: IndexArray
    """(B,) no camera in that box explains more, at any yaw and any tilt within the gravity bound."""
    left: IndexArray
    """(B,) boxes of the same level that were split."""
    support: int
    """What the best pose explains."""
    upper_bound: int
    """What no pose explains more than, after the search."""


@dataclass(frozen=True, eq=False)
class DecisionStage(Stage):
    """Which estimator was chosen for this problem, and why."""

    kind = "decision"
    chosen: str
    """Registered name."""
    reason: str
    """A sentence with this problem's numbers."""
    samples: int
    """Pairs that the probe sampled."""
    inlier_rate: float
    """Share of the correspondences that the probe's best pose explains."""


@dataclass(frozen=True, eq=False)
class RefinementStage(Stage):
    """Gauss-Newton on the sphere. I + 1 states, the first one being the initial pose, the last one the result."""

    kind = "refinement"
    dof: int
    """6, or 4 (yaw and translation) where gravity is exact or, unknown, too few inliers would fix all six."""
    cam_from_map: FloatArray
    """(I + 1, 3, 4) poses."""
    cost_px2: FloatArray
    """(I + 1,) mean squared residual of the last state's inliers at each state, px^2."""
    inlier_counts: IndexArray
    """(I + 1,) correspondences at each state within the bound by which the last one's inliers were chosen."""
    covariance: FloatArray
    """(6, 6) of the last pose's error, given its inliers: first the rotation vector w, rad, in the problem's camera
    frame (true R = Exp(w) R), then the camera's position, m, in the problem's map frame (true C = C + error). Roll and
    pitch have no variance where gravity is exact, so that it is singular there. NaN where inliers and gravity do not
    determine the pose."""
    gravity_sd_rad: float
    """Standard deviation of each tilt that weighed the given gravity: 0 kept it, inf ignored it."""
    tilt_rad: float
    """Angle between the given gravity and that of the last pose."""


@dataclass(frozen=True)
class Certificate:
    """What is proven about the consensus of a run.

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
        """How many more correspondences a better pose could explain."""
        return self.upper_bound - self.lower_bound

    @property
    def proven(self) -> bool:
        """Whether no pose explains more than the one that was found."""
        return self.gap <= 0


@dataclass(frozen=True, eq=False)
class Trace:
    """Everything about one run. N correspondences."""

    problem: Problem
    """What was solved."""
    estimator: str
    """Registered name."""
    options: Any
    """The estimator's frozen options dataclass, resolved: what really was used."""
    seed: int
    """Seed of every random draw."""
    versions: Mapping[str, str]
    """Versions of spherloc, python and the numeric libraries."""
    stages: tuple[Stage, ...]
    """In the order in which they ran."""
    timings_ms: Mapping[str, float]
    """Wall time a stage, and ``total``."""
    cam_from_map: FloatArray | None
    """Estimated pose (3, 4), or None if the data allow none."""
    inlier_mask: BoolArray
    """(N,) correspondences within the bound of the estimated pose."""
    message: str
    """The outcome in one sentence."""
    certificate: Certificate | None = None
    """What is proven about the consensus; None if the estimator proves nothing."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "versions", MappingProxyType(dict(self.versions)))
        object.__setattr__(self, "timings_ms", MappingProxyType(dict(self.timings_ms)))
        for array in (self.cam_from_map, self.inlier_mask):
            if array is not None:
                array.setflags(write=False)

    def __repr__(self) -> str:
        return f"<Trace of {self.estimator} on {show(self.problem.name)}: {self.message}>"

    def _repr_html_(self) -> str:
        """What notebooks show: a table with a row a stage."""
        rows = [("problem", self.problem.name), ("estimator", f"{self.estimator}, seed {self.seed}")]
        rows += [(f"stage {number}", stage.kind) for number, stage in enumerate(self.stages, 1)]
        rows += [("outcome", self.message), ("time", f"{self.timings_ms['total']:.1f} ms")]
        cells = (f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in rows)
        return f"<table>{''.join(cells)}</table>"

    def stage(self, kind: type[StageT]) -> StageT | None:
        """The stage of that type, or None if the run did not reach it."""
        return next((stage for stage in self.stages if isinstance(stage, kind)), None)
