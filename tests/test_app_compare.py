"""The comparison on the page: what is run, what is shown, and what gives way to what."""

import re
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from spherloc import registry
from spherloc.datasets.synthetic import SyntheticScene
from spherloc.errors import InputError
from spherloc.estimators import estimate, options_type
from spherloc.estimators.ransac import MAX_ITERATIONS, RansacOptions
from spherloc.problem import Problem
from spherloc.trace import Trace
from spherloc.watch import Cancelled, Watch
from spherloc_viz.app.panels import compare_panel
from spherloc_viz.app.panels.compare_panel import START, STOP, TICKED, ComparePanel, is_same
from spherloc_viz.app.web.touch import Touch, Touches
from spherloc_viz.app.web.viser_internals import start_viser, stop_viser
from spherloc_viz.layers.primitives import Label
from tests.waiting import LIMIT_S, until


class Stage:
    """A panel on a real server, with what it tells its session."""

    def __init__(self, gui: Any) -> None:
        self.used: list[str] = []
        self.redraws = 0
        self.touches = Touches(self._failed)
        self.panel = ComparePanel(gui, self.touches, self.used.append, self._redraw)
        self.touch("views:Compare,Yaw;Yaw;")

    def _failed(self, error: Exception) -> None:
        raise error

    def _redraw(self, event: object) -> None:
        self.redraws += 1

    def touch(self, words: str) -> None:
        action, _, argument = words.partition(":")
        self.touches.deliver(Touch(action, argument, 0.5, 0.5, 0.5, 0.5, False))

    def press(self) -> None:
        self.panel._press(None)  # type: ignore[arg-type]

    def tick_only(self, *names: str) -> None:
        for name in self.panel._ticked ^ set(names):
            self.touch(f"compare:{name}")

    @property
    def html(self) -> str:
        return self.panel._table.content

    @property
    def named(self) -> list[str]:
        """Estimators on the canvas."""
        trace = self.panel._trace
        assert trace is not None
        return [item.text for item in self.panel.items(trace) if isinstance(item, Label)]

    def settle(self) -> None:
        until(lambda: not self.panel._background._busy)


@pytest.fixture(scope="module")
def gui() -> Iterator[Any]:
    server = start_viser("a key of this test")
    yield server.gui
    stop_viser(server)


@pytest.fixture
def stage(gui: Any) -> Iterator[Stage]:
    out = Stage(gui)
    yield out
    out.panel.close()
    out.settle()


@pytest.fixture(scope="module")
def runs(scene_of: Callable[..., SyntheticScene]) -> tuple[Trace, Trace]:
    """One run of each of two problems."""
    scene = scene_of("panorama", correspondences=30, outlier_rate=0.4)
    return estimate(scene.problem(1), "mc", seed=5), estimate(scene.problem(2), "mc", seed=5)


def row_names(html: str) -> list[str]:
    return re.findall(r'data-touch="use:([^"]+)" title', html)[::2]


def test_every_registered_estimator_can_be_ticked(stage: Stage) -> None:
    chips = re.findall(r'role="checkbox" aria-checked="(\w+)" aria-label="([^"]+)"', stage.panel._choice.content)
    assert {name for _, name in chips} == set(registry.names("estimators"))
    assert {name for ticked, name in chips if ticked == "true"} == set(TICKED)
    stage.touch("compare:auto")
    assert 'aria-checked="true" aria-label="auto"' in stage.panel._choice.content
    stage.touch("compare:<b>evil</b>")
    assert "evil" not in stage.panel._choice.content


def test_a_comparison_shows_every_estimator(stage: Stage, runs: tuple[Trace, Trace]) -> None:
    stage.panel.draw(runs[0])
    stage.press()
    stage.settle()
    assert row_names(stage.html) == list(TICKED) and stage.panel._button.label == START
    assert stage.redraws >= 2 * len(TICKED), "each run and each diagnosis is shown as it comes"
    done = stage.panel._done
    assert done is not None and all(entry.diagnosis is not None for entry in done.entries)
    assert [chart.name for chart in done.charts] == ["comparison-residuals", "comparison-yaw"]
    assert stage.html.count("<svg") == 2 and len(stage.html) < 30_000
    assert not stage.panel._status.visible and not stage.panel._bar.visible
    found = [entry.trace.estimator for entry in done.entries if entry.trace.cam_from_map is not None]
    shared = [name for label in stage.named for name in label.split(", ")]  # cameras at one place share a label
    assert shared == found and "mc-exact" in found
    assert stage.panel.items(runs[1]) == (), "cameras of another problem would mislead"


def test_it_repeats_the_run_of_the_page(stage: Stage, runs: tuple[Trace, Trace]) -> None:
    options = options_type("mc")(bound_px=5.0)
    chosen = estimate(runs[0].problem, "mc", options, seed=9)
    stage.tick_only("mc", "ransac-2p")
    stage.panel.draw(chosen)
    stage.press()
    stage.settle()
    assert stage.panel._done is not None
    mc, two_point = (entry.trace for entry in stage.panel._done.entries)
    assert mc.options == options and (mc.seed, two_point.seed) == (9, 9)
    assert mc.cam_from_map is not None and chosen.cam_from_map is not None
    assert np.array_equal(mc.cam_from_map, chosen.cam_from_map)
    assert two_point.options == options_type("ransac-2p")(bound_px=5.0), "by the same bound"


