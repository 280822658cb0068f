"""The parts of the page that need no browser: colours, plots, text, steps, scenes, options, views, threads."""

import dataclasses
import math
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import viser

from spherloc import registry
from spherloc.datasets import bundled_scenes, load_scene
from spherloc.datasets.synthetic import SyntheticScene
from spherloc.datasets.variation import Variation
from spherloc.diagnosis import Cause, Diagnosis
from spherloc.errors import InputError
from spherloc.estimators import estimate, options_type
from spherloc_viz import style
from spherloc_viz.app.catalog import Catalog, SceneRequest, camera_label
from spherloc_viz.app.controls.estimator_controls import EstimatorControls, Option, estimator_labels
from spherloc_viz.app.controls.steps_panel import find_step
from spherloc_viz.app.stage import views
from spherloc_viz.app.stage.painter import light_bytes, surface_bytes
from spherloc_viz.app.text import cause_html, evidence_html, key_step_html, status_html, step_html, table_html
from spherloc_viz.app.workers import LatestWorker
from spherloc_viz.layers import paint, steps
from spherloc_viz.layers.primitives import Balls, Points, Step, StepHeading, Table
from spherloc_viz.options import option_fields
from tests.waiting import LIMIT_S, until

COLORS = np.array([color for color, _ in style.LEGEND] + [style.SPHERE], np.uint8)


def on_screen(light: np.ndarray) -> np.ndarray:
    """What three.js shows for linear light: ACESFilmicToneMapping as in its shader, then sRGB, as bytes."""
    into = np.array([[0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777]])
    out = np.array([[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]])
    v = light / 0.6 @ into.T
    v = (v * (v + 0.0245786) - 0.000090537) / (v * (0.983729 * v + 0.4329510) + 0.238081)
    linear = np.clip(v @ out.T, 0, 1)
    return 255 * np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def test_colours_arrive_as_the_legend_shows_them() -> None:
    shown = on_screen(light_bytes(COLORS) / 255.0)
    # The filmic curve cannot show pure hues: the yellow of the clique keeps a little blue.
    assert np.abs(shown - COLORS).max() <= 18
    assert np.abs(shown - COLORS).mean() <= 2
    assert np.abs(on_screen(COLORS / 255.0) - COLORS).mean() > 30, "sent as they are they would be far off"


def test_surface_colours_are_encoded_once_more() -> None:
    srgb = surface_bytes(COLORS) / 255.0
    light = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    assert np.abs(255 * light - light_bytes(COLORS)).max() <= 1.5


EVIL = '<img src=x onerror="alert(1)">&\'"'


def test_every_text_is_escaped() -> None:
    pieces = [
        step_html(Step("key", EVIL, EVIL, EVIL, EVIL)),
        table_html(Table("any", ("", ""), ((EVIL, EVIL), ("number", 3.0)))),
        table_html(Table("any", (EVIL, "", ""), ((EVIL, EVIL, EVIL),))),
        cause_html(Diagnosis(Cause.AMBIGUOUS, True, EVIL, (EVIL,), EVIL, False)),
        evidence_html(Diagnosis(Cause.AMBIGUOUS, True, EVIL, (EVIL,), EVIL, False)),
        evidence_html(Diagnosis(Cause.OK, False, EVIL, (), "", True)),
        key_step_html((StepHeading("a", EVIL), StepHeading("b", EVIL), StepHeading("outcome", EVIL)), 1, 0, True),
        status_html(EVIL, wrong=True),
    ]
    for html in pieces:
        assert "<img" not in html and "&lt;img src=x onerror=&quot;alert(1)&quot;&gt;&amp;" in html


@pytest.mark.parametrize(
    "key, found",
    [
        ("yaw-arcs", "outcome"),
        ("sample-2", "sample-2"),
        ("sample-9", "sample-3"),
        ("bearings", "bearings"),
        ("", "outcome"),
    ],
)
def test_a_step_is_kept_over_runs_where_it_can(key: str, found: str) -> None:
    keys = ["problem", "bearings", "sample-1", "sample-2", "sample-3", "outcome"]
    timeline = [StepHeading(name, name) for name in keys]
    assert keys[find_step(timeline, key)] == found


