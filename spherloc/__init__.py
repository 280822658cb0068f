"""Estimator core for visual localization with fisheye and 360-degree cameras."""

import hashlib
import os
import shutil
import sys
from importlib.metadata import version
from pathlib import Path

__version__ = version("spherloc")

KERNEL_SOURCES = ("watch.py", "geometry.py", "gauss_newton.py", "refine.py", "solvers", "consensus", "estimators")
"""Files and folders of this package that hold compiled kernels and whatever their values come from."""

KEPT_KERNELS = 4
"""States of the sources whose compiled kernels are kept."""


def _keep_kernels_fresh() -> None:
    """Give numba a cache for just this state of the sources; must run before any kernel is defined.

    numba notices when a kernel's own file changes but not when a function that it calls from another file does, and
    would go on with the old machine code after an update.
    """
    package = Path(__file__).parent
    rooms = [package / name for name in KERNEL_SOURCES]
    files = sorted(file for room in rooms for file in (room.rglob("*.py") if room.is_dir() else [room]))
    sources = b"".join(file.read_bytes() for file in files)
    home = package if os.access(package, os.W_OK) else Path.home() / ".cache" / "spherloc"
    folder = home / "__pycache__" / f"kernels-{hashlib.sha256(sources).hexdigest()[:16]}"
    others = sorted(set(folder.parent.glob("kernels-*")) - {folder}, key=lambda path: path.stat().st_mtime)
    for old in others[:-KEPT_KERNELS]:  # of earlier states of the sources; a few stay for whoever goes back and forth
        shutil.rmtree(old, ignore_errors=True)
    os.environ.setdefault("NUMBA_CACHE_DIR", str(folder))
    if "numba" in sys.modules:  # imported before us, it has read its settings already
        sys.modules["numba"].config.CACHE_DIR = os.environ["NUMBA_CACHE_DIR"]


_keep_kernels_fresh()
