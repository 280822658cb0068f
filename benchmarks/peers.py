"""The peers: each gets the same correspondences in the form that it takes, prepared before the clock starts.

No released peer has a robust path for known gravity or takes bare bearings, so bearings are projected into a camera
that the peer knows; PoseLib's minimal solver for known gravity gets a RANSAC of ours around it. All of them end with a
refinement of the pose, as ours do. The threshold of each is ours, 3 px of
the scene's camera, times the median of (peer's pixels per scene pixel) over the correspondences it gets; the ratio at
one of them is sqrt |det| of d peer pixel / d scene pixel.
"""

import time
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import cv2
import numpy as np
import poselib
import pycolmap

from benchmarks.methods import BOUND_PX, CONFIDENCE, MAX_ITERATIONS, Answer, Method, Solve
from spherloc.geometry import pose
from spherloc.problem import Problem
from spherloc.types import FloatArray, IntArray

Project = Callable[[FloatArray], FloatArray]

FOCAL_PX = 375.0
"""Of every camera made up here: about the px/rad of the simulated MEI camera, 415 in the middle and 311 at the rim."""
FRONT_RAD = np.radians(87.0)
"""Widest angle to the axis that a pinhole plane is given; its pixels there are 360 times as large as in the middle."""

PANORAMA_SLACK = 1.5
"""More for the panorama: towards its poles a pixel is much wider than the median (96 % success instead of 92 %)."""

_TURN = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
_NOD = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
FACES: FloatArray = np.array([np.eye(3), _TURN, _TURN @ _TURN, _TURN.T, _NOD, _NOD.T])
"""(6, 3, 3): face from camera; each face's +z looks along +z, +x, -z, -x, +y, -y of the camera."""


def to_plane(rays: FloatArray) -> FloatArray:
    """Pinhole pixels (N, 2), principal point 0, of rays (N, 3) in front."""
    return FOCAL_PX * rays[:, :2] / rays[:, 2:]


def to_equidistant(rays: FloatArray) -> FloatArray:
    """Pixels (N, 2), principal point 0, of a Kannala-Brandt camera with k = 0."""
    lateral = np.hypot(rays[:, 0], rays[:, 1])
    return FOCAL_PX * rays[:, :2] * (np.arctan2(lateral, rays[:, 2]) / np.maximum(lateral, 1e-12))[:, None]


def to_panorama(rays: FloatArray) -> FloatArray:
    """Pixels (N, 2) of COLMAP's EQUIRECTANGULAR camera: +z in the middle, +y downwards."""
    lon = np.arctan2(rays[:, 0], rays[:, 2])
    lat = np.arctan2(rays[:, 1], np.hypot(rays[:, 0], rays[:, 2]))
    return FOCAL_PX * np.column_stack([lon + np.pi, lat + np.pi / 2])


def face_of(rays: FloatArray) -> IntArray:
    """Index (N,) of the face of the cube that each ray (N, 3) falls in."""
    return np.argmax(rays @ FACES[:, 2].T, axis=1)


def pixel_ratio(problem: Problem, rows: IntArray, project: Project) -> float:
    """Median over the correspondences ``rows`` of how many of the peer's pixels a scene pixel is wide."""
    half = 0.25
    columns = []
    for shift in np.eye(2) * half:
        ahead, behind = (problem.camera.unproject(problem.pixels[rows] + sign * shift)[0] for sign in (1, -1))
        columns.append((project(ahead) - project(behind)) / (2 * half))
    (du_dx, dv_dx), (du_dy, dv_dy) = (column.T for column in columns)
    return float(np.nanmedian(np.sqrt(np.abs(du_dx * dv_dy - du_dy * dv_dx))))


def _answer(rotation: Any, translation: Any) -> Answer:
    estimate = pose(np.asarray(rotation), np.asarray(translation).ravel())
    return Answer(estimate if np.isfinite(estimate).all() else None)


def _front(problem: Problem, most_rad: float) -> IntArray:
    """The usable correspondences (K,) within an angle of the optical axis."""
    return np.flatnonzero(problem.usable & (np.nan_to_num(problem.bearings[:, 2], nan=-1.0) > np.cos(most_rad)))


