"""How long the page takes to answer: from the command until it is ready, and from a widget's message to the last byte
or to the painted frame; alone, and with others who drag at the same time.

    .venv/bin/python -m benchmarks.latency             # bytes, a minute
    .venv/bin/python -m benchmarks.latency --browser   # and frames in Chromium with its draw calls stubbed

Every case starts the playground anew and turns a slider a little, again and again, each time after a pause: what is
measured is one move of a hand, with the whole picture, all panels and the front door.
"""

import argparse
import asyncio
import contextlib
import time
from dataclasses import dataclass

import numpy as np

from benchmarks.browser_frames import painted_frames
from benchmarks.page_client import PageClient
from benchmarks.playground import playground

WARM = 8
STEPS = 20
"""Number of the steps that are walked, in an order that jumps."""


@dataclass(frozen=True)
class Case:
    """One row of the table."""

    name: str
    points: int
    outliers_percent: float
    estimator: str
    median_ms: float
    """What is asked for."""
    step: bool = False
    """Whether steps are walked instead of runs made, back and forth: most of them have been seen before."""
    first: bool = False
    """Whether only steps count that are seen for the first time."""


CASES = (
    Case("run, N 200", 200, 95.0, "mc-exact (exact, certified)", 12.0),
    Case("run, N 1000", 1000, 95.0, "mc-exact (exact, certified)", 40.0),
    Case("step, N 200, mc-exact", 200, 95.0, "mc-exact (exact, certified)", 5.0, step=True),
    Case("step, N 200, mc", 200, 80.0, "mc (the paper's)", 5.0, step=True),
    Case("step, N 200, mc, for the first time", 200, 80.0, "mc (the paper's)", 5.0, step=True, first=True),
)
OPENINGS = ("The yaw most arcs share", "What no pose can beat, at each yaw", "What no pose can beat")
"""Titles of the steps at which pages open."""
READY_S, STARTS = 1.5, 5
CROWD = 5


def opening_of(page: PageClient) -> str:
    """The title of the step at which the page opens; empty while it has no such step."""
    return next((title for title in page.widget("Step").props["options"] if title.endswith(OPENINGS)), "")


async def prepare(page: PageClient, case: Case) -> None:
    """Bring a page to a case, at the step at which a page of that estimator opens: elsewhere more or less is drawn."""
    await page.until(lambda: page.says("data-ready"), 120.0)
    await page.set("Points", case.points)
    await page.set("Outliers (%)", case.outliers_percent)
    await page.set("Estimator", case.estimator)
    await page.until(lambda: page.says(f"of {case.points}<"))
    await asyncio.sleep(2.0)
    await page.settle(0.5)
    await page.until(lambda: opening_of(page))
    opening = opening_of(page)
    await page.set("Step", opening)
    await page.until(lambda: page.widget("Step").value == opening)
    await asyncio.sleep(1.0)
    await page.settle(0.5)


async def answers_ms(case: Case, moves: int) -> tuple[np.ndarray, float]:
    """Milliseconds (moves,) from each message to the last byte that follows, and kilobytes at the median."""
    with playground() as (address, _):
        async with PageClient(address) as page:
            await prepare(page, case)
            found = []
            for k in range(WARM + moves):
                if case.step:
                    found.append(await page.answer("Timeline", 1 + (7 * k) % STEPS))
                else:
                    found.append(await page.answer("Noise (px)", round(0.8 + 0.01 * k, 2), quiet_s=0.1))
            found = found[:STEPS] if case.first else found[WARM:]
            kilobytes = float(np.median([answer.bytes for answer in found])) / 1e3
            return np.array([1e3 * answer.seconds for answer in found]), kilobytes


async def ready_s() -> float:
    """Seconds from the command until a page that asks at once is ready."""
    start = time.perf_counter()
    with playground() as (address, _):
        async with PageClient(address) as page:
            await page.until(lambda: page.says("data-ready"), 120.0)
            return time.perf_counter() - start


async def crowd_ms(case: Case, moves: int, clients: int) -> np.ndarray:
    """Milliseconds (clients * moves,) from a message to the first answer, where all drag without a pause."""

    async def drag(page: PageClient, first: int) -> list[float]:
        found = []
        for k in range(moves):
            start = time.perf_counter()
            await page.set("Noise (px)", round(0.8 + 0.01 * (first + k), 2))
            await page.until(lambda start=start: page.last_s > start)
            found.append(1e3 * (time.perf_counter() - start))
        return found

    with playground() as (address, _):
        async with contextlib.AsyncExitStack() as stack:
            pages = [await stack.enter_async_context(PageClient(address)) for _ in range(clients)]
            for page in pages:
                await prepare(page, case)
            await asyncio.gather(*(drag(page, 0) for page in pages))
            found = await asyncio.gather(*(drag(page, moves) for page in pages))
            return np.concatenate(found)


def main() -> None:
    """Print the table."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("--moves", type=int, default=100)
    words.add_argument("--browser", action="store_true", help="measure painted frames too")
    given = words.parse_args()
    print("| case | median ms | 95 % ms | asked for | kB |\n|---|---|---|---|---|")
    starts = 1e3 * np.array([asyncio.run(ready_s()) for _ in range(1 + STARTS)][1:])
    row("from the command to the page", starts, f"{1e3 * READY_S:g}")
    for case in CASES:
        found, kilobytes = asyncio.run(answers_ms(case, given.moves))
        row(case.name, found, f"{case.median_ms:g}", f"{kilobytes:.0f}")
    alone = asyncio.run(crowd_ms(CASES[0], given.moves, 1))
    row("dragged without a pause, N 200, alone", alone, "")
    together = asyncio.run(crowd_ms(CASES[0], given.moves, CROWD))
    row(f"... {CROWD} pages at once", together, f"{CROWD * np.median(alone):.0f}")
    if given.browser:
        with playground() as (address, _):
            row("to the painted frame, N 200", np.asarray(painted_frames(address, given.moves)), "")


def row(name: str, found_ms: np.ndarray, asked: str, kilobytes: str = "") -> None:
    """Print a row of the table."""
    median, high = np.percentile(found_ms, [50, 95])
    print(f"| {name} | {median:.1f} | {high:.1f} | {asked} | {kilobytes} |", flush=True)


if __name__ == "__main__":
    main()
