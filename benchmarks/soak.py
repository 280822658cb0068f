"""Twenty pages at once for some minutes: every page must end with what its hand asked for, and nobody else's.

    .venv/bin/python -m benchmarks.soak --pages 20 --minutes 5

Each page turns its widgets at random. From time to time it stands still, and then what it shows must be what it asked
for: the values of its widgets, the number of matches in its outcome (each page has its own), and the seed. At
the end it prints runs, mistakes, latencies, memory and threads.
"""

import argparse
import asyncio
import re
import time
from functools import partial

import numpy as np

from benchmarks.page_client import PageClient
from benchmarks.playground import memory_mib, playground, thread_count

ESTIMATORS = ("mc-exact (exact, certified)", "mc (the paper's)", "ransac-2p (two points)")


async def visit(address: str, number: int, end_s: float, mistakes: list[str], answers: list[float]) -> int:
    """Turn the widgets of one page until ``end_s``; returns how many runs it asked for."""
    rng = np.random.default_rng(number)
    runs, points = 0, 40 + number
    async with PageClient(address) as page:
        await page.until(lambda: page.says("data-ready"), 120.0)
        await page.set("Points", points)
        while time.perf_counter() < end_s:
            for _ in range(rng.integers(3, 12)):
                label, value = _move(rng)
                await page.set(label, value)
                runs += 1
                await asyncio.sleep(rng.uniform(0.02, 0.3))
            seed = str(rng.integers(10**6))
            start = time.perf_counter()
            await page.set("Seed", seed)
            runs += 1
            try:
                await page.until(partial(_recorded, page, seed), 60.0)
            except TimeoutError:
                status = next((html for html in page.html.values() if "ecorded" in html), "")
                mistakes.append(f"page {number}: the run with seed {seed} never came; {re.sub('<[^>]*>', '', status)}")
                continue
            answers.append(time.perf_counter() - start)
            mistakes += _mistakes(page, number, points, seed)
    return runs


def _recorded(page: PageClient, seed: str) -> bool:
    """Whether the page names the recording of a run with that seed."""
    return page.says("Recorded as") and page.says(f"_{seed}_")


def _move(rng: np.random.Generator) -> tuple[str, object]:
    kind = rng.integers(4)
    if kind == 0:
        return "Noise (px)", round(float(rng.uniform(0.1, 5.0)), 1)
    if kind == 1:
        return "Outliers (%)", float(rng.integers(0, 95))
    if kind == 2:
        return "Estimator", str(rng.choice(ESTIMATORS))
    return "Timeline", int(rng.integers(1, 20))


def _mistakes(page: PageClient, number: int, points: int, seed: str) -> list[str]:
    """What the page shows and did not ask for."""
    found = []
    outcome = next((html for html in page.html.values() if "inliers" in html and "outcome" in html), "")
    counts = set(re.findall(r"of (\d+)<", outcome))
    if counts != {str(points)}:
        found.append(f"page {number}: its outcome speaks of {counts}, not of {points} matches")
    if page.widget("Points").value != points or page.widget("Seed").value != seed:
        found.append(f"page {number}: its widgets say {page.widget('Points').value}, {page.widget('Seed').value}")
    return found


async def soak(pages: int, minutes: float) -> None:
    """Run it and print what was seen."""
    mistakes: list[str] = []
    answers: list[float] = []
    with playground() as (address, server):
        end_s = time.perf_counter() + 60.0 * minutes
        tasks = [asyncio.create_task(visit(address, k, end_s, mistakes, answers)) for k in range(pages)]
        memory = []
        while not all(task.done() for task in tasks):
            memory.append((memory_mib(server.pid), thread_count(server.pid)))
            await asyncio.sleep(5.0)
        runs = sum(await asyncio.gather(*tasks))
        await asyncio.sleep(3.0)
        left = memory_mib(server.pid), thread_count(server.pid)
    print(f"{pages} pages, {minutes:g} minutes: {runs} changes, {len(answers)} read back, {len(mistakes)} mistakes")
    if answers:
        median, high = np.percentile(answers, [50, 95])
        print(f"from a change to its recording, 0.7 s of quiet included: {median:.2f} s, 95 % {high:.2f} s")
    print(
        "memory MiB, threads:", ", ".join(f"{mib:.0f} {count}" for mib, count in memory[:: max(1, len(memory) // 12)])
    )
    print(f"after all pages have left: {left[0]:.0f} MiB, {left[1]} threads")
    for mistake in mistakes[:20]:
        print(mistake)


def main() -> None:
    """Read the command line."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("--pages", type=int, default=20)
    words.add_argument("--minutes", type=float, default=5.0)
    given = words.parse_args()
    asyncio.run(soak(given.pages, given.minutes))


if __name__ == "__main__":
    main()
