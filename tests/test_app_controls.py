"""Controls say what they show, and show what they are told: without a browser."""

import math
import re
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import viser
from hypothesis import given, settings
from hypothesis import strategies as st

from spherloc import registry
from spherloc.datasets import load_scene
from spherloc.datasets.map_scene import MapScene
from spherloc.datasets.point_cloud import OUTLIER_KINDS
from spherloc.datasets.variation import Variation
from spherloc.errors import InputError
from spherloc.estimators import options_type
from spherloc_viz.app.catalog import Catalog, SceneRequest
from spherloc_viz.app.controls.estimator_controls import EstimatorControls
from spherloc_viz.app.controls.presets import presets
from spherloc_viz.app.controls.scene_controls import CHANGED, LISTED_QUERIES, SceneControls
from spherloc_viz.app.controls.simulation_controls import KINDS, SIMULATED
from tests.datasets.test_rendered import SMALL

CATALOG = Catalog(None)
FIRST = next(iter(CATALOG.scenes))


@dataclass
class Press:
    """What viser gives to a callback when a person did something."""

    client: object = "somebody"


@pytest.fixture(scope="module")
def controls(server: viser.ViserServer) -> SceneControls:
    return SceneControls(server.gui, CATALOG.branch(), lambda event: None)


NUMBER = st.floats(0.0, 1.0)
VARIATIONS = st.builds(
    Variation,
    camera=st.sampled_from([None, *CATALOG.cameras.values()]),
    correspondences=st.one_of(st.none(), st.integers(2, 10_000)),
    noise_px=st.one_of(st.none(), st.floats(0.0, 100.0)),
    outlier_rate=st.one_of(st.none(), NUMBER),
    outlier_kind=st.sampled_from([None, *OUTLIER_KINDS]),
    field_of_view_deg=st.one_of(st.none(), st.floats(10.0, 360.0)),
    cloud_height_m=st.one_of(st.none(), st.floats(0.0, 10.0)),
    gravity_error_deg=st.one_of(st.none(), st.floats(0.0, 10.0)),
    true_camera=st.one_of(st.none(), st.tuples(*4 * [st.floats(-99.0, 99.0)])),
)
SIMULATIONS = [label for label in CATALOG.scenes if CATALOG.synthetic(label) is not None]


def own(request: SceneRequest) -> SceneRequest:
    """The request without what the scene says already."""
    scene, changes = CATALOG.synthetic(request.scene), request.variation
    same = {name: None for name in SIMULATED if getattr(changes, name) == getattr(scene, name)}
    return replace(request, variation=replace(changes, **same))


@settings(max_examples=40)
@given(st.sampled_from(SIMULATIONS), st.integers(0, 2**63 - 1), VARIATIONS)
def test_what_is_written_is_read(controls: SceneControls, label: str, seed: int, variation: Variation) -> None:
    """To the last bit, so that undo, presets and links restore what was."""
    request = SceneRequest(label, seed, None, variation)
    controls.write(request)
    assert controls.read() == own(request) and not controls.follow_scene()
    assert controls.true_camera == variation.true_camera


def test_changes_to_single_matches_are_not_shown(controls: SceneControls) -> None:
    controls.write(SceneRequest(FIRST, 1, None, Variation(noise_px=3.0, spoiled=(1,), hidden=(2,))))
    assert controls.read() == SceneRequest(FIRST, 1, None, Variation(noise_px=3.0))


def test_a_scene_that_is_chosen_brings_its_own_settings(controls: SceneControls) -> None:
    controls.write(SceneRequest(FIRST, 5, None, Variation(noise_px=3.0, true_camera=(0.0, 1.0, 2.0, 3.0))))
    other = SIMULATIONS[1]
    controls._scene.value = other
    assert controls.read().variation == Variation(), "nothing of the scene before"
    assert controls.follow_scene() and not controls.follow_scene()
    scene = CATALOG.synthetic(other)
    assert scene is not None and controls.read() == SceneRequest(other, scene.seed)
    assert not controls._simulation._moved.visible and not controls._simulation._home.visible
    np.testing.assert_array_equal(CATALOG.problem(controls.read()).pixels, scene.problem().pixels)


