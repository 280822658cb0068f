"""Charts as SVG: what is drawn is what the numbers say, at round ticks, small, and with every text escaped."""

import math
import re
from xml.etree import ElementTree

import numpy as np
import pytest
import viser
from hypothesis import given, settings
from hypothesis import strategies as st

from spherloc_viz import style
from spherloc_viz.app.plots import shapes
from spherloc_viz.app.plots.charts import MAX_STEPS, ChartPanel, chart_html, chart_svg, curve_parts
from spherloc_viz.app.plots.shapes import MINUS, Scale, decade_ticks, round_ticks, tick_texts, wrapped_deg
from spherloc_viz.layers.primitives import Chart, Curve

EVIL = '<img src=x onerror="alert(1)">&\'"'
SVG = "{http://www.w3.org/2000/svg}"

numbers = st.floats(-1e6, 1e6, allow_nan=False)


def parsed(text: str) -> ElementTree.Element:
    return ElementTree.fromstring(text)


def chart(*curves: Curve, x_label: str = "x") -> Chart:
    return Chart("any", "Any", x_label, "y", curves)


def curve(x: list[float] | np.ndarray, y: list[float] | np.ndarray, kind: str = "line") -> Curve:
    return Curve("c", np.array(x, dtype=float), np.array(y, dtype=float), style.INLIER, kind)  # pyright: ignore[reportArgumentType]


@settings(max_examples=150)
@given(low=numbers, span=st.floats(1e-6, 1e7), most=st.integers(2, 12), degrees=st.booleans())
def test_ticks_are_round_numbers_within_the_range(low: float, span: float, most: int, degrees: bool) -> None:
    high = low + span
    ticks = np.array(round_ticks(low, high, most, degrees))
    slack = 1e-8 * max(abs(low), abs(high), span)
    assert len(ticks) <= most and len(ticks) >= most // 8
    assert np.all(ticks >= low - slack) and np.all(ticks <= high + slack)
    if len(ticks) > 1 and span > 1e-5 * abs(low):
        steps = np.diff(ticks)
        step = float(steps[0])
        assert np.allclose(steps, step, rtol=1e-4)
        mantissa = step / 10.0 ** math.floor(math.log10(step) + 1e-6)
        assert any(
            math.isclose(mantissa, m, rel_tol=1e-4)
            for m in ((1, 2, 5, 1.5, 3, 4.5, 9, 1.8, 3.6) if degrees else (1, 2, 5))
        )
        assert np.allclose(ticks / step, np.round(ticks / step), atol=1e-3)


@pytest.mark.parametrize(
    "low, high, most, degrees, ticks",
    [
        (0, 1.06, 5, False, (0, 0.5, 1)),
        (0, 1, 6, False, (0, 0.2, 0.4, 0.6, 0.8, 1)),
        (-180, 180, 5, True, (-180, -90, 0, 90, 180)),
        (170, 190, 6, True, (170, 175, 180, 185, 190)),
        (0.1, 0.7, 9, False, (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7)),
        (3, 3, 5, False, ()),
    ],
)
def test_ticks_that_people_expect(low: float, high: float, most: int, degrees: bool, ticks: tuple) -> None:
    assert round_ticks(low, high, most, degrees) == ticks


@settings(max_examples=80)
@given(low=st.floats(-1e4, 1e4), span=st.floats(1e-3, 1e5))
def test_tick_texts_tell_ticks_apart_and_say_what_they_are(low: float, span: float) -> None:
    ticks = round_ticks(low, low + span, 8)
    texts = tick_texts(ticks)
    assert len(set(texts)) == len(texts) and all("-" not in words for words in texts)
    for tick, words in zip(ticks, texts, strict=True):
        assert float(words.replace(",", "").replace(MINUS, "-")) == pytest.approx(tick, rel=1e-9, abs=1e-9)


def test_decades() -> None:
    ticks = decade_ticks(0.01, 2e5, 10)
    assert ticks == tuple(10.0**k for k in range(-2, 6))
    assert tick_texts(ticks, log=True) == ["0.01", "0.1", "1", "10", "100", "1000", "10000", "10⁵"]
    assert decade_ticks(1, 1e9, 4) == (1.0, 1e3, 1e6, 1e9)


@settings(max_examples=60)
@given(st.floats(-1e5, 1e5))
def test_angles_are_brought_around(angle: float) -> None:
    wrapped = wrapped_deg(angle)
    assert -180.0 <= wrapped < 180.0 and math.isclose(math.remainder(wrapped - angle, 360.0), 0.0, abs_tol=1e-6)


