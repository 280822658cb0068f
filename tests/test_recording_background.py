"""The recorder: beside the work, one after another, and never the end of the program."""

import os
import threading
import time
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
from recording_samples import scene_problem

from spherloc.errors import RecordingError
from spherloc.estimators import estimate
from spherloc.trace import Stage, Trace
from spherloc_viz.recording.background import QUEUE_LENGTH, Recorder, file_name
from spherloc_viz.recording.reader import read_recording
from spherloc_viz.recording.writer import STALE_AFTER_S, write_recording


@pytest.fixture(scope="module")
def trace() -> Trace:
    return estimate(scene_problem("mei_outliers_80"), "ransac-2p", seed=11)


class Errors(list[RecordingError]):
    """What a recorder reports."""

    def __call__(self, error: RecordingError) -> None:
        self.append(error)


def test_what_is_submitted_is_there_after_closing(trace: Trace, tmp_path: Path) -> None:
    errors, folder = Errors(), tmp_path / "new" / "recordings"
    with Recorder(folder, errors) as recorder:
        paths = [recorder.submit(replace(trace, seed=seed)) for seed in range(5)]
    assert not errors
    assert sorted(paths) == sorted(folder.iterdir())
    assert [read_recording(path).seed for path in paths] == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("name", ["Straße / ../*?: 80 %", "街道", "", "a" * 500, "..", "CON\n\0"])
def test_names_of_files_are_safe_and_unique(trace: Trace, tmp_path: Path, name: str) -> None:
    run = replace(trace, problem=replace(trace.problem, name=name))
    now = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)
    names = {file_name(run, now) for _ in range(20)}
    assert len(names) == 20
    for file in names:
        assert file.startswith("20260102T030405Z_") and file.endswith(".rrd") and len(file) < 150
        assert "_ransac-2p_11_" in file
        assert all(letter.isascii() and (letter.isalnum() or letter in "-_.") for letter in file)
        assert (tmp_path / file).parent == tmp_path
    with Recorder(tmp_path, Errors()) as recorder:
        path = recorder.submit(run)
    assert read_recording(path).problem.name == name


def test_a_run_that_cannot_be_written_is_reported_and_the_next_one_is_recorded(trace: Trace, tmp_path: Path) -> None:
    class Unknown(Stage):
        kind = "unknown"

    errors, folder = Errors(), tmp_path / "recordings"
    folder.write_text("in the way")
    with Recorder(folder, errors) as recorder:
        recorder.submit(trace)
        recorder.submit(replace(trace, stages=(Unknown(),)))
    folder.unlink()
    with Recorder(folder, errors) as recorder:
        recorder.submit(replace(trace, stages=(Unknown(),)))
        path = recorder.submit(trace)
    assert len(errors) == 3
    assert all("cannot be recorded" in str(error) and "\n" not in str(error) for error in errors)
    assert list(folder.iterdir()) == [path]


def test_a_full_queue_says_so_and_does_not_wait(trace: Trace, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    stuck, go_on, errors = threading.Event(), threading.Event(), Errors()

    def hold(error: RecordingError) -> None:
        stuck.set()
        go_on.wait(60)
        errors(error)

    with Recorder(tmp_path / "file", hold) as recorder:
        recorder.submit(trace)
        assert stuck.wait(60)
        for _ in range(QUEUE_LENGTH):
            recorder.submit(trace)
        with pytest.raises(RecordingError, match=f"{QUEUE_LENGTH} runs wait"):
            recorder.submit(trace)
        go_on.set()
    assert len(errors) == QUEUE_LENGTH + 1


def test_nothing_is_recorded_after_closing(trace: Trace, tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, Errors())
    recorder.close()
    recorder.close()
    with pytest.raises(RecordingError, match="has ended"):
        recorder.submit(trace)
    assert not list(tmp_path.iterdir())


def test_what_killed_processes_left_is_swept(tmp_path: Path) -> None:
    old, new = f"a.rrd.{'0' * 8}.part", f"b.rrd.{'1' * 8}.part"
    others = [new, "a.rrd", "notes.part", f"a.txt.{'0' * 8}.part", "a.rrd.zzzzzzzz.part"]
    for name in [old, *others]:
        (tmp_path / name).write_text("x")
        if name != new:
            age = time.time() - STALE_AFTER_S - 60
            os.utime(tmp_path / name, (age, age))
    Recorder(tmp_path, Errors()).close()
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(others)


def test_threads_and_files_stay_few(trace: Trace, tmp_path: Path) -> None:
    def count() -> tuple[int, int]:
        tasks, files = Path("/proc/self/task"), Path("/proc/self/fd")
        return (len(list(tasks.iterdir())), len(list(files.iterdir()))) if tasks.exists() else (0, 0)

    write_recording(trace, tmp_path / "first.rrd")
    before = count()
    for _ in range(3):
        with Recorder(tmp_path, Errors()) as recorder:
            for _ in range(10):
                recorder.submit(trace)
    threads, files = count()
    assert threads <= before[0] + 2 and files <= before[1] + 2
    assert len(list(tmp_path.iterdir())) == 31
