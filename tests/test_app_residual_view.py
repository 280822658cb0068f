"""The residual view on a real server: heights, presses and what is sent."""

import re
from collections.abc import Callable
from dataclasses import replace
from html import unescape
from xml.etree import ElementTree

import numpy as np
import pytest
import viser

from spherloc.datasets.synthetic import SyntheticScene
from spherloc.estimators import estimate
from spherloc.trace import RefinementStage, Trace
from spherloc_viz.app.plots.residual_view import (
    FOOT_PX,
    ResidualView,
    histogram_svg,
    history_caption,
    history_svg,
    residuals_caption,
)
from spherloc_viz.app.plots.shapes import Scale
from spherloc_viz.app.web.touch import Touch, Touches
from spherloc_viz.layers.refinement import chart
from spherloc_viz.layers.residuals import history_of, residuals_of

SVG = "{http://www.w3.org/2000/svg}"
SceneOf = Callable[..., SyntheticScene]


@pytest.fixture(scope="module")
def run(scene_of: SceneOf) -> Trace:
    return estimate(scene_of("mei").problem(), "ransac-2p", seed=2)


def boxes(root: ElementTree.Element, name: str) -> list[tuple[float, float, float]]:
    """Left end, foot and top of every box of a path."""
    path = next((path for path in root.iter(f"{SVG}path") if path.attrib.get("class") == name), None)
    found = [] if path is None else re.findall(r"M([\d.]+) ([\d.]+)V([\d.]+)", path.attrib["d"])
    return [(float(x), float(foot), float(top)) for x, foot, top in found]


def test_bars_are_as_high_as_the_counts(run: Trace) -> None:
    residuals = residuals_of(run)
    assert residuals is not None
    marked = np.zeros(len(run.problem), dtype=bool)
    marked[[3, 5, 8, 13]] = True
    for shown in residuals.histograms:
        root = ElementTree.fromstring(histogram_svg(shown, marked))
        total = shown.inliers + shown.outliers
        y = Scale(0.0, 1.08 * total.max(), FOOT_PX, 20.0)
        for name, low, high in (
            ("inliers", np.zeros_like(total), shown.inliers),
            ("outliers", shown.inliers, total),
            ("wrongly", shown.inliers - shown.wrongly_kept, shown.inliers + shown.wrongly_rejected),
        ):
            drawn, there = boxes(root, name), high > low
            assert [top for *_, top in drawn] == pytest.approx([y.at(n) for n in high[there]], abs=0.06)
            assert [foot for _, foot, _ in drawn] == pytest.approx([y.at(n) for n in low[there]], abs=0.06)
        chosen = boxes(root, "chosen")
        counts = np.bincount(shown.bin[marked], minlength=len(total))
        assert [top for *_, top in chosen] == pytest.approx([y.at(n) for n in counts if n], abs=0.06)
        pressable = [rect for rect in root.iter(f"{SVG}rect") if "data-touch" in rect.attrib]
        places = [int(rect.attrib["data-touch"].split(":")[2]) for rect in pressable]
        assert places == np.flatnonzero(total).tolist()
        lefts = [float(rect.attrib["x"]) for rect in pressable]
        assert sorted(lefts) == lefts and lefts[-1] + float(pressable[-1].attrib["width"]) <= 380.0


def test_the_bound_is_where_the_axis_says(run: Trace) -> None:
    residuals = residuals_of(run)
    assert residuals is not None
    root = ElementTree.fromstring(histogram_svg(residuals.histograms[0], np.zeros(100, dtype=bool)))
    line = next(p for p in root.iter(f"{SVG}path") if "stroke-dasharray" in p.attrib).attrib["d"]
    ticks = {item.text: float(item.attrib["x"]) for item in root.iter(f"{SVG}text")}
    # 8 px lies at log10(8) of the way from 1 to 10.
    expected = ticks["1"] + np.log10(8.0) * (ticks["10"] - ticks["1"])
    assert float(line[1:].split(" ")[0]) == pytest.approx(expected, abs=0.2)
    assert "bound 8 px" in ticks


