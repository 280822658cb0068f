"""The pictures: what each step shows must be what the trace says."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recording_samples import exact_run, scene_problem

from spherloc import registry
from spherloc.datasets import bundled_scenes, load_scene
from spherloc.estimators import estimate
from spherloc.estimators.ransac import RansacOptions
from spherloc.geometry import camera_centre, transform, yaw_of
from spherloc.metrics import evaluate
from spherloc.problem import Problem
from spherloc.trace import (
    Certificate,
    ConsensusStage,
    RansacStage,
    RefinementStage,
    Trace,
    TranslationStage,
    YawStage,
)
from spherloc_viz import layers, style
from spherloc_viz.layers import paint, steps
from spherloc_viz.layers.ball_set import MAX_SURFACES
from spherloc_viz.layers.frame import angle_text
from spherloc_viz.layers.outcome import outcome_table
from spherloc_viz.layers.point_cloud import WRONG_RAYS
from spherloc_viz.layers.primitives import Balls, Curve, Label, Mesh, Picture, Points, SceneItem, Segments, Textured

SCENES = sorted(name for name, path in bundled_scenes().items() if 'kind = "synthetic"' in path.read_text())


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
    check_drawable(trace_of(scene, estimator))


@pytest.mark.parametrize("estimator", registry.names("estimators"))
def test_every_estimator_is_drawable(estimator: str) -> None:
    check_drawable(trace_of("mei_outliers_80", estimator, outlier_rate=0.5))


def check_drawable(trace: Trace) -> None:
    """Finite, of the promised shapes, with unique names on known layers, and a caption with numbers."""
    keys = [step.key for step in steps(trace)]
    assert len(set(keys)) == len(keys) and keys[:2] == ["problem", "bearings"] and keys[-1] == "outcome"
    for index, step in enumerate(steps(trace)):
        picture = paint(trace, index)
        said = picture.step
        assert (said.key, said.title, said.stage) == (step.key, step.title, step.stage) and step.stage
        sentences = said.caption.count(". ") + 1
        assert sentences == 2 and said.caption.endswith("."), said.caption
        names = [found.name for found in picture.scene]
        assert len(set(names)) == len(names)
        for found in picture.scene:
            assert found.layer in style.LAYERS
            check_item(found)
        for chart in picture.charts:
            for curve in chart.curves:
                assert len(curve.x) == len(curve.y) and np.isfinite(curve.x).all() and np.isfinite(curve.y).all()
                assert (np.diff(curve.x) >= 0).all()


@pytest.fixture(scope="module")
def exact() -> Trace:
    return exact_run()


def test_every_step_of_an_exact_run_is_drawable(exact: Trace) -> None:
    stages = list(dict.fromkeys(step.stage for step in steps(exact)))
    assert stages == ["Matches", "Choice", "Consensus", "Refinement", "Outcome"]
    main = ["decision", "consensus-bound", "consensus-clique", "consensus-poses", "refinement", "outcome"]
    assert [step.key for step in steps(exact) if step.key in main] == main
    check_drawable(exact)


def test_consensus_chart_holds_the_bound_against_what_is_explained(exact: Trace) -> None:
    stage = exact.stage(ConsensusStage)
    assert stage is not None and exact.problem.truth_cam_from_map is not None
    curves = curves_of(at(exact, "consensus-clique"), "consensus")
    np.testing.assert_array_equal(curves["bound"].y, stage.bound)
    assert curves["bound"].x[0] == -180 and curves["bound"].x[-1] == pytest.approx(179.75)
    assert set(curves["first guess"].y) == {stage.seed_support} and set(curves["best pose"].y) == {stage.support[0]}
    assert curves["truth"].x[0] == pytest.approx(np.degrees(yaw_of(exact.problem.truth_cam_from_map[:, :3])))
    assert curves["estimate"].x[0] == pytest.approx(np.degrees(stage.yaw_rad))


def curves_of(picture: Picture, name: str) -> dict[str, Curve]:
    return {curve.label: curve for chart in picture.charts if chart.name == name for curve in chart.curves}


def test_the_peak_of_the_bound_is_gold_where_the_estimate_looks(exact: Trace) -> None:
    picture = at(exact, "consensus-bound")
    bars, spoke = item(picture, "ring/bars"), item(picture, "ring/estimate")
    assert isinstance(bars, Segments) and isinstance(spoke, Segments)
    gold = is_color(bars.colors, style.CLIQUE)
    assert np.count_nonzero(gold) == 1
    along = [line[1] - line[0] for line in (bars.points[gold][0], spoke.points[0])]
    cosine = along[0] @ along[1] / np.linalg.norm(along[0]) / np.linalg.norm(along[1])
    assert cosine > np.cos(np.radians(1.0))


def test_what_pokes_out_of_the_green_circle_may_hide_a_better_pose() -> None:
    """The circle has the height of the best support: a bar is longer exactly where the bound is larger."""
    bound = np.random.default_rng(4).integers(0, 31, 1440).astype(np.int32)
    trace = exact_run(bound=bound)
    picture = at(trace, "consensus-bound")
    bars, circle = item(picture, "ring/bars"), item(picture, "ring/support")
    assert isinstance(bars, Segments) and isinstance(circle, Segments)
    centre = item(picture, "sphere/surface").vertices.mean(axis=0)  # pyright: ignore[reportAttributeAccessIssue]
    reach, limit = (np.linalg.norm(ends - centre, axis=1) for ends in (bars.points[:, 1], circle.points[:, 0]))
    stage = trace.stage(ConsensusStage)
    assert stage is not None
    np.testing.assert_array_equal(reach > limit + 1e-9, bound.reshape(360, 4).max(axis=1) > stage.support[0])
    share = 100 * np.mean(bound > stage.support[0])
    assert f"{share:.3g} % of all yaws could hide a better one" in picture.step.caption


def test_the_clique_is_gold_on_the_sphere_and_on_the_map(exact: Trace) -> None:
    stage = exact.stage(ConsensusStage)
    assert stage is not None
    picture = at(exact, "consensus-clique")
    for name in ("map/points", "sphere/bearings"):
        dots = item(picture, name)
        assert isinstance(dots, Points) and dots.ids is not None
        np.testing.assert_array_equal(dots.ids[is_color(dots.colors, style.CLIQUE)], np.sort(stage.clique))
    pairs = item(picture, "pairs/clique")
    assert isinstance(pairs, Segments) and len(pairs.points) == len(stage.clique) * (len(stage.clique) - 1) // 2
    assert f"All {len(pairs.points)} pairs" in picture.step.note


def test_pairs_of_a_large_clique_are_thinned_by_a_stated_rule() -> None:
    trace = exact_run(clique=np.arange(60, dtype=np.int32))
    picture = at(trace, "consensus-clique")
    pairs = item(picture, "pairs/clique")
    assert isinstance(pairs, Segments) and len(pairs.points) == style.MAX_DRAWN_PAIRS
    assert f"{style.MAX_DRAWN_PAIRS} of 1,770 pairs" in picture.step.note


def test_rivals_are_ghosts_and_rows(exact: Trace) -> None:
    stage, aligned = exact.stage(ConsensusStage), exact.problem.aligned
    assert stage is not None
    picture = at(exact, "consensus-poses")
    best, alternatives = item(picture, "cameras/estimate"), item(picture, "cameras/alternatives")
    assert isinstance(best, Segments) and isinstance(alternatives, Segments)
    np.testing.assert_allclose(best.points[0, 0], camera_centre(aligned.align_pose(stage.cam_from_map[0])), atol=1e-9)
    np.testing.assert_allclose(
        alternatives.points[0, 0], camera_centre(aligned.align_pose(stage.cam_from_map[1])), atol=1e-9
    )
    assert is_color(alternatives.colors, style.ALTERNATIVE).all()
    assert [row[1] for row in picture.tables[0].rows] == [str(support) for support in stage.support]
    assert picture.tables[0].columns[-1] == "off the truth"


def test_many_rivals_are_thinned_and_none_is_said() -> None:
    pose = exact_run().cam_from_map
    assert pose is not None
    many = exact_run(cam_from_map=np.tile(pose, (20, 1, 1)), support=np.arange(40, 20, -1, dtype=np.int32))
    picture = at(many, "consensus-poses")
    assert len(picture.tables[0].rows) == 1 + style.MAX_DRAWN_ALTERNATIVES
    assert f"{style.MAX_DRAWN_ALTERNATIVES} of 19 other poses" in picture.step.note
    alone = at(exact_run(cam_from_map=pose[None], support=np.array([20], np.int32)), "consensus-poses")
    assert "cameras/alternatives" not in {found.name for found in alone.scene}
    assert "No clearly different pose" in alone.step.caption


def test_a_set_that_no_pose_explains_is_said() -> None:
    picture = at(exact_run(clique=np.arange(30, dtype=np.int32)), "consensus-clique")
    assert "10 more than the best pose explains" in picture.step.caption
    labels = scene_problem("mei_outliers_80").truth_inliers
    assert labels is not None and f" {np.count_nonzero(labels[:30])} of them right ones" in picture.step.caption


def test_a_search_that_found_nothing_has_its_bound_only() -> None:
    empty = exact_run(clique=np.zeros(0, np.int32), cam_from_map=np.zeros((0, 3, 4)), support=np.zeros(0, np.int32))
    keys = [step.key for step in steps(empty)]
    assert "consensus-bound" in keys and "consensus-clique" not in keys and "consensus-poses" not in keys
    assert "estimate" not in curves_of(at(empty, "consensus-bound"), "consensus")
    assert "ring/estimate" not in {found.name for found in at(empty, "consensus-bound").scene}


def test_a_budget_that_ran_out_is_said() -> None:
    assert "the budget ran out" in at(exact_run(finished=False), "consensus-bound").step.note
    assert "searched to its end" in at(exact_run(), "consensus-bound").step.note


def test_the_decision_has_its_reason_and_its_numbers(exact: Trace) -> None:
    step = at(exact, "decision").step
    assert step.title == "Chosen: mc-exact" and step.caption.startswith("100 matches are few enough")
    assert "20 of 100 matches" in step.caption and "w = 0.2" in step.equation


@pytest.mark.parametrize(
    ("certificate", "said", "knowable"),
    [
        (Certificate(20, 20, 2e-9), "Proven optimal: no pose explains more than 20", True),
        (Certificate(23, 20, 0.0), "so at most 3 more", True),
        (Certificate(5, 5, 0.01), "Proven optimal", False),
        (Certificate(5, 4, np.inf), "so at most 1 more", False),
    ],
)
def test_the_certificate_is_in_the_outcome(exact: Trace, certificate: Certificate, said: str, knowable: bool) -> None:
    mask = exact.inlier_mask & (np.cumsum(exact.inlier_mask) <= certificate.lower_bound)
    trace = replace(exact, certificate=certificate, inlier_mask=mask)
    picture, rows = at(trace, "outcome"), dict(outcome_table(trace).rows)
    assert said in rows["certificate"] and said.lower() in picture.step.caption.lower()
    assert ("warning" in rows) != knowable
    assert ("The answer cannot be known" in picture.step.note) != knowable
    assert "certificate" not in dict(outcome_table(replace(exact, certificate=None)).rows)


def test_a_wrong_pose_that_is_believed_says_that_nothing_tells_it(mc: Trace) -> None:
    """Of two lines, "failure" and "localized", one is by the truth."""
    assert mc.cam_from_map is not None
    far = mc.cam_from_map + np.array([0.0, 0.0, 0.0, 5.0])
    wrong = replace(mc, problem=replace(mc.problem, truth_cam_from_map=far))
    told, believed = dict(outcome_table(wrong).rows), dict(outcome_table(mc).rows)
    assert (told["outcome"], believed["outcome"]) == ("failure", "success")
    assert told["judged without the truth"] == "localized: nothing in the matches tells that the pose is wrong"
    assert believed["judged without the truth"] == "localized"


@pytest.mark.parametrize(
    ("more", "bounds", "proof", "why"),
    [
        (0, (0, 0), "Proven optimal: no pose explains more than {}", ""),
        (1, (0, 0), "Before refinement {}, which is proven optimal: no pose explains more", "Refinement makes"),
        (-1, (0, 0), "Before refinement {}, which is proven optimal: no pose explains more", "can go beyond either"),
        (1, (2, 0), "so at most 2 more than the {} of the best known pose", "Refinement makes"),
    ],
)
def test_a_certificate_of_another_number_than_the_inliers_is_explained(
    exact: Trace, more: int, bounds: tuple[int, int], proof: str, why: str
) -> None:
    best = int(np.count_nonzero(exact.inlier_mask)) + more
    trace = replace(exact, certificate=Certificate(best + bounds[0], best + bounds[1], 1e-30))
    assert dict(outcome_table(trace).rows)["certificate"].endswith(proof.format(best))
    note = at(trace, "outcome").step.note
    assert why in note and ("count" in note) == bool(why)


def test_inliers_beyond_the_bound_on_the_noise_are_told_apart(exact: Trace) -> None:
    """Where gravity is kept, inliers are counted at a bound that allows for its error; the certificate's are not."""
    within = int(np.count_nonzero(exact.inlier_mask))
    more = exact.inlier_mask | (np.cumsum(~exact.inlier_mask) <= 5)
    trace = replace(exact, inlier_mask=more, certificate=Certificate(within + 5, within + 5, 1e-30))
    picture, rows = at(trace, "outcome"), dict(outcome_table(trace).rows)
    assert f"may add, {within} of them within 3 px" in picture.step.caption
    assert f"before refinement {within + 5}, which is proven optimal" in picture.step.caption
    assert f"this pose keeps the given gravity and has {within} such matches" in picture.step.note
    assert rows["inliers"].startswith(f"{within + 5} of ")
    assert rows["inliers"].endswith(f", {within} within the bound on the noise")


