"""Records the runs of one page that stay unchanged for a while, with their origin."""

from dataclasses import dataclass, replace
from pathlib import Path

from spherloc.diagnosis import Diagnosis
from spherloc.errors import RecordingError
from spherloc.trace import Trace
from spherloc.types import FloatArray
from spherloc_viz.app.catalog import Catalog, Run, RunRequest, SceneRequest
from spherloc_viz.app.review.opened import is_same_pose
from spherloc_viz.recording.origin import Origin, Source
from spherloc_viz.recording.replay import origin_of
from spherloc_viz.recording.storage.recorder import Recorder

RETRY_S = 1.0
"""Seconds until a recording that failed is tried again."""
LOOK_S = 0.1
"""Seconds between two looks whether a run is written."""
NOT_RECORDED = "Runs are not recorded."


@dataclass(frozen=True, eq=False)
class Known:
    """A run that is recorded already and opened again."""

    request: RunRequest
    path: Path
    cam_from_map: FloatArray | None
    """Its pose (3, 4), if it had one."""


@dataclass(eq=False)
class Submitted:
    """A run that was given to the recorder, or was recorded before."""

    trace: Trace
    promised: Path
    """Path at which it will be recorded; not used if the same run is recorded already (``before``)."""
    before: Path | None = None
    """The recording of the very same run, if there is one: a reload, or undo, makes no second one."""
    written: bool = False
    error: RecordingError | None = None
    """Why it could not be written."""

    @property
    def path(self) -> Path:
        """Path of its recording; the file exists once it is written."""
        return self.before or self.promised

    def known(self, path: Path) -> None:
        """The very same run is recorded."""
        self.before = path

    def end(self, error: RecordingError | None) -> None:
        """It is written, or not."""
        self.written, self.error = error is None, error


class PageRuns:
    """Used by the session's solver thread; panels record their runs on threads of their own."""

    def __init__(self, recorder: Recorder | None, catalog: Catalog) -> None:
        self._recorder, self._catalog = recorder, catalog
        self._known: Known | None = None
        self._submitted: Submitted | None = None
        self._queries: dict[tuple[str, str | None], Path] = {}
        """The last recordings of the queries of sequences, by the scene's label and the query's name."""

    def expect(self, known: Known) -> None:
        """The page is about to repeat a recorded run, which is not to be recorded once more."""
        self._known = known

    def became(self, asked: RunRequest, request: RunRequest) -> None:
        """The page has brought the expected request into its own form, such as no value where it equals the scene's."""
        if self._known is not None and self._known.request is asked:
            self._known = replace(self._known, request=request)

    def announce(self, run: Run) -> str:
        """Whether a run will be recorded, in a sentence."""
        if self._repeats(run):
            return "This run is recorded already."
        return NOT_RECORDED if self._recorder is None else "Will be recorded when nothing changes any more."

    def finish(self, run: Run, diagnosis: Diagnosis | None) -> tuple[str, float | None]:
        """Record a run that the page has settled on, unless it is recorded.

        Returns what became of it, in a sentence, and the seconds after which to ask again if that is not known yet.
        """
        known = self._known
        if known is not None and self._repeats(run):
            self._submitted = Submitted(run.trace, known.path, written=True)
            return f"Opened {known.path.name}", None
        if self._recorder is None:
            return NOT_RECORDED, None
        submitted = self._submitted
        if submitted is None or submitted.trace is not run.trace:
            submitted = Submitted(run.trace, Path())
            origin = self._origin("page", run.request.scene)
            try:
                submitted.promised = self._recorder.submit(run.trace, origin, diagnosis, submitted.end, submitted.known)
            except RecordingError as error:
                return f"{error} It is tried again.", RETRY_S
            self._submitted = submitted
        if submitted.error is not None:
            return str(submitted.error), None
        if submitted.written:
            return f"Recorded as {submitted.path.name}", None
        waiting = self._recorder.overload
        return f"Recording as {submitted.path.name} …{f' {waiting}' if waiting else ''}", LOOK_S

    def untold(self, sentence: str) -> str:
        """A sentence of ``finish`` without the name of the file: it begins with the problem's, which may tell how many
        matches are wrong."""
        name = "" if self._submitted is None else self._submitted.path.name
        return sentence.replace(f" as {name}", "").replace(name, "a recording") if name else sentence

    def keepable(self, trace: Trace) -> str:
        """The file of a run's recording, if pages made it; else empty."""
        known, path = self._known, self.path(trace)
        return "" if path is None or (known is not None and path == known.path) else path.name

    def record(self, trace: Trace, scene: SceneRequest, anew: bool) -> None:
        """Record a query of a sequence that a panel localized, if runs are recorded; raises ``RecordingError``.

        One that is tried ``anew`` takes the place of that query's last recording, which is deleted once it is written.
        """
        if self._recorder is not None:
            query = scene.scene, scene.query
            before = self._queries.pop(query, None) if anew else None
            self._queries[query] = self._recorder.submit(trace, self._origin("sequence", scene), instead_of=before)

    def path(self, trace: Trace) -> Path | None:
        """The recording of a run, if there is one."""
        submitted = self._submitted
        return submitted.path if submitted is not None and submitted.trace is trace and submitted.written else None

    def _repeats(self, run: Run) -> bool:
        """Whether a run is the one that was opened, and finds the same pose."""
        known = self._known
        same = known is not None and run.request == known.request
        return same and known is not None and is_same_pose(known.cam_from_map, run.trace.cam_from_map)

    def _origin(self, source: Source, scene: SceneRequest) -> Origin:
        catalog, label = self._catalog, scene.scene
        return origin_of(source, catalog.path(label), catalog.scenes[label], scene.seed, scene.query, scene.variation)
