"""Calibration files beside photographs: which there are, and whose."""

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from spherloc.cameras._checks import UnrecognisedError
from spherloc.cameras.base import Camera
from spherloc.cameras.calibration import about_calibration, camera_names, load_camera
from spherloc.errors import SpherlocError, shorten
from spherloc.files import is_folder, is_image, names_in
from spherloc.mapping.advice import advice
from spherloc.mapping.images.left_out import MAX_NAMED
from spherloc.mapping.rig import camera_and_key

CALIBRATIONS = (".yaml", ".yml", ".json", ".toml", ".txt", ".xml")
CALLED_CALIBRATION = re.compile("calib|camera|camchain|intrinsic|sensor|lens|cam[0-9]*$")
"""Names of files that are taken for calibrations, so that one that cannot be read is told."""
MAX_CALIBRATIONS = 20
"""Largest number of files beside the photographs that are tried as a calibration."""
OWN_ENDINGS = (".yaml", ".yml", ".json", ".toml", ".xml")
"""Endings of calibrations of single images, in whose place texts are mostly labels of what is seen."""
OWN_FOLDERS = ("calibration", "calibration_data/calibration")
"""Folders of calibrations of single images, as WoodScape calls them."""
MAX_CALLED = 8
"""Largest number of cameras with the same lens that are named."""
MAX_OTHER_FILES = 3
"""If so many files that are called as images are cannot be read, they are something else, such as labels."""


@dataclass(frozen=True)
class FoundCalibrations:
    """What calibration files beside images hold."""

    cameras: Mapping[str, Camera]
    """By the name of the file or, if it has several, of the camera in it."""
    refused: tuple[str, ...] = ()
    """Why files are not read that are calibrations or are called so, a sentence each."""
    concluded: Mapping[str, str] = field(default_factory=dict)
    """What files do not say of their lens and was concluded, a sentence each, by the name of the file."""
    of_image: Mapping[str, Camera] = field(default_factory=dict)
    """By the name of the image, cameras of the files that are called as the images are; each is one of ``cameras``."""
    of_image_refused: tuple[str, ...] = ()
    """Why some of those files are not read, a sentence each."""

    def unused(self, sizes: Collection[tuple[int, int]]) -> list[str]:
        """Why none of it is used for images of these sizes, a sentence each."""
        others = [
            f"{shorten(name)} is of {camera.width} x {camera.height}"
            for name, camera in self.cameras.items()
            if (camera.width, camera.height) not in sizes
        ]
        if not others:
            return list(self.refused[:MAX_NAMED])
        told = (
            f"The calibration beside them is not used ({', '.join(others[:MAX_NAMED])} pixels), as no photograph there"
        )
        turned = any((camera.height, camera.width) in sizes for camera in self.cameras.values())
        what = "turn the photographs by 90°, or calibrate anew" if turned else advice("another size")
        return [f"{told} has its size: {what}.", *self.refused[:MAX_NAMED]]


def calibrations_in(root: Path, inside: str = "", images: Sequence[str] = ()) -> FoundCalibrations:
    """Cameras of the calibration files in ``root`` or, with ``inside``, in that folder there, and of one beside it that
    has its name; and those of the files of single ``images`` there, by name."""
    there = names_in(root / inside)
    files = [root / inside / name for name in there]
    files += [root / name for name in names_in(root) if inside and Path(name).stem == inside]
    own = _own(root / inside, images)
    if own.series:  # the files of other images say nothing of these
        stems = {Path(name).stem for name in there if is_image(name)}
        files = [path for path in files if path.stem not in stems]
    found = calibrations_of(files)
    cameras, concluded = {**found.cameras, **own.cameras}, {**found.concluded, **own.concluded}
    return FoundCalibrations(cameras, found.refused, concluded, own.of_image, own.refused)


