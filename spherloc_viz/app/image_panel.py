"""The images of the problem beside the canvas."""

import viser

from spherloc.trace import Trace
from spherloc_viz.app.text import status_html
from spherloc_viz.layers.match_image import match_image
from spherloc_viz.layers.primitives import Picture, Points

JPEG_QUALITY = 85


class ImagePanel:
    """Query and reference with the matches in the colours of the step at hand; hidden for problems without images."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._gui = gui
        self._folder = gui.add_folder("Images", visible=False)
        with self._folder:
            self._caption = gui.add_html("")
        self._image: viser.GuiImageHandle | None = None

    def draw(self, trace: Trace, picture: Picture) -> None:
        """Show the images of a run at a step."""
        points = next(item for item in picture.scene if isinstance(item, Points) and item.name == "map/points")
        shown = match_image(trace.problem, points.colors, trace.inlier_mask)
        self._folder.visible = shown is not None
        if shown is None:
            return
        self._caption.content = status_html(shown.caption)
        if self._image is None:
            with self._folder:
                self._image = self._gui.add_image(shown.image, format="jpeg", jpeg_quality=JPEG_QUALITY)
        else:
            self._image.image = shown.image
