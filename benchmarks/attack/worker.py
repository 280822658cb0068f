"""Reads damaged files, one after another: ``python -m benchmarks.attack.worker INTACT SCRATCH SEED``.

A line "KIND NUMBER COUNT" on its input asks for so many files of a kind from a number on; each is answered with a line
of JSON. It may die or hang at any of them: whoever started it knows which was next.
"""

import json
import os
import resource
import shutil
import sys
import time
import traceback
import warnings
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.attack.damage import damaged, misplaced
from benchmarks.attack.kinds import KINDS, Kind, targets

MISPLACED = 0.02
"""Share of the files in whose place is none."""
ADDRESS_BYTES = 4 << 30
"""A reader that asks for more gets a ``MemoryError`` rather than this machine."""
LONGEST = 700
"""Characters of a sentence."""


def tried(kind: Kind, name: str, number: int, seed: int, intact: Path, folder: Path) -> dict[str, Any]:
    """Damage one file of an intact copy in ``folder``, read it, and mend it again; what came of it."""
    rng = np.random.default_rng([seed, zlib.crc32(name.encode()), number])
    every = targets(kind, intact)
    original = every[int(rng.integers(len(every)))]
    path = folder / original.relative_to(intact)
    try:
        if rng.random() < MISPLACED:
            misplaced(path, rng)
        else:
            path.write_bytes(damaged(original.read_bytes(), rng))
        return {"number": number, "file": path.name, **_read(kind, folder, path)}
    finally:
        if kind.writes:
            shutil.rmtree(folder, ignore_errors=True)
            shutil.copytree(intact, folder)
        else:
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:  # rmtree would open a pipe and wait for its writer
                path.unlink(missing_ok=True)
            shutil.copy2(original, path)


def _read(kind: Kind, folder: Path, path: Path) -> dict[str, Any]:
    from spherloc.errors import SpherlocError

    _forget_peak()
    before_mb, children_mb = _own_peak_mb(), _children_mb()
    start, begun, said, wrong = _busy_s(), time.monotonic(), "", ""
    try:
        kind.read(folder, path)
        outcome = "accepted"
    except SpherlocError as error:
        outcome, said = "sentence", str(error)
        if not (said.isprintable() and said.endswith(".") and len(said) <= LONGEST + len(str(path))):
            outcome, wrong = "bad sentence", said[:LONGEST]
    except Exception as error:
        outcome, said = "traceback", f"{type(error).__name__}: {str(error)[:200]}"
        wrong = "".join(traceback.format_exception(error)[-6:])[-3000:]
    # A child that reads many files counts as a whole when it ends; of that, this file took no longer than it lasted.
    seconds = min(_busy_s() - start, time.monotonic() - begun)
    return {
        "outcome": outcome,
        "said": said[:200],
        "wrong": wrong,
        "seconds": seconds,
        "peak_mb": _peak_mb(before_mb, children_mb),
    }


def _busy_s() -> float:
    """Processor time of this process and of its children that have ended: a busy machine makes nothing slow."""
    return sum(os.times()[:4])


def _forget_peak() -> None:
    """Have the system measure the most memory from now on."""
    Path("/proc/self/clear_refs").write_text("5")


def _children_mb() -> float:
    """The most that any child had that has ended by now."""
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024.0


def _own_peak_mb() -> float:
    """The most memory of this process since it was forgotten."""
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    return next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM")) / 1024.0


def _peak_mb(before_mb: float, children_mb: float) -> float:
    """What this process had at most beyond ``before_mb``, or a child that has ended since and had more than those
    before."""
    now_mb = _children_mb()
    return max(_own_peak_mb() - before_mb, now_mb if now_mb > children_mb else 0.0)


def main() -> None:
    """Answer until the input ends."""
    intact, scratch, seed = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
    warnings.simplefilter("ignore")
    # What libraries print about damage is not an answer.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    os.dup2(1, 2)
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_BYTES, ADDRESS_BYTES))
    names = list(KINDS)
    for line in sys.stdin:
        which, first, count = map(int, line.split())
        name = names[which]
        folder = scratch / str(which)
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(intact / str(which), folder)
        for number in range(first, first + count):
            answer = tried(KINDS[name], name, number, seed, intact / str(which), folder)
            print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
