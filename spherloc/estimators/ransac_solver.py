"""RANSAC around any solver of ``spherloc.solvers``: the baselines that the paper compares 2P with (Sec. VI).

Algorithm 1 with a 6-DoF solver in the place of 2P: sample, solve, count inliers, keep the best, refine. Gravity is not
used unless ``gravity_sd_deg`` asks the refinement to. P3P, which the paper does not compare with, is the solver that
needs fewest matches without gravity.

EPnP, oDLT and EPro-PnP are solvers of many matches, made for the image plane of a pinhole. P3P solves the samples, and
the solver in question all inliers of the best. They see the correspondences inside a rectified virtual camera only,
from sampling to refinement; those outside are lost to them and never count as inliers. The paper rectifies to a view
that it does not print and takes RANSAC "to remove outliers for them" (Sec. VI-C), as in OpenCV with EPnP for the
samples (``sampler=epnp``). With ``view_deg=360`` nothing is lost: the same algebra, with the equations of bearings.
Residuals and bounds stay those of the original pixels.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np

from spherloc.bounds import Bounds
from spherloc.errors import InputError, show
from spherloc.estimators.base import Clock, Estimate, check_positive, check_sampling, check_switches
from spherloc.last_step import conclude, conclude_as_printed
from spherloc.metrics import ransac_success_probability
from spherloc.problem import AlignedProblem
from spherloc.refine import RefinementOptions, inlier_counts, residuals_px
from spherloc.solvers.base import Solver, solve_each, solver_of
from spherloc.solvers.epnp import Epnp, VirtualPinhole
from spherloc.solvers.epnp_sphere import EpnpSphere
from spherloc.solvers.epropnp import EproPnp, EproPnpSphere
from spherloc.solvers.mlpnp import Mlpnp
from spherloc.solvers.odlt import Odlt, OdltSphere
from spherloc.solvers.p3p import P3p
from spherloc.solvers.svd import Svd
from spherloc.trace import RansacStage
from spherloc.types import BoolArray, FloatArray, IntArray
from spherloc.watch import Watch

MAX_ITERATIONS = 1_000_000
BATCH = 128
"""Samples that are solved at once."""
WHOLE_SPHERE_DEG = 360.0
PinholeSampler = Literal["p3p", "epnp"]


@dataclass(frozen=True)
class SolverRansacOptions(RefinementOptions):
    """Options of the baselines. The defaults search as the paper does, and end with this project's own last step."""

    bound_px: float = 8.0
    """Reprojection error up to which a correspondence is an inlier, px (8, as OpenCV's default and the paper's)."""
    iterations: int = 100
    """Samples drawn; with a confidence, the most that are drawn."""
    confidence: float | None = None
    """Stop as soon as Eq. 28 gives this probability of having drawn inliers only; without it all samples are drawn."""
    gravity_sd_deg: float | None = np.inf
    """Standard deviation of the known roll and pitch, degrees, for the refinement: inf ignores them, as the paper's
    baselines do; None takes the problem's."""
    local_optimization: bool = False
    """Fit all inliers of each improvement by the solver (P3P: by MLPnP), and keep that if it explains more."""
    as_printed: bool = False
    """Do what the paper prints, with none of what this estimator adds: the last step is one least-squares fit in 6 DoF
    to the inliers of the best pose (Algorithm 1, line 16)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(self)
        check_sampling(self, MAX_ITERATIONS)
        check_switches(self)


@dataclass(frozen=True)
class MlpnpRansacOptions(SolverRansacOptions):
    """Options of RANSAC around MLPnP."""

    covariances: bool = True
    """Weigh each match by the covariance of its bearing, which follows from the camera for pixels of equal noise; off,
    all bearings are equally uncertain."""


@dataclass(frozen=True)
class PinholeRansacOptions(SolverRansacOptions):
    """Options of RANSAC around a solver that was made for a pinhole."""

    view_deg: float = 174.0
    """Field of view of the rectified image, degrees, across its width and across its height, below 180; or 360 for the
    whole sphere, where the solver takes the equations of bearings and nothing is rectified or lost."""
    sampler: PinholeSampler = "p3p"
    """Solves the samples: "p3p", three matches, or "epnp", five matches, as in OpenCV's own RANSAC (not on the whole
    sphere)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (0.0 < self.view_deg < 180.0 or self.view_deg == WHOLE_SPHERE_DEG):
            raise InputError(f"option view_deg is {self.view_deg:g}; give degrees below 180, or 360 for the sphere.")
        if self.sampler not in get_args(PinholeSampler):
            raise InputError(
                f"option sampler is {show(self.sampler)}; give one of {', '.join(get_args(PinholeSampler))}."
            )
        if self.sampler == "epnp" and self.view_deg == WHOLE_SPHERE_DEG:
            raise InputError("option sampler is 'epnp', which samples on an image plane; give p3p for the sphere.")