def test_scales_are_exact_and_hold_back_what_is_absurd() -> None:
    linear, log = Scale(-2.0, 3.0, 10.0, 110.0), Scale(0.1, 1000.0, 0.0, 400.0, log=True)
    assert linear.px([-2, 0.5, 3]).tolist() == [10, 60, 110] and linear.at(0.5) == 60
    assert np.allclose(log.px([0.1, 1, 1000]), [0, 100, 400]) and log.at(10.0) == pytest.approx(200)
    for scale in (linear, log):
        assert np.isfinite(scale.px([np.inf, -np.inf, np.nan, 0.0, 1e300])).all()


@settings(max_examples=60)
@given(st.lists(numbers, min_size=0, max_size=900), st.integers(4, 120))
def test_thinning_keeps_ends_and_extremes(values: list[float], most: int) -> None:
    x, y = np.arange(len(values), dtype=float), np.array(values)
    xs, ys = shapes.thin(x, y, most)
    assert len(xs) <= max(most, 0) or len(values) <= most
    assert len(xs) == min(len(xs), len(values)) and np.all(np.diff(xs) > 0)
    assert np.array_equal(ys, y[xs.astype(int)]), "it keeps corners, and makes none up"
    if len(values):
        assert xs[0] == 0 and xs[-1] == len(values) - 1 and ys.max() == y.max() and ys.min() == y.min()
    step_x, step_y = shapes.thin_steps(x, y, most)
    assert len(step_x) <= most or len(values) <= most
    if len(values):
        assert step_y.max() == y.max() and step_x[0] == 0


def heights(data: str) -> tuple[np.ndarray, np.ndarray]:
    """Corners (K,), (K,) of a path of steps as the browser walks it."""
    x = y = 0.0
    out = []
    for letter, rest in re.findall(r"([MHVLhvzZ])([^MHVLhvzZ]*)", data):
        values = [float(value) for value in rest.split()]
        if letter in "ML":
            x, y = values
        elif letter == "H":
            x = values[0]
        elif letter == "V":
            y = values[0]
        out.append((x, y))
    return np.array(out)[:, 0], np.array(out)[:, 1]


def test_steps_are_as_high_as_the_numbers_say(rng: np.random.Generator) -> None:
    y = rng.integers(0, 60, 300).astype(float)
    scale_x, scale_y = Scale(0.0, 299.0, 0.0, 598.0), Scale(0.0, 60.0, 120.0, 0.0)
    drawn = parsed(f"<g>{curve_parts((curve(np.arange(300), y, 'step'),), scale_x, scale_y)[0]}</g>")[0]
    xs, ys = heights(drawn.attrib["d"])
    assert (xs[0], ys[0]) == (0.0, 120.0) and (xs[-1], ys[-1]) == (598.0, 120.0), "it begins and ends on the ground"
    for k in range(299):
        middle = 2.0 * k + 1.0
        at = np.flatnonzero((xs[:-1] <= middle) & (xs[1:] >= middle) & (ys[:-1] == ys[1:]))
        assert len(at) == 1 and ys[at[0]] == pytest.approx(120.0 - 2.0 * y[k], abs=0.06)


def test_a_peak_survives_thinning_and_the_drawing_stays_small(rng: np.random.Generator) -> None:
    y = rng.integers(100, 200, 5000).astype(float)
    y[1234] = 777.0
    text = chart_svg(chart(curve(np.linspace(-180, 179.9, 5000), y, "step"), x_label="yaw (°)"))
    data = next(path.attrib["d"] for path in parsed(text).iter(f"{SVG}path") if "fill-opacity" in path.attrib)
    _, ys = heights(data)
    assert len(text) < 9000 and data.count("H") <= MAX_STEPS + 1
    assert ys.max() - ys.min() > 3.0 * (ys.max() - np.sort(ys)[3]), "the peak towers above the rest"


def test_a_part_of_a_chart_stays_within_its_axes() -> None:
    x = np.linspace(-180, 180, 721)
    curves = (
        curve(x, np.abs(x), "step"),
        curve(x, 180 - np.abs(x)),
        curve([-170.0], [100.0], "marker"),
        curve([20.0], [100.0], "marker"),
        curve([-180.0, 180.0], [90.0, 90.0], "level"),
    )
    scale_x, scale_y = Scale(10.0, 30.0, 40.0, 340.0), Scale(0.0, 180.0, 120.0, 20.0)
    parts = curve_parts(curves, scale_x, scale_y)
    assert sum("<title>" in part for part in parts) == 1, "the marker outside is not drawn"
    for part in parts:
        for path in parsed(f"<g>{part}</g>").iter("path"):
            xs, ys = heights(path.attrib["d"])
            assert xs.min() >= 39.9 and xs.max() <= 340.1 and ys.min() >= 19.9 and ys.max() <= 120.1
    line = next(part for part in parts if "L" in part and "dasharray" not in part and "<g>" not in part)
    xs, ys = heights(re.findall(r' d="([^"]*)"', line)[0])
    assert np.allclose(ys, 120.0 - 100.0 * (180.0 - (10.0 + 20.0 * (xs - 40.0) / 300.0)) / 180.0, atol=0.1)


