"""Hidden answers: no step of any estimator tells what came out, the truth or how many matches are wrong."""

import html
import re
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import viser

from spherloc.datasets.synthetic import SyntheticScene
from spherloc.estimators import default_options, estimate
from spherloc.geometry import camera_centre, yaw_of
from spherloc.trace import Trace
from spherloc_viz import style
from spherloc_viz.app.audience import AudienceControls
from spherloc_viz.app.catalog import Run, RunRequest, SceneRequest
from spherloc_viz.app.run_display import Callbacks, RunDisplay
from spherloc_viz.app.text import WITHHELD
from spherloc_viz.app.web.touch import Touch, Touches
from spherloc_viz.app.web.viser_internals import start_viser, stop_viser
from spherloc_viz.layers import steps
from spherloc_viz.layers.frame import RunView
from spherloc_viz.layers.withheld import ANSWERS, HIDDEN, ONLY_OUTCOME, untold
from tests.connected_page import KEY, ConnectedPage

SEEN = "views:Charts,Graph,Images,Matches,Residuals,Yaw;Yaw;"
WRONG = 0.63
"""Share of wrong matches: a number that nothing else on the page has."""
WORDS = re.compile(
    r"success|failure\b|doubtful|localized|no pose|inliers|precision|recall|\bF1\b|off the truth|from the truth|proven"
    r"|rotation error|position error|best pose|right ones|of them wrong|% wrong|certificate",
    re.IGNORECASE,
)
TELLING = {style.INLIER, style.OUTLIER, style.CLIQUE, style.ESTIMATE, style.TRUTH, style.ALTERNATIVE}
"""Colours of answers."""


@pytest.fixture(scope="module")
def client() -> Iterator[viser.ClientHandle]:
    server = start_viser(KEY)
    page = ConnectedPage(server, KEY)
    yield page.handle
    page.close()
    stop_viser(server)


class Reader:
    """A page that shows one run, and reads all of itself."""

    def __init__(self, client: viser.ClientHandle, trace: Trace) -> None:
        request = RunRequest(SceneRequest("scene", 0), trace.estimator, trace.options)
        self.run, self.touches = (
            Run(request, trace, np.arange(len(trace.problem))),
            Touches(lambda error: pytest.fail(str(error))),
        )
        self._before = set(client.gui._gui_input_handle_from_uuid) | set(self._parts(client))
        controls = AudienceControls(client.gui, 340, lambda event: None)
        callbacks = Callbacks(
            lambda event: None, lambda chosen, extend: None, None, lambda layer, name: None, lambda label: None
        )
        self.display = RunDisplay(client, self.touches, controls, callbacks, (380, 340))
        self.touch(SEEN)
        self._client = client

    @staticmethod
    def _parts(client: viser.ClientHandle) -> dict[str, Any]:
        boxes = list(client.gui._container_handle_from_uuid.values())
        return {uuid: part for box in boxes for uuid, part in box._children.items()}

    def touch(self, words: str) -> None:
        action, _, argument = words.partition(":")
        self.touches.deliver(Touch(action, argument, 0.5, 0.5, 0.5, 0.5, False))

    def show(self, key: str) -> str:
        """Go to a step; what the page then says, without the legend."""
        self.display.panels.steps.go(key)
        self.display.draw(self.run, None, None, (int(np.flatnonzero(self.run.trace.inlier_mask)[0]),), True, 0)
        new = [part for uuid, part in self._parts(self._client).items() if uuid not in self._before]
        said = [words_of(part.content) for part in new if hasattr(part, "content") and "Legend" not in part.content]
        chosen = [word.partition("  ")[2] or word for part in new for word in getattr(part, "options", ())]
        return " | ".join([*said, *chosen, *(item.text for item in self.scene if hasattr(item, "text"))])

    @property
    def scene(self) -> tuple[Any, ...]:
        assert self.display._shown is not None
        return self.display._shown[2].scene

    def colors(self) -> set[tuple[int, ...]]:
        """All colours on the canvas and in the charts."""
        assert self.display._shown is not None
        drawn = [item.colors for item in self.scene if hasattr(item, "colors")]
        charts = [curve.color for chart in self.display._shown[2].charts for curve in chart.curves]
        return {tuple(color) for array in drawn for color in np.unique(array, axis=0).tolist()} | set(charts)


def words_of(content: str) -> str:
    """What is read of HTML: its text, and what stands under a resting pointer."""
    hints = re.findall(r'(?:title|aria-label|alt)="([^"]*)"', content)
    text = re.sub(r"<style>.*?</style>|<[^>]*>", " ", content)
    return html.unescape(" ".join([text, *hints]))


def numbers_of(trace: Trace) -> set[str]:
    """Numbers that tell: of wrong, right and agreeing matches, and of both poses as the page writes them."""
    right = trace.problem.truth_inliers
    assert right is not None and trace.cam_from_map is not None and trace.problem.truth_cam_from_map is not None
    counts = {int(right.sum()), int((~right).sum()), int(trace.inlier_mask.sum())}
    told = {str(count) for count in counts} | {f"{100 * count / len(right):.3g} %" for count in counts}
    if trace.certificate is not None:
        told |= {str(trace.certificate.upper_bound)}
    for pose in (trace.cam_from_map, trace.problem.truth_cam_from_map):
        places = [*camera_centre(pose), float(np.degrees(yaw_of(RunView(trace).aligned_pose(pose)[:, :3])))]
        told |= {f"{abs(value):.2f}" for value in places}
    return told


