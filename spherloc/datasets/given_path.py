"""Recognizes a path that a command does not take, such as a folder of images in the place of a scene file, and names
the command that takes it."""

import re
import shlex
import tomllib
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from spherloc.datasets.asl_layout import AslSequence, asl_sequence
from spherloc.datasets.loc360_layout import is_hall
from spherloc.errors import InputError, shorten
from spherloc.files import IMAGES, is_file, is_folder, is_image, names_in, read_file

ARCHIVES = {".7z", ".bz2", ".gz", ".rar", ".tar", ".tgz", ".xz", ".zip"}
VIDEOS = {".360", ".avi", ".insv", ".m4v", ".mkv", ".mov", ".mp4", ".webm"}
PICKLES = {".pickle", ".pkl"}
SCENE = "give the path of a scene file (TOML) or a bundled scene's name, which spherloc scenes lists"
OF_MAP = "scene.toml"
"""The scene file of a map of photographs itself, in the folder of that map."""
COMMAND = re.compile(r": spherloc [^;]*$")
"""A command at the end of a sentence."""
MAX_SCENE_BYTES = 1_000_000
"""Largest TOML file that is looked at."""
MAX_FOLDERS = 50
"""Largest number of subfolders that are searched for images."""

_COLMAP = "a scene of kind colmap localizes its images: spherloc scenes colmap prints one to start from"
_SAVED = "save the photographs in it as JPEG or PNG files, then make a map of their folder with: spherloc map FOLDER"
_FILES = {
    **dict.fromkeys((".doc", ".docx", ".key", ".odp", ".odt", ".ppt", ".pptx"), ("a document", _SAVED)),
    ".bin": ("a binary file, maybe of a COLMAP model", f"give its folder in a scene file: {_COLMAP}"),
    ".csv": (
        "a table",
        "its matches are solved by a scene of kind correspondences: spherloc scenes correspondences",
    ),
    ".db": (
        "a COLMAP database, which holds features and matches but no poses and points",
        f"the folder with cameras, images and points3D is the map, and {_COLMAP}",
    ),
    ".h5": ("an HDF5 file, such as hloc writes", "a scene of kind hloc names it: spherloc scenes hloc prints one"),
    ".pdf": ("a PDF document", _SAVED),
    ".ply": ("a point cloud or a mesh", "a scene of kind newer-college names it as prior_map"),
    ".vrs": (
        "a recording of Project Aria's glasses",
        "save its images with projectaria-tools, in an environment of its own because its version 2 needs another "
        "version of rerun, then make a map of their folder with: spherloc map FOLDER",
    ),
    ".json": ("a JSON file", "a calibration is named by the key 'calibration' of a scene file"),
    ".yaml": ("a YAML file", "a calibration is named by the key 'calibration' of a scene file"),
    ".yml": ("a YAML file", "a calibration is named by the key 'calibration' of a scene file"),
}
"""What files with these endings are, and where they belong."""


def what_it_is(path: Path) -> str:
    """What a path is and what takes it: "photos: is a folder of 32 images; make a map of it with: spherloc map photos".

    No full stop follows a command, so that it can be copied. Empty for a path that may be a scene file, and for one
    that does not exist.
    """
    return "" if path.suffix.lower() == ".toml" and not is_folder(path) else _said(path, *_told(path))


def known_as(path: Path) -> str:
    """The same where a path is known to be something: a file of another kind than a scene, a scene file, or a folder
    with something in it; else empty."""
    what, advice = _told(path)
    return "" if advice == SCENE else _said(path, what, advice.removesuffix(f"; else {SCENE}"))


def _said(path: Path, what: str, advice: str) -> str:
    return f"{path}: is {what}; {advice}{'' if COMMAND.search(advice) else '.'}" if what else ""


def _told(path: Path) -> tuple[str, str]:
    """What a path is, and what to do with it; empty for one that does not exist."""
    return _folder(path) if is_folder(path) else _file(path) if is_file(path) else ("", "")


def _file(path: Path) -> tuple[str, str]:
    suffix, folder = path.suffix.lower(), _quoted(path.parent)
    if suffix in PICKLES:
        advice = f"if it is a log of hloc, say why its poses are wrong with: spherloc diagnose {_quoted(path)}"
        return "a pickle", f"{advice} --model MODEL"
    if suffix in (".rrd", ".toml"):
        return "a recording" if suffix == ".rrd" else "a TOML file", f"open it with: spherloc play {_quoted(path)}"
    if suffix in IMAGES:
        return "an image", f"make a map of all images of its folder with: spherloc map {folder}"
    if suffix in ARCHIVES:
        return "an archive", "unpack it, and give the folder or the file that comes out of it"
    if suffix in VIDEOS:
        return "a video", f"make a map of its frames with: spherloc map frames --video {_quoted(path)}"
    what, advice = _FILES.get(suffix, ("not a scene file", ""))
    return what, advice if advice == _SAVED else f"{advice}; else {SCENE}" if advice else SCENE


