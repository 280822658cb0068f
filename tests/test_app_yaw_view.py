"""The yaw view: arcs against Eq. 22 by brute force, rows that do not collide, windows across the seam, and presses."""

import re
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import viser
from hypothesis import example, given, settings
from hypothesis import strategies as st

from spherloc.bounds import bounds_of
from spherloc.consensus.yaw_arcs import yaw_arcs
from spherloc.datasets.synthetic import SyntheticScene
from spherloc.estimators import estimate
from spherloc.estimators.mc import WIDEST_RAD
from spherloc.geometry import yaw_rotation
from spherloc.problem import Problem
from spherloc.trace import RansacStage, Trace, YawStage
from spherloc_viz.app.plots.yaw_view import PEAK, WHOLE, YawView, bars_html, yaw_svg
from spherloc_viz.app.web.touch import Touch, Touches
from spherloc_viz.layers import paint, steps
from spherloc_viz.layers.yaw_story import (
    ALL,
    KINDS,
    MAX_BARS,
    MAX_CHOSEN,
    ArcBars,
    PairArcs,
    Window,
    arcs_of,
    at_step,
    bars_in,
    peak_window,
    sample,
    spans_in,
    window_around,
    yaw_story,
)

SVG = "{http://www.w3.org/2000/svg}"
SceneOf = Callable[..., SyntheticScene]


@pytest.fixture(scope="module")
def runs(scene_of: SceneOf) -> dict[str, Trace]:
    problem = scene_of("mei", correspondences=120, outlier_rate=0.8).problem()
    return {name: estimate(problem, name, seed=1) for name in ("mc", "mc-exact", "ransac-2p")}


def roots_deg(problem: Problem, i: int, j: int) -> list[float]:
    """Yaws at which n . (R d) = 0 with both depths positive, found by looking at 72,000 of them (Eq. 22)."""
    aligned = problem.aligned
    a, b = (int(np.flatnonzero(aligned.index == k)[0]) for k in (i, j))
    v, w, d = aligned.bearings[a], aligned.bearings[b], aligned.points[a] - aligned.points[b]
    yaw = np.radians(np.arange(-180.0, 180.0, 0.005))
    turned = np.column_stack(
        [d[0] * np.cos(yaw) + d[2] * np.sin(yaw), np.full_like(yaw, d[1]), d[2] * np.cos(yaw) - d[0] * np.sin(yaw)]
    )
    f = turned @ np.cross(v, w)
    crossing = np.flatnonzero(np.sign(f) != np.sign(np.roll(f, -1)))
    out = []
    for k in crossing:
        s = np.linalg.lstsq(np.column_stack([v, -w]), turned[k], rcond=None)[0]
        if (s > 0.02).all():
            out.append(float(np.degrees(yaw[k])))
    return out


def around(angle: float, lo: float, hi: float, slack: float = 0.01) -> bool:
    """Whether an arc covers an angle, whatever circle it is on."""
    return any(lo - slack <= angle + turn <= hi + slack for turn in (-360.0, 0.0, 360.0, 720.0))


def with_wide_arcs(run: Trace) -> set[tuple[int, int]]:
    """Pairs with an arc that mc leaves out for its width."""
    aligned = run.problem.aligned
    pairs, lo, hi = yaw_arcs(aligned, bounds_of(aligned, run.options.bound_px).radians)
    return set(map(tuple, aligned.index[pairs[hi - lo > WIDEST_RAD]].tolist()))


@pytest.mark.parametrize("estimator", ["mc", "mc-exact", "ransac-2p"])
def test_every_root_of_eq_22_is_in_a_bar_of_its_pair(runs: dict[str, Trace], estimator: str) -> None:
    run = runs[estimator]
    bars, left_out = bars_in(run, arcs_of(run, ()), ALL, ()), with_wide_arcs(run) if estimator == "mc" else set()
    checked = 0
    for pair in range(0, len(bars.pairs), 2):
        i, j = bars.pairs[pair].tolist()
        own = np.flatnonzero(bars.owner == pair)
        assert 1 <= len(own) == bars.count[pair] <= 4
        if (i, j) in left_out:
            continue
        for root in roots_deg(run.problem, i, j):
            assert any(around(root, bars.lo_deg[k], bars.hi_deg[k]) for k in own)
            checked += 1
    assert checked >= 15


