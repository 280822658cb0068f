"""What a map is asked for: photographs, what gives its scale, and what is known of their gravity and their lens."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from spherloc.frontend.masks import Masks
from spherloc.frontend.pipeline import FrontendOptions
from spherloc.frontend.view import View
from spherloc.mapping.alignment.fixed_images import FixedImages
from spherloc.mapping.alignment.positions import Positions
from spherloc.mapping.alignment.stated_gravity import StatedGravity
from spherloc.mapping.images.folder_cameras import CalibratedLens
from spherloc.mapping.scenes.new_images import NewImages


@dataclass(frozen=True)
class ScaleMeasurement:
    """A measurement that fixes the map's scale: one of the first three or none; GPS in the photographs is used then,
    and what is ``fixed`` where that is not known or does not fit."""

    camera_height_m: float | None = None
    """Height of the cameras above the ground, m."""
    distance: tuple[str, str, float] | None = None
    """Names of two images, and their distance, m."""
    positions: Positions | None = None
    """Positions of the images from another source."""
    fixed: FixedImages | None = None
    """How the cameras of images that were taken together are fixed to each other."""

    @property
    def given(self) -> bool:
        """Whether it is more than how the cameras are fixed."""
        return not (self.camera_height_m is None and self.distance is None and self.positions is None)


@dataclass(frozen=True, eq=False)
class MapRequest:
    """What a map is made of, and how."""

    views: Sequence[View]
    """Images of one camera or several."""
    images: Path
    """Their folder."""
    measured: ScaleMeasurement = field(default_factory=ScaleMeasurement)
    """What gives the scale."""
    new_images: NewImages | None = None
    """Other images, for which a scene is written too."""
    masks: Masks | None = None
    """The masks of the views, which are written into the scenes."""
    how: FrontendOptions = field(default_factory=FrontendOptions)
    """Which features are matched, and how."""
    find_carried: bool = True
    """Whether what moves with the camera below panoramas is found and left out, too."""
    stated: StatedGravity | None = None
    """Gravity that a file states."""
    lens: CalibratedLens | None = None
    """The lens that the photographs told, which the map may correct."""

    def with_lens(self, before: CalibratedLens, lens: CalibratedLens) -> "MapRequest":
        """The request with another lens instead of the one ``before``, for the views and the new images."""

        def changed(views: Sequence[View]) -> tuple[View, ...]:
            return tuple(replace(view, camera=lens.camera) if view.camera == before.camera else view for view in views)

        new = self.new_images
        if new is not None and new.views is not None:
            new = replace(new, views=changed(new.views))
        return replace(self, views=changed(self.views), new_images=new, lens=lens)
