"""The list of runs when its file is damaged, foreign, locked, gone, or may not be written."""

import contextlib
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from run_rows import some_row

from spherloc.errors import RecordingError
from spherloc_viz.commands.runs import reindex
from spherloc_viz.recording.index import file as index_file
from spherloc_viz.recording.index.query import RunQuery
from spherloc_viz.recording.index.run_index import RunIndex


def foreign(path: Path) -> None:
    with contextlib.closing(sqlite3.connect(path)) as other, other:
        other.execute("CREATE TABLE mine (secret TEXT)")
        other.execute("INSERT INTO mine VALUES ('keep me')")


def with_trigger(path: Path) -> None:
    with RunIndex(path.parent):
        pass
    with contextlib.closing(sqlite3.connect(path)) as other, other:
        other.execute("CREATE TRIGGER evil AFTER INSERT ON runs BEGIN DELETE FROM runs; END")


def newer(path: Path) -> None:
    with RunIndex(path.parent):
        pass
    with contextlib.closing(sqlite3.connect(path)) as other, other:
        other.execute("PRAGMA user_version = 99")


def damaged(path: Path) -> None:
    with RunIndex(path.parent) as index:
        index.add_all([some_row(f"{number}.rrd") for number in range(100)])
    content = bytearray(path.read_bytes())
    content[200:] = bytes(len(content) - 200)
    path.write_bytes(content)


def truncated(path: Path) -> None:
    with RunIndex(path.parent) as index:
        index.add_all([some_row(f"{number}.rrd") for number in range(100)])
    path.write_bytes(path.read_bytes()[:5000])


def schema_without_text(path: Path) -> None:
    changed(path, lambda content: content.index(b"CREATE TABLE runs") + 20, b"\xff\xfe")


def unknown_format(path: Path) -> None:
    changed(path, lambda content: 44, bytes([0, 0, 0, 99]))


def changed(path: Path, place: Callable[[bytes], int], new: bytes) -> None:
    with RunIndex(path.parent) as index:
        index.add(some_row())
    content = bytearray(path.read_bytes())
    start = place(bytes(content))
    content[start : start + len(new)] = new
    path.write_bytes(content)


@pytest.mark.parametrize(
    "spoil, what",
    [
        (foreign, "is a database of another program"),
        (with_trigger, "was made by another version"),
        (newer, "was made by another version"),
        (damaged, "is damaged"),
        (truncated, "is damaged"),
        (schema_without_text, "is damaged"),
        (unknown_format, "is damaged"),
        (lambda path: path.write_bytes(b"no database\n" * 1000), "is damaged"),
    ],
)
def test_a_file_that_cannot_serve_is_set_aside(tmp_path: Path, spoil: Callable[[Path], None], what: str):
    """Renamed, never deleted, and said in a sentence; the list goes on."""
    path = tmp_path / index_file.FILE_NAME
    spoil(path)
    before = path.read_bytes()
    said: list[str] = []
    with RunIndex(tmp_path, said.append) as index:
        assert index.find(RunQuery()).total == 0
        assert index.stale
        index.add(some_row())
        assert index.find(RunQuery()).rows == (some_row(),)
    (aside,) = tmp_path.glob("*.aside")
    assert aside.read_bytes() == before
    (sentence,) = said
    assert what in sentence and aside.name in sentence


@pytest.mark.parametrize(
    "change",
    [
        "DELETE FROM details",
        "UPDATE runs SET labels = 'none'",
        "UPDATE runs SET labels = '[1, {}]'",
        "UPDATE runs SET labels = '" + "[" * 100_000 + "'",
        "UPDATE runs SET scene = CAST(x'fffe' AS TEXT)",
    ],
)
def test_rows_that_we_never_write_are_damage(tmp_path: Path, change: str):
    """The tables are ours, and what is in them is not."""
    (tmp_path / "a.rrd").touch()
    with RunIndex(tmp_path) as index:
        index.add(some_row())
    with contextlib.closing(sqlite3.connect(tmp_path / index_file.FILE_NAME)) as database, database:
        database.execute(change)
    told: list[str] = []
    with RunIndex(tmp_path, told.append) as index:
        assert index.find(RunQuery()).rows == () and index.stale
        assert index.refresh(read=lambda paths: ((path, some_row()) for path in paths)).read == 1
        assert index.find(RunQuery()).rows == (some_row(),)
    (sentence,) = told
    assert "is damaged; it is kept as" in sentence


def test_rows_of_files_elsewhere_are_forgotten(tmp_path: Path):
    folder = tmp_path / "recordings"
    (tmp_path / "secret.rrd").touch()
    with RunIndex(folder) as index:
        index.add(some_row())
    with contextlib.closing(sqlite3.connect(folder / index_file.FILE_NAME)) as database, database:
        database.execute("UPDATE runs SET file = '../secret.rrd'")
    with RunIndex(folder) as index:
        assert index.refresh().removed == 1
        assert index.find(RunQuery()).total == 0


