"""Has processes read damaged files, and counts what came of them."""

import json
import os
import queue
import shutil
import subprocess
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.attack.kinds import KINDS
from benchmarks.machine import ROOT

SLOW_S = 10.0
"""Of processor time."""
HANG_S = 60.0
"""A process that has not answered for this long is ended; that file counts as slow too."""
LARGE_MB = 1024.0
START_S = 300.0
"""What a process may take until its first answer, with all that it loads."""
BATCH = 50


@dataclass
class Tally:
    """What came of the files of one kind."""

    tried: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    slow: int = 0
    """Over ``SLOW_S``."""
    large: int = 0
    """Over ``LARGE_MB``."""
    slowest_s: float = 0.0
    most_mb: float = 0.0
    wrong: list[dict[str, Any]] = field(default_factory=list)
    """Whatever misbehaved, with its number."""

    def add(self, answer: dict[str, Any]) -> None:
        """Count one more."""
        self.tried += 1
        self.outcomes[answer["outcome"]] += 1
        slow, large = answer["seconds"] > SLOW_S, answer["peak_mb"] > LARGE_MB
        self.slow += slow
        self.large += large
        self.slowest_s, self.most_mb = max(self.slowest_s, answer["seconds"]), max(self.most_mb, answer["peak_mb"])
        if slow or large or answer["outcome"] not in ("accepted", "sentence"):
            self.wrong.append(answer)


def attack_files(
    files: int, seed: int, workers: int, kinds: Sequence[str], told: Callable[[int], None]
) -> dict[str, Tally]:
    """Have about so many damaged files read, in processes side by side; ``told`` hears how many are done."""
    shares = sum(KINDS[name].share for name in kinds)
    counts = {name: max(1, round(files * KINDS[name].share / shares)) for name in kinds}
    starts = [(name, first) for name in kinds for first in range(0, counts[name], BATCH)]
    batches = [(name, first, min(BATCH, counts[name] - first)) for name, first in starts]
    return _attack(batches, seed, workers, told)


def attack_one(name: str, number: int, seed: int) -> Tally:
    """One file again."""
    return _attack([(name, number, 1)], seed, 1, lambda done: None)[name]


def _attack(
    batches: list[tuple[str, int, int]], seed: int, workers: int, told: Callable[[int], None]
) -> dict[str, Tally]:
    names = list(KINDS)
    tallies = {name: Tally() for name, _, _ in batches}
    with tempfile.TemporaryDirectory(prefix="spherloc-attack-") as scratch:
        folder = Path(scratch)
        for name in tallies:
            (folder / "intact" / str(names.index(name))).mkdir(parents=True)
            KINDS[name].write(folder / "intact" / str(names.index(name)))
        todo: queue.SimpleQueue[tuple[str, int, int]] = queue.SimpleQueue()
        for batch in batches:
            todo.put(batch)
        lock = threading.Lock()

        def work(place: int) -> None:
            crew = _Worker(folder, place, seed)
            try:
                while True:
                    try:
                        name, first, count = todo.get_nowait()
                    except queue.Empty:
                        return
                    for answer in crew.answers(names.index(name), first, count):
                        with lock:
                            tallies[name].add(answer)
                            told(sum(tally.tried for tally in tallies.values()))
            finally:
                crew.end()

        threads = [threading.Thread(target=work, args=(place,)) for place in range(workers)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    return tallies


class _Worker:
    """A process that reads; another one once it died or hung."""

    def __init__(self, folder: Path, place: int, seed: int) -> None:
        self._scratch = folder / f"worker{place}"
        self._command = [sys.executable, "-m", "benchmarks.attack.worker", folder / "intact", self._scratch, str(seed)]
        self._process: subprocess.Popen[str] | None = None
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()

    def answers(self, kind: int, first: int, count: int) -> Iterator[dict[str, Any]]:
        """What came of each of the files, the deadly ones too."""
        number, last = first, first + count
        while number < last:
            fresh = self._process is None
            process = self._process or self._start()
            assert process.stdin is not None
            process.stdin.write(f"{kind} {number} {last - number}\n")
            process.stdin.flush()
            while number < last:
                try:
                    line = self._lines.get(timeout=START_S if fresh else HANG_S)
                except queue.Empty:
                    line, ended = "", "hung"
                else:
                    ended = "died"
                fresh = False
                if not line:
                    self.end()
                    yield {
                        "number": number, "outcome": ended, "said": "", "wrong": f"the process {ended}", "file": "?",
                        "seconds": HANG_S if ended == "hung" else 0.0, "peak_mb": 0.0,
                    }  # fmt: skip
                    number += 1
                    break
                yield json.loads(line)
                number += 1

    def _start(self) -> subprocess.Popen[str]:
        shutil.rmtree(self._scratch, ignore_errors=True)
        environment = os.environ | {"SPHERLOC_CACHE": str(self._scratch / "cache"), "OMP_NUM_THREADS": "1"}
        process = subprocess.Popen(
            self._command, cwd=ROOT, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self._process, self._lines = process, queue.SimpleQueue()
        threading.Thread(target=_pump, args=(process, self._lines), daemon=True).start()
        return process

    def end(self) -> None:
        """End the process."""
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()


def _pump(process: subprocess.Popen[str], lines: "queue.SimpleQueue[str]") -> None:
    assert process.stdout is not None
    for line in process.stdout:
        lines.put(line)
    lines.put("")