def _on_faces(
    rows: IntArray, faces: IntArray, pixels: FloatArray, points: FloatArray, used: IntArray
) -> tuple[list[FloatArray], list[FloatArray]]:
    """Pixels and points of the correspondences ``rows`` by face, as PoseLib takes them."""
    on = [rows[faces[rows] == face] for face in used]
    return [pixels[some] for some in on], [points[some] for some in on]


def _rig_cameras(used: IntArray) -> tuple[list[Any], list[dict[str, Any]]]:
    """PoseLib's extrinsics and cameras of the faces ``used``."""
    extrinsics = []
    for face in used:
        extrinsic = poselib.CameraPose()
        extrinsic.R = FACES[face]
        extrinsics.append(extrinsic)
    size = int(2 * FOCAL_PX)
    camera = {"model": "SIMPLE_PINHOLE", "width": size, "height": size, "params": [FOCAL_PX, 0.0, 0.0]}
    return extrinsics, [camera] * len(used)


def _rig_data(problem: Problem) -> tuple[IntArray, IntArray, FloatArray, float]:
    """Rows of the usable correspondences (K,), their faces (K,), pixels (K, 2) there, and the threshold, px."""
    rows = np.flatnonzero(problem.usable)
    faces = face_of(problem.bearings[rows])

    def project(rays: FloatArray) -> FloatArray:
        return to_plane(np.einsum("nij,nj->ni", FACES[faces], rays))

    return rows, faces, project(problem.bearings[rows]), BOUND_PX * pixel_ratio(problem, rows, project)


# --- PoseLib ----------------------------------------------------------------------------------------------------------

_POSELIB = {"max_iterations": MAX_ITERATIONS, "min_iterations": 100, "success_prob": CONFIDENCE}


def _poselib_fisheye(problem: Problem, seed: int) -> Solve:
    rows = _front(problem, np.pi / 2)
    threshold = BOUND_PX * pixel_ratio(problem, rows, to_equidistant)
    pixels, points = to_equidistant(problem.bearings[rows]), problem.points[rows]
    size = int(np.pi * FOCAL_PX)
    camera = {"model": "OPENCV_FISHEYE", "width": size, "height": size, "params": [FOCAL_PX, FOCAL_PX] + 6 * [0.0]}
    options = {**_POSELIB, "max_reproj_error": threshold, "seed": seed}

    def solve() -> Answer:
        found, _ = poselib.estimate_absolute_pose(pixels, points, camera, options, {})
        return _answer(found.R, found.t)

    return solve


def _poselib_rig(problem: Problem, seed: int) -> Solve:
    rows, faces, pixels, threshold = _rig_data(problem)
    used = np.unique(faces)
    per_face = _on_faces(np.arange(len(rows)), faces, pixels, problem.points[rows], used)
    extrinsics, cameras = _rig_cameras(used)
    options = {**_POSELIB, "max_reproj_error": threshold, "seed": seed}

    def solve() -> Answer:
        found, _ = poselib.estimate_generalized_absolute_pose(*per_face, extrinsics, cameras, options, {})
        return _answer(found.R, found.t)

    return solve