def test_right_pairs_cover_the_true_yaw(runs: dict[str, Trace]) -> None:
    for run in runs.values():
        story = yaw_story(run)
        assert story.truth_deg is not None
        bars = bars_in(run, arcs_of(run, ()), window_around(story.truth_deg, 40.0), ())
        right = np.flatnonzero(bars.kind == 0)
        assert len(right) >= 10
        covered = [
            any(around(story.truth_deg, bars.lo_deg[k], bars.hi_deg[k]) for k in np.flatnonzero(bars.owner == pair))
            for pair in right
        ]
        # Noise of 1 px has a tail beyond the bound of 3 px.
        assert np.mean(covered) >= 0.95


def inside_by_sampling(lo: float, hi: float, window: Window) -> bool:
    places = np.linspace(*window, 4001)
    return any(np.any((places + turn >= lo) & (places + turn <= hi)) for turn in (-720.0, -360.0, 0.0, 360.0))


@pytest.mark.parametrize("window", [(-180.0, 180.0), (20.0, 70.0), (160.0, 215.0), (-180.0, -150.0), (140.0, 180.0)])
def test_all_arcs_of_a_window_are_counted_by_their_kind(runs: dict[str, Trace], window: Window) -> None:
    run = runs["mc"]
    stage, truth = run.stage(YawStage), run.problem.truth_inliers
    assert stage is not None and truth is not None
    bars = bars_in(run, arcs_of(run, ()), window, ())
    some = np.arange(0, len(stage.lo_rad), 7)
    thinned = PairArcs(stage.pairs[some], stage.lo_rad[some], stage.hi_rad[some], "")
    total = [0, 0, 0]
    for pair, lo, hi in zip(thinned.pairs, np.degrees(thinned.lo_rad), np.degrees(thinned.hi_rad), strict=True):
        total[2 - int(truth[pair].sum())] += inside_by_sampling(lo, hi, window)
    counted = bars_in(run, thinned, window, ()).total
    # Sampling may miss an arc that only just reaches into the window.
    assert all(0 <= a - b <= 3 for a, b in zip(counted, total, strict=True)) and sum(total) > 20
    shown = bars.row >= 0
    assert MAX_BARS <= np.count_nonzero(shown) <= MAX_BARS + 12 and sum(bars.total) > MAX_BARS
    held = np.bincount(bars.kind[bars.owner[shown]], minlength=3)
    assert (held >= np.minimum(bars.total, MAX_BARS // 3)).all(), "each kind has its share"


arcs_strategy = st.lists(st.tuples(st.floats(-180, 179.99), st.floats(0, 360)), min_size=1, max_size=60)


@settings(max_examples=60)
@given(arcs_strategy, st.floats(-180, 179.99), st.floats(0.05, 360))
@example([(0.0, 360.0)], 0.0, 1.0)
@example([(0.0, 360.0), (10.0, 5.0)], -1.0, 360.0)
@example([(162.3434644592084, 0.0)], 0.0, 162.3434644592084)  # in radians and back it is outside
def test_bars_of_a_row_never_touch(arcs: list[tuple[float, float]], low: float, width: float) -> None:
    window = (low, low + width)
    lo, span = np.array(arcs).T
    count = len(lo)
    pairs = np.column_stack([np.zeros(count, int), 1 + np.arange(count)])
    truth = np.arange(count + 1) % 3 != 1
    run: Any = SimpleNamespace(problem=SimpleNamespace(truth_inliers=truth), inlier_mask=truth)
    bars = bars_in(run, PairArcs(pairs, np.radians(lo), np.radians(lo + span), ""), window, (), most=1000)
    arc, left, right = spans_in(bars.lo_deg, bars.hi_deg, window)
    assert np.all(left <= right) and np.all(left >= low) and np.all(right <= window[1])
    assert set(arc.tolist()) == set(np.flatnonzero(bars.row >= 0).tolist()) and len(set(arc.tolist())) == sum(
        bars.total
    )
    for row in range(bars.rows):
        own = np.flatnonzero(bars.row[arc] == row)
        order = own[np.argsort(left[own])]
        assert len(order) and np.all(left[order[1:]] > right[order[:-1]])
        assert len(np.unique(bars.kind[bars.owner[arc[own]]])) == 1
    kinds = [int(bars.kind[bars.owner[np.flatnonzero(bars.row == row)[0]]]) for row in range(bars.rows)]
    assert kinds == sorted(kinds)


@settings(max_examples=40)
@given(st.integers(0, 300), st.integers(0, 400))
def test_samples_are_even_and_hold_no_index_twice(count: int, most: int) -> None:
    indices = 3 * np.arange(count)
    some = sample(indices, most)
    assert len(some) == min(count, most) and np.all(np.diff(some) > 0)
    if len(some) > 1:
        assert np.ptp(np.diff(some)) <= 3


@pytest.mark.parametrize(
    ("middle", "width", "window"),
    [(0, 10, (-5, 5)), (179, 10, (174, 184)), (-179, 10, (176, 186)), (10, 359.5, ALL), (400, 2, (39, 41))],
)
def test_windows_begin_on_the_circle(middle: float, width: float, window: Window) -> None:
    assert window_around(middle, width) == pytest.approx(window)


def test_a_legend_has_the_colours_of_the_bars_that_are_drawn(runs: dict[str, Trace]) -> None:
    run = runs["mc"]
    bars = bars_in(run, arcs_of(run, ()), ALL, ())
    assert all(word in bars_html(bars) for word in KINDS)
    right = replace(bars, kind=np.zeros_like(bars.kind))
    assert KINDS[0] in bars_html(right) and KINDS[1] not in bars_html(right)
    assert bars_html(replace(bars, row=np.full_like(bars.row, -1))) == ""


def test_the_peak_is_in_its_window(runs: dict[str, Trace]) -> None:
    for run in runs.values():
        story = yaw_story(run)
        low, high = peak_window(story, arcs_of(run, ()))
        assert story.estimate_deg is not None and high - low <= 120.0
        assert low + 0.3 * (high - low) < story.estimate_deg < low + 0.7 * (high - low)


def drawn(view: YawView) -> ElementTree.Element:
    return ElementTree.fromstring(f"<p>{view._html.content}</p>")


def arc_elements(root: ElementTree.Element) -> list[ElementTree.Element]:
    return [path for path in root.iter(f"{SVG}path") if path.attrib.get("class") == "yaw-arc"]


def make(server: viser.ViserServer) -> tuple[YawView, Touches, list]:
    touches, asked = Touches(lambda error: pytest.fail(str(error))), []
    return YawView(server.gui, touches, asked.append), touches, asked


@pytest.mark.parametrize("estimator", ["mc", "mc-exact", "ransac-2p"])
def test_bars_lie_where_their_tooltips_say(server: viser.ViserServer, runs: dict[str, Trace], estimator: str) -> None:
    view, _, _ = make(server)
    kept = np.arange(120) * 2
    view.draw(runs[estimator], "", (), kept)
    root = drawn(view)
    drags = [item.attrib["data-touch"] for item in root.iter() if "data-drag" in item.attrib]
    assert len(drags) == 2 and drags[0] == "yaw-zoom:-180.000000,180.000000"
    low, high = map(float, drags[1].removeprefix("yaw-zoom:").split(","))
    plot = next(item for item in root.iter() if item.attrib.get("data-touch") == drags[1]).attrib
    left, width = float(plot["x"]), float(plot["width"])
    elements = arc_elements(root)
    assert len(elements) >= 20 and len(view._html.content.encode()) < 30_000
    arcs = {tuple((kept[pair]).tolist()): k for k, pair in enumerate(arcs_of(runs[estimator], ()).pairs)}
    for element in elements:
        tip = "".join(element.itertext())
        a, b = map(int, element.attrib["data-touch"].removeprefix("select:").split(","))
        assert (a, b) in arcs and tip.startswith(f"{a} and {b}, ") and any(kind in tip for kind in KINDS)
        if "every yaw" in tip:
            continue
        ends = [float(text.replace("−", "-")) for text in re.findall(r"([−\d.]+)°", tip)]
        lo, hi = ends[0], ends[1] + (360.0 if ends[1] < ends[0] else 0.0)
        found = re.match(r"M([\d.]+) [\d.]+h([\d.]+)v", element.attrib["d"])
        assert found is not None
        turns = [t for t in (-360.0, 0.0, 360.0) if lo + t <= high + 0.01 and hi + t >= low - 0.01]
        expected = [left + width * (max(lo + t, low) - low) / (high - low) for t in turns]
        assert any(float(found[1]) == pytest.approx(x, abs=0.3) for x in expected)
        if turns:
            spans = [width * (min(hi + t, high) - max(lo + t, low)) / (high - low) for t in turns]
            assert any(float(found[2]) == pytest.approx(max(1.5, span), abs=0.5) for span in spans)


def test_a_selected_pair_is_there_with_its_second_arc_wherever_its_arcs_are(
    server: viser.ViserServer, runs: dict[str, Trace]
) -> None:
    run = runs["mc"]
    stage = run.stage(YawStage)
    assert stage is not None
    codes = stage.pairs[:, 0] * 1000 + stage.pairs[:, 1]
    twin = int(np.flatnonzero(np.diff(codes) == 0)[0])
    pair = tuple(stage.pairs[twin].tolist())
    for window in (ALL, (100.0, 100.5)):
        bars = bars_in(run, arcs_of(run, pair), window, pair)
        mine = np.flatnonzero(bars.chosen)
        assert len(mine) == 1 and tuple(bars.pairs[mine[0]]) == pair and bars.count[mine[0]] == 2
        ends = np.degrees(stage.lo_rad[codes == codes[twin]])
        assert np.allclose(bars.lo_deg[bars.owner == mine[0]], ends)
    view, _, _ = make(server)
    view.draw(run, "", pair, np.arange(120))
    chosen = [path for path in drawn(view).iter(f"{SVG}path") if path.attrib.get("class") == "yaw-second chosen"]
    assert len(chosen) == 1 and chosen[0].attrib["d"].count("Q") == 1, "one arch joins the two roots"


def test_one_selected_match_brings_its_pairs(runs: dict[str, Trace]) -> None:
    for run in runs.values():
        match = int(run.problem.aligned.index[5])
        bars = bars_in(run, arcs_of(run, (match,)), ALL, (match,))
        held = (bars.pairs == match).any(axis=1)
        assert np.array_equal(held, bars.chosen) and 3 <= held.sum() <= MAX_CHOSEN + MAX_BARS // 3
        assert np.array_equal(bars_in(run, arcs_of(run, ()), ALL, ()).chosen.any(), False)


def test_ransac_shows_its_hypotheses_and_a_press_goes_to_their_step(
    server: viser.ViserServer, runs: dict[str, Trace]
) -> None:
    run = runs["ransac-2p"]
    stage = run.stage(RansacStage)
    assert stage is not None
    view, touches, asked = make(server)
    view.draw(run, "sample-1", (), np.arange(120))
    first = view._html.content
    keys = re.findall(r'data-touch="step:([^"]*)"', first)
    assert set(keys) == {f"sample-{k + 1}" for k in range(len(stage.improved_at))}
    tips = [
        f"sample {at + 1:,}: {mask.sum()} inliers at"
        for at, mask in zip(stage.improved_at, stage.inlier_masks, strict=True)
    ]
    assert all(tip in first for tip in tips)
    touches.deliver(Touch("yaw-zoom", "-180,180", 1, 0, 0, 0, False))
    assert asked == [None]
    view.draw(run, "sample-1-pose", (), np.arange(120))
    whole = view._html.content
    view.draw(run, "outcome", (), np.arange(120))
    assert view._html.content != whole, "the stem of the step at hand stands out"
    assert view._html.content.count('opacity=".25"') == 0
    assert whole.count('opacity=".25"') == first.count('opacity=".25"') > 0, "what was tried later is faint"


def test_curve_arcs_and_window_are_those_of_the_step(server: viser.ViserServer, runs: dict[str, Trace]) -> None:
    run = runs["mc"]
    keys = [step.key for step in steps(run)]
    view, _, _ = make(server)
    contents = {}
    for key in ("yaw-pair", "yaw-roots", "yaw-arcs-10", "yaw-arcs", "yaw-candidate-1", "yaw-clique"):
        picture = paint(run, keys.index(key))
        (chart,) = (chart for chart in picture.charts if chart.name == "yaw")
        view.draw(run, key, (), np.arange(120), step_chart=chart)
        contents[key] = view._html.content
        story = at_step(yaw_story(run), chart, arcs_of(run, ()))
        assert story.top == chart.curves[0].y.max()
        assert (story.candidate_deg is not None) == (key == "yaw-candidate-1") == ("candidate" in contents[key])
        assert (story.estimate_deg is not None) == (key == "yaw-clique") == ("estimate" in contents[key])
        if key == "yaw-arcs-10":
            low, high = window_on(view)
            told = float(re.search(r"overlap, at (\S+?)°", picture.step.caption)[1].replace("−", "-"))
            assert low < told < high, "the window is where the caption says that most of these arcs overlap"
    drawn = {key: content.count('class="yaw-arc"') for key, content in contents.items()}
    assert contents.pop("yaw-roots") == contents["yaw-pair"], "both steps show the arcs of one pair"
    assert len(set(contents.values())) == len(contents)
    assert 1 <= drawn["yaw-pair"] <= 2 and drawn["yaw-arcs-10"] <= 10 < drawn["yaw-arcs"]


def test_the_estimate_is_the_yaw_of_the_pose(runs: dict[str, Trace]) -> None:
    """Refinement can correct gravity, and the yaw with it."""
    run = runs["mc"]
    turned = np.vstack([run.cam_from_map, [0.0, 0.0, 0.0, 1.0]])
    turned[:3, :3] = turned[:3, :3] @ yaw_rotation(0.02)
    moved = replace(run, cam_from_map=turned[:3])
    assert abs(yaw_story(moved).estimate_deg - yaw_story(run).estimate_deg) > 0.5


def window_on(view: YawView) -> tuple[float, float]:
    found = re.findall(r'data-touch="yaw-zoom:([-\d.]+),([-\d.]+)"', view._html.content)
    low, high = found[-1]
    return float(low), float(high)


def press(view: YawView, button: str) -> None:
    event: Any = SimpleNamespace(target=SimpleNamespace(value=button))
    view._click(event)


def test_drags_zoom_clicks_move_and_buttons_go_back(server: viser.ViserServer, runs: dict[str, Trace]) -> None:
    view, touches, asked = make(server)
    run, kept = runs["mc"], np.arange(120)

    def after(argument: str, start: float, end: float) -> tuple[float, float]:
        touches.deliver(Touch("yaw-zoom", argument, end, 0.5, start, 0.5, False))
        view.draw(run, "", (), kept)
        return window_on(view)

    view.draw(run, "", (), kept)
    peak = window_on(view)
    assert after("-180,180", 0.75, 0.5) == pytest.approx((0.0, 90.0))
    assert after("0,90", 0.1, 0.2) == pytest.approx((9.0, 18.0))
    assert after("9,18", 0.4, 0.4) == pytest.approx((9.0, 18.0)), "a click in the window is no zoom"
    assert after("-180,180", 1.0, 1.0) == pytest.approx((175.5, 184.5)), "a click in the circle moves the window"
    root = drawn(view)
    labels = [item.text for item in root.iter(f"{SVG}text")]
    assert "−176" in labels and "178" in labels, "beyond the seam the numbers start again"
    assert after("175.5,184.5", 0.5, 1.0) == pytest.approx((-180.0, -175.5))
    press(view, WHOLE)
    view.draw(run, "", (), kept)
    assert window_on(view) == ALL
    press(view, PEAK)
    view.draw(run, "", (), kept)
    assert window_on(view) == peak and len(asked) == 6
    for argument in ("", "1", "a,b", "nan,3", "0,inf", "5,4", "-181,3", "0,400", "1,2,3"):
        assert after(argument, 0.2, 0.8) == peak
    assert len(asked) == 6


def test_across_the_seam_the_curve_goes_on(server: viser.ViserServer, runs: dict[str, Trace]) -> None:
    stage = runs["mc"].stage(YawStage)
    assert stage is not None
    story, window = yaw_story(runs["mc"]), (176.0, 186.0)
    bars = bars_in(runs["mc"], arcs_of(runs["mc"], ()), window, ())
    root = ElementTree.fromstring(yaw_svg(story, bars, window, np.arange(120), ""))
    data = [path.attrib["d"] for path in root.iter(f"{SVG}path") if path.attrib.get("fill-opacity") == "0.22"][1]
    tops = np.array(re.findall(r"V([\d.]+)", data)[:-1], dtype=float)
    expected = np.concatenate([stage.overlap[-16:], stage.overlap[:24]]).astype(float)
    heights = 176.0 - 60.0 * expected / (1.08 * story.top)
    distinct = heights[np.insert(np.diff(np.round(heights, 1)) != 0, 0, True)]
    assert np.allclose(tops, distinct, atol=0.06)


def test_who_walks_back_sees_what_was_there_before(server: viser.ViserServer, runs: dict[str, Trace]) -> None:
    """Contents are kept by step, selection and window."""
    view, _, _ = make(server)
    run, kept = runs["mc"], np.arange(120)
    keys = [step.key for step in steps(run)]
    charts = {key: paint(run, keys.index(key)).charts[0] for key in ("yaw-arcs-10", "yaw-clique")}
    seen: dict[str, list[str]] = {key: [] for key in charts}
    for pair in ((), (), (0, 1)):
        for key, chart in charts.items():
            view.draw(run, key, pair, kept, step_chart=chart)
            seen[key].append(view._html.content)
    assert all(first is second and first != other for first, second, other in seen.values())
    assert seen["yaw-clique"][0] != seen["yaw-arcs-10"][0]
    view.draw(replace(run), "yaw-clique", (), kept, step_chart=charts["yaw-clique"])
    assert view._html.content == seen["yaw-clique"][0]


def test_nothing_is_sent_if_nothing_changed(server: viser.ViserServer, runs: dict[str, Trace]) -> None:
    view, _, _ = make(server)
    view.draw(runs["mc"], "yaw-arcs", (), np.arange(120))
    content = view._html.content
    view.draw(runs["mc"], "balls", (), np.arange(120))
    assert view._html.content is content
    view.draw(runs["mc"], "balls", (3, 9), np.arange(120))
    assert view._html.content != content


def test_runs_without_pose_truth_or_labels_can_be_drawn(server: viser.ViserServer, runs: dict[str, Trace]) -> None:
    view, _, _ = make(server)
    for run in runs.values():
        bare = replace(run.problem, truth_inliers=None, truth_cam_from_map=None)
        view.draw(replace(run, problem=bare), "", (), np.arange(120))
        assert "Inliers and outliers are this run&#x27;s." in view._html.content and ">truth<" not in view._html.content
        assert "both outliers" in view._html.content and not re.search("both right|one wrong", view._html.content)
        view.draw(replace(run, cam_from_map=None, inlier_mask=np.zeros(120, bool)), "", (2,), np.arange(120))
        assert ElementTree.fromstring(f"<p>{view._html.content}</p>") is not None
        view.draw(replace(run, stages=()), "", (), np.arange(120))
        assert "No stage of this run looked at the yaw" in view._html.content


def test_few_matches_and_unseen_pixels_are_no_trouble(server: viser.ViserServer, scene_of: SceneOf) -> None:
    problem = scene_of("fisheye", correspondences=12, outlier_rate=0.25).problem()
    pixels = problem.pixels.copy()
    pixels[:3] = -1e6
    view, _, _ = make(server)
    for estimator in ("mc-exact", "ransac-2p"):
        run = estimate(replace(problem, pixels=pixels), estimator)
        view.draw(run, "", (0, 1, 5), np.arange(12))
        bars: ArcBars = bars_in(run, arcs_of(run, (0, 1, 5)), ALL, (0, 1, 5))
        assert bars.pairs.min() >= 3 and "keeps no arcs" in view._html.content
