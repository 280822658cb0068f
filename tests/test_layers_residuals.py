"""Residuals, scores and the history of RANSAC against plain arithmetic."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from spherloc.datasets.synthetic import SyntheticScene
from spherloc.estimators import estimate
from spherloc.estimators.ransac import RansacOptions
from spherloc.geometry import transform
from spherloc.metrics import evaluate, ransac_success_probability
from spherloc.problem import Problem
from spherloc.trace import RansacStage, Trace
from spherloc_viz.layers.residuals import BINS_A_DECADE, bin_words, histogram, history_of, residuals_of, scores_table

SceneOf = Callable[..., SyntheticScene]


def unseen(problem: Problem, count: int) -> Problem:
    """The problem with its first pixels moved where the camera sees nothing."""
    pixels = problem.pixels.copy()
    pixels[:count] = -1e6
    return replace(problem, pixels=pixels)


@pytest.fixture(scope="module")
def run(scene_of: SceneOf) -> Trace:
    return estimate(scene_of("fisheye", correspondences=120).problem(), "mc")


def test_residuals_are_the_distances_in_the_image(run: Trace) -> None:
    residuals, problem = residuals_of(run), run.problem
    assert residuals is not None and run.cam_from_map is not None
    seen, valid = problem.camera.project(transform(run.cam_from_map, problem.points))
    off = np.linalg.norm(seen - problem.pixels, axis=1)
    close = valid & (off < 10.0)
    assert np.count_nonzero(close) >= 20 and np.allclose(residuals.px[close], off[close], rtol=0.05, atol=0.02)
    directions = transform(run.cam_from_map, problem.points)
    cosines = np.einsum("ni,ni->n", problem.bearings, directions) / np.linalg.norm(directions, axis=1)
    assert np.allclose(residuals.deg, np.degrees(np.arccos(np.clip(cosines, -1, 1))), atol=1e-5)
    assert np.array_equal(np.isinf(residuals.px), residuals.deg >= 90.0)


def test_every_match_is_in_one_bin_of_each_histogram(run: Trace) -> None:
    residuals = residuals_of(run)
    assert residuals is not None and residuals.truth_known
    truth = run.problem.truth_inliers
    assert truth is not None
    for shown, values in zip(residuals.histograms, (residuals.px, residuals.deg), strict=True):
        edges = np.concatenate([[0.0], shown.edges, [np.inf]])
        held = np.minimum(values, 1e300)
        assert np.all(held >= edges[shown.bin]) and np.all(held < edges[shown.bin + 1])
        kept = run.inlier_mask
        for counts, members in (
            (shown.inliers, kept),
            (shown.outliers, ~kept),
            (shown.wrongly_kept, kept & ~truth),
            (shown.wrongly_rejected, ~kept & truth),
        ):
            assert np.array_equal(counts, np.histogram(held[members], edges)[0])
        assert len(bin_words(shown.unit)) == len(shown.inliers) == 4 * BINS_A_DECADE + 2
    assert residuals.histograms[0].bound[1] == pytest.approx(run.options.bound_px)


def test_the_bound_shown_is_the_one_that_chose_the_inliers(scene_of: SceneOf) -> None:
    """By the noise where the tilt was estimated, else with gravity's error on top of it."""
    problem = scene_of("mei", gravity_error_deg=0.5).problem()
    seen = set()
    for sd_deg in (np.inf, 0.0):
        run = estimate(problem, "ransac-2p", RansacOptions(gravity_sd_deg=sd_deg, bound_px=2.0))
        residuals = residuals_of(run)
        assert residuals is not None
        px = residuals.histograms[0]
        inside = residuals.px <= px.bound[0] - 1e-9
        assert not np.any(inside & ~run.inlier_mask) and not np.any((residuals.px > px.bound[2]) & run.inlier_mask)
        assert px.widened == (px.bound[0] > run.options.bound_px + 0.1) == residuals.histograms[1].widened
        seen.add(px.widened)
    assert seen == {False, True}


def test_the_edges_of_bins_belong_to_the_bin_above() -> None:
    values = np.array([0.0, 0.1, 1.0, 999.0, 1000.0, np.inf, np.nan])
    kept = np.array([True] * 3 + [False] * 4)
    shown = histogram("px", values, (kept, kept), (3.0, 3.0, 3.0))
    assert shown.bin.tolist() == [0, 1, 1 + BINS_A_DECADE, 24, 25, 25, 25]
    assert shown.inliers.sum() == 3 and shown.outliers[25] == 3
    words = bin_words("px")
    assert words[0] == "less than 0.1 px" and words[7] == "1 to 1.5 px"
    assert words[-1] == "1000 px or more, or more than 90° off"
    assert bin_words("deg")[-1] == "100° or more, or without a bearing"


