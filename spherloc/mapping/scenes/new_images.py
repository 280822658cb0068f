"""The images that are to be localized in a map, with their cameras: those of the map or others."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from spherloc.cameras.base import Camera
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.datasets.given_path import known_as
from spherloc.errors import InputError
from spherloc.files import is_file, is_folder, is_image, names_in
from spherloc.frontend.view import Gravity, View
from spherloc.images import read_size
from spherloc.mapping.alignment.sequence import sequence_data
from spherloc.mapping.alignment.tag_gravity import stated_by_tags
from spherloc.mapping.alignment.true_poses import GroundTruth, ground_truth
from spherloc.mapping.images.frames import FrameChoice
from spherloc.mapping.images.photographs import Photographs, cameras_of, with_cameras


@dataclass(frozen=True)
class NewImages:
    """Images that are to be localized in a map."""

    folder: Path
    views: tuple[View, ...] | None
    """With their cameras, named by the path in the folder; None for all images there, of the map's one camera."""
    gravity: Mapping[str, Gravity] = field(default_factory=dict)
    """That of a sequence's IMU or of tags, by name."""
    truth: GroundTruth | None = None
    """That of their sequence; None if there is none."""


def new_images_of(
    folder: Path,
    mapped: Photographs,
    panorama: bool = False,
    choice: FrameChoice = FrameChoice(),  # noqa: B008 -- frozen
    *,
    measured_gravity: bool = True,
) -> tuple[NewImages, tuple[str, ...]]:
    """The images of a folder that are to be localized in the map of others, and remarks on those that cannot be.

    Where they are many, those that ``choice`` takes, of a folder whose images were mapped in part the others. With
    ``measured_gravity``, gravity is that of a sequence's IMU, or of the tags of panoramas (``stated_by_tags``).

    A calibration that lies beside images of its size is theirs, as for a map's own. Without one, they are of a camera
    of the map that has their size, which ``with_cameras`` tells by their names where it has several; others of 2 to 1
    are panoramas. Raises ``InputError`` if there is no image, or none whose camera is known.
    """
    if not is_folder(folder):
        if is_file(folder) and is_image(folder.name):
            raise InputError(f"{folder}: is an image; give a folder with it and others that are to be localized.")
        raise InputError(
            known_as(folder) or f"{folder}: is not a folder; give one with images that are to be localized."
        )
    different = cameras_of(mapped.views)
    only = next(iter(different.values())) if len(different) == 1 else None
    choice = replace(choice, mapped=frozenset(view.path.resolve() for view in mapped.views))
    found = with_cameras(folder, {}, panorama, None, mapped.cameras if only is None else {"": only}, choice)
    if not found.views:
        raise InputError(f"{folder}: the camera of none of its images is known. {' '.join(found.remarks)}")
    all_there = only is not None and _all_of(folder, only) == [view.path for view in found.views]
    all_its = only is not None and all(_is(view.camera, only) for view in found.views)
    data = sequence_data(folder, found.views, gravity=measured_gravity, positions=False)
    gravity = {} if data.stated is None else data.stated.found
    remarks = (*found.remarks, *data.remarks)
    if measured_gravity and not gravity:
        stated, about_tags = stated_by_tags(found.views, choice.tell)
        gravity = {} if stated is None else stated.found
        remarks = (*remarks, *about_tags)
    truth = ground_truth(folder, found.views, mapped.views)
    return NewImages(folder, None if all_there and all_its else found.views, gravity, truth), remarks


def _all_of(folder: Path, camera: Camera) -> list[Path]:
    """The images of a folder that can be read and are of the camera by their size; panoramas are of any size."""
    return [path for name in names_in(folder) if is_image(name) and _has_size(path := folder / name, camera)]


def _has_size(path: Path, camera: Camera) -> bool:
    try:
        width, height = read_size(path)
    except InputError:
        return False
    panorama = isinstance(camera, Equirectangular) and width == 2 * height
    return panorama or (width, height) == (camera.width, camera.height)


def _is(camera: Camera, of_map: Camera) -> bool:
    """Whether it is the camera of the map; panoramas are of any size."""
    return camera == of_map or (isinstance(camera, Equirectangular) and isinstance(of_map, Equirectangular))
