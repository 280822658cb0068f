"""Every preset does what its story says, and what it says to try helps."""

import json
import re
from dataclasses import replace
from html import unescape

import numpy as np
import pytest

from spherloc.diagnosis import diagnose
from spherloc.estimators import estimate, options_type
from spherloc.geometry import camera_centre, rotation_angle
from spherloc.metrics import evaluate
from spherloc.trace import Trace
from spherloc_viz.app.catalog import Catalog, RunRequest, SceneRequest
from spherloc_viz.app.controls.choices import choices_html
from spherloc_viz.app.controls.presets import RECIPES, Preset, presets

CATALOG = Catalog(None)
PRESETS = {preset.title: preset for preset in presets(CATALOG)}


def solve(preset: Preset, seed: int | None = None, **changes: object) -> Trace:
    """Run a preset; with ``estimator``, ``options`` or fields of its variation changed."""
    seed = preset.scene.seed if seed is None else seed
    estimator = str(changes.pop("estimator", preset.estimator))
    options = changes.pop("options", preset.options if estimator == preset.estimator else options_type(estimator)())
    variation = replace(preset.scene.variation, **changes)  # type: ignore[arg-type]
    return estimate(CATALOG.problem(SceneRequest(preset.scene.scene, seed, None, variation)), estimator, options, seed)


def right(trace: Trace) -> np.ndarray:
    """Mask (N,) of the right matches."""
    assert trace.problem.truth_inliers is not None
    return trace.problem.truth_inliers


def good(trace: Trace) -> bool:
    return evaluate(trace).success is True


def test_there_are_the_promised_ones_and_each_is_a_sentence() -> None:
    assert list(PRESETS) == [recipe.title for recipe in RECIPES] and len(PRESETS) == 7
    for preset in PRESETS.values():
        assert preset.story.endswith(".") and preset.story.count(".") <= 3 and len(preset.story) < 200
        assert len({RunRequest(preset.scene, preset.estimator, preset.options)}) == 1, (
            "requests are kept by their value"
        )


@pytest.mark.parametrize("title", PRESETS)
def test_the_list_says_which_fail(title: str) -> None:
    preset = PRESETS[title]
    assert good(solve(preset)) is not preset.fails
    told = choices_html(tuple(PRESETS.values()), CATALOG, False)
    assert f"{'Fails' if preset.fails else 'Succeeds'}. {preset.story[:20]}" in unescape(told)
    assert preset.story[:20] not in choices_html(tuple(PRESETS.values()), CATALOG, True), "it is an answer"


def test_each_bundled_scene_says_what_it_is_there_for() -> None:
    told = json.loads(re.findall('data-choices="([^"]*)"', choices_html((), CATALOG, False))[0].replace("&quot;", '"'))
    assert set(told) == set(CATALOG.scenes) and all(text.endswith(".") for text in told.values())
    for label, text in told.items():
        scene = CATALOG.synthetic(label)
        if scene is not None:
            wrong = round(scene.outlier_rate * scene.correspondences)
            assert f"{scene.correspondences - wrong} of {scene.correspondences} matches are right" in text
            assert "find the pose" in text
            for estimator in ("mc", "ransac-2p"):
                assert good(estimate(CATALOG.problem(SceneRequest(label, 0)), estimator)), estimator


def test_a_catalog_with_a_scene_of_its_own_has_them_too(tmp_path) -> None:
    copy = tmp_path / "mine.toml"
    copy.write_text(CATALOG.path(PRESETS["Coherent outliers"].scene.scene).read_text())
    others = {preset.title: preset for preset in presets(Catalog(copy))}
    assert list(others) == list(PRESETS)
    problem = Catalog(copy).problem(others["Coherent outliers"].scene)
    np.testing.assert_array_equal(problem.pixels, CATALOG.problem(PRESETS["Coherent outliers"].scene).pixels)


def test_a_quiet_start() -> None:
    trace = solve(PRESETS["A quiet start"])
    assert good(trace) and trace.certificate is not None and trace.certificate.proven
    hopeless = solve(PRESETS["A quiet start"], outlier_rate=0.97, correspondences=60)
    assert not good(hopeless)


def test_fig_6() -> None:
    preset = PRESETS["Paper Fig. 6 at 90 %"]
    trace = solve(preset)
    assert len(trace.problem) == 100 and np.count_nonzero(right(trace)) == 10
    assert trace.problem.camera.model == "mei"
    assert all(good(solve(preset, seed)) for seed in range(10))


def test_ransac_bad_luck() -> None:
    preset = PRESETS["RANSAC bad luck"]
    assert not good(solve(preset)) and diagnose(solve(preset)).cause == "iterations ran out"
    more = solve(preset, options=replace(preset.options, iterations=1000))
    assert good(more) and sum(good(solve(preset, seed)) for seed in range(8)) >= 5
    assert CATALOG.problem(replace(preset.scene, seed=0)) is CATALOG.problem(PRESETS["Paper Fig. 6 at 90 %"].scene)


def test_coherent_outliers() -> None:
    preset = PRESETS["Coherent outliers"]
    trace = solve(preset)
    assert not good(trace) and trace.certificate is not None and trace.certificate.proven
    assert np.count_nonzero(trace.inlier_mask & ~right(trace)) >= 55
    assert diagnose(trace).cause == "larger false consensus"
    assert good(solve(preset, outlier_rate=0.45))


def test_repeated_facades() -> None:
    preset = PRESETS["Repeated facades"]
    trace = solve(preset)
    assert trace.cam_from_map is not None and trace.problem.truth_cam_from_map is not None
    truth = trace.problem.truth_cam_from_map
    step = camera_centre(trace.cam_from_map) - camera_centre(truth)
    np.testing.assert_allclose(np.abs(step), [2.0, 0.0, 0.0], atol=0.05)
    assert np.degrees(rotation_angle(truth[:, :3].T @ trace.cam_from_map[:, :3])) < 1
    assert good(solve(preset, outlier_rate=0.6))


def test_horizontal_bearings() -> None:
    preset = PRESETS["Horizontal bearings"]
    trace = solve(preset)
    assert not good(trace) and good(solve(preset, estimator="mc-exact"))
    bearings = trace.problem.bearings[right(trace)]
    assert np.degrees(np.arcsin(np.abs(bearings[:, 1]))).max() < 8
    assert good(solve(preset, cloud_height_m=None)), "it is the height of the cloud"


def test_tilted_car() -> None:
    preset = PRESETS["Tilted car"]
    trace = solve(preset)
    tilt = np.degrees(np.arccos(trace.problem.gravity_camera[1]))
    assert tilt == pytest.approx(1.4, abs=0.05) and tilt < np.degrees(trace.problem.gravity_bound_rad)
    errors, believed = evaluate(trace), replace(preset.options, gravity_sd_deg=None)
    assert not errors.success and errors.rotation_error_deg is not None and errors.rotation_error_deg > 1
    mended = evaluate(solve(preset, options=believed))
    assert mended.success and mended.rotation_error_deg is not None and mended.rotation_error_deg < 0.2
    assert good(solve(preset, gravity_error_deg=None)), "it is gravity"