def test_bands_enclose_their_curves_and_gaps_are_left_out() -> None:
    x = np.array([0.0, 1.0, 2.0, 3.0])
    y = np.array([0.9, np.nan, 0.5, 0.2])
    text = chart_svg(chart(curve(x, y)), bands={"c": (y - 0.1, y + 0.1)})
    paths = [path for path in parsed(text).iter(f"{SVG}path") if path.attrib.get("fill-opacity") == "0.18"]
    assert len(paths) == 1 and "nan" not in text
    _, ys = heights(paths[0].attrib["d"])
    dots = [float(dot.attrib["cy"]) for dot in parsed(text).iter(f"{SVG}circle")]
    assert len(ys) == 6 and len(dots) == 3
    assert np.allclose(0.5 * (ys[:3] + ys[:2:-1]), dots, atol=0.11), "the curve is in the middle of its band"


@pytest.mark.parametrize("curves", [(), (curve([], []),), (curve([3.0], [0.0]),), (curve([1, 2], [0, 0]),)])
def test_charts_of_nothing_can_be_drawn(curves: tuple[Curve, ...]) -> None:
    assert parsed(chart_svg(chart(*curves))).tag == f"{SVG}svg"


def test_equal_curves_can_both_be_seen() -> None:
    x, y = np.arange(5.0), np.ones(5)
    paths = parsed(chart_svg(chart(curve(x, y), curve(x, y)))).findall(f".//{SVG}path")
    lines = [float(path.attrib["stroke-width"]) for path in paths if path.attrib["d"].count("L") == 4]
    assert len(lines) == 2 and lines[0] > lines[1] > 1.5


def test_every_text_is_escaped() -> None:
    evil = Chart(EVIL, EVIL, EVIL, EVIL, (Curve(EVIL, np.arange(3.0), np.arange(3.0), style.TRUTH),) * 2)
    html = chart_html(evil)
    assert "<img" not in html and 'onerror="' not in html
    texts = ["".join(item.itertext()) for item in parsed(html).iter()]
    assert EVIL in texts
    assert parsed(chart_svg(evil, touch=EVIL)).findall(f".//{SVG}rect")[0].attrib["data-touch"] == EVIL


def test_what_can_be_dragged_is_the_plot_and_nothing_else() -> None:
    root = parsed(chart_svg(chart(curve([0.0, 10.0], [0.0, 5.0])), touch="zoom:"))
    plot = root.findall(f".//{SVG}rect")[0]
    assert plot.attrib["data-drag"] == ""
    dots = [float(dot.attrib["cx"]) for dot in root.iter(f"{SVG}circle")]
    left, width = float(plot.attrib["x"]), float(plot.attrib["width"])
    assert dots[0] == pytest.approx(left, abs=0.1) and dots[1] == pytest.approx(left + width, abs=0.1)


@pytest.mark.parametrize("width", [340.0, 380.0, 460.0])
def test_legends_do_not_run_out_of_the_drawing(width: float) -> None:
    names = ("bound", "first guess", "best pose", "truth", "estimate", "one more curve")
    curves = tuple(Curve(name, np.arange(3.0), np.arange(3.0), style.TRUTH) for name in names)
    rows: dict[str, list[tuple[float, str]]] = {}
    for item in parsed(chart_svg(chart(*curves), width)).iter(f"{SVG}text"):
        if item.text in names:
            rows.setdefault(item.attrib["y"], []).append((float(item.attrib["x"]), item.text))
    assert sum(map(len, rows.values())) == len(names)
    for row in rows.values():
        ends = [left + shapes.text_width_px(name) for left, name in row]
        assert max(ends) <= width and all(end < left for end, (left, _) in zip(ends, row[1:], strict=False))


def test_the_panel_sends_charts_when_they_change_and_only_then(server: viser.ViserServer) -> None:
    panel = ChartPanel(server.gui)
    first, second = chart(curve([0, 1], [0, 1])), chart(curve([0, 1], [0, 2]))
    panel.draw((first,))
    content = panel._html.content
    assert content == chart_html(first)
    panel.draw((first,))
    assert panel._html.content is content
    panel.draw((first, second))
    assert panel._html.content == chart_html(first) + chart_html(second)
    panel.draw(())
    assert "<svg" not in panel._html.content and "No chart yet" in panel._html.content


def test_rounding_is_no_range() -> None:
    """Residuals of 1e-13 px have no axis of fourteen decimals."""
    assert "0.0000" not in chart_svg(chart(curve(np.zeros(1), np.full(1, 8e-14))))
