"""Files that the layout of a dataset demands."""

from pathlib import Path

from spherloc.errors import InputError
from spherloc.files import is_file


def needed_file(root: Path, name: str, where: str, what: str) -> Path:
    """A file that a dataset's layout demands; raises ``InputError`` that names it if it is missing.

    ``what`` says what it holds ("the calibration of image_02").
    """
    named = root / name
    if not is_file(named):
        raise InputError(f"{where}: {named} is missing, {what}; check that 'root' is the dataset's own folder.")
    return named
