"""What is said of files in a folder of photographs that are not mapped, and of a folder without photographs."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from spherloc.datasets.given_path import SCENE, images_below, what_it_is
from spherloc.errors import shorten
from spherloc.files import IMAGES, is_folder
from spherloc.mapping.advice import advice

UNREAD = {".arw", ".avif", ".cr2", ".cr3", ".dng", ".gpr", ".heic", ".heif", ".insp", ".nef", ".orf", ".raf", ".rw2"}
"""Endings of photographs that OpenCV does not read."""
MAX_NAMED = 3
"""Largest number of names in a remark."""


def about_damaged(names: Sequence[str]) -> list[str]:
    """A remark on images that are damaged or empty; none without any."""
    if not names:
        return []
    return [f"{were(len(names), 'image')} left out, damaged or empty: {some_of(names)}; copy again what is needed."]


def about_refused(errors: Sequence[str]) -> list[str]:
    """A remark on images that are too large, hold other numbers or may not be read, by the sentences on each."""
    if not errors:
        return []
    first = "" if len(errors) == 1 else " The first:"
    return [f"{were(len(errors), 'image')} left out that cannot be read.{first} {errors[0]}"]


def about_raw(names: Sequence[str]) -> list[str]:
    """A remark on images of two fisheye circles; none without any."""
    if not names:
        return []
    return [
        f"{were(len(names), 'image')} left out, two fisheye circles side by side and no panorama: {some_of(names)}; "
        f"{advice('two circles')}."
    ]


def about_turned(names: Sequence[str]) -> list[str]:
    """A remark on panoramas that programs show turned. That of other images is right: calibrations are of the pixels
    as they are stored."""
    if not names:
        return []
    have = f"{counted(len(names), 'panorama')} {'has' if len(names) == 1 else 'have'}"
    return [
        f"{have} an orientation tag, which is not used: {some_of(names)}; where pixels are upside down without it, "
        "save them turned."
    ]


def about_unread(names: Sequence[str]) -> list[str]:
    """A remark on photographs in formats that are not read, among files with these names; empty without any."""
    unread = [name for name in names if Path(name).suffix.lower() in UNREAD and not name.startswith(".")]
    if not unread:
        return []
    kinds = ", ".join(sorted({Path(name).suffix.lower() for name in unread}))
    return [f"{were(len(unread), 'photograph')} left out: {some_of(unread)}; convert {kinds} to JPEG or PNG."]


def about_subfolders(inside: Mapping[str, int]) -> list[str]:
    """A remark on the numbers of images in subfolders, by their names; none without any."""
    if not inside:
        return []
    left = f"{were(sum(inside.values()), 'image')} left out, in subfolders: {some_of(list(inside))}"
    return [f"{left}; put each camera's images into a folder of its own to have them too."]


def about_deeper(root: Path, names: Sequence[str]) -> list[str]:
    """A remark on images that are two folders deep or more."""
    found = [deeper for name in names if is_folder(root / name) and (deeper := images_below(root / name))]
    if not found:
        return []
    where, count = found[0]
    return [f"{were(count, 'image')} left out, deeper in the folder, in {where}; give that folder to have them."]


def known_otherwise(path: Path) -> str:
    """What a path is and what takes it, if it is known and no scene file is asked for instead; else empty."""
    told = what_it_is(path)
    return "" if SCENE in told else told


def without_photographs(folder: Path, remarks: Sequence[str], new: bool) -> str:
    """Why a folder has nothing to map or, if its images are ``new``, to localize, and what to do."""
    if remarks:
        return f"{folder}: has no photographs that can be read. {' '.join(remarks)}"
    if new:
        deeper = images_below(folder)
        if deeper:
            return f"{folder}: has no images, but {deeper[1]} deeper in it, in {deeper[0]}; give that folder."
        return f"{folder}: has no images; give a folder with images that are to be localized."
    return (
        known_otherwise(folder)
        or f"{folder}: has no photographs ({', '.join(sorted(IMAGES))}); give the folder that has them."
    )


def counted(count: int, what: str) -> str:
    """A number with its noun, such as "2 images"."""
    return f"{count} {what}{'' if count == 1 else 's'}"


def were(count: int, what: str) -> str:
    """A number with its noun and verb, such as "2 images were"."""
    return f"{counted(count, what)} {'was' if count == 1 else 'were'}"


def some_of(names: Sequence[str]) -> str:
    """The first ``MAX_NAMED`` names."""
    return f"{', '.join(shorten(name) for name in names[:MAX_NAMED])}{', …' if len(names) > MAX_NAMED else ''}"
