"""Progress of long jobs on stderr, and jobs that Ctrl-C ends at once."""

import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from typing import Any, Protocol

from tqdm import tqdm

from spherloc.datasets.map_scene import MapScene
from spherloc.estimators import estimate
from spherloc.problem import Problem
from spherloc.trace import Trace
from spherloc.watch import Watch

LINE_EVERY_S = 30.0
"""Seconds between two lines of progress if stderr is not a terminal."""
BAR_AFTER_S = 1.0
"""Least duration of a job, seconds, before its progress is shown."""


def say(sentence: str) -> None:
    """Print one line on stderr."""
    tqdm.write(f"spherloc: {sentence}", file=sys.stderr)  # above the bar, if there is one
    sys.stderr.flush()


class Advance(Protocol):
    """Called after each piece of work."""

    def __call__(self, remark: str, count: int | None = None) -> None:
        """``remark`` may be empty; ``count`` is the number of all pieces if that has changed."""
        ...


@contextmanager
def progress(count: int, plural: str) -> Iterator[Advance]:
    """A bar on a terminal, else a line now and then, of ``count`` pieces of work ("queries")."""
    if sys.stderr.isatty():
        with tqdm(total=count, unit=f" {plural}", file=sys.stderr, dynamic_ncols=True, delay=BAR_AFTER_S) as bar:

            def advance(remark: str, count: int | None = None) -> None:
                bar.total = bar.total if count is None else count
                bar.set_postfix_str(remark, refresh=False)
                bar.update()

            yield advance
        return
    done, total, said = 0, count, time.monotonic()

    def line(remark: str, count: int | None = None) -> None:
        nonlocal done, total, said
        done, total = done + 1, total if count is None else count
        if time.monotonic() - said > LINE_EVERY_S:
            say(f"{done:,} of {total:,} {plural}{f', {remark}' if remark else ''}.")
            said = time.monotonic()

    yield line


def solve(problem: Problem, estimator: str, options: Any, seed: int) -> Trace:
    """``estimate`` that Ctrl-C can end, and that prints the progress of a long run now and then.

    It runs on another thread: the main thread cannot react to Ctrl-C while a kernel computes, which can take hours.
    """
    watch = Watch()
    with ThreadPoolExecutor(1) as thread:
        run = thread.submit(estimate, problem, estimator, options, seed, watch)
        try:
            while not wait([run], LINE_EVERY_S).done:
                say(f"{estimator} is at {100 * watch.fraction:.0f} % of its search; Ctrl-C stops it.")
        except KeyboardInterrupt:
            watch.cancel()
            raise
        return run.result()


def prepare(scene: MapScene) -> None:
    """Let the scene prepare what all queries need, and show its progress."""
    with progress(len(scene.references), "references") as advance:
        scene.prepare(lambda done, count: advance(""))
