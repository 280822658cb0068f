"""What every picture shows: errors by the factor that is said, lengths that are true, the image on its sphere."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from spherloc.cameras.base import in_image
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.datasets.synthetic import SyntheticScene
from spherloc.estimators import estimate
from spherloc.geometry import camera_centre, pose, so3_exp
from spherloc.metrics import rotation_error_deg
from spherloc.problem import Problem
from spherloc.trace import RefinementStage, Trace
from spherloc_viz import style
from spherloc_viz.layers import paint, steps
from spherloc_viz.layers.frame import angle_text, icosphere, length, length_text
from spherloc_viz.layers.primitives import Label, Mesh, Picture, Points, SceneItem, Segments, Textured
from spherloc_viz.layers.query_image import DIM
from spherloc_viz.layers.scene import round_length
from spherloc_viz.layers.uncertainty import FACTORS, SIGMAS

SceneOf = Callable[..., SyntheticScene]


def items_of(picture: Picture) -> dict[str, SceneItem]:
    return {item.name: item for item in picture.scene}


def last(trace: Trace) -> dict[str, SceneItem]:
    return items_of(paint(trace, len(steps(trace)) - 1))


@pytest.fixture(scope="module")
def turned(scene_of: SceneOf) -> Trace:
    """A run whose map and camera both lean, so that the aligned frames are not the problem's own."""
    problem = scene_of("panorama", correspondences=60, outlier_rate=0.3, noise_px=2.0).problem()
    lean, truth = so3_exp(np.array([0.4, 0.2, -0.3])), problem.truth_cam_from_map
    assert truth is not None
    moved = replace(
        problem,
        points=problem.points @ lean.T,
        gravity_map=lean @ problem.gravity_map,
        truth_cam_from_map=pose(truth[:, :3] @ lean.T, truth[:, 3]),
    )
    trace = estimate(moved, "ransac-2p")
    assert rotation_error_deg(moved.truth_cam_from_map, trace.cam_from_map) < 1.0  # pyright: ignore[reportArgumentType]
    return trace


def with_covariance(trace: Trace, covariance: np.ndarray) -> Trace:
    stages = [replace(s, covariance=covariance) if isinstance(s, RefinementStage) else s for s in trace.stages]
    return replace(trace, stages=tuple(stages))


def text(item: SceneItem) -> str:
    assert isinstance(item, Label)
    return item.text


@pytest.mark.parametrize("size", [1e-4, 0.02, 3.0])
def test_the_ellipsoid_is_that_of_the_covariance_by_the_factor_it_states(
    turned: Trace, rng: np.random.Generator, size: float
) -> None:
    spread = rng.normal(size=(6, 6))
    covariance = size**2 * spread @ spread.T
    trace = with_covariance(turned, covariance)
    items = items_of(paint(trace, [step.key for step in steps(trace)].index("refinement-error")))
    assert "uncertainty/ellipsoid" in last(trace) and "uncertainty/sigmas" not in last(trace)
    lines, label = items["uncertainty/ellipsoid"], text(items["uncertainty/sigmas"])
    assert isinstance(lines, Segments) and label.startswith("3σ of the position")
    factor = int(label.partition("enlarged ")[2].removesuffix("×") or 1)
    assert factor in FACTORS and (factor > 1) == (size < 3.0)
    assert turned.cam_from_map is not None
    turn = turned.problem.aligned.map_turn
    offset = lines.points.reshape(-1, 3) @ turn - camera_centre(turned.cam_from_map)
    distance = np.sqrt(np.einsum("ni,ij,nj->n", offset, np.linalg.inv(covariance[3:, 3:]), offset))
    np.testing.assert_allclose(distance, SIGMAS * factor, rtol=1e-6)
    ellipses = lines.points.reshape(3, -1, 2, 3)
    np.testing.assert_allclose(ellipses[:, :, 1], np.roll(ellipses[:, :, 0], -1, axis=1), atol=1e-9 * size)


@pytest.mark.parametrize("broken", [np.full((6, 6), np.nan), np.diag([1.0] * 5 + [np.inf])])
def test_a_spread_that_is_unknown_is_not_drawn(turned: Trace, broken: np.ndarray) -> None:
    items = last(with_covariance(turned, broken))
    assert "uncertainty/ellipsoid" not in items and "×" not in text(items["uncertainty/error"])