def _poselib_up2p(problem: Problem, seed: int) -> Solve:
    """The minimal solver for known gravity in a RANSAC written here: truncated squares, refined at every improvement.

    Two matches fix a pose with roll and pitch as measured; the refinement, PoseLib's of the rig, has six unknowns.
    """
    rows, faces, pixels, threshold = _rig_data(problem)
    aligned = problem.aligned
    bearings, points = problem.bearings[rows] @ aligned.camera_turn.T, problem.points[rows] @ aligned.map_turn.T
    turned = FACES[faces]
    used = np.unique(faces)
    extrinsics, cameras = _rig_cameras(used)
    options = {"max_iterations": 25, "loss_type": "TRUNCATED", "loss_scale": threshold}

    def squares(rotation: FloatArray, translation: FloatArray) -> FloatArray:
        """Squared errors (N,) on the faces, px^2, of a pose between the camera and the map."""
        rays = np.einsum("nij,nj->ni", turned, problem.points[rows] @ rotation.T + translation)
        with np.errstate(divide="ignore", invalid="ignore"):
            errors = ((to_plane(rays) - pixels) ** 2).sum(axis=1)
        return np.where(rays[:, 2] > 0.0, errors, np.inf)

    def solve() -> Answer:
        rng = np.random.default_rng(seed)
        best, least, inside_s, drawn, needed = None, np.inf, 0.0, 0, MAX_ITERATIONS
        while drawn < max(100, needed) and drawn < MAX_ITERATIONS:
            pair = rng.choice(len(rows), 2, replace=False)
            drawn += 1
            start = time.perf_counter()
            found = poselib.up2p(bearings[pair], points[pair])
            inside_s += time.perf_counter() - start
            for level in found:
                # Between the camera and the map, and back from their aligned frames.
                rotation = aligned.camera_turn.T @ level.R @ aligned.map_turn
                translation = aligned.camera_turn.T @ level.t
                errors = squares(rotation, translation)
                cost = np.minimum(errors, threshold**2).sum()
                if cost >= least:
                    continue
                start = time.perf_counter()
                state = poselib.CameraPose()
                state.R, state.t = rotation, translation
                per_face = _on_faces(np.flatnonzero(errors < threshold**2), faces, pixels, problem.points[rows], used)
                if sum(map(len, per_face[0])) >= 4:
                    state, _ = poselib.refine_generalized_absolute_pose(*per_face, state, extrinsics, cameras, options)
                inside_s += time.perf_counter() - start
                refined = squares(state.R, state.t)
                if np.minimum(refined, threshold**2).sum() < cost:
                    errors, cost, rotation, translation = (
                        refined,
                        np.minimum(refined, threshold**2).sum(),
                        state.R,
                        state.t,
                    )
                best, least = pose(np.asarray(rotation), np.asarray(translation)), cost
                right = np.mean(errors < threshold**2) ** 2
                needed = np.log(1.0 - CONFIDENCE) / np.log1p(-min(max(right, 1e-9), 1.0 - 1e-9))
        return Answer(best, inside_ms=1e3 * inside_s)

    return solve


# --- pycolmap ---------------------------------------------------------------------------------------------------------

_COLMAP = {"max_num_trials": MAX_ITERATIONS, "min_num_trials": 100, "min_inlier_ratio": 0.01, "confidence": CONFIDENCE}


def _colmap_options(threshold: float, seed: int) -> pycolmap.RANSACOptions:
    return pycolmap.RANSACOptions({**_COLMAP, "max_error": threshold, "random_seed": seed, "num_threads": 1})


def _colmap_answer(found: dict[str, Any] | None, key: str) -> Answer:
    if found is None:
        return Answer(None)
    return _answer(found[key].rotation.matrix(), found[key].translation)


def _colmap_panorama(problem: Problem, seed: int) -> Solve:
    rows = np.flatnonzero(problem.usable)
    threshold = PANORAMA_SLACK * BOUND_PX * pixel_ratio(problem, rows, to_panorama)
    pixels, points = to_panorama(problem.bearings[rows]), problem.points[rows]
    width, height = 2 * np.pi * FOCAL_PX, np.pi * FOCAL_PX
    camera = pycolmap.Camera(
        model="EQUIRECTANGULAR", width=round(width), height=round(height), params=np.array([width, height])
    )
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac = _colmap_options(threshold, seed)

    def solve() -> Answer:
        return _colmap_answer(
            pycolmap.estimate_and_refine_absolute_pose(pixels, points, camera, options), "cam_from_world"
        )

    return solve


def _colmap_rig(problem: Problem, seed: int) -> Solve:
    rows, faces, pixels, threshold = _rig_data(problem)
    extrinsics = [pycolmap.Rigid3d(pycolmap.Rotation3d(face), np.zeros(3)) for face in FACES]
    size = int(2 * FOCAL_PX)
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=size, height=size, params=np.array([FOCAL_PX, 0.0, 0.0]))
    arguments = pixels, problem.points[rows], faces.tolist(), extrinsics, [camera] * len(FACES)
    options = _colmap_options(threshold, seed)

    def solve() -> Answer:
        return _colmap_answer(
            pycolmap.estimate_and_refine_generalized_absolute_pose(*arguments, options), "rig_from_world"
        )

    return solve


# --- OpenCV -----------------------------------------------------------------------------------------------------------


