"""What takes its time: comparisons, sweeps in processes of their own, slow runs. All say how far they are, and end."""

import contextlib
import csv
import io
import itertools
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from playground import SCENE, Playground, served
from playwright.sync_api import Browser, expect

from spherloc.datasets.variation import Variation
from spherloc.diagnosis import Cause, diagnose
from spherloc.estimators import default_options, estimate
from spherloc.metrics import evaluate
from spherloc.problem import Problem
from spherloc_viz.app.catalog import Catalog, SceneRequest
from spherloc_viz.layers.comparison import Entry, comparison_table
from tests.installed import install
from tests.waiting import until

RANSAC = "ransac-2p (two points)"
COMPARED = ("mc-exact", "mc", "ransac-2p")
ITERATIONS = "100000000"
SWEEP_MS = 200_000
"""How long a sweep may take to start its processes and to do its first runs."""
PATIENT = '''
"""An estimator that runs until it is cancelled, but for one iteration and for problems as small as the warm-up's."""
import itertools
import time
from dataclasses import dataclass
import numpy as np
from spherloc.estimators.base import Estimate
from spherloc.refine import RefinementOptions


class Patient:
    @dataclass(frozen=True)
    class Options(RefinementOptions):
        bound_px: float = 3.0
        iterations: int = 1_000

    @staticmethod
    def run(aligned, options, bounds, seed, clock):
        if len(aligned.index) > 20 and options.iterations > 1:
            clock.watch.begin("waiting", 1.0)
            clock.watch.expect(1_000)
            for done in itertools.count():
                clock.watch.reach(min(done, 500))
                clock.watch.check()
                time.sleep(0.01)
        return Estimate((), np.eye(3, 4), np.ones(len(aligned.index), dtype=bool))
'''
CELLS = "rows => rows.map(row => [...row.cells].map(cell => cell.innerText))"


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "small.toml"
    path.write_text(SCENE)
    return path


@pytest.fixture(scope="module")
def server(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, int]]:
    """Address and process of a playground of this file's own, so that its processes can be counted.

    It has an estimator more, of an extension.
    """
    packages = tmp_path_factory.mktemp("packages")
    points = {"spherloc.estimators": {"patient": "patient_pack:Patient"}}
    install(packages, "patient-pack", points, {"patient_pack.py": PATIENT})
    with served(scene, "--no-record", packages=packages) as (address, process):
        yield address, process.pid


@pytest.fixture
def page(browser: Browser, server: tuple[str, int]) -> Iterator[Playground]:
    tab = Playground(browser, server[0])
    yield tab
    tab.close()


def tick_only(tab: Playground, kind: str, wanted: tuple[str, ...]) -> None:
    """Press the chips of a panel until just these estimators are ticked."""
    for one in tab.page.locator(f"[data-touch^='{kind}:']").all():
        name = str(one.get_attribute("aria-label"))
        if (one.get_attribute("aria-checked") == "true") != (name in wanted):
            chip = tab.page.locator(f"[data-touch='{kind}:{name}']")
            chip.click()
            expect(chip).to_have_attribute("aria-checked", str(name in wanted).lower())


def compared_rows(tab: Playground) -> dict[str, tuple[str, ...]]:
    """The comparison's table: by estimator rotation, position and F1, and what is said below."""
    texts = tab.page.locator("tr[data-touch^='use:']").evaluate_all(CELLS)
    pairs = zip(texts[::2], texts[1::2], strict=True)
    return {numbers[0].strip(): (*numbers[1:4], below[0].strip()) for numbers, below in pairs}


def expected_rows(problem: Problem, seed: int, bound_of: str) -> dict[str, tuple[str, ...]]:
    """What the table must say in the end, computed here: all have the bound of the estimator on the page."""
    bound_px = default_options(bound_of, problem).bound_px
    found = {}
    for name in COMPARED:
        trace = estimate(problem, name, replace(default_options(name, problem), bound_px=bound_px), seed)
        table = comparison_table([Entry(trace, diagnose(trace))])
        row = dict(zip(table.columns, table.rows[0], strict=True))
        below = f"{row['outcome']} · {row['inliers']} inliers · {row['precision']} precision · {row['recall']} recall"
        proof = f" · {row['certificate']}" if name == "mc-exact" else ""
        found[name] = (row["rotation"], row["position"], row["F1"], below + proof)
        assert row["outcome"] == "success" and row["diagnosis"] == Cause.OK
    return found


def until_compared(tab: Playground, expected: dict[str, tuple[str, ...]]) -> None:
    tab.until(lambda: compared_rows(tab) == expected, f"the table says {expected}")


def is_shown(tab: Playground, node: str) -> bool:
    return bool((tab.node(node) or {}).get("visible"))


