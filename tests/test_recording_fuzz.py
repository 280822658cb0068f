"""Recordings cut and changed at random: each one is read rightly or refused in a sentence, and nothing else happens."""

import os
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from hostile_recordings import message, places, with_index, with_message
from recording_samples import scene_problem
from rerun.chunk import Chunk, LazyChunkStream

from spherloc.errors import RecordingError
from spherloc.estimators import estimate
from spherloc_viz.recording.content.data import read_recording
from spherloc_viz.recording.content.writer import write_recording
from spherloc_viz.recording.index.query import RunQuery
from spherloc_viz.recording.index.run_index import RunIndex
from spherloc_viz.recording.run_row import RunRow
from spherloc_viz.recording.sandbox.examiner import Examiner, examine_all

Noise = Callable[[bytes, np.random.Generator], bytes]


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("good") / "good.rrd"
    write_recording(estimate(scene_problem("mei_outliers_80"), "mc"), path)
    return path


def flipped(content: bytes, rng: np.random.Generator) -> bytes:
    """One to three bits, anywhere."""
    changed = bytearray(content)
    for place in rng.integers(len(changed), size=rng.integers(1, 4)):
        changed[place] ^= 1 << rng.integers(8)
    return bytes(changed)


def lied(content: bytes, rng: np.random.Generator) -> bytes:
    """A number of 8 bytes replaced by one that is too small or too large."""
    place = 8 * rng.integers(len(content) // 8)
    number = rng.choice([-1, 0, 1 << 31, 10**9, 1 << 40, (1 << 63) - 1])
    return content[:place] + struct.pack("<q", number) + content[place + 8 :]


def cut(content: bytes, rng: np.random.Generator) -> bytes:
    return content[: rng.integers(len(content))]


def hostile_files(good: Path, rng: np.random.Generator, count: int) -> Iterator[bytes]:
    """Files with noise outside, within a chunk that is packed again, or in the index with a checksum that fits."""
    content = good.read_bytes()
    own = [entity for entity in places(good) if entity.startswith(("/data", "/__properties"))]
    for turn in range(count):
        noise: Noise = (flipped, lied)[rng.integers(2)]
        entity = str(rng.choice(own))
        match turn % 6:
            case 0:
                yield cut(content, rng)
            case 1:
                yield flipped(content, rng)
            case 2:
                yield with_message(good, entity, lambda m, noise=noise: noise(m, rng))
            case 3:
                offset, size = (struct.pack("<Q", number) for number in places(good)[entity])
                yield with_index(good, (offset, noise(offset, rng)), (size, noise(size, rng)))
            case _:
                yield with_message(good, entity, lambda m, noise=noise: message(m, change=lambda a: noise(a, rng)))


def test_whatever_passes_can_be_read_and_the_rest_is_one_sentence(
    good: Path, tmp_path: Path, rng: np.random.Generator
) -> None:
    paths = []
    for number, content in enumerate(hostile_files(good, rng, 24)):
        paths.append(tmp_path / f"{number}.rrd")
        paths[-1].write_bytes(content)
    content = good.read_bytes()
    cuts = [*range(0, 40, 16), *sorted(rng.integers(len(content), size=8)), *range(len(content) - 40, len(content), 5)]
    for length in cuts:
        paths.append(tmp_path / f"cut-{length}.rrd")
        paths[-1].write_bytes(content[:length])
    passed = 0
    with Examiner() as examiner:
        results = examine_all(paths, examiner)
    for path, result in results:
        if isinstance(result, RunRow):
            assert read_recording(path).row == result
            passed += 1
        else:
            text = str(result)
            assert text.startswith(f"{path}: ") and text.endswith(".") and text.isprintable() and len(text) < 700
        if path.name.startswith("cut"):
            assert isinstance(result, RecordingError) and "not a whole recording" in str(result)
    assert 0 < passed < 12


def foreign(path: Path) -> None:
    dot = Chunk.from_columns("/dot", [], rr.Points3D.columns(positions=[[1, 2, 3]]))
    LazyChunkStream.from_iter([dot]).write_rrd(path, application_id="other", recording_id="1")


def test_a_list_of_good_and_bad_files_has_the_good_ones(good: Path, tmp_path: Path, rng: np.random.Generator) -> None:
    folder, content = tmp_path / "recordings", good.read_bytes()
    folder.mkdir()
    names = {f"good-{number}.rrd" for number in range(10)}
    for name in names:
        (folder / name).write_bytes(content)
    bad: list[Path] = []
    for number in range(20):
        bad.append(folder / f"bad-{number}.rrd")
        bad[-1].write_bytes(cut(content, rng) if number % 2 else lied(content[:-32], rng) + content[-32:][::-1])
    for name in ("foreign", "folder", "pipe", "sparse", "a b", "b\nc", "<img src=x>", "c;d", "\udcff", "\u202egnp"):
        bad.append(folder / f"{name}.rrd")
    foreign(bad[20])
    bad[21].mkdir()
    os.mkfifo(bad[22])
    bad[23].write_bytes(content)
    os.truncate(bad[23], 5_000_000_000)
    (folder / "loop.rrd").symlink_to("loop.rrd")
    for path in bad[24:]:
        path.write_bytes(content)
    notices: list[str] = []
    with RunIndex(folder, notices.append) as index:
        listed = {row.file for row in (index.refresh(), index.find(RunQuery(), limit=None))[1].rows}
        assert names <= listed and not any(map(index.examined, listed)), "what the start of a file tells is believed"
        refreshed = index.examine()
        found = index.find(RunQuery(), limit=None)
        assert all(map(index.examined, names)) and refreshed.read == 10 and len(refreshed.skipped) == len(bad)
        refreshed = index.rebuild()
    assert {row.file for row in found.rows} == names and refreshed.read == 10 and not notices
    assert len(refreshed.skipped) == len(bad) == 30
    for file, sentence in refreshed.skipped:
        assert file.encode() and sentence.isprintable() and sentence.endswith(".") and len(sentence) < 700
