"""Workers of a sweep that belong to a Dask cluster. Its machines have spherloc and can read the scene file."""

import asyncio
import contextlib
import logging
import queue
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from spherloc.errors import InputError
from spherloc.experiments.sweep_plan import Job, SweepPlan
from spherloc.experiments.sweep_workers import AHEAD, Done, Keep, solve
from spherloc.registry import require

CONNECT_S = 10.0
COUNT_EVERY_S = 2.0
"""Time between two counts of the workers, whose number can change."""
PATIENCE_S = 60.0
"""Longest time for which a cluster may be without any worker."""
GATHER_S = 2.0


class Cluster:
    """Workers behind a Dask scheduler. Dask does the tasks of a lost worker again, also those with a result."""

    def __init__(self, plan: SweepPlan, address: str, keep: Keep | None) -> None:
        """Raises ``InputError`` if ``dask.distributed`` is missing, or no scheduler with workers is at ``address``."""
        self._dask = require("distributed", "cluster", "a sweep on a Dask cluster")
        self._plan, self._address, self._keep = plan, address, keep
        # Errors are reported here in one sentence; Dask would log them with tracebacks.
        logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
        try:
            # A client that never reached its scheduler takes 20 s to be deleted, so the address is tried before.
            with ThreadPoolExecutor(1) as knocking:
                knocking.submit(asyncio.run, _knock(self._dask, address)).result()
            self._client: Any = self._dask.Client(address, timeout=CONNECT_S, set_as_default=False)
        except (OSError, TimeoutError, ValueError, TypeError, ImportError) as error:
            raise InputError(
                f"no Dask scheduler answers at '{address}' ({_one_line(error)}); give its address, such as "
                "tcp://host:8786."
            ) from None
        self._tasks: dict[Any, tuple[Job, ...]] = {}
        self._ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._threads, self._counted, self._seen = 0, 0.0, time.monotonic()
        try:
            with contextlib.suppress(TimeoutError):
                self._client.wait_for_workers(1, timeout=CONNECT_S)
            self._count()
            if not self._threads:
                raise InputError(f"the Dask cluster at {address} has no workers; start some: dask worker {address}")
        except BaseException:
            self.close()
            raise

    def room(self) -> int:
        """Number of further tasks that can be submitted now."""
        if time.monotonic() - self._counted > COUNT_EVERY_S:
            self._count()
        return self._threads + AHEAD - len(self._tasks)

    def submit(self, jobs: tuple[Job, ...]) -> None:
        """Have a worker do these jobs as one task; does not wait."""
        future = self._client.submit(solve, self._plan, jobs, self._keep, pure=False)
        self._tasks[future] = jobs
        future.add_done_callback(self._ended.put)

    def collect(self, timeout_s: float) -> list[Done]:
        """Tasks that ended since the last call; waits at most ``timeout_s`` seconds for the first one."""
        found: list[Done] = []
        with contextlib.suppress(queue.Empty):
            future = self._ended.get(timeout=timeout_s)
            while True:
                if (done := self._gather(future)) is not None:
                    found.append(done)
                future = self._ended.get_nowait()
        if not found:
            self._check()
        return found

    def close(self) -> None:
        """Drop tasks that are not done, and disconnect from the workers."""
        with contextlib.suppress(Exception):  # the scheduler may be gone
            self._client.cancel(list(self._tasks), asynchronous=False)
        self._tasks.clear()
        with contextlib.suppress(Exception):
            self._client.close(timeout=2)

    def _gather(self, future: Any) -> Done | None:
        """The task of a future; None if its result was lost with its worker and is being computed again."""
        try:
            solved = future.result(timeout=GATHER_S)
        except self._dask.KilledWorker:
            solved = None
        except TimeoutError:
            future.add_done_callback(self._ended.put)
            return None
        except self._dask.CancelledError:
            raise self._lost() from None
        return Done(self._tasks.pop(future), solved)

    def _check(self) -> None:
        if self._client.status != "running":
            raise self._lost()
        if time.monotonic() - self._seen > PATIENCE_S:
            raise InputError(
                f"the Dask cluster at {self._address} has had no workers for {PATIENCE_S:.0f} s; start some and give "
                "the same command to go on."
            )

    def _count(self) -> None:
        try:
            self._threads = sum(self._client.nthreads().values())
        except (OSError, TimeoutError):
            raise self._lost() from None
        self._counted = time.monotonic()
        if self._threads:
            self._seen = self._counted

    def _lost(self) -> InputError:
        return InputError(
            f"the Dask scheduler at {self._address} is gone; start it and give the same command to go on."
        )


async def _knock(dask: Any, address: str) -> None:
    identity = dask.rpc(address, timeout=CONNECT_S)
    try:
        if (await asyncio.wait_for(identity.identity(), CONNECT_S))["type"] != "Scheduler":
            raise ValueError("it is not a scheduler")
    finally:
        await identity.close_rpc()


def _one_line(error: BaseException) -> str:
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 120 else f"{text[:117]}..."
