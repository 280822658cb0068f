"""``spherloc runs``, ``label`` and ``reindex``: the list of recorded runs on the command line."""

import time
from collections.abc import Sequence
from pathlib import Path

from spherloc import registry
from spherloc.diagnosis import Cause
from spherloc.errors import InputError, show
from spherloc_viz.progress import progress, say
from spherloc_viz.recording.index import RunIndex
from spherloc_viz.recording.index_refresh import Refreshed
from spherloc_viz.recording.query import GROUP_KEYS, OUTCOMES, SORT_KEYS, SOURCES, RunQuery
from spherloc_viz.recording.review import read_review
from spherloc_viz.recording.strangers import examine
from spherloc_viz.run_table import counts_text, rows_text

SORT_WORDS = {
    "outliers": "outlier_rate",
    "rotation-error": "rotation_error_deg",
    "position-error": "translation_error_m",
    "time": "time_ms",
    "size": "size_bytes",
}
"""What the command line calls some of the sort keys."""
UNDIAGNOSED = "none"
"""What is typed for runs that were not diagnosed."""
TABLE_LIMIT = 50
GALLERY = "gallery"
"""A folder of recordings that is listed with the folder that it is in."""


def open_index(folder: Path) -> RunIndex:
    """The index of a folder; raises ``InputError`` if there is no such folder."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder of recordings; run a scene first, or name another folder.")
    return RunIndex(folder, say)


def print_runs(folder: Path, query: RunQuery, group: str | None, limit: int | None, form: str) -> int:
    """List the runs of a folder; returns the exit code. Recordings that are new or have changed are read first."""
    with open_index(folder) as index:
        refreshed = _read_files(index, everything=False)
        if refreshed.skipped:
            file, sentence = refreshed.skipped[0]
            say(f"{_count(len(refreshed.skipped), 'file')} left out, such as {file}; spherloc reindex names all.")
        _check_known(index, query)
        if group is not None:
            key = _one_of("group", group, tuple(name.replace("_", "-") for name in GROUP_KEYS)).replace("-", "_")
            print(counts_text(group, index.groups(query, key), form), end="")
            return 0
        most = (TABLE_LIMIT if form == "table" else None) if limit is None else limit or None
        found = index.find(query, most)
        print(rows_text(folder, found.rows, form), end="", flush=True)
        if form == "table":
            _say_total(index, len(found.rows), found.total)
    return 0


def _say_total(index: RunIndex, shown: int, total: int) -> None:
    if not total:
        known = index.find(RunQuery(), 1).total
        say(f"no run matches; {index.folder} has {_count(known, 'run')}.")
    elif shown < total:
        say(f"{shown:,} of {total:,} runs; --limit 0 shows all.")


def _read_files(index: RunIndex, everything: bool) -> Refreshed:
    """Bring the index up to date, and show how far it is."""
    with _Bar() as bar:
        return index.rebuild(bar.advance) if everything else index.refresh(bar.advance)


class _Bar:
    """A progress line that learns from its first call how much there is to do."""

    def __enter__(self) -> "_Bar":
        self._lines = None
        self._done = 0
        return self

    def advance(self, done: int, total: int) -> None:
        if self._lines is None and total:
            self._lines = progress(total, "recordings")
            self._step = self._lines.__enter__()
        for _ in range(done - self._done):
            self._step("")
        self._done = done

    def __exit__(self, *exception: object) -> None:
        if self._lines is not None:
            self._lines.__exit__(None, None, None)


def _count(count: int, noun: str) -> str:
    return f"1 {noun}" if count == 1 else f"{count:,} {noun}s"
