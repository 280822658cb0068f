"""Whether anything grows: python -m benchmarks.long_run --pages 20 --minutes 20 --recordings 10000 --visits 300

Three parts, one after another. Recordings: so many runs are recorded by one recorder, as a sweep does. Visits: so many
pages are opened, ten at a time, until each has seen its first run, and closed. Soak: so many pages change their widgets
for so long, as ``benchmarks.soak`` does. Resident memory, threads and open files of the process that does it are read
all along; the last half must be flat. Ends with 1 if it is not, or if a page was shown what it did not ask for. Linux.
"""

import argparse
import asyncio
import multiprocessing
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from benchmarks.page_client import PageClient
from benchmarks.playground import memory_mib, playground, thread_count
from benchmarks.soak import visit

AT_ONCE = 10
"""Pages that are opened together."""
MEMORY_MIB = 25.0
"""What memory may grow by over the last half, along the line that fits it best."""
THREADS, FILES = 3, 5
"""The same for threads and open files."""
SAMPLES = 40


@dataclass
class Watched:
    """What a process had, and when: after so many recordings, visits or seconds."""

    done: list[float] = field(default_factory=list)
    rows: list[tuple[float, int, int]] = field(default_factory=list)
    """Memory in MiB, threads, open files."""

    def note(self, done: float, process: int) -> None:
        """Read it once more."""
        self.done.append(done)
        self.rows.append((memory_mib(process), thread_count(process), len(list(Path(f"/proc/{process}/fd").iterdir()))))

    def verdict(self, name: str, unit: str, per: float) -> bool:
        """Print what was seen and how it grew over the last half; whether that is flat."""
        half = len(self.rows) // 2
        done, rows = np.array(self.done[half:]), np.array(self.rows[half:])
        slopes = np.polyfit(done, rows, 1)[0] if len(done) > 2 and np.ptp(done) > 0 else np.full(3, np.nan)
        grown = slopes * np.ptp(done)
        flat = bool((grown <= (MEMORY_MIB, THREADS, FILES)).all())
        print(f"{name}: {self.done[-1]:,.0f} {unit}; {'flat' if flat else 'GROWS'}")
        for column, title in enumerate(("memory, MiB", "threads", "open files")):
            seen = [f"{row[column]:.0f}" for row in self.rows[:: max(1, len(self.rows) // 10)]]
            slope = f"{slopes[column] * per:+.2f} per {per:,.0f} {unit}"
            print(f"  {title}: {' '.join(seen)}; over the last half {slope}, {grown[column]:+.1f} in all")
        sys.stdout.flush()
        return flat


def _record(count: int, pipe: Connection) -> None:
    """Record so many runs, telling how many are done."""
    from spherloc.datasets import bundled_scenes, load_scene
    from spherloc.estimators import estimate
    from spherloc_viz.recording.storage.recorder import Recorder

    scene = load_scene(bundled_scenes()["mei_outliers_80"])
    traces = [estimate(scene.problem(seed), "mc", seed=seed) for seed in range(20)]
    failures: list[str] = []
    with (
        tempfile.TemporaryDirectory() as folder,
        Recorder(Path(folder), lambda error: failures.append(str(error)), keep_bytes=200_000_000) as recorder,
    ):
        for number in range(count):
            recorder.submit(traces[number % len(traces)])
            while recorder.waiting > 8:
                time.sleep(0.005)
            if (number + 1) % max(1, count // SAMPLES) == 0:
                pipe.send(number + 1)
                pipe.recv()
    pipe.send(failures)


def record(count: int) -> bool:
    """The first part, in a process of its own; whether all was well."""
    ours, theirs = multiprocessing.Pipe()
    process = multiprocessing.get_context("spawn").Process(target=_record, args=(count, theirs))
    process.start()
    theirs.close()
    watched = Watched()
    while isinstance(told := ours.recv(), int):
        watched.note(told, process.pid or 0)
        ours.send(None)
    process.join()
    print(f"recordings that failed: {len(told)} {told[:3]}")
    return watched.verdict("recordings", "recordings", 1000.0) and not told


async def _greet(address: str) -> None:
    async with PageClient(address) as page:
        await page.until(lambda: page.says("data-ready"), 180.0)


async def visits(count: int) -> bool:
    """The second part; whether all was well."""
    watched = Watched()
    with playground() as (address, server):
        for done in range(0, count, AT_ONCE):
            await asyncio.gather(*(_greet(address) for _ in range(min(AT_ONCE, count - done))))
            await _quiet(lambda: thread_count(server.pid))
            watched.note(done + AT_ONCE, server.pid)
        return watched.verdict("visits", "visits", 100.0)


async def _quiet(read: Callable[[], int]) -> None:
    """Wait until a count has stayed the same for half a second, or for ten."""
    seen: list[int] = []
    for _ in range(20):
        seen.append(read())
        if len(seen) > 1 and seen[-1] == seen[-2]:
            return
        await asyncio.sleep(0.5)


async def soak(pages: int, minutes: float) -> bool:
    """The third part; whether all was well."""
    watched, mistakes, answers = Watched(), [], []
    with playground() as (address, server):
        start = time.perf_counter()
        end_s = start + 60.0 * minutes
        tasks = [asyncio.create_task(visit(address, k, end_s, mistakes, answers)) for k in range(pages)]
        while not all(task.done() for task in tasks):
            if time.perf_counter() < end_s:
                watched.note(time.perf_counter() - start, server.pid)
            await asyncio.sleep(60.0 * minutes / (3 * SAMPLES))
        changes = sum(await asyncio.gather(*tasks))
        await _quiet(lambda: thread_count(server.pid))
        left = memory_mib(server.pid), thread_count(server.pid)
        flat = watched.verdict(f"soak of {pages} pages", "seconds", 600.0)
        print(f"  {changes:,} changes, {len(answers):,} read back, {len(mistakes)} mistakes")
        print(f"  after all pages have left: {left[0]:.0f} MiB, {left[1]} threads")
        for mistake in mistakes[:20]:
            print(f"  {mistake}")
    return flat and not mistakes


def main() -> int:
    """Read the command line."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("--pages", type=int, default=20)
    words.add_argument("--minutes", type=float, default=20.0)
    words.add_argument("--recordings", type=int, default=10_000)
    words.add_argument("--visits", type=int, default=300)
    given = words.parse_args()
    well = [record(given.recordings)] if given.recordings else []
    well += [asyncio.run(visits(given.visits))] if given.visits else []
    well += [asyncio.run(soak(given.pages, given.minutes))] if given.pages else []
    return 0 if all(well) else 1


if __name__ == "__main__":
    sys.exit(main())
