"""Compiles numeric kernels with numba and keeps the machine code on disk, separately for each state of the sources.

numba notices when a kernel's own file changes but not when a function that it calls from another file does, and would
use old machine code after an update. Also, two processes that compile for different types at the same time may give
their files the same name, so that a later process runs machine code for the wrong types.
"""

import atexit
import hashlib
import os
import shutil
import tempfile
import uuid
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba.core import config

from spherloc.disk_cache import user_cache

KERNEL_SOURCES = (
    "watch.py",
    "geometry.py",
    "small_arrays.py",
    "gauss_newton.py",
    "narrowing.py",
    "noise_scale.py",
    "refine.py",
    "solvers",
    "consensus",
    "estimators",
    "mapping/two_view/guided.py",
    "mapping/two_view/level_pairs.py",
)
"""Files and folders of this package that hold kernels or code on which their results depend."""

KEPT_STATES = 4
"""Number of states of the sources whose machine code is kept, for switching between versions."""

VARIABLE = "NUMBA_CACHE_DIR"
"""numba's environment variable that sets the folder of its cache."""


def kernel(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorator: compile a function when it is first called, without the interpreter's lock, and keep the machine code.

    ``options`` are those of ``numba.njit``. The function's own file must be named in ``KERNEL_SOURCES`` if another
    file's kernels call it.

    Most kernels are only called by others. For those calls a kernel is compiled without the code that takes its
    arguments from Python, which saves a fifth of the time; numba itself would make that code for every kernel.
    """

    common: dict[str, Any] = {"nogil": True, **options}
    no_wrappers: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}

    def decorate(function: Callable[..., Any]) -> Any:
        called = _cached(numba.njit(**common)(function), kernel_folder())
        bare = _cached(numba.njit(**common, **no_wrappers)(function), kernel_folder() / "bare")
        called.get_call_template, called.get_overload = bare.get_call_template, bare.get_overload
        return called

    return decorate


def _cached(dispatcher: Any, folder: Path) -> Any:
    """The numba function, set up to keep its machine code in a folder."""
    settings: Any = config
    before, settings.CACHE_DIR = settings.CACHE_DIR, str(folder)  # read when the cache is made
    try:
        dispatcher.enable_caching()
    finally:
        settings.CACHE_DIR = before
    files = dispatcher._cache._cache_file
    files._data_name_pattern = files._data_name_pattern.replace("{number:d}", f"{uuid.uuid4().hex[:12]}-{{number:d}}")
    return dispatcher


@cache
def kernel_folder() -> Path:
    """Folder of the machine code: under $NUMBA_CACHE_DIR, beside the package, in the user's cache, or temporary."""
    package = Path(__file__).parent
    rooms = [package / name for name in KERNEL_SOURCES]
    files = sorted(file for room in rooms for file in (room.rglob("*.py") if room.is_dir() else [room]))
    digest = hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
    return _first_writable(package, f"kernels-{digest[:16]}")


@cache
def _temporary() -> Path:
    """A folder for this process and its children alone: others must not write into it, since its machine code is
    run."""
    folder = Path(tempfile.mkdtemp(prefix="spherloc-kernels-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    os.environ[VARIABLE] = str(folder)
    return folder


def is_temporary() -> bool:
    """Whether the machine code is lost when this process ends, since no permanent folder for it is writable."""
    kernel_folder()
    return _temporary.cache_info().currsize > 0


def _first_writable(package: Path, name: str) -> Path:
    given, user = os.environ.get(VARIABLE), user_cache()
    if given and _is_writable(Path(given) / name):
        return Path(given) / name
    for home in (package, user):
        if home is not None and _is_writable(folder := home / "__pycache__" / name):
            others = sorted(set(folder.parent.glob("kernels-*")) - {folder}, key=_changed_s)
            for old in others[:-KEPT_STATES]:
                shutil.rmtree(old, ignore_errors=True)
            return folder
    return _temporary() / name


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
