"""What a reviewer says about a run, and the name of the file in which that is kept."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from spherloc.errors import InputError, show
from spherloc_viz.given_files import REVIEW_SUFFIX

MAX_LABELS = 20
MAX_LABEL_CHARACTERS = 40
MAX_NOTE_CHARACTERS = 4_000
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
    if len(clean) > MAX_LABELS:
        raise InputError(f"{len(clean)} labels are too many for a run: give at most {MAX_LABELS}.")
    for label in clean:
        if len(label) > MAX_LABEL_CHARACTERS:
            raise InputError(f"the label {show(label)} is too long: give at most {MAX_LABEL_CHARACTERS} characters.")
    text = "\n".join(_printable(line).rstrip() for line in note.splitlines()).strip()
    if len(text) > MAX_NOTE_CHARACTERS:
        raise InputError(f"a note of {len(text)} characters is too long: give at most {MAX_NOTE_CHARACTERS}.")
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
    return bool(file_stamp(review_path(recording)))


def file_stamp(path: Path) -> tuple[int, ...]:
    """Numbers that another file of this name does not have; empty if there is none, or its name is too long."""
    try:
        found = path.stat()
    except OSError:
        return ()
    return found.st_ino, found.st_mtime_ns, found.st_size