def test_every_slider_and_choice_changes_what_it_says(controls: SceneControls) -> None:
    shown = controls._simulation
    cases: list[tuple[Any, Any, str, Any]] = [
        (shown._points, 200, "correspondences", 200),
        (shown._noise, 2.5, "noise_px", 2.5),
        (shown._outliers, 95.0, "outlier_rate", 0.95),
        (shown._outliers, 7.0, "outlier_rate", 0.07),
        (shown._kind, next(reversed(list(KINDS))), "outlier_kind", "repeated"),
        (shown._view, 120.0, "field_of_view_deg", 120.0),
        (shown._height, 0.5, "cloud_height_m", 0.5),
        (shown._gravity, 1.5, "gravity_error_deg", 1.5),
        (shown._camera, list(CATALOG.cameras)[1], "camera", list(CATALOG.cameras.values())[1]),
    ]
    for widget, value, name, expected in cases:
        controls.write(SceneRequest(FIRST, 0))
        widget.value = value
        assert controls.read().variation == Variation(**{name: expected})
    assert tuple(KINDS.values()) == OUTLIER_KINDS


def test_the_slider_of_points_goes_to_5000_where_that_is_wanted(controls: SceneControls) -> None:
    shown, asked = controls._simulation, []
    controls.write(SceneRequest(FIRST, 0))
    shown._range.value = "to 500"
    shown._rescale(Press())
    assert shown._points.max == 500 and shown._points.value == 100
    shown._range.value = "to 5,000"
    shown._rescale(Press())
    assert shown._points.max == 5000
    shown._points.value = 4000
    shown._range.value = "to 500"
    shown._changed = asked.append
    shown._rescale(Press())
    assert shown._points.max == 500 and shown._points.value == 500 and len(asked) == 1
    controls.write(SceneRequest(FIRST, 0, None, Variation(correspondences=1000)))
    assert shown._range.value == "to 5,000" and shown._points.max == 5000


def test_the_true_camera_is_shown_and_put_back(server: viser.ViserServer) -> None:
    asked: list[object] = []
    controls = SceneControls(server.gui, CATALOG.branch(), lambda event: asked.append(event))
    controls.write(SceneRequest(FIRST, 0))
    controls.true_camera = (12.34, 1.0, -2.0, 0.5)
    assert controls.read().variation == Variation(true_camera=(12.34, 1.0, -2.0, 0.5))
    assert (
        controls._simulation._moved.visible
        and "yaw 12.3°, at (1.00, \N{MINUS SIGN}2.00, 0.50) m" in controls._simulation._moved.content
    )
    asked.clear()
    controls._simulation._put_back(press := Press())
    assert asked == [press] and controls.true_camera is None and controls.read() == SceneRequest(FIRST, 0)
    assert not controls._simulation._home.visible


def test_reset_sets_everything_to_what_the_scene_says(server: viser.ViserServer) -> None:
    controls = SceneControls(server.gui, CATALOG.branch(), lambda event: None)
    controls.write(SceneRequest(FIRST, 77, None, Variation(noise_px=3.0, true_camera=(0.0, 1.0, 2.0, 3.0))))
    scene, reset = CATALOG.synthetic(FIRST), controls.read_unchanged()
    assert scene is not None and reset == SceneRequest(FIRST, scene.seed) != controls.read()
    controls.write(reset)
    assert controls.read() == reset


def test_seeds(controls: SceneControls) -> None:
    controls.write(SceneRequest(FIRST, 2**63 - 1))
    assert controls.read().seed == 2**63 - 1
    controls.next_seed()
    assert controls.read().seed == 0
    for wrong in ("", "-1", "1.5", "²", "9" * 19, "seven"):
        controls._seed.value = wrong
        with pytest.raises(InputError, match=r"is not a whole number from 0 to 2\^63 - 1; type one\."):
            controls.read()
    controls.next_seed()
    assert controls.read().seed == 0


