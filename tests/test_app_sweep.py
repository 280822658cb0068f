"""The sweep panel on a real viser server: it draws as it goes, ends when told, and leaves no process behind."""

import csv
import html
import io
import multiprocessing
import re
import threading
import time
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import viser

from spherloc.datasets.variation import Variation
from spherloc.errors import InputError
from spherloc.warm_up import warm_up
from spherloc_viz.app.catalog import SceneRequest
from spherloc_viz.app.panels import sweep_runs_panel
from spherloc_viz.app.panels.compare_panel import chips_html
from spherloc_viz.app.panels.sweep_runs_panel import CANCEL, START, SweepPanel
from spherloc_viz.app.plots.charts import charts_html, sweep_svg, table_html
from spherloc_viz.app.web.touch import Touch, Touches
from spherloc_viz.app.web.viser_internals import start_viser, stop_viser
from spherloc_viz.layers.primitives import Chart, Curve
from spherloc_viz.layers.sweep import SweepChart
from spherloc_viz.recording.index.query import RunQuery
from spherloc_viz.recording.storage.recorder import Recorder
from tests.tiny_scene import write_tiny_scene
from tests.waiting import LIMIT_S, until

NAME = "tiny <b>"
"""What a page must escape."""


@pytest.fixture(autouse=True, scope="module")
def compiled() -> None:
    """As the server does before it opens."""
    warm_up()


class Desk:
    """A panel, and the page around it."""

    def __init__(self, server: viser.ViserServer, scene: Path, recorder: Recorder | None = None) -> None:
        self.request = SceneRequest(NAME, 5, None, Variation(noise_px=1.0, outlier_rate=0.4, hidden=(3,)))
        self.scene = scene
        self.touches = Touches(lambda error: None)
        self.panel: Any = SweepPanel(server.gui, self.touches, lambda: (self.scene, self.request), recorder)

    def tick(self, *names: str) -> None:
        """Have just these estimators ticked."""
        for name in self.panel._names:
            if (name in self.panel._ticked) != (name in names):
                self.touches.deliver(Touch("sweep", name, 0, 0, 0, 0, False))

    def press(self) -> None:
        self.panel._press(SimpleNamespace(client=None))

    def finish(self) -> None:
        until(lambda: self.panel._button.label == START)

    @property
    def status(self) -> str:
        return html.unescape(re.sub("<[^>]*>", "", self.panel._status.content))

    @property
    def rows(self) -> int:
        return 0 if self.panel._results is None else len(self.panel._results.rows)


@pytest.fixture
def server() -> Iterator[viser.ViserServer]:
    started = start_viser("a key of this test")
    yield started
    stop_viser(started)


@pytest.fixture
def desk(server: viser.ViserServer, tmp_path: Path) -> Iterator[Desk]:
    opened = Desk(server, write_tiny_scene(tmp_path, NAME))
    opened.tick("ransac-2p")
    yield opened
    opened.panel.close()
    until(lambda: not any(thread.name == "spherloc-sweep" for thread in threading.enumerate()))
    assert not multiprocessing.active_children()


def test_runs_are_recorded_unless_that_is_unticked(server: viser.ViserServer, tmp_path: Path) -> None:
    with Recorder(tmp_path / "recordings", print) as recorder:
        desk = Desk(server, write_tiny_scene(tmp_path, NAME), recorder)
        desk.tick("ransac-2p")
        panel = desk.panel
        panel._values.value, panel._runs.value, panel._workers.value = "0.2", 2, 1
        desk.press()
        desk.finish()
        assert desk.status == "2 runs on 2 problems at each value, from seed 5 on."
        listed = recorder.index.find(RunQuery(source="sweep")).rows
        assert sorted(row.seed for row in listed) == [5, 6]
        panel._runs.value, panel._record.value = 3, False
        desk.press()
        desk.finish()
        assert desk.rows == 3 and len(list(recorder.folder.glob("*.rrd"))) == 2
        panel.close()
    assert not multiprocessing.active_children()


