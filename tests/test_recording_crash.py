"""Killed at any moment, or without room: at most the run in flight is lost, and the next start puts all right."""

import contextlib
import os
import resource
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from recording_samples import scene_problem

from spherloc.estimators import estimate
from spherloc.trace import Trace
from spherloc_viz.recording.content.data import read_recording, read_run_row
from spherloc_viz.recording.content.writer import write_recording
from spherloc_viz.recording.index.query import RunQuery
from spherloc_viz.recording.replay import compare
from spherloc_viz.recording.review_file import write_review
from spherloc_viz.recording.sandbox.examiner import Examiner, ExaminerError
from spherloc_viz.recording.storage.recorder import Recorder
from spherloc_viz.recording.storage.store import RecordingStore, Recovered, recover
from spherloc_viz.recording.storage.unfinished import STALE_AFTER_S, here, leftovers, unfinished
from tests.needs import needs
from tests.waiting import LIMIT_S, until

ROOT = Path(__file__).resolve().parents[1]

KILLER = """
import os, pathlib, random, signal, sys, time
from spherloc.datasets import load_scene
from spherloc.estimators import estimate
from spherloc_viz.recording.storage.store import RecordingStore

folder, scene, seed, kills = pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2]), *map(int, sys.argv[3:])
trace, draws = estimate(load_scene(scene).problem(), "ransac-2p"), random.Random(seed)
for number in range(kills):
    reader, writer = os.pipe()
    pid = os.fork()
    if not pid:
        with RecordingStore(folder, sys.stderr.write) as store:
            while True:
                store.record(trace)
                os.write(writer, b"1")
    os.read(reader, 1)  # it has recorded once: what takes long the first time is over
    time.sleep(draws.uniform(0.0, 0.06))
    os.kill(pid, 9)
    os.waitpid(pid, 0)
    os.close(writer)
    recorded = 1
    while got := os.read(reader, 4096):
        recorded += len(got)
    os.close(reader)
    print(recorded, sum(name.endswith(".part") for name in os.listdir(folder)), flush=True)
"""


@pytest.fixture(scope="module")
def trace() -> Trace:
    return estimate(scene_problem("mei_outliers_80"), "ransac-2p", seed=11)