@dataclass(frozen=True, eq=False)
class _View:
    """What a solver gets to see of the problem, V of its M usable correspondences."""

    seen: BoolArray
    """(M,)."""
    aligned: AlignedProblem
    """The V correspondences."""
    bounds: Bounds
    """Theirs."""
    bearings: FloatArray
    """(V, 3), camera frame: solvers see nothing that gravity has turned."""
    points: FloatArray
    """(V, 3), map frame."""
    pixel_from_bearing: FloatArray | None
    """(V, 2, 3), camera frame, where the solver takes covariances."""
    deg: float
    """Field of view, degrees."""


@dataclass(frozen=True, eq=False)
class _Hypothesis:
    """A pose that beat those before it, or the fit to all inliers of the last one."""

    iteration: int
    sample: IntArray
    cam_from_map: FloatArray
    """(3, 4), aligned frames."""
    mask: BoolArray
    """(V,)."""
    fitted: bool = False


@dataclass(frozen=True)
class SolverRansac:
    """An estimator that samples for one solver and may fit the inliers by another."""

    name: str
    """As it is registered."""
    sampler: Solver
    """Solves the samples."""
    fitter: Solver | None = None
    """Solves all inliers of the best hypothesis; None leaves that to the refinement, as Algorithm 1 does."""
    on_sphere: Solver | None = None
    """The fitter where the view is the whole sphere; None for a fitter or sampler that sees it anyway."""
    Options: Any = SolverRansacOptions

    def run(
        self, aligned: AlignedProblem, options: SolverRansacOptions, bounds: Bounds, seed: int, clock: Clock
    ) -> Estimate:
        """Algorithm 1."""
        if isinstance(options, PinholeRansacOptions):
            whole = options.view_deg == WHOLE_SPHERE_DEG
            sampler: Solver = Epnp() if options.sampler == "epnp" else P3p()
            chosen = replace(self, sampler=sampler, fitter=self.on_sphere if whole else self.fitter)
        else:
            chosen = self
        return chosen._run(aligned, options, bounds, seed, clock)

    def _run(
        self, aligned: AlignedProblem, options: SolverRansacOptions, bounds: Bounds, seed: int, clock: Clock
    ) -> Estimate:
        view = _view(aligned, bounds, options, self.sampler.pinhole)
        with clock.stage("ransac", until=0.99):
            drawn, found = self._search(view, options, np.random.default_rng(seed), clock.watch)
            reason = self._no_pose(view, drawn, found)
            if not reason and self.fitter is not None:
                fit = _fit(view, found[-1], self.fitter)
                found += [] if fit is None else [fit]
                reason = "" if fit is not None else self._no_fit(found[-1])
            stage = _stage(view, drawn, found, self.sampler.sample_size)
        inlier_mask = np.zeros(len(aligned.bearings), dtype=bool)
        if reason:
            return Estimate((stage,), None, inlier_mask, " ".join(filter(None, (reason, _lost(view)))))
        with clock.stage("refinement", until=1.0):
            start, members = found[-1].cam_from_map, found[-1].mask
            if options.as_printed:
                refined, inliers, refinement = conclude_as_printed(view.aligned, start, members, view.bounds, options)
            else:
                refined, inliers, refinement = conclude(view.aligned, [start], view.bounds, options)
        inlier_mask[view.seen] = inliers
        return Estimate((stage, refinement), refined, inlier_mask, note=_lost(view))

    def _search(
        self, view: _View, options: SolverRansacOptions, rng: np.random.Generator, watch: Watch
    ) -> tuple[int, list[_Hypothesis]]:
        """Samples drawn, and every hypothesis that explains more than all before it."""
        count, size = len(view.bearings), self.sampler.sample_size
        found: list[_Hypothesis] = []
        if count < size:
            return 0, found
        samples = draw_samples(rng, count, size, int(options.iterations))
        best, drawn, needed = 0, 0, float(len(samples))
        watch.expect(len(samples))
        while drawn < len(samples) and drawn < needed:
            watch.reach(drawn)
            batch = samples[drawn : drawn + BATCH]
            turned = None if view.pixel_from_bearing is None else view.pixel_from_bearing[batch]
            solutions, places = solve_each(self.sampler, view.bearings[batch], view.points[batch], turned)
            states = view.aligned.align_poses(solutions)
            counts, last = _explained_by_each(view, states), drawn
            for k in np.flatnonzero(counts > best):
                iteration = drawn + int(places[k])
                if counts[k] <= best or iteration >= max(needed, last + 1):
                    continue
                best, last = int(counts[k]), iteration
                _, mask = _explained(view, states[k])
                found.append(_Hypothesis(iteration, samples[iteration], states[k], mask))
                if options.local_optimization:
                    fit = _fit(view, found[-1], self.fitter or (Mlpnp() if size == P3p.sample_size else self.sampler))
                    if fit is not None and np.count_nonzero(fit.mask) > best:
                        best = int(np.count_nonzero(fit.mask))
                        found.append(fit)
                if options.confidence is not None:
                    needed = _samples_needed(options.confidence, best / count, size)
                    watch.expect(max(1, min(len(samples), math.ceil(needed))))
            drawn = min(drawn + len(batch), max(last + 1, math.ceil(needed)))
        return drawn, found

    def _no_pose(self, view: _View, drawn: int, found: list[_Hypothesis]) -> str:
        """Why there is no hypothesis; empty if there is one."""
        count, size = len(view.bearings), self.sampler.sample_size
        if count < size:
            where = "usable" if view.deg == WHOLE_SPHERE_DEG else "inside its virtual camera"
            verb = "is" if count == 1 else "are"
            return f"No pose: {self.name} needs {size} correspondences, {count} {verb} {where}."
        return "" if found else f"No pose: none of {drawn} samples has a solution that explains a correspondence."

    def _no_fit(self, best: _Hypothesis) -> str:
        """Why the fitter has no pose."""
        assert self.fitter is not None
        inliers, size = int(np.count_nonzero(best.mask)), self.fitter.sample_size
        if inliers < size:
            return f"No pose: {self.fitter.name} needs {size} inliers, the best sample's pose has {inliers}."
        return f"No pose: {self.fitter.name} finds none from the {inliers} inliers of the best sample's pose."