def test_a_press_on_a_bar_selects_the_matches_in_it(server: viser.ViserServer, run: Trace) -> None:
    touches, chosen, asked = Touches(lambda error: pytest.fail(str(error))), [], []
    view = ResidualView(server.gui, touches, asked.append, chosen.append)
    kept = np.arange(100) + 7
    touches.deliver(Touch("select-bin", "px:3", 0, 0, 0, 0, False))
    assert chosen == [] == asked, "nothing is drawn yet"
    view.draw(run, (), kept)
    residuals = residuals_of(run)
    assert residuals is not None
    for unit, shown in zip(("px", "deg"), residuals.histograms, strict=True):
        for place in np.flatnonzero(shown.inliers + shown.outliers):
            assert f'data-touch="select-bin:{unit}:{place}"' in view._html.content
            touches.deliver(Touch("select-bin", f"{unit}:{place}", 0, 0, 0, 0, False))
            assert chosen[-1] == tuple(np.flatnonzero(shown.bin == place))
    before = len(chosen)
    assert len(asked) == before > 10
    for argument in ("", "px", "px:", "px:-1", "px:²", "m:3", "px:1:2"):
        touches.deliver(Touch("select-bin", argument, 0, 0, 0, 0, False))
    assert len(chosen) == before


def test_it_sends_only_what_changed_and_little(server: viser.ViserServer, run: Trace) -> None:
    view = ResidualView(server.gui, Touches(print), lambda event: None, lambda ids: None)
    kept = np.arange(100)
    view.draw(run, (), kept)
    content = view._html.content
    assert len(content.encode()) < 30_000 and "Eq. 28" in content and "precision" in content
    view.draw(run, (), kept)
    assert view._html.content is content
    view.draw(run, (4, 9), kept)
    assert view._html.content != content
    view.draw(run, (), kept)
    assert view._html.content == content


def test_how_the_residuals_fall_is_shown_once_there_are_two_steps(server: viser.ViserServer, run: Trace) -> None:
    view = ResidualView(server.gui, Touches(print), lambda event: None, lambda ids: None)
    stage = run.stage(RefinementStage)
    assert stage is not None and len(stage.cost_px2) > 1
    for last, shown in ((0, False), (1, True)):
        view.draw(run, (), np.arange(100), chart(stage, last))
        assert ("Residual during refinement" in view._html.content) == shown


def test_runs_without_pose_or_truth_are_said_to_be(server: viser.ViserServer, run: Trace) -> None:
    touches = Touches(print)
    chosen: list[tuple[int, ...]] = []
    view = ResidualView(server.gui, touches, lambda event: None, chosen.append)
    view.draw(replace(run, cam_from_map=None), (1,), np.arange(100))
    assert "no pose" in view._html.content and "<svg" in view._html.content, "the history of the samples is there"
    touches.deliver(Touch("select-bin", "px:3", 0, 0, 0, 0, False))
    assert chosen == []
    view.draw(replace(run, problem=replace(run.problem, truth_inliers=None)), (), np.arange(100))
    shown = unescape(view._html.content)
    assert "inliers</span>" in shown and "right</span>" not in shown and not re.search(r"\d right, ", shown)
    assert "precision" not in shown and "clean sample" not in shown


def test_the_history_shows_eq_28_and_the_first_clean_sample(run: Trace) -> None:
    history = history_of(run)
    assert history is not None and history.clean_at is not None
    root = ElementTree.fromstring(history_svg(history))
    data = next(p.attrib["d"] for p in root.iter(f"{SVG}path") if p.attrib.get("class") == "chance")
    corners = np.array([corner.split(" ") for corner in data[1:].split("L")], dtype=float)
    texts = {item.text: item.attrib for item in root.iter(f"{SVG}text")}
    one, thousand = float(texts["1"]["x"]), float(texts["1000"]["x"])
    full, none = float(texts["100 %"]["y"]), float(texts["0 %"]["y"])
    drawn = 10.0 ** (3.0 * (corners[:, 0] - one) / (thousand - one))
    chance = (none - 4.0 - corners[:, 1]) / (none - full)
    assert np.allclose(chance, 1.0 - (1.0 - history.share**2) ** drawn, atol=0.01)
    dashed = next(p.attrib["d"] for p in root.iter(f"{SVG}path") if "stroke-dasharray" in p.attrib)
    at = 10.0 ** (3.0 * (float(dashed[1:].split(" ")[0]) - one) / (thousand - one))
    assert at == pytest.approx(history.clean_at, rel=0.02)
    assert f"sample {history.clean_at:,}." in history_caption(history)
    assert history_caption(replace(history, share=0.0, clean_at=None)).endswith("no sample could be of inliers only.")


def test_captions_count_what_has_no_place_on_the_axis(run: Trace) -> None:
    residuals = residuals_of(run)
    assert residuals is not None
    behind = int(np.count_nonzero(residuals.deg >= 90.0))
    assert behind and f"{behind} matches more than 90° off" in residuals_caption(residuals)
    assert "3 whose pixel the camera model cannot see" in residuals_caption(replace(residuals, blind=3))
