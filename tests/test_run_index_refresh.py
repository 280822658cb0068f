"""The list of runs follows the files: what is new, changed, gone or no recording."""

import contextlib
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from run_rows import some_row

from spherloc.errors import RecordingError
from spherloc_viz.recording.index.query import RunQuery
from spherloc_viz.recording.index.run_index import RunIndex
from spherloc_viz.recording.review_file import read_review, write_review
from spherloc_viz.recording.run_row import RunRow


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


def test_names_in_capitals_are_listed_too(index: RunIndex):
    files = Files(index.folder)
    files.write("a.RRD", "b.Rrd", "c.REVIEW.RRD", "d.rrdx")
    done = index.refresh(read=files.examine)
    assert (done.read, done.skipped) == (2, ()) and sorted(files.read) == ["a.RRD", "b.Rrd"]
    write_review(index.folder / "a.RRD", ["seen"], "", run_id="1b2c")
    assert index.refresh(read=files.examine).read == 1
    assert {row.file: row.labels for row in index.find(RunQuery()).rows} == {"a.RRD": ("seen",), "b.Rrd": ()}


def test_refresh_reads_only_what_is_new_or_has_changed(index: RunIndex):
    files = Files(index.folder)
    files.write("a.rrd", "b.rrd", "gallery/c.rrd", "notes.txt", "d.rrd.part", "e.review.rrd")
    assert index.stale
    done = index.refresh(read=files.examine)
    assert (done.read, done.removed, done.skipped, index.stale) == (3, 0, (), False)
    assert sorted(files.read) == ["a.rrd", "b.rrd", "gallery/c.rrd"]
    assert {row.file for row in index.find(RunQuery()).rows} == {"a.rrd", "b.rrd", "gallery/c.rrd"}
    files.read.clear()
    assert index.refresh(read=files.examine).read == 0 and files.read == []
    files.write("b.rrd", content="another run")
    (index.folder / "a.rrd").unlink()
    write_review(index.folder / "gallery" / "c.rrd", ["seen"], "", run_id="1b2c")
    index.add(some_row("new.rrd"))
    files.write("bad.rrd", content="bad")
    done = index.refresh(read=files.examine)
    assert (done.read, done.removed) == (2, 2), "b and c are read again; a and new have no file"
    assert files.read == ["b.rrd", "bad.rrd", "gallery/c.rrd"]
    assert done.skipped == (("bad.rrd", f"{index.folder / 'bad.rrd'}: is bad."),)
    row = index.get("gallery/c.rrd")
    assert row is not None and row.labels == ("seen",)
    files.read.clear()
    assert index.refresh(read=files.examine).skipped == done.skipped and files.read == [], "known to be bad"
    files.write("bad.rrd", content="good now")
    assert index.refresh(read=files.examine).skipped == ()
    files.write("b.rrd", content="bad now")
    index.refresh(read=files.examine)
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
        done = index.refresh(read=files.examine)
        assert {file for file, _ in done.skipped} == set(names)
        assert all("not the name of a recording" in sentence for _, sentence in done.skipped)
    assert files.read == ["good.rrd"]
    assert [row.file for row in index.find(RunQuery()).rows] == ["good.rrd"]


def test_rebuild_reads_all_and_says_how_far_it_is(index: RunIndex):
    files = Files(index.folder)
    files.write(*(f"{number}.rrd" for number in range(45)))
    index.refresh(read=files.examine)
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
        index.refresh(read=files.examine)
    size = index.path.stat().st_size
    with index.path.open("r+b") as file:
        file.seek(size // 2)
        file.write(b"\xff" * 5000)
    with RunIndex(tmp_path, said.append) as index:
        assert index.rebuild(read=files.examine).read == 200
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

    index.refresh(read=slow)
    row = index.get("a.rrd")
    assert row is not None and row.labels == ("meanwhile",)


def test_a_refresh_can_be_stopped(index: RunIndex):
    files = Files(index.folder)
    files.write(*(f"{number}.rrd" for number in range(145)))

    class StoppedError(Exception):
        pass

    def stop(done: int, total: int) -> None:
        if done:
            raise StoppedError

    with pytest.raises(StoppedError):
        index.refresh(stop, files.examine)
    assert index.stale
    assert 0 < index.refresh(read=files.examine).read < 145