@pytest.mark.parametrize("size", [2, 3, 6])
def test_samples_of_any_size_are_shown(ransac: Trace, size: int) -> None:
    stage = ransac.stage(RansacStage)
    assert stage is not None
    samples = np.arange(size * len(stage.samples), dtype=np.int32).reshape(-1, size)
    again = np.arange(len(samples)) % 2 == 1
    trace = replace(ransac, stages=(replace(stage, samples=samples, locally_optimized=again), *ransac.stages[1:]))
    pink = []
    for k in range(len(samples)):
        picture = at(trace, f"sample-{k + 1}")
        assert f"n = {size} " in picture.step.equation
        points = item(picture, "map/points")
        assert isinstance(points, Points)
        pink.append(np.flatnonzero(is_color(points.colors, style.SAMPLE)).tolist())
        if not again[k]:
            listed = ", ".join(map(str, samples[k][:-1])) + f" and {samples[k][-1]}"
            assert picture.step.caption.startswith(f"Matches {listed} fix a pose")
    assert pink == [[] if fitted else sample.tolist() for sample, fitted in zip(samples, again, strict=True)]


def check_item(found: SceneItem) -> None:
    if isinstance(found, Points):
        assert found.positions.shape == found.colors.shape == (len(found.positions), 3)
        assert np.isfinite(found.positions).all() and found.radius_m > 0
    elif isinstance(found, Segments):
        assert found.points.shape == (len(found.colors), 2, 3) and np.isfinite(found.points).all()
    elif isinstance(found, Balls):
        assert found.centers.shape == found.colors.shape and (found.radii_m > 0).all() and 0 < found.opacity <= 1
    elif isinstance(found, Label):
        assert found.position.shape == (3,) and np.isfinite(found.position).all() and found.text
    else:
        assert isinstance(found, Mesh | Textured) and found.faces.max() < len(found.vertices)


