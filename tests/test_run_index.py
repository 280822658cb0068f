"""The list of runs: every filter against plain Python, several writers at once, and files that go bad."""

import contextlib
import os
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from run_rows import random_row, some_row

from spherloc.diagnosis import Cause
from spherloc.errors import InputError, RecordingError
from spherloc_viz.recording.index import file as index_file
from spherloc_viz.recording.index.query import GROUP_KEYS, SORT_KEYS, Range, RunQuery
from spherloc_viz.recording.index.run_index import RunIndex
from spherloc_viz.recording.review.notes import Review, read_review, review_path, write_review
from spherloc_viz.recording.run_row import RunRow

ROOT = Path(__file__).resolve().parents[1]
RANGES = ("outlier_rate", "rotation_error_deg", "translation_error_m", "inliers", "correspondences", "time_ms")


@pytest.fixture
def index(tmp_path: Path) -> Iterator[RunIndex]:
    with RunIndex(tmp_path / "recordings") as index:
        yield index


@pytest.fixture
def rows(index: RunIndex, rng: np.random.Generator) -> list[RunRow]:
    rows = [random_row(rng, number) for number in range(300)]
    index.add_all(rows)
    return rows


def within(limits: Range, value: float | None) -> bool:
    if value is None:
        return False
    low = value > limits.low if limits.low_open else value >= limits.low
    return low and (value < limits.high if limits.high_open else value <= limits.high)


def wanted(query: RunQuery, row: RunRow) -> bool:
    """What a query means, in plain Python."""
    exact = ("estimator", "outcome", "diagnosis", "doubtful", "source", "problem_key")
    if any(getattr(query, name) is not None and getattr(query, name) != getattr(row, name) for name in exact):
        return False
    for name in RANGES:
        if (limits := getattr(query, name)) is not None and not within(limits, getattr(row, name)):
            return False
    texts = (row.scene, row.name, row.query or "", row.message, row.summary, row.note, row.file, row.title, *row.labels)
    haystack = "\n".join(texts).casefold()
    return (
        all(word in haystack for word in (query.text or "").casefold().split())
        and (query.label is None or query.label in row.labels)
        and (query.since is None or row.created >= query.since)
        and (query.until is None or row.created < query.until)
    )


def in_order(query: RunQuery, rows: list[RunRow]) -> list[str]:
    """The files of a query's answer, in plain Python."""
    found = [row for row in rows if wanted(query, row)]
    known = [row for row in found if getattr(row, query.sort) is not None]
    unknown = [row for row in found if getattr(row, query.sort) is None]
    known.sort(key=lambda row: (getattr(row, query.sort), row.file), reverse=query.descending)
    unknown.sort(key=lambda row: row.file, reverse=query.descending)
    return [row.file for row in known + unknown]


def random_query(rng: np.random.Generator, rows: list[RunRow]) -> RunQuery:
    """One to four filters, each with a value that some run has, and any order."""
    row = rows[rng.integers(len(rows))]
    names = [
        "text",
        "estimator",
        "outcome",
        "diagnosis",
        "doubtful",
        "label",
        "source",
        "problem_key",
        "since",
        "until",
    ]
    chosen: dict[str, Any] = {}
    for name in rng.choice([*names, *RANGES], size=rng.integers(1, 5), replace=False).tolist():
        if name == "text":
            chosen[name] = f"{row.name.upper()} {row.summary[1:3]}"
        elif name == "label":
            chosen[name] = (*row.labels, "none")[0]
        elif name in ("since", "until"):
            chosen[name] = row.created
        elif name in RANGES:
            low, high = sorted(getattr(rows[k], name) or 0.0 for k in rng.integers(len(rows), size=2))
            open_ends = rng.random(2) < 0.5
            chosen[name] = Range(low, high, bool(open_ends[0]), bool(open_ends[1]))
        else:
            chosen[name] = getattr(row, name)
    return RunQuery(**chosen, sort=SORT_KEYS[rng.integers(len(SORT_KEYS))], descending=bool(rng.random() < 0.5))


def test_rows_come_back_as_they_are(index: RunIndex, rows: list[RunRow]):
    for row in rows:
        assert index.get(row.file) == row
    assert set(index.find(RunQuery(), limit=None).rows) == set(rows)
    assert index.bytes() == sum(row.size_bytes for row in rows)
    assert index.get("nobody.rrd") is None


