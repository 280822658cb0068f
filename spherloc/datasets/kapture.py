"""kapture 1.1: posed images of cameras and rigs, some of them localized against the others.

Depth records are not read: points of a reference are triangulated from other references, those first that a rig took at
the same time. An image that a rig took together with a query is not a reference. A query's pose, if it has one, is the
truth.

https://github.com/naver/kapture/blob/main/kapture_format.adoc
"""

from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from spherloc.datasets import map_scene, scene_file
from spherloc.datasets.colmap import gravity_of_map, some, split_gravity
from spherloc.datasets.map_scene import MapScene
from spherloc.errors import InputError, show
from spherloc.files import is_file
from spherloc.formats.kapture_files import Kapture, Record, read_kapture
from spherloc.frontend.partners import with_triangulation
from spherloc.frontend.pipeline import FrontendOptions, frontend_options
from spherloc.frontend.view import View

EXAMPLE = """\
kind = "kapture"
name = "my robot"
root = "mapping"                 # folder that holds sensors/
queries = ["cam001/*5.jpg"]      # names or patterns of images, or a section [queries] like the next

[references]                     # optional, and so are its keys: else all other images with a pose
images = ["cam001/*", "cam002/*"]
devices = ["cam001", "cam002"]
timestamps = [0, 1000]           # first and last, as in the files
every = 5                        # every fifth of these, by time

[gravity]                        # optional
map = [0.0, 1.0, 0.0]            # down; else the mean +y axis of the reference cameras
bound_deg = 5.0                  # how far a query's roll and pitch may be from its reference's
# query = "lines"                # down in a query from the vertical lines of its image instead
# file = "gravity.txt"           # or from rows: image gx gy gz [sd_deg]
"""

GRAVITY_BOUND_DEG = 5.0
"""Default bound on the difference of a query's roll and pitch from its most similar reference's: cameras are
handheld."""
_MIN_NANOSECONDS = 10**17
"""Least timestamp, March 1973, that counts as nanoseconds; smaller ones may be running numbers."""
_SELECTION = {"images", "devices", "timestamps", "every"}


def load(table: dict[str, Any], path: Path) -> MapScene:
    """Read a scene of ``kind = "kapture"``; paths in it are relative to its file.

    Raises ``InputError`` for a missing file, a wrong line in one, or a wrong key.
    """
    where = str(path)
    required = map_scene.REQUIRED | {"root", "queries"}
    scene_file.check_keys(table, required, map_scene.OPTIONAL | {"references"}, where)
    shared_gravity, gravity = split_gravity(table, where)
    scene_file.check_keys(gravity, set(), {"map"}, f"{where} [gravity]")
    settings = map_scene.read_settings(table | {"gravity": shared_gravity}, where, GRAVITY_BOUND_DEG)
    root = map_scene.folder(table, "root", path)
    kapture = read_kapture(root, where)
    records, remarks = _usable(kapture, root)
    queries = _selected(records, table, "queries", where)
    asked = set(queries)
    others = [record for record in records if record not in asked]
    if "references" in table:
        others = _selected(others, table, "references", where)
    others, left_out = _posed_apart(kapture, others, queries)
    references = _references(kapture, root, others, frontend_options(settings.frontend, where, path.parent))
    down, assumed = gravity_of_map(gravity, references, where)
    views = (_view(kapture, root, record) for record in queries)
    return settings.scene(
        path, views, references, down, (*kapture.remarks, *remarks, *left_out, *assumed), assumed_down=bool(assumed)
    )


def _file(root: Path, record: Record) -> Path:
    return root / "sensors" / "records_data" / record.image


def _usable(kapture: Kapture, root: Path) -> tuple[list[Record], list[str]]:
    """Records with a camera and an image, by time, and a remark on those without an image."""
    known = [record for record in kapture.records if record.device in kapture.cameras]
    missing = [record.image for record in known if not is_file(_file(root, record))]
    gone = set(missing)
    folder = root / "sensors" / "records_data"
    remarks = [f"{some(missing, 'image')} not found in {folder}: left out."] if missing else []
    return sorted((record for record in known if record.image not in gone), key=lambda one: one.timestamp), remarks


