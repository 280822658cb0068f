"""Makes recordings of what killed processes left unfinished."""

import shutil
import subprocess
from pathlib import Path

from spherloc.errors import RecordingError
from spherloc_viz.recording.keeping.leftovers import target_of, unfinished
from spherloc_viz.recording.review.notes import REVIEW_SUFFIX
from spherloc_viz.recording.strangers.child_process import ExaminerError
from spherloc_viz.recording.strangers.examiner import Examiner
from spherloc_viz.recording.viewing.rerun_program import rerun_command, rerun_environment

ROOM = 4
"""A recovered recording takes up to twice the room of what it is made of, since it is packed less tightly."""
MERGE_LIMIT_S = 60.0
"""rerun takes a twentieth of a second; one that takes this long has got stuck."""


def rescue(part: Path, examiner: Examiner) -> Path | None:
    """Make a recording of what is left of one, if there is enough; returns its path, or None.

    The problem and the result come first in a file, so that even a fifth of it has all that repeats the run. The
    leftover is gone afterwards, unless the disk has no room to recover it. Raises ``OSError`` if the folder cannot be
    written, ``ExaminerError`` if ``examiner`` has ended: the leftover stays then.
    """
    target = target_of(part)
    if target is None:
        return None
    mended = unfinished(target)
    try:
        if not target.exists() and not target.name.endswith(REVIEW_SUFFIX):
            if _readable(part, examiner):
                return part.replace(target)
            if shutil.disk_usage(part.parent).free < ROOM * part.stat().st_size:
                return None
            if _merged(part, mended) and _readable(mended, examiner):
                mended.replace(target)
                part.unlink()
                return target
        part.unlink()
        return None
    except FileNotFoundError:
        return None  # another process has done it meanwhile
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
    if not part.stat().st_size:
        return False
    command = [*rerun_command(), "rrd", "merge", "--continue-on-error", str(part), "-o", str(mended)]
    try:
        done = subprocess.run(command, capture_output=True, check=False, timeout=MERGE_LIMIT_S, env=rerun_environment())
    except subprocess.SubprocessError:
        return False
    return done.returncode == 0 and mended.is_file()