def request_of(catalog: Catalog, label: str) -> SceneRequest:
    scene = catalog.synthetic(label)
    assert scene is not None
    return SceneRequest(label, scene.seed)


def test_untouched_controls_give_the_scene_itself() -> None:
    catalog = Catalog(None)
    simulated = [scene for path in bundled_scenes().values() if isinstance(scene := load_scene(path), SyntheticScene)]
    assert len(simulated) >= 6 and list(catalog.scenes)[: len(simulated)] == [scene.name for scene in simulated]
    for scene in simulated:
        expected, given = scene.problem(), catalog.problem(request_of(catalog, scene.name))
        assert np.array_equal(expected.pixels, given.pixels) and np.array_equal(expected.points, given.points)


def test_another_camera_sees_the_same_simulation() -> None:
    catalog = Catalog(None)
    label = next(iter(catalog.scenes))
    assert len(catalog.cameras) == 3
    for name, path in catalog.cameras.items():
        problem = catalog.problem(replace(request_of(catalog, label), variation=Variation(camera=path)))
        assert camera_label(problem.camera) == name and len(problem) == 100


def test_gravity_error_is_simulated_and_stated() -> None:
    catalog = Catalog(None)
    request = request_of(catalog, next(iter(catalog.scenes)))
    exact, off = catalog.problem(request), catalog.problem(replace(request, variation=Variation(gravity_error_deg=0.5)))
    assert off.gravity_sd_rad == pytest.approx(np.radians(0.5)) and np.array_equal(exact.points, off.points)
    assert not np.array_equal(exact.gravity_camera, off.gravity_camera)


def test_the_given_scene_comes_first_and_once(tmp_path: Path) -> None:
    bundled = list(bundled_scenes().values())
    copy = tmp_path / "mine.toml"
    copy.write_text(bundled[0].read_text())
    labels = list(Catalog(copy).scenes)
    assert len(labels) == len(bundled) + 1 and f"{labels[0]} ({bundled[0].name})" in labels[1:]
    assert len(Catalog(bundled[2]).scenes) == len(bundled)
    with pytest.raises(InputError):
        Catalog(tmp_path / "missing.toml")


def test_a_diagnosis_tells_cause_evidence_and_advice_and_is_quiet_about_good_runs() -> None:
    wrong = Diagnosis(Cause.GRAVITY_OFF, True, "The summary.", ("One.", "Two."), "The advice.", False)
    above, below = cause_html(wrong), evidence_html(wrong)
    for part in ("Gravity prior off", "The summary.", "The advice."):
        assert part in above and part not in below
    for part in ("<li", "One.", "Two.", "without the truth"):
        assert part in below and part not in above
    named = cause_html(replace(wrong, advice="Raise bound_px."))
    assert "Raise Bound (px)." in named, "the page names an option as its settings do"
    fine = replace(wrong, cause=Cause.OK, doubtful=False, evidence=())
    quiet = evidence_html(fine)
    assert (
        cause_html(fine) == ""
        and "The summary." in quiet
        and "advice" not in quiet
        and style.css(style.OUTLIER) not in quiet
    )


def test_steps_before_the_outcome_say_where_a_run_goes_wrong_and_not_why() -> None:
    timeline = tuple(StepHeading(key, f"Title of {key}") for key in ("problem", "yaw-clique", "clique", "outcome"))
    before, here, after = (key_step_html(timeline, 1, index, True) for index in (0, 1, 2))
    assert before == after and "goes wrong at step 2" in before and 'data-touch="step:yaw-clique"' in before
    assert "Title of yaw-clique" in before and "Here the run goes wrong" in here and 'data-touch="step:outcome"' in here
    doubtful = key_step_html(timeline, 3, 1, False)
    assert "is doubtful" in doubtful and 'data-touch="step:outcome"' in doubtful and "step 4" not in doubtful