def test_the_ellipsoid_belongs_to_the_refined_pose_only(turned: Trace) -> None:
    stage = turned.stage(RefinementStage)
    assert stage is not None
    for index, step in enumerate(steps(turned)):
        items = items_of(paint(turned, index))
        camera = items.get("cameras/estimate")
        if isinstance(camera, Segments):
            known = camera_centre(turned.problem.aligned.align_pose(stage.cam_from_map[-1]))
            away = float(np.linalg.norm(camera.points[0, 0] - known))
            if not 1e-9 < away < 1e-5:  # a step of the refinement that has all but arrived
                assert ("uncertainty/ellipsoid" in items) == (away <= 1e-9), step.key
        else:
            assert "uncertainty/ellipsoid" not in items
        assert ("uncertainty/error" in items) == ("cameras/estimate" in items), step.key


def test_errors_are_drawn_and_said_as_the_metrics_have_them(turned: Trace) -> None:
    items, aligned = last(turned), turned.problem.aligned
    truth, estimated = turned.problem.truth_cam_from_map, turned.cam_from_map
    assert truth is not None and estimated is not None
    truth, estimated = aligned.align_pose(truth), aligned.align_pose(estimated)
    offset, angle = items["uncertainty/offset"], items["uncertainty/angle"]
    assert isinstance(offset, Segments) and isinstance(angle, Segments)
    drawn, error = offset.points[0, 1] - offset.points[0, 0], camera_centre(truth) - camera_centre(estimated)
    degrees, _, rest = text(items["uncertainty/error"]).partition(" · ")
    away, _, factor = rest.partition(", enlarged ")
    assert away == length(float(np.linalg.norm(error)))
    np.testing.assert_allclose(drawn, int(factor.removesuffix("×") or 1) * error, atol=1e-9)
    assert degrees == f"error {angle_text(rotation_error_deg(truth, estimated))}"
    ways = angle.points[:2, 1] - angle.points[:2, 0]
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    np.testing.assert_allclose(ways, [estimated[2, :3], truth[2, :3]], atol=1e-9)
    assert [tuple(color) for color in angle.colors[:2]] == [style.ESTIMATE, style.TRUTH]
    np.testing.assert_allclose(angle.points[[2, -1], [0, 1]], angle.points[:2, 1], atol=1e-9)


def test_a_large_error_has_its_true_size(turned: Trace) -> None:
    truth = turned.problem.truth_cam_from_map
    assert truth is not None
    away = replace(turned.problem, truth_cam_from_map=pose(truth[:, :3], truth[:, 3] + [0.0, 0.0, 40.0]))
    items = last(replace(turned, problem=away))
    offset = items["uncertainty/offset"]
    assert isinstance(offset, Segments) and text(items["uncertainty/error"]).endswith(" · 40.00 m")
    assert np.linalg.norm(offset.points[0, 1] - offset.points[0, 0]) == pytest.approx(40.0, rel=0.01)


def test_opposite_and_equal_directions_have_an_arc_too(turned: Trace) -> None:
    assert turned.cam_from_map is not None
    for turn in (np.eye(3), np.diag([-1.0, 1.0, -1.0])):
        truth = pose(turn @ turned.cam_from_map[:, :3], turn @ turned.cam_from_map[:, 3])
        angle = last(replace(turned, problem=replace(turned.problem, truth_cam_from_map=truth)))["uncertainty/angle"]
        assert isinstance(angle, Segments) and np.isfinite(angle.points).all()


def test_without_the_truth_only_the_spread_is_shown(turned: Trace) -> None:
    items = last(replace(turned, problem=replace(turned.problem, truth_cam_from_map=None)))
    assert {name for name in items if name.startswith("uncertainty")} == {
        "uncertainty/ellipsoid",
        "uncertainty/sigmas",
    }
    assert not {"cameras/ghost", "cameras/truth"} & items.keys()


def test_the_ghost_fills_the_true_camera_where_that_stands_alone(turned: Trace) -> None:
    assert "cameras/ghost" not in last(turned), "the estimate is there"
    items = items_of(paint(turned, 0))
    ghost, lines = items["cameras/ghost"], items["cameras/truth"]
    assert isinstance(ghost, Mesh) and isinstance(lines, Segments) and 0 < ghost.opacity < 0.5
    np.testing.assert_allclose(ghost.vertices[0], lines.points[0, 0], atol=1e-12)
    np.testing.assert_allclose(ghost.vertices[1:], lines.points[:4, 1], atol=1e-12)
    names = [item.name for item in paint(turned, 0).scene]
    assert names.index("cameras/ghost") < names.index("sphere/surface"), "else the sphere around it would hide it"
    truth = turned.problem.truth_cam_from_map
    assert truth is not None
    away = replace(turned.problem, truth_cam_from_map=pose(truth[:, :3], truth[:, 3] + [0.0, 0.0, 4.0]))
    assert "cameras/ghost" in last(replace(turned, problem=away))


