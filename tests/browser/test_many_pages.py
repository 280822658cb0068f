"""Eight pages at once: each has its own state, none loses a change, and nothing stays when they leave. No browser."""

import asyncio
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playground import SCENE, served

from benchmarks.page_client import PageClient
from benchmarks.playground import memory_mib, thread_count
from spherloc.datasets.variation import Variation
from spherloc.estimators import estimate
from spherloc_viz.app.catalog import Catalog, SceneWish
from spherloc_viz.app.estimator_controls import ABOUT
from spherloc_viz.layers.tables import outcome_table

PAGES = 8
BURSTS = 4
ESTIMATORS = {f"{name} ({ABOUT[name]})": name for name in ("mc", "mc-exact", "ransac-2p")}
COMPARED = ("estimator", "outcome", "rotation error", "position error", "inliers")
PUT_BACK_S = 1.0
MEMORY_MIB = 120.0
"""What the server may keep of pages that have left: caches, and what the allocator does not give back."""

pytestmark = [pytest.mark.timeout(280)]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "small.toml"
    path.write_text(SCENE)
    return path


@pytest.fixture(scope="module")
def server(scene: Path) -> Iterator[tuple[str, int]]:
    """Address and process of a playground."""
    with served(scene, "--no-record") as (address, process):
        yield address + "/", process.pid


def outcome(page: PageClient) -> dict[str, str]:
    """The outcome table as the page shows it."""
    html = next((content for content in page.html.values() if ">outcome</td>" in content), "")
    cells = [re.sub("<[^>]*>", "", cell) for cell in re.findall(r"<td[^>]*>(.*?)</td>", html)]
    return dict(zip(cells[::2], cells[1::2], strict=True))


def expected(wanted: dict[str, Any], catalog: Catalog) -> dict[str, str]:
    """What the core computes for these values of the widgets, as the outcome table words it."""
    variation = Variation(
        correspondences=wanted["Points"],
        noise_px=wanted["Noise (px)"],
        outlier_rate=wanted["Outliers (%)"] / 100.0,
    )
    seed = int(wanted["Seed"])
    problem = catalog.problem(SceneWish("small street", seed, None, variation))
    rows = dict(outcome_table(estimate(problem, ESTIMATORS[wanted["Estimator"]], seed=seed)).rows)
    return {name: rows[name] for name in COMPARED if name in rows}


def moved(rng: np.random.Generator) -> tuple[str, Any]:
    """A widget and what a hand sets it to."""
    return [
        ("Noise (px)", round(float(rng.uniform(0.2, 5.0)), 1)),
        ("Outliers (%)", float(rng.integers(0, 90))),
        ("Estimator", str(rng.choice(list(ESTIMATORS)))),
        ("Seed", str(rng.integers(10**6))),
    ][rng.integers(4)]


async def visit(address: str, number: int, catalog: Catalog, rng: np.random.Generator) -> int:
    """Some bursts of changes on one page, each of which must end with what was asked for; returns the changes."""
    changes = 0
    async with PageClient(address) as page:
        await page.until(lambda: outcome(page), 120.0)
        wanted = {name: page.widget(name).value for name in ("Noise (px)", "Outliers (%)", "Estimator", "Seed")}
        wanted["Points"] = 40 + number
        await page.set("Points", wanted["Points"])
        for _ in range(BURSTS):
            for _ in range(rng.integers(5, 25)):
                name, value = moved(rng)
                wanted[name] = value
                await page.set(name, value)
                changes += 1
                await asyncio.sleep(rng.uniform(0.0, 0.1))
            rows = expected(wanted, catalog)
            assert rows["inliers"].endswith(f" of {40 + number}")
            try:
                await page.until(lambda rows=rows: rows.items() <= outcome(page).items())
            except TimeoutError:
                pytest.fail(f"page {number} was asked for {wanted}, so {rows}, and shows {outcome(page)}")
            # Once nothing changes any more, the page is told all values that Python has.
            await page.settle(PUT_BACK_S)
            assert {name: page.widget(name).value for name in wanted} == wanted
            assert rows.items() <= outcome(page).items()
    return changes


async def visits(address: str, count: int, catalog: Catalog, seed: int) -> int:
    rngs = np.random.default_rng(seed).spawn(count)
    tasks = [visit(address, number, catalog, rng) for number, rng in enumerate(rngs)]
    return sum(await asyncio.gather(*tasks))


def settled_threads(process: int, wanted: int) -> int:
    """Threads of a process, once there are no more than wanted, or after a while."""
    end = time.monotonic() + 20.0
    while thread_count(process) > wanted and time.monotonic() < end:
        time.sleep(0.1)
    return thread_count(process)


def test_pages_do_not_disturb_each_other_and_leave_nothing(server: tuple[str, int], scene: Path) -> None:
    address, process = server
    catalog = Catalog(scene)
    print(thread_count(process), memory_mib(process))
    asyncio.run(visits(address, 2, catalog, 1))
    time.sleep(5)
    before = thread_count(process), memory_mib(process)
    print(before)
    start = time.monotonic()
    changes = asyncio.run(visits(address, PAGES, catalog, 2))
    print("took", time.monotonic() - start, changes)
    assert changes > 4 * PAGES * BURSTS
    print(settled_threads(process, before[0]), memory_mib(process))
    changes = asyncio.run(visits(address, PAGES, catalog, 3))
    print(settled_threads(process, before[0]), memory_mib(process))
    import os, signal
    os.kill(process, signal.SIGUSR2); time.sleep(0.5); os.kill(process, signal.SIGUSR1); time.sleep(1)
    assert 0
