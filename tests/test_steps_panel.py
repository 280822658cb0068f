"""The timeline's panel: where buttons, keys, slider, list and stages lead, and how long a step plays."""

import gc
import warnings
from types import SimpleNamespace
from typing import Any

import pytest
import viser

from spherloc_viz.app.controls.steps_panel import (
    BACK,
    NEXT,
    ON,
    PLAY,
    PLAY_S,
    PREVIOUS,
    SHORT,
    StepsPanel,
    find_step,
    moved,
    stages_html,
)
from spherloc_viz.app.web.viser_internals import changes_of, start_viser, stop_viser
from spherloc_viz.layers.primitives import Step, StepHeading

TIMELINE = (
    StepHeading("problem", "The matches", "Matches"),
    StepHeading("bearings", "Bearings", "Matches"),
    StepHeading("yaw-pair", "One pair", "Yaw"),
    *(StepHeading(f"yaw-arcs-{k}", f"{k} arcs", "Yaw") for k in (10, 30, 100, 300)),
    StepHeading("yaw-arcs", "All arcs", "Yaw"),
    StepHeading("yaw-clique", "The yaw", "Yaw"),
    StepHeading("outcome", "Outcome", "Outcome"),
)
KEYS = [heading.key for heading in TIMELINE]


def event(widget: Any, client: object | None = object()) -> Any:
    """What viser tells of a widget; without a client it was Python that set it."""
    return SimpleNamespace(client=client, target=widget)


class Panel:
    """A panel with a page that presses its widgets."""

    def __init__(self, server: viser.ViserServer) -> None:
        self.asked = 0
        self.panel = StepsPanel(server.gui, self._changed)
        self.opened = self.settle()
        self.panel.go("outcome")
        self.settle()
        self.asked = 0

    def _changed(self, event: object) -> None:
        self.asked += 1

    def settle(self, steps: tuple[StepHeading, ...] = TIMELINE, asked: bool = True) -> str:
        """Key of the step at hand, after it was shown."""
        index, self.pause = self.panel.advance(steps, asked)
        heading = steps[index]
        self.panel.show(Step(heading.key, heading.title, "One. Two.", ""), self.pause is not None, ())
        return heading.key

    def page(self, callback: Any, widget: Any, value: Any) -> str:
        """The page sets a widget."""
        widget._impl.value = value
        callback(event(widget))
        return self.settle()

    def press(self, button: str) -> str:
        self.panel._press(button)
        return self.settle()


@pytest.fixture
def panel(server: viser.ViserServer) -> Panel:
    return Panel(server)


def test_a_page_opens_at_the_yaw_ring(panel: Panel) -> None:
    assert panel.opened == "yaw-clique" and panel.settle() == "outcome"
    assert panel.panel._slider.max == len(TIMELINE) and panel.panel._slider.value == len(TIMELINE)


def test_buttons_step_and_jump_between_stages(panel: Panel) -> None:
    assert [panel.press(button) for button in (PREVIOUS, PREVIOUS, NEXT)] == ["yaw-clique", "yaw-arcs", "yaw-clique"]
    assert [panel.press(BACK) for _ in range(4)] == ["yaw-pair", "problem", "problem", "problem"]
    assert [panel.press(ON) for _ in range(3)] == ["yaw-pair", "outcome", "outcome"]
    assert moved(TIMELINE, 0, PREVIOUS) == 0 and moved(TIMELINE, len(TIMELINE) - 1, NEXT) == len(TIMELINE) - 1


def test_presses_before_a_picture_all_count(panel: Panel) -> None:
    for button in (BACK, NEXT, NEXT):
        panel.panel._press(button)
    assert panel.settle() == "yaw-arcs-30"


def test_slider_list_and_stage_bars_go_to_their_step_and_agree(panel: Panel) -> None:
    inner = panel.panel
    assert panel.page(inner._slide, inner._slider, 3) == "yaw-pair"
    assert inner._choice.value == "3/10  One pair" and "One pair" in inner._text.content
    assert panel.page(inner._pick, inner._choice, inner._choice.options[5]) == "yaw-arcs-100"
    assert inner._slider.value == 6
    inner.go("problem")
    assert panel.settle() == "problem" and panel.asked == 3
    for key in ("yaw-pair", "problem", "outcome"):
        assert f'data-touch="step:{key}"' in inner._stages.content