@pytest.mark.parametrize(
    ("length_m", "said"),
    [(0.00012, "0.12 mm"), (0.0068, "6.8 mm"), (0.00998, "1 cm"), (0.021, "2.1 cm"), (0.25, "25 cm"), (1.0, "1 m"),
     (12.34, "12 m"), (345.6, "346 m"), (2000.0, "2 km"), (0.0, "0 mm"), (0.996, "1 m")],
)  # fmt: skip
def test_lengths_have_the_unit_of_their_size(length_m: float, said: str) -> None:
    assert length_text(length_m) == said


def test_one_is_one_unit() -> None:
    assert [length_text(length, metric=False) for length in (0.5, 1.0, 2.0)] == ["0.5 units", "1 unit", "2 units"]


@pytest.mark.parametrize(
    ("angle_deg", "said"),
    [(0.0117, "0.012°"), (0.13, "0.13°"), (0.0996, "0.10°"), (2.5, "2.50°"), (37.4, "37°"), (180.0, "180°")],
)
def test_angles_have_the_digits_of_their_size(angle_deg: float, said: str) -> None:
    assert angle_text(angle_deg) == said


@pytest.mark.parametrize(("most", "length"), [(1.0, 1.0), (1.99, 1.0), (4.99, 2.0), (50.0, 50.0), (0.07, 0.05)])
def test_scale_bars_are_round(most: float, length: float) -> None:
    assert round_length(most) == pytest.approx(length)


@pytest.mark.parametrize("scale", [0.001, 1.0, 300.0])
def test_the_scale_bar_is_as_long_as_it_says_and_lies_on_the_ground(turned: Trace, scale: float) -> None:
    problem = replace(turned.problem, points=scale * turned.problem.points, truth_cam_from_map=None)
    picture = paint(replace(turned, problem=problem), 0)
    items = items_of(picture)
    bar, points = items["scale/bar"], items["map/points"]
    assert isinstance(bar, Segments) and isinstance(points, Points)
    length = float(np.linalg.norm(bar.points[0, 1] - bar.points[0, 0]))
    assert text(items["scale/length"]) == length_text(length) and bar.layer == "scale bar"
    assert round_length(length) == pytest.approx(length)
    width = np.ptp(points.positions[:, [0, 2]], axis=0).max()
    assert 0.05 * width < length <= 0.3 * width
    assert np.mean(points.positions[:, 1] <= bar.points[0, 0, 1] + 1e-9) >= 0.9, "y points down"


def image_problem(folder: Path, camera_name: str, scene_of: SceneOf) -> tuple[Problem, np.ndarray]:
    """A problem with tilted gravity and a dark picture in which the pixels of five matches are marked in colours."""
    problem = scene_of(camera_name, correspondences=40, outlier_rate=0.0, noise_px=0.0).problem()
    camera, down = problem.camera, so3_exp(np.array([0.2, 0.0, -0.15])) @ problem.gravity_camera
    pixels = problem.pixels[np.argsort(problem.radians_per_pixel)]
    apart = [0]
    for k in range(1, len(pixels)):
        if min(np.linalg.norm(pixels[k] - pixels[m]) for m in apart) > 80 and len(apart) < 5:
            apart.append(k)
    colors = np.array([[255, 40, 40], [40, 255, 40], [40, 40, 255], [255, 255, 40], [40, 255, 255]], np.uint8)
    image = np.full((camera.height, camera.width, 3), 20, np.uint8)
    for k, color in zip(apart, colors, strict=True):
        cv2.circle(image, [int(value) for value in pixels[k]], 12, color[::-1].tolist(), -1)
    assert cv2.imwrite(str(folder / "query.png"), image)
    order = np.argsort(problem.radians_per_pixel)[apart]
    chosen = np.concatenate([order, np.setdiff1d(np.arange(len(problem)), order)])
    marked = replace(
        problem,
        pixels=problem.pixels[chosen],
        points=problem.points[chosen],
        truth_inliers=None,
        gravity_camera=down,
        gravity_bound_rad=0.3,
        image=folder / "query.png",
    )
    return marked, colors


