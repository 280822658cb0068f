"""The pictures: what each step shows must be what the trace says."""

from dataclasses import replace

import numpy as np
import pytest

from spherloc.datasets import bundled_scenes, load_scene
from spherloc.estimators import estimate
from spherloc.estimators.ransac import RansacOptions
from spherloc.geometry import camera_centre, transform, yaw_of
from spherloc.problem import Problem
from spherloc.trace import RansacStage, RefinementStage, Trace, TranslationStage, YawStage
from spherloc_viz import style
from spherloc_viz.layers import paint, steps
from spherloc_viz.layers.primitives import Balls, Mesh, Picture, Points, SceneItem, Segments

SCENES = sorted(bundled_scenes())


def trace_of(scene: str, estimator: str, **changes: object) -> Trace:
    loaded = load_scene(bundled_scenes()[scene])
    return estimate(replace(loaded, **changes).problem(), estimator)  # pyright: ignore[reportArgumentType]


def item(picture: Picture, name: str) -> SceneItem:
    return next(found for found in picture.scene if found.name == name)


def at(trace: Trace, key: str) -> Picture:
    return paint(trace, [step.key for step in steps(trace)].index(key))


@pytest.fixture(scope="module")
def mc() -> Trace:
    return trace_of("mei_outliers_80", "mc")


@pytest.fixture(scope="module")
def ransac() -> Trace:
    return trace_of("mei_outliers_80", "ransac-2p")


def is_color(colors: np.ndarray, color: style.RGB) -> np.ndarray:
    return (colors == np.array(color)).all(axis=1)


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("estimator", ["mc", "ransac-2p"])
def test_every_step_is_drawable(scene: str, estimator: str) -> None:
    """Finite, of the promised shapes, with unique names on known layers, and a caption with numbers."""
    trace = trace_of(scene, estimator)
    keys = [step.key for step in steps(trace)]
    assert len(set(keys)) == len(keys) and keys[:2] == ["problem", "bearings"] and keys[-1] == "outcome"
    for index, step in enumerate(steps(trace)):
        picture = paint(trace, index)
        assert picture.step is step
        sentences = step.caption.count(". ") + 1
        assert sentences == 2 and step.caption.endswith("."), step.caption
        names = [found.name for found in picture.scene]
        assert len(set(names)) == len(names)
        for found in picture.scene:
            assert found.layer in style.LAYERS
            check_item(found)
        for chart in picture.charts:
            for curve in chart.curves:
                assert len(curve.x) == len(curve.y) and np.isfinite(curve.x).all() and np.isfinite(curve.y).all()
                assert (np.diff(curve.x) >= 0).all()


def check_item(found: SceneItem) -> None:
    if isinstance(found, Points):
        assert found.positions.shape == found.colors.shape == (len(found.positions), 3)
        assert np.isfinite(found.positions).all() and found.radius_m > 0
    elif isinstance(found, Segments):
        assert found.points.shape == (len(found.colors), 2, 3) and np.isfinite(found.points).all()
    elif isinstance(found, Balls):
        assert found.centers.shape == found.colors.shape and (found.radii_m > 0).all() and 0 < found.opacity <= 1
    else:
        assert isinstance(found, Mesh) and found.faces.max() < len(found.vertices)


def test_outcome_colours_say_inlier_and_outlier(mc: Trace) -> None:
    points = item(at(mc, "outcome"), "map/points")
    assert isinstance(points, Points) and points.ids is not None
    np.testing.assert_array_equal(is_color(points.colors, style.INLIER), mc.inlier_mask[points.ids])
    np.testing.assert_array_equal(is_color(points.colors, style.OUTLIER), ~mc.inlier_mask[points.ids])
    rays = item(at(mc, "outcome"), "rays")
    assert isinstance(rays, Segments) and len(rays.points) == np.count_nonzero(mc.inlier_mask)


def test_inlier_rays_leave_the_sphere_radially_at_the_final_pose(mc: Trace) -> None:
    """The bearing's dot, the map point and the centre of the sphere are in one line for an inlier."""
    picture = at(mc, "outcome")
    rays, estimate_ = item(picture, "rays"), item(picture, "cameras/estimate")
    assert isinstance(rays, Segments) and isinstance(estimate_, Segments)
    centre = estimate_.points[0, 0]
    assert mc.cam_from_map is not None
    np.testing.assert_allclose(centre, camera_centre(mc.cam_from_map), atol=1e-9)
    dot, point = rays.points[:, 0] - centre, rays.points[:, 1] - centre
    cosine = np.einsum("ni,ni->n", dot, point) / np.linalg.norm(dot, axis=1) / np.linalg.norm(point, axis=1)
    bound = mc.options.bound_px * mc.problem.radians_per_pixel[mc.inlier_mask]
    assert (np.arccos(np.clip(cosine, -1, 1)) < 1.01 * bound).all()


def test_dots_are_the_bearings_of_their_pixels(mc: Trace) -> None:
    picture = at(mc, "outcome")
    dots, surface = item(picture, "sphere/bearings"), item(picture, "sphere/surface")
    assert isinstance(dots, Points) and isinstance(surface, Mesh) and mc.cam_from_map is not None
    centre = surface.vertices.mean(axis=0)
    directions = (dots.positions - centre) @ mc.cam_from_map[:, :3].T
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    np.testing.assert_allclose(directions, mc.problem.bearings[dots.ids], atol=1e-9)


