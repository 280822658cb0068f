"""``spherloc runs``, ``label`` and ``reindex``: the list of recorded runs on the command line."""

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from spherloc import registry
from spherloc.diagnosis import Cause
from spherloc.errors import InputError, RecordingError, show
from spherloc.files import is_folder, names_in
from spherloc_viz.commands.flags import RECORDINGS
from spherloc_viz.commands.progress import progress, say
from spherloc_viz.given_files import check_recording_file, check_recordings_folder, is_recording
from spherloc_viz.recording.index.query import GROUP_KEYS, OUTCOMES, SORT_KEYS, SOURCES, RunQuery
from spherloc_viz.recording.index.refresher import Progress, Refreshed
from spherloc_viz.recording.index.run_index import RunIndex
from spherloc_viz.recording.index.run_text import counts_text, rows_text
from spherloc_viz.recording.reviews import Review, checked_review
from spherloc_viz.recording.run_row import RunRow
from spherloc_viz.recording.sandbox.examiner import examine, examine_review
from spherloc_viz.recording.storage.room import GALLERY

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
SCENES_NAMED = 8
MANY = 500
"""Recordings whose steps take more than some seconds to be read."""


def print_runs(folder: Path, query: RunQuery, group: str | None, limit: int | None, form: str) -> int:
    """List the runs of a folder; returns the exit code. Recordings that are new or have changed are read first.

    Raises ``InputError`` for a folder or group that there is not, and for values that no run can have.
    """
    most = _limit(limit, form)
    key = None if group is None else one_of("group", group.replace("-", "_"), GROUP_KEYS)
    if not _has_recordings(folder) and _has_recordings(folder / RECORDINGS):
        folder = folder / RECORDINGS  # of results that spherloc localize has written
    with _open(folder) as index:
        _refresh(index)
        _check_known(index, query)
        if key is not None:
            counts = index.groups(query, key)
            print(counts_text(key, counts, form), end="", flush=True)
            if not counts:
                say(f"no run of those that are asked for has a {show(group)}.")
            return 0
        found = index.find(query, most)
        print(rows_text(folder, found.rows, form), end="", flush=True)
        if not found.total:
            say(f"no run matches, of {_count(index.find(RunQuery(), 1).total, 'run')} in {folder}.{_elsewhere(folder)}")
        elif len(found.rows) < found.total:
            say(f"{len(found.rows):,} of {found.total:,} runs; --limit 0 shows all.")
    return 0


def _has_recordings(folder: Path) -> bool:
    return is_folder(folder) and any(name.endswith(".rrd") for name in names_in(folder))


def _elsewhere(folder: Path) -> str:
    """Where runs are that ``spherloc localize`` has recorded beside its results."""
    places = [folder / name / RECORDINGS for name in names_in(folder)]
    found = [place for place in places if _has_recordings(place)]
    return f" There are others in {', '.join(map(str, found[:3]))}{', …' if len(found) > 3 else ''}." if found else ""


def print_steps(folder: Path, condition: str, limit: int | None, form: str) -> int:
    """List the steps of a folder's runs for which a condition holds; returns the exit code.

    Raises ``InputError`` for a condition that cannot be understood, and as ``print_runs`` does.
    """
    from spherloc_viz.recording.index.steps import checked_condition, find_steps, steps_text

    most = _limit(limit, form)
    checked_condition(condition)
    with _open(folder) as index:
        _refresh(index, index.examine)  # rerun's catalog reads them in this process
        rows = index.find(RunQuery(), None).rows
    if len(rows) > MANY:
        say(f"reading the steps of {len(rows):,} recordings.")
    steps = find_steps(folder, rows, condition, None if most is None else most + 1)
    found = steps.found
    print(steps_text(folder, found[:most], form), end="", flush=True)
    if steps.refused:
        files = _count(len(steps.refused), "recording")
        say(f"{files} left out, such as {show(steps.refused[0])}: rerun cannot read it beside the others.")
    if not found:
        say(f"no step matches in {_count(len(rows), 'run')} of {folder}.")
    elif most is not None and len(found) > most:
        say(f"the first {_count(most, 'step')}; --limit 0 shows all.")
    return 0


def label_runs(paths: Sequence[Path], add: Sequence[str], remove: Sequence[str], note: str | None) -> int:
    """Change labels and note of recordings, and print what they are then; returns the exit code.

    A wrong file is reported and the others are still labelled.
    """
    if not paths:
        raise InputError("no recording given; name one or more (.rrd), as spherloc runs lists them.")
    checked_review(add, note or "")
    code = 0
    for path in paths:
        try:
            review = _label(path, add, remove, note)
        except RecordingError as error:
            say(str(error))
            code = 2
        else:
            labels = ", ".join(review.labels) or "no labels"
            print(f"{path}: {labels}" + (f"; note: {' '.join(review.note.split())}" if review.note else ""))
    return code


def _label(path: Path, add: Sequence[str], remove: Sequence[str], note: str | None) -> Review:
    check_recording_file(path)
    row, before = examine(path), examine_review(path)
    added, gone = checked_review(add, "").labels, checked_review(remove, "").labels
    for label in gone:
        if label not in (*before.labels, *added):
            raise RecordingError(f"{path}: has no label {show(label)}; it has {', '.join(before.labels) or 'none'}.")
    labels = [label for label in (*before.labels, *added) if label not in gone]
    in_gallery = path.parent.name == GALLERY
    with RunIndex(path.parent.parent if in_gallery else path.parent, say) as index:
        file = f"{GALLERY}/{path.name}" if in_gallery else path.name
        index.add(replace(row, file=file))
        return index.set_review(file, labels, before.note if note is None else note)


