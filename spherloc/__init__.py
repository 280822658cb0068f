"""Estimator core for visual localization with fisheye and 360-degree cameras."""

import hashlib
import os
import sys
from importlib.metadata import version
from pathlib import Path

__version__ = version("spherloc")


def _keep_kernels_fresh() -> None:
    """Give numba a cache for just this state of the sources; must run before any kernel is defined.

    numba notices when a kernel's own file changes but not when a function that it calls from another file does, and
    would go on with the old machine code after an update.
    """
    package = Path(__file__).parent
    sources = b"".join(path.read_bytes() for path in sorted(package.rglob("*.py")))
    home = package if os.access(package, os.W_OK) else Path.home() / ".cache" / "spherloc"
    folder = home / "__pycache__" / f"kernels-{hashlib.sha256(sources).hexdigest()[:16]}"
    os.environ.setdefault("NUMBA_CACHE_DIR", str(folder))
    if "numba" in sys.modules:  # imported before us, it has read its settings already
        sys.modules["numba"].config.CACHE_DIR = os.environ["NUMBA_CACHE_DIR"]


_keep_kernels_fresh()
