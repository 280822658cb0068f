"""A recording from a stranger costs one sentence at worst: no process, no memory, and not the other recordings."""

import os
import re
import signal
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
import pytest
import rerun as rr
from hostile_recordings import (
    APPLICATION_ID,
    DATA,
    Change,
    alone,
    changed,
    message,
    packed,
    packed_as_format_1,
    places,
    unpacked,
    with_index,
    with_message,
)
from impossible_recordings import IMPOSSIBLE, PROBLEM, RUN, RUN_PROPERTY
from recording_samples import exact_run, lost_run, odd_problem, scene_problem
from rerun.chunk import Chunk, LazyChunkStream
from typing_extensions import TypeAliasType

from spherloc.errors import RecordingError
from spherloc.estimators import estimate
from spherloc_viz.recording.content.data import read_recording
from spherloc_viz.recording.content.writer import write_recording
from spherloc_viz.recording.review_file import write_review
from spherloc_viz.recording.reviews import Review, review_path
from spherloc_viz.recording.run_row import RunRow
from spherloc_viz.recording.sandbox import content_checks
from spherloc_viz.recording.sandbox import examiner as examiners
from spherloc_viz.recording.sandbox.child import FILE_LIMIT_BYTES
from spherloc_viz.recording.sandbox.examiner import Examiner, examine, examine_all
from tests.needs import needs
from tests.waiting import LIMIT_S

Lie = Callable[[Path], bytes]
"""A bad file from a good one."""


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("good") / "good.rrd"
    write_recording(estimate(scene_problem("mei_outliers_80"), "mc"), path)
    return path


@pytest.fixture(scope="module")
def examiner() -> Iterator[Examiner]:
    with Examiner() as examiner:
        yield examiner


def sentence(examiner: Examiner, path: Path) -> str:
    """What is said about a bad file: one sentence that begins with its path."""
    with pytest.raises(RecordingError) as error:
        examiner.examine(path)
    text = str(error.value)
    assert text.startswith(f"{path}: ") and text.endswith(".") and text.isprintable() and len(text) < 700
    return text.removeprefix(f"{path}: ")


def test_a_good_recording_passes_and_its_row_comes_back_whole(good: Path, examiner: Examiner) -> None:
    row = examiner.examine(good)
    assert row == read_recording(good).row
    assert row.file == good.name and row.correspondences == 100 and row.thumbnail.startswith(b"\x89PNG")


def test_every_sort_of_run_passes(examiner: Examiner, tmp_path: Path, rng: np.random.Generator) -> None:
    traces = [estimate(odd_problem(rng, turn), "ransac-2p") for turn in range(4)]
    for number, trace in enumerate([*traces, lost_run(), exact_run()]):
        path = tmp_path / f"{number}.rrd"
        written = write_recording(trace, path, full=number % 2 == 1)
        assert examiner.examine(path) == read_recording(path).row == written


def test_recordings_of_format_1_pass(examiner: Examiner, good: Path, tmp_path: Path) -> None:
    """They had no row of their own, and arrays in columns."""
    known = ("name", "scene", "estimator", "seed", "options", "outcome", "message", "inliers", "correspondences")

    def old_properties(row: Mapping[str, Any]) -> Mapping[str, Any]:
        return {name: row[name] for name in (*known, "created")} | {"format_version": pa.array([[1]])}

    def old_row(row: Mapping[str, Any]) -> Mapping[str, Any]:
        return packed_as_format_1(*unpacked(row))

    changes: dict[str, Change] = {RUN_PROPERTY: old_properties, PROBLEM: old_row, RUN: old_row}
    gone = ("/data/origin", "/data/diagnosis", "/__properties/thumbnail")
    path = changed(good, tmp_path / "old.rrd", changes | dict.fromkeys(gone, lambda row: None))
    row, now = examiner.examine(path), examiner.examine(good)
    assert (row.name, row.seed, row.inliers, row.created) == (now.name, now.seed, now.inliers, now.created)
    assert (row.diagnosis, row.thumbnail, row.format_version) == ("", b"", 1)


