"""Eight pages at once: each has its own state, none loses a change, and nothing stays when they leave. No browser."""

import asyncio
import re
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
from spherloc_viz.app.catalog import Catalog, SceneRequest
from spherloc_viz.app.controls.estimator_controls import ABOUT
from spherloc_viz.layers.outcome import outcome_table
from tests.waiting import LIMIT_S, until

PAGES = 8
BURSTS = 2
ESTIMATORS = {f"{name} ({ABOUT[name]})": name for name in ("mc", "mc-exact", "ransac-2p")}
COMPARED = ("estimator", "outcome", "rotation error", "position error", "inliers")
OWN_THREADS = 4
"""Of each page: they solve, draw, diagnose, and look after slow runs."""
SLACK = 3
"""Threads by which the shared pool may grow when all pages leave."""
MEMORY_MIB = 40.0
"""What the server may keep of pages that have left, once others did the same: what the allocator keeps."""


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
    problem = catalog.problem(SceneRequest("small street", seed, None, variation))
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


async def visit(address: str, number: int, catalog: Catalog, rng: np.random.Generator, end: asyncio.Barrier) -> int:
    """Some bursts of changes on one page, each of which must end with what was asked for; returns the changes.

    The page leaves when all pages have come to their end.
    """
    changes = 0
    async with PageClient(address) as page:
        await page.until(lambda: outcome(page), LIMIT_S)
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
                await page.until(lambda rows=rows: rows.items() <= outcome(page).items(), LIMIT_S)
            except TimeoutError:
                pytest.fail(f"page {number} was asked for {wanted}, so {rows}, and shows {outcome(page)}")
            # Nor has the server put another value into a widget.
            await page.settle()
            told = lambda: {name: page.widget(name).value for name in wanted}  # noqa: E731
            try:
                await page.until(lambda told=told: told() == wanted, LIMIT_S)
            except TimeoutError:
                pytest.fail(f"page {number} was asked for {wanted} and told {told()}")
            # The same values may have been asked for before others, so that the run was seen on the way already.
            await page.until(lambda rows=rows: rows.items() <= outcome(page).items(), LIMIT_S)
        await end.wait()
    return changes


async def visits(address: str, process: int, catalog: Catalog) -> tuple[int, int]:
    """All pages at once; returns the changes and how many threads there were before the pages left."""
    end = asyncio.Barrier(PAGES + 1)
    rngs = np.random.default_rng(2).spawn(PAGES)
    tasks = [asyncio.create_task(visit(address, number, catalog, rng, end)) for number, rng in enumerate(rngs)]
    arrival = asyncio.create_task(end.wait())
    await asyncio.wait([arrival, *tasks], return_when=asyncio.FIRST_COMPLETED)
    threads = thread_count(process)
    if not arrival.done():  # a page failed
        await end.abort()
    return sum(await asyncio.gather(*tasks)), threads


async def greetings(address: str) -> None:
    """All pages come at once, see their first run, and leave."""

    async def greet() -> None:
        async with PageClient(address) as page:
            await page.until(lambda: outcome(page), LIMIT_S)

    await asyncio.gather(*(greet() for _ in range(PAGES)))


def test_pages_do_not_disturb_each_other_and_leave_nothing(server: tuple[str, int], scene: Path) -> None:
    address, process = server
    # The first ones also fill the caches that all pages share.
    asyncio.run(greetings(address))
    asyncio.run(visits(address, process, Catalog(scene)))
    memory = memory_mib(process)
    changes, threads = asyncio.run(visits(address, process, Catalog(scene)))
    assert changes > 5 * PAGES * BURSTS
    # The pool that answers all pages keeps its threads, but the pages' own must end.
    until(lambda: thread_count(process) <= threads - PAGES * OWN_THREADS + SLACK)
    assert memory_mib(process) < memory + MEMORY_MIB