@pytest.fixture(scope="module")
def recorded(trace: Trace, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("whole") / "run.rrd"
    write_recording(trace, path)
    return path.read_bytes()


@pytest.fixture(scope="module")
def dead() -> str:
    """How names of unfinished files tell of a process of this machine that has ended."""
    lines = ("import pathlib", "from spherloc_viz.recording.storage.unfinished import unfinished")
    code = "\n".join((*lines, "print(unfinished(pathlib.Path('a')))"))
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout.strip().removeprefix("a.").rpartition("-")[0]


def part_of(folder: Path, name: str, owner: str, content: bytes = b"") -> Path:
    path = folder / f"{name}.{owner}-{'0' * 8}.part"
    path.write_bytes(content)
    return path


@needs("fork")
def test_whoever_is_killed_at_any_moment_loses_the_run_in_flight_only(
    tmp_path: Path, rng, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, scratches = tmp_path / "recordings", tmp_path / "scratch"
    folder.mkdir()
    scratches.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(scratches))
    kills, seed = 3, int(rng.integers(2**31))
    done = subprocess.run(
        [sys.executable, "-c", KILLER, folder, ROOT / "scenes" / "mei_outliers_80.toml", str(seed), str(kills)],
        cwd=ROOT,
        env=os.environ | {"TMPDIR": str(scratches), "OPENBLAS_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=True,
    )
    counts = [tuple(map(int, line.split())) for line in done.stdout.splitlines()]
    assert len(counts) == kills
    before = 0
    for _, parts in counts:
        assert parts <= before + 1
        before = parts
    finished = sum(count for count, _ in counts)
    files = sorted(folder.glob("*.rrd"))
    # A kill may come between the last byte of a run and the word that it is done.
    assert finished <= len(files) <= finished + kills
    assert all(read_recording(path).message for path in files)
    notices: list[str] = []
    with Recorder(folder, lambda error: notices.append(str(error)), notices.append) as recorder:
        recorder.submit(estimate(scene_problem("mei_outliers_80"), "mc"))
        until(lambda: not recorder.waiting)
        wait_for_upkeep(recorder)
        listed = recorder.index.find(RunQuery(sort="file", descending=False), limit=None).rows
    now = sorted(folder.glob("*.rrd"))
    assert [row.file for row in listed] == [path.name for path in now]
    assert not list(folder.glob("*.part")) and not list(scratches.iterdir())
    assert len(now) - 1 - len(files) + len(list(folder.glob("*.unreadable"))) <= before
    assert all("Recovered" in sentence or "cannot be recovered" in sentence for sentence in notices)


@pytest.fixture(scope="module")
def examiner() -> Iterator[Examiner]:
    with Examiner() as examiner:
        yield examiner


def wait_for_upkeep(recorder: Recorder) -> None:
    recorder._upkeep.join(LIMIT_S)
    assert not recorder._upkeep.is_alive()


@settings(max_examples=12, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(share=st.floats(0.0, 1.0), garbage=st.binary(max_size=40))
def test_what_is_left_of_a_file_becomes_the_run_again_or_nothing(
    recorded: bytes, trace: Trace, dead: str, examiner: Examiner, share: float, garbage: bytes
) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        part = part_of(folder, "a.rrd", dead, recorded[: round(share * len(recorded))] + garbage)
        assert leftovers(folder) == [part]
        content = part.read_bytes()
        done = recover(part, examiner)
        left = [file.name for file in folder.iterdir()]
        if done.recording is None:
            assert share < 0.6
            assert done.kept is None if not content else done.kept is not None and done.kept.read_bytes() == content
            assert left == ([] if done.kept is None else ["a.rrd.00000000.unreadable"])
        else:
            assert left == ["a.rrd"] and done == Recovered(folder / "a.rrd")
            assert compare(read_recording(done.recording), trace) == []
            assert read_run_row(done.recording).outcome == "success"


def test_a_finished_file_without_its_name_is_moved_and_never_onto_another(
    recorded: bytes, dead: str, examiner: Examiner, tmp_path: Path
) -> None:
    path = recover(part_of(tmp_path, "a.rrd", dead, recorded), examiner).recording
    assert path == tmp_path / "a.rrd" and path.read_bytes() == recorded
    assert recover(part_of(tmp_path, "a.rrd", dead, recorded[:1000]), examiner) == Recovered()
    assert path.read_bytes() == recorded and list(tmp_path.iterdir()) == [path]
    path.write_bytes(b"damaged")
    kept = recover(part_of(tmp_path, "a.rrd", dead, recorded[:1000]), examiner).kept
    assert kept is not None and kept.read_bytes() == recorded[:1000]
    assert path.read_bytes() == b"damaged" and sorted(tmp_path.iterdir()) == [path, kept]


def test_what_a_reviewer_said_last_is_kept_if_its_file_was_not_finished(
    dead: str, examiner: Examiner, tmp_path: Path
) -> None:
    (tmp_path / "a.review.rrd").write_bytes(b"before")
    kept = recover(part_of(tmp_path, "a.review.rrd", dead, b"after"), examiner).kept
    assert kept == tmp_path / "a.review.rrd.00000000.unreadable" and kept.read_bytes() == b"after"
    assert (tmp_path / "a.review.rrd").read_bytes() == b"before"


def test_without_room_a_leftover_waits(
    recorded: bytes, dead: str, examiner: Examiner, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    part = part_of(tmp_path, "a.rrd", dead, recorded[: len(recorded) * 9 // 10])
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=1000))
        assert recover(part, examiner) == Recovered() and part.exists()
    assert recover(part, examiner) == Recovered(tmp_path / "a.rrd") and not part.exists()


def test_a_leftover_that_cannot_be_read_since_nothing_can_be_stays(recorded: bytes, dead: str, tmp_path: Path) -> None:
    """It was taken for a broken one, and deleted, where the process that reads it did not start or was ended."""
    part, ended = part_of(tmp_path, "a.rrd", dead, recorded), Examiner()
    ended.close()
    with pytest.raises(ExaminerError):
        recover(part, ended)
    assert part.read_bytes() == recorded and [path.name for path in tmp_path.iterdir()] == [part.name]


def test_only_what_nobody_will_finish_is_a_leftover(dead: str, tmp_path: Path) -> None:
    _, boot, pid, start = dead.split("-")
    machine = here().split("-")[0]
    gone = [
        part_of(tmp_path, "dead.rrd", dead),
        part_of(tmp_path, "dead.review.rrd", dead),
        part_of(tmp_path, "boot.rrd", f"{machine}-{'0' * 8}-{os.getpid()}-{start}"),
        part_of(tmp_path, "again.rrd", f"{machine}-{boot}-{os.getpid()}-1"),  # another process has its number now
    ]
    old = [tmp_path / f"old.rrd.{'0' * 8}.part", part_of(tmp_path, "far.rrd", f"{'0' * 8}-{boot}-{pid}-{start}")]
    young = [tmp_path / f"young.rrd.{'1' * 8}.part", unfinished(tmp_path / "alive.rrd")]
    # Its process was stopped for an hour, say, and will go on.
    living = unfinished(tmp_path / "stopped.rrd")
    others = [tmp_path / name for name in ("a.rrd", "notes.part", f"a.txt.{'0' * 8}.part", "a.rrd.zzzzzzzz.part")]
    for path in (*old, *young, living, *others):
        path.touch()
    for path in (*old, living, *others):
        os.utime(path, (0, 0))
    (tmp_path / f"folder.rrd.{dead}-{'0' * 8}.part").mkdir()
    assert leftovers(tmp_path) == sorted(gone + old)
    assert young[1].stat().st_mtime > STALE_AFTER_S


def test_the_next_start_tells_what_it_recovered(recorded: bytes, dead: str, tmp_path: Path) -> None:
    part_of(tmp_path, "a.rrd", dead, recorded[: len(recorded) * 9 // 10])
    part_of(tmp_path, "b.rrd", dead, recorded[:100])
    (tmp_path / "c.rrd").write_bytes(recorded)
    write_review(tmp_path / "c.rrd", ["street"], "was not listed")
    notices: list[str] = []
    with RecordingStore(tmp_path, notices.append) as store:
        store.index.add(read_run_row(tmp_path / "c.rrd"))
        (tmp_path / "c.rrd").rename(tmp_path / "d.rrd")
        (tmp_path / "c.review.rrd").rename(tmp_path / "d.review.rrd")
    with Recorder(tmp_path, lambda error: notices.append(str(error)), notices.append) as recorder:
        wait_for_upkeep(recorder)
        rows = recorder.index.find(RunQuery(sort="file", descending=False), limit=None).rows
    assert notices == [
        "Recovered the recording of a run that was not finished: a.rrd.",
        "An unfinished file of a killed process cannot be recovered, kept as b.rrd.00000000.unreadable in "
        f"{tmp_path}: delete what you do not need.",
    ]
    assert [(row.file, row.labels) for row in rows] == [("a.rrd", ()), ("d.rrd", ("street",))]


@contextlib.contextmanager
def small_disk(folder: Path, size_bytes: int) -> Iterator[None]:
    """A file system of its own in ``folder``."""
    words = ["mount", "-t", "tmpfs", "-o", f"size={size_bytes}", "tmpfs", str(folder)]
    subprocess.run(words, check=True, capture_output=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True, capture_output=True)


@needs("mount")
def test_a_full_disk_is_told_and_survived(trace: Trace, recorded: bytes, tmp_path: Path) -> None:
    errors: list[str] = []
    notices: list[str] = []
    with (
        small_disk(tmp_path, 4 * len(recorded) + 400_000),
        Recorder(tmp_path, lambda error: errors.append(str(error)), notices.append) as recorder,
    ):
        paths = []
        for _ in range(10):
            paths.append(recorder.submit(trace))
            until(lambda: not recorder.waiting)
        written = [path for path in paths if path.exists()]
        assert 2 <= len(written) <= 5 and all(read_recording(path) for path in written)
        assert len(errors) == 10 - len(written)
        assert all("No space left on device" in error and "make room" in error for error in errors)
        assert not list(tmp_path.glob("*.part"))
        for path in written:
            path.unlink()
        paths = [recorder.submit(trace) for _ in range(2)]
        until(lambda: not recorder.waiting)
        assert all(read_recording(path) for path in paths) and len(errors) == 10 - len(written)
        assert f"Runs are recorded again; {10 - len(written)} were not." in notices
        listed = {row.file for row in recorder.index.find(RunQuery(), limit=None).rows}
        assert listed >= {path.name for path in paths}


def test_where_no_large_file_can_be_written_it_is_the_same(
    trace: Trace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # else it would leave the first half of compiled modules
    errors: list[str] = []
    notices: list[str] = []
    with Recorder(tmp_path, lambda error: errors.append(str(error)), notices.append) as recorder:
        first = recorder.submit(trace)
        until(lambda: not recorder.waiting)
        wait_for_upkeep(recorder)
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, before[1]))
        try:
            for _ in range(4):
                recorder.submit(trace)
            until(lambda: not recorder.waiting)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        assert len(errors) == 4 and all("cannot be recorded" in error and "\n" not in error for error in errors)
        assert not list(tmp_path.glob("*.part"))
        last = recorder.submit(trace)
    assert sorted(tmp_path.glob("*.rrd")) == sorted([first, last]) and all(map(read_recording, (first, last)))
    assert notices == ["Runs are recorded again; 4 were not."]
