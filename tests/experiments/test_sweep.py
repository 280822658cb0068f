"""Sweeps: the rows are those of direct calls, whoever does them, and nothing is lost or left behind."""

import errno
import multiprocessing
import multiprocessing.spawn
import os
import signal
import subprocess
import sys
import threading
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import distributed
import pytest
from sweep_samples import QUICK, SCENE, small_plan, write_scene

from spherloc.datasets import load_scene
from spherloc.datasets.variation import Variation
from spherloc.errors import InputError
from spherloc.estimators import estimate, options_type
from spherloc.experiments import sweep_cluster, sweep_workers
from spherloc.experiments.sweep import (
    MAX_DEATHS,
    TASK_S,
    Backlog,
    Entrant,
    Job,
    SweepPlan,
    SweepRow,
    planned,
    run_sweep,
)
from spherloc.experiments.sweep_workers import NICENESS
from spherloc.metrics import evaluate
from spherloc.warm_up import warm_up
from tests.waiting import LIMIT_S, until


@pytest.fixture(autouse=True, scope="module")
def compiled() -> None:
    """Workers side by side would each compile the kernels, where none are cached yet."""
    warm_up()


def untimed(rows: list[SweepRow]) -> dict[tuple[str, float, int], SweepRow]:
    """The rows by estimator, value and seed, none of which may come twice."""
    found = {(row.estimator, row.value, row.seed): replace(row, time_ms=0.0) for row in rows}
    assert len(found) == len(rows)
    return found


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"


def test_rows_are_those_of_direct_calls_though_a_worker_is_killed(tmp_path: Path) -> None:
    plan = small_plan(tmp_path, runs=6)
    given: list[SweepRow] = []
    for row in run_sweep(plan, workers=2):
        given.append(row)
        if len(given) == 6:
            pid = multiprocessing.active_children()[0].pid
            assert pid is not None
            own = os.getpriority(os.PRIO_PROCESS, 0)
            assert os.getpriority(os.PRIO_PROCESS, pid) == min(own + NICENESS, 19)
            os.kill(pid, signal.SIGKILL)
    assert not multiprocessing.active_children()
    rows = untimed(given)
    assert len(rows) == plan.rows == 24
    assert {seed for _, _, seed in rows} == set(range(3, 9)), "all estimators and values get the same problems"
    scene = load_scene(tmp_path / "tiny.toml")
    for (label, value, seed), row in rows.items():
        name = label.split()[0]
        problem = Variation(noise_px=1.0, outlier_rate=value).problem(scene, seed)
        options = options_type(name)(iterations=20) if name == "ransac-2p" else None
        trace = estimate(problem, name, options, seed)
        scores = evaluate(trace)
        assert (row.rotation_error_deg, row.translation_error_m) == (
            scores.rotation_error_deg,
            scores.translation_error_m,
        )
        assert (row.success, row.precision, row.recall, row.f1) == (
            scores.success,
            scores.precision,
            scores.recall,
            scores.f1,
        )
        assert row.inliers == trace.inlier_mask.sum() and row.correspondences == 30
        proven = trace.certificate
        bounds = (None, None) if proven is None else (proven.upper_bound, proven.lower_bound)
        assert (row.upper_bound, row.lower_bound) == bounds
        assert (name == "mc-exact") == (proven is not None)
    assert 0 < sum(row.success for row in rows.values()) < plan.rows
    done = [key for place, key in enumerate(rows) if place % 6]
    backlog = Backlog(plan, done)
    again: list[SweepRow] = []
    while jobs := backlog.take():
        again += plan.solve(jobs)
        backlog.book(jobs, again[-len(jobs) :])
    assert untimed(again) == {key: row for key, row in rows.items() if key not in done}


def test_stopping_ends_it_at_once_and_leaves_no_process(tmp_path: Path) -> None:
    slow = (Entrant("ransac-svd", (("iterations", 1_000_000), ("confidence", 1.0 - 1e-15))),)
    plan = small_plan(tmp_path, entrants=(*QUICK, *slow), runs=1000)
    stop = threading.Event()
    sweep = run_sweep(plan, workers=2, stop=stop)
    assert isinstance(next(sweep), SweepRow) and len(multiprocessing.active_children()) >= 1
    stop.set()
    assert len(list(sweep)) < 100
    assert not multiprocessing.active_children()


PARENT = """
import sys, multiprocessing
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from sweep_samples import small_plan
from spherloc.experiments.sweep import run_sweep
if __name__ == "__main__":
    for number, row in enumerate(run_sweep(small_plan(Path(sys.argv[2]), runs=100_000), workers=1)):
        if number == 20:
            print(*(child.pid for child in multiprocessing.active_children()), flush=True)
"""