def _selected(records: Sequence[Record], table: Mapping[str, Any], key: str, where: str) -> list[Record]:
    """The records that ``queries`` or ``references`` means: a list of names and patterns, or a section."""
    wanted = table[key] if isinstance(table[key], dict) else {"images": table[key]}
    place = f"{where} [{key}]"
    scene_file.check_keys(wanted, set(), _SELECTION, place)
    chosen = list(records)
    if "images" in wanted:
        images = _fitting([record.image for record in records], _texts(wanted["images"], "images", place), place)
        chosen = [record for record in chosen if record.image in images]
    if "devices" in wanted:
        devices = _texts(wanted["devices"], "devices", place)
        chosen = [record for record in chosen if record.device in devices]
    if "timestamps" in wanted:
        first, last = _two_integers(wanted["timestamps"], place)
        chosen = [record for record in chosen if first <= record.timestamp <= last]
    if "every" in wanted:
        chosen = chosen[:: scene_file.integer(wanted, "every", place, 1, 10**9)]
    if not chosen and records:
        raise InputError(
            f"{place}: fits none of the {len(records)} images, such as {show(records[0].image)}; correct it."
        )
    return chosen


def _texts(value: Any, key: str, place: str) -> list[str]:
    texts = [value] if isinstance(value, str) else value
    if not isinstance(texts, list) or not texts or not all(isinstance(text, str) and text for text in texts):
        raise InputError(f"{place}: {key} is {show(value)}; give a list of texts.")
    return texts


def _fitting(images: Sequence[str], patterns: Sequence[str], place: str) -> set[str]:
    """The images that are named or fit a pattern; raises ``InputError`` for a pattern that none fits."""
    known = set(images)
    found: set[str] = set()
    for pattern in patterns:
        fits = {pattern} & known or {image for image in images if fnmatchcase(image, pattern)}
        if images and not fits:
            first = show(images[0])
            raise InputError(
                f"{place}: {show(pattern)} fits none of the {len(images)} images, such as {first}; correct it."
            )
        found |= fits
    return found


def _two_integers(value: Any, place: str) -> tuple[int, int]:
    good = isinstance(value, list) and len(value) == 2 and all(type(item) is int for item in value)
    if not good or value[0] > value[1]:
        raise InputError(f"{place}: timestamps is {show(value)}; give the first and the last, two whole numbers.")
    return value[0], value[1]


def _posed_apart(
    kapture: Kapture, records: Sequence[Record], queries: Sequence[Record]
) -> tuple[list[Record], list[str]]:
    """Records with a pose that no rig took together with a query, and remarks on the others."""
    taken = {(query.timestamp, rig) for query in queries for rig in kapture.carriers(query.device)}
    partners = [
        record.image
        for record in records
        if any((record.timestamp, rig) in taken for rig in kapture.carriers(record.device))
    ]
    together = set(partners)
    apart = [record for record in records if record.image not in together]
    unposed = [record.image for record in apart if kapture.pose(record.timestamp, record.device) is None]
    remarks = [f"{some(partners, 'image')} taken together with a query: not used as references."] if partners else []
    if unposed:
        remarks.append(f"{some(unposed, 'image')} without a pose: not used as references.")
    lost = set(unposed)
    return [record for record in apart if record.image not in lost], remarks


def _view(kapture: Kapture, root: Path, record: Record) -> View:
    nanoseconds = abs(record.timestamp) >= _MIN_NANOSECONDS
    return View(
        name=record.image,
        camera=kapture.cameras[record.device],
        path=_file(root, record),
        cam_from_map=kapture.pose(record.timestamp, record.device),
        timestamp_s=record.timestamp / 1e9 if nanoseconds else None,
    )


def _references(kapture: Kapture, root: Path, records: Sequence[Record], options: FrontendOptions) -> tuple[View, ...]:
    """Views whose points are triangulated with other views, those of the same rig and time first."""
    by_rig: dict[tuple[int, str], list[int]] = {}
    for index, record in enumerate(records):
        for rig in kapture.carriers(record.device):
            by_rig.setdefault((record.timestamp, rig), []).append(index)
    together = [
        list(dict.fromkeys(at for rig in sorted(kapture.carriers(one.device)) for at in by_rig[one.timestamp, rig]))
        for one in records
    ]
    return with_triangulation([_view(kapture, root, record) for record in records], options, together)