def test_compare(page: Playground, scene: Path) -> None:
    tab, catalog = page, Catalog(scene)
    tab.tab("Compare")
    tick_only(tab, "compare", COMPARED)
    tab.press("Compare")
    first, second, third = (
        expected_rows(catalog.problem(SceneRequest("small street", seed)), seed, name)
        for seed, name in ((3, "mc"), (4, "ransac-2p"), (5, "ransac-2p"))
    )
    assert first != second != third
    until_compared(tab, first)
    for name in COMPARED:
        tab.until(lambda name=name: is_shown(tab, f"/comparison/{name}"), f"the camera of {name} is shown")
    assert not is_shown(tab, "/comparison/auto")
    expect(tab.page.get_by_text("Matches within x px of the pose", exact=True)).to_be_visible()
    expect(tab.page.get_by_text("The yaw that each found", exact=True)).to_be_visible()
    expect(tab.page.get_by_role("button", name="Compare", exact=True)).to_be_visible()

    tab.page.locator("tr[data-touch='use:ransac-2p']").first.click()
    expect(tab.value("estimator")).to_have_text("ransac-2p")

    # A change makes the comparison old; live, it follows by itself.
    old = tab.page.get_by_text(re.compile("^The problem has changed since"))
    tab.press("New seed")
    expect(old).to_be_visible()
    tab.until(lambda: not is_shown(tab, "/comparison/mc-exact"), "cameras of another problem are gone")
    assert compared_rows(tab) == first
    tab.tick("Live", True)
    until_compared(tab, second)
    expect(old).to_have_count(0)
    tab.press("New seed")
    until_compared(tab, third)
    tab.until(lambda: is_shown(tab, "/comparison/mc-exact"), "the cameras are there again")

    # The address names what is compared: a reload compares again, with the tab in front.
    listed = "%2C".join(compared_rows(tab))
    expect(tab.page).to_have_url(re.compile(f"&seed=5&estimator=ransac-2p&.*&compare={listed}$"))
    tab.page.reload()
    until_compared(tab, third)
    expect(tab.page.get_by_role("tab", name="Compare")).to_have_attribute("aria-selected", "true")
    tab.until(lambda: is_shown(tab, "/comparison/mc-exact"), "the cameras are there after a reload")
    tab.tab("Share")
    expect(tab.page.get_by_role("button", name="Picture (PNG)")).to_be_visible()
    assert is_shown(tab, "/comparison/mc-exact"), "a picture can have them"
    tab.tab("Open")
    tab.until(lambda: not is_shown(tab, "/comparison/mc-exact"), "they do not linger")
    assert tab.errors == []


def test_a_comparison_is_cancelled_and_a_slow_run_gives_way(page: Playground) -> None:
    tab = page
    tab.tab("Compare")
    tick_only(tab, "compare", ("ransac-2p", "patient"))
    tab.press("Compare")
    expect(tab.page.get_by_text("patient, 2 of 2 …")).to_be_visible()
    tab.press("Cancel")
    expect(tab.page.get_by_role("button", name="Compare", exact=True)).to_be_visible()
    assert list(compared_rows(tab)) == ["ransac-2p"]
    expect(tab.page.get_by_text("patient, 2 of 2 …")).to_be_hidden()
    tick_only(tab, "compare", ("mc",))
    tab.press("Compare")
    tab.until(lambda: list(compared_rows(tab)) == ["mc"], "a comparison can follow")
    tab.tab("Play")
    shows_progress_and_gives_way(tab)
    assert tab.errors == []


def bar(tab: Playground) -> float | None:
    """How far the run at hand is, in percent; None if no bar is shown."""
    script = "bars => bars.map(bar => Number(bar.getAttribute('aria-valuenow')))"
    return next(iter(tab.page.get_by_role("progressbar").locator("visible=true").evaluate_all(script)), None)


def shows_progress_and_gives_way(tab: Playground) -> None:
    """A slow run."""
    cancel = tab.page.get_by_role("button", name="Cancel", exact=True)
    tab.choose("Estimator", "patient")
    expect(cancel).to_be_visible()
    tab.type("Iterations", "1")
    expect(tab.value("estimator")).to_have_text("patient")
    expect(cancel).to_be_hidden()
    tab.type("Iterations", ITERATIONS)
    tab.until(lambda: (bar(tab) or 0.0) > 1.0, "the bar moves")
    before, count = tab.value("inliers").inner_text(), tab.step_count()
    tab.press("Previous")
    expect(tab.step).to_have_value(re.compile(rf"^{count - 1}/"))
    cancel.click()
    expect(cancel).to_be_hidden()
    expect(tab.page.get_by_text("Cancelled; the page still shows the run before.")).to_be_visible()
    assert re.sub(r"\D", "", tab.entry("Iterations").input_value()) == ITERATIONS
    assert tab.value("inliers").inner_text() == before

    # What is asked for during a slow run does not wait for it.
    tab.press("New seed")
    tab.until(lambda: (bar(tab) or 0.0) > 1.0, "the bar moves")
    tab.choose("Estimator", RANSAC)
    expect(tab.value("estimator")).to_have_text("ransac-2p")
    expect(cancel).to_be_hidden()


