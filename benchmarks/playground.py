"""Starts the playground as its user does, for the programs that measure it."""

import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

ROOT = Path(__file__).resolve().parents[1]
STOP_S = 120.0
"""What it may take to store what waits, on a busy machine too."""
SCENE = ROOT / "scenes" / "panorama_outliers_90.toml"


@contextmanager
def playground(
    scene: Path = SCENE, recordings: Path | None = None, *more: str, errors: IO[str] | None = None
) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """Address and process of ``spherloc play`` on a free port; the folder that it records into is thrown away if it is
    not given. ``more`` are further words of the command, and ``errors`` takes what it prints as errors."""
    program = Path(sys.executable).with_name("spherloc")
    with tempfile.TemporaryDirectory() as folder:
        words = [program, "play", scene, "--port", "0", "--recordings", recordings or folder, *more]
        server = subprocess.Popen([*map(str, words)], stdout=subprocess.PIPE, stderr=errors, text=True)
        try:
            assert server.stdout is not None
            line = server.stdout.readline()
            match = re.fullmatch(r"spherloc playground: (http://127\.0\.0\.1:\d+(/\?token=[\w-]+)?)\n", line)
            if match is None:
                raise RuntimeError(f"the playground did not start: {line!r}")
            yield match[1] + ("" if match[2] else "/"), server
        finally:
            server.terminate()
            server.wait(STOP_S)


def memory_mib(process: int) -> float:
    """Resident memory of a process, MiB (Linux)."""
    for line in Path(f"/proc/{process}/status").read_text(encoding="utf-8").splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) / 1024
    raise RuntimeError(f"process {process} has no resident memory")


def thread_count(process: int) -> int:
    """Threads of a process (Linux)."""
    return len(list(Path(f"/proc/{process}/task").iterdir()))
