"""A session from connect to disconnect, driven by the messages that a page would send; no browser needed."""

import json
import threading
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from spherloc.datasets import bundled_scenes, load_scene
from spherloc.datasets.map_scene import MapScene
from spherloc.datasets.variation import Variation
from spherloc.diagnosis import Cause, Diagnosis
from spherloc.errors import InputError, RecordingError
from spherloc.estimators import estimate
from spherloc.geometry import align_to_down, camera_centre
from spherloc.trace import Trace
from spherloc_viz import layers
from spherloc_viz.app import compilation, run_display
from spherloc_viz.app import session as session_module
from spherloc_viz.app.catalog import Catalog, Run, RunRequest, SceneRequest
from spherloc_viz.app.compilation import Compilation
from spherloc_viz.app.server import Sessions
from spherloc_viz.app.services import Services
from spherloc_viz.app.session import Session
from spherloc_viz.app.stage import canvas as canvas_module
from spherloc_viz.app.stage import views
from spherloc_viz.app.text import HIDDEN
from spherloc_viz.app.web.touch import Touch
from spherloc_viz.app.web.viser_internals import start_viser, stop_viser
from spherloc_viz.layers.primitives import Picture
from spherloc_viz.recording.origin import Origin
from spherloc_viz.recording.storage.recorder import Ended
from tests.connected_page import HELLO, KEY, Wire
from tests.tiny_scene import write_tiny_scene
from tests.waiting import LIMIT_S, until

ALTERNATIVE = np.column_stack([np.eye(3), [1.0, 2.0, 3.0]])


class Notes:
    """Stands in for the recorder: notes what it was given."""

    def __init__(self) -> None:
        self.traces: list[Trace] = []
        self.origins: list[Origin | None] = []
        self.full = False
        self.overload = ""

    def submit(
        self,
        trace: Trace,
        origin: Origin | None = None,
        diagnosis: Diagnosis | None = None,
        ended: Ended = lambda error: None,
        known: object = None,
    ) -> Path:
        if self.full:
            raise RecordingError("run.rrd: the disk is full; make room.")
        self.traces.append(trace)
        self.origins.append(origin)
        ended(None)
        return Path(f"run-{len(self.traces)}.rrd")


class Page(Wire):
    """One connected page, which drops whatever it is sent."""

    def set(self, widget: Any, value: Any) -> None:
        """Change a widget, as the page tells it."""
        self.send({"type": "GuiUpdateMessage", "uuid": widget._impl.uuid, "updates": {"value": value}})


def threads() -> set[threading.Thread]:
    """Of all pages; those of a page that was closed may still be on their way out."""
    return {thread for thread in threading.enumerate() if thread.name.startswith("spherloc-")}


class House:
    """A server with its sessions and pages."""

    def __init__(self, catalog: Catalog) -> None:
        self.notes = Notes()
        self.services = Services(catalog, recorder=self.notes)  # type: ignore[arg-type]
        self.sessions = Sessions(self.services)
        self.server = start_viser(KEY)
        self.sessions.attend(self.server)
        self.pages: list[Page] = []

    def visit(self) -> tuple[Page, Session]:
        """A new page, once its first run is recorded."""
        known, recorded = set(self.sessions._open), len(self.notes.traces)
        self.pages.append(Page(self.server.get_port(), KEY))
        until(lambda: len(self.notes.traces) > recorded)
        (number,) = set(self.sessions._open) - known
        session = self.sessions._open[number]
        session._display.panels.steps.go("outcome")
        until(lambda: session._display.panels.steps._choice.value.endswith("Outcome"))
        until(lambda: session._display.panels._of_step == "Residuals")  # drawn after the steps
        return self.pages[-1], session

    def close(self) -> None:
        for page in self.pages:
            page.close()
        self.sessions.close()
        stop_viser(self.server)