def many(path: Path, count: int) -> MapScene:
    """A scene with that many queries; nothing of it is drawn."""
    path.write_text(SMALL)
    scene = load_scene(path)
    assert isinstance(scene, MapScene)
    views = tuple(replace(scene.queries[0], name=f"Drive/{number:05d}.png") for number in range(count))
    return replace(scene, queries=views)


def test_thousands_of_queries_stay_usable(server: viser.ViserServer, tmp_path: Path) -> None:
    catalog = CATALOG.branch()
    label = catalog.add(many(tmp_path / "many.toml", 4000), tmp_path / "many.toml")
    controls = SceneControls(server.gui, catalog, lambda event: None)
    assert controls.write(SceneRequest(label, 0)) and controls.read() == SceneRequest(label, 0, "Drive/00000.png")
    assert controls._find.visible and len(controls._query.options) == LISTED_QUERIES
    assert "50 of 4,000 queries are listed" in controls._found.content
    assert not controls.write(SceneRequest(label, 0, "Drive/03999.png")) and controls.read().query == "Drive/03999.png"
    controls._find.value = " drive/0123 "
    controls._filter(Press())
    found = [f"Drive/0123{digit}.png" for digit in range(10)]
    assert list(controls._query.options) == ["Drive/03999.png", *found] and "10 fit" in controls._found.content
    assert controls.read().query == "Drive/03999.png", "what is typed does not choose another query"
    controls._query.value = found[4]
    assert controls.read().query == found[4]
    with pytest.raises(InputError, match="no query image 'gone'"):
        controls.write(SceneRequest(label, 0, "gone"))
    assert controls.write(SceneRequest(FIRST, 0)) and not controls._find.visible and not controls._query.visible


def test_few_queries_need_no_filter(server: viser.ViserServer, tmp_path: Path) -> None:
    catalog = CATALOG.branch()
    label = catalog.add(many(tmp_path / "few.toml", 7), tmp_path / "few.toml")
    controls = SceneControls(server.gui, catalog, lambda event: None)
    controls.write(SceneRequest(label, 3, "Drive/00004.png"))
    assert controls.read() == SceneRequest(label, 3, "Drive/00004.png")
    assert not controls._find.visible and len(controls._query.options) == 7
    assert not controls._simulation._folder.visible and not controls._simulation._points.visible


def test_a_page_has_its_own_scenes(server: viser.ViserServer, tmp_path: Path) -> None:
    one, other = CATALOG.branch(), CATALOG.branch()
    controls = SceneControls(server.gui, one, lambda event: None)
    path = tmp_path / "mine.toml"
    path.write_text(CATALOG.path(FIRST).read_text().replace("outlier_rate = 0.8", "outlier_rate = 0.5"))
    label = one.add(load_scene(path), path)
    assert label == f"{FIRST} (mine.toml)" and one.path(label) == path.resolve()
    assert label not in other.scenes and label not in CATALOG.scenes
    controls.write(SceneRequest(label, 0))
    assert controls._scene.value == label and np.mean(one.problem(controls.read()).truth_inliers) == 0.5  # type: ignore[arg-type]
    assert one.add(load_scene(path), path, "another name") == label, "the same file once"
    third = tmp_path / "more" / "mine.toml"
    third.parent.mkdir()
    third.write_text(path.read_text())
    assert one.add(load_scene(third), third) == f"{FIRST} 2"
    with pytest.raises(InputError, match="is not open on this page"):
        controls.write(SceneRequest("gone", 0))
    assert other.problem(SceneRequest(FIRST, 0)) is CATALOG.problem(SceneRequest(FIRST, 0)), "caches are shared"