def test_every_filter_and_order_finds_what_python_finds(index: RunIndex, rows: list[RunRow], rng: np.random.Generator):
    sizes = []
    for _ in range(300):
        query = random_query(rng, rows)
        found = index.find(query, limit=None)
        assert [row.file for row in found.rows] == in_order(query, rows), query
        assert found.total == len(found.rows)
        sizes.append(found.total)
    assert sum(size > 0 for size in sizes) > 100 and sum(size == 0 for size in sizes) > 3


@pytest.mark.parametrize("sort", SORT_KEYS)
def test_pages_join_to_the_whole(index: RunIndex, rows: list[RunRow], sort: str):
    query = RunQuery(sort=sort)
    pages = [index.find(query, 70, offset) for offset in range(0, len(rows), 70)]
    assert [row.file for page in pages for row in page.rows] == in_order(query, rows)
    assert {page.total for page in pages} == {len(rows)}
    assert index.find(query, 70, 10 * len(rows)).rows == ()


@pytest.mark.parametrize("by", GROUP_KEYS)
def test_groups_count_what_is_found(index: RunIndex, rows: list[RunRow], by: str):
    query = RunQuery(outcome="failure")
    counts: dict[str, int] = {}
    for row in (row for row in rows if wanted(query, row)):
        for value in row.labels if by == "label" else (getattr(row, by),):
            counts[value] = counts.get(value, 0) + 1
    found = index.groups(query, by)
    assert dict(found) == counts
    assert [count for _, count in found] == sorted(counts.values(), reverse=True)


def test_unknown_group_and_order_are_sentences(index: RunIndex):
    with pytest.raises(InputError, match="grouped by 'seed; --': choose one of diagnosis, "):
        index.groups(RunQuery(), "seed; --")
    with pytest.raises(InputError, match="sorted by '1; DROP TABLE runs': choose one of created, "):
        RunQuery(sort="1; DROP TABLE runs")


@pytest.mark.parametrize(
    "text", ["%", "_", "'", '"', "\\", "%a", "a_", "x'; DROP TABLE runs; --", "ÄÖ", "äö", "雪", "*", "a OR b"]
)
def test_text_is_searched_for_as_it_is(index: RunIndex, text: str):
    """No letter of it is a wildcard or SQL."""
    index.add_all([some_row("with.rrd", note=f"before {text} after"), some_row("without.rrd", note="neither")])
    assert [row.file for row in index.find(RunQuery(text=text)).rows] == ["with.rrd"]
    for name in ("label", "scene", "estimator", "diagnosis", "outcome", "source", "problem_key"):
        assert index.find(RunQuery(**{name: text})).total == 0


@pytest.mark.parametrize("scene", ["scenes/street.toml", "street", "street.toml"])
def test_scene_is_found_by_its_file_name(index: RunIndex, scene: str):
    names = (
        "scenes/street.toml",
        "street",
        "street.toml",
        "scenes/my_street.toml",
        "scenes/street2.toml",
        "streets/a.toml",
    )
    index.add_all([some_row(f"{number}.rrd", scene=name, name="") for number, name in enumerate(names)])
    found = {row.scene for row in index.find(RunQuery(scene=scene)).rows}
    assert "scenes/street.toml" in found
    assert found <= set(names[:3])


def test_a_row_replaces_that_of_the_same_file(index: RunIndex):
    index.add(some_row(labels=("old", "both"), note="before"))
    index.add(some_row(labels=("both", "new"), note="after", inliers=1))
    assert index.find(RunQuery()).rows == (some_row(labels=("both", "new"), note="after", inliers=1),)
    assert dict(index.groups(RunQuery(), "label")) == {"both": 1, "new": 1}
    assert index.find(RunQuery(text="before")).total == 0
    index.remove("a.rrd")
    assert index.find(RunQuery()).total == 0 and index.groups(RunQuery(), "label") == ()


@pytest.mark.parametrize(
    "file", ["../a.rrd", "/etc/a.rrd", "a/b.rrd", "gallery/../a.rrd", "a\\b.rrd", "a.txt", "", "a\n.rrd"]
)
def test_files_outside_the_folder_are_refused(index: RunIndex, file: str):
    with pytest.raises(RecordingError, match="not the name of a recording"):
        index.add(some_row(file))
    with pytest.raises(RecordingError, match="not the name of a recording"):
        index.set_review(file, ["x"], "")
    assert index.find(RunQuery()).total == 0


