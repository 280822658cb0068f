"""Files that the layout of a dataset demands."""

from collections.abc import Callable
from pathlib import Path

from spherloc.errors import InputError


def needed_file(root: Path, name: str, where: str, what: str) -> Path:
    """A file that a dataset's layout demands; raises ``InputError`` that names it if it is missing.

    ``what`` says what it holds ("the calibration of image_02").
    """
    named = root / name
    if not is_there(named.is_file):
        raise InputError(f"{where}: {named} is missing, {what}; check that 'root' is the dataset's own folder.")
    return named


def is_there(test: Callable[[], bool]) -> bool:
    """What ``path.is_file`` or ``path.is_dir`` says; False also for a path that the system cannot even look up."""
    try:
        return test()
    except (OSError, ValueError):  # too long, or with a zero byte
        return False
