"""The list of runs with several writers at once, and labels and notes from several pages."""

import contextlib
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from recording_samples import scene_problem
from run_rows import some_row

from spherloc.errors import RecordingError
from spherloc.estimators import estimate
from spherloc_viz.recording.content.writer import write_recording
from spherloc_viz.recording.index.query import RunQuery
from spherloc_viz.recording.index.run_index import RunIndex
from spherloc_viz.recording.review_file import read_review
from spherloc_viz.recording.reviews import Review, review_path
from spherloc_viz.recording.viewer import labels_of
from tests.waiting import LIMIT_S

pytestmark = pytest.mark.usefixtures("own_examiner")
ROOT = Path(__file__).resolve().parents[1]


WRITER = """
import sys
from pathlib import Path
sys.path.insert(0, {tests!r})
from run_rows import some_row
from spherloc_viz.recording.index.run_index import RunIndex
from spherloc_viz.recording.index.query import RunQuery
print("ready", flush=True)
sys.stdin.readline()
with RunIndex(Path({folder!r})) as index:
    for number in range(200):
        index.add(some_row({name!r} + "-" + str(number) + ".rrd"))
        index.find(RunQuery(), 5)
"""


def test_four_processes_that_write_lose_nothing(tmp_path: Path):
    """They begin at once, with no database there yet."""
    with contextlib.ExitStack() as stack:
        processes = []
        for name in "abcd":
            code = WRITER.format(tests=str(ROOT / "tests"), folder=str(tmp_path / "new"), name=name)
            command = [sys.executable, "-c", code]
            pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
            processes.append(stack.enter_context(subprocess.Popen(command, cwd=ROOT, text=True, **pipes)))
        for process in processes:
            assert process.stdout is not None and process.stdout.readline() == "ready\n"
        for process in processes:
            assert process.stdin is not None
            process.stdin.write("\n")
            process.stdin.flush()
        for process in processes:
            _, errors = process.communicate(timeout=LIMIT_S)
            assert (process.returncode, errors) == (0, "")
    with RunIndex(tmp_path / "new") as index:
        assert index.find(RunQuery(), 1).total == 800
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["runs.sqlite"]


def test_threads_share_one_index(index: RunIndex):
    def write(name: str) -> int:
        for number in range(50):
            index.add(some_row(f"{name}-{number}.rrd"))
            index.find(RunQuery(text=name), 5)
        return index.find(RunQuery(text=f"{name}-")).total

    with ThreadPoolExecutor(4) as threads:
        assert list(threads.map(write, "wxyz")) == [50] * 4
    assert index.find(RunQuery()).total == 200


def test_review_is_stored_with_the_run_and_found(index: RunIndex):
    (index.folder / "a.rrd").write_text("a run")
    index.add(some_row(run_id="the-id"))
    assert index.set_review("a.rrd", [" wrong  map ", "x"], "Über\nalles\n") == Review(
        ("wrong map", "x"), "Über\nalles"
    )
    assert read_review(index.folder / "a.rrd") == Review(("wrong map", "x"), "Über\nalles")
    assert [row.labels for row in index.find(RunQuery(label="wrong map", text="über")).rows] == [("wrong map", "x")]
    index.set_review("a.rrd", [], " ")
    assert not review_path(index.folder / "a.rrd").exists()
    assert index.get("a.rrd") == some_row(run_id="the-id")
    with pytest.raises(RecordingError, match="there is no such run"):
        index.set_review("b.rrd", ["x"], "")


def test_two_pages_that_review_a_run_agree_in_the_end(tmp_path: Path):
    (tmp_path / "a.rrd").write_text("a run")
    with RunIndex(tmp_path) as one, RunIndex(tmp_path) as other:
        one.add(some_row())
        begin = threading.Barrier(2)

        def review(index: RunIndex, word: str) -> None:
            begin.wait()
            for number in range(15):
                index.set_review("a.rrd", [f"{word} {number}"], word * 100)

        with ThreadPoolExecutor(2) as threads:
            for done in [threads.submit(review, one, "one"), threads.submit(review, other, "other")]:
                done.result()
        row, stored = one.get("a.rrd"), read_review(tmp_path / "a.rrd")
        assert row is not None and (row.labels, row.note) == (stored.labels, stored.note)
        assert stored in (Review(("one 14",), "one" * 100), Review(("other 14",), "other" * 100))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.review.rrd", "a.rrd", "runs.sqlite"]


def test_a_label_is_for_the_run_that_lies_there(tmp_path: Path):
    """Another run has taken the place of the one that the list has."""
    traces = [estimate(scene_problem("mei_outliers_80"), "ransac-2p", seed=seed) for seed in (1, 2)]
    path = tmp_path / "a.rrd"
    with RunIndex(tmp_path) as index:
        first = write_recording(traces[0], path)
        index.add(first)
        second = write_recording(traces[1], path)
        index.set_review("a.rrd", ["wrong map"], "")
        assert index.get("a.rrd") == replace(second, labels=("wrong map",)) and second.run_id != first.run_id
        assert labels_of(path, second.run_id) == review_path(path)
        assert index.refresh().read == 0
        path.write_text("no run")
        with pytest.raises(RecordingError, match="not a whole recording"):
            index.set_review("a.rrd", ["right map"], "")
