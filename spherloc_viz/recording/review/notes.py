"""Labels and a note that a reviewer gives a run: a small recording beside it, which Rerun shows together with it."""

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from spherloc.errors import InputError, RecordingError, show

REVIEW_SUFFIX = ".review.rrd"
"""Ends the name of a review file, which otherwise is that of its run."""
MOST_LABELS = 20
MOST_LABEL_CHARACTERS = 40
MOST_NOTE_CHARACTERS = 4_000
MOST_BYTES = 1 << 20
"""Of a review file, which has 6 kB and the text."""
UNREADABLE = "labels and note cannot be read; delete the file and label the run again."


@dataclass(frozen=True)
class Review:
    """What a reviewer said about a run."""

    labels: tuple[str, ...] = ()
    """Words, each once."""
    note: str = ""
    """Text, of several lines perhaps."""


def checked_review(labels: Sequence[str], note: str) -> Review:
    """Labels and a note as they are stored: without spaces around them, no label twice, no control characters.

    Raises ``InputError`` if there are more or longer ones than are stored.
    """
    clean = tuple(dict.fromkeys(label for label in (_line(text) for text in labels) if label))
    if len(clean) > MOST_LABELS:
        raise InputError(f"{len(clean)} labels are too many for a run: give at most {MOST_LABELS}.")
    for label in clean:
        if len(label) > MOST_LABEL_CHARACTERS:
            raise InputError(f"the label {show(label)} is too long: give at most {MOST_LABEL_CHARACTERS} characters.")
    text = "\n".join(_printable(line).rstrip() for line in note.splitlines()).strip()
    if len(text) > MOST_NOTE_CHARACTERS:
        raise InputError(f"a note of {len(text)} characters is too long: give at most {MOST_NOTE_CHARACTERS}.")
    return Review(clean, text)


def _line(text: str) -> str:
    return " ".join(_printable(text).split())


def _printable(text: str) -> str:
    return "".join(character if character.isprintable() else " " for character in text)


def review_path(recording: Path) -> Path:
    """The review file of a recording, whether or not there is one."""
    return recording.with_name(recording.name.removesuffix(".rrd") + REVIEW_SUFFIX)


def reviewed_name(name: str) -> str:
    """The name of the recording whose review file has this name."""
    stem = name.removesuffix(REVIEW_SUFFIX)
    # "a.RRD" is a recording too, and keeps its ending.
    return stem if stem.lower().endswith(".rrd") and not stem.endswith(".rrd") else f"{stem}.rrd"


def has_review(recording: Path) -> bool:
    """Whether there is a review file; none has a name that is too long for the disk."""
    try:
        review_path(recording).stat()
    except OSError:
        return False
    return True


def write_review(recording: Path, labels: Sequence[str], note: str, run_id: str | None = None) -> Review:
    """Store labels and a note beside a recording, in place of those before, and return them as they are stored.

    Without any, the file is removed. ``run_id`` is that of the recording, which is read if it is not given. A reader
    never sees half a file. Raises ``InputError`` if they are too long, ``RecordingError`` if they cannot be written.
    """
    # Here, as lists of runs need only names and limits of this file, and rerun takes a second to load.
    from spherloc_viz.recording.review.file import recording_id, write_file
    from spherloc_viz.recording.storage.leftovers import unfinished

    review = checked_review(labels, note)
    path = review_path(Path(recording))
    part = unfinished(path)
    try:
        if review == Review():
            path.unlink(missing_ok=True)
            return review
        write_file(part, review.labels, review.note, run_id or recording_id(Path(recording)))
        part.replace(path)
    except (OSError, RuntimeError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise RecordingError(
            f"{path}: labels and note cannot be stored ({reason}); make room or check the folder."
        ) from error
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
    return review


def read_review(recording: Path) -> Review:
    """Labels and note of a recording; empty if it has none.

    Raises ``RecordingError``, in one sentence, if the file that has them is damaged.
    """
    path = review_path(Path(recording))
    if not has_review(Path(recording)):
        return Review()
    from spherloc_viz.recording.review.file import read_file

    damaged = RecordingError(f"{path}: {UNREADABLE}")
    try:
        if not path.is_file() or path.stat().st_size > MOST_BYTES:
            raise damaged
        return checked_review(*read_file(path, MOST_LABELS))
    except (OSError, RuntimeError, ValueError, TypeError, LookupError, AttributeError, InputError) as error:
        raise damaged from error
