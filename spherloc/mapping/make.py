"""The whole way from photographs to a map on the disk."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from spherloc.errors import InputError, show
from spherloc.files import is_folder
from spherloc.frontend.view import View
from spherloc.mapping.reconstruction import Reconstruction, Tell, reconstruct
from spherloc.mapping.upright import (
    Level,
    Scale,
    arbitrary_scale,
    level_of,
    scale_by_distance,
    scale_by_height,
)
from spherloc.mapping.written import Written, write_map


@dataclass(frozen=True)
class Measured:
    """What fixes the map's scale: one of the two, or nothing."""

    camera_height_m: float | None = None
    """Of the cameras above the ground."""
    distance: tuple[str, str, float] | None = None
    """Names of two images, and how many metres they are apart."""


@dataclass(frozen=True, eq=False)
class Map:
    """A finished map, and how it came about."""

    made: Reconstruction
    level: Level
    scale: Scale
    written: Written


def make_map(
    views: Sequence[View], images: Path, folder: Path, measured: Measured, new_images: Path | None, tell: Tell
) -> Map:
    """Make a map of images of one camera and write it into ``folder``.

    ``new_images`` is a folder of other images of that camera, for which a scene is written too. Raises ``InputError``
    if they give no map, if what is measured does not fit them, or if a file cannot be read or written.
    """
    if new_images is not None and not is_folder(new_images):
        raise InputError(f"{new_images}: is no folder; give one with images that are to be localized.")
    names = {view.name for view in views}
    for name in () if measured.distance is None else measured.distance[:2]:
        if name not in names:
            raise InputError(
                f"{show(name)} is none of the {len(views)} photographs; name two as their files are called."
            )
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror}); give another --output.") from None
    made = reconstruct(views, folder, tell)
    level = level_of(made.poses, views)
    made = made.without(level.leaning)
    if measured.distance is not None:
        scale = scale_by_distance(made.poses, *measured.distance)
    elif measured.camera_height_m is not None:
        scale = scale_by_height(made.poses, made.points(), level, measured.camera_height_m)
    else:
        scale = arbitrary_scale(made.poses)
    return Map(made, level, scale, write_map(made, level, scale, views, images, folder, new_images))
