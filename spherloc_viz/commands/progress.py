"""Progress of long jobs on stderr, and jobs that Ctrl-C ends at once."""

import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from typing import Any

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


@contextmanager
def progress(count: int, plural: str) -> Iterator[Callable[[str], None]]:
    """A bar on a terminal, else a line now and then.

    The function that it gives is called after each of ``count`` pieces of work ("queries") with a remark, which may be
    empty.
    """
    if sys.stderr.isatty():
        with tqdm(total=count, unit=f" {plural}", file=sys.stderr, dynamic_ncols=True, delay=BAR_AFTER_S) as bar:

            def advance(remark: str) -> None:
                bar.set_postfix_str(remark, refresh=False)
                bar.update()

            yield advance
        return
    done, said = 0, time.monotonic()

    def line(remark: str) -> None:
        nonlocal done, said
        done += 1
        if time.monotonic() - said > LINE_EVERY_S:
            say(f"{done:,} of {count:,} {plural}{f', {remark}' if remark else ''}.")
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
