"""The recorder: beside the work, one after another, and never the end of the program."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
from recording_samples import scene_problem

from spherloc.datasets.synthetic import SyntheticScene
from spherloc.datasets.variation import Variation
from spherloc.diagnosis import diagnose
from spherloc.errors import RecordingError
from spherloc.estimators import estimate
from spherloc.trace import Stage, Trace
from spherloc_viz.recording.content import writer
from spherloc_viz.recording.content.data import read_recording
from spherloc_viz.recording.content.writer import write_recording
from spherloc_viz.recording.index.query import RunQuery
from spherloc_viz.recording.origin import Origin
from spherloc_viz.recording.reviews import review_path
from spherloc_viz.recording.storage import recorder as background
from spherloc_viz.recording.storage.recorder import Recorder
from spherloc_viz.recording.storage.store import RecordingStore, file_name
from tests.waiting import LIMIT_S, until


@pytest.fixture(scope="module")
def trace() -> Trace:
    return estimate(scene_problem("mei_outliers_80"), "ransac-2p", seed=11)


class Told(list[str]):
    """What a recorder reports."""

    def hear(self, sentence: object) -> None:
        self.append(str(sentence))


class Unknown(Stage):
    """Nobody can draw it."""

    kind = "unknown"


@contextmanager
def held(folder: Path, trace: Trace, told: Callable[[object], None]) -> Iterator[Recorder]:
    """A recorder that is busy with a run until the context ends; ``folder`` must be one where none can be written."""
    stuck, go_on = threading.Event(), threading.Event()

    def hold(error: RecordingError) -> None:
        stuck.set()
        go_on.wait(LIMIT_S)
        told(error)

    with Recorder(folder, hold) as recorder:
        recorder.submit(trace)
        assert stuck.wait(LIMIT_S)
        try:
            yield recorder
        finally:
            go_on.set()


def test_what_is_submitted_is_there_and_listed_after_closing(trace: Trace, tmp_path: Path) -> None:
    errors, notices, folder = Told(), Told(), tmp_path / "new" / "recordings"
    origin = Origin("page", "/scenes/street.toml", 3, "a.jpg", Variation(hidden=(1, 2)))
    with Recorder(folder, errors.hear, notices.hear) as recorder:
        paths = [recorder.submit(replace(trace, seed=seed), origin) for seed in range(5)]
        paths.append(recorder.submit(trace, diagnosis=replace(diagnose(trace), summary="Told before.")))
        assert recorder.folder == folder
    assert not errors and not notices and recorder.waiting == 0
    runs = [read_recording(path) for path in paths]
    assert [run.seed for run in runs] == [0, 1, 2, 3, 4, 11]
    assert [run.origin for run in runs[:5]] == [origin] * 5
    assert runs[5].row.summary == "Told before." and runs[5].row.source == "unknown"
    with RecordingStore(folder, notices.hear) as store:
        found = store.index.find(RunQuery(sort="file", descending=False)).rows
        refreshed = store.index.refresh()
    assert [row.file for row in found] == sorted(path.name for path in paths) and {row.steps for row in found} != {0}
    assert (refreshed.read, refreshed.removed, refreshed.skipped) == (0, 0, ())


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
    with RecordingStore(tmp_path, Told().hear) as store:
        assert read_recording(store.record(run)).problem.name == name


def test_every_run_that_cannot_be_written_is_told(
    trace: Trace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    errors, notices, folder = Told(), Told(), tmp_path / "recordings"
    folder.write_text("in the way")
    ends: list[RecordingError | None] = []
    with Recorder(folder, errors.hear, notices.hear) as recorder:
        missing = [recorder.submit(trace, ended=ends.append) for _ in range(3)]
        until(lambda: not recorder.waiting)
        assert [str(end) for end in ends] == errors and len(errors) == 3
        for path, error in zip(missing, errors, strict=True):
            assert error.startswith(f"{path}: the run cannot be recorded") and "\n" not in error
        folder.unlink()
        path = recorder.submit(trace, ended=lambda error: ends.append(error if path.is_file() else RecordingError("")))
        until(lambda: not recorder.waiting)
        assert ends[3:] == [None], "it is told when the file is there"
        assert notices == ["Runs are recorded again; 3 were not."] and read_recording(path).seed == trace.seed
        unknown = recorder.submit(replace(trace, stages=(Unknown(),)))
        until(lambda: not recorder.waiting)
        assert len(errors) == 3 and unknown.is_file(), "a stage that has no drawing is recorded too"
        with monkeypatch.context() as patch:
            patch.setattr(writer, "thumbnail", lambda trace: 1 / 0)  # a bug in drawing
            recorder.submit(trace)
            until(lambda: not recorder.waiting)
        last = recorder.submit(trace)
    assert len(errors) == 4 and "ZeroDivisionError" in errors[3] and "cannot be recorded" in errors[3]
    assert notices[1:] == ["Runs are recorded again; 1 was not."]
    assert sorted(folder.glob("*.rrd")) == sorted([path, unknown, last]) and not list(folder.glob("*.part"))


def test_a_full_queue_says_how_many_wait_and_does_not_wait(
    trace: Trace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    errors = Told()
    monkeypatch.setattr(background, "QUEUE_LENGTH", 4)
    (tmp_path / "file").write_text("in the way")
    with held(tmp_path / "file", trace, errors.hear) as recorder:
        assert recorder.waiting == 1 and recorder.overload == ""
        for _ in range(4):
            recorder.submit(trace)
        assert recorder.overload == "5 runs wait to be recorded."
        with pytest.raises(RecordingError, match="not recorded, since 4 runs wait to be recorded"):
            recorder.submit(trace)
    assert len(errors) == 5 and recorder.waiting == 0


def test_nothing_is_recorded_after_closing(trace: Trace, tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "recordings", Told().hear)
    recorder.close()
    recorder.close()
    with pytest.raises(RecordingError, match="has ended"):
        recorder.submit(trace)
    with pytest.raises(RecordingError, match="closed"):
        _ = recorder.index
    assert not list(tmp_path.iterdir())


def test_a_full_recording_keeps_what_a_lean_one_leaves_out(
    scene_of: Callable[..., SyntheticScene], tmp_path: Path
) -> None:
    run = estimate(scene_of("mei", correspondences=200).problem(), "mc")
    sizes = []
    for full in (False, True):
        with Recorder(tmp_path / str(full), Told().hear, full=full) as recorder:
            path = recorder.submit(run)
        stage = read_recording(path).stages["yaw"]
        assert ("pairs" in stage) == full
        sizes.append(path.stat().st_size)
    assert sizes[1] > sizes[0]


def test_without_a_usable_list_runs_are_recorded_too(trace: Trace, tmp_path: Path) -> None:
    errors, notices = Told(), Told()
    (tmp_path / "runs.sqlite").mkdir()
    (tmp_path / "runs.sqlite" / "file").touch()
    with Recorder(tmp_path, errors.hear, notices.hear) as recorder:
        paths = [recorder.submit(trace) for _ in range(3)]
    assert not errors and all(path.is_file() for path in paths)
    assert len(notices) == 1 and "runs.sqlite" in notices[0]


def test_a_run_that_cannot_be_listed_is_told_once(trace: Trace, tmp_path: Path) -> None:
    told = Told()
    with RecordingStore(tmp_path, told.hear) as store:
        store.index.close()
        paths = [store.record(trace) for _ in range(3)]
    assert all(path.is_file() for path in paths)
    assert len(told) == 1 and told[0].startswith("A run is recorded, but not listed: ")


def test_threads_and_files_stay_few(trace: Trace, tmp_path: Path) -> None:
    def count() -> tuple[int, int]:
        tasks, files = Path("/proc/self/task"), Path("/proc/self/fd")
        return (len(list(tasks.iterdir())), len(list(files.iterdir()))) if tasks.exists() else (0, 0)

    write_recording(trace, tmp_path / "first.rrd")
    Recorder(tmp_path, Told().hear).close()
    before = count()
    for _ in range(3):
        with Recorder(tmp_path, Told().hear) as recorder:
            for _ in range(6):
                recorder.submit(trace)
    threads, files = count()
    # A pool of threads may start late; one thread a run, or one a recorder and run, would be many more.
    assert threads <= before[0] + 8 and files <= before[1] + 2
    assert len(list(tmp_path.glob("*.rrd"))) == 19


def test_a_run_that_is_made_anew_takes_the_place_of_its_recording(trace: Trace, tmp_path: Path) -> None:
    """Unless somebody has labelled that, which a notice tells."""
    errors, notices = Told(), Told()
    with Recorder(tmp_path, errors.hear, notices.hear) as recorder:
        first = recorder.submit(trace)
        second = recorder.submit(replace(trace, seed=12), instead_of=first)
        until(lambda: recorder.waiting == 0)
        assert not first.exists() and not notices
        review_path(second).write_bytes(b"")
        third = recorder.submit(replace(trace, seed=13), instead_of=second)
        until(lambda: recorder.waiting == 0)
        assert {row.file for row in recorder.index.find(RunQuery()).rows} == {second.name, third.name}
    (notice,) = notices
    assert notice.startswith(f"{second.name} stays, since it has labels") and third.name in notice and not errors