def _opencv_usac(problem: Problem, seed: int) -> Solve:
    rows = _front(problem, FRONT_RAD)
    params = cv2.UsacParams()
    params.threshold = BOUND_PX * pixel_ratio(problem, rows, to_plane)
    params.confidence, params.maxIterations = CONFIDENCE, MAX_ITERATIONS
    params.score, params.sampler = cv2.SCORE_METHOD_MSAC, cv2.SAMPLING_UNIFORM
    params.loMethod, params.randomGeneratorState = cv2.LOCAL_OPTIM_INNER_LO, seed
    pixels, points = to_plane(problem.bearings[rows]), problem.points[rows].copy()
    matrix = np.diag([FOCAL_PX, FOCAL_PX, 1.0])

    def solve() -> Answer:
        found, _, turn, translation, _ = cv2.solvePnPRansac(points, pixels, matrix, None, params=params)
        return _answer(cv2.Rodrigues(turn)[0], translation) if found else Answer(None)

    return solve


# --- SupeRANSAC -------------------------------------------------------------------------------------------------------


_SUPERANSAC = {"max_iterations": MAX_ITERATIONS, "min_iterations": 100, "confidence": CONFIDENCE}


def _superansac(problem: Problem, seed: int) -> Solve:
    """Its own example's scoring and optimizations, with uniform samples as there is no order by quality.

    It takes no seed, and points with negative coordinates make its search for neighbours fail, so that all are moved.
    """
    import pysuperansac

    rows = _front(problem, FRONT_RAD)
    settings = pysuperansac.RANSACSettings()
    for name, value in _SUPERANSAC.items():
        setattr(settings, name, value)
    settings.inlier_threshold = BOUND_PX * pixel_ratio(problem, rows, to_plane)
    settings.sampler = pysuperansac.SamplerType.Uniform
    settings.scoring = pysuperansac.ScoringType.MAGSAC
    settings.local_optimization = pysuperansac.LocalOptimizationType.NestedRANSAC
    settings.final_optimization = pysuperansac.LocalOptimizationType.IteratedLSQ
    pixels, points = to_plane(problem.bearings[rows]), problem.points[rows]
    middle_px, low = 1.0 - pixels.min(axis=0, initial=0.0), points.min(axis=0, initial=0.0) - 1.0
    data = np.ascontiguousarray(np.hstack([pixels + middle_px, points - low]))
    size = np.ptp(data, axis=0)
    box = [*(data.max(axis=0)[:2] + 1.0), *(size[2:] + 2.0)]
    params = [FOCAL_PX, *middle_px]

    def solve() -> Answer:
        rotation, translation, *_ = pysuperansac.estimateAbsolutePose(
            data, pysuperansac.CameraType.SimplePinhole, params, box, config=settings
        )
        rotation, translation = np.asarray(rotation), np.asarray(translation).ravel()
        if not rotation.any():
            return Answer(None)
        return _answer(rotation, translation - rotation @ low)

    return solve


def peers() -> dict[str, Method]:
    """All of them by name."""
    rig = "sphere cut into six 90 degree pinhole faces"
    usac = {"score": "MSAC", "loMethod": "INNER_LO", "maxIterations": MAX_ITERATIONS, "confidence": CONFIDENCE}
    methods = (
        Method("PoseLib rig", _poselib_rig, {"camera": rig, **_POSELIB}),
        Method("PoseLib fisheye", _poselib_fisheye, {"camera": "OPENCV_FISHEYE, k = 0; front half", **_POSELIB}),
        Method("pycolmap rig", _colmap_rig, {"camera": rig, **_COLMAP}),
        Method(
            "pycolmap panorama",
            _colmap_panorama,
            {"camera": "EQUIRECTANGULAR", "threshold_factor": PANORAMA_SLACK, **_COLMAP},
        ),
        Method(
            "PoseLib up2p",
            _poselib_up2p,
            {"camera": rig, "gravity": "given", "max_iterations": MAX_ITERATIONS, "confidence": CONFIDENCE},
        ),
        Method("OpenCV USAC", _opencv_usac, {"camera": "pinhole plane, points within 87 degrees", **usac}),
    )
    if find_spec("pysuperansac"):
        plane = {"camera": "pinhole plane, points within 87 degrees", "scoring": "MAGSAC", **_SUPERANSAC}
        methods += (Method("SupeRANSAC", _superansac, plane),)
    return {method.name: method for method in methods}


def use_one_thread() -> None:
    """For the library that is told at run time; the others are told by the environment and by their options."""
    cv2.setNumThreads(1)