def test_one_more_edit_does_not_match_images_again(tmp_path: Path) -> None:
    catalog = CATALOG.branch()
    calls: list[str] = []
    scene = many(tmp_path / "few.toml", 2)
    matches = scene.matcher

    def counted(view: Any) -> Any:
        calls.append(view.name)
        return matches(view)

    label = catalog.add(replace(scene, matcher=counted), tmp_path / "few.toml")
    for variation in (Variation(), Variation(spoiled=(1,)), Variation(spoiled=(1,), hidden=(0,)), Variation()):
        problem = catalog.problem(SceneRequest(label, 4, "Drive/00001.png", variation))
        assert len(problem) > 10
    assert calls == ["Drive/00001.png"]


def test_estimator_controls_show_what_they_are_told(server: viser.ViserServer) -> None:
    controls = EstimatorControls(server.gui, lambda event: None)
    requests: list[tuple[str, Any]] = [(name, options_type(name)()) for name in registry.names("estimators")]
    requests += [(preset.estimator, preset.options) for preset in presets(CATALOG)]
    requests += [
        ("mc-exact", options_type("mc-exact")(bound_px=0.123456789, gravity_sd_deg=0.3, time_budget_s=1e-3)),
        ("mc-exact", options_type("mc-exact")(bound_px=77.5, gravity_sd_deg=math.inf, robust="huber")),
        ("mc", options_type("mc")(max_balls=1500, noise_px=9.0)),
        ("ransac-2p", options_type("ransac-2p")(confidence=0.12345, iterations=7, local_optimization=True)),
    ]
    for name, options in [*requests, *reversed(requests)]:
        controls.write(name, options)
        assert controls.read() == (name, options)
        assert [other for other, folder in controls._folders.items() if folder.visible] == [name]
    with pytest.raises(InputError, match="unknown estimator 'magic': choose one of"):
        controls.write("magic", None)


def test_an_estimator_that_comes_with_another_bound_says_so(server: viser.ViserServer) -> None:
    controls = EstimatorControls(server.gui, lambda event: None)
    said = []
    for name in ("mc", "mc-exact", "ransac-2p", "mc"):
        controls.write(name, options_type(name)())
        said.append(re.sub("<[^>]*>", "", controls._remark.content))
    assert said[:2] == ["", ""]
    assert "now 8 px, not 3 px" in said[2] and "now 3 px, not 8 px" in said[3]


def test_a_typed_number_that_no_solver_can_reckon_with_is_refused(server: viser.ViserServer) -> None:
    controls = EstimatorControls(server.gui, lambda event: None)
    controls.write("mc", options_type("mc")())
    box = controls._options["mc"]["noise_px"].widget
    for value in (1e-300, 1e200):
        box.value = value
        with pytest.raises(InputError, match=r"option noise_px is 1e.*give a number from 1e-06 to 1e\+06"):
            controls.read()
    box.value = 0.5
    assert controls.read()[1].noise_px == 0.5


def test_a_changed_simulation_does_not_go_by_the_name_of_its_scene(controls: SceneControls) -> None:
    """That name tells a rate of outliers, which the run may no longer have."""
    scene = CATALOG.synthetic(FIRST)
    assert scene is not None
    changed, name = SceneRequest(FIRST, scene.seed, None, Variation(outlier_rate=0.3)), CHANGED.format(FIRST)
    controls.write(changed)
    assert controls._scene.value == name == controls._scene.options[0] and controls.read() == changed
    assert not controls.follow_scene()
    # Whoever chooses the scene again gets it as it is.
    controls._scene.value = FIRST
    controls._choose(viser.GuiEvent(None, None, controls._scene))
    assert not controls.follow_scene(), "the server's own setting is no choice"
    controls.write(changed)
    controls._scene.value = FIRST
    controls._choose(SimpleNamespace(client="somebody", target=controls._scene))
    assert controls.follow_scene() and controls.read() == SceneRequest(FIRST, scene.seed)
    assert controls._scene.value == FIRST and controls._scene.options == tuple(CATALOG.scenes)
    # A value that the scene has is no change.
    controls.write(SceneRequest(FIRST, 3, None, Variation(outlier_rate=scene.outlier_rate, spoiled=(1,))))
    assert controls._scene.value == FIRST
