"""Estimator core for visual localization with fisheye and 360-degree cameras."""

import atexit
import hashlib
import importlib
import os
import shutil
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path
from typing import Any

__version__ = version("spherloc")

EXPORTS = {
    "localize": "localization",
    "Localization": "localization",
    "estimate_absolute_pose": "localization",
    "estimate": "estimators",
    "options_type": "estimators",
    "diagnose": "diagnosis",
    "evaluate": "metrics",
    "load_scene": "datasets",
    "bundled_scenes": "datasets",
    "load_camera": "cameras.calibration",
    "Problem": "problem",
    "Trace": "trace",
    "InputError": "errors",
    "SpherlocError": "errors",
}
"""What is to be had from the package itself, and where it comes from: imported when it is first asked for, since the
solvers take a second. ``__init__.pyi`` tells type checkers."""

KERNEL_SOURCES = (
    "watch.py",
    "geometry.py",
    "gauss_newton.py",
    "narrowing.py",
    "refine.py",
    "solvers",
    "consensus",
    "estimators",
)
"""Files and folders of this package that hold compiled kernels and whatever their values come from."""

KEPT_KERNELS = 4
"""States of the sources whose compiled kernels are kept."""


kernels_are_temporary = False
"""Whether compiled kernels are lost when this process ends, since no folder to keep them can be written."""


def __getattr__(name: str) -> Any:
    if name not in EXPORTS:
        raise AttributeError(f"module 'spherloc' has no attribute {name!r}")
    found = getattr(importlib.import_module(f"spherloc.{EXPORTS[name]}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *EXPORTS})


def user_cache() -> Path | None:
    """The user's folder for what can be computed again; None for a user without a home."""
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "spherloc"
    except RuntimeError:
        return None


def _keep_kernels_fresh() -> None:
    """Give numba a cache for just this state of the sources; must run before any kernel is defined.

    numba notices when a kernel's own file changes but not when a function that it calls from another file does, and
    would go on with the old machine code after an update.
    """
    package = Path(__file__).parent
    rooms = [package / name for name in KERNEL_SOURCES]
    files = sorted(file for room in rooms for file in (room.rglob("*.py") if room.is_dir() else [room]))
    sources = b"".join(file.read_bytes() for file in files)
    name = f"kernels-{hashlib.sha256(sources).hexdigest()[:16]}"
    os.environ["NUMBA_CACHE_DIR"] = str(_first_writable(package, name))
    if "numba" in sys.modules:  # imported before us, it has read its settings already
        sys.modules["numba"].config.CACHE_DIR = os.environ["NUMBA_CACHE_DIR"]


def _first_writable(package: Path, name: str) -> Path:
    """What $NUMBA_CACHE_DIR names, else a folder beside the package or of the user, else one of this process alone."""
    global kernels_are_temporary
    given, user = os.environ.get("NUMBA_CACHE_DIR"), user_cache()
    if given and _is_writable(Path(given)):
        return Path(given)
    for home in (package, user):
        if home is not None and _is_writable(folder := home / "__pycache__" / name):
            others = sorted(set(folder.parent.glob("kernels-*")) - {folder}, key=_changed_s)
            for old in others[:-KEPT_KERNELS]:  # of earlier states; some stay for who goes back and forth
                shutil.rmtree(old, ignore_errors=True)
            return folder
    # Of this process alone: whoever can write into a folder of kernels decides what is run.
    kernels_are_temporary = True
    folder = Path(tempfile.mkdtemp(prefix="spherloc-kernels-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _is_writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except (OSError, ValueError):
        return False


def _changed_s(folder: Path) -> float:
    try:
        return folder.stat().st_mtime
    except OSError:  # another process has deleted it
        return 0.0


_keep_kernels_fresh()
