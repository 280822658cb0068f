"""Shows how far a run is that takes its time, lets a person end it, and ends it when its result is no longer wanted."""

import threading

import viser

from spherloc.watch import Watch
from spherloc_viz.app.workers import LatestWorker

AFTER_S = 0.4
"""A run that takes longer shows its progress, and gives way to a newer request. Shorter ones are let finish: else
dragging a slider would show nothing until it stands still."""
EVERY_S = 0.1


class SlowRun:
    """One session's progress bar and cancel button."""

    def __init__(self, gui: viser.GuiApi, name: str) -> None:
        self._bar = gui.add_progress_bar(0.0, visible=False)
        self._button = gui.add_button("Cancel", visible=False, color="red")
        self._button.on_click(lambda event: self.cancel())
        self._lock = threading.Lock()
        self._watch: Watch | None = None
        self._outdated = False
        self._stopped = self._lasting = False
        self._clock = LatestWorker(name, self._tick)

    def start(self) -> None:
        """Start the clock."""
        self._clock.start()

    def close(self) -> None:
        """End the run at hand and the clock; does not wait."""
        self._clock.close()
        with self._lock:
            if self._watch is not None:
                self._watch.cancel()

    def renew(self) -> None:
        """What is asked for is about to be read: only what is asked for later outdates the run that begins next."""
        self._outdated = False

    def begin(self, lasting: bool = False) -> Watch:
        """A run begins; what it must look at. One that is ``lasting`` does not give way to what is asked for later."""
        with self._lock:
            self._watch, self._stopped, self._lasting = Watch(), False, lasting
            watch = self._watch
        self._clock.ask()
        return watch

    def end(self) -> None:
        """The run has ended."""
        with self._lock:
            self._watch = None
        if self._bar.visible:
            self._clock.ask()

    def outdate(self) -> None:
        """Something newer is asked for."""
        self._outdated = True

    @property
    def stopped(self) -> bool:
        """Whether a person ended the last run."""
        return self._stopped

    def cancel(self) -> None:
        """A person wants no more of the run at hand."""
        with self._lock:
            if self._watch is not None:
                self._stopped = True
                self._watch.cancel()

    def _tick(self, asked: bool) -> float | None:
        with self._lock:
            watch = self._watch
        slow = watch is not None and not asked
        if watch is not None and slow:
            if self._outdated and not self._lasting:
                watch.cancel()
            self._bar.value = 100.0 * watch.fraction
        if self._bar.visible != slow and (slow or watch is None):
            self._bar.visible = self._button.visible = slow
        if watch is None:
            return None
        return AFTER_S if asked else EVERY_S