def calibration_files(folder: Path, images: Sequence[str]) -> list[Path]:
    """The calibration files in a folder of them: those that are called as ``images`` are or, without any, the first."""
    stems = {Path(name).stem for name in images}
    files = [folder / name for name in names_in(folder) if Path(name).suffix.lower() in CALIBRATIONS]
    return [path for path in files if path.stem in stems] or files[:MAX_CALIBRATIONS]


def own_files(folder: Path, images: Sequence[str], given: Path | None = None) -> dict[str, Path]:
    """The calibration file of each image, by its name, of those that have one: it is called as the image is but for the
    ending, and lies in the folder ``given``, else beside it or in a folder of calibrations in or beside its
    ``folder``."""
    wanted = {Path(name).stem: name for name in images}
    here = folder if folder.name else folder.resolve()
    found: dict[str, Path] = {}
    usual = (folder, *(folder / name for name in OWN_FOLDERS), *(here.parent / name for name in OWN_FOLDERS))
    for place in usual if given is None else (given,):
        for name in names_in(place) if is_folder(place) else ():
            path = place / name
            image = wanted.get(path.stem) if path.suffix.lower() in OWN_ENDINGS else None
            if image is not None:
                found.setdefault(image, path)
    return {name: found[name] for name in images if name in found}


class _OwnCalibrations(NamedTuple):
    """What the files of single images hold."""

    cameras: Mapping[str, Camera]
    """Different ones: by what their images are called but for a number, or the name of the file of a single image."""
    of_image: Mapping[str, Camera]
    series: bool
    """Whether a camera is that of several images."""
    concluded: Mapping[str, str]
    """As in ``FoundCalibrations``."""
    refused: tuple[str, ...]
    """``of_image_refused``; none if no file of an image is a calibration."""


def _own(folder: Path, images: Sequence[str]) -> _OwnCalibrations:
    """The calibrations of single images in a folder; none if the first files that are called so are none."""
    taken: dict[str, tuple[Camera, list[str]]] = {}
    refused: list[str] = []
    files = own_files(folder, images)
    for image, path in files.items():
        try:
            camera = load_camera(path)
        except SpherlocError as error:
            refused.append(f"The calibration of {shorten(image)} is not used: {error}")
            if not taken and len(refused) == MAX_OTHER_FILES:
                break
        else:
            taken.setdefault(repr(camera), (camera, []))[1].append(image)
    cameras, concluded = dict[str, Camera](), dict[str, str]()
    for camera, names in taken.values():
        file = files[names[0]]
        by_names = sorted({camera_and_key(name)[0] for name in names} - {""}) if len(names) > 1 else []
        called = ", ".join(by_names[:MAX_CALLED]) or file.stem
        number = sum(name == called or name.startswith(f"{called} (") for name in cameras)
        called = f"{called} ({number + 1})" if number else called
        cameras[called] = camera
        if about := about_calibration(file):
            concluded[called] = about
    of_image = {name: camera for camera, names in taken.values() for name in names}
    series = any(len(names) > 1 for _, names in taken.values())
    return _OwnCalibrations(cameras, of_image, series, concluded, tuple(refused) if taken else ())


def calibrations_of(files: Sequence[Path], least: int = 1) -> FoundCalibrations:
    """What those of the files hold that are calibrations of at least so many cameras."""
    found: dict[str, Camera] = {}
    refused, concluded = [], dict[str, str]()
    for path in [path for path in files if path.suffix.lower() in CALIBRATIONS][:MAX_CALIBRATIONS]:
        try:
            names = camera_names(path)
            if len(names) > 1:
                found |= {name: load_camera(path, name) for name in names}
            elif least <= 1:
                found[path.stem] = load_camera(path)
                if about := about_calibration(path):
                    concluded[path.stem] = about
        except SpherlocError as error:  # perhaps not a calibration, but for its name
            if CALLED_CALIBRATION.search(path.stem.lower()) or not isinstance(error, UnrecognisedError):
                refused.append(f"A file beside them is not used: {error}")
    return FoundCalibrations(found, tuple(refused), concluded)
