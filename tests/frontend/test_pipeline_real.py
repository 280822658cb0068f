"""Real images, matched and localized by the front end alone: a panorama against SfM points, fisheyes against depth."""

import json
import tomllib
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.datasets.map_scene import MapScene
from spherloc.estimators import estimate
from spherloc.frontend.features import FeatureOptions, extract
from spherloc.frontend.lifting import DepthLift, SfmLift
from spherloc.frontend.matching import MatchOptions, match
from spherloc.frontend.pipeline import image_matcher
from spherloc.frontend.triangulation import TriangulationLift
from spherloc.frontend.view import Gravity, View
from spherloc.geometry import camera_centre, pose, rotation_angle, transform
from spherloc.images import read_depth_png
from tests.needs import DATA, real_data, require


def rotation_from_wxyz(w, x, y, z):
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def errors(problem, estimator):
    """Degrees and metres between the estimated and the true pose."""
    found, truth = estimate(problem, estimator).cam_from_map, problem.truth_cam_from_map
    assert found is not None
    return (
        np.degrees(rotation_angle(found[:, :3] @ truth[:, :3].T)),
        np.linalg.norm(camera_centre(found) - camera_centre(truth)),
    )


@pytest.fixture(scope="module")
def panoramas() -> tuple[View, View]:
    """The two panoramas with the poses and points of their COLMAP model, whose baseline is 10."""
    folder = real_data("stella_equirect_pair")

    def lines(name):
        return [line.split() for line in (folder / "colmap_equirect/0" / name).open() if not line.startswith("#")]

    points = {int(row[0]): np.array(row[1:4], float) for row in lines("points3D.txt")}
    rows = lines("images.txt")
    views = []
    for about, seen in zip(rows[::2], rows[1::2], strict=True):
        numbers = np.array(about[1:8], float)
        observed = np.array(seen, float).reshape(-1, 3)
        observed = observed[observed[:, 2] >= 0]
        views.append(
            View(
                name=about[9],
                camera=Equirectangular(1920, 960),
                path=folder / about[9],
                cam_from_map=pose(rotation_from_wxyz(*numbers[:4]), numbers[4:]),
                lift=SfmLift(observed[:, :2], np.stack([points[int(index)] for index in observed[:, 2]])),
            )
        )
    first, second = sorted(views, key=lambda view: view.name)
    return first, second


@pytest.mark.parametrize("estimator", ["ransac-2p", "auto"])
def test_a_real_panorama_is_localized_against_the_points_of_a_model(panoramas, estimator):
    """Gravity is the reference's: 0.7 degrees off."""
    reference, query = panoramas
    matcher = image_matcher((reference,), {}, "pair", DATA)
    down = np.array([0.0, 1.0, 0.0])
    scene = MapScene("pair", "pair", (query,), (reference,), matcher, down, gravity_bound_rad=np.radians(2.0))
    problem = scene.problem()
    assert len(problem) > 250 and problem.truth_inliers is not None and problem.truth_inliers.mean() > 0.9
    degrees, length = errors(problem, estimator)
    assert degrees < 0.1 and length < 0.1


def test_triangulation_agrees_with_the_model(panoramas):
    """The project's own points of the first panorama, from matches with the second, against COLMAP's."""
    first, second = panoramas
    pixels = first.lift.pixels
    points, has = TriangulationLift(first, (second,))(pixels)
    distance = np.linalg.norm(points - first.lift.points, axis=1)[has]
    ranges = np.linalg.norm(first.lift.points - camera_centre(first.cam_from_map), axis=1)[has]
    assert has.sum() > 150
    assert np.median(distance / ranges) < 0.01


