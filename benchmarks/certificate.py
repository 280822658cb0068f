"""Is the certificate honest? Its upper bound against brute force on thousands of small random problems of all kinds."""

import os
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any

import numpy as np

from benchmarks.brute_force import largest_consensus
from spherloc.cameras.base import Camera, in_image
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.cameras.mei import Mei
from spherloc.estimators import estimate
from spherloc.estimators.base import options_type
from spherloc.geometry import DOWN, pose, so3_exp, tangent_basis
from spherloc.problem import Problem
from spherloc.types import FloatArray

MAX_COUNT = 14
KINDS = ("anywhere", "near-horizontal", "near-vertical", "repeated", "narrow", "plane", "far")
"""How bearings and points lie."""


def random_problem(seed: int) -> tuple[Problem, float, str]:
    """A problem with at most ``MAX_COUNT`` matches that the camera sees, its noise bound in px, and its kind."""
    rng = np.random.default_rng([seed, 14])
    kind = KINDS[seed % len(KINDS)]
    camera = _camera(rng)
    count, bound_px = (
        int(rng.integers(3, MAX_COUNT + 1)),
        float(np.exp(rng.uniform(np.log(0.5), np.log(30.0)))),
    )
    # Half of the cameras are mounted level; the others look anywhere.
    mount = so3_exp(rng.uniform(-np.pi, np.pi) * _unit(rng)) if rng.random() < 0.5 else np.eye(3)
    truth = pose(mount @ so3_exp(rng.uniform(-np.pi, np.pi) * DOWN), rng.uniform(-5.0, 5.0, 3))
    seen = _seen_rays(rng, camera, kind, mount, count)
    points = (seen * _depths(rng, kind, mount, seen) - truth[:, 3]) @ truth[:, :3]
    clean = camera.project(seen)[0]
    pixels = clean + _noise(rng, count, bound_px)
    lost = ~camera.unproject(pixels)[1]  # noise must not take a pixel out of what the camera sees
    pixels[lost] = clean[lost]
    outliers = rng.random(count) < rng.uniform(0.0, 1.0)
    points[outliers] = rng.uniform(-10.0, 10.0, (np.count_nonzero(outliers), 3))
    if kind == "repeated":
        copies = rng.integers(0, count, (2, count // 3))
        points[copies[0]] = points[copies[1]]
        pixels[copies[0, ::2]] = pixels[copies[1, ::2]]
    # Half of the problems have uncertain gravity.
    bound_rad = float(np.radians(rng.uniform(0.1, 5.0))) if rng.random() < 0.5 else 0.0
    true_down = truth[:, :3] @ DOWN
    axis = tangent_basis(true_down[None])[0].T @ _unit(rng, 2)
    problem = Problem(
        name=f"{kind} {seed}",
        camera=camera,
        pixels=pixels,
        points=points,
        gravity_camera=so3_exp(bound_rad * np.sqrt(rng.random()) * 0.999 * axis) @ true_down,
        gravity_map=DOWN,
        gravity_bound_rad=bound_rad,
        truth_cam_from_map=truth,
    )
    return problem, bound_px, kind


def _unit(rng: np.random.Generator, size: int = 3) -> FloatArray:
    vector = rng.standard_normal(size)
    return vector / np.linalg.norm(vector)


def _camera(rng: np.random.Generator) -> Camera:
    kind, scale = rng.integers(3), float(np.exp(rng.uniform(np.log(0.3), np.log(3.0))))
    size = int(1400 * scale)
    if kind == 0:
        return Equirectangular(width=2 * int(1000 * scale), height=int(1000 * scale))
    middle = {"width": size, "height": size, "cx": size / 2, "cy": size / 2}
    if kind == 1:
        return KannalaBrandt(fx=450 * scale, fy=440 * scale, distortion=(0.003, 0.0007, -0.002, 0.0002), **middle)
    return Mei(fx=1336 * scale, fy=1330 * scale, xi=2.2, distortion=(0.0168, 1.6549, 0.0004, 0.0004), **middle)


def _seen_rays(rng: np.random.Generator, camera: Camera, kind: str, mount: FloatArray, count: int) -> FloatArray:
    """Unit rays (count, 3) in the camera frame that it sees, spread as the kind says in the level frame."""
    found: list[FloatArray] = []
    middle = _unit(rng)
    for attempt in range(1000):
        rays = rng.standard_normal((64, 3))
        if kind == "near-horizontal":
            rays[:, 1] *= 10.0 ** rng.uniform(-8.0, -1.0)
        elif kind == "near-vertical":
            rays[:, [0, 2]] *= 10.0 ** rng.uniform(-6.0, -1.0)
        elif kind == "narrow" and attempt < 500:
            rays = middle + 0.1 * rays
        rays = (rays / np.linalg.norm(rays, axis=1, keepdims=True)) @ mount.T
        if attempt >= 500:  # the camera sees nothing of that kind
            rays[:, 2] = np.abs(rays[:, 2])
        pixels, valid = camera.project(rays)
        pixels[~valid] = -1.0
        found += list(rays[valid & in_image(camera, pixels) & camera.unproject(pixels)[1]])
        if len(found) >= count:
            return np.array(found[:count])
    raise RuntimeError(f"the camera {camera} sees none of 64,000 random rays")


def _depths(rng: np.random.Generator, kind: str, mount: FloatArray, rays: FloatArray) -> FloatArray:
    """Depths (N, 1), metres."""
    if kind == "plane":  # floor or ceiling, 2 m away
        return 2.0 / np.maximum(np.abs(rays @ mount[:, 1]), 0.01)[:, None]
    return rng.uniform(1.0, 10.0, (len(rays), 1)) * (100.0 if kind == "far" else 1.0)


def _noise(rng: np.random.Generator, count: int, bound_px: float) -> FloatArray:
    """Pixel noise (count, 2) up to the bound: at the bound itself for a third of the problems, or a third of it."""
    radius = bound_px * np.sqrt(rng.random((count, 1)))
    style = rng.integers(3)
    radius = 0.999 * bound_px + 0.0 * radius if style == 0 else radius / (1.0 if style == 1 else 3.0)
    angle = rng.uniform(-np.pi, np.pi, count)
    return radius * np.column_stack([np.cos(angle), np.sin(angle)])


@dataclass(frozen=True)
class Check:
    """One problem's certificate beside brute force."""

    seed: int
    """Of ``random_problem``."""
    kind: str
    """One of ``KINDS``."""
    tilted: bool
    """Whether gravity was uncertain."""
    upper_bound: int
    """No pose explains more, says the certificate."""
    lower_bound: int
    """Some pose explains as many."""
    found: int
    """What brute force found."""


def check(seed: int, estimator: str = "mc-exact") -> Check:
    """Solve the problem of a seed both ways."""
    problem, bound_px, kind = random_problem(seed)
    certificate = estimate(problem, estimator, options_type(estimator)(bound_px=bound_px)).certificate
    truth = problem.truth_cam_from_map
    if certificate is None or truth is None:
        raise RuntimeError(f"{estimator} gives no certificate")
    found = largest_consensus(problem.aligned, bound_px, truth)
    return Check(seed, kind, problem.gravity_bound_rad > 0.0, certificate.upper_bound, certificate.lower_bound, found)


def measure(problems: int) -> dict[str, Any]:
    """Check the seeds 0, 1, ... on all cores, for nothing is timed; lists those where the bound was not honest."""
    if hasattr(os, "sched_setaffinity"):
        pinned = os.sched_getaffinity(0)
        os.sched_setaffinity(0, range(os.cpu_count() or 1))
    check(0)  # here, so that no two processes compile the same kernels
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as pool:
        checks = list(pool.map(check, range(problems), chunksize=50))
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, pinned)
    return {"problems": problems} | summary(checks)


def summary(checks: list[Check]) -> dict[str, Any]:
    """What the checks say together."""
    proven = [one.upper_bound == one.lower_bound for one in checks]
    return {
        "dishonest": [one.seed for one in checks if one.found > one.upper_bound],
        "proven_optimal": float(np.mean(proven)),
        "proven_optimal_exact_gravity": float(
            np.mean([known for known, one in zip(proven, checks, strict=True) if not one.tilted])
        ),
        "uncertain_gravity": sum(one.tilted for one in checks),
        "mean_gap": float(np.mean([one.upper_bound - one.lower_bound for one in checks])),
        "brute_force_found_more": sum(one.found > one.lower_bound for one in checks),
        "problems_by_kind": {kind: sum(one.kind == kind for one in checks) for kind in KINDS},
    }