def test_outcome_colours_say_inlier_and_outlier(mc: Trace) -> None:
    points = item(at(mc, "outcome"), "map/points")
    assert isinstance(points, Points) and points.ids is not None
    np.testing.assert_array_equal(is_color(points.colors, style.INLIER), mc.inlier_mask[points.ids])
    np.testing.assert_array_equal(is_color(points.colors, style.OUTLIER), ~mc.inlier_mask[points.ids])
    rays = item(at(mc, "outcome"), "rays")
    assert isinstance(rays, Segments) and len(rays.points) == np.count_nonzero(mc.inlier_mask)


def test_lines_to_inliers_that_are_wrong_turn_red(mc: Trace) -> None:
    wrong = np.flatnonzero(mc.inlier_mask)[::3]
    truth = mc.inlier_mask.copy()
    right = replace(mc, problem=replace(mc.problem, truth_inliers=truth.copy()))
    truth[wrong] = False
    run = replace(mc, problem=replace(mc.problem, truth_inliers=truth))
    whole, picture = item(at(right, "outcome"), "rays"), at(run, "outcome")
    rays, halves = item(picture, "rays"), item(picture, WRONG_RAYS)
    assert isinstance(whole, Segments) and isinstance(rays, Segments) and isinstance(halves, Segments)
    assert is_color(rays.colors, style.INLIER).all() and is_color(halves.colors, style.OUTLIER).all()
    spoiled = np.isin(np.flatnonzero(mc.inlier_mask), wrong)
    np.testing.assert_array_equal(rays.points[~spoiled], whole.points[~spoiled])
    np.testing.assert_array_equal(rays.points[spoiled, 0], whole.points[spoiled, 0])
    np.testing.assert_array_equal(rays.points[spoiled, 1], halves.points[:, 0])
    np.testing.assert_array_equal(halves.points[:, 1], whole.points[spoiled, 1])
    assert "turn red" in picture.step.note and "turn red" not in at(right, "outcome").step.note


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
    balls, edges = (item(picture, f"balls/{name}") for name in ("clique", "edges"))
    circled = {name: item(picture, f"balls/{name}-circles") for name in ("clique", "others")}
    assert isinstance(balls, Balls) and isinstance(edges, Segments)
    centres = item(picture, "balls/clique-centres")
    assert isinstance(centres, Points) and len(centres.positions) == len(stage.clique)
    assert is_color(balls.colors, style.CLIQUE).all() and len(balls.centers) == MAX_SURFACES
    assert set(balls.radii_m) <= set(stage.radii_m[stage.clique])
    assert balls.ids is not None
    pairs = {tuple(pair): ball for ball, pair in enumerate(stage.pairs.tolist())}
    drawn = [pairs[tuple(pair)] for pair in balls.ids]
    for name, lines in circled.items():
        assert isinstance(lines, Segments) and lines.ids is not None
        own = np.array([pairs[tuple(pair)] for pair in lines.ids])
        assert (np.isin(own, stage.clique) == (name == "clique")).all()
        offset = lines.points - stage.centres_m[own][:, None]
        np.testing.assert_allclose(np.linalg.norm(offset, axis=2), np.tile(stage.radii_m[own][:, None], 2))
        drawn += np.unique(own).tolist()
    assert len(drawn) == len(set(drawn)) == style.MAX_DRAWN_BALLS < len(stage.radii_m)
    members = {tuple(centre) for centre in stage.centres_m[stage.clique]}
    for ends, gold in zip(edges.points, is_color(edges.colors, style.CLIQUE), strict=True):
        assert gold == ({tuple(ends[0]), tuple(ends[1])} <= members)