class Aria:
    """The fisheyes of a pair of glasses, with the calibration in this project's pixels."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.calibration = json.loads((folder / "calibration_fisheye624.json").read_text())
        self.fits = json.loads((folder / "kb4_fit_of_fisheye624.json").read_text())
        rows = np.loadtxt(folder / "poses_world_device_tum.txt", dtype=np.longdouble)
        self.times, self.poses = rows[:, 0].astype(np.int64), rows[:, 1:].astype(np.float64)

    def view(self, camera: str, image_ns: int, depth_ns: int | None = None, truth: NDArray | None = None) -> View:
        """With the pose of that moment, which is known to 0.1 s, or ``truth``."""
        fx, fy, cx, cy, *distortion = self.fits[camera]["params"]
        lens = self.calibration[camera]
        width, height = lens["size"]
        # The glasses' calibration has the centre of the first pixel at (0, 0).
        model = KannalaBrandt(width, height, fx, fy, cx + 0.5, cy + 0.5, tuple(distortion))
        if truth is None:
            x, y, z, qx, qy, qz, qw = self.poses[np.abs(self.times - image_ns).argmin()]
            world_device = np.vstack([pose(rotation_from_wxyz(qw, qx, qy, qz), np.array([x, y, z])), [0, 0, 0, 1]])
            truth = np.linalg.inv(world_device @ np.array(lens["T_device_camera"]))[:3]
        columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        lit = np.hypot(columns - model.cx, rows - model.cy) < lens["valid_radius"]
        lift = None
        if depth_ns is not None:
            lift = DepthLift(partial(self.depth, f"{camera}_{depth_ns}.png"), model, truth, "z")
        path = self.folder / "images" / f"{camera}_{image_ns}.png"
        gravity = Gravity(truth[:, :3] @ self.down, "the true pose")
        return View(path.name, model, path, truth, gravity, lift=lift, mask=lambda: lit)

    down = np.array([0.0, -1.0, 0.0])

    def depth(self, name: str) -> NDArray:
        return read_depth_png(self.folder / "depth" / name) / 1000.0

    def scene(self, query: View, references: tuple[View, ...]) -> MapScene:
        matcher = image_matcher(references, {}, "aria", self.folder)
        return MapScene("aria", "aria", (query,), references, matcher, self.down, gravity_bound_rad=np.radians(0.5))


def truth_of(folder: Path, name: str) -> NDArray:
    return np.array(tomllib.loads((folder / name).read_text())["truth"]["cam_from_map"])


@pytest.mark.parametrize("of_query, estimator", [("rgb", "ransac-2p"), ("slam-left", "mc-exact")])
def test_a_real_fisheye_is_localized_against_the_depth_of_another_camera(aria, of_query, estimator):
    """Colour against grey, 1408 against 640 pixels, half a minute apart, 8-11 cm beside each other."""
    glasses = Aria(aria)
    if of_query == "rgb":
        query = glasses.view("camera-rgb", 87551237472175, truth=truth_of(aria, "rgb.toml"))
        references = (
            glasses.view("camera-slam-left", 87551170910700, 87551170910000),
            glasses.view("camera-slam-left", 87551204238700, 87551204237999),
        )
    else:
        query = glasses.view("camera-slam-left", 87551237566700, truth=truth_of(aria, "slam_left.toml"))
        references = (glasses.view("camera-rgb", 87551204152300, 87551204237999),)
    problem = glasses.scene(query, references).problem()
    assert len(problem) > 200 and problem.truth_inliers is not None and problem.estimated_outlier_rate is not None
    assert abs(problem.estimated_outlier_rate - (1 - problem.truth_inliers.mean())) < 0.15
    degrees, metres = errors(problem, estimator)
    assert degrees < 0.5 and metres < 0.03


@pytest.mark.parametrize("engine", ["learned", "weights"])
def test_learned_features_match_across_cameras(aria, engine):
    """A grey fisheye against a colour one: five times as many right matches as SIFT had, 65, with trained weights.

    Once by the packages of the extra, once by OpenCV with files.
    """
    require(engine)
    glasses = Aria(aria)
    files = (None, None)
    if engine == "weights":
        require("opencv 5")
        files = (DATA / "weights" / "aliked_n16rot_640_k2048.onnx", DATA / "weights" / "aliked_lightglue.onnx")
    query = glasses.view("camera-slam-right", 87551237566712, truth=truth_of(aria, "slam_right.toml"))
    reference = glasses.view("camera-rgb", 87551204152300, 87551204237999)
    first, second = (extract(view, FeatureOptions("aliked", weights=files[0])) for view in (query, reference))
    found = match(first, second, MatchOptions("lightglue", weights=files[1]))
    points, lifted = reference.lift(second.pixels[found.reference_index])
    seen, _ = query.camera.project(transform(query.cam_from_map, points[lifted]))
    error = np.linalg.norm(seen - first.pixels[found.query_index[lifted]], axis=1)
    assert (error < 3.0).sum() > 325