RANSAC_SVD = SolverRansac("ransac-svd", Svd())
RANSAC_MLPNP = SolverRansac("ransac-mlpnp", Mlpnp(), Options=MlpnpRansacOptions)
RANSAC_P3P = SolverRansac("ransac-p3p", P3p())
RANSAC_EPNP = SolverRansac("ransac-epnp", P3p(), Epnp(), EpnpSphere(), PinholeRansacOptions)
RANSAC_ODLT = SolverRansac("ransac-odlt", P3p(), Odlt(), OdltSphere(), PinholeRansacOptions)
RANSAC_EPROPNP = SolverRansac("ransac-epropnp", P3p(), EproPnp(), EproPnpSphere(), PinholeRansacOptions)


def around(name: str, solver: str) -> SolverRansac:
    """The estimator ``name`` around the solver that is registered as ``solver``; it leaves the fit to the refinement.

    Raises ``InputError`` for a solver that cannot be used.
    """
    return SolverRansac(name, solver_of(solver))


def draw_samples(rng: np.random.Generator, count: int, size: int, draws: int) -> IntArray:
    """Uniform sets (draws, size) of different numbers below ``count``, by Floyd's algorithm, column by column."""
    samples = np.empty((draws, size), dtype=np.int64)
    for column in range(size):
        last = count - size + column
        drawn = rng.integers(0, last + 1, draws)
        taken = (samples[:, :column] == drawn[:, None]).any(axis=1)
        samples[:, column] = np.where(taken, last, drawn)
    return samples


