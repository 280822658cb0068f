"""Makes the slow parts of a page after its run is shown: the mesh of the map, and the pictures of a rendered scene."""

import threading
from collections.abc import Callable

from spherloc.files import is_file
from spherloc_viz.app.catalog import Catalog, Run
from spherloc_viz.app.workers import Job, LatestWorker


class MapPictures:
    """One page's. The query comes before its references, which are seen on one tab only."""

    def __init__(
        self,
        number: int,
        catalog: Catalog,
        say: Callable[[str], None],
        redraw: Callable[[], None],
        guarded: Callable[[Job], Job],
    ) -> None:
        """``redraw`` is called whenever there is more to be seen, and ``guarded`` turns errors into words."""
        self._catalog, self._say, self._redraw = catalog, say, redraw
        self._lock = threading.Lock()
        self._run: Run | None = None
        self._whole: Run | None = None
        self._worker = LatestWorker(f"spherloc-pictures-{number}", guarded(self._work))

    def start(self) -> None:
        """Start the thread."""
        self._worker.start()

    def close(self) -> None:
        """End it after the picture at hand; does not wait."""
        self._run = None
        self._worker.close()

    def want(self, run: Run) -> None:
        """Make what this run shows."""
        drawn = self._catalog.map_scene(run.request.scene.scene) is None
        with self._lock:
            self._run = run
            self._whole = run if drawn else self._whole
        if not drawn:
            self._worker.ask()

    def whole(self, run: Run) -> bool:
        """Whether all is there that a run shows."""
        return self._whole is run

    def _work(self, asked: bool) -> None:
        run = self._run
        if run is None or self._whole is run:
            return
        try:
            self._make(run)
        finally:
            with self._lock:  # another run may be wanted by now, and be whole
                self._whole = run if self._run is run else self._whole
            self._redraw()

    def _make(self, run: Run) -> None:
        label, problem = run.request.scene.scene, run.trace.problem
        scene = self._catalog.map_scene(label)
        if scene is None:
            return
        if self._catalog.known_mesh(label) is None and self._catalog.mesh(label) is not None:
            self._redraw()
        missing = [view for view in scene.pictures(problem) if not is_file(view.path)]
        for number, view in enumerate(missing, 1):
            if self._run is not run:
                return
            self._say(f"Drawing the pictures of this scene: {number} of {len(missing)} …")
            view.make_file()
            self._redraw()
