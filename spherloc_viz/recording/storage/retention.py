"""What is kept: failures and what a reviewer labelled for ever, successes as long as there is room."""

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from spherloc.errors import RecordingError
from spherloc_viz.recording.index.query import RunQuery
from spherloc_viz.recording.index.run_index import RunIndex
from spherloc_viz.recording.reviews import has_review
from spherloc_viz.recording.run_row import RunRow
from spherloc_viz.recording.storage.room import size_words

NEWEST_KEPT = 20
"""The last runs stay whatever they are: somebody may be looking at them."""
LOG_NAME = "pruned.log"
"""In the folder of the recordings: a line for every run that was deleted."""
AT_ONCE = 50


@dataclass(frozen=True)
class Pruned:
    """What was deleted to make room."""

    files: tuple[str, ...]
    """Names of the recordings, the oldest first."""
    freed_bytes: int
    """Their size."""
    left_bytes: int
    """Size of those that are left."""
    keep_bytes: int
    """What they may have."""

    @property
    def over(self) -> bool:
        """Whether those that are left take more than they may, since none of them may be deleted."""
        return self.left_bytes > self.keep_bytes

    @property
    def sentence(self) -> str:
        """What was deleted, in a sentence; empty if nothing was."""
        if not self.files:
            return ""
        runs = "1 old success was" if len(self.files) == 1 else f"{len(self.files):,} old successes were"
        freed, most = size_words(self.freed_bytes), size_words(self.keep_bytes)
        return f"{runs} deleted ({freed}), since the recordings took more than {most}; {LOG_NAME} names them."


def prune(folder: Path, index: RunIndex, keep_bytes: int) -> Pruned:
    """Delete the oldest successes until the recordings in ``folder`` take no more than ``keep_bytes``.

    Failures stay, and whatever was labelled or noted, belongs to the gallery, or is doubtful without a truth to say
    more. Every deletion is first written into ``pruned.log``; where that cannot be, nothing is deleted. Any number of
    processes may do this at once. Raises ``RecordingError`` if index or log cannot be used.
    """
    left = index.bytes()
    if left <= keep_bytes:
        return Pruned((), 0, left, keep_bytes)
    deleted: list[RunRow] = []
    for row in _candidates(index):
        if left <= keep_bytes:
            break
        if _delete(folder / row.file, row):
            deleted.append(row)
        if not (folder / row.file).exists():
            index.remove(row.file)
        left = index.bytes()
    return Pruned(tuple(row.file for row in deleted), sum(row.size_bytes for row in deleted), left, keep_bytes)


def prunable(row: RunRow) -> bool:
    """Whether a run is one that nobody will look for: right, or nothing speaks against it, and nobody labelled it."""
    fine = row.outcome == "success" or (row.outcome == "unknown" and row.doubtful is False)
    marked = bool(row.labels or row.note or row.title)
    return fine and not marked and row.source != "gallery" and "/" not in row.file


def _candidates(index: RunIndex) -> Iterator[RunRow]:
    """Runs that may be deleted, the oldest first, each once. Those that are must leave the index too."""
    spared = {row.file for row in index.find(RunQuery(), limit=NEWEST_KEPT).rows}
    while rows := [row for row in index.oldest_successes(AT_ONCE + len(spared)) if row.file not in spared]:
        for row in rows:
            fit = prunable(row)
            if fit:
                yield row
            if not fit or (index.folder / row.file).exists():
                spared.add(row.file)


def _delete(path: Path, row: RunRow) -> bool:
    """Delete a recording; whether that was done, and here."""
    if not path.exists() or has_review(path):  # deleted or labelled since it was listed
        return False
    _log(path.parent / LOG_NAME, row)
    try:
        path.unlink()
    except OSError:
        return False
    return True


def _log(log: Path, row: RunRow) -> None:
    """Write down what is about to be deleted. Raises ``RecordingError`` if that cannot be done."""
    when = datetime.now(UTC).isoformat(timespec="milliseconds")
    cells = (when, row.file, row.name, row.estimator, f"seed {row.seed}", row.outcome, f"{row.size_bytes} bytes")
    line = "\t".join("".join(c if c.isprintable() else " " for c in cell) for cell in cells) + "\n"
    try:
        # One write to a file that is only appended to: lines of several processes do not mix.
        with log.open("ab", buffering=0) as file:
            file.write(line.encode())
    except OSError as error:
        raise RecordingError(
            f"{log}: cannot be written ({error.strerror or error}), so no old success is deleted; make room for it."
        ) from error