def test_workers_end_with_a_killed_parent(tmp_path: Path) -> None:
    (tmp_path / "parent.py").write_text(PARENT)
    words = [sys.executable, tmp_path / "parent.py", Path(__file__).parent, tmp_path]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        workers = [int(word) for word in parent.stdout.readline().split()]
        assert workers and all(map(alive, workers))
        parent.kill()
    until(lambda: not any(map(alive, workers)))


def test_points_fill_evenly_in_tasks_of_a_good_size(tmp_path: Path) -> None:
    plan = small_plan(tmp_path, runs=100)
    backlog, tasks = Backlog(plan, ()), []
    row = plan.solve([Job(0, 0, 0)])[0]

    def cost_ms(job: Job) -> float:
        return 18.0 if job.entrant else 240.0

    while jobs := backlog.take():
        tasks.append(jobs)
        backlog.book(jobs, [replace(row, time_ms=cost_ms(job)) for job in jobs])
    seen = [job for jobs in tasks for job in jobs]
    assert seen == sorted(seen) == list(plan.jobs()) and not backlog.left
    assert [len(jobs) for jobs in tasks[:4]] == [1, 1, 1, 1], "nobody knows yet how long they take"
    costs_ms = [sum(map(cost_ms, jobs)) for jobs in tasks[4:-1]]
    assert max(costs_ms) <= 1e3 * TASK_S and min(costs_ms) > 1e3 * TASK_S - 260.0


def test_a_machine_that_starts_no_workers_is_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A pool needs semaphores, which lie in /dev/shm."""

    def read_only(*words: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(sweep_workers, "ProcessPoolExecutor", read_only)
    with pytest.raises(InputError, match=r"cannot be started \(Read-only file system\); see whether /dev/shm"):
        list(run_sweep(small_plan(tmp_path)))


def test_a_machine_that_starts_one_worker_and_no_more_is_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Further processes are started when there is work for them."""

    def submit(self: ProcessPoolExecutor, job: object, *words: object) -> Future:
        if job is sweep_workers.solve:
            raise BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable")
        return started(self, job, *words)  # type: ignore[arg-type]

    started = ProcessPoolExecutor.submit
    monkeypatch.setattr(ProcessPoolExecutor, "submit", submit)
    with pytest.raises(InputError, match=r"cannot be started \(Resource temporarily unavailable\); see whether"):
        list(run_sweep(small_plan(tmp_path)))


def test_workers_that_do_not_come_are_a_sentence_and_are_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asleep = tmp_path / "python"
    asleep.write_text("#!/bin/sh\nexec sleep 600\n")
    asleep.chmod(0o755)
    monkeypatch.setattr(sweep_workers, "START_S", 0.5)
    before = multiprocessing.spawn.get_executable()
    multiprocessing.set_executable(str(asleep))
    try:
        with pytest.raises(InputError, match="no worker process has started within"):
            list(run_sweep(small_plan(tmp_path)))
    finally:
        multiprocessing.set_executable(before)


def test_a_run_that_always_kills_its_worker_is_named(tmp_path: Path) -> None:
    plan = small_plan(tmp_path)
    backlog = Backlog(plan, ())
    first, second = backlog.take(), backlog.take()
    assert len(first) == len(second) == 1
    backlog.put_back(first)
    assert backlog.take() == (), "suspects wait until they are alone"
    backlog.put_back(second)
    (bad,) = second
    with pytest.raises(InputError, match=r"mc-exact at outlier rate 0.5, seed 3: its worker process was kill"):
        for _ in range(10 * MAX_DEATHS * (len(first) + len(second))):
            jobs = backlog.take()
            assert len(jobs) == 1 and backlog.take() == ()
            if jobs == (bad,):
                backlog.put_back(jobs)
            else:
                backlog.book(jobs, plan.solve(jobs))


