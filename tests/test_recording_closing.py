"""Whoever closes does not wait for a hostile file: the process that reads it is killed, and nothing is left alive."""

import contextlib
import http.client
import os
import signal
import subprocess
import sys
import threading
import urllib.request
from collections.abc import Callable
from pathlib import Path

import pytest

from spherloc.errors import RecordingError
from spherloc_viz.recording.index.run_index import RunIndex, examine_side_by_side
from spherloc_viz.recording.sandbox import examiner as examiners
from spherloc_viz.recording.sandbox.examiner import Examiner, ExaminerError
from spherloc_viz.recording.storage.recorder import Recorder
from tests.waiting import LIMIT_S, until

STUCK = """#!{python}
import os, sys
print('{{"ready": true}}', flush=True)
for line in sys.stdin:
    with open({pids!r}, "a") as pids:
        print(os.getpid(), file=pids)
    print('{{"begun": true}}', flush=True)
"""

PROGRAM = """
import contextlib, signal, sys, threading, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # programs in the background begin without it
from pathlib import Path
from spherloc_viz.commands.cli import main
from spherloc_viz.recording.sandbox import examiner
sys.executable, examiner.FILE_LIMIT_S = sys.argv[1], 3600.0
folder, pids = Path(sys.argv[2]), Path(sys.argv[3])
{do}
"""
LISTS = """sys.argv[1:] = ["runs", str(folder)]
main()"""
ENDS = """def look():
    with contextlib.suppress(Exception):
        examiner.examine(folder / "a.rrd")
threading.Thread(target=look, daemon=True).start()
while not (pids.exists() and pids.read_text()):
    time.sleep(0.01)"""


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


class Stuck:
    """A reader that begins with every file and never comes to an end."""

    def __init__(self, folder: Path) -> None:
        self.program, self.pids, self.recordings = folder / "python", folder / "pids", folder / "recordings"
        self.program.write_text(STUCK.format(python=sys.executable, pids=str(self.pids)))
        self.program.chmod(0o755)
        self.recordings.mkdir()
        (self.recordings / "a.rrd").write_bytes(b"RRF2")

    def readers(self) -> list[int]:
        """Processes that have begun with a file."""
        return [int(line) for line in self.pids.read_text().splitlines()] if self.pids.exists() else []


@pytest.fixture
def stuck(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Stuck:
    stuck = Stuck(tmp_path)
    monkeypatch.setattr(sys, "executable", str(stuck.program))
    monkeypatch.setattr(examiners, "FILE_LIMIT_S", 3600.0)
    return stuck


def ended(work: Callable[[], object]) -> tuple[threading.Thread, list[RecordingError]]:
    """A thread at work, and how that ended."""
    errors: list[RecordingError] = []

    def run() -> None:
        try:
            work()
        except RecordingError as error:
            errors.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    return thread, errors


def test_closing_an_examiner_ends_who_waits_for_it_and_its_child(stuck: Stuck) -> None:
    examiner = Examiner()
    first, errors = ended(lambda: examiner.examine(stuck.recordings / "a.rrd"))
    until(stuck.readers)
    second, others = ended(lambda: examiner.examine_review(stuck.recordings / "a.rrd"))
    examiner.close()
    for thread in (first, second):
        thread.join(LIMIT_S)
        assert not thread.is_alive()
    (pid,) = stuck.readers()
    assert not alive(pid)
    assert [type(error) for error in errors + others] == [ExaminerError] * 2, "which is no fault of the file"
    with pytest.raises(ExaminerError, match="the program ends"):
        examiner.examine(stuck.recordings / "a.rrd")
    assert examiner._child is None


def test_closing_a_list_ends_its_refresh_and_says_nothing_of_the_file(stuck: Stuck) -> None:
    with RunIndex(stuck.recordings) as index:
        thread, errors = ended(index.refresh)
        until(stuck.readers)
        index.close()
        thread.join(LIMIT_S)
        assert not thread.is_alive() and len(errors) == 1
    assert not any(map(alive, stuck.readers()))
    with RunIndex(stuck.recordings) as index:
        assert index.refresh(read=lambda paths: [(path, RecordingError("bad.")) for path in paths]).skipped == (
            ("a.rrd", "bad."),
        )


def test_closing_the_recorder_ends_its_upkeep(stuck: Stuck) -> None:
    notices: list[str] = []
    recorder = Recorder(stuck.recordings, lambda error: notices.append(str(error)), notices.append)
    until(stuck.readers)
    recorder.close()
    recorder._upkeep.join(LIMIT_S)
    assert not recorder._upkeep.is_alive() and not any(map(alive, stuck.readers())) and notices == []


def test_leaving_early_ends_all_readers(stuck: Stuck) -> None:
    """As Ctrl-C does."""
    results = examine_side_by_side([stuck.recordings / f"{number}.rrd" for number in range(10)])
    thread, errors = ended(lambda: next(results))
    until(stuck.readers)
    assert thread.is_alive() and not errors
    os.kill(stuck.readers()[0], signal.SIGKILL)  # the first file's fault; now it reads the second
    thread.join(LIMIT_S)
    until(lambda: len(stuck.readers()) == 2)
    results.close()
    assert not any(map(alive, stuck.readers()))


@pytest.mark.parametrize(("do", "code"), [(LISTS, 130), (ENDS, 0)])
def test_a_program_ends_at_once(stuck: Stuck, monkeypatch: pytest.MonkeyPatch, do: str, code: int) -> None:
    monkeypatch.undo()
    words = [sys.executable, "-c", PROGRAM.format(do=do), stuck.program, stuck.recordings, stuck.pids]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as program:
        until(lambda: stuck.readers() or program.poll() is not None)
        if code:
            program.send_signal(signal.SIGINT)
        _, said = program.communicate(timeout=LIMIT_S)
    assert program.returncode == code and "Traceback" not in said, said
    assert not any(map(alive, stuck.readers())) and stuck.readers()


PLAYS = """sys.argv[1:] = ["play", "--port", "0", "--recordings", str(folder)]
main()"""


def test_the_playground_ends_at_once_while_a_page_asks_for_a_hostile_file(
    stuck: Stuck, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.undo()
    words = [sys.executable, "-c", PROGRAM.format(do=PLAYS), stuck.program, stuck.recordings, stuck.pids]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None
        address = program.stdout.readline().split()[-1]
        until(stuck.readers)  # of the list, which is brought up to date
        asking, _ = ended(lambda: fetch(f"{address}/viewer/data/a.rrd"))
        until(lambda: len(stuck.readers()) == 2 or program.poll() is not None)
        program.send_signal(signal.SIGINT)
        _, said = program.communicate(timeout=LIMIT_S)
        asking.join(LIMIT_S)
    assert program.returncode == 0 and "Traceback" not in said, said
    assert len(stuck.readers()) == 2 and not any(map(alive, stuck.readers()))


def fetch(address: str) -> None:
    with (
        contextlib.suppress(OSError, http.client.HTTPException),
        urllib.request.urlopen(address, timeout=LIMIT_S) as answer,
    ):
        answer.read()


def test_paths_count_from_the_folder_that_one_is_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The child stays in the folder in which it was started."""
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "a.rrd").write_bytes(b"hello")
    with Examiner() as examiner:
        monkeypatch.chdir(tmp_path)
        with pytest.raises(RecordingError, match=r"a\.rrd: cannot be opened"):
            examiner.examine(Path("a.rrd"))
        monkeypatch.chdir(tmp_path / "there")
        with pytest.raises(RecordingError, match="not a whole recording"):
            examiner.examine(Path("a.rrd"))
        assert examiner.examine_review(Path("a.rrd")).labels == ()