def reindex(folder: Path) -> int:
    """Read all recordings of a folder again; returns 1 if files had to be left out."""
    began = time.monotonic()
    with _open(folder) as index:
        done = _read_files(index.rebuild)
    for _, sentence in done.skipped:
        say(sentence)
    left_out = f", {_count(len(done.skipped), 'file')} left out" if done.skipped else ""
    gone = f", {_count(done.removed, 'run')} gone" if done.removed else ""
    print(f"{_count(done.read, 'run')} in {folder}, read in {time.monotonic() - began:.1f} s{left_out}{gone}.")
    return 1 if done.skipped else 0


def sort_key(word: str) -> str:
    """The sort key that a word of the command line means; raises ``InputError``, with all words, if it means none."""
    words = {next((name for name, own in SORT_WORDS.items() if own == key), key): key for key in SORT_KEYS}
    return words[one_of("sort", word, tuple(words))]


def diagnosis_of(text: str) -> str:
    """The diagnosis that a text means: any part of it that no other has, also with dashes for spaces.

    Raises ``InputError``, which names all, if it means none or several.
    """
    wanted = text.strip().casefold().replace("-", " ").replace("_", " ")
    if wanted == UNDIAGNOSED:
        return ""
    found = [cause.value for cause in Cause if wanted and wanted in cause.value]
    if wanted in found:
        return wanted
    if len(found) == 1:
        return found[0]
    return one_of("diagnosis", text, (*(cause.value for cause in Cause), UNDIAGNOSED))


def one_of(what: str, value: str, known: Sequence[str]) -> str:
    """``value`` if it is known; raises ``InputError``, which names those that are, if it is not."""
    if value in known:
        return value
    raise InputError(f"unknown {what} {show(value)}: choose one of {', '.join(known)}.")


def outcome_of(outcome: str | None, failed: bool) -> str | None:
    """The outcome that is asked for; raises ``InputError`` for an unknown one, or for two."""
    if failed and outcome not in (None, "failure"):
        raise InputError(f"--failed and --outcome {outcome} exclude each other: leave one out.")
    return "failure" if failed else None if outcome is None else one_of("outcome", outcome, OUTCOMES)


def source_of(source: str | None) -> str | None:
    """The source that is asked for; raises ``InputError`` for an unknown one."""
    return None if source is None else one_of("source", source, SOURCES)


def _check_known(index: RunIndex, query: RunQuery) -> None:
    """Raises ``InputError`` for a scene without runs, or an estimator that neither is registered nor has any."""
    if query.scene is not None and not index.find(RunQuery(scene=query.scene), 1).total:
        scenes = [name for name, _ in index.groups(RunQuery(), "scene")]
        known = "; ".join(scenes[:SCENES_NAMED]) + ("; and others" if len(scenes) > SCENES_NAMED else "")
        raise InputError(f"no run of scene {show(query.scene)}: there are {known or 'no runs at all'}.")
    if query.estimator is not None:
        recorded = (name for name, _ in index.groups(RunQuery(), "estimator"))
        one_of("estimator", query.estimator, tuple(dict.fromkeys((*registry.names("estimators"), *recorded))))


def rows_at(place: Path, query: RunQuery) -> tuple[Path, tuple[RunRow, ...]]:
    """The folder and the runs of a folder of recordings, of a set that the desk stored (.txt), or of one recording.

    Raises ``SpherlocError``, in one sentence, if there is no such thing or no run in it.
    """
    named: tuple[str, ...] | None = None
    folder = place
    if place.suffix == ".txt":
        from spherloc_viz.app.desk.files import read_set

        named, folder = read_set(place), place.parent.parent
    elif is_recording(place):
        check_recording_file(place)
        named, folder = (place.name,), place.parent
    with _open(folder) as index:
        _refresh(index)
        rows = index.find(replace(query, sort="file", descending=False), None).rows
        if named is not None:
            chosen = {row.file for row in rows}
            rows = tuple(row for row in index.of_files(named) if row.file in chosen)
    if not rows:
        raise InputError(f"{place}: has no such run; see spherloc runs {folder}.")
    return folder, rows


def _open(folder: Path) -> RunIndex:
    check_recordings_folder(folder)
    return RunIndex(folder, say)


def _limit(limit: int | None, form: str) -> int | None:
    """How many to list, None for all; raises ``InputError`` for a negative number."""
    if limit is None:
        return TABLE_LIMIT if form == "table" else None
    if limit < 0:
        raise InputError(f"--limit {limit} is negative: give how many to list, or 0 for all.")
    return limit or None


def _refresh(index: RunIndex, read: Callable[[Progress], Refreshed] | None = None) -> None:
    """Read what is new, by ``index.refresh`` if nothing else is given; files that are not runs are one line."""
    if skipped := _read_files(read or index.refresh).skipped:
        say(f"{_count(len(skipped), 'file')} left out, such as {show(skipped[0][0])}; spherloc reindex says why.")


def _read_files(read: Callable[[Progress], Refreshed]) -> Refreshed:
    """Bring the index up to date, and show how far it is."""
    with ExitStack() as stack:
        advance: Callable[[str], None] | None = None
        shown = 0

        def tell(done: int, total: int) -> None:
            nonlocal advance, shown
            if advance is None:  # only now it is known how many there are
                advance = stack.enter_context(progress(total, "recordings"))
            for _ in range(done - shown):
                advance("")
            shown = done

        return read(tell)


def _count(count: int, noun: str) -> str:
    return f"1 {noun}" if count == 1 else f"{count:,} {noun}s"