def _folder(path: Path) -> tuple[str, str]:
    try:
        names = names_in(path)
    except InputError:
        return "a folder that cannot be listed", SCENE
    suffixes = Counter(Path(name).suffix.lower() for name in names)
    if (sequence := asl_sequence(path)) is not None:
        *others, last = images_of_cameras(sequence).items()
        counts = f"{', '.join(_of_camera(*one) for one in others)}{' and ' if others else ''}{_of_camera(*last)}"
        what = f"a recorded sequence in the layout of EuRoC and TUM-VI, with {counts}"
        return what, f"make a map of some of them with: spherloc map {_quoted(path)}"
    stems = {Path(name).stem for name in names if Path(name).suffix in (".bin", ".txt")}
    if stems >= {"cameras", "images", "points3D"}:
        return "a COLMAP model", _COLMAP
    if "sensors" in names:
        return "a dataset of kapture", "a scene of kind kapture localizes its images: see spherloc scenes kapture"
    if is_hall(path):
        return "a hall of 360Loc", "a scene of kind 360loc localizes its images: see spherloc scenes 360loc"
    if "results.jsonl" in names:
        runs = _quoted(path / "recordings")
        return "a folder of results of spherloc localize", f"list its runs with: spherloc runs {runs}"
    if suffixes[".rrd"]:
        return _counted(suffixes[".rrd"], "recording"), f"list them with: spherloc runs {_quoted(path)}"
    images = _images(names)
    if images == 1:
        return _counted(images, "image"), "a map takes two images or more: add some to it"
    if images:
        return _counted(images, "image"), f"make a map of it with: spherloc map {_quoted(path)}"
    inside = images_in_folders(path, names, MAX_FOLDERS)
    if inside:
        what = f"a folder without images, but with {sum(inside.values()):,} in the folders in it"
        return what, f"make a map of them with: spherloc map {_quoted(path)}"
    scenes = [name for name in names if name.endswith(".toml") and _may_be_scene(path / name)]
    if scenes:
        first = OF_MAP if OF_MAP in scenes else scenes[0]
        return _counted(len(scenes), "scene file"), f"give one of them, such as {shorten(str(path / first))}"
    videos = [name for name in names if Path(name).suffix.lower() in VIDEOS]
    if videos:
        video = _quoted(path / videos[0])
        advice = f"make a map of the frames of one with: spherloc map frames --video {video}"
        return _counted(len(videos), "video"), advice
    if deeper := images_below(path):
        where, count = deeper
        what = f"a folder without images, but with {count:,} deeper in it, in {where}"
        return what, f"make a map of these with: spherloc map {_quoted(where)}"
    return ("an empty folder" if not names else "a folder without images or scene files"), SCENE


def _may_be_scene(path: Path) -> bool:
    """Whether a TOML file has more than a camera, which a calibration has alone, and a kind or a camera, as scene files
    do, or cannot be read, so that its loader says why."""
    try:
        table = tomllib.loads(read_file(path, MAX_SCENE_BYTES).decode())
    except (InputError, OSError, ValueError):
        return True
    return not table or bool(table.keys() & {"kind", "camera"} and table.keys() != {"camera"})


def _images(names: Sequence[str]) -> int:
    return sum(is_image(name) for name in names)


def _of_camera(name: str, count: int) -> str:
    return f"{count:,} image{'' if count == 1 else 's'} of {name}"


def images_of_cameras(sequence: AslSequence) -> dict[str, int]:
    """Number of images of each camera of a sequence."""
    return {name: _images(names_in(folder)) for name, folder in sequence.cameras.items()}


def images_in_folders(path: Path, names: Sequence[str], most: int | None = None) -> dict[str, int]:
    """Number of images in each subfolder that has some, by its name; of at most ``most`` folders if that is given."""
    counts = {}
    for name in [name for name in names if is_folder(path / name)][:most]:
        try:
            counts[name] = _images(names_in(path / name))
        except InputError:
            continue
    return {name: count for name, count in counts.items() if count}


def images_below(path: Path) -> tuple[Path, int] | None:
    """A folder in ``path``, at any depth, that has two images or more, or that has several such folders or a sequence
    in the ASL layout, and how many.

    The one that is least deep, the first by name; None if there is none among the first ``MAX_FOLDERS`` folders.
    """
    folders = [path]
    for place in folders:  # grows: those of the next level come after those of this one
        try:
            names = [name for name in names_in(place) if not name.startswith(".")]
        except InputError:
            continue
        if (sequence := asl_sequence(place)) is not None and (count := sum(images_of_cameras(sequence).values())) > 1:
            return place, count
        inside = [count for count in images_in_folders(place, names, MAX_FOLDERS).values() if count > 1]
        count = sum(inside) if len(inside) > 1 else _images(names)
        if count > 1:
            return place, count
        folders += [place / name for name in names if is_folder(place / name)][: MAX_FOLDERS - len(folders)]
    return None


def _counted(count: int, what: str) -> str:
    return f"a folder of {count:,} {what}{'' if count == 1 else 's'}"


def _quoted(path: Path) -> str:
    return shlex.quote(str(path))
