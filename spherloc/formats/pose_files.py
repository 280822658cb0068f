"""Poses that other programs found: hloc's results or log, a CSV, or a COLMAP model."""

import csv
import io
from pathlib import Path

from spherloc.errors import InputError, show
from spherloc.files import is_folder, read_file, reading
from spherloc.formats.colmap_files import read_model
from spherloc.formats.hloc_files import read_results
from spherloc.formats.hloc_log import is_log, read_log_poses
from spherloc.formats.text_rows import pose_from_words
from spherloc.types import FloatArray

NUMBERS = ("qw", "qx", "qy", "qz", "tx", "ty", "tz")
MAX_BYTES = 200_000_000


def read_poses(path: Path) -> dict[str, FloatArray]:
    """Poses ``cam_from_map`` (3, 4) by the name of their image.

    From a CSV with the columns name, qw, qx, qy, qz, tx, ty, tz in any order among others, from hloc's lines
    ``name qw qx qy qz tx ty tz``, from hloc's log, or from the folder of a COLMAP model. Raises ``InputError``, which
    names the line, for any other file.
    """
    if is_folder(path):
        return {name: image.cam_from_map for name, image in read_model(path).images.items()}
    if is_log(path):
        return read_log_poses(path)
    if path.suffix.lower() != ".csv":
        return read_results(path)
    return _read_csv(path)


def _read_csv(path: Path) -> dict[str, FloatArray]:
    with reading(path, "give a CSV of poses"):
        text = read_file(path, MAX_BYTES).decode("utf-8-sig", errors="replace")
    lines = csv.reader(io.StringIO(text, newline=""))
    poses: dict[str, FloatArray] = {}
    try:
        head = [word.strip().lower() for word in next(lines, [])]
        missing = [name for name in ("name", *NUMBERS) if name not in head]
        if missing:
            raise InputError(f"{path}: its first line has no column {missing[0]}; give name, {', '.join(NUMBERS)}.")
        for row in lines:
            if not any(cell.strip() for cell in row):
                continue
            place = f"{path}, line {lines.line_num}"
            if len(row) != len(head):
                raise InputError(f"{place}: has {len(row)} cells; its first line has {len(head)}.")
            cells = dict(zip(head, (cell.strip() for cell in row), strict=True))
            if cells["name"] in poses:
                raise InputError(f"{place}: {show(cells['name'])} has two poses; remove one line.")
            poses[cells["name"]] = pose_from_words([cells[name] for name in NUMBERS], place)
    except csv.Error as error:
        raise InputError(f"{path}, line {lines.line_num}: is not CSV ({error}); save it again.") from None
    return poses