def workers(server: int) -> set[int]:
    """Processes (Linux) that a server has started for a sweep."""
    found = set()
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            if parent == server and b"spawn_main" in (folder / "cmdline").read_bytes():
                found.add(int(folder.name))
    return found


def describe_sweep(tab: Playground, values: str, runs: int) -> None:
    """Fill in the form of a sweep over outliers."""
    tab.tab("Sweep")
    tick_only(tab, "sweep", ("mc-exact", "ransac-2p"))
    tab.type("Values", values)
    tab.type("Runs", str(runs))


def downloaded(tab: Playground, button: str) -> tuple[str, bytes]:
    """Press a button of the downloads; name and content of the file."""
    with tab.page.expect_download() as found:
        tab.press(button)
    return found.value.suggested_filename, Path(found.value.path()).read_bytes()


def said_of(rows: list[dict[str, str]]) -> dict[tuple[str, str], tuple[str, ...]]:
    """What the page's table must say of a CSV: by estimator and value, successes and medians."""
    groups: dict[tuple[str, str], list[dict[str, str]]] = {}
    for row in rows:
        groups.setdefault((row["estimator"], f"{float(row['outlier_rate']):g}"), []).append(row)

    def median(group: list[dict[str, str]], column: str) -> float:
        return sorted(float(row[column]) for row in group)[len(group) // 2]

    return {
        key: (
            f"{sum(row['success'] == 'true' for row in group)} of {len(group)}",
            f"{100 * median(group, 'translation_error_m'):.3g} cm",
            f"{median(group, 'time_ms'):.3g} ms",
        )
        for key, group in groups.items()
    }


def test_a_sweep_to_its_end(page: Playground, server: tuple[str, int], scene: Path) -> None:
    tab = page
    describe_sweep(tab, "0.3, 0.9", 3)
    tab.press("Start sweep")
    expect(tab.page.get_by_text("12 runs on 3 problems at each value, from seed 3 on.")).to_be_visible(timeout=SWEEP_MS)
    expect(tab.page.get_by_role("button", name="Start sweep", exact=True)).to_be_visible(timeout=SWEEP_MS)
    for about in ("success", "error", "time"):
        chart = tab.page.get_by_role("img", name=re.compile(f"{about}.* over outlier rate", re.I))
        expect(chart.first).to_be_visible()
    tab.until(lambda: not workers(server[1]), "no process is left")

    name, content = downloaded(tab, "CSV")
    assert name == "sweep_small_outlier_rate.csv"
    rows = list(csv.DictReader(io.StringIO(content.decode())))
    found = {(row["estimator"], row["outlier_rate"], row["seed"]) for row in rows}
    assert found == set(itertools.product(("mc-exact", "ransac-2p"), ("0.3", "0.9"), "345"))
    table = tab.page.locator("tr", has_text=re.compile("^(mc-exact|ransac-2p)0\\."))
    cells = lambda: {(row[0].strip(), row[1]): tuple(row[2:]) for row in table.evaluate_all(CELLS)}  # noqa: E731
    tab.until(lambda: cells() == said_of(rows), f"the table says {said_of(rows)}")
    # The rows are what the core computes.
    for row in rows:
        variation = Variation(outlier_rate=float(row["outlier_rate"]))
        problem = Catalog(scene).problem(SceneRequest("small street", int(row["seed"]), None, variation))
        metrics = evaluate(estimate(problem, row["estimator"], seed=int(row["seed"])))
        assert float(row["translation_error_m"]) == pytest.approx(metrics.translation_error_m, rel=1e-6)

    name, content = downloaded(tab, "PNG")
    picture = np.asarray(Image.open(io.BytesIO(content)).convert("RGB"))
    assert name == "sweep_small_outlier_rate.png"
    assert min(picture.shape[:2]) > 300 and len(np.unique(picture.reshape(-1, 3), axis=0)) > 50
    assert tab.errors == []


def test_a_sweep_ends_with_its_page(page: Playground, server: tuple[str, int]) -> None:
    """A sweep of large problems, which would take many minutes."""
    tab = page
    tab.slide("Points", "End")
    expect(tab.value("inliers")).to_have_text(re.compile(" of 500$"))
    describe_sweep(tab, "0.3:0.9:0.05", 700)
    tab.press("Start sweep")
    expect(tab.page.get_by_text(re.compile(r"^\d[\d,]* of 18,200 runs"))).to_be_visible(timeout=SWEEP_MS / 2)
    tab.until(lambda: len(workers(server[1])) == 2, "two processes work")
    tab.page.close()
    until(lambda: not workers(server[1]))
