"""What a card says of a match is true: pairs against the arcs of all pairs, residuals against the camera, words
against the evidence."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from spherloc.bounds import bounds_of
from spherloc.consensus.yaw_arcs import yaw_arcs
from spherloc.datasets import load_scene
from spherloc.datasets.synthetic import SyntheticScene
from spherloc.estimators import estimate
from spherloc.geometry import pose, transform, yaw_of, yaw_rotation
from spherloc.problem import Problem
from spherloc.trace import ConsensusStage, Trace, TranslationStage, YawStage
from spherloc_viz.layers.agreement import agreement, partner_arcs, unbounded
from spherloc_viz.layers.explanation import WORST, explain
from spherloc_viz.layers.matches import FILTERS, IN_CLIQUE, SORTS, match_rows, offered, order
from spherloc_viz.layers.residuals import run_bounds, verdicts
from spherloc_viz.layers.selection import MAX_COMPARED, explain_many

SceneOf = Callable[..., SyntheticScene]


def covered(problem: Problem, bound_px: float, yaw: float) -> np.ndarray:
    """Which pairs (M, M) have an arc over a yaw, from the arcs of all pairs at once."""
    aligned = problem.aligned
    pairs, lo, hi = yaw_arcs(aligned, bounds_of(aligned, bound_px).radians)
    inside = ((yaw - lo) % (2 * np.pi)) <= hi - lo
    out = np.zeros((len(aligned.index), len(aligned.index)), dtype=bool)
    out[pairs[inside, 0], pairs[inside, 1]] = True
    return out | out.T


@pytest.mark.parametrize("camera", ["mei", "fisheye", "panorama"])
@pytest.mark.parametrize("gravity_error_deg", [0.0, 0.3])
def test_agreement_is_what_the_arcs_of_all_pairs_say(
    scene_of: SceneOf, camera: str, gravity_error_deg: float, rng: np.random.Generator
) -> None:
    problem = scene_of(camera, correspondences=40, gravity_error_deg=gravity_error_deg).problem()
    aligned, everybody = problem.aligned, np.arange(40)
    bound = bounds_of(aligned, 4.0).radians
    silent = unbounded(aligned, bound, everybody, everybody)
    for yaw in rng.uniform(-np.pi, np.pi, 6):
        expected = (covered(problem, 4.0, yaw) | silent) & ~np.eye(40, dtype=bool)
        assert np.array_equal(agreement(aligned, bound, yaw, everybody, everybody), expected)
        one, others = 7, np.delete(everybody, 7)
        missed = partner_arcs(aligned, bound, one, others).missed_rad(yaw)
        assert np.array_equal((missed == 0.0) | silent[one, others], expected[one, others])


def test_how_far_off_the_nearest_arc_is(scene_of: SceneOf) -> None:
    """Walking from a yaw by what is missed, either way, reaches an arc, and no less does."""
    problem = scene_of("mei", correspondences=30).problem()
    aligned, others = problem.aligned, np.arange(1, 30)
    bound = bounds_of(aligned, 3.0).radians
    arcs, yaw = partner_arcs(aligned, bound, 0, others), 0.7
    missed = arcs.missed_rad(yaw)
    assert np.isinf(missed).any() and np.isfinite(missed).any()
    for k in np.flatnonzero(np.isfinite(missed) & (missed > 0)):
        near = [agreement(aligned, bound, yaw + s * missed[k] * 0.999, np.array([0]), others)[0, k] for s in (-1, 1)]
        far = [agreement(aligned, bound, yaw + s * (missed[k] + 1e-7), np.array([0]), others)[0, k] for s in (-1, 1)]
        assert not any(near) and any(far)
    for k in np.flatnonzero(np.isinf(missed)):
        yaws = np.linspace(-np.pi, np.pi, 60)
        assert not any(agreement(aligned, bound, y, np.array([0]), others)[0, k] for y in yaws)


def test_rays_of_right_pairs_meet_at_the_true_yaw(scene_of: SceneOf) -> None:
    """Eq. 22 in its own form: without noise n . (R d) vanishes for inliers, so that they agree within any bound."""
    problem = scene_of("panorama", correspondences=30, outlier_rate=0.5, noise_px=0.0).problem()
    aligned = problem.aligned
    assert problem.truth_cam_from_map is not None and problem.truth_inliers is not None
    yaw = yaw_of(aligned.align_pose(problem.truth_cam_from_map)[:, :3])
    right = np.flatnonzero(problem.truth_inliers)
    for i, j in pairwise(right):
        normal = np.cross(aligned.bearings[i], aligned.bearings[j])
        assert abs(normal @ yaw_rotation(yaw) @ (aligned.points[i] - aligned.points[j])) < 1e-9
    bound = bounds_of(aligned, 1e-6).radians
    agree = agreement(aligned, bound, yaw, right, right)
    assert (agree | np.eye(len(right), dtype=bool)).all()


@pytest.mark.parametrize("estimator", ["mc", "mc-exact", "ransac-2p", "ransac-mlpnp"])
@pytest.mark.parametrize("gravity_error_deg", [0.0, 0.2])
def test_verdicts_repeat_the_run(scene_of: SceneOf, estimator: str, gravity_error_deg: float) -> None:
    trace = estimate(scene_of("fisheye", outlier_rate=0.1, gravity_error_deg=gravity_error_deg).problem(), estimator)
    known = verdicts(trace)
    assert known.estimate is not None and trace.cam_from_map is not None
    with np.errstate(invalid="ignore"):
        assert np.array_equal(known.estimate.px <= known.limit_px, trace.inlier_mask)
    rays = transform(trace.cam_from_map, trace.problem.points)
    pixels, valid = trace.problem.camera.project(rays)
    near = valid & (known.estimate.px < 3.0)
    errors = np.linalg.norm(pixels - trace.problem.pixels, axis=1)
    assert near.sum() > 10 and np.allclose(known.estimate.px[near], errors[near], rtol=0.05, atol=1e-3)
    cosine = np.einsum("ni,ni->n", trace.problem.bearings, rays) / np.linalg.norm(rays, axis=1)
    assert np.allclose(np.cos(known.estimate.rad), cosine)
    assert np.array_equal(np.isinf(known.estimate.px), cosine <= 0)


def test_a_card_counts_what_brute_force_counts(scene_of: SceneOf) -> None:
    trace = estimate(scene_of("mei", correspondences=60).problem(), "mc")
    problem, bounds = trace.problem, run_bounds(trace)
    assert trace.cam_from_map is not None and problem.truth_cam_from_map is not None
    aligned, everybody = problem.aligned, np.arange(60)
    silent = unbounded(aligned, bounds.radians, everybody, everybody)
    for number in (0, 1, int(np.argmax(trace.inlier_mask)), 59):
        what = explain(trace, number)
        assert what.others == 59 and what.estimate is not None and what.truth is not None
        for pairs, known in ((what.at_estimate, trace.cam_from_map), (what.at_truth, problem.truth_cam_from_map)):
            yaw = yaw_of(aligned.align_pose(known)[:, :3])
            agree = covered(problem, bounds.noise_px, yaw)[number] | silent[number]
            agree[number] = False
            assert pairs is not None and pairs.yaw_deg == pytest.approx(np.degrees(yaw))
            assert pairs.agree == agree.sum() and pairs.agree_inliers == (agree & trace.inlier_mask).sum()
            assert pairs.agree + pairs.excluded + pairs.impossible == 59
            assert len(pairs.worst) == min(WORST, pairs.excluded)
            assert not any(agree[other] for other, _ in pairs.worst)
            assert [off for _, off in pairs.worst] == sorted((off for _, off in pairs.worst), reverse=True)


def lost(trace: Trace, right: np.ndarray) -> Trace:
    """The run, had it ended at another pose that explains some matches that the truth calls wrong."""
    wrong = pose(yaw_rotation(1.0), np.array([0.5, 0.0, 1.0]))
    return replace(trace, cam_from_map=wrong, inlier_mask=~right)


@pytest.fixture(scope="module")
def trace(scene_of: SceneOf) -> Trace:
    return estimate(scene_of("mei", correspondences=60, outlier_rate=0.5).problem(), "mc")


def test_words_follow_the_evidence(trace: Trace) -> None:
    known, right = verdicts(trace), trace.problem.truth_inliers
    assert right is not None and known.estimate is not None and np.array_equal(right, trace.inlier_mask)
    kept = explain(trace, int(np.argmax(right)))
    assert kept.verdict == "Kept, rightly" and "within its bound of 3 px" in kept.reason and kept.kept
    behind = int(np.flatnonzero(np.isinf(known.estimate.px))[0])
    away = explain(trace, behind)
    assert away.verdict == "Rejected, rightly" and "from the direction of its pixel" in away.reason
    assert f"{np.degrees(known.estimate.rad[behind]):.0f}°" in away.reason and "wrong match" in away.reason
    far = int(np.flatnonzero(~right & np.isfinite(known.estimate.px))[0])
    px = known.estimate.px[far]
    assert f"{px / 3.0:,.0f} times its bound of 3 px" in explain(trace, far).reason


def test_words_about_a_run_that_ended_elsewhere(trace: Trace) -> None:
    right = trace.problem.truth_inliers
    assert right is not None and trace.cam_from_map is not None
    failed = lost(trace, right)
    loser, chance = explain(failed, int(np.argmax(right))), explain(failed, int(np.argmin(right)))
    assert loser.verdict == "Rejected, wrongly" and "agrees with the true pose" in loser.reason
    assert "the run ended" in loser.reason and "m and" in loser.reason
    assert chance.verdict == "Kept, wrongly" and "agrees with a wrong pose" in chance.reason
    unknown = replace(
        failed, problem=replace(failed.problem, truth_cam_from_map=None, truth_inliers=None), inlier_mask=right & False
    )
    plain = explain(unknown, int(np.argmax(right)))
    assert plain.verdict == "Rejected" and plain.right is None and plain.at_truth is None and plain.truth is None
    alternative = explain(unknown, int(np.argmax(right)), trace.cam_from_map)
    assert "agrees with another pose" in alternative.reason and "agrees with another pose" not in plain.reason


def test_labels_that_the_true_pose_does_not_bear_out(trace: Trace) -> None:
    right = trace.problem.truth_inliers
    assert right is not None
    swapped = replace(trace, problem=replace(trace.problem, truth_inliers=~right))
    assert "the bound is too tight for it" in explain(swapped, int(np.argmin(right))).reason
    assert "Its label says that it is wrong, though" in explain(swapped, int(np.argmax(right))).reason


def test_a_run_without_a_pose(trace: Trace) -> None:
    right = trace.problem.truth_inliers
    assert right is not None
    nothing = replace(trace, cam_from_map=None, inlier_mask=np.zeros(60, dtype=bool), stages=())
    what = explain(nothing, int(np.argmax(right)))
    assert what.verdict == "Not judged" and "no pose" in what.reason and "a right match" in what.reason
    assert what.at_estimate is None and what.at_truth is not None and what.stages == ()


def test_a_pixel_that_the_camera_does_not_see(scene_of: SceneOf) -> None:
    problem = scene_of("mei", correspondences=30, outlier_rate=0.3).problem()
    pixels = problem.pixels.copy()
    pixels[5] = [1e5, 1e5]
    unseen = replace(problem, pixels=pixels)
    assert not unseen.usable[5]
    trace = estimate(unseen, "mc")
    what = explain(trace, 5)
    assert what.verdict == "Cannot be used" and "does not see this pixel" in what.reason
    assert what.others == 0 and what.estimate is None and what.at_truth is None and np.isnan(what.bound_deg)
    other = explain(trace, 6)
    assert other.others == 28
    assert "does not see 1 of their pixels" in explain_many(trace, np.arange(4, 8)).sentences[0]
    assert match_rows(trace).agree[5] == -1


def test_there_is_no_match_of_that_number(trace: Trace) -> None:
    for number in (-1, 60):
        with pytest.raises(IndexError):
            explain(trace, number)


@pytest.mark.parametrize(
    "estimator, words",
    [("mc", ("yaw clique", "translation clique")), ("mc-exact", ("largest set",)), ("ransac-2p", ("RANSAC",))],
)
def test_stages_say_what_part_a_match_had(scene_of: SceneOf, estimator: str, words: tuple[str, ...]) -> None:
    trace = estimate(scene_of("mei", correspondences=40, outlier_rate=0.5).problem(), estimator)
    inside, outside = (
        explain(trace, int(k)).stages for k in (np.argmax(trace.inlier_mask), np.argmin(trace.inlier_mask))
    )
    assert len(inside) == len(words) and inside != outside
    for word, part, other in zip(words, inside, outside, strict=True):
        assert word in part and word in other
        assert other.startswith(("in 0 of", "not in", "explained by 0", "explained by")), other


def test_a_card_says_at_which_stage_a_match_was_lost(scene_of: SceneOf) -> None:
    trace = estimate(scene_of("panorama", correspondences=60, outlier_rate=0.8, seed=0).problem(), "mc")
    yaw, translation = trace.stage(YawStage), trace.stage(TranslationStage)
    assert yaw is not None and translation is not None
    voted, located = set(yaw.pairs[yaw.clique].ravel()), set(translation.pairs[translation.clique].ravel())
    lost = {"yaw arcs": set(range(60)) - voted, "translation balls": voted - located, "": located}
    assert all(lost.values())
    for where, numbers in lost.items():
        for number in numbers:
            what = explain(trace, int(number))
            said = "lost at the " in what.reason
            assert said == (bool(where) and not what.kept) and (not said or f"lost at the {where}" in what.reason)
            later = "not lost before the refinement: balls of it are in the maximum clique" in what.reason
            assert later == (not where and not what.kept)
    assert any(not trace.inlier_mask[number] for number in located), "some are lost after all stages"


def _outside(stage: TranslationStage) -> int:
    """A ball that is not in the clique, of a pair that has no other."""
    members = {tuple(pair) for pair in stage.pairs[stage.clique].tolist()}
    return next(ball for ball, pair in enumerate(stage.pairs.tolist()) if tuple(pair) not in members)


def test_what_several_have_in_common(trace: Trace) -> None:
    right = trace.problem.truth_inliers
    assert right is not None
    inliers = np.flatnonzero(right)
    some = explain_many(trace, inliers[:6])
    assert (some.count, some.kept, some.right, some.agree, some.pairs) == (6, 6, 6, 15, 15)
    assert some.median_px is not None and some.median_px < 3.0
    two = explain_many(trace, inliers[:2])
    aligned = trace.problem.aligned
    pairs, lo, _ = yaw_arcs(aligned, run_bounds(trace).radians)
    own = np.flatnonzero((pairs == inliers[:2]).all(axis=1))
    assert f"{np.degrees(lo[own[0]]):.1f}° to" in two.sentences[0] and len(own) == two.sentences[0].count(" to ")
    stage = trace.stage(TranslationStage)
    assert stage is not None
    for ball, words in ((int(stage.clique[0]), "is in"), (_outside(stage), "is not in")):
        told = explain_many(trace, stage.pairs[ball]).sentences[1]
        assert told.startswith("Their ball has a radius of ") and told.endswith(f"{words} the maximum clique.")
    failed = explain_many(lost(trace, right), inliers[:6])
    assert any("6 agree with the true pose and not with the estimated one" in words for words in failed.sentences)


def test_references_in_common(trace: Trace) -> None:
    images = (Path("a.png"), Path("b.png"))
    index = np.arange(60) % 2
    both = replace(trace, problem=replace(trace.problem, reference_images=images, reference_index=index))
    assert "All were matched with b.png." in explain_many(both, np.array([1, 3, 5])).sentences
    assert "They come from 2 references." in explain_many(both, np.array([1, 2, 3])).sentences


def test_rows_filter_and_sort(trace: Trace) -> None:
    right = trace.problem.truth_inliers
    assert right is not None
    rows = match_rows(lost(trace, right))
    assert set(order(rows, "wrongly kept", "number", False)) == set(np.flatnonzero(~right))
    assert set(order(rows, "wrongly rejected", "number", False)) == set(np.flatnonzero(right))
    assert sum(len(order(rows, name, "number", False)) for name in ("inliers", "outliers")) == 60
    rows = match_rows(trace)
    for by in SORTS:
        up, down = order(rows, "all", by, False), order(rows, "all", by, True)
        assert sorted(up) == sorted(down) == list(range(60))
    ascending = rows.px[order(rows, "all", "px", False)]
    finite = ascending[np.isfinite(ascending)]
    assert np.all(np.diff(finite) >= 0) and np.isinf(ascending[len(finite) :]).all()
    most = rows.agree[order(rows, "all", "agrees", False)]
    assert np.all(np.diff(most) <= 0) and rows.partners == right.sum() and most[0] == right.sum() - 1
    assert set(FILTERS) == {"all", "inliers", "outliers", IN_CLIQUE, "wrongly kept", "wrongly rejected"}


def test_members_of_the_clique_are_listed_where_there_is_one(scene_of: SceneOf) -> None:
    problem = scene_of("mei", correspondences=60).problem()
    balls, exact = estimate(problem, "mc"), estimate(problem, "mc-exact")
    found, consensus = balls.stage(TranslationStage), exact.stage(ConsensusStage)
    assert found is not None and consensus is not None
    listed = order(match_rows(balls), IN_CLIQUE, "number", False)
    assert listed.tolist() == np.unique(found.pairs[found.clique]).tolist() and 2 < len(listed) < 60
    assert order(match_rows(exact), IN_CLIQUE, "number", False).tolist() == np.sort(consensus.clique).tolist()
    assert (match_rows(balls).of_balls, match_rows(exact).of_balls) == (True, False)
    assert set(offered(match_rows(balls))) == set(FILTERS)
    blind = replace(problem, truth_cam_from_map=None, truth_inliers=None)
    assert offered(match_rows(estimate(blind, "ransac-2p"))) == ("all", "inliers", "outliers")


def test_many_inliers_are_sampled(scene_of: SceneOf, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("spherloc_viz.layers.matches.MAX_PAIRS", 100)
    trace = estimate(scene_of("mei", correspondences=60, outlier_rate=0.2).problem(), "ransac-2p")
    rows = match_rows(trace)
    assert rows.partners == 16 < trace.inlier_mask.sum() and rows.agree.max() <= 16
    many = explain_many(trace, np.arange(60))
    assert many.pairs == 60 * 59 // 2 and MAX_COMPARED >= 60


def test_real_matches_are_explained(aria: Path) -> None:
    trace = estimate(load_scene(aria / "slam_right.toml").problem(), "ransac-2p")
    known = verdicts(trace)
    assert known.right is not None
    words = {(True, True): "Kept, rightly", (True, False): "Kept, wrongly", (False, True): "Rejected, wrongly"}
    for number in range(0, len(trace.problem), 60):
        what = explain(trace, number)
        kept, right = bool(trace.inlier_mask[number]), bool(known.right[number])
        assert (
            what.verdict == ("Cannot be used" if not what.usable else words.get((kept, right), "Rejected, rightly"))
            and what.reason
        )