def test_wide_tables_have_headings_and_narrow_ones_none() -> None:
    assert "off the truth" in table_html(Table("poses", ("", "yaw", "off the truth"), (("1", "2", "3"),)))
    assert "this run" not in table_html(Table("outcome", ("", "this run"), (("1", "2"),)))


def test_estimators_are_offered_in_their_order() -> None:
    names = ("auto", "mc", "mc-exact", "ransac-2p", "ransac-epnp", "ransac-svd", "zebra")
    labels = estimator_labels(names)
    assert list(labels.values()) == ["mc-exact", "mc", "ransac-2p", "auto", "ransac-epnp", "ransac-svd", "zebra"]
    assert all(label.startswith(name) for label, name in labels.items()) and len(labels) == len(names)


@dataclasses.dataclass(frozen=True)
class Every:
    """One option of every form."""

    limit: float | None = None
    """A limit."""
    confidence: float | None = 0.95
    """A preset that is not in the list."""
    gravity_sd_deg: float | None = None
    """A preset."""
    kernel: Literal["none", "soft_l1"] = "none"
    """A choice."""
    wise: bool = True
    """A switch."""
    tries: int = 7
    """A number."""
    time_budget_s: float = math.inf
    """A limit that need not be."""
    bound_px: float = 3.0
    """A slider."""


def test_every_form_of_option_has_a_widget_that_gives_its_default(server: viser.ViserServer) -> None:
    fields = option_fields(Every)
    options = {field.name: Option(server.gui, field) for field in fields}
    assert Every(**{name: option.read() for name, option in options.items()}) == Every()
    assert {name: type(option.widget).__name__ for name, option in options.items()} == {
        "limit": "GuiTextHandle",
        "confidence": "GuiDropdownHandle",
        "gravity_sd_deg": "GuiDropdownHandle",
        "kernel": "GuiDropdownHandle",
        "wise": "GuiCheckboxHandle",
        "tries": "GuiNumberHandle",
        "time_budget_s": "GuiTextHandle",
        "bound_px": "GuiSliderHandle",
    }
    assert options["time_budget_s"].widget.label == "Time budget (s)"


@pytest.mark.parametrize(
    ("name", "shown", "value"),
    [
        ("limit", "2.5", 2.5),
        ("limit", "inf", math.inf),
        ("limit", "", None),
        ("gravity_sd_deg", "unknown (6 DoF)", math.inf),
        ("gravity_sd_deg", "0: exact (4 DoF)", 0.0),
        ("gravity_sd_deg", "as the problem states", None),
        ("kernel", "soft l1", "soft_l1"),
        ("wise", False, False),
        ("time_budget_s", "0.5", 0.5),
    ],
)
def test_widgets_mean_what_they_show(server: viser.ViserServer, name: str, shown: object, value: object) -> None:
    field = next(field for field in option_fields(Every) if field.name == name)
    option = Option(server.gui, field)
    option.widget.value = shown
    assert option.read() == value and type(option.read()) is type(value)


def test_what_is_no_number_is_a_sentence(server: viser.ViserServer) -> None:
    field = next(field for field in option_fields(Every) if field.name == "limit")
    option = Option(server.gui, field)
    option.widget.value = "soon"
    with pytest.raises(InputError, match=r"option limit is 'soon'; give a number or none\."):
        option.read()


def test_controls_offer_every_estimator_with_its_defaults(server: viser.ViserServer) -> None:
    controls = EstimatorControls(server.gui, lambda event: None)
    assert controls.read() == ("mc", options_type("mc")())
    for label, name in estimator_labels(registry.names("estimators")).items():
        controls._estimator.value = label
        assert controls.read() == (name, options_type(name)())
        assert [other for other, folder in controls._folders.items() if folder.visible] == [name]


@pytest.mark.parametrize("estimator", registry.names("estimators"))
def test_every_option_has_its_hint(estimator: str) -> None:
    fields = option_fields(options_type(estimator))
    assert all(field.doc.endswith(".") for field in fields)
    assert {field.name for field in fields if field.shared} == {"noise_px", "gravity_sd_deg", "robust"}
    assert {"bound_px"} <= {field.name for field in fields if not field.shared}