def test_clique_balls_are_the_clique_and_its_edges_are_gold(mc: Trace) -> None:
    stage = mc.stage(TranslationStage)
    assert stage is not None
    picture = at(mc, "clique")
    balls, others, edges = (item(picture, f"balls/{name}") for name in ("clique", "others", "edges"))
    assert isinstance(balls, Balls) and isinstance(others, Balls) and isinstance(edges, Segments)
    centres = item(picture, "balls/clique-centres")
    assert isinstance(centres, Points) and len(centres.positions) == len(stage.clique)
    assert is_color(balls.colors, style.CLIQUE).all() and len(balls.centers) >= style.MAX_DRAWN_BALLS // 2
    assert set(balls.radii_m) <= set(stage.radii_m[stage.clique])
    assert len(balls.centers) + len(others.centers) == style.MAX_DRAWN_BALLS < len(stage.radii_m)
    members = {tuple(centre) for centre in stage.centres_m[stage.clique]}
    for ends, gold in zip(edges.points, is_color(edges.colors, style.CLIQUE), strict=True):
        assert gold == ({tuple(ends[0]), tuple(ends[1])} <= members)


def test_thinning_is_stated_with_its_numbers(mc: Trace) -> None:
    yaw, translation = mc.stage(YawStage), mc.stage(TranslationStage)
    assert yaw is not None and translation is not None
    assert len(yaw.lo_rad) > style.MAX_DRAWN_ARCS and f"{len(yaw.lo_rad):,}" in at(mc, "yaw-arcs").step.note
    assert len(translation.radii_m) > style.MAX_DRAWN_BALLS
    assert f"{style.MAX_DRAWN_BALLS} of {len(translation.radii_m)} balls" in at(mc, "clique").step.note


def test_yaw_chart_shows_overlap_truth_and_estimate(mc: Trace) -> None:
    stage = mc.stage(YawStage)
    assert stage is not None and mc.problem.truth_cam_from_map is not None
    curves = {curve.label: curve for curve in at(mc, "yaw-clique").charts[0].curves}
    np.testing.assert_array_equal(curves["arcs that overlap"].y, stage.overlap)
    assert curves["estimate"].x[0] == pytest.approx(np.degrees(stage.yaw_rad))
    assert curves["truth"].x[0] == pytest.approx(np.degrees(yaw_of(mc.problem.truth_cam_from_map[:, :3])))
    assert "estimate" not in {curve.label for curve in at(mc, "yaw-arcs").charts[0].curves}


def test_ring_points_where_the_camera_looks(mc: Trace) -> None:
    """The truth's spoke and the true camera's viewing direction are the same direction."""
    picture = at(mc, "yaw-clique")
    spoke, truth = item(picture, "ring/truth"), mc.problem.truth_cam_from_map
    assert isinstance(spoke, Segments) and truth is not None
    direction = spoke.points[0, 1] - spoke.points[0, 0]
    ahead = transform(truth, camera_centre(truth) + direction[None])[0]
    np.testing.assert_allclose(ahead / np.linalg.norm(ahead), [0, 0, 1], atol=1e-9)


def test_gold_arcs_cover_the_estimated_yaw(mc: Trace) -> None:
    """A ring drawn with the wrong ends would show an overlap that is not there."""
    picture, stage = at(mc, "yaw-clique"), mc.stage(YawStage)
    ring, spoke = item(picture, "ring/arcs"), item(picture, "ring/estimate")
    assert isinstance(ring, Segments) and isinstance(spoke, Segments) and stage is not None
    centre = item(picture, "sphere/surface").vertices.mean(axis=0)  # pyright: ignore[reportAttributeAccessIssue]
    gold = ring.points[is_color(ring.colors, style.CLIQUE)] - centre
    angles = np.arctan2(-gold[..., 0], gold[..., 2]) - stage.yaw_rad
    low, high = ((angles + np.pi) % (2 * np.pi) - np.pi).T
    radius = np.round(np.linalg.norm(gold[:, 0], axis=1), 9)
    tracks = np.unique(radius)
    assert len(tracks) == min(len(stage.clique), style.MAX_DRAWN_ARCS // 2)
    for track in tracks:
        own = radius == track
        assert ((low[own] <= 1e-9) & (high[own] >= -1e-9)).any()


def test_ransac_steps_are_its_improvements(ransac: Trace) -> None:
    stage = ransac.stage(RansacStage)
    assert stage is not None
    samples = [step for step in steps(ransac) if step.key.startswith("sample-")]
    assert len(samples) == len(stage.improved_at)
    for k, step in enumerate(samples):
        picture = at(ransac, step.key)
        points = item(picture, "map/points")
        assert isinstance(points, Points)
        np.testing.assert_array_equal(np.flatnonzero(is_color(points.colors, style.SAMPLE)), np.sort(stage.samples[k]))
        assert f"{np.count_nonzero(stage.inlier_masks[k])} of 100" in step.caption


def test_refinement_chart_is_its_cost(ransac: Trace) -> None:
    stage = ransac.stage(RefinementStage)
    assert stage is not None
    chart = next(chart for chart in at(ransac, "outcome").charts if chart.name == "refinement")
    np.testing.assert_allclose(chart.curves[0].y ** 2, stage.cost_px2)


def test_no_pose_and_no_truth_are_said() -> None:
    level = np.array([[100.0, 50.0], [150.0, 50.0], [30.0, 50.0]])
    camera = load_scene(bundled_scenes()["panorama_outliers_80"]).camera  # pyright: ignore[reportAttributeAccessIssue]
    level[:, 1] = camera.height / 2
    points, down = np.eye(3) * 4 + 1, np.array([0.0, 1.0, 0.0])
    problem = Problem("level", camera, level, points, down, down)
    for trace in (estimate(problem, "mc"), estimate(problem, "ransac-2p", RansacOptions(iterations=20))):
        assert trace.cam_from_map is None
        picture = paint(trace, len(steps(trace)) - 1)
        assert picture.step.title == "No pose" and "cameras/estimate" not in {found.name for found in picture.scene}
        assert ("outcome", "no pose") in picture.tables[0].rows
