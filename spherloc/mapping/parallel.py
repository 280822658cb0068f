"""Work on images or pairs of them on all processors."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from typing import TypeVar

from spherloc.processors import processor_count

Job = TypeVar("Job")
Result = TypeVar("Result")

Tell = Callable[[str, int, int], None]
"""Called after each piece of work: with its kind in the plural, how many are done, and how many there are."""
MAX_WORKERS = 4


def as_completed(work: Callable[[Job], Result], jobs: Sequence[Job]) -> Iterator[tuple[Job, Result]]:
    """Jobs with their results as they are completed, by threads; raises what ``work`` raises.

    Only a few are started ahead, and an interruption waits for those that run.
    """
    workers = max(1, min(MAX_WORKERS, processor_count()))
    running: dict[Future[Result], Job] = {}
    left = iter(jobs)
    pool = ThreadPoolExecutor(workers)
    try:
        while True:
            while len(running) < 2 * workers and (job := next(left, None)) is not None:
                running[pool.submit(work, job)] = job
            if not running:
                return
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                yield running.pop(future), future.result()
    finally:
        pool.shutdown(cancel_futures=True)
