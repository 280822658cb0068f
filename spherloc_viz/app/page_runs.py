"""What becomes of one page's runs: those that it settles on are recorded, with where they came from."""

from dataclasses import dataclass, replace
from pathlib import Path

from spherloc.cameras.base import FloatArray
from spherloc.diagnosis import Diagnosis
from spherloc.errors import RecordingError
from spherloc.trace import Trace
from spherloc_viz.app.catalog import Catalog, SceneWish
from spherloc_viz.app.review.opened import is_same_pose
from spherloc_viz.app.wish import Run, Wish
from spherloc_viz.recording.again.scene import origin_of
from spherloc_viz.recording.keeping.recorder import Recorder
from spherloc_viz.recording.origin import Origin, Source

RETRY_S = 1.0
"""After this long a run is recorded that could not be before."""
NOT_RECORDED = "Runs are not recorded."


@dataclass(frozen=True, eq=False)
class Known:
    """A run that is recorded already and opened again."""

    wish: Wish
    path: Path
    cam_from_map: FloatArray | None
    """Its pose (3, 4), if it had one."""


class PageRuns:
    """Used by the session's solver thread; panels record their runs on threads of their own."""

    def __init__(self, recorder: Recorder | None, catalog: Catalog) -> None:
        self._recorder, self._catalog = recorder, catalog
        self._known: Known | None = None
        self._recorded: tuple[Trace, Path] | None = None

    def expect(self, known: Known) -> None:
        """The page is about to repeat a recorded run, which is not to be recorded once more."""
        self._known = known

    def became(self, asked: Wish, wish: Wish) -> None:
        """The page says in its own words what it was asked for, such as nothing for what the scene says already."""
        if self._known is not None and self._known.wish is asked:
            self._known = replace(self._known, wish=wish)

    def announce(self, run: Run) -> str:
        """What will become of a run, in a sentence."""
        if self._repeats(run):
            return "This run is recorded already."
        return NOT_RECORDED if self._recorder is None else "Will be recorded when nothing changes any more."

    def settle(self, run: Run, diagnosis: Diagnosis | None) -> tuple[str, float | None]:
        """Record a run that the page has settled on, unless it is recorded.

        Returns what became of it, in a sentence, and the seconds to the next attempt if that must wait.
        """
        known = self._known
        if known is not None and self._repeats(run):
            self._recorded = run.trace, known.path
            return f"Opened {known.path.name}", None
        if self._recorder is None:
            return NOT_RECORDED, None
        if self._recorded is None or self._recorded[0] is not run.trace:
            try:
                path = self._recorder.submit(run.trace, self._origin("page", run.wish.scene), diagnosis)
            except RecordingError as error:
                return f"{error} It is tried again.", RETRY_S
            self._recorded = run.trace, path
        waiting = self._recorder.overload
        return f"Recorded as {self._recorded[1].name}{f'. {waiting}' if waiting else ''}", None

    def record(self, trace: Trace, scene: SceneWish) -> None:
        """Record a query of a sequence that a panel localized, if runs are recorded; raises ``RecordingError``."""
        if self._recorder is not None:
            self._recorder.submit(trace, self._origin("sequence", scene))

    def path(self, trace: Trace) -> Path | None:
        """The recording of a run, if there is one."""
        recorded = self._recorded
        return recorded[1] if recorded is not None and recorded[0] is trace else None

    def _repeats(self, run: Run) -> bool:
        """Whether a run is the one that was opened, and finds the same pose."""
        known = self._known
        same = known is not None and run.wish == known.wish
        return same and known is not None and is_same_pose(known.cam_from_map, run.trace.cam_from_map)

    def _origin(self, source: Source, scene: SceneWish) -> Origin:
        catalog, label = self._catalog, scene.scene
        return origin_of(source, catalog.path(label), catalog.scenes[label], scene.seed, scene.query, scene.variation)