def tells(text: str, numbers: set[str]) -> list[str]:
    """What of a text tells an answer."""
    spelled = "|".join(map(re.escape, sorted(numbers)))
    return WORDS.findall(text) + re.findall(rf"(?<![\d.,])(?:{spelled})(?![\d.,]*\d)", text)


@pytest.mark.parametrize(
    ("estimator", "gravity_error_deg"),
    [("mc", 0.0), ("mc-exact", 0.0), ("mc-exact", 0.5), ("ransac-2p", 0.0), ("auto", 0.0)],
)
def test_no_step_tells_a_hidden_answer(
    client: viser.ClientHandle, scene_of: Callable[..., SyntheticScene], estimator: str, gravity_error_deg: float
) -> None:
    scene = scene_of("mei", outlier_rate=WRONG, correspondences=100, gravity_error_deg=gravity_error_deg)
    problem = scene.problem(seed=4)
    trace = estimate(problem, estimator, default_options(estimator, problem), seed=4)
    page, numbers = Reader(client, trace), numbers_of(trace)
    assert len(set(tells(page.show("outcome"), numbers))) > 6 and page.colors() & TELLING, "the test can see answers"

    page.display.controls.display.answers = HIDDEN
    withheld = []
    for heading in steps(trace):
        said = page.show(heading.key)
        assert tells(said, numbers) == [], heading
        assert not page.colors() & TELLING, heading
        assert not {item.name for item in page.scene if item.layer in ("cameras", "uncertainty", "balls")}, heading
        assert page.display.step_key == heading.key
        withheld += [heading.key] if "withheld until it is revealed" in said else []
    keys = [heading.key for heading in steps(trace)]
    assert set(withheld).isdisjoint(["problem", "bearings", "match", "gravity", "unknowns"]) and "outcome" in withheld
    assert set(withheld).isdisjoint(key for key in keys if key.startswith("yaw-arcs") or key == "samples-needed")
    titles = [name.partition("  ")[2] for name in page.display.panels.steps._choice.options]
    assert all(titles[keys.index(key)] == steps(trace)[keys.index(key)].stage for key in withheld)

    # A click each: what came out, which says nothing of the truth, and the truth.
    page.touch("reveal:outcome")
    said = page.show("outcome")
    assert "inliers" in said and "The truth is unknown" in said and "cameras/estimate" in drawn(page)
    assert not re.search("off the truth|rotation error", said) and "cameras/truth" not in drawn(page)
    page.touch("reveal:truth")
    assert "off the truth" in page.show("outcome") and "cameras/truth" in drawn(page)
    page.touch("reveal:nothing")
    assert WITHHELD not in page.show("outcome")


def drawn(page: Reader) -> set[str]:
    return {item.name for item in page.scene}


def test_the_truth_alone_can_be_shown(client: viser.ClientHandle, scene_of: Callable[..., SyntheticScene]) -> None:
    trace = estimate(scene_of("mei").problem(seed=4), "mc", seed=4)
    page = Reader(client, trace)
    page.display.controls.display.answers = HIDDEN
    page.show("outcome")
    page.touch("reveal:truth")
    said = page.show("outcome")
    assert "cameras/truth" in drawn(page) and "cameras/estimate" not in drawn(page)
    assert not re.search("success|inliers|off the truth", said, re.IGNORECASE) and "withheld until" in said


def test_a_link_can_withhold_the_truth_alone(
    client: viser.ClientHandle, scene_of: Callable[..., SyntheticScene]
) -> None:
    """Lessons show what one would see in practice: the pose and the matches that agree with it."""
    trace = estimate(scene_of("mei").problem(seed=4), "mc", seed=4)
    page = Reader(client, trace)
    page.display.controls.display.answers = ONLY_OUTCOME
    assert page.display.controls.display.answers == ONLY_OUTCOME
    assert "The truth is unknown" in page.show("outcome") and "withheld until" not in page.show("yaw-clique")
    assert {"ring/estimate"} <= drawn(page) and not {"ring/truth", "cameras/truth"} & drawn(page)


def test_an_untold_run_has_no_answers(scene_of: Callable[..., SyntheticScene]) -> None:
    """What is not in the run can be drawn by no view."""
    trace = estimate(scene_of("mei").problem(seed=4), "mc", seed=4)
    bare = untold(trace, ANSWERS)
    assert bare.cam_from_map is None and not bare.inlier_mask.any() and bare.certificate is None and bare.message == ""
    assert bare.problem.truth_cam_from_map is None and bare.problem.truth_inliers is None
    assert [one.key for one in steps(bare)] == [one.key for one in steps(trace)]
    blind = untold(trace, {"truth"})
    assert blind.cam_from_map is trace.cam_from_map and blind.problem.truth_cam_from_map is None
