"""What a measurement was made on, and one core for it."""

import hashlib
import os
import platform
import sys
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]

PACKAGES = (
    "spherloc",
    "numpy",
    "scipy",
    "numba",
    "poselib",
    "pycolmap",
    "opencv-python-headless",
    "pysuperansac",
    "networkit",
    "networkx",
)

MEASURING = (
    "brute_force.py",
    "cases.py",
    "certificate.py",
    "clique.py",
    "measure.py",
    "memory.py",
    "methods.py",
    "peers.py",
    "proven.py",
)
"""The files here that decide what a row says; the others only show it."""

BESIDE = ("diagnosis", "experiments", "formats", "frontend", "mapping", "verification")
"""The folders of the core that no measured call reaches: a change there leaves the rows valid."""

ONE_THREAD = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")}


def restart_on_one_core(module: str) -> None:
    """Start ``python -m module`` again with one thread for every library, pinned to one core where that is possible.

    Libraries read these settings when they are imported, which is too early for anything but a new process.
    """
    if os.environ.get("SPHERLOC_BENCH_CORE"):
        return
    core = "none"
    if hasattr(os, "sched_setaffinity"):
        core = str(max(os.sched_getaffinity(0)))
        os.sched_setaffinity(0, {int(core)})
    environment = {**os.environ, **ONE_THREAD, "SPHERLOC_BENCH_CORE": core}
    os.execve(sys.executable, [sys.executable, "-m", module, *sys.argv[1:]], environment)


def describe() -> dict[str, Any]:
    """Processor, cores, versions, date and load: what a reader needs to judge the numbers."""
    return {
        "cpu": _cpu_model(),
        "cores": os.cpu_count(),
        "pinned_to_core": os.environ.get("SPHERLOC_BENCH_CORE", "none"),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in PACKAGES},
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "load_1min": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else 0.0,
    }


def fingerprint() -> str:
    """Changes with the machine, the versions, and what is measured: rows of another state are measured again."""
    core = ROOT / "spherloc"
    measured = (path for path in sorted(core.rglob("*.py")) if path.relative_to(core).parts[0] not in BESIDE)
    sources = [*measured, *(ROOT / "benchmarks" / name for name in MEASURING)]
    state = b"".join(path.read_bytes() for path in sources)
    state += repr([_cpu_model(), platform.python_version(), *(_version(name) for name in PACKAGES)]).encode()
    return hashlib.sha256(state).hexdigest()[:16]


def _cpu_model() -> str:
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"
