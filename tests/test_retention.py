"""What is kept and what makes room: failures for ever, old successes while there is room, and nothing in silence."""

import math
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from run_rows import some_row

from spherloc.errors import InputError, RecordingError
from spherloc_viz.recording.index.query import RunQuery
from spherloc_viz.recording.index.run_index import RunIndex
from spherloc_viz.recording.reviews import review_path
from spherloc_viz.recording.run_row import RunRow
from spherloc_viz.recording.storage.room import KEEP_BYTES, kept_bytes
from spherloc_viz.recording.storage.store import LOG_NAME, NEWEST_KEPT, prunable, prune
from tests.needs import needs

SIZE = 1000

SUCCESS = some_row(
    created="",
    name="a street\twith a tab",
    outcome="success",
    diagnosis="ok",
    doubtful=False,
    size_bytes=SIZE,
    thumbnail=b"",
)
FAILURE = replace(SUCCESS, outcome="failure", doubtful=True, diagnosis="too few inliers")
UNKNOWN = replace(SUCCESS, outcome="unknown")
KEPT = (
    FAILURE,
    replace(FAILURE, doubtful=False),
    replace(UNKNOWN, doubtful=True),
    replace(UNKNOWN, doubtful=None),
    replace(SUCCESS, labels=("keep",)),
    replace(SUCCESS, note="look again"),
    replace(SUCCESS, source="gallery", title="A case"),
)


def fill(index: RunIndex, rows: list[RunRow]) -> list[str]:
    """Files of these runs, made one after another; their names."""
    listed = []
    for number, row in enumerate(rows):
        named = replace(row, file=f"{number:04}.rrd", created=f"2026-01-01T00:{number // 60:02}:{number % 60:02}.000Z")
        (index.folder / named.file).write_bytes(bytes(SIZE))
        listed.append(named)
    index.add_all(listed)
    return [row.file for row in listed]


def files(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.glob("*.rrd"))


def log_of(folder: Path) -> list[list[str]]:
    path = folder / LOG_NAME
    return [line.split("\t") for line in path.read_text().splitlines()] if path.exists() else []


def test_only_what_nobody_will_look_for_may_go() -> None:
    assert prunable(replace(SUCCESS, file="a.rrd")) and prunable(replace(UNKNOWN, file="a.rrd"))
    assert prunable(replace(SUCCESS, file="a.rrd", doubtful=True))  # it is right, whatever was said about it
    assert not any(prunable(replace(row, file="a.rrd")) for row in KEPT)
    assert not prunable(replace(SUCCESS, file="gallery/a.rrd"))


def test_the_oldest_successes_make_room_and_are_written_down(tmp_path: Path, rng: np.random.Generator) -> None:
    rows = [(*KEPT, SUCCESS, UNKNOWN)[kind] for kind in rng.integers(0, len(KEPT) + 2, 60)]
    with RunIndex(tmp_path) as index:
        names = fill(index, rows + [SUCCESS] * NEWEST_KEPT)
        may_go = [name for name, row in zip(names, rows, strict=False) if row in (SUCCESS, UNKNOWN)]
        assert len(may_go) > 6
        keep_bytes = (len(names) - 6) * SIZE + SIZE // 2
        done = prune(tmp_path, index, keep_bytes)
        assert list(done.files) == may_go[:6] and (done.freed_bytes, done.left_bytes) == (6 * SIZE, index.bytes())
        assert not done.over and index.bytes() == (len(names) - 6) * SIZE
        assert files(tmp_path) == sorted(set(names) - set(done.files))
        assert index.find(RunQuery(), limit=None).total == len(names) - 6
        assert done.sentence == (
            "6 old successes were deleted (0.006 MB), since the recordings took more than 0.0745 MB; "
            "pruned.log names them."
        )
        assert [cells[1] for cells in log_of(tmp_path)] == may_go[:6]
        assert {tuple(cells[2:5]) for cells in log_of(tmp_path)} == {("a street with a tab", "mc", "seed 7")}
        again = prune(tmp_path, index, keep_bytes)
        assert again.files == () and again.sentence == "" and len(log_of(tmp_path)) == 6


