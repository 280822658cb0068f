"""The run that a link leads to, without a page: for the lessons' files and for what checks the lessons."""

from dataclasses import dataclass

from spherloc.errors import InputError
from spherloc.estimators import default_options, estimate
from spherloc_viz.app.catalog import Catalog, SceneRequest
from spherloc_viz.app.link import Follower, PageView
from spherloc_viz.app.panels.folders import Roots
from spherloc_viz.app.review.opened import Opened
from spherloc_viz.app.run_request import Run, RunRequest

ESTIMATOR = "mc"
"""Of a link that says none."""


def _no_recordings(file: str) -> Opened:
    raise InputError("a link to a recording needs the playground that has it.")


@dataclass(frozen=True)
class LinkedRun:
    """What a link leads to."""

    run: Run
    view: PageView


class LinkedRuns:
    """Runs of links to the scenes that come with the project."""

    def __init__(self) -> None:
        self.catalog = Catalog(None)
        self._follower = Follower(self.catalog, Roots(()), self.catalog.problem, _no_recordings)
        self._last: Run | None = None

    def run(self, link: str) -> LinkedRun:
        """The run of a link; raises ``InputError`` for what of it cannot be followed."""
        scene = SceneRequest(next(iter(self.catalog.scenes)), 0)
        begin = RunRequest(scene, ESTIMATOR, default_options(ESTIMATOR, self.catalog.problem(scene)))
        followed = self._follower.follow(link, begin, PageView("", (), "dark"))
        if followed.remarks:
            raise InputError(" ".join(followed.remarks))
        request = followed.request
        if self._last is None or self._last.request != request:
            problem = self.catalog.problem(request.scene)
            trace = estimate(problem, request.estimator, request.options, request.scene.seed)
            kept = request.scene.variation.kept(len(problem) + len(request.scene.variation.hidden))
            self._last = Run(request, trace, kept)
        return LinkedRun(self._last, followed.view)