@pytest.mark.parametrize("camera_name", ["panorama", "fisheye"])
def test_bearings_lie_on_their_pixels_of_the_image(tmp_path: Path, scene_of: SceneOf, camera_name: str) -> None:
    """The ray from the sphere's centre through a bearing's dot meets the mesh where its picture has the pixel's
    colour."""
    problem, colors = image_problem(tmp_path, camera_name, scene_of)
    trace = estimate(problem, "ransac-2p")
    for index in (0, len(steps(trace)) - 1):
        items = items_of(paint(trace, index))
        sphere, dots = items["sphere/image"], items["sphere/bearings"]
        assert isinstance(sphere, Textured) and isinstance(dots, Points) and dots.ids is not None
        picture = sphere.image()
        assert picture is not None and sphere.layer == "image"
        placed = sphere.vertices @ sphere.map_from_mesh[:, :3].T + sphere.map_from_mesh[:, 3]
        centre = sphere.map_from_mesh[:, 3]
        np.testing.assert_allclose(np.linalg.norm(placed - centre, axis=1), np.linalg.norm(dots.positions[0] - centre))
        mesh = trimesh.Trimesh(placed, sphere.faces, process=False)
        rays = (dots.positions[:5] - centre) / np.linalg.norm(dots.positions[:5] - centre, axis=1)[:, None]
        assert dots.ids[:5].tolist() == [0, 1, 2, 3, 4]
        hits, ray, face = mesh.ray.intersects_location(np.tile(centre, (5, 1)), rays, multiple_hits=False)
        weights = trimesh.triangles.points_to_barycentric(mesh.triangles[face], hits)
        place = np.einsum("nk,nkc->nc", weights, sphere.uv[sphere.faces[face]])
        height, width = picture.shape[:2]
        column, row = (place[:, 0] * width).astype(int), ((1.0 - place[:, 1]) * height).astype(int)
        seen = picture[row, column, :3].astype(float)
        np.testing.assert_allclose(seen, DIM * colors[ray], atol=3.0)


@pytest.mark.parametrize("camera_name", ["panorama", "fisheye"])
def test_there_is_a_hole_where_the_camera_sees_nothing(tmp_path: Path, scene_of: SceneOf, camera_name: str) -> None:
    problem, _ = image_problem(tmp_path, camera_name, scene_of)
    items = items_of(paint(estimate(problem, "ransac-2p"), 0))
    sphere, surface = items["sphere/image"], items["sphere/surface"]
    assert isinstance(sphere, Textured) and isinstance(surface, Mesh)
    radius = np.linalg.norm(surface.vertices - sphere.map_from_mesh[:, 3], axis=1)
    assert (radius < np.cbrt(np.linalg.det(sphere.map_from_mesh[:, :3]))).all(), "the bare sphere is inside"
    picture = sphere.image()
    assert picture is not None
    if camera_name == "panorama":
        assert picture.shape[2] == 3
        return
    model = Equirectangular(picture.shape[1], picture.shape[0])
    rows, columns = (axis.ravel()[::7] for axis in np.indices(picture.shape[:2]))
    bearings, _ = model.unproject(np.column_stack([columns + 0.5, rows + 0.5]).astype(np.float64))
    pixels, valid = problem.camera.project(bearings @ problem.aligned.camera_turn)
    visible = valid & in_image(problem.camera, pixels)
    agree = (picture[rows, columns, 3] >= 128) == visible
    assert np.mean(agree) > 0.995 and 0.2 < np.mean(visible) < 0.9


def test_an_image_that_has_gone_leaves_the_sphere_bare(tmp_path: Path, scene_of: SceneOf) -> None:
    problem = replace(scene_of("panorama").problem(), image=tmp_path / "gone.png")
    sphere = items_of(paint(estimate(problem, "ransac-2p"), 0))["sphere/image"]
    assert isinstance(sphere, Textured) and sphere.image() is None


def test_equal_images_have_equal_keys(tmp_path: Path, scene_of: SceneOf) -> None:
    """A match that is hidden or spoiled changes the problem but not its image, which must not be sent again."""
    problem, _ = image_problem(tmp_path, "panorama", scene_of)
    fewer = replace(problem, pixels=problem.pixels[:-1], points=problem.points[:-1])
    tilted = replace(problem, gravity_camera=problem.gravity_camera[[2, 1, 0]])
    keys = [
        item.key
        for p in (problem, fewer, tilted)
        for item in paint(estimate(p, "ransac-2p"), 0).scene
        if isinstance(item, Textured)
    ]
    assert keys[0] == keys[1] != keys[2]


@pytest.mark.parametrize("divisions", [0, 1, 3])
def test_the_sphere_is_the_one_that_trimesh_makes(divisions: int) -> None:
    vertices, faces = icosphere(divisions)
    mesh, known = trimesh.Trimesh(vertices, faces, process=False), trimesh.creation.icosphere(divisions)
    assert mesh.is_watertight and mesh.is_winding_consistent and len(faces) == len(known.faces)
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(mesh.volume, known.volume, rtol=1e-12)  # negative if seen from within