def test_failures_labelled_and_new_runs_stay_even_where_there_is_no_room(tmp_path: Path) -> None:
    with RunIndex(tmp_path) as index:
        names = fill(index, [*KEPT, SUCCESS, *[SUCCESS] * NEWEST_KEPT])
        done = prune(tmp_path, index, 1)
        assert done.files == (names[len(KEPT)],) and done.over
        assert files(tmp_path) == sorted(set(names) - set(done.files))


def test_a_run_that_was_labelled_since_it_was_listed_stays(tmp_path: Path) -> None:
    with RunIndex(tmp_path) as index:
        names = fill(index, [SUCCESS] * (NEWEST_KEPT + 3))
        review_path(tmp_path / names[0]).write_bytes(b"labels")
        (tmp_path / names[1]).unlink()  # somebody else has deleted it
        done = prune(tmp_path, index, 1)
        assert done.files == (names[2],) and [cells[1] for cells in log_of(tmp_path)] == [names[2]]
        assert (tmp_path / names[0]).exists() and index.get(names[0]) is not None and index.get(names[1]) is None


def test_nothing_is_deleted_that_cannot_be_written_down(tmp_path: Path) -> None:
    with RunIndex(tmp_path) as index:
        names = fill(index, [SUCCESS] * (NEWEST_KEPT + 3))
        (tmp_path / LOG_NAME).mkdir()
        with pytest.raises(RecordingError, match=r"pruned\.log: cannot be written .* no old success is deleted"):
            prune(tmp_path, index, 1)
        assert files(tmp_path) == names


def test_many_at_once_delete_no_more_than_one_alone(tmp_path: Path) -> None:
    with RunIndex(tmp_path) as index, RunIndex(tmp_path) as other:
        names = fill(index, [SUCCESS] * 70)
        start, results = threading.Barrier(4), []

        def work(own: RunIndex) -> None:
            start.wait()
            results.append(prune(tmp_path, own, 50 * SIZE))

        threads = [threading.Thread(target=work, args=(own,)) for own in (index, other, index, other)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        gone = [file for done in results for file in done.files]
        # Each of the others may have chosen one more before it heard of the last.
        assert len(results) == 4 and 20 <= len(gone) == len(set(gone)) <= 23
        assert sorted(gone) == names[: len(gone)] and files(tmp_path) == names[len(gone) :]
        assert index.bytes() == SIZE * (70 - len(gone))
        assert set(gone) <= {cells[1] for cells in log_of(tmp_path)}


def test_sizes_to_be_kept(tmp_path: Path) -> None:
    assert kept_bytes(2.0, tmp_path) == KEEP_BYTES == 2 * 10**9 and kept_bytes(0.5, tmp_path) == 5 * 10**8
    assert kept_bytes(math.inf, tmp_path) > 10**18 and kept_bytes(1e300, tmp_path) > 10**18
    # To open a folder that was given more room deletes nothing, unless a size is said.
    assert kept_bytes(None, tmp_path / "missing") == kept_bytes(None, tmp_path) == KEEP_BYTES
    (tmp_path / "gallery").mkdir()
    for name, size in (("a.rrd", 2 * 10**9), ("b.RRD", 9 * 10**8), ("gallery/c.rrd", 10**8), ("video.mp4", 10**9)):
        with (tmp_path / name).open("wb") as file:
            file.truncate(size)  # takes no room
    assert kept_bytes(None, tmp_path) == 3 * 10**9 and kept_bytes(2.0, tmp_path) == KEEP_BYTES
    for wrong in (0.0, -1.0, math.nan, -math.inf):
        with pytest.raises(InputError, match="give a positive number, or inf to keep all"):
            kept_bytes(wrong, tmp_path)


@needs("no superuser")
def test_what_cannot_be_deleted_stays_listed(tmp_path: Path) -> None:
    with RunIndex(tmp_path) as index:
        names = fill(index, [SUCCESS] * (NEWEST_KEPT + 1))
        (tmp_path / LOG_NAME).touch()
        tmp_path.chmod(0o500)
        try:
            assert prune(tmp_path, index, 1).files == ()
        finally:
            tmp_path.chmod(0o700)
        assert index.get(names[0]) is not None
