"""The cameras of a calibration file that a user gives for photographs of known sizes."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from spherloc.cameras.base import Camera
from spherloc.cameras.calibration import about_calibration, camera_names, load_camera
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.scaling import scaled
from spherloc.datasets.asl_layout import asl_sequence
from spherloc.errors import CalibrationError, InputError, show
from spherloc.files import is_folder, is_image, names_in
from spherloc.images import read_size
from spherloc.mapping.images.found_calibrations import calibration_files
from spherloc.mapping.images.left_out import MAX_NAMED, some_of

Size = tuple[int, int]
"""Width and height, px."""


def given_cameras(place: Path, name: str | None, folder: Path) -> tuple[dict[str, Camera], list[str]]:
    """The cameras of a calibration file, or of the files in a folder, by name, or the named one alone, for photographs
    in ``folder``, and remarks. Of files in a folder with one camera each, those that call it alike, or not at all,
    give it their own names.

    If none has the size of a photograph, those of the same shape are scaled to the most frequent size. If a file states
    no size, and the photographs have one, it is that. Raises ``CalibrationError`` for a file that cannot be used and
    for a folder without one that can.
    """
    images = list(_images_in(folder))
    sizes = _sizes_of(images)
    if not is_folder(place):
        return _of_file(place, name, sizes)
    found, remarks = dict[Path, dict[str, Camera]](), list[str]()
    for file in calibration_files(place, [path.name for path in images]):
        try:
            found[file], about = _of_file(file, None, sizes)
        except CalibrationError as error:
            remarks.append(f"It is not used: {error}")
            continue
        remarks += about
    # Kalibr's files of one camera all call it cam0, whichever of the cameras it is.
    files = Counter(one for own in found.values() for one in own)
    cameras = {
        one if one and (files[one] == 1 or len(own) > 1) else file.stem: camera
        for file, own in found.items()
        for one, camera in own.items()
    }
    if not cameras:
        raise CalibrationError(
            f"{place}: none of its files can be read as a calibration; give a folder of calibrations, called as the "
            f"cameras or as the images are, or one file. {' '.join(remarks[:1])}".rstrip()
        )
    if name is not None and name not in cameras:
        raise CalibrationError(f"{place}: has no camera {show(name)}; choose one of {some_of(tuple(cameras))}.")
    return cameras if name is None else {name: cameras[name]}, remarks[:MAX_NAMED]


def _of_file(file: Path, name: str | None, sizes: Counter[Size]) -> tuple[dict[str, Camera], list[str]]:
    """``given_cameras`` of a file, for photographs of ``sizes``."""
    names: Sequence[str | None] = [name] if name is not None else camera_names(file)
    cameras, remarks = dict[str, Camera](), list[str]()
    for one in names or (None,):
        try:
            cameras[one or ""] = load_camera(file, one)
        except CalibrationError:
            if len(sizes) != 1:
                raise
            (size,) = sizes
            cameras[one or ""] = load_camera(file, one, size)
            remarks.append(f"{file}: states no size of images; {_px(size)}, that of the photographs, are taken.")
    if about := about_calibration(file, next(iter(sizes)) if len(sizes) == 1 else None):
        remarks.append(f"{file}: {about}")
    if sizes and not any((camera.width, camera.height) in sizes for camera in cameras.values()):
        cameras, about = _scaled(file, cameras, sizes.most_common(1)[0][0])
        remarks += about
    return cameras, remarks


def _scaled(file: Path, cameras: Mapping[str, Camera], size: Size) -> tuple[dict[str, Camera], list[str]]:
    """The cameras, those of the shape of images of that size scaled to it, and remarks."""
    found, remarks = dict(cameras), []
    for name, camera in cameras.items():
        smaller = None if isinstance(camera, Equirectangular) else scaled(camera, *size)
        if smaller is not None:
            found[name] = smaller
            which = f", camera {show(name)}," if name else ""
            remarks.append(
                f"{file}{which}: is for images of {_px((camera.width, camera.height))}, and was scaled to {_px(size)}, "
                "the size of the photographs. That is right if these were scaled, but not if they were cut."
            )
    return found, remarks


def _images_in(folder: Path) -> Iterator[Path]:
    """The images in a folder or, if there are none, in the folders in it; of a sequence in the ASL layout all."""
    if (sequence := asl_sequence(folder)) is not None:
        yield from (place / name for place in sequence.cameras.values() for name in names_in(place) if is_image(name))
        return
    names = names_in(folder) if is_folder(folder) else []
    paths = [folder / name for name in names if is_image(name)]
    inside = [] if paths else [folder / name for name in names if is_folder(folder / name)]
    yield from paths
    yield from (place / name for place in inside for name in names_in(place) if is_image(name))


def _sizes_of(images: Sequence[Path]) -> Counter[Size]:
    """How many images of each size there are."""
    sizes = Counter[Size]()
    for path in images:
        try:
            sizes[read_size(path)] += 1
        except InputError:  # told later, with all that is left out
            continue
    return sizes


def _px(size: Size) -> str:
    return f"{size[0]} x {size[1]} pixels"
