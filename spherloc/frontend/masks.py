"""Masks: pixels from which no features are taken, such as the car, the tripod, or the seam between two lenses.

A mask is an image of the photographs' size whose dark pixels are left out, as in COLMAP: one for all images, or a
folder of them. In a folder, the mask of ``walk/a.jpg`` is ``walk/a.jpg.png``, ``walk/a.png`` or ``walk/a.jpg``, else
that of its camera, ``walk.png``.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path, PurePosixPath

import numpy as np

from spherloc.cameras.base import Camera
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.errors import InputError, shorten
from spherloc.files import is_file, is_folder
from spherloc.frontend.triangulation import TriangulationLift
from spherloc.frontend.view import PIXELS_AT_ONCE, View
from spherloc.images import grey, read_image, read_size
from spherloc.types import BoolArray

MAX_NADIR_DEG = 80.0
MAX_SEAM_DEG = 30.0


@dataclass(frozen=True)
class Masks:
    """The pixels that are left out of images."""

    images: Path | None = None
    """A mask for all images, or a folder with masks by the images' names."""
    nadir_deg: float = 0.0
    """Half the opening angle of a cone around the camera's +y axis that is left out: the car or tripod below a
    panorama."""
    seam_deg: float = 0.0
    """Angle on either side of the circle, 90 degrees from the middle of a panorama, where the images of a two-lens
    camera meet; pixels within it are left out."""

    def __post_init__(self) -> None:
        limits = {"nadir_deg": (self.nadir_deg, MAX_NADIR_DEG), "seam_deg": (self.seam_deg, MAX_SEAM_DEG)}
        for key, (value, most) in limits.items():
            if not 0.0 <= value <= most:
                raise InputError(f"{key} of masks is {value:g}; give degrees from 0 to {most:g}.")

    def on(self, views: Sequence[View]) -> tuple[tuple[View, ...], list[str]]:
        """The views with these masks, added to the masks that they have, and a remark on those without a mask.

        Raises ``InputError`` if the mask or the folder cannot be used, if the folder has a mask for none of the views,
        or if ``seam_deg`` is set and the images are not panoramas.
        """
        if self.seam_deg and not any(isinstance(view.camera, Equirectangular) for view in views):
            raise InputError("seam_deg of masks is for panoramas, and these images are not panoramas; leave it out.")
        files = self._files(views)
        masked = tuple(
            _masked(view, file, self.nadir_deg, self.seam_deg) for view, file in zip(views, files, strict=True)
        )
        without = [view.name for view, file in zip(views, files, strict=True) if file is None]
        if self.images is None or not without:
            return masked, []
        return masked, [
            f"{len(without)} of {len(views)} images have no mask in {self.images}, the first is {shorten(without[0])}."
        ]

    def _files(self, views: Sequence[View]) -> list[Path | None]:
        """The mask of each view."""
        where = self.images
        if where is None:
            return [None] * len(views)
        if is_folder(where):
            files = [_in_folder(where, view.name) for view in views]
            if not any(files):
                first = PurePosixPath(views[0].name).with_suffix(".png")
                raise InputError(
                    f"{where}: has a mask for none of the {len(views)} images; name the masks after the images, "
                    f"such as {first}."
                )
            return files
        if not is_file(where):
            raise InputError(f"{where}: is neither a mask nor a folder of masks; correct the path.")
        size = read_size(where)
        files = [where if (view.camera.width, view.camera.height) == size else None for view in views]
        if not any(files):
            camera = views[0].camera
            raise InputError(
                f"{where}: is {size[0]} x {size[1]} pixels, and no image is, such as {shorten(views[0].name)} with "
                f"{camera.width} x {camera.height}; give a mask of the images' size."
            )
        return files


def _in_folder(folder: Path, name: str) -> Path | None:
    own = PurePosixPath(name)
    parents = [parent for parent in own.parents if parent.name]
    cameras = [parent.with_name(f"{parent.name}.png") for parent in parents]
    cameras += [PurePosixPath(f"{parent.name}.png") for parent in parents]  # of cam0/data: cam0.png
    for candidate in (own.with_name(f"{own.name}.png"), own.with_suffix(".png"), own, *cameras):
        if is_file(folder / candidate):
            return folder / candidate
    return None


def _masked(view: View, file: Path | None, nadir_deg: float, seam_deg: float) -> View:
    seam_deg = seam_deg if isinstance(view.camera, Equirectangular) else 0.0
    if file is None and not nadir_deg and not seam_deg:
        return view
    return replace(view, mask=partial(_allowed, view, file, nadir_deg, seam_deg))


def _allowed(view: View, file: Path | None, nadir_deg: float, seam_deg: float) -> BoolArray:
    """Mask (H, W) of the pixels of a view that may be used."""
    allowed = around(view.camera, nadir_deg, seam_deg)
    if view.mask is not None:
        allowed = allowed & view.mask()
    if file is None:
        return allowed
    mask = read_mask(file)
    if mask.shape != allowed.shape:
        raise InputError(
            f"{file}: the mask is {mask.shape[1]} x {mask.shape[0]} pixels, its image {allowed.shape[1]} x "
            f"{allowed.shape[0]}; give a mask of the image's size."
        )
    return allowed & mask


def read_mask(path: Path) -> BoolArray:
    """Mask (H, W), true where an image is at least half as bright as its brightest pixel.

    Raises ``InputError`` if the image cannot be read or is completely black.
    """
    image = grey(read_image(path))
    brightest = int(image.max())
    if brightest == 0:
        raise InputError(f"{path}: the mask is completely black; make the pixels white that may be used.")
    return 2 * image.astype(np.int32) > brightest


@lru_cache(maxsize=8)
def around(camera: Camera, nadir_deg: float, seam_deg: float) -> BoolArray:
    """Read-only mask (H, W) of the pixels outside the cone around +y and outside the band around the circle z = 0."""
    outside = np.ones((camera.height, camera.width), bool)
    columns = np.arange(camera.width) + 0.5
    rows = max(1, PIXELS_AT_ONCE // camera.width)
    for top in range(0, camera.height if nadir_deg or seam_deg else 0, rows):
        block = np.arange(top, min(top + rows, camera.height)) + 0.5
        u, v = np.meshgrid(columns, block)
        bearings, seen = camera.unproject(np.column_stack([u.ravel(), v.ravel()]).astype(np.float64))
        below = nadir_deg > 0.0 and bearings[:, 1] > np.cos(np.radians(nadir_deg))
        seam = seam_deg > 0.0 and np.abs(bearings[:, 2]) < np.sin(np.radians(seam_deg))
        outside[top : top + rows] = ~(seen & (below | seam)).reshape(u.shape)
    outside.setflags(write=False)
    return outside


def with_masked_lifts(views: Sequence[View]) -> tuple[View, ...]:
    """The views, with lifts that triangulate with these masked views and not with the unmasked ones."""
    masked = {view.path: view for view in views}
    found = []
    for view in views:
        lift = view.lift
        if isinstance(lift, TriangulationLift):
            others = tuple(masked.get(other.path, other) for other in lift.others)
            view = replace(view, lift=replace(lift, view=masked.get(lift.view.path, lift.view), others=others))
        found.append(view)
    return tuple(found)
