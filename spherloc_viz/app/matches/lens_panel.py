"""The view through the query's lens from the estimated pose: the photograph, the map as it would look, or both."""

from collections.abc import Callable

import numpy as np
import viser
from numpy.typing import NDArray

from spherloc.datasets.map_scene import MapScene
from spherloc.trace import Trace
from spherloc_viz.app.catalog import Run
from spherloc_viz.app.matches.image_panel import jpeg_uri, photo_uri
from spherloc_viz.app.text import DIM, box, status_html
from spherloc_viz.app.web.touch import Touch, Touches
from spherloc_viz.app.workers import BackgroundWorker
from spherloc_viz.layers.lens_view import WIDTH_PX, through_lens
from spherloc_viz.layers.query_image import modified

BLENDS = {"photograph": 0.0, "half and half": 0.5, "map": 1.0}
"""Title of the picture, and the share of it that shows the map."""
ABOUT = "The matched references' pixels at their points in the map, seen from the estimated pose."
NOTHING = "The matched references have no point in the map that this pose would see."
GREY = 40
"""Colour of pixels where the map has nothing."""


class LensPanel:
    """The panel of one page. Pictures are made on a separate thread, for the current run only."""

    def __init__(
        self,
        gui: viser.GuiApi,
        touches: Touches,
        scene_of: Callable[[str], MapScene | None],
        changed: Callable[[object], None],
    ) -> None:
        """``scene_of`` returns the map scene of a label, or None; ``changed`` has the page drawn again."""
        self._scene_of, self._changed = scene_of, changed
        self._html = gui.add_html("")
        self._blend = "half and half"
        self._made: tuple[Trace, list[int], str, float] | None = None
        """The run of the picture, the times at which its reference files were written, its address, and the share of it
        that shows the map."""
        self._worker = BackgroundWorker("spherloc-lens", self._say)
        touches.on("lens", self._choose)

    def draw(self, run: Run, hidden: bool) -> None:
        """Show the run's query; ``hidden`` says that its pose must not be shown."""
        trace, scene = run.trace, self._scene_of(run.request.scene.scene)
        if hidden or scene is None or trace.cam_from_map is None or trace.problem.image is None:
            self._say("")
            return
        made, written = self._made, [modified(path) for path in trace.problem.reference_images]
        if made is None or made[0] is not trace or made[1] != written:
            self._say(status_html("Drawing the map through the query's lens …"))
            self._worker.ask(lambda: self._make(trace, scene, written))
            return
        self._say(lens_html(photo_uri(trace.problem.image, WIDTH_PX), made[2], made[3], self._blend, _aspect(trace)))

    def _make(self, trace: Trace, scene: MapScene, written: list[int]) -> None:
        pose, wanted = trace.cam_from_map, set(trace.problem.reference_images)
        if pose is None:
            return
        references = [view for view in scene.pictures(trace.problem) if view.path in wanted]
        found = through_lens(trace.problem.camera, pose, references)
        picture, covered = ("", 0.0) if found is None else (jpeg_uri(_on_grey(found[0])), found[1])
        self._made = trace, written, picture, covered
        self._changed(None)

    def _choose(self, touch: Touch) -> None:
        if touch.argument in BLENDS:
            self._blend = touch.argument
            self._changed(touch)

    def _say(self, html: str) -> None:
        if self._html.content != html:
            self._html.content = html


def _aspect(trace: Trace) -> str:
    return f"{trace.problem.camera.width}/{trace.problem.camera.height}"


def _on_grey(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A picture (H, W, 4) on a grey background (H, W, 3)."""
    return np.where(picture[..., 3:] > 0, picture[..., :3], np.uint8(GREY))


def lens_html(photo: str | None, picture: str, covered: float, blend: str, aspect: str) -> str:
    """The photograph, the map above it with the opacity of ``blend``, and the buttons that change it."""
    if not picture:
        return status_html(NOTHING)
    chips = " · ".join(
        f"<b>{name}</b>"
        if name == blend
        else f'<u role="button" tabindex="0" data-touch="lens:{name}" style="cursor:pointer">{name}</u>'
        for name in BLENDS
    )
    opacity = BLENDS[blend] if photo else 1.0
    frame = "position:absolute;inset:0;width:100%;height:100%"
    below = f'<img alt="" src="{photo}" style="{frame}">' if photo else ""
    above = f'<img alt="" src="{picture}" style="{frame};opacity:{opacity:g}">'
    return box(
        f'<div style="padding:.5em 0 .25em"><b>Through the query\'s lens</b>: {chips}</div>'
        f'<div role="img" aria-label="The query and the map from the estimated pose: {blend}" '
        f'style="position:relative;width:100%;aspect-ratio:{aspect}">{below}{above}</div>'
        f'<div style="{DIM}">{ABOUT} It covers {100.0 * covered:.0f} % of the image.</div>',
        "font-size:12px",
    )