def test_a_sweep_is_drawn_as_it_goes_cancelled_and_gone_on_with(desk: Desk) -> None:
    panel = desk.panel
    panel._values.value, panel._runs.value, panel._workers.value = "0.2,0.6", 10_000, 1
    drawn: list[float] = []
    panel._draw, draw = (lambda: (drawn.append(time.monotonic()), draw())), panel._draw
    desk.press()
    until(lambda: len(drawn) >= 3)
    assert panel._button.label == CANCEL and 0.0 < panel._bar.value < 100.0
    assert re.fullmatch(r"[\d,]+ of 20,000 runs, about \d+ (s|min) left\.", desk.status)
    assert panel._charts.content.count("<svg") == 4 and NAME not in panel._charts.content
    desk.press()
    desk.finish()
    assert np.diff(drawn[:-1]).min() >= sweep_runs_panel.DRAW_EVERY_S
    done = desk.rows
    assert 0 < done < 20_000 and desk.status.startswith(f"Stopped at {done:,} of 20,000 runs")
    assert not multiprocessing.active_children()
    most = max(row.seed for row in panel._results.rows) - 4
    panel._runs.value = most
    desk.press()
    desk.finish()
    assert desk.rows == 2 * most
    assert desk.status == f"{2 * most:,} runs on {most} problems at each value, from seed 5 on."
    plan = panel._results.plan
    assert plan.variation == Variation(noise_px=1.0), "what the sweep goes over and edits of matches are not the page's"
    sent: list[tuple[str, bytes]] = []
    client = SimpleNamespace(send_file_download=lambda *file, **how: sent.append(file))
    for kind in ("CSV", "Summary", "PNG"):
        panel._files.value = kind
        panel._download(SimpleNamespace(client=client))
    assert [name for name, _ in sent] == [f"sweep_tiny_outlier_rate.{end}" for end in ("csv", "summary.csv", "png")]
    table = list(csv.DictReader(io.StringIO(sent[0][1].decode())))
    assert [row["seed"] for row in table[:4]] == ["5", "5", "6", "6"] and len(table) == 2 * most
    assert len(list(csv.DictReader(io.StringIO(sent[1][1].decode())))) == 2 and sent[2][1][:4] == b"\x89PNG"


def test_one_sweep_at_a_time_on_a_server(desk: Desk) -> None:
    assert sweep_runs_panel._turn.acquire(timeout=LIMIT_S)
    try:
        desk.press()
        until(lambda: "waits for it" in desk.status)
        assert not multiprocessing.active_children()
        desk.press()
        desk.finish()
        assert desk.rows == 0 and desk.status.startswith("Stopped at 0 of")
    finally:
        sweep_runs_panel._turn.release()


def test_wrong_wishes_are_one_sentence(desk: Desk) -> None:
    panel = desk.panel

    def said() -> str:
        desk.press()
        desk.finish()
        return desk.status

    panel._values.value = "a lot"
    assert "give numbers, or FIRST:LAST:STEP" in said()
    panel._values.value, panel._runs.value = "0:0.99:0.01", 1000
    assert "These are 100,000 runs; ask for 20,000 or fewer, or take spherloc sweep" in said()
    panel._values.value, panel._runs.value = "2", 1
    assert "outlier_rate is 2.0" in said()
    desk.tick()
    panel._values.value = "0.5"
    assert "has 0 estimators" in said()
    desk.tick("mc")
    desk.scene = Path("nowhere.toml")
    assert "nowhere.toml: no such file" in said()
    panel._chosen = lambda: (_ for _ in ()).throw(InputError("the seed 'x' is not a whole number; type one."))
    assert said() == "The seed 'x' is not a whole number; type one."
    panel._chosen = lambda: 1 / 0
    assert "This is a bug in the playground" in said()


def test_values_follow_the_axis_until_somebody_typed_some(desk: Desk) -> None:
    panel = desk.panel
    panel._over.value = "pixel noise (px)"
    panel._follow(SimpleNamespace())
    assert panel._values.value == "0:10:1"
    panel._values.value = "1,2"
    panel._over.value = "gravity error (deg)"
    panel._follow(SimpleNamespace())
    assert panel._values.value == "1,2"


class Tags(HTMLParser):
    """Checks that tags close as they open."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_html_is_whole_and_escaped() -> None:
    from spherloc.experiments.sweep_rows import SweepRow, point_of

    labels = ("mc", "mc <i>=1")
    rows = [
        SweepRow(label, 0.5, 0, False, error, error, error, 2.0, 5, 20, 1.0, 0.5, 0.6, None, None, None)
        for label, error in zip(labels, (None, 1e-9), strict=True)
    ]
    points = [point_of([row]) for row in rows]
    for text in (
        charts_html("outlier_rate", labels, points),
        charts_html("outlier_rate", labels, ()),
        table_html("outlier_rate", labels, points),
        chips_html("sweep", ("mc", "ransac-2p"), {"mc"}),
    ):
        Tags(text)
        assert "<i>" not in text and "nan" not in text and "inf" not in text.replace("infinite", "")
    assert 'data-touch="sweep:mc"' in chips_html("sweep", ("mc",), set())


def test_a_log_axis_has_a_tick_and_keeps_its_curve_inside() -> None:
    curve = Curve("mc", np.array([1.0, 2.0]), np.array([3.0, 4.0]), (1, 2, 3))
    svg = sweep_svg(SweepChart(Chart("sweep time", "Time", "x", "time (ms)", (curve,)), {}, log=True))
    assert re.search(r">(1|10)</text>", svg)
    heights = [float(y) for y in re.findall(r'cy="([\d.]+)"', svg)]
    assert len(heights) == 2 and 20.0 <= heights[1] < heights[0] <= 132.0
