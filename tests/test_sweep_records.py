"""Every run of a sweep is recorded where it is done, by several processes into one folder."""

import csv
import io
from contextlib import redirect_stderr
from dataclasses import replace
from pathlib import Path

import distributed
import pytest
from sweep_deaths import DeadlyStore

from spherloc.datasets.variation import Variation
from spherloc.experiments.sweep import Entrant, Job, planned, run_sweep
from spherloc.experiments.sweep_rows import Point
from spherloc.experiments.sweep_workers import solve
from spherloc.trace import Trace
from spherloc_viz.commands.run import Records
from spherloc_viz.commands.sweep import SweepRecordings, sweep
from spherloc_viz.recording.content.data import read_recording
from spherloc_viz.recording.index.query import RunQuery
from spherloc_viz.recording.index.run_index import RunIndex
from spherloc_viz.recording.replay import reopen
from spherloc_viz.recording.storage import store as storage
from spherloc_viz.recording.storage.store import RecordingStore, SweepStore, sweep_run_id

ROOT = Path(__file__).resolve().parents[1]
SCENE = ROOT / "scenes" / "mei_outliers_80.toml"


def swept(out: Path, recordings: Path, **changes: object) -> tuple[Point, ...]:
    words = {"values": ["0.2", "0.5"], "estimators": ["mc", "ransac-2p,iterations=50"], "runs": 3, "seed": 4}
    more = {"workers": 2, "scheduler": None, "out": out, "records": Records(recordings)}
    settings = ["correspondences=30"]
    return sweep(SCENE, "outlier_rate", settings=settings, **(words | more | changes))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def here(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, str]:
    """The CSV of a sweep by two workers, the folder of its recordings, and what was said."""
    folder, said = tmp_path_factory.mktemp("here"), io.StringIO()
    with redirect_stderr(said):
        assert len(swept(folder / "sweep.csv", folder / "recordings")) == 4
    return folder / "sweep.csv", folder / "recordings", said.getvalue()


def test_the_runs_of_all_workers_are_recorded_and_listed(here: tuple[Path, Path, str]) -> None:
    out, folder, said = here
    assert "recorded" not in said
    with out.open(newline="") as file:
        rows = {(row["estimator"].split()[0], row["outlier_rate"], int(row["seed"])) for row in csv.DictReader(file)}
    with RunIndex(folder) as index:
        listed = index.find(RunQuery(source="sweep"), limit=None).rows
        assert index.refresh().read == 0
    assert len(rows) == len(listed) == len(list(folder.glob("*.rrd"))) == 12 and not list(folder.glob("*.part"))
    runs = {row.file: read_recording(folder / row.file) for row in listed}
    origins = [run.origin for run in runs.values()]
    assert all(origin is not None and origin.scene_path == str(SCENE) for origin in origins)
    assert rows == {
        (run.estimator, str(run.origin.variation.outlier_rate), run.seed) for run in runs.values() if run.origin
    }
    name = next(name for name, run in runs.items() if run.estimator == "ransac-2p")
    opened = reopen(runs[name], folder / name, [SCENE.parent])
    assert opened.live and opened.variation.correspondences == 30 and opened.options.iterations == 50


