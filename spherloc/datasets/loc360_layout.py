"""Recognizes a hall of 360Loc by the names of its folders.

A hall has a folder ``mapping`` of sequences of panoramas, and folders of queries; a sequence is a folder with
``camera_pose.json`` and a folder ``image``. Imports nothing large, so that a command says at once what a folder is.
"""

from pathlib import Path

from spherloc.errors import InputError
from spherloc.files import is_file, is_folder, names_in

MAPPING, POSES, IMAGES = "mapping", "camera_pose.json", "image"


def is_hall(path: Path) -> bool:
    """Whether a folder has a mapping sequence of 360Loc."""
    mapping = path / MAPPING
    if not is_folder(mapping):
        return False
    try:
        inside = names_in(mapping)
    except InputError:
        return False
    return any(is_file(folder / POSES) for folder in (mapping, *(mapping / name for name in inside)))