def test_without_a_pose_there_are_no_residuals(run: Trace) -> None:
    assert residuals_of(replace(run, cam_from_map=None)) is None


def test_pixels_that_the_camera_cannot_see_are_counted(scene_of: SceneOf) -> None:
    run = estimate(unseen(scene_of("fisheye", correspondences=60, outlier_rate=0.3).problem(), 4), "ransac-2p")
    residuals = residuals_of(run)
    assert residuals is not None and residuals.blind == 4
    assert np.isinf(residuals.px[:4]).all() and np.isinf(residuals.deg[:4]).all()
    for shown in residuals.histograms:
        assert (shown.bin[:4] == len(shown.inliers) - 1).all() and (shown.inliers + shown.outliers).sum() == 60


def test_without_truth_nothing_is_called_wrong(run: Trace) -> None:
    problem = replace(run.problem, truth_inliers=None, truth_cam_from_map=None)
    residuals = residuals_of(replace(run, problem=problem))
    assert residuals is not None and not residuals.truth_known
    for shown in residuals.histograms:
        assert shown.inliers.sum() == np.count_nonzero(run.inlier_mask)
        assert not shown.wrongly_kept.any() and not shown.wrongly_rejected.any()
    rows = scores_table(replace(run, problem=problem)).rows
    assert [row[0] for row in rows] == ["reported inliers"]


def test_scores_say_their_counts(run: Trace) -> None:
    mask = run.inlier_mask.copy()
    truth = run.problem.truth_inliers
    assert truth is not None
    mask[np.flatnonzero(truth)[:3]] = False
    mask[np.flatnonzero(~truth)[:2]] = True
    wrong = replace(run, inlier_mask=mask)
    metrics, rows = evaluate(wrong), {row[0]: row[1:] for row in scores_table(wrong).rows}
    hits, found, all_right = np.count_nonzero(truth & mask), np.count_nonzero(mask), np.count_nonzero(truth)
    assert rows["precision"] == (f"{hits} right of {found} reported", f"{100 * metrics.precision:.1f} %")  # pyright: ignore
    assert rows["recall"] == (f"{hits} reported of {all_right} right", f"{100 * metrics.recall:.1f} %")  # pyright: ignore
    assert rows["F1"][1] == f"{100 * 2 * hits / (found + all_right):.1f} %"
    assert rows["F1"][0] == f"2 × {hits} of {found + all_right}"


@pytest.mark.parametrize("refit", [False, True])
def test_the_history_is_what_the_run_recorded(scene_of: SceneOf, refit: bool) -> None:
    problem = scene_of("panorama", outlier_rate=0.7).problem()
    run = estimate(problem, "ransac-2p", RansacOptions(local_optimization=refit), seed=4)
    history, stage, truth = history_of(run), run.stage(RansacStage), problem.truth_inliers
    assert history is not None and stage is not None and truth is not None
    assert history.inliers.tolist() == [mask.sum() for mask in stage.inlier_masks]
    assert history.drawn.tolist() == [at + 1 for at in stage.improved_at] and history.iterations == 1000
    clean = [at + 1 for at, sample in zip(stage.improved_at, stage.samples, strict=True) if all(truth[sample])]
    assert history.clean_at == clean[0]
    for k in (1, 17, 1000):
        expected = ransac_success_probability(stage.inlier_masks[-1].mean(), 2, k)
        assert history.probability(np.array([float(k)]))[0] == pytest.approx(expected, rel=1e-12)
    assert history.probability(np.array([history.half_at]))[0] == pytest.approx(0.5)
    unknown = history_of(replace(run, problem=replace(problem, truth_inliers=None)))
    assert unknown is not None and unknown.clean_at is None


def test_a_run_without_samples_has_no_history(run: Trace) -> None:
    assert history_of(run) is None


def test_a_perfect_share_is_certain_at_once(scene_of: SceneOf) -> None:
    run = estimate(scene_of("panorama", correspondences=30, outlier_rate=0.0, noise_px=0.1).problem(), "ransac-2p")
    history = history_of(run)
    assert history is not None and history.share == 1.0 and history.half_at == 1.0
    assert history.probability(np.array([1.0])).tolist() == [1.0]
