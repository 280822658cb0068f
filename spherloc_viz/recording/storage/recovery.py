"""Makes recordings of what killed processes left unfinished."""

import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

from spherloc.errors import RecordingError
from spherloc_viz.given_files import REVIEW_SUFFIX
from spherloc_viz.recording.rerun_program import rerun_command, rerun_environment
from spherloc_viz.recording.sandbox.examiner import Examiner, ExaminerError
from spherloc_viz.recording.storage.unfinished import target_of, unfinished

UNREADABLE_SUFFIX = ".unreadable"
"""Ends the name of what was left unfinished and cannot be read; it began with the name that the file was to have."""
ROOM = 4
"""A recovered recording takes up to twice the room of what it is made of, since it is packed less tightly."""
MERGE_LIMIT_S = 60.0
"""rerun takes a twentieth of a second; one that takes this long has got stuck."""


@dataclass(frozen=True)
class Recovered:
    """What became of a leftover."""

    recording: Path | None = None
    """The recording that was made of it."""
    kept: Path | None = None
    """Where it lies now if none could be made of it."""


def recover(part: Path, examiner: Examiner) -> Recovered:
    """Make a recording of what is left of one, if there is enough; otherwise rename it, so that a person can decide.

    The problem and the result come first in a file, so that even a fifth of it has all that repeats the run. The
    leftover stays as it is if the disk has no room to recover it; deleted are only an empty one, and one of a run whose
    recording is there and can be read. Raises ``OSError`` if the folder cannot be written, ``ExaminerError`` if
    ``examiner`` has ended: the leftover stays then too.
    """
    target = target_of(part)
    if target is None:
        return Recovered()
    mended = unfinished(target)
    try:
        if not part.stat().st_size:
            part.unlink()
            return Recovered()
        is_run = not target.name.endswith(REVIEW_SUFFIX)
        if is_run and target.exists() and _readable(target, examiner):
            part.unlink()
            return Recovered()
        if is_run and not target.exists():
            if _readable(part, examiner):
                return Recovered(part.replace(target))
            if shutil.disk_usage(part.parent).free < ROOM * part.stat().st_size:
                return Recovered()
            if _merged(part, mended) and _readable(mended, examiner):
                mended.replace(target)
                part.unlink()
                return Recovered(target)
        number = part.name.removesuffix(".part")[-8:]  # tells leftovers of one file apart
        return Recovered(kept=part.replace(part.with_name(f"{target.name}.{number}{UNREADABLE_SUFFIX}")))
    except FileNotFoundError:
        return Recovered()  # another process has done it meanwhile
    finally:
        mended.unlink(missing_ok=True)


def _readable(path: Path, examiner: Examiner) -> bool:
    """Whether it is whole. What a power cut leaves can end the process that reads it, so another one does."""
    try:
        examiner.examine(path)
    except ExaminerError:
        raise  # says nothing about the file
    except RecordingError:
        return False
    return True


def _merged(part: Path, mended: Path) -> bool:
    """Whether rerun could save what is whole at the start of ``part``."""
    command = [*rerun_command(), "rrd", "merge", "--continue-on-error", str(part), "-o", str(mended)]
    try:
        done = subprocess.run(command, capture_output=True, check=False, timeout=MERGE_LIMIT_S, env=rerun_environment())
    except subprocess.SubprocessError:
        return False
    return done.returncode == 0 and mended.is_file()