def test_a_pressed_row_asks_for_its_estimator(stage: Stage) -> None:
    stage.touch("use:ransac-2p")
    stage.touch("use:no-such")
    assert stage.used == ["ransac-2p"]


def test_an_earlier_problem_is_shown_paler(stage: Stage, runs: tuple[Trace, Trace]) -> None:
    stage.tick_only("ransac-2p")
    stage.panel.draw(runs[0])
    stage.press()
    stage.settle()
    assert "has changed since" not in stage.html
    stage.panel.draw(runs[1])
    assert "has changed since" in stage.html and stage.named == []
    stage.panel.draw(runs[0])
    assert "has changed since" not in stage.html and stage.named == ["ransac-2p"]


def test_nothing_is_sent_where_nothing_changed(
    stage: Stage, runs: tuple[Trace, Trace], monkeypatch: pytest.MonkeyPatch
) -> None:
    stage.tick_only("ransac-2p")
    stage.panel.draw(runs[0])
    stage.press()
    stage.settle()
    calls = []
    monkeypatch.setattr(compare_panel, "comparison_html", lambda *parts: calls.append(parts) or "")
    stage.panel.draw(runs[0])
    stage.panel.draw(replace(runs[0]))
    assert not calls


def test_live_follows_the_problem(stage: Stage, runs: tuple[Trace, Trace], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compare_panel, "LIVE_AFTER_S", 0.01)
    stage.tick_only("ransac-2p")
    stage.panel.draw(runs[0])
    assert stage.panel._done is None, "nothing is compared unasked"
    stage.panel._live.value = True
    until(lambda: stage.panel._done is not None)
    stage.settle()
    stage.panel.draw(runs[1])
    stage.settle()
    assert stage.named == ["ransac-2p"] and stage.panel._done is not None
    assert stage.panel._done.problem is runs[1].problem
    shown, redraws = stage.panel._done, stage.redraws
    stage.panel.draw(estimate(runs[1].problem, "ransac-2p"))
    stage.settle()
    assert stage.panel._done is shown and stage.redraws == redraws, "another run of the same problem changes nothing"


def test_cancel_ends_it_within_a_run(stage: Stage, runs: tuple[Trace, Trace], monkeypatch: pytest.MonkeyPatch) -> None:
    begun, real = threading.Event(), compare_panel.estimate
    ended: list[Watch] = []

    def endless(problem: Problem, name: str, options: Any, seed: int, watch: Watch) -> Trace:
        if name != "ransac-2p":
            return real(problem, name, options, seed, watch)
        begun.set()
        try:
            return real(problem, name, RansacOptions(iterations=MAX_ITERATIONS), seed, watch)
        except Cancelled:
            ended.append(watch)
            raise

    monkeypatch.setattr(compare_panel, "estimate", endless)
    stage.tick_only("mc-exact", "ransac-2p")
    stage.panel.draw(runs[0])
    stage.press()
    assert begun.wait(LIMIT_S)
    assert stage.panel._button.label == STOP and stage.panel._bar.visible
    stage.press()
    stage.settle()
    assert row_names(stage.html) == ["mc-exact"] and stage.panel._button.label == START
    assert len(ended) == 1 and ended[0].fraction < 1.0


def test_what_cannot_be_compared_is_said(stage: Stage, runs: tuple[Trace, Trace]) -> None:
    stage.press()
    stage.settle()
    assert "There is no run to compare with yet" in stage.panel._status.content and stage.panel._status.visible
    stage.tick_only()
    stage.panel.draw(runs[0])
    stage.press()
    stage.settle()
    assert "No estimator is ticked" in stage.panel._status.content


def test_an_error_leaves_the_panel_usable(
    stage: Stage, runs: tuple[Trace, Trace], monkeypatch: pytest.MonkeyPatch
) -> None:
    stage.tick_only("ransac-2p")
    stage.panel.draw(runs[0])
    for error, words in ((InputError("it is <b>no</b> use."), "It is &lt;b&gt;no"), (ZeroDivisionError("x"), "a bug")):
        with monkeypatch.context() as patch:
            patch.setattr(compare_panel, "estimate", lambda *parts, error=error: (_ for _ in ()).throw(error))
            stage.press()
            stage.settle()
        assert words in stage.panel._status.content and stage.panel._button.label == START
    stage.press()
    stage.settle()
    assert row_names(stage.html) == ["ransac-2p"]


def test_a_closed_panel_does_nothing_more(gui: Any, runs: tuple[Trace, Trace]) -> None:
    stage = Stage(gui)
    stage.panel.draw(runs[0])
    stage.panel.close()
    stage.press()
    stage.settle()
    assert stage.panel._done is None


def test_the_same_problem_is_known_again(scene_of: Callable[..., SyntheticScene]) -> None:
    scene = scene_of("mei", correspondences=20)
    one = scene.problem(3)
    assert is_same(one, scene.problem(3)) and not is_same(one, scene.problem(4))
    pixels = one.pixels.copy()
    pixels[7, 1] += 1e-9
    for change in ({"pixels": pixels}, {"truth_inliers": None}, {"bound_px": 2.0}, {"gravity_bound_rad": 0.01}):
        assert not is_same(one, replace(one, **change))
