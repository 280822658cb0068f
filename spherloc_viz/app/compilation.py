"""Compiles the solvers that the first run does not need while the page is open."""

import threading
import time
from collections.abc import Callable, Sequence

from spherloc import registry
from spherloc.warm_up import compile_apart, warm_up
from spherloc.watch import Watch
from spherloc_viz.app.controls.estimator_controls import START

EARLY = ("mc-exact", "ransac-2p", "auto")
"""Compiled before the others, since users try them first."""
PAUSE_S = 0.05
CLOSING_S = 1.0
"""How long an end waits for a kernel that is being loaded."""
FIRST_PAGE_S = 2.0
"""How long nothing is loaded or compiled, so that a page that is opened at once is ready sooner."""


class Compilation:
    """Compiles estimators one after another in processes of low priority, so that the page stays quick. Thread-safe."""

    def __init__(self, estimators: Sequence[str]) -> None:
        self._waiting = list(estimators)
        self._lock = threading.Lock()
        self._stopped = threading.Event()
        self._wanted = threading.Event()
        self._thread = threading.Thread(target=self._compile_all, name="compilation", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def close(self) -> None:
        """End it with its processes."""
        self._stopped.set()
        self._wanted.set()
        if self._thread.ident is not None:
            self._thread.join(CLOSING_S)

    def wait_for(self, estimator: str, watch: Watch, say: Callable[[str], None]) -> None:
        """Return when an estimator can run without being compiled here; it is the next one from now on.

        Raises ``Cancelled`` if ``watch`` ends the waiting. ``say`` is told why it takes long.
        """
        with self._lock:
            if estimator not in self._waiting:
                return
            self._waiting.remove(estimator)
            self._waiting.insert(0, estimator)
        self._wanted.set()
        say(f"Compiling {estimator}, once after an installation …")
        while estimator in self._waiting and self._thread.is_alive():
            watch.check()
            time.sleep(PAUSE_S)

    def _compile_all(self) -> None:
        self._wanted.wait(FIRST_PAGE_S)
        while self._waiting and not self._stopped.is_set():
            estimator = self._waiting[0]
            compile_apart(estimator, self._stopped.is_set)
            if not self._stopped.is_set():
                warm_up(estimators=[estimator])
            with self._lock:
                self._waiting.remove(estimator)


def first_and_later() -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Estimators that must be ready before a page opens, and those that can be compiled later.

    Extensions are among the first, so that their errors are reported at the start.
    """
    names = registry.names("estimators")
    first = tuple(name for name in names if name == START or registry.extension_of("estimators", name))
    return first, (*EARLY, *(name for name in names if name not in (*first, *EARLY)))