@pytest.mark.parametrize("change", [{"seed": 2**70}, {"name": "\ud800"}, {"time_ms": None}, {"scene": object()}])
def test_a_row_that_cannot_be_stored_is_a_sentence(index: RunIndex, change: dict[str, Any]):
    """And takes none of the others with it."""
    index.add(some_row())
    with pytest.raises(RecordingError, match="list"):
        index.add_all([some_row("b.rrd"), some_row("c.rrd", **change)])
    assert [row.file for row in index.find(RunQuery()).rows] == ["a.rrd"]


def test_oldest_successes_are_those_that_nobody_will_look_for(index: RunIndex):
    fine = {"outcome": "success", "doubtful": False}
    kept = [{"outcome": "failure"}, {"labels": ("x",)}, {"note": "x"}, {"source": "gallery"}, {"doubtful": True}]
    kept += [{"outcome": "unknown", "doubtful": None}, {"outcome": "unknown", "doubtful": True}]
    times = [f"2026-01-{day:02d}T00:00:00.000+00:00" for day in range(1, 20)]
    for number, change in enumerate(kept):
        index.add(some_row(f"kept-{number}.rrd", **fine | {"created": times[0]} | change))
    index.add(some_row("third.rrd", **fine | {"created": times[3]}))
    index.add(some_row("first.rrd", **fine | {"created": times[1]}))
    index.add(some_row("second.rrd", **fine | {"created": times[2], "outcome": "unknown"}))
    assert [row.file for row in index.oldest_successes()] == ["first.rrd", "second.rrd", "third.rrd"]
    assert [row.file for row in index.oldest_successes(limit=1)] == ["first.rrd"]


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
            _, errors = process.communicate(timeout=200)
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


