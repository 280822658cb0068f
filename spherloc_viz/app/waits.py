"""What a page shows while its next run waits: for the map of its scene to be described, or an estimator compiled."""

from collections.abc import Callable

from spherloc.problem import Problem
from spherloc.watch import Watch
from spherloc_viz.app.catalog import Catalog, Run, SceneRequest
from spherloc_viz.app.compilation import Compilation
from spherloc_viz.app.controls.controls import Controls
from spherloc_viz.app.run_display import RunDisplay
from spherloc_viz.app.status import Status


class Waits:
    """One page's; called on its solver thread."""

    def __init__(
        self,
        catalog: Catalog,
        compilation: Compilation | None,
        page: tuple[Status, Controls, RunDisplay],
        run: Callable[[], Run | None],
        redraw: Callable[[], None],
    ) -> None:
        """``compilation`` is that of the estimators, if they are compiled in the background; ``run`` gives the one that
        the page shows, and ``redraw`` has the page drawn anew."""
        self._catalog, self._compilation = catalog, compilation
        self._status, self._controls, self._display = page
        self._run, self._redraw = run, redraw

    def for_problem(self, request: SceneRequest) -> Problem:
        """The problem of a request; while images are matched, the page shows the progress.

        Raises ``Cancelled`` if a person ends it while the map is described.
        """
        scene = self._catalog.map_scene(request.scene)
        if scene is None or scene.stored_problem(request.query) is not None:
            return self._catalog.problem(request)
        panels = self._display.panels
        watch = self._controls.slow.begin(lasting=True)
        try:
            watch.begin("map", 1.0)
            run = self._run()
            if run is None or request.scene != run.request.scene.scene:
                panels.begin_opening(request.scene)
                panels.tell_opening("Making the map …", 0.0)
                self._controls.begin_opening(request.scene)
                self._display.open_map(request.scene, scene, self._catalog.mesh(request.scene))
                self._redraw()

            def report(done: int, count: int) -> None:
                words = f"Describing the map: {done} of {count} images …"
                self._status.say(words)
                panels.tell_opening(words, done / (count + 1))
                watch.expect(count)
                watch.reach(done)

            scene.prepare(report)
            self._status.say("Reading and matching images …")
            panels.tell_opening("Reading and matching images …", 0.9)
            watch.check()
            problem = self._catalog.problem(request)
            watch.check()
            return problem
        finally:
            self._controls.slow.end()

    def for_estimator(self, name: str, watch: Watch) -> None:
        """Return when an estimator is compiled; a page without a run shows why it waits in its empty canvas.

        Raises ``Cancelled`` if ``watch`` ends that.
        """

        def say(sentence: str) -> None:
            self._status.say(sentence)
            if self._run() is None:
                panels = self._display.panels
                panels.begin_opening(self._controls.scene.read().scene)
                panels.tell_opening(sentence, None)

        if self._compilation is not None:
            self._compilation.wait_for(name, watch, say)
