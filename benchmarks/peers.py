"""The peers: each gets the same correspondences in the form that it takes, prepared before the clock starts.

No released peer has a robust path for known gravity or takes bare bearings, so bearings are projected into a camera
that the peer knows. All of them end with a refinement of the pose, as ours do. The threshold of each is ours, 3 px of
the scene's camera, times the median of (peer's pixels per scene pixel) over the correspondences it gets; the ratio at
one of them is sqrt |det| of d peer pixel / d scene pixel.
"""

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import poselib
import pycolmap

from benchmarks.methods import BOUND_PX, CONFIDENCE, MOST_ITERATIONS, Answer, Method, Solve
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


def _rig_data(problem: Problem) -> tuple[IntArray, IntArray, FloatArray, float]:
    """Rows of the usable correspondences (K,), their faces (K,), pixels (K, 2) there, and the threshold, px."""
    rows = np.flatnonzero(problem.usable)
    faces = face_of(problem.bearings[rows])

    def project(rays: FloatArray) -> FloatArray:
        return to_plane(np.einsum("nij,nj->ni", FACES[faces], rays))

    return rows, faces, project(problem.bearings[rows]), BOUND_PX * pixel_ratio(problem, rows, project)


# --- PoseLib ----------------------------------------------------------------------------------------------------------

_POSELIB = {"max_iterations": MOST_ITERATIONS, "min_iterations": 100, "success_prob": CONFIDENCE}


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
    per_face = [pixels[faces == face] for face in used], [problem.points[rows[faces == face]] for face in used]
    extrinsics = []
    for face in used:
        extrinsic = poselib.CameraPose()
        extrinsic.R = FACES[face]
        extrinsics.append(extrinsic)
    size = int(2 * FOCAL_PX)
    cameras = [{"model": "SIMPLE_PINHOLE", "width": size, "height": size, "params": [FOCAL_PX, 0.0, 0.0]}] * len(used)
    options = {**_POSELIB, "max_reproj_error": threshold, "seed": seed}

    def solve() -> Answer:
        found, _ = poselib.estimate_generalized_absolute_pose(*per_face, extrinsics, cameras, options, {})
        return _answer(found.R, found.t)

    return solve


# --- pycolmap ---------------------------------------------------------------------------------------------------------

_COLMAP = {"max_num_trials": MOST_ITERATIONS, "min_num_trials": 100, "min_inlier_ratio": 0.01, "confidence": CONFIDENCE}


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
    params.confidence, params.maxIterations = CONFIDENCE, MOST_ITERATIONS
    params.score, params.sampler = cv2.SCORE_METHOD_MSAC, cv2.SAMPLING_UNIFORM
    params.loMethod, params.randomGeneratorState = cv2.LOCAL_OPTIM_INNER_LO, seed
    pixels, points = to_plane(problem.bearings[rows]), problem.points[rows].copy()
    matrix = np.diag([FOCAL_PX, FOCAL_PX, 1.0])

    def solve() -> Answer:
        found, _, turn, translation, _ = cv2.solvePnPRansac(points, pixels, matrix, None, params=params)
        return _answer(cv2.Rodrigues(turn)[0], translation) if found else Answer(None)

    return solve


def peers() -> dict[str, Method]:
    """All of them by name."""
    rig = "sphere cut into six 90 degree pinhole faces"
    usac = {"score": "MSAC", "loMethod": "INNER_LO", "maxIterations": MOST_ITERATIONS, "confidence": CONFIDENCE}
    methods = (
        Method("PoseLib rig", _poselib_rig, {"camera": rig, **_POSELIB}),
        Method("PoseLib fisheye", _poselib_fisheye, {"camera": "OPENCV_FISHEYE, k = 0; front half", **_POSELIB}),
        Method("pycolmap rig", _colmap_rig, {"camera": rig, **_COLMAP}),
        Method(
            "pycolmap panorama",
            _colmap_panorama,
            {"camera": "EQUIRECTANGULAR", "threshold_factor": PANORAMA_SLACK, **_COLMAP},
        ),
        Method("OpenCV USAC", _opencv_usac, {"camera": "pinhole plane, points within 87 degrees", **usac}),
    )
    return {method.name: method for method in methods}


def use_one_thread() -> None:
    """For the library that is told at run time; the others are told by the environment and by their options."""
    cv2.setNumThreads(1)