def test_damage_while_open_is_noticed(tmp_path: Path):
    """By both that have it open; one of them renames it, the other finds the new one."""
    said: list[str] = []
    with RunIndex(tmp_path, said.append) as one, RunIndex(tmp_path, said.append) as other:
        one.add_all([some_row(f"{number}.rrd") for number in range(300)])
        assert other.find(RunQuery()).total == 300
        one._connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        with one.path.open("r+b") as file:
            file.seek(4096)
            file.write(b"\xff" * (one.path.stat().st_size - 4096))
        for number in range(3):
            one.add(some_row(f"one-{number}.rrd"))
            other.add(some_row(f"other-{number}.rrd"))
        files = {row.file for row in one.find(RunQuery(), None).rows}
        assert files == {row.file for row in other.find(RunQuery(), None).rows}
        assert "other-2.rrd" in files and "one-2.rrd" in files
        assert one.stale and other.stale
    assert len(list(tmp_path.glob("*.aside"))) == 1 == len(said)


@pytest.mark.parametrize("spoil", [schema_without_text, unknown_format])
def test_a_damaged_list_is_made_anew_by_reindex(
    tmp_path: Path, spoil: Callable[[Path], None], capsys: pytest.CaptureFixture[str]
):
    spoil(tmp_path / index_file.FILE_NAME)
    assert reindex(tmp_path) == 0
    said = capsys.readouterr()
    assert "is damaged; it is kept as" in said.err and said.out.startswith("0 runs in ")


KILLED = """
import os, pathlib, signal, sys
from run_rows import some_row
from spherloc_viz.recording.index.run_index import RunIndex

index = RunIndex(pathlib.Path(sys.argv[1]))
index.add_all([some_row(f"{number}.rrd") for number in range(20)])
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize("gone", ["", "-wal", "database"])
def test_the_log_that_a_killed_process_leaves_behind_does_no_harm(tmp_path: Path, gone: str):
    """It has what was listed last; whoever opens the list next takes that over, and removes it. Without it, or with
    nothing else, the runs are read from their files again."""
    for number in range(20):
        (tmp_path / f"{number}.rrd").touch()
    done = subprocess.run([sys.executable, "-c", KILLED, tmp_path], cwd=Path(__file__).parent, check=False)
    path = tmp_path / index_file.FILE_NAME
    log = path.with_name(f"{path.name}-wal")
    assert done.returncode == -signal.SIGKILL and log.stat().st_size > 0
    if gone:
        (log if gone == "-wal" else path).unlink()
    told: list[str] = []
    with RunIndex(tmp_path, told.append) as index:
        known = index.find(RunQuery(), None).total
        assert known == 20 if not gone else known in (0, 20)
        rows = index.refresh(read=lambda paths: ((path, some_row(path.name)) for path in paths))
        assert index.find(RunQuery(), None).total == 20 and not rows.skipped
    assert not told and not log.exists() and len(list(tmp_path.glob("runs.sqlite*"))) == 1


def test_a_deleted_database_is_made_anew(index: RunIndex):
    index.add(some_row())
    index.path.unlink()
    index.add(some_row("b.rrd"))
    assert [row.file for row in index.find(RunQuery()).rows] == ["b.rrd"]
    assert index.stale


def test_a_folder_that_was_away_is_listed_again(tmp_path: Path):
    folder, away = tmp_path / "recordings", tmp_path / "away"
    with RunIndex(folder) as index:
        index.add(some_row())
        folder.rename(away)
        assert index.find(RunQuery()).total == 0 and not folder.exists()
        away.rename(folder)
        assert index.find(RunQuery()).rows == (some_row(),)


def test_a_failing_disk_is_a_sentence(tmp_path: Path):
    """What a full one says of the file that SQLite keeps beside the list."""
    error = sqlite3.OperationalError("disk I/O error")
    error.sqlite_errorcode = sqlite3.SQLITE_IOERR_SHMSIZE  # its upper bits only refine it
    told = index_file.sentence(tmp_path, error)
    assert "cannot be read or written (disk I/O error); make room" in told


def test_a_locked_database_is_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(index_file, "BUSY_S", 0.05)
    with RunIndex(tmp_path) as index, contextlib.closing(sqlite3.connect(index.path)) as other:
        index.add(some_row())
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(RecordingError, match="another program has locked the list of runs"):
            index.add(some_row("b.rrd"))
        assert index.get("a.rrd") is not None, "readers don't wait for writers"
        other.rollback()
        index.add(some_row("b.rrd"))
        assert index.find(RunQuery()).total == 2


def test_a_folder_that_cannot_be_written_is_listed_from_memory(tmp_path: Path):
    (tmp_path / index_file.FILE_NAME).mkdir()
    said: list[str] = []
    with RunIndex(tmp_path, said.append) as index:
        index.add(some_row())
        assert index.find(RunQuery()).rows == (some_row(),)
    assert len(said) == 1 and "cannot be written" in said[0]


def test_a_list_that_may_only_be_read_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """As in a folder of somebody else: changes stay in memory, and the file as it is."""
    with RunIndex(tmp_path) as index:
        index.add(some_row())
    before = index.path.read_bytes()
    monkeypatch.setattr(index_file.os, "access", lambda path, mode: False)
    said: list[str] = []
    with RunIndex(tmp_path, said.append) as index:
        assert index.find(RunQuery()).rows == (some_row(),)
        index.add(some_row("b.rrd"))
        assert index.find(RunQuery()).total == 2
    assert len(said) == 1 and "cannot be written" in said[0]
    assert index.path.read_bytes() == before and len(list(tmp_path.iterdir())) == 1


def test_a_closed_index_says_so(tmp_path: Path):
    with RunIndex(tmp_path) as index:
        pass
    with pytest.raises(RecordingError, match="has been closed"):
        index.find(RunQuery())
