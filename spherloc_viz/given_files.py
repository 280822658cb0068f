"""What tells recordings from other files, and whether files that somebody names are there.

Imports nothing large, so that a command says at once that a file is missing.
"""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from spherloc.errors import InputError, RecordingError, SpherlocError
from spherloc.files import is_file, is_folder, names_in

RECORDING = ".rrd"
RECORDINGS_FOLDER = "recordings"
"""Name of the folder of the recordings beside results."""
REVIEW_SUFFIX = ".review.rrd"
"""Ends the name of a review file, which otherwise is that of its run."""


def is_recording(path: Path) -> bool:
    """Whether a path that is given as a scene is that of a recording."""
    return path.suffix.lower() == RECORDING


def without_reviews(files: Sequence[Path]) -> tuple[Path, ...]:
    """What a shell's pattern such as ``*.rrd`` is meant to find; all if there is nothing but labels and notes."""
    return tuple(file for file in files if not file.name.endswith(REVIEW_SUFFIX)) or tuple(files)


def check_recording_file(path: Path) -> None:
    """Raise ``RecordingError`` if there is no such file, or if it is known to be of another kind."""
    if is_folder(path):
        from spherloc.datasets.given_path import what_it_is

        raise RecordingError(what_it_is(path))
    if not is_recording(path) and (told := known_as(path)):
        raise RecordingError(told)
    if not is_file(path):
        raise RecordingError(f"{path}: no such file; give the path of a recording (.rrd).")


def check_recordings_folder(folder: Path) -> None:
    """Raise ``InputError`` if there is no such folder of recordings, or if it is known to be one of something else."""
    if not is_folder(folder):
        raise InputError(
            known_as(folder) or f"{folder}: no such folder of recordings; run a scene first, or name another folder."
        )
    if not _may_have_recordings(folder) and (told := known_as(folder)):
        raise InputError(told)


def known_as(path: Path) -> str:
    """What a path is and which command takes it, if that is known; else empty."""
    from spherloc.datasets.given_path import known_as  # only where it is needed: it takes a tenth of a second

    return known_as(path)


def no_such_name(name: str, error: InputError) -> InputError:
    """The ``error`` about a name that is not known, or, if it is the path of something, what that is."""
    told = known_as(Path(name))
    return InputError(told) if told else error


def _may_have_recordings(folder: Path) -> bool:
    """Whether a folder, or one in it or in that, has recordings or a folder of that name, where results have them."""
    names = names_in(folder)
    if RECORDINGS_FOLDER in names or any(name.endswith(RECORDING) for name in names):
        return True
    for name in names:
        inside = names_in(folder / name) if is_folder(folder / name) else []
        if RECORDINGS_FOLDER in inside or any(one.endswith(RECORDING) for one in inside):
            return True
    return False


def check_scene_file(path: Path) -> None:
    """Raise ``SpherlocError`` if there is no such scene file or recording."""
    if is_recording(path):
        check_recording_file(path)
        return
    from spherloc.datasets.scene_file import check_there

    check_there(path)


def none_there(paths: Sequence[Path], check: Callable[[Path], None]) -> bool:
    """Whether ``check`` refuses all of one or more files, which is then said of each on stderr."""
    refusals: list[str] = []
    for path in paths:
        try:
            check(path)
        except SpherlocError as error:
            refusals.append(f"spherloc: {error}")
        else:
            return False
    if refusals:
        print("\n".join(refusals), file=sys.stderr, flush=True)
    return bool(refusals)