def test_thinning_is_stated_with_its_numbers(mc: Trace) -> None:
    yaw, translation = mc.stage(YawStage), mc.stage(TranslationStage)
    assert yaw is not None and translation is not None
    assert len(yaw.lo_rad) > style.MAX_DRAWN_ARCS and f"{len(yaw.lo_rad):,}" in at(mc, "yaw-arcs").step.note
    assert len(translation.radii_m) > style.MAX_DRAWN_BALLS
    note = at(mc, "clique").step.note
    assert f"{style.MAX_DRAWN_BALLS} of {len(translation.radii_m)} balls" in note
    assert f"{MAX_SURFACES} have a surface" in note


def test_yaw_chart_shows_overlap_truth_and_estimate(mc: Trace) -> None:
    stage = mc.stage(YawStage)
    assert stage is not None and mc.problem.truth_cam_from_map is not None
    note = at(mc, "yaw-clique").step.note
    assert f"the pose of the outcome is {angle_text(evaluate(mc).rotation_error_deg)} off" in note
    curves = {curve.label: curve for curve in at(mc, "yaw-clique").charts[0].curves}
    np.testing.assert_array_equal(curves["that overlap"].y, stage.overlap)
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


def test_the_true_yaw_and_the_true_camera_are_in_view(mc: Trace) -> None:
    """The lessons speak of them; the line of the true yaw is longer where another one hides it."""
    truth = mc.problem.truth_cam_from_map
    assert truth is not None
    for step in ("yaw-pair", "yaw-roots"):
        picture = at(mc, step)
        spoke = item(picture, "ring/truth")
        assert isinstance(spoke, Segments)
        for end in spoke.points[0]:
            assert np.any(np.all(picture.focus.points == end, axis=1)), step
    seen = at(mc, "match").focus.points
    assert np.all((seen.min(axis=0) < camera_centre(truth)) & (camera_centre(truth) < seen.max(axis=0)))


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
    samples = [step for step in steps(ransac) if re.fullmatch(r"sample-\d+", step.key)]
    assert len(samples) == len(stage.improved_at)
    for k, step in enumerate(samples):
        picture = at(ransac, step.key)
        points = item(picture, "map/points")
        assert isinstance(points, Points)
        np.testing.assert_array_equal(np.flatnonzero(is_color(points.colors, style.SAMPLE)), np.sort(stage.samples[k]))
        assert f"{np.count_nonzero(stage.inlier_masks[k])} of 100" in picture.step.caption