@pytest.fixture
def house(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[House]:
    monkeypatch.setattr(session_module, "QUIET_S", 0.3)
    opened = House(Catalog(write_tiny_scene(tmp_path)))
    yield opened
    opened.close()


def shown(session: Session) -> str:
    """The step at hand, the outcome and the status, as HTML."""
    return (
        session._display.panels.steps._text.content
        + session._display.panels._outcome.content
        + session._status._line.content
    )


def test_only_the_run_that_is_settled_on_is_recorded(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    page, session = house.visit()
    slider = session._controls.scene._simulation._outliers
    with monkeypatch.context() as patch:  # no pause between two values is as long, however slow the machine
        patch.setattr(session_module, "QUIET_S", 3600.0)
        for percent in range(60, 0, -1):
            page.set(slider, float(percent))
        until(lambda: session._run.request.scene.variation.outlier_rate == 0.01)
        assert len(house.notes.traces) == 1, "values on the way are not recorded"
    page.set(slider, 0.0)

    def without_outliers() -> bool:
        truth = house.notes.traces[-1].problem.truth_inliers
        return truth is not None and bool(truth.all())

    until(without_outliers)
    last, name = house.notes.traces[-1].problem, f"Recorded as run-{len(house.notes.traces)}.rrd"
    until(lambda: name in shown(session))
    # There and back again: the page ends with the run that is recorded.
    page.set(slider, 5.0)
    page.set(slider, 0.0)
    until(lambda: slider.value == 0.0 and "Recorded as run-" in shown(session) and without_outliers())
    assert np.array_equal(house.notes.traces[-1].problem.pixels, last.pixels)


def test_steps_can_be_walked_while_a_run_is_solved(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    page, session = house.visit()
    entered, gate, solved = threading.Event(), threading.Event(), []

    def slow(*words: Any) -> Trace:
        entered.set()
        assert gate.wait(LIMIT_S)
        solved.append(words)
        return estimate(*words)

    monkeypatch.setattr(session_module, "estimate", slow)
    page.set(session._controls.scene._simulation._noise, 1.0)
    assert entered.wait(LIMIT_S)
    for noise in np.linspace(1.1, 3.0, 15):
        page.set(session._controls.scene._simulation._noise, float(noise))
    page.set(session._display.panels.steps._buttons, "Previous")
    until(lambda: "Refinement" in shown(session))
    assert not solved, "and it is still being solved"
    gate.set()
    until(lambda: len(house.notes.traces) == 2)
    assert len(solved) == 2, "of fifteen changes meanwhile only the newest was run"
    assert session._display.panels.steps._choice.value.endswith("Refinement"), "the stage is kept"


def test_while_another_scene_opens_nothing_stands_under_its_name(house: House) -> None:
    _, session = house.visit()
    story = session._display.panels
    shown = story._summary.content
    street = load_scene(bundled_scenes()["street_fisheye"])
    assert isinstance(street, MapScene)
    session._display.open_map("<elsewhere>", street, None)
    story.begin_opening("<elsewhere>")
    story.tell_opening("1 of 2", 0.5)
    until(lambda: "Opening &lt;elsewhere&gt;" in story._summary.content)
    assert "opacity:.35" in story._outcome.content and shown not in story._summary.content
    assert "Opening &lt;elsewhere&gt;" in story._card.content and "1 of 2" in story._card.content
    drawn, look = session._display.canvas._painter._drawn, session._client.camera
    until(lambda: "cloud/references" in drawn and not drawn["map/points"][0].visible)
    ends = [camera_centre(street.references[k].cam_from_map) for k in (0, -1)]
    middle = align_to_down(street.gravity_map) @ np.mean(ends, axis=0)
    until(lambda: np.linalg.norm(look.look_at - middle) < np.linalg.norm(ends[1] - ends[0]))
    session._display.end_opening()
    until(lambda: drawn["map/points"][0].visible and not drawn["cloud/references"][0].visible)
    until(lambda: story._card.content == "" and story._summary.content == shown)
    assert "opacity:.35" not in story._outcome.content


def test_while_another_scene_opens_nothing_of_the_one_before_is_offered_for_change(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    page, session = house.visit()
    path = bundled_scenes()["street_fisheye"]
    street, gate = load_scene(path), threading.Event()
    assert isinstance(street, MapScene)

    def fail(*given: Any) -> None:
        gate.wait(LIMIT_S)
        raise InputError("the map cannot be made.")

    monkeypatch.setattr(MapScene, "stored_problem", lambda *given: None)
    monkeypatch.setattr(MapScene, "prepare", fail)
    controls, card = session._controls, session._display.card._panel
    simulation = controls.scene._simulation
    session.select([4])
    session._edits.spoil()
    session.changed()
    page.set(controls._movable, True)
    handle = session._display.canvas._camera._level
    until(lambda: card.visible and handle.visible and "Matches by hand" in controls._edits.content)

    def offered() -> list[bool]:
        widgets = (simulation._points, simulation._noise, simulation._folder, controls._movable, controls._edits)
        return [widget.visible for widget in (*widgets, card, handle)]

    assert all(offered())
    session.open(RunRequest(SceneRequest(session._catalog.add(street, path), 0), "ransac-2p", None))
    until(lambda: not any(offered()))
    gate.set()
    until(lambda: all(offered()))


def test_a_view_that_a_slow_page_drops_is_set_again(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    """The page reports where its viewer began long after the checks of the first view."""
    monkeypatch.setattr(canvas_module, "FIRST_CHECKS", 0)
    monkeypatch.setattr(canvas_module, "MAX_CHECKS", 0)
    page, session = house.visit()
    canvas = session._display.canvas
    until(lambda: session._diagnosed is not None)
    until(lambda: "Diagnosing" not in session._display.panels._diagnosis.content)
    assert canvas._looked is not None
    view, before = canvas._looked[1], canvas._taken_s
    page.send(HELLO | {"position": views.START})
    until(lambda: canvas._taken_s > before)
    until(lambda: views.stands_at(session._client, view))


def test_stepping_solves_nothing(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    page, session = house.visit()
    monkeypatch.setattr(session_module, "estimate", lambda *_: pytest.fail("solved again"))
    for button, title in (("Previous", "Refinement"), ("Next", "Outcome"), ("Next", "Outcome")):
        page.set(session._display.panels.steps._buttons, button)
        until(lambda title=title: title in session._display.panels.steps._choice.value)
    page.set(session._display.panels.steps._choice, session._display.panels.steps._choice.options[0])
    until(lambda: "The matches" in session._display.panels.steps._text.content)
    page.set(session._controls.display._layers["map"], False)
    until(lambda: not session._display.canvas._painter._drawn["map/points"][0].visible)
    assert len(house.notes.traces) == 1


def test_a_pressed_reference_is_shown_beside_the_query(house: House) -> None:
    _, session = house.visit()
    catalog = session._catalog
    street = load_scene(bundled_scenes()["street_fisheye"])
    assert isinstance(street, MapScene)
    label = next(label for label, scene in catalog.scenes.items() if scene.name == street.name)
    session.open(RunRequest(SceneRequest(label, 0), "ransac-2p", None))
    until(lambda: session._run is not None and session._run.request.scene.scene == label)
    matched = [path.name for path in session._run.trace.problem.reference_images]
    view = next(view for view in street.references if view.path.name in matched)
    number = matched.index(view.path.name)
    press = session._press_photograph
    press("point cloud", view.name)
    assert session._display.panels._images._wanted == number and session._display.panels.tab == "Images"
    press("point cloud", "elsewhere.jpg")
    until(lambda: "This query was not matched with elsewhere.jpg." in session._status._line.content)


def test_steps_around_the_one_at_hand_are_painted_before_they_are_asked_for(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    page, session = house.visit()
    painted, paint_anew = [], layers._painted

    def noted(timeline: Any, index: int, told: bool) -> Picture:
        painted.append(index)
        return paint_anew(timeline, index, told)

    monkeypatch.setattr(layers, "_painted", noted)
    page.set(session._controls.scene._simulation._noise, 1.5)  # a run of which nothing is painted
    until(lambda: len(painted) == 1 + run_display.MAX_AHEAD)
    last = len(session._display.panels.steps._choice.options) - 1
    assert painted == list(range(last, last - run_display.MAX_AHEAD - 1, -1)), "the nearest first"
    session._display.panels.steps.go("yaw-candidate-1")
    until(lambda: len(painted) > 30)
    made = dict(session._display.panels._yaw._made)
    session._display.panels.steps.go("yaw-candidate-2")
    until(lambda: session._display.step_key == "yaw-candidate-2")
    place = next(k for k, step in enumerate(layers.steps(session._run.trace)) if step.key == "yaw-candidate-2")
    assert painted.count(place) == 1, "it was painted when it was not asked for, and not again"
    assert session._display.panels._yaw._html.content in {content for content, _ in made.values()}


def test_the_view_of_balls_goes_to_the_step_that_shows_them(house: House) -> None:
    """From the outcome, which shows none; from a step that does, it stays."""
    page, session = house.visit()
    display = session._display
    page.set(display.controls.display._views, "Balls")
    until(lambda: display.step_key == "clique")
    display.panels.steps.go("balls")
    until(lambda: display.step_key == "balls")
    page.set(display.controls.display._views, "Balls")
    until(lambda: display.controls.display.wanted_view is None)
    assert display.step_key == "balls"


def test_play_goes_to_the_end_and_stops(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    from spherloc_viz.app.controls import steps_panel

    monkeypatch.setattr(steps_panel, "PLAY_S", 0.05)
    page, session = house.visit()
    page.set(session._display.panels.steps._choice, session._display.panels.steps._choice.options[0])
    until(lambda: "The matches" in session._display.panels.steps._text.content)
    page.set(session._display.panels.steps._buttons, "Play")
    until(lambda: session._display.panels.steps._choice.value.endswith("Outcome"))
    steps = session._display.panels.steps
    until(lambda: not steps._playing and "Play" in steps._buttons.options)


def test_a_wrong_seed_is_a_sentence_and_the_page_goes_on(house: House) -> None:
    page, session = house.visit()
    for count, seed in enumerate(("", "x", "-1", "1.5", "9223372036854775808", "٣", "1" * 400), 2):
        before = session._run.trace
        page.set(session._controls.scene._seed, seed)
        until(lambda: session._status._complaint is not None)
        assert session._status._complaint is not None and session._status._complaint[0].endswith("type one.")
        assert "not a whole number" in shown(session) and session._run.trace is before
        page.set(session._controls.scene._seed, str(5 + count))
        until(lambda count=count: session._status._complaint is None and len(house.notes.traces) == count)
        assert house.notes.traces[-1].seed == 5 + count


def test_a_wrong_option_is_a_sentence(house: House) -> None:
    page, session = house.visit()
    page.set(session._controls.estimator._estimator, "ransac-2p (two points)")
    until(lambda: session._run is not None and session._run.trace.estimator == "ransac-2p")
    assert [name for name, folder in session._controls.estimator._folders.items() if folder.visible] == ["ransac-2p"]
    page.set(session._controls.estimator._options["ransac-2p"]["iterations"].widget, 10**9)
    until(lambda: "give a whole number up to" in shown(session))


def test_unknown_gravity_reaches_the_estimator(house: House) -> None:
    page, session = house.visit()
    page.set(session._controls.estimator._options["mc"]["gravity_sd_deg"].widget, "unknown (6 DoF)")
    until(lambda: session._run is not None and session._run.trace.options.gravity_sd_deg == np.inf)
    until(lambda: len(house.notes.traces) == 2)
    assert house.notes.traces[1].options.gravity_sd_deg == np.inf


def test_diagnosis_comes_after_the_picture_and_only_for_the_newest_run(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    page, session = house.visit()
    until(lambda: session._diagnosed is not None and session._diagnosed[0] is session._run.trace)
    entered, gate, seen = threading.Event(), threading.Event(), []

    def slow(trace: Trace) -> Diagnosis:
        seen.append(trace)
        entered.set()
        assert gate.wait(LIMIT_S)
        return Diagnosis(Cause.AMBIGUOUS, True, "Two poses.", ("Both explain 9.",), "Look twice.", True, ALTERNATIVE)

    monkeypatch.setattr(session_module, "diagnose", slow)
    page.set(session._controls.scene._simulation._noise, 1.0)
    assert entered.wait(LIMIT_S)
    until(lambda: "Diagnosing" in session._display.panels._diagnosis.content)
    for noise in np.linspace(1.1, 3.0, 15):
        page.set(session._controls.scene._simulation._noise, float(noise))
    until(lambda: session._run.request.scene.variation.noise_px == 3.0 and house.notes.traces[-1] is session._run.trace)
    page.set(session._display.panels.steps._buttons, "Previous")
    until(lambda: "Refinement" in shown(session))
    assert len(seen) == 1 and "cameras/alternative" not in session._display.canvas._painter._drawn, (
        "the page goes on meanwhile"
    )
    gate.set()
    until(lambda: 'data-touch="step:' in session._display.panels._diagnosis.content)
    assert not session._display.panels.steps.cause.content, "a step before the last tells no cause"
    assert len(seen) == 2 and seen[1] is session._run.trace, "of fifteen runs meanwhile only the newest was diagnosed"
    page.set(session._display.panels.steps._buttons, "Next")
    until(lambda: "Two poses." in session._display.panels.steps.cause.content)
    assert "Both explain 9." in session._display.panels._diagnosis.content
    until(lambda: "cameras/alternative" in session._display.canvas._painter._drawn)
    page.set(session._display.panels.steps._buttons, "Previous")
    until(lambda: not session._display.canvas._painter._drawn["cameras/alternative"][0].visible)


def test_a_full_disk_and_a_bug_are_sentences(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    page, session = house.visit()
    house.notes.full = True
    page.set(session._controls.scene._seed, "5")
    until(lambda: "the disk is full; make room." in shown(session))
    house.notes.full = False
    until(lambda: len(house.notes.traces) == 2 and "Recorded as run-2.rrd" in shown(session))
    assert house.notes.traces[-1].seed == 5, "tried again by itself"
    monkeypatch.setattr(session_module, "estimate", lambda *_: 1 / 0)
    page.set(session._controls.scene._seed, "6")
    until(lambda: "a bug in the playground (ZeroDivisionError" in shown(session))
    monkeypatch.undo()
    page.set(session._controls.scene._seed, "8")
    until(lambda: session._status._complaint is None and session._run is not None and session._run.trace.seed == 8)


def test_pages_share_nothing_and_leave_nothing(house: House) -> None:
    before = threads()
    (first, one), (second, two) = house.visit(), house.visit()
    assert len(threads() - before) == 12
    kept = two._run.trace
    first.set(one._controls.scene._simulation._points, 33)
    until(lambda: one._run is not None and len(one._run.trace.problem) == 33)
    first.set(one._display.panels.steps._buttons, "Previous")
    until(lambda: one._display.panels.steps._choice.value.endswith("Refinement"))
    assert (
        two._run.trace is kept
        and two._controls.scene._simulation._points.value == 20
        and two._display.panels.steps._choice.value.endswith("Outcome")
    )
    first.close()
    until(lambda: len(threads() - before) == 6 and len(house.sessions._open) == 1)
    second.close()
    until(lambda: not threads() - before and not house.sessions._open)


def test_only_views_that_are_seen_are_drawn(house: House) -> None:
    _, session = house.visit()
    table, residuals = session._display.panels.matches._html, session._display.panels._residuals._html
    assert table.content == "" and residuals.content == "", "another tab is open"

    def see(names: str) -> None:
        session._touches.deliver(Touch("views", names, 0.0, 0.0, 0.0, 0.0, False))

    see("Matches")
    until(lambda: 'data-touch="select:3"' in table.content)
    session._controls.scene._simulation._points.value = 30
    session.changed()
    until(lambda: session._run is not None and len(session._run.trace.problem) == 30)
    until(lambda: "all 30" in table.content)
    assert residuals.content == ""
    see("Residuals,Yaw")
    until(lambda: "select-bin" in residuals.content)


def test_a_tab_is_chosen_only_by_whoever_has_seen_the_step(house: House) -> None:
    """A page under load opens the view of a step long after it got the step."""
    _, session = house.visit()
    panels = session._display.panels

    def see(argument: str) -> str:
        session._touches.deliver(Touch("views", argument, 0.0, 0.0, 0.0, 0.0, False))
        return panels.tab

    assert panels._of_step == "Residuals"
    assert see("Yaw;;") == see("Yaw;Yaw;") == "step's", "not opened yet"
    assert see("Residuals;Residuals;") == "step's"
    assert see("Yaw;Residuals;") == "Yaw", "a person opened it"
    panels.open_tab("Matches")
    assert see("Yaw;Residuals;") == "Matches", "the page has yet to follow the link"
    assert see("Matches;Residuals;Matches 1") == "Matches"
    assert see("Residuals;Residuals;Matches 1") == "step's"


def test_what_a_link_was_refused_for_stays_until_another_run(house: House) -> None:
    """A page answers values that the server sets as if its user had set them."""
    _, session = house.visit()
    session._touches.deliver(Touch("link", "v=1&scene=nowhere", 0.0, 0.0, 0.0, 0.0, False))
    until(lambda: session._status._complaint is not None)
    number, session._answers = session._answers, -1
    session.changed()
    until(lambda: session._answers == number)
    session._solver.ask()
    assert session._status._complaint is not None and "'nowhere' is not open" in session._status._complaint[0]
    session.use_estimator("ransac-2p")
    until(lambda: session._status._complaint is None)


def test_a_link_counts_as_followed_when_its_step_is_drawn(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    _, session = house.visit()
    gate, draw = threading.Event(), session._display.draw
    monkeypatch.setattr(session._display, "draw", lambda *words: draw(*words) if gate.wait(LIMIT_S) else None)
    session._touches.deliver(Touch("link", "v=1&step=bearings", 0.0, 0.0, 0.0, 0.0, False))
    until(lambda: session._followed == 1)
    assert session._run is not None
    session._link.write(session._run)
    assert (
        "step=outcome" in session._link._addresses[0].content
        and 'data-followed="0"' in session._link._addresses[0].content
    )
    gate.set()
    until(lambda: 'data-followed="1"' in session._link._addresses[0].content)
    assert "step=bearings" in session._link._addresses[0].content


def test_matches_are_selected_and_changed_by_hand(house: House) -> None:
    _, session = house.visit()

    def press(action: str, extend: bool = False) -> None:
        name, _, argument = action.partition(":")
        session._touches.deliver(Touch(name, argument, 0.5, 0.5, 0.5, 0.5, extend))

    def variation() -> Variation:
        assert session._run is not None
        return session._run.request.scene.variation

    press("select:3")
    until(lambda: session._display.card._panel.visible and "Match 3" in session._display.card._html.content)
    press("select:7,5", extend=True)
    assert session._edits.selected == (3, 5, 7)
    for wrong in ("select:99", "select:-1", "select:x", "select:", "select:1e3", "nothing:1"):
        press(wrong)
    assert session._edits.selected == (3, 5, 7)
    before = session._run
    press("spoil:")
    until(lambda: session._run is not before and variation().spoiled == (3, 5, 7))
    until(lambda: "3 made wrong" in session._controls._edits.content)
    press("select:5")
    press("hide:")
    until(lambda: variation().hidden == (5,) and session._run is not None and len(session._run.trace.problem) == 19)
    assert 5 not in session._run.kept and session._edits.selected == ()  # type: ignore[union-attr]
    press("unhide:")
    until(lambda: variation().hidden == ())
    session.step_history(-1)
    until(lambda: variation().hidden == (5,))
    for _ in range(2):
        session.step_history(-1)
    until(lambda: variation() == before.request.scene.variation)  # type: ignore[union-attr]
    assert session._run is not None and before is not None
    assert np.array_equal(session._run.trace.cam_from_map, before.trace.cam_from_map), "to the last bit"


def test_undo_takes_back_what_was_not_solved_yet(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    """A change that waits for a slow run is taken back by itself, not together with the one before."""
    page, session = house.visit()
    until(lambda: session._run is not None)
    at_work, go_on = threading.Event(), threading.Event()

    def slow(*words: Any) -> Trace:
        at_work.set()
        go_on.wait(LIMIT_S)
        return estimate(*words)

    monkeypatch.setattr(session_module, "estimate", slow)
    scene = session._controls.scene
    page.set(scene._simulation._noise, 4.0)
    until(at_work.is_set)
    page.set(scene._seed, "77")
    until(lambda: scene._seed.value == "77")
    session.step_history(-1)
    go_on.set()

    def shown_now() -> tuple[int, float | None]:
        assert session._run is not None
        request = session._run.request.scene
        return request.seed, request.variation.noise_px

    start = session._run.request.scene.seed  # type: ignore[union-attr]
    until(lambda: shown_now() == (start, 4.0) and scene._seed.value == str(start))
    session.step_history(1)
    until(lambda: shown_now() == (77, 4.0))
    session.step_history(-1)
    session.step_history(-1)
    until(lambda: shown_now() == (start, None))
    # What is opened after an Undo that still waits is not what that takes back.
    at_work.clear()
    go_on.clear()
    page.set(scene._simulation._noise, 2.0)
    until(at_work.is_set)
    before = session._run.request  # type: ignore[union-attr]
    session.step_history(-1)
    session.open(replace(before, scene=replace(before.scene, seed=5)))
    go_on.set()
    until(lambda: shown_now() == (5, None))
    session.step_history(-1)
    until(lambda: shown_now() == (start, None))


def test_a_page_that_is_opened_by_a_link_begins_with_it(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is solved, shown or recorded before, and Undo leads to nothing else."""
    solved: list[str] = []

    def noted(*words: Any) -> Trace:
        solved.append(words[1])
        return estimate(*words)

    monkeypatch.setattr(session_module, "estimate", noted)
    page = Page(house.server.get_port(), KEY, linked=True)
    house.pages.append(page)
    until(lambda: len(house.sessions._open) == 1)
    (session,) = house.sessions._open.values()
    assert isinstance(session, Session)
    press = {"action": "link:v=1&seed=6&estimator=ransac-2p", "at": [0, 0], "from": [0, 0], "extend": False}
    page.send({"type": "GuiUpdateMessage", "uuid": "", "updates": {"touch": json.dumps(press)}})
    until(lambda: len(house.notes.traces) == 1)
    assert solved == ["ransac-2p"] and session._run is not None and session._run.request.scene.seed == 6
    until(
        lambda: (
            "estimator=ransac-2p" in session._link._addresses[0].content
            and 'data-followed="1"' in session._link._addresses[0].content
        )
    )
    session.step_history(-1)
    until(lambda: session._asked == deque() and session._controls.scene._seed.value == "6")
    assert solved == ["ransac-2p"] and len(house.notes.traces) == 1


def test_pages_begin_with_what_was_localized_before(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing else is solved before."""
    solved: list[str] = []
    monkeypatch.setattr(session_module, "estimate", lambda *words: (solved.append(words[1]), estimate(*words))[1])
    label = next(iter(house.services.catalog.scenes))
    house.services.begin = RunRequest(SceneRequest(label, 3), "ransac-2p", None)
    _, session = house.visit()
    assert solved == ["ransac-2p"] and session._run is not None and session._run.request.scene.seed == 3
    assert session._controls.scene._seed.value == "3" and session._controls.estimator.read()[0] == "ransac-2p"


def test_a_page_that_waits_for_its_first_estimator_says_so_in_the_canvas(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate = threading.Event()
    monkeypatch.setattr(compilation, "compile_apart", lambda estimator, stopped: gate.wait(LIMIT_S))
    house.services.compilation = Compilation(["mc"])
    house.services.compilation.start()
    house.pages.append(Page(house.server.get_port(), KEY))
    until(lambda: len(house.sessions._open) == 1)
    (session,) = house.sessions._open.values()
    card = session._display.panels._card
    until(lambda: "Compiling mc, once after an installation" in card.content)
    assert "tiny" in card.content and session._run is None
    gate.set()
    until(lambda: session._run is not None and card.content == "")


def test_undo_takes_back_a_change_that_cannot_be_and_nothing_before_it(house: House) -> None:
    page, session = house.visit()
    until(lambda: session._run is not None)
    scene = session._controls.scene
    page.set(scene._seed, "77")
    until(lambda: session._run.request.scene.seed == 77)  # type: ignore[union-attr]
    page.set(scene._seed, "seven")
    until(lambda: session._status._complaint is not None)
    session.step_history(-1)
    until(lambda: scene._seed.value == "77")
    assert session._run is not None and session._run.request.scene.seed == 77
    session.step_history(-1)
    until(lambda: session._run.request.scene.seed != 77)  # type: ignore[union-attr]


def test_answers_are_hidden_until_they_are_asked_for(house: House) -> None:
    page, session = house.visit()
    story, display = session._display.panels, session._controls.display

    def told() -> str:
        parts = (story._summary, story.steps.cause, story.steps._text, story._diagnosis, story._outcome)
        return "".join(part.content for part in parts)

    def drawn() -> set[str]:
        assert session._display._shown is not None
        return {item.name for item in session._display._shown[2].scene}

    until(lambda: "off the truth" in told() and "rotation error" in told())
    assert "cameras/truth" in drawn()
    page.set(display._hide, True)
    until(lambda: HIDDEN in told() and "withheld until it is revealed" in told())
    assert "off the truth" not in told() and "inliers" not in told() and story._outcome.content == ""
    assert not {"cameras/truth", "cameras/estimate"} & drawn()
    shown = house.services.presented.newest
    assert shown is not None and shown.withheld == {"outcome", "truth"}
    until(lambda: "answers=hidden" in session._link._addresses[0].content)
    page.set(display._hide, False)
    until(lambda: "Success" in told() and "answers=hidden" not in session._link._addresses[0].content)


def test_a_link_hides_the_answers_before_its_run_is_seen(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    _, session = house.visit()
    draw, arrive, seen = session._display.draw, session._arrive, []

    def note(run: Run, *given: Any) -> float | None:
        seen.append((run.request.scene.seed, session._controls.display.answers))
        return draw(run, *given)

    def arrive_late(*given: Any) -> None:
        until(lambda: any(seed == 9 for seed, _ in seen))
        arrive(*given)

    monkeypatch.setattr(session._display, "draw", note)
    monkeypatch.setattr(session, "_arrive", arrive_late)
    session._touches.deliver(Touch("link", "v=1&scene=tiny&seed=9&answers=hidden", 0, 0, 0, 0, False))
    until(lambda: session._link.arrived == 1)
    assert {answers for seed, answers in seen if seed == 9} == {"hidden"}


def test_a_slow_run_gives_way_and_can_be_cancelled(house: House) -> None:
    page, session = house.visit()
    controls = session._controls.estimator
    page.set(controls._estimator, "ransac-2p (two points)")
    until(lambda: session._run is not None and session._run.trace.estimator == "ransac-2p")
    quick = session._run
    page.set(controls._options["ransac-2p"]["iterations"].widget, 100_000_000)
    bar, button = session._controls.slow._bar, session._controls.slow._button
    until(lambda: bar.visible and button.visible)
    until(lambda: 0.0 < bar.value < 100.0)
    page.set(session._display.panels.steps._buttons, "Previous")
    until(lambda: "Refinement" in shown(session))
    page.send({"type": "GuiUpdateMessage", "uuid": button._impl.uuid, "updates": {"value": True}})
    until(lambda: "Cancelled" in shown(session) and not bar.visible)
    assert session._run is quick
    page.set(session._controls.scene._seed, "5")
    until(lambda: bar.visible)
    page.set(controls._options["ransac-2p"]["iterations"].widget, 100)
    until(lambda: session._run is not quick and session._run.trace.options.iterations == 100)
    assert session._run is not None and session._run.trace.seed == 5
    until(lambda: not bar.visible)


def test_what_a_callback_raises_is_a_sentence(house: House) -> None:
    page, session = house.visit()
    button = session._client.gui.add_button("Break")
    button.on_click(lambda event: 1 / 0)
    page.send({"type": "GuiUpdateMessage", "uuid": button._impl.uuid, "updates": {"value": True}})
    until(lambda: "a bug in the playground (ZeroDivisionError" in shown(session))
    session._touches.on("break", lambda touch: [][1])
    session._touches.deliver(Touch("break", "", 0.0, 0.0, 0.0, 0.0, False))
    until(lambda: "IndexError" in shown(session))
    page.set(session._controls.scene._seed, "8")
    until(lambda: session._status._complaint is None and session._run is not None and session._run.trace.seed == 8)
    assert session._status._complaint is None
