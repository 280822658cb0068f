"""A little of the attack with damaged files: each is read or refused in a sentence, and what went wrong is seen."""

import shutil
from pathlib import Path

import pytest

from benchmarks.attack.files import Tally, attack_files
from benchmarks.attack.kinds import KINDS, Kind
from benchmarks.attack.worker import tried
from spherloc.errors import InputError

QUICK = (
    "simulation (TOML)",
    "scene of matches (TOML)",
    "matches (CSV)",
    "calibration (YAML, JSON, TOML)",
    "upload (CSV, calibration, form)",
    "COLMAP, binary",
    "COLMAP, text",
    "kapture",
    "hloc (HDF5, lists)",
    "folder of images",
    "images (PNG, JPEG, ...)",
    "trajectories (TUM, EuRoC, ...)",
)
"""Those whose intact files are there in a moment. The others have tests of their own beside ``benchmarks.attack``."""


def test_damaged_files_are_read_or_refused_in_a_sentence() -> None:
    tallies = attack_files(200, 11, 1, QUICK, lambda done: None)
    assert not [(name, answer) for name, tally in tallies.items() for answer in tally.wrong]
    outcomes = [sum(tally.outcomes[outcome] for tally in tallies.values()) for outcome in ("sentence", "accepted")]
    assert sum(outcomes) >= 195 and min(outcomes) > 20, "some damage is harmless, some is not"


@pytest.mark.parametrize(
    ("error", "outcome"),
    [
        (InputError("a.txt: is no list; give one."), "sentence"),
        (InputError("no end"), "bad sentence"),
        (KeyError("a"), "traceback"),
        (MemoryError(), "traceback"),
        (None, "accepted"),
    ],
)
def test_what_a_reader_does_is_seen_and_undone(tmp_path: Path, error: Exception | None, outcome: str) -> None:
    seen: list[bytes] = []

    def read(folder: Path, damaged: Path) -> None:
        seen.append(damaged.read_bytes() if damaged.is_file() and not damaged.is_symlink() else b"")
        if error is not None:
            raise error

    intact, folder = tmp_path / "intact", tmp_path / "copy"
    intact.mkdir()
    (intact / "a.txt").write_text("1 2 3\n" * 20)
    shutil.copytree(intact, folder)
    kind, tally = Kind(lambda folder: None, ("*.txt",), read), Tally()
    for number in range(20):
        tally.add(tried(kind, "numbers", number, 3, intact, folder))
        assert (folder / "a.txt").read_text() == (intact / "a.txt").read_text()
    assert tally.outcomes == {outcome: 20} and len(set(seen)) > 10
    assert len(tally.wrong) == (0 if outcome in ("sentence", "accepted") else 20)
    before = list(seen)
    seen.clear()
    for number in range(20):
        tried(kind, "numbers", number, 3, intact, folder)
    assert seen == before, "a seed and a number give the same file again"
    assert set(QUICK) <= set(KINDS)
