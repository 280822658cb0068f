"""The cache on disk: what was not used for long makes room, and nothing else."""

import os
import time
from pathlib import Path

from spherloc.disk_cache import TOUCH_S, UNUSED_S, make_room, store, used


def put(path: Path, size_bytes: int, unused_s: float) -> Path:
    assert store(path, bytes(size_bytes))
    when = time.time() - unused_s
    os.utime(path, (when, when))
    return path


def test_the_longest_unused_files_go_first_and_recent_ones_stay(tmp_path: Path) -> None:
    old = [put(tmp_path / f"{k}" / "render.png", 100, UNUSED_S * (5 - k)) for k in range(3)]
    recent = [put(tmp_path / f"recent-{k}.npz", 1_000, UNUSED_S - 3600.0) for k in range(3)]
    assert make_room(tmp_path, 3_300) == 0, "it all fits"
    assert make_room(tmp_path, 3_150) == 2
    assert [path.exists() for path in old] == [False, False, True]
    assert not old[0].parent.exists(), "an empty folder goes with its file"
    assert make_room(tmp_path, 0) == 1 and all(path.exists() for path in recent)


def test_a_file_that_is_used_again_stays(tmp_path: Path) -> None:
    one, other = (put(tmp_path / name, 100, 2 * UNUSED_S) for name in ("one", "other"))
    used(one)
    assert make_room(tmp_path, 0) == 1
    assert one.exists() and not other.exists()
    before = one.stat().st_mtime
    used(one)
    assert one.stat().st_mtime == before, "a use is noted once an hour"
    assert TOUCH_S < UNUSED_S
    used(tmp_path / "missing")


def test_a_folder_that_is_not_there_needs_no_room(tmp_path: Path) -> None:
    assert make_room(tmp_path / "none") == 0