def test_workers_that_cannot_start_end_in_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "bare.py").write_text(PARENT.replace('if __name__ == "__main__":', "if True:"))
    words = [sys.executable, tmp_path / "bare.py", Path(__file__).parent, tmp_path]
    done = subprocess.run(words, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    assert done.returncode == 1
    assert "InputError: the worker processes end while they start: in a script" in done.stderr


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"over": "camera"}, "cannot go over 'camera'; choose one of outlier_rate, noise_px"),
        ({"values": ()}, "has 0 values"),
        ({"values": (0.5, float("nan"))}, "has the value nan; give numbers"),
        ({"over": "correspondences", "values": (20.5,)}, "has the value 20.5; give whole numbers"),
        ({"values": (0.5, 1.5)}, r"outlier rate 1.5: tiny: outlier_rate is 1.5; give a number from 0 to 1"),
        ({"over": "noise_px", "values": (1.0,)}, "noise_px is set, and the sweep goes over it"),
        ({"entrants": ()}, "has 0 estimators"),
        ({"entrants": (Entrant("magic"),)}, "'magic': choose one of"),
        ({"entrants": (QUICK[0], QUICK[0])}, "'ransac-2p iterations=20' twice"),
        ({"entrants": (Entrant("mc", (("magic", 1),)),)}, "mc has no option 'magic'; it has as_printed, bound_px"),
        ({"entrants": (Entrant("mc", (("bound_px", -1.0),)),)}, "bound_px is -1.0"),
        ({"runs": 0}, "has 0 runs a point"),
        ({"runs": 100_000, "values": [k / 100 for k in range(99)]}, "runs in all; ask for 2,000,000 or fewer"),
        ({"first_seed": -1}, "first seed is -1"),
        ({"variation": Variation(hidden=(3,))}, "single matches cannot be edited"),
        ({"variation": Variation(camera="nowhere.yaml")}, "nowhere.yaml: no such file"),
    ],
)  # fmt: skip
def test_wrong_plans_are_one_sentence(tmp_path: Path, changes: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        small_plan(tmp_path, **changes)


def test_what_changes_under_a_sweep_is_noticed(tmp_path: Path) -> None:
    plan = small_plan(tmp_path)
    with pytest.raises(InputError, match=r"numpy is \S+ where the runs are done and 1.0 where the sweep was started"):
        replace(plan, versions=(("numpy", "1.0"),)).solve([Job(0, 0, 0)])
    write_scene(tmp_path).write_text(SCENE.replace("30", "31"))
    with pytest.raises(InputError, match="has changed since the sweep was planned"):
        replace(plan, scene_sha256="0").solve([Job(0, 0, 0)])
    with pytest.raises(InputError, match=r"gone.toml: no such file"):
        planned(tmp_path / "gone.toml", "noise_px", [1], QUICK, 1)
    with pytest.raises(InputError, match="has 0 workers"):
        next(run_sweep(plan, workers=0))


def test_an_impossible_run_is_named(tmp_path: Path) -> None:
    """Only its problem can tell, so it comes as the error of a worker."""
    plan = small_plan(tmp_path)
    broken: SweepPlan = replace(plan, values=(0.5, 1.5))
    with pytest.raises(InputError, match=r"outlier rate 1.5, seed 3: tiny: outlier_rate is 1.5"):
        list(run_sweep(broken, workers=1))
    assert not multiprocessing.active_children()


def test_a_cluster_gives_the_same_rows_though_a_worker_is_killed(tmp_path: Path) -> None:
    plan = small_plan(tmp_path, runs=12)
    rows: list[SweepRow] = []
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50
    ) as cluster:
        pids = [worker.pid for worker in cluster.workers.values()]
        for row in run_sweep(plan, scheduler=cluster.scheduler_address):
            rows.append(row)
            if len(rows) == 12:
                os.kill(pids[0], signal.SIGKILL)
        worker_address = list(cluster.workers.values())[1].worker_address
        with pytest.raises(InputError, match="it is not a scheduler"):
            next(run_sweep(plan, scheduler=worker_address))
    assert not alive(pids[0])
    found = untimed(rows)
    assert len(found) == plan.rows
    few = [Job(run, value, entrant) for run in (0, 11) for value in (0, 1) for entrant in (0, 1)]
    assert untimed(plan.solve(few)).items() <= found.items()


def test_no_cluster_is_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = small_plan(tmp_path)
    monkeypatch.setattr(sweep_cluster, "CONNECT_S", 0.5)
    for address, said in (("tcp://127.0.0.1:9", "no Dask scheduler answers at"), ("host", "missing port number")):
        with pytest.raises(InputError, match=said):
            next(run_sweep(plan, scheduler=address))
    with (
        distributed.LocalCluster(n_workers=0, dashboard_address=None, silence_logs=50) as cluster,
        pytest.raises(InputError, match="has no workers; start some: dask worker tcp://"),
    ):
        next(run_sweep(plan, scheduler=cluster.scheduler_address))


def test_a_missing_dask_is_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"distributed; install it with: .* -m pip install 'spherloc\[cluster\]'"):
        next(run_sweep(small_plan(tmp_path), scheduler="tcp://127.0.0.1:8786"))