@pytest.mark.parametrize("estimator", ["mc", "mc-exact", "ransac-2p"])
@pytest.mark.parametrize("aspect", [0.6, 1.0, 2.2])
def test_views_hold_what_they_are_about(scene_of: Callable[..., SyntheticScene], estimator: str, aspect: float) -> None:
    trace = estimate(scene_of("panorama", correspondences=60).problem(), estimator)
    for index in range(len(steps(trace))):
        picture = paint(trace, index)
        assert picture.focus.view in views.DIRECTIONS
        for button in views.DIRECTIONS:
            view = views.find(button, picture, aspect)
            assert np.isfinite(view.position).all() and np.linalg.norm(view.position - view.target) > 0
        items = {item.name: item for item in picture.scene}
        points, surface = items["map/points"], items["sphere/surface"]
        assert isinstance(points, Points)
        for button, held in (("Overview", points.positions), ("Sphere", surface.vertices)):  # type: ignore[union-attr]
            across = views.projected(views.find(button, picture, aspect), held)
            limit = np.tan(views.FIELD_OF_VIEW_RAD / 2) * np.array([aspect, 1.0])
            share = np.mean(np.all(np.abs(across) <= limit, axis=1))
            assert share >= (0.9 if button == "Overview" else 1.0)


def test_the_view_of_the_clique_shows_its_balls(scene_of: Callable[..., SyntheticScene]) -> None:
    trace = estimate(scene_of("fisheye").problem(), "mc")
    index = [step.key for step in steps(trace)].index("clique")
    picture = paint(trace, index)
    assert picture.focus.view == "Balls"
    balls = next(item for item in picture.scene if item.name == "balls/clique")
    assert isinstance(balls, Balls)
    across = views.projected(views.find("Balls", picture, 1.0), balls.centers)
    assert np.mean(np.all(np.abs(across) <= np.tan(views.FIELD_OF_VIEW_RAD / 2), axis=1)) >= 0.5


def test_requests_never_queue() -> None:
    """However often it is asked while it works, the job runs once more, and it runs for the newest state."""
    state, seen = [0], []
    gate, inside = threading.Event(), threading.Event()

    def job(asked: bool) -> None:
        seen.append(state[0])
        inside.set()
        gate.wait(LIMIT_S)

    worker = LatestWorker("test", job)
    worker.start()
    worker.ask()
    assert inside.wait(LIMIT_S)
    for number in range(1, 50):
        state[0] = number
        worker.ask()
    gate.set()
    until(lambda: len(seen) == 2)
    worker.close()
    worker.join(LIMIT_S)
    assert seen == [0, 49]


def test_an_alarm_rings_once_and_a_request_puts_it_off() -> None:
    calls: list[bool] = []
    worker = LatestWorker("test", lambda asked: calls.append(asked) or (0.01 if asked else None))
    worker.start()
    worker.ask()
    until(lambda: calls == [True, False])
    worker.ask()
    until(lambda: calls == [True, False, True, False])
    worker.close()
    worker.join(LIMIT_S)
    assert calls == [True, False, True, False]


def test_what_is_put_off_again_and_again_is_done_once_and_wakes_nobody() -> None:
    calls: list[bool] = []
    worker = LatestWorker("test", lambda asked: calls.append(asked))
    worker.start()
    worker.after(1000.0)
    until(lambda: worker._sleeps_until_s is not None)
    first = worker._sleeps_until_s
    for _ in range(100):
        worker.after(2000.0)
    assert worker._sleeps_until_s == first and not calls
    worker.after(0.01)
    until(lambda: calls == [False])
    worker.ask()
    until(lambda: calls == [False, True])
    worker.close()
    worker.join(LIMIT_S)
    assert calls == [False, True]


def test_close_ends_a_waiting_thread() -> None:
    workers = [LatestWorker("test", lambda asked: 1000.0) for _ in range(3)]
    for worker in workers:
        worker.start()
        worker.ask()
        worker.close()
        worker.join(LIMIT_S)
    assert not any(worker._thread.is_alive() for worker in workers)