@pytest.mark.parametrize(
    "spoil, what",
    [
        (foreign, "is a database of another program"),
        (with_trigger, "was made by another version"),
        (newer, "was made by another version"),
        (damaged, "is damaged"),
        (truncated, "is damaged"),
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


def test_a_deleted_database_is_made_anew(index: RunIndex):
    index.add(some_row())
    index.path.unlink()
    index.add(some_row("b.rrd"))
    assert [row.file for row in index.find(RunQuery()).rows] == ["b.rrd"]
    assert index.stale


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


class Files:
    """A folder of files that stand for recordings, and a reader that counts what it is asked for."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.read: list[str] = []
        (folder / "gallery").mkdir(parents=True, exist_ok=True)

    def write(self, *names: str, content: str = "run") -> None:
        for name in names:
            (self.folder / name).write_text(content)

    def examine(self, paths: Any) -> Iterator[tuple[Path, RunRow | RecordingError]]:
        for path in paths:
            self.read.append(path.relative_to(self.folder).as_posix())
            text = path.read_text()
            if "bad" in text:
                yield path, RecordingError(f"{path}: is bad.")
            else:
                review = read_review(path)
                yield path, some_row(path.name, labels=review.labels, note=review.note, name=text)


def test_refresh_reads_only_what_is_new_or_has_changed(index: RunIndex):
    files = Files(index.folder)
    files.write("a.rrd", "b.rrd", "gallery/c.rrd", "notes.txt", "d.rrd.part", "e.review.rrd")
    assert index.stale
    done = index.refresh(examine=files.examine)
    assert (done.read, done.removed, done.skipped, index.stale) == (3, 0, (), False)
    assert sorted(files.read) == ["a.rrd", "b.rrd", "gallery/c.rrd"]
    assert {row.file for row in index.find(RunQuery()).rows} == {"a.rrd", "b.rrd", "gallery/c.rrd"}
    files.read.clear()
    assert index.refresh(examine=files.examine).read == 0 and files.read == []
    files.write("b.rrd", content="another run")
    (index.folder / "a.rrd").unlink()
    write_review(index.folder / "gallery" / "c.rrd", ["seen"], "", run_id="1b2c")
    index.add(some_row("new.rrd"))
    files.write("bad.rrd", content="bad")
    done = index.refresh(examine=files.examine)
    assert (done.read, done.removed) == (2, 2), "b and c are read again; a and new have no file"
    assert files.read == ["b.rrd", "bad.rrd", "gallery/c.rrd"]
    assert done.skipped == (("bad.rrd", f"{index.folder / 'bad.rrd'}: is bad."),)
    row = index.get("gallery/c.rrd")
    assert row is not None and row.labels == ("seen",)
    files.read.clear()
    assert index.refresh(examine=files.examine).skipped == done.skipped and files.read == [], "known to be bad"
    files.write("bad.rrd", content="good now")
    assert index.refresh(examine=files.examine).skipped == ()
    files.write("b.rrd", content="bad now")
    index.refresh(examine=files.examine)
    assert index.get("b.rrd") is None, "it was a run once"


def test_files_whose_names_no_recording_has_are_left_out(index: RunIndex):
    """They would be links on a page, and paths in commands."""
    files = Files(index.folder)
    names = ["my run.rrd", "<img src=x>.rrd", "a;b.rrd", "é.rrd"]
    files.write("good.rrd", *names)
    with contextlib.suppress(OSError):  # some systems have Unicode names only
        (Path(os.fsdecode(bytes(index.folder) + b"/\xff.rrd"))).write_text("run")
        names.append("\\udcff.rrd")
    for _ in range(2):
        done = index.refresh(examine=files.examine)
        assert {file for file, _ in done.skipped} == set(names)
        assert all("not the name of a recording" in sentence for _, sentence in done.skipped)
    assert files.read == ["good.rrd"]
    assert [row.file for row in index.find(RunQuery()).rows] == ["good.rrd"]


def test_rebuild_reads_all_and_says_how_far_it_is(index: RunIndex):
    files = Files(index.folder)
    files.write(*(f"{number}.rrd" for number in range(45)))
    index.refresh(examine=files.examine)
    index.add(replace(some_row("7.rrd"), inliers=999))
    told: list[tuple[int, int]] = []
    done = index.rebuild(lambda *far: told.append(far), files.examine)
    assert done.read == 45 and len(files.read) == 90
    assert told[0] == (0, 45) and told[-1] == (45, 45) and told == sorted(told)
    row = index.get("7.rrd")
    assert row is not None and row.inliers == some_row().inliers


def test_rebuild_notices_damage_that_no_query_has_met(tmp_path: Path):
    files = Files(tmp_path)
    said: list[str] = []
    with RunIndex(tmp_path, said.append) as index:
        files.write(*(f"{number}.rrd" for number in range(200)))
        index.refresh(examine=files.examine)
    size = index.path.stat().st_size
    with index.path.open("r+b") as file:
        file.seek(size // 2)
        file.write(b"\xff" * 5000)
    with RunIndex(tmp_path, said.append) as index:
        assert index.rebuild(examine=files.examine).read == 200
        assert index.find(RunQuery()).total == 200
    assert len(said) == 1 and "is damaged" in said[0]


def test_a_label_given_during_a_refresh_stays(index: RunIndex):
    files = Files(index.folder)
    files.write("a.rrd")

    def slow(paths: Any) -> Iterator[tuple[Path, RunRow | RecordingError]]:
        found = list(files.examine(paths))
        index.add(some_row())
        index.set_review("a.rrd", ["meanwhile"], "")
        yield from found

    index.refresh(examine=slow)
    row = index.get("a.rrd")
    assert row is not None and row.labels == ("meanwhile",)


def test_a_refresh_can_be_stopped(index: RunIndex):
    files = Files(index.folder)
    files.write(*(f"{number}.rrd" for number in range(45)))

    class StoppedError(Exception):
        pass

    def stop(done: int, total: int) -> None:
        if done:
            raise StoppedError

    with pytest.raises(StoppedError):
        index.refresh(stop, files.examine)
    assert index.stale
    assert 0 < index.refresh(examine=files.examine).read < 45


def test_review_is_stored_with_the_run_and_found(index: RunIndex):
    index.add(some_row(run_id="the-id"))
    (index.folder / "a.rrd").write_text("a run")
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
    with RunIndex(tmp_path) as one, RunIndex(tmp_path) as other:
        (tmp_path / "a.rrd").write_text("a run")
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


def test_causes_fit_the_filter(index: RunIndex):
    """Every diagnosis that there is can be asked for."""
    index.add_all([some_row(f"{number}.rrd", diagnosis=cause.value) for number, cause in enumerate(Cause)])
    for cause in Cause:
        assert [row.diagnosis for row in index.find(RunQuery(diagnosis=cause.value)).rows] == [cause.value]


def test_the_benchmark_runs(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """Its peer finds the same; no time is asserted."""
    from benchmarks import run_index

    monkeypatch.setattr(sys, "argv", ["run_index", "--runs", "40", "--repeats", "1"])
    run_index.main()
    out = capsys.readouterr().out
    assert out.startswith("40 runs, ") and "the slowest takes" in out and "by reading JSON" in out
