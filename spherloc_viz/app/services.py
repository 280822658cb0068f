"""What all pages of one server share, among it what the presenter's page shows to an audience."""

import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from spherloc.diagnosis import Diagnosis
from spherloc.trace import Trace
from spherloc_viz.app.catalog import Catalog, Run, RunRequest
from spherloc_viz.app.compilation import Compilation
from spherloc_viz.app.page_runs import Known
from spherloc_viz.app.review.run_library import RunLibrary
from spherloc_viz.app.web.downloads import Downloads
from spherloc_viz.app.web.drops import DropRoom
from spherloc_viz.recording.storage.recorder import Recorder


@dataclass(frozen=True, eq=False)
class PresentedRun:
    """A run that the presenter has settled on."""

    run: Run
    mesh: bytes | None
    """Binary glTF of the map, in the map frame; None if it has none."""
    diagnosis: Diagnosis | None
    """None for as long as there is none."""
    withheld: frozenset[str] = frozenset()
    """The answers that the presenter hides, see ``RunDisplay``."""


class Presented:
    """The newest of all presenters' runs. Pages of an audience draw it as it is: nothing is computed again."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._newest: PresentedRun | None = None
        self._followers: tuple[Callable[[], None], ...] = ()

    @property
    def newest(self) -> PresentedRun | None:
        """What is shown now; None before the first run."""
        return self._newest

    def show(
        self, run: Run, mesh: bytes | None, diagnosis: Diagnosis | None, withheld: frozenset[str] = frozenset()
    ) -> None:
        """Show a run, unless it is shown already."""
        with self._lock:
            if self._newest is not None and self._newest.run is run:
                return
            self._newest = PresentedRun(run, mesh, diagnosis, withheld)
        self._tell()

    def hide(self, run: Run, withheld: frozenset[str]) -> None:
        """Hide or show the answers of a run, if it is the one shown."""
        with self._lock:
            if self._newest is None or self._newest.run is not run or self._newest.withheld == withheld:
                return
            self._newest = replace(self._newest, withheld=withheld)
        self._tell()

    def diagnose(self, trace: Trace, diagnosis: Diagnosis) -> None:
        """Add the diagnosis of a run, if that is the one shown."""
        with self._lock:
            if self._newest is None or self._newest.run.trace is not trace:
                return
            self._newest = replace(self._newest, diagnosis=diagnosis)
        self._tell()

    def follow(self, follower: Callable[[], None]) -> None:
        """Have ``follower``, which must not take long, called whenever there is something new."""
        with self._lock:
            self._followers = (*self._followers, follower)

    def leave(self, follower: Callable[[], None]) -> None:
        """End it."""
        with self._lock:
            self._followers = tuple(other for other in self._followers if other != follower)

    def _tell(self) -> None:
        for follower in self._followers:
            follower()


@dataclass
class Services:
    """Made before the first page connects."""

    catalog: Catalog
    roots: tuple[Path, ...] = ()
    """Folders that pages may open scenes from."""
    recorder: Recorder | None = None
    """Recorder of the runs; None if runs are not recorded."""
    library: RunLibrary | None = None
    """The recordings that pages review; None if there is no folder of them."""
    downloads: Downloads = field(default_factory=Downloads)
    """Files that pages may fetch."""
    drops: DropRoom = field(default_factory=DropRoom)
    """The pages onto which photographs can be dropped."""
    presented: Presented = field(default_factory=Presented)
    """What pages of an audience show."""
    first: Known | None = None
    """The recorded run that pages open with; None for the catalog's first scene."""
    begin: RunRequest | None = None
    """What pages ask for first without a recorded run; None for what the catalog's first scene begins with."""
    compilation: Compilation | None = None
    """Compiles the solvers that are not yet; None if all are ready."""
