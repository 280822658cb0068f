"""Makes recordings of what killed processes left unfinished."""

import contextlib
import subprocess
from pathlib import Path

from spherloc.errors import RecordingError
from spherloc_viz.recording.leftovers import target_of, unfinished
from spherloc_viz.recording.reader import read_recording
from spherloc_viz.recording.rerun_program import rerun_command, rerun_environment
from spherloc_viz.recording.review import REVIEW_SUFFIX

MERGE_LIMIT_S = 60.0
"""rerun takes a twentieth of a second; one that takes this long has got stuck."""


def rescue(part: Path) -> Path | None:
    """Make a recording of what is left of one, if there is enough; returns its path, or None.

    The problem and the result come first in a file, so that even a fifth of it has all that repeats the run. The
    leftover is gone afterwards, in either case. Raises ``OSError`` if the folder cannot be written.
    """
    target = target_of(part)
    if target is None:
        return None
    mended = unfinished(target)
    try:
        if target.exists() or target.name.endswith(REVIEW_SUFFIX):
            return None
        whole = part if _readable(part) else mended if _merged(part, mended) and _readable(mended) else None
        return None if whole is None else whole.replace(target)
    except FileNotFoundError:
        return None  # another process has done it meanwhile
    finally:
        mended.unlink(missing_ok=True)
        part.unlink(missing_ok=True)


def _readable(path: Path) -> bool:
    with contextlib.suppress(RecordingError):
        read_recording(path)
        return True
    return False


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