def _samples_needed(confidence: float, inlier_rate: float, size: int) -> float:
    """Samples after which Eq. 28 gives ``confidence``."""
    clean = inlier_rate**size
    return float(np.log1p(-confidence) / np.log1p(-clean)) if clean < 1.0 else 0.0


def _fit(view: _View, best: _Hypothesis, fitter: Solver) -> _Hypothesis | None:
    """The fitter's pose from all inliers of a hypothesis, if it finds one that explains any."""
    members = np.flatnonzero(best.mask)[None]
    if members.size < fitter.sample_size:
        return None
    turned = None if view.pixel_from_bearing is None else view.pixel_from_bearing[members]
    for solution in solve_each(fitter, view.bearings[members], view.points[members], turned)[0]:
        state = view.aligned.align_pose(solution)
        inliers, mask = _explained(view, state)
        if inliers:
            return replace(best, cam_from_map=state, mask=mask, fitted=True)
    return None


def _view(aligned: AlignedProblem, bounds: Bounds, options: SolverRansacOptions, pinhole: bool) -> _View:
    bearings, points = aligned.bearings @ aligned.camera_turn, aligned.points @ aligned.map_turn
    turned = None
    if isinstance(options, MlpnpRansacOptions) and options.covariances:
        turned = aligned.pixel_from_bearing @ aligned.camera_turn
    deg = VirtualPinhole.fov_deg if pinhole else WHOLE_SPHERE_DEG
    deg = options.view_deg if isinstance(options, PinholeRansacOptions) else deg
    if deg == WHOLE_SPHERE_DEG:
        return _View(np.ones(len(bearings), dtype=bool), aligned, bounds, bearings, points, turned, deg)
    seen = VirtualPinhole(deg).sees(bearings)
    names = ("index", "bearings", "points", "pixel_from_bearing", "radians_per_pixel")
    part = {name: getattr(aligned, name)[seen] for name in names}
    for array in part.values():
        array.setflags(write=False)  # as in the whole: kernels are compiled for one or the other
    part_bounds = replace(bounds, pixels=bounds.pixels[seen], radians=bounds.radians[seen])
    return _View(seen, replace(aligned, **part), part_bounds, bearings[seen], points[seen], None, deg)


def _lost(view: _View) -> str:
    """The correspondences that the virtual camera does not see, as a sentence; empty if it sees all."""
    lost = int(np.count_nonzero(~view.seen))
    if not lost:
        return ""
    return (
        f"{lost} of {len(view.seen)} usable correspondences {'lies' if lost == 1 else 'lie'} outside the virtual "
        f"camera's {view.deg:g} degrees."
    )


def _explained_by_each(view: _View, cam_from_map: FloatArray) -> IntArray:
    """How many correspondences each of P poses (P, 3, 4) explains: (P,)."""
    return inlier_counts(view.aligned, cam_from_map, view.bounds.noise_px)


def _explained(view: _View, cam_from_map: FloatArray) -> tuple[int, BoolArray]:
    """How many correspondences a pose explains, and which (V,). Its tilt is free, so the bound is that of the noise."""
    mask = residuals_px(view.aligned, cam_from_map) <= view.bounds.noise_px
    return int(np.count_nonzero(mask)), mask


def _stage(view: _View, drawn: int, found: list[_Hypothesis], size: int) -> RansacStage:
    """The record of a search, in the problem's own frames and numbers."""
    aligned = view.aligned
    rate = np.count_nonzero(found[-1].mask) / len(found[-1].mask) if found else 0.0
    return RansacStage(
        iterations=drawn,
        confidence_reached=ransac_success_probability(rate, size, drawn),
        improved_at=np.array([item.iteration for item in found], dtype=np.int32),
        samples=aligned.index.astype(np.int32)[np.array([item.sample for item in found], dtype=int).reshape(-1, size)],
        cam_from_map=aligned.unalign_poses(np.array([item.cam_from_map for item in found]).reshape(-1, 3, 4)),
        inlier_masks=np.array([aligned.full_mask(item.mask) for item in found], bool).reshape(-1, aligned.count),
        locally_optimized=np.array([item.fitted for item in found], dtype=bool),
    )
