"""How long the page takes to answer: from a widget's message to the last byte, and to the painted frame.

    .venv/bin/python -m benchmarks.latency             # bytes, a minute
    .venv/bin/python -m benchmarks.latency --browser   # and frames in Chromium with its draw calls stubbed

Every case starts the playground anew and turns a slider a little, again and again, each time after a pause: what is
measured is one move of a hand, with the whole picture, all panels and the front door.
"""

import argparse
import asyncio
from dataclasses import dataclass

import numpy as np

from benchmarks.browser_frames import painted_frames
from benchmarks.page_client import PageClient
from benchmarks.playground import playground

WARM = 8


@dataclass(frozen=True)
class Case:
    """One row of the table."""

    name: str
    points: int
    outliers_percent: float
    estimator: str
    median_ms: float
    """What is asked for."""
    high_ms: float
    """What is asked for at the 95th percentile."""
    step: bool = False
    """Whether steps are walked instead of runs made."""


CASES = (
    Case("run, N 200", 200, 95.0, "mc-exact (exact, certified)", 15.0, 30.0),
    Case("run, N 1000", 1000, 95.0, "mc-exact (exact, certified)", 250.0, 250.0),
    Case("step, N 200, mc-exact", 200, 95.0, "mc-exact (exact, certified)", 15.0, 30.0, step=True),
    Case("step, N 200, mc", 200, 80.0, "mc (the paper's)", 15.0, 30.0, step=True),
)


async def prepare(page: PageClient, case: Case) -> None:
    """Bring a page to a case."""
    await page.until(lambda: page.says("data-ready"), 120.0)
    await page.set("Points", case.points)
    await page.set("Outliers (%)", case.outliers_percent)
    await page.set("Estimator", case.estimator)
    await page.until(lambda: page.says(f"of {case.points}<"))
    await asyncio.sleep(2.0)
    await page.settle(0.5)


async def answers_ms(case: Case, moves: int) -> tuple[np.ndarray, float]:
    """Milliseconds (moves,) from each message to the last byte that follows, and kilobytes at the median."""
    with playground() as (address, _):
        async with PageClient(address) as page:
            await prepare(page, case)
            found = []
            for k in range(WARM + moves):
                if case.step:
                    found.append(await page.answer("Timeline", 1 + (7 * k) % 20))
                else:
                    found.append(await page.answer("Noise (px)", round(0.8 + 0.01 * k, 2), quiet_s=0.1))
            found = found[WARM:]
            kilobytes = float(np.median([answer.bytes for answer in found])) / 1e3
            return np.array([1e3 * answer.seconds for answer in found]), kilobytes


def main() -> None:
    """Print the table."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("--moves", type=int, default=100)
    words.add_argument("--browser", action="store_true", help="measure painted frames too")
    given = words.parse_args()
    print("| case | median ms | 95 % ms | asked for | kB |\n|---|---|---|---|---|")
    for case in CASES:
        found, kilobytes = asyncio.run(answers_ms(case, given.moves))
        median, high = np.percentile(found, [50, 95])
        print(
            f"| {case.name} | {median:.1f} | {high:.1f} | {case.median_ms:g} / {case.high_ms:g} | {kilobytes:.0f} |",
            flush=True,
        )
    if given.browser:
        with playground() as (address, _):
            found = painted_frames(address, given.moves)
            median, high = np.percentile(found, [50, 95])
            print(f"| to the painted frame, N 200 | {median:.0f} | {high:.0f} | | |")


if __name__ == "__main__":
    main()