def test_a_clusters_workers_on_this_machine_record_the_same_runs(
    here: tuple[Path, Path, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cluster = tmp_path / "cluster"
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=50
    ) as workers:
        swept(tmp_path / "cluster.csv", cluster, scheduler=workers.scheduler_address)
    assert f"workers on this machine are recorded in {cluster}" in capsys.readouterr().err
    assert poses(cluster) == poses(here[1]) and len(poses(cluster)) == 12
    assert sorted({path.suffix for path in cluster.iterdir()}) == [".rrd", ".sqlite"]


def poses(folder: Path) -> dict[tuple[object, ...], bytes | None]:
    """The pose of every run that the folder's list has, by its estimator and what it solved."""
    with RunIndex(folder) as index:
        rows = index.find(RunQuery(source="sweep"), limit=None).rows
    found = {(row.estimator, row.problem_key, row.seed): read_recording(folder / row.file).cam_from_map for row in rows}
    assert len(found) == len(rows) == len(list(folder.glob("*.rrd")))
    return {key: None if pose is None else pose.tobytes() for key, pose in found.items()}


def test_a_run_of_a_killed_worker_is_done_again_and_listed_once(tmp_path: Path) -> None:
    folder, marks = tmp_path / "recordings", tmp_path / "marks"
    marks.mkdir()
    entrants = [Entrant("ransac-2p", (("iterations", 20),))]
    plan = planned(SCENE, "outlier_rate", [0.2, 0.5], entrants, 4, Variation(correspondences=30), 7)
    rows = list(run_sweep(plan, workers=1, keep=DeadlyStore(SweepStore(folder), marks, deaths=1)))
    assert len(list(marks.iterdir())) == 1
    with RunIndex(folder) as index:
        index.refresh()
        listed = index.find(RunQuery(), limit=None).rows
    assert len(rows) == len(listed) == len(list(folder.glob("*.rrd"))) == plan.rows


def test_a_run_that_is_recorded_anew_replaces_itself_and_keeps_what_a_reviewer_said(tmp_path: Path) -> None:
    plan = planned(SCENE, "noise_px", [1.0, 2.0], [Entrant("ransac-2p")], 2, Variation(correspondences=20))
    jobs, store = list(plan.jobs()), SweepStore(tmp_path)
    assert len({sweep_run_id(plan, job) for job in jobs}) == 4
    assert sweep_run_id(replace(plan, runs=50, values=(0.5, 1.0, 2.0)), Job(0, 1, 0)) == sweep_run_id(plan, jobs[0])
    try:
        plan.solve(jobs, lambda job, trace: store(plan, job, trace))
        with RunIndex(tmp_path) as index:
            before = {row.file: row for row in index.find(RunQuery(), limit=None).rows}
            chosen = min(before)
            index.set_review(chosen, ["street"], "wet road")
            plan.solve(jobs, lambda job, trace: store(plan, job, trace))
            after = {row.file: row for row in index.find(RunQuery(), limit=None).rows}
            assert after.keys() == before.keys() and len(after) == 4
            assert all(row.run_id == before[file].run_id != "" for file, row in after.items())
            assert after[chosen].labels == ("street",) and after[chosen].note == "wet road"
            assert index.refresh().read == 0
    finally:
        storage._store(store.folder)[0].close()
        storage._store.cache_clear()


def test_where_nothing_can_be_recorded_the_sweep_goes_on_and_says_it_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("in the way")
    plan = planned(SCENE, "noise_px", [1.0], [Entrant("ransac-2p")], 3, Variation(correspondences=20))
    with RecordingStore(tmp_path / "file", print) as store:
        recorded = SweepRecordings(store)
        solved = solve(plan, list(plan.jobs()), recorded.keep(cluster=False))
        assert len(solved.rows) == len(solved.complaints) == 3
        for sentence in solved.complaints:
            recorded.complain(sentence)
        recorded.finish()
    first, last = capsys.readouterr().err.splitlines()
    assert "the run cannot be recorded" in first and first.endswith("The sweep goes on.")
    assert "times something could not be recorded" in last


def test_workers_of_other_machines_record_nothing(tmp_path: Path) -> None:
    plan = planned(SCENE, "noise_px", [1.0], [Entrant("ransac-2p")], 1, Variation(correspondences=20))
    done: list[tuple[Job, Trace]] = []
    plan.solve(list(plan.jobs()), lambda job, trace: done.append((job, trace)))
    store = SweepStore(tmp_path / "recordings")
    assert replace(store, machine="another")(plan, *done[0]) == "" and not list(tmp_path.iterdir())
    assert store(plan, *done[0]) == ""
    storage._store(store.folder)[0].close()
    storage._store.cache_clear()
    (path,) = (tmp_path / "recordings").glob("*.rrd")
    assert read_recording(path).row.source == "sweep" and read_recording(path).problem.pixels.shape == (20, 2)
