"""A folder of recordings as its writers see it: runs become files and rows, killed ones are recovered, old ones go."""

import contextlib
import json
import re
import shutil
import subprocess
import threading
import unicodedata
import uuid
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Self

from spherloc.diagnosis import Diagnosis
from spherloc.errors import RecordingError
from spherloc.experiments.sweep import Job, SweepPlan
from spherloc.trace import Trace
from spherloc_viz.given_files import REVIEW_SUFFIX
from spherloc_viz.options import json_text
from spherloc_viz.recording.index.query import PAGE_KEPT, RunQuery
from spherloc_viz.recording.index.run_index import RunIndex
from spherloc_viz.recording.origin import Origin, Source
from spherloc_viz.recording.rerun_program import rerun_command, rerun_environment
from spherloc_viz.recording.reviews import has_review
from spherloc_viz.recording.run_row import RunRow
from spherloc_viz.recording.run_summary import problem_key
from spherloc_viz.recording.sandbox.examiner import Examiner, ExaminerError, Examiners, examine_review
from spherloc_viz.recording.storage.room import GALLERY, KEEP_BYTES, size_words
from spherloc_viz.recording.storage.unfinished import here, leftovers, target_of, unfinished

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


NEWEST_KEPT = 20
"""Number of the newest runs that are never deleted, since they may be in use."""
LOG_NAME = "pruned.log"
"""File in the folder of the recordings with a line for every deleted run."""
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


def prune_pages(folder: Path, index: RunIndex) -> None:
    """Delete the oldest runs of pages beyond ``PAGE_KEPT``, right or wrong, unless they were labelled or noted.

    Every deletion is first written into ``pruned.log``. Raises ``RecordingError`` if index or log cannot be used.
    """
    for row in index.old_page_runs(PAGE_KEPT):
        _delete(folder / row.file, row)
        if not (folder / row.file).exists():
            index.remove(row.file)


def prunable(row: RunRow) -> bool:
    """Whether a run may be deleted to make room: it is right or nothing speaks against it, and it has no label."""
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


CHECKS = 50
"""The size of all recordings is looked at when a new part of it, one of so many, was written."""


class RecordingStore:
    """Writes runs into a folder, here and now. Any number of threads and processes may write into the same one."""

    def __init__(
        self,
        folder: Path,
        on_notice: Callable[[str], None],
        full: bool = False,
        keep_bytes: int | None = KEEP_BYTES,
    ) -> None:
        """``on_notice`` gets a sentence for people now and then; ``full`` keeps every arc and edge.

        ``keep_bytes`` is the size limit of the recordings; with None nothing is deleted here. Nothing is opened yet.
        """
        self.folder = Path(folder)
        self._notice, self._full, self._keep_bytes = on_notice, full, keep_bytes
        self._lock = threading.Lock()
        self._index: RunIndex | None = None
        self._examiners = Examiners()
        self._closed = False
        self._unlisted = 0
        """Recordings whose rows could not be stored; the next refresh finds them."""
        self._unchecked_bytes: float = float("inf")
        self._told_over = False

    @property
    def index(self) -> RunIndex:
        """The list of the folder's runs. Raises ``RecordingError`` if it cannot be opened."""
        with self._lock:
            if self._closed:
                raise RecordingError(f"{self.folder}: the list of runs is closed.")
            if self._index is None:
                self._index = RunIndex(self.folder, self._notice)
            return self._index

    def known(self, trace: Trace, source: Source) -> Path | None:
        """The recording of the very same run from this source, if there is one.

        The same are problem, estimator, options, seed and the number of inliers. Raises ``RecordingError``.
        """
        options = json_text(asdict(trace.options))
        key, inliers = problem_key(trace.problem), int(trace.inlier_mask.sum())
        file = self.index.same_run(source, key, trace.estimator, options, trace.seed, inliers)
        return None if file is None or not (self.folder / file).exists() else self.folder / file

    def path_of(self, trace: Trace) -> Path:
        """A new path for the recording of a run."""
        return self.folder / file_name(trace, datetime.now(UTC))

    def record(
        self,
        trace: Trace,
        origin: Origin | None = None,
        diagnosis: Diagnosis | None = None,
        path: Path | None = None,
        run_id: str | None = None,
    ) -> Path:
        """Write a run, list it, and make room if it is time to; returns the recording's path.

        A run that is recorded anew, to the same ``path`` and with the same ``run_id``, keeps its labels and note.
        Raises ``RecordingError`` if it cannot be written. What else fails is a notice: the recording is there.
        """
        # Here, since it imports rerun, which takes a quarter of a second: a page should not wait for it.
        from spherloc_viz.recording.content.writer import write_recording

        path = self.path_of(trace) if path is None else path
        row = write_recording(trace, path, origin, diagnosis, self._full, run_id)
        if has_review(path):
            with contextlib.suppress(RecordingError):  # a refresh of the list tells of it
                review = examine_review(path)
                row = replace(row, labels=review.labels, note=review.note)
        try:
            self.index.add(row)
            self._unlisted = 0
        except RecordingError as error:
            self._unlisted += 1
            if self._unlisted == 1:
                self._notice(f"A run is recorded, but not listed: {error}")
        if row.source == "page":
            with contextlib.suppress(RecordingError):  # it is tried again with the next one
                prune_pages(self.folder, self.index)
        self._unchecked_bytes += row.size_bytes
        if self._keep_bytes is not None and self._unchecked_bytes > self._keep_bytes / CHECKS:
            with contextlib.suppress(RecordingError):  # it is tried again, and the failing index was spoken of
                self.prune()
        return path

    def delete(self, path: Path) -> bool:
        """Delete a recording of this folder, whose run was made anew; returns whether it is gone.

        One with labels or a note stays, as one that is not listed does. What is deleted is first written into
        ``pruned.log``. Raises ``RecordingError`` if the index or the log cannot be used.
        """
        row = self.index.get(path.name) if path.parent.resolve() == self.folder.resolve() else None
        if row is not None and not (row.labels or row.note or row.title):
            _delete(path, row)
        gone = not path.exists()
        if gone and row is not None:
            self.index.remove(row.file)
        return gone

    def prune(self) -> None:
        """Delete the oldest successes beyond the size that may be kept, and say so.

        Raises ``RecordingError`` if the index or the log of deletions cannot be used.
        """
        if self._keep_bytes is None:
            return
        self._unchecked_bytes = 0.0
        done = prune(self.folder, self.index, self._keep_bytes)
        if done.sentence:
            self._notice(done.sentence)
        self._tell_over(done)

    def tidy(self) -> None:
        """Recover what killed processes left unfinished, or rename it, and say so.

        Raises ``OSError``, or ``ExaminerError`` if nothing can be read or this is ended meanwhile.
        """
        folders = [folder for folder in (self.folder, self.folder / GALLERY) if folder.is_dir()]
        found = [part for folder in folders for part in leftovers(folder)]
        with self._examiners.start(1) as (examiner,):
            recovered = [recover(part, examiner) for part in found]
        saved = [done.recording for done in recovered if done.recording is not None]
        kept = [done.kept for done in recovered if done.kept is not None]
        if saved:
            runs = "a run" if len(saved) == 1 else f"{len(saved)} runs"
            self._notice(f"Recovered the recording of {runs} that was not finished: {_names(saved)}.")
        if kept:
            files = "An unfinished file" if len(kept) == 1 else f"{len(kept)} unfinished files"
            self._notice(
                f"{files} of a killed process cannot be recovered, kept as {_names(kept)} in {kept[0].parent}: "
                "delete what you do not need."
            )

    def end_reading(self) -> None:
        """Read no more recordings, in whatever thread that happens; runs can still be recorded."""
        self._examiners.close()
        with self._lock:
            index = self._index
        if index is not None:
            index.examiners.close()

    def close(self) -> None:
        """Close the list of runs; nothing else can be recorded after that."""
        self._examiners.close()
        with self._lock:
            self._closed = True
            if self._index is not None:
                self._index.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _tell_over(self, done: Pruned) -> None:
        if done.over and not self._told_over:
            self._notice(
                f"The recordings take {size_words(done.left_bytes)}, more than {size_words(done.keep_bytes)}, and only "
                "failures, labelled and new ones are left; delete some, or keep more gigabytes."
            )
        self._told_over = done.over