def test_what_python_sets_is_no_request(panel: Panel) -> None:
    inner = panel.panel
    for callback, widget in ((inner._slide, inner._slider), (inner._pick, inner._choice)):
        callback(event(widget, None))
    assert panel.asked == 0 and panel.settle() == "outcome"


def test_showing_a_step_leaves_nothing_to_a_loop_that_has_ended() -> None:
    """A page is still drawn while its server goes: what nobody awaits any more was a warning now and then."""
    server = start_viser("a key")
    panel = Panel(server)
    stop_viser(server)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        for button in (PREVIOUS, BACK):
            panel.press(button)
        gc.collect()
    assert not [warning for warning in said if "never awaited" in str(warning.message)]


def test_a_thumb_that_moves_on_is_not_pulled_back(panel: Panel) -> None:
    inner, slider = panel.panel, panel.panel._slider
    changes = changes_of(slider._impl.gui_api)

    def slide(place: int) -> None:
        with changes.hearing(slider._impl.uuid, None):
            slider._impl.value = place
            inner._slide(event(slider))

    slide(3)
    with changes.as_of(changes.now()):
        index, _ = inner.advance(TIMELINE, True)
        slide(7)
        inner.show(Step(KEYS[index], "", "", ""), False, ())
    assert slider.value == 7
    assert panel.settle() == KEYS[6] and slider.value == 7


@pytest.mark.parametrize("asked_for", ["4711", "", "no-such-step", "yaw-arcs-9999999999999999999", "../../etc"])
def test_any_request_of_a_page_leads_somewhere(panel: Panel, asked_for: str) -> None:
    panel.panel.go(asked_for)
    assert panel.settle() in KEYS


def test_play_walks_all_steps_once_and_stays_longer_where_more_is_said(panel: Panel) -> None:
    assert panel.press(PLAY) == "problem"
    walked, pauses = ["problem"], [panel.pause]
    while panel.pause is not None and len(walked) < 30:
        walked.append(panel.settle(asked=False))
        pauses.append(panel.pause)
    assert walked == KEYS and pauses[-1] is None
    short, long = PLAY_S * SHORT, PLAY_S
    assert pauses[:-1] == [long, long, *[short] * 6, long]


def test_the_pace_is_chosen_and_a_press_pauses(panel: Panel) -> None:
    panel.panel._pace.value = "4×"
    panel.press(PLAY)
    assert panel.pause == PLAY_S / 4
    panel.press(NEXT)
    assert panel.pause is None
    panel.panel._pace.value = "1×"


def test_another_run_stays_at_the_same_kind_of_step(panel: Panel) -> None:
    panel.panel.go("yaw-arcs-300")
    assert panel.settle() == "yaw-arcs-300"
    fewer = tuple(heading for heading in TIMELINE if heading.key not in ("yaw-arcs-300", "yaw-arcs-100"))
    assert panel.settle(fewer) == "yaw-arcs-30"
    assert panel.panel._slider.max == len(fewer) and panel.panel._slider.value == 5


@pytest.mark.parametrize(
    "key, found",
    [
        ("yaw-arcs-1000", "yaw-arcs-300"),
        ("yaw-arcs-50", "yaw-arcs-30"),
        ("yaw-arcs-3", "yaw-arcs"),
        ("yaw-candidate-4", "yaw-clique"),
        ("balls-10", "outcome"),
    ],
)
def test_the_nearest_of_a_kind(key: str, found: str) -> None:
    assert KEYS[find_step(TIMELINE, key)] == found


def test_stage_bars_are_escaped_and_filled(panel: Panel) -> None:
    evil = (StepHeading('"><img src=x>', "t", "<b>"), StepHeading("b", "t", "<b>"), StepHeading("c", "t", "End"))
    html = stages_html(evil, 0)
    assert "<img" not in html and "<b>" not in html and "width:50.0%" in html and "width:0.0%" in html


def test_a_step_to_begin_at_gives_way_to_one_that_is_asked_for(server: viser.ViserServer) -> None:
    panel = StepsPanel(server.gui, lambda event: None)
    panel.begin_at("outcome")
    assert TIMELINE[panel.advance(TIMELINE, True)[0]].key == "outcome"
    panel.go(TIMELINE[1].key)
    panel.begin_at("outcome")
    assert panel.advance(TIMELINE, True)[0] == 1