def test_labels_and_note_come_with_the_row(good: Path, examiner: Examiner, tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    path.write_bytes(good.read_bytes())
    write_review(path, ["look again", "ü & <b>"], "One line.\nAnother one.")
    row = examiner.examine(path)
    assert row.labels == ("look again", "ü & <b>") and row.note == "One line.\nAnother one."
    review = examiner.examine_review(path)
    assert (review.labels, review.note) == (row.labels, row.note)
    assert examiner.examine_review(good) == Review()


def test_a_run_is_still_a_run_when_its_labels_cannot_be_read(good: Path, examiner: Examiner, tmp_path: Path) -> None:
    path, deadly = tmp_path / "run.rrd", tmp_path / "deadly.rrd"
    path.write_bytes(good.read_bytes())
    deadly.write_bytes(ends_the_reader(good))
    write_review(path, ["seen"], "")
    review = review_path(path)
    for content in (b"", review.read_bytes()[:-40], deadly.read_bytes(), good.read_bytes()):
        review.write_bytes(content)
        assert examiner.examine(path).labels == ()
    with pytest.raises(RecordingError) as error:
        examiner.examine_review(path)
    assert str(error.value).startswith(f"{review}: ")


# ---------------------------------------------------------------------------------------------- no recordings


def test_what_is_no_recording_is_one_sentence(tmp_path: Path, examiner: Examiner) -> None:
    for content in (b"", b"RRF2", b"hello\n" * 100, b"\x89PNG\r\n\x1a\n", bytes(100_000), b"PK\x03\x04" + bytes(100)):
        path = tmp_path / "other.rrd"
        path.write_bytes(content)
        assert "not a whole recording" in sentence(examiner, path)


def test_what_is_no_file_is_one_sentence_at_once(tmp_path: Path, examiner: Examiner) -> None:
    assert "cannot be opened" in sentence(examiner, tmp_path / "missing.rrd")
    assert "not a file" in sentence(examiner, tmp_path)
    pipe, loop = tmp_path / "pipe.rrd", tmp_path / "loop.rrd"
    os.mkfifo(pipe)
    loop.symlink_to(loop)
    assert "not a file" in sentence(examiner, pipe)
    assert "cannot be opened" in sentence(examiner, loop)
    assert "not a file" in sentence(examiner, Path("/dev/zero"))


@needs("no superuser")
def test_a_file_that_may_not_be_read_is_one_sentence(good: Path, tmp_path: Path, examiner: Examiner) -> None:
    path = tmp_path / "secret.rrd"
    path.write_bytes(good.read_bytes())
    path.chmod(0)
    assert "may not be read" in sentence(examiner, path)


def test_a_huge_file_is_not_read(good: Path, tmp_path: Path, examiner: Examiner) -> None:
    path = tmp_path / "sparse.rrd"
    path.write_bytes(good.read_bytes())
    os.truncate(path, 10 * FILE_LIMIT_BYTES)
    assert "which no recording is" in sentence(examiner, path)


def test_recordings_of_other_programs_are_told_apart(tmp_path: Path, examiner: Examiner) -> None:
    dot = Chunk.from_columns("/dot", [], rr.Points3D.columns(positions=[[1, 2, 3]]))
    for application, said in (("other", "another program"), (APPLICATION_ID, "a part of the run is missing")):
        path = tmp_path / "foreign.rrd"
        LazyChunkStream.from_iter([dot]).write_rrd(path, application_id=application, recording_id="1")
        assert said in sentence(examiner, path)


# ---------------------------------------------------------------------------------------------- lies about sizes


def unpacks_to_much(good: Path) -> bytes:
    """A file of 3 MB with a chunk of 700 MB."""
    return repacked(change=lambda arrow: arrow + bytes(700_000_000))(good)


def ends_the_reader(good: Path) -> bytes:
    """A file of which rerun's reader dies: the array of a chunk claims -1 numbers."""
    return relabelled(-1)(good)


def has_a_list_that_ends_beyond_its_values(good: Path) -> bytes:
    """Rerun's reader dies of this too."""
    return recounted(lambda size: (struct.pack("<ii", 0, size), struct.pack("<ii", 0, 10**9)))(good)


def repacked(claim: int | None = None, change: Callable[[bytes], bytes] | None = None) -> Lie:
    return lambda good: with_message(good, DATA, lambda m: message(m, claim, change))


def relabelled(count: int) -> Lie:
    """Whose array claims to have so many numbers."""
    return recounted(lambda size: (struct.pack("<qq", size, 0), struct.pack("<qq", count, 0)))


def recounted(change: Callable[[int], tuple[bytes, bytes]]) -> Lie:
    """With bytes of an arrow message replaced, by the size of its array."""

    def replace_in(arrow: bytes) -> bytes:
        batch = pa.ipc.open_stream(arrow).read_next_batch()
        old, new = change(len(batch.column("arrays").flatten()))
        assert old in arrow
        return arrow.replace(old, new)

    return repacked(change=replace_in)


LIES: dict[str, Lie] = {
    "a chunk unpacks to 1 GB": repacked(claim=1 << 30),
    "a chunk unpacks to 2^64 - 1 bytes": repacked(claim=(1 << 64) - 1),
    "a chunk unpacks to nothing": repacked(claim=0),
    "an array of 10^9 numbers": relabelled(10**9),
    "10^9 rows": recounted(lambda size: (struct.pack("<qq", 1, 0), struct.pack("<qq", 10**9, 0))),
    "the index claims a chunk of 2^40 bytes": lambda good: with_index(
        good, (struct.pack("<Q", places(good)[DATA][1]), struct.pack("<Q", 1 << 40))
    ),
    "the index claims a chunk beyond the end": lambda good: with_index(
        good, (struct.pack("<Q", places(good)[DATA][0]), struct.pack("<Q", (1 << 64) - 8))
    ),
}


@pytest.mark.parametrize("lie", LIES)
def test_lies_about_sizes_are_one_sentence(good: Path, examiner: Examiner, tmp_path: Path, lie: str) -> None:
    path = tmp_path / "lie.rrd"
    path.write_bytes(LIES[lie](good))
    sentence(examiner, path)


def test_the_tools_of_these_tests_tell_the_truth_where_they_change_nothing(
    good: Path, examiner: Examiner, tmp_path: Path
) -> None:
    same = {
        "message": with_message(good, DATA, lambda content: content),
        "packed again": repacked(change=lambda arrow: arrow)(good),
        "index": with_index(good),
        "rows": changed(good, tmp_path / "same.rrd", {PROBLEM: lambda row: packed(*unpacked(row))}).read_bytes(),
        "rows of format 2": changed(good, tmp_path / "same.rrd", {PROBLEM: alone, RUN: alone}).read_bytes(),
        "rows of format 1": changed(
            good, tmp_path / "same.rrd", {PROBLEM: lambda row: packed_as_format_1(*unpacked(row))}
        ).read_bytes(),
    }
    for content in same.values():
        path = tmp_path / "same.rrd"
        path.write_bytes(content)
        assert replace(examiner.examine(path), file=good.name, size_bytes=good.stat().st_size) == examiner.examine(good)


# ---------------------------------------------------------------------------------------------- impossible values


@pytest.mark.parametrize("what", IMPOSSIBLE)
def test_impossible_values_are_one_sentence(good: Path, examiner: Examiner, tmp_path: Path, what: str) -> None:
    sentence(examiner, changed(good, tmp_path / "bad.rrd", IMPOSSIBLE[what]))


# ---------------------------------------------------------------------------------------------- one file's fault


def test_a_bad_file_costs_the_others_nothing(good: Path, tmp_path: Path) -> None:
    deadly, huge = tmp_path / "deadly.rrd", tmp_path / "huge.rrd"
    deadly.write_bytes(has_a_list_that_ends_beyond_its_values(good))
    huge.write_bytes(unpacks_to_much(good))
    paths = [good, deadly, good, huge, tmp_path, good]
    with Examiner() as examiner:
        results = examine_all(paths, examiner)
        told = examiner.told([good, deadly, huge, tmp_path, good])
    assert told[0] == told[-1] == results[0][1] and told[3] is None, "what a child died of costs the others nothing"
    assert [path for path, _ in results] == paths
    assert [isinstance(result, RunRow) for _, result in results] == [True, False, True, False, False, True]


@needs("/proc")
def test_a_huge_recording_fills_no_memory(good: Path, tmp_path: Path, examiner: Examiner) -> None:
    path = tmp_path / "huge.rrd"
    path.write_bytes(unpacks_to_much(good))
    row = examiner.examine(good)
    # The reader says that it cannot allocate, or is ended by its limits, which a busy machine makes it reach sooner.
    assert re.search("allocat|too much memory", sentence(examiner, path))
    assert examiner.examine(good) == row
    assert examiner._child is not None
    status = Path(f"/proc/{examiner._child._process.pid}/status").read_text()
    (most_kb,) = re.findall(r"VmHWM:\s+(\d+) kB", status)
    assert int(most_kb) < 700_000


@pytest.mark.parametrize("sign", [signal.SIGSTOP, signal.SIGALRM])
def test_a_child_that_hangs_or_has_ended_is_replaced(
    good: Path, examiner: Examiner, monkeypatch: pytest.MonkeyPatch, sign: signal.Signals
) -> None:
    monkeypatch.setattr(examiners, "BEGIN_LIMIT_S", 0.5)
    row = examiner.examine(good)
    before = examiner._child
    assert before is not None
    before._process.send_signal(sign)
    assert examiner.examine(good) == row
    assert examiner._child is not before and before._process.returncode is not None


def test_the_child_is_limited_in_time_and_what_it_writes(tmp_path: Path) -> None:
    program = f"""
from spherloc_viz.recording.sandbox import child as examine
examine.TIME_LIMIT_S = 1
examine._limit_process()
try:
    examine.Path({str(tmp_path / "made")!r}).write_text("x")
except OSError as error:
    print(error.strerror, flush=True)
examine._limit_time()
while True:
    pass
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=LIMIT_S, check=False)
    assert done.returncode == -signal.SIGXCPU and done.stdout == "File too large\n", done.stderr


def test_many_threads_may_examine(good: Path, examiner: Examiner) -> None:
    rows: list[RunRow] = []
    threads = [threading.Thread(target=lambda: rows.append(examiner.examine(good))) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(rows) == 4 and len(set(rows)) == 1


def test_one_file_is_examined_by_a_child_that_stays(
    good: Path, examiner: Examiner, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(examiners, "_shared", examiner)
    row, child = examine(good), examiner._child
    assert examine(good) == row and child is not None
    assert examiner._child is child and child._process.poll() is None


def test_a_child_that_cannot_be_started_is_no_fault_of_a_file(good: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    with pytest.raises(RecordingError, match="does not start"):
        examine_all([good], Examiner())


def test_fields_whose_types_are_aliases_are_checked_too() -> None:
    """As ``NDArray`` is from numpy 2.5 on."""
    item = TypeVar("item", bound=np.generic)
    array = TypeAliasType("array", np.ndarray[Any, np.dtype[item]], type_params=(item,))  # type: ignore[misc]
    whole = TypeAliasType("whole", int)
    for hint in (array, array[np.float64], array[np.float64] | None):
        assert content_checks._fits(np.zeros(3), hint) and not content_checks._fits([0.0], hint)
    assert content_checks._fits(3, whole) and not content_checks._fits(3.0, whole)