def file_name(trace: Trace, now: datetime) -> str:
    """``<UTC time>_<scene>_<estimator>_<seed>_<id>.rrd``: sorts by time, is unique, and is safe in any file system."""
    when = now.strftime("%Y%m%dT%H%M%SZ")
    return _name_of(trace, when, uuid.uuid4().hex[:8])


def sweep_file_name(trace: Trace, run_id: uuid.UUID) -> str:
    """``sweep_<scene>_<estimator>_<seed>_<id>.rrd``: the same name for the same run, whenever it is done."""
    return _name_of(trace, "sweep", run_id.hex[:16])


def _name_of(trace: Trace, first: str, last: str) -> str:
    return f"{first}_{_slug(trace.problem.name)}_{_slug(trace.estimator)}_{trace.seed}_{last}.rrd"


def _names(paths: Sequence[Path]) -> str:
    return ", ".join(path.name for path in paths[:3]) + (" and more" if len(paths) > 3 else "")


def _slug(text: str) -> str:
    ascii_text = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode()
    return re.sub(r"[^a-z0-9]+", "-", ascii_text.lower()).strip("-")[:60] or "run"


@dataclass(frozen=True)
class SweepStore:
    """Keeps the runs of all workers on the machine where it was made; others cannot reach its folder.

    A run that is done again, because its worker was killed or its sweep interrupted, replaces its own recording.
    Nothing is deleted to make room: that is for one process to do, which has a ``RecordingStore``.
    """

    folder: Path
    """Absolute path of the recordings' folder."""
    machine: str = field(default_factory=here)
    """Where it was made."""

    def __call__(self, plan: SweepPlan, job: Job, trace: Trace) -> str:
        """Record a run; returns why that failed, in a sentence."""
        if here() != self.machine:
            return ""
        origin = Origin("sweep", plan.scene, plan.first_seed + job.run, None, plan.variation_at(job.value))
        store, told = _store(self.folder)
        try:
            run_id = sweep_run_id(plan, job)
            store.record(trace, origin, path=self.folder / sweep_file_name(trace, run_id), run_id=str(run_id))
        except RecordingError as error:
            return str(error)
        except Exception as error:  # a bug in drawing one run must not end the sweep
            return f"{plan.place(job)}: the run cannot be recorded: {error!r}."
        sentence = " ".join(told)
        told.clear()
        return sentence


def sweep_run_id(plan: SweepPlan, job: Job) -> uuid.UUID:
    """What tells a run of a sweep from others: a hash of all that decides its result."""
    table = plan.record()
    shared = {name: table[name] for name in ("scene", "scene_sha256", "camera_sha256", "versions")}
    own = {
        "variation": plan.variation_at(job.value).simulation,
        "estimator": table["entrants"][job.entrant],
        "seed": plan.first_seed + job.run,
    }
    return uuid.uuid5(uuid.NAMESPACE_URL, json.dumps(shared | own, sort_keys=True))


@lru_cache(maxsize=1)
def _store(folder: Path) -> tuple[RecordingStore, list[str]]:
    """This process's own, and what it has to say."""
    told: list[str] = []
    return RecordingStore(folder, told.append, keep_bytes=None), told
