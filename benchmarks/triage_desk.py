"""The triage desk at 100,000 runs in a real Chromium: how long it opens, and what a filter, a sort and a brush take.

    python -m benchmarks.triage_desk [--runs 100000] [--repeats 7] [--chromium PATH]

Beside each question stands the same one asked of the run index (SQLite) for one page of 50 rows, as the playground's
list does. Times in the browser are from the press until the page is drawn: table, groups, plots and counts. Also
measured: how fast rows are listed. Prints medians and writes ``results/triage_desk.json``.
"""

import argparse
import asyncio
import json
import statistics
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import Page, sync_playwright

from benchmarks.machine import describe
from benchmarks.run_index import synthetic_row
from spherloc_viz.app.review.run_library import RunLibrary
from spherloc_viz.app.web.access import Access, open_socket
from spherloc_viz.app.web.desk import DeskRoom
from spherloc_viz.app.web.downloads import Downloads
from spherloc_viz.app.web.front_door import FrontDoor
from spherloc_viz.recording.index.query import Range, RunQuery
from spherloc_viz.recording.index.run_index import RunIndex

RESULTS = Path(__file__).parent / "results" / "triage_desk.json"
BATCH = 2_000
FLAGS = ("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking")
TIMED = """async (differences) => {
    const began = performance.now();
    change(differences, false);
    const asked = performance.now();
    await new Promise(done => requestAnimationFrame(() => setTimeout(done)));
    return [performance.now() - began, asked - began];
}"""
BOX = {"outlier_rate": [0.6, 0.9], "rotation_error_deg": [0.1, 30]}
LASSO = [[-1, -1], [1, -1], [1, 1], [-1, 1]]
QUESTIONS: tuple[tuple[str, dict[str, Any], RunQuery | None], ...] = (
    ("filter by outcome", {"chosen": {"outcome": ["failure"]}}, RunQuery(outcome="failure")),
    ("filter by cause", {"chosen": {"diagnosis": ["ambiguous"]}}, RunQuery(diagnosis="ambiguous")),
    ("search a word", {"chosen": {}, "search": "pose"}, RunQuery(text="pose")),
    ("sort by error", {"search": "", "sort": "rotation_error_deg"}, RunQuery(sort="rotation_error_deg")),
    ("sort by scene", {"sort": "scene", "descending": False}, RunQuery(sort="scene", descending=False)),
    ("brush a box", {"ranges": BOX}, RunQuery(outlier_rate=Range(0.6, 0.9), rotation_error_deg=Range(0.1, 30.0))),
    ("lasso on the map", {"ranges": {}, "lasso": LASSO}, None),
    ("take all away", {"lasso": None}, RunQuery()),
)


def fill(folder: Path, count: int) -> tuple[RunIndex, float]:
    """An index of synthetic runs with measures, and the seconds that listing them took."""
    rng = np.random.default_rng(1)
    index, spent = RunIndex(folder), 0.0
    for start in range(0, count, BATCH):
        rows = [with_measures(synthetic_row(k, rng), rng) for k in range(start, min(count, start + BATCH))]
        began = time.perf_counter()
        index.add_all(rows)
        spent += time.perf_counter() - began
    return index, spent


def with_measures(row: Any, rng: np.random.Generator) -> Any:
    """The row with evidence that never was."""
    values = dict(row.__dict__)
    for name in ("residual_median", "residual_p90", "alternative_support", "coverage"):
        values[name] = float(rng.uniform())
    for name in ("tilt_deg", "rotation_sd_deg", "position_sd_m"):
        values[name] = float(rng.exponential())
    return type(row)(**values | {"thumbnail": b""})


def ask(page: Page, repeats: int) -> dict[str, float]:
    """Median milliseconds of each question, until the page is drawn."""
    found: dict[str, list[float]] = {name: [] for name, _, _ in QUESTIONS}
    for _ in range(repeats):
        for name, differences, _ in QUESTIONS:
            found[name].append(page.evaluate(TIMED, differences)[0])
    return {name: statistics.median(values) for name, values in found.items()}


def timed(work: Callable[[], object], repeats: int) -> float:
    """Median milliseconds."""
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        work()
        times.append(1e3 * (time.perf_counter() - began))
    return statistics.median(times)


def serve(index: RunIndex, ready: threading.Event, told: dict[str, int]) -> None:
    """A front door with the desk, until the program ends."""

    async def run() -> None:
        downloads = Downloads()
        desk = DeskRoom(RunLibrary(index), downloads)
        listener = open_socket("127.0.0.1", 0)
        await FrontDoor("127.0.0.1", 1, "", Access(False), downloads, None, False, desk).start(listener)
        told["port"] = listener.getsockname()[1]
        ready.set()
        await asyncio.Event().wait()

    asyncio.run(run())


def main() -> None:
    """Measure, print, and write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=100_000)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--chromium", default="/usr/bin/chromium")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        index, listing = fill(Path(folder), given.runs)
        ready, told = threading.Event(), dict[str, int]()
        threading.Thread(target=serve, args=(index, ready, told), daemon=True).start()
        ready.wait()
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=given.chromium, args=list(FLAGS))
            page = browser.new_page(viewport={"width": 1440, "height": 900})
            opened = []
            for _ in range(2):
                began = time.perf_counter()
                page.goto(f"http://127.0.0.1:{told['port']}/desk")
                page.wait_for_selector('body[data-state="open"]')
                opened.append(time.perf_counter() - began)
            browser_ms = ask(page, given.repeats)
            browser.close()
        index_ms = {
            name: timed(lambda query=query: index.find(query, 50), given.repeats)
            for name, _, query in QUESTIONS
            if query is not None
        }
        index.close()
    rate = given.runs / listing
    print(f"{given.runs:,} runs: listed at {rate:,.0f} a second; opens in {opened[0]:.1f} s, again {opened[1]:.1f} s")
    print(f"{'':<20}{'desk, drawn':>14}{'index, 50 rows':>17}")
    for name, value in browser_ms.items():
        peer = index_ms.get(name)
        beside = "" if peer is None else f"{peer:>14.0f} ms"
        print(f"{name:<20}{value:>11.0f} ms{beside}")
    result = {
        "machine": describe(),
        "runs": given.runs,
        "listed_per_s": rate,
        "opened_s": opened,
        "desk_ms": browser_ms,
        "index_ms": index_ms,
    }
    RESULTS.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