def test_refinement_chart_is_its_cost(ransac: Trace) -> None:
    stage = ransac.stage(RefinementStage)
    assert stage is not None
    chart = next(chart for chart in at(ransac, "outcome").charts if chart.name == "refinement")
    np.testing.assert_allclose(chart.curves[0].y ** 2, stage.cost_px2)


def with_covariance(trace: Trace, **changes: object) -> Trace:
    stage = trace.stage(RefinementStage)
    assert stage is not None
    return replace(trace, stages=(*trace.stages[:-1], replace(stage, **changes)))  # pyright: ignore[reportArgumentType]


def test_standard_deviations_are_those_of_the_covariance(mc: Trace) -> None:
    """Angles in degrees, positions in centimetres, and their root mean squares over the axes."""
    covariance = np.diag(np.square([*np.radians([0.1, 0.2, 0.2]), 0.01, 0.02, 0.02]))
    trace = with_covariance(mc, covariance=covariance, tilt_rad=np.radians(0.25), gravity_sd_rad=np.radians(0.5))
    picture = at(trace, "refinement")
    assert dict(picture.tables[0].rows) == {
        "rotation about x, y, z": "0.100°, 0.200°, 0.200°",
        "position x, y, z": "1.0 cm, 2.0 cm, 2.0 cm",
        "tilt": "0.250°",
    }
    assert "its expected error is 0.30° and 3.0 cm RMS." in picture.step.caption
    assert "leans 0.250° from the given gravity, which was trusted to 0.5°" in picture.step.note
    assert "tilt / σ_g" in picture.step.equation
    assert dict(outcome_table(trace).rows)["expected error"] == "0.30° and 3.0 cm RMS"


@pytest.mark.parametrize(("sd", "said"), [(0.0, "is kept"), (np.inf, "was not used")])
def test_gravity_that_is_exact_or_unknown_is_said(mc: Trace, sd: float, said: str) -> None:
    step = at(with_covariance(mc, gravity_sd_rad=sd), "refinement").step
    assert said in step.note and "σ_g" not in step.equation


def test_a_pose_that_is_left_open_is_said(mc: Trace) -> None:
    picture = at(with_covariance(mc, covariance=np.full((6, 6), np.nan)), "refinement")
    assert "unknown: the inliers leave it open." in picture.step.caption
    assert dict(picture.tables[0].rows)["position x, y, z"] == "open, open, open"


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
        assert ("outcome", "no pose") in outcome_table(trace).rows


def test_what_runs_share_of_a_map_has_names_of_its_own() -> None:
    """Two numbers under one name would be taken for each other."""
    sources = [path.read_text("utf-8") for path in Path(layers.__file__).parent.glob("*.py")]
    names = [name for source in sources for name in re.findall(r'of_map\(\s*"([^"]+)"', source)]
    assert len(names) > 5 and len(set(names)) == len(names), sorted(names)
