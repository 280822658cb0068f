"""Labels and notes: stored beside the run as a layer that rerun's own reader finds, bounded, and never torn."""

from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rerun.chunk import RrdReader

from spherloc.errors import InputError, RecordingError
from spherloc_viz.recording import review_file
from spherloc_viz.recording.content.names import APPLICATION_ID
from spherloc_viz.recording.review_file import MAX_BYTES, read_review, write_review
from spherloc_viz.recording.reviews import (
    MAX_LABEL_CHARACTERS,
    MAX_LABELS,
    MAX_NOTE_CHARACTERS,
    Review,
    checked_review,
    review_path,
)


def test_the_layer_belongs_to_the_run(tmp_path: Path):
    """Same application and recording, so that a viewer shows both as one; the text is plain for people."""
    run = tmp_path / "a.b.rrd"
    write_review(run, ["wrong <b>map</b>", "x"], "See *step* 4.\nThen 5.", run_id="1b2c")
    path = tmp_path / "a.b.review.rrd"
    assert path == review_path(run)
    reader = RrdReader(path)
    (entry,) = reader.recordings()
    assert (entry.application_id, entry.recording_id) == (APPLICATION_ID, "1b2c")
    chunks = {chunk.entity_path: chunk.to_record_batch() for chunk in reader.stream()}
    assert chunks["/__properties/review"].column("labels")[0].as_py() == ["wrong <b>map</b>", "x"]
    assert chunks["/__properties/review"].column("note")[0].as_py() == ["See *step* 4.\nThen 5."]
    (text,) = chunks["/review"].column("TextDocument:text")[0].as_py()
    assert text == "**wrong \\<b\\>map\\</b\\>** **x**\n\nSee \\*step\\* 4.\n\nThen 5."


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.text(max_size=20), max_size=6), st.text(max_size=100))
def test_what_is_stored_comes_back(tmp_path: Path, labels: list[str], note: str):
    run = tmp_path / "run.rrd"
    try:
        stored = write_review(run, labels, note, run_id="1")
    except InputError:
        return
    assert read_review(run) == stored == checked_review(stored.labels, stored.note)
    assert review_path(run).exists() == (stored != Review())


def test_the_last_label_and_note_remove_the_file(tmp_path: Path):
    run = tmp_path / "run.rrd"
    assert write_review(run, [], "  \n ", run_id="1") == Review()
    write_review(run, ["a"], "", run_id="1")
    assert read_review(run) == Review(("a",), "")
    write_review(run, [" "], "", run_id="1")
    assert list(tmp_path.iterdir()) == []
    assert read_review(run) == Review()


def test_labels_are_cleaned(tmp_path: Path):
    assert checked_review([" a  b ", "a b", "", "\x1b[31mred", "c\nd"], "x  \r\ny\x00z\n\n") == Review(
        ("a b", "[31mred", "c d"), "x\ny z"
    )


@pytest.mark.parametrize(
    "labels, note, what",
    [
        ([str(number) for number in range(MAX_LABELS + 1)], "", "too many"),
        (["x" * (MAX_LABEL_CHARACTERS + 1)], "", "too long"),
        ([], "x" * (MAX_NOTE_CHARACTERS + 1), "too long"),
    ],
)
def test_more_than_is_stored_is_a_sentence(tmp_path: Path, labels: list[str], note: str, what: str):
    with pytest.raises(InputError, match=what):
        write_review(tmp_path / "run.rrd", labels, note, run_id="1")
    assert list(tmp_path.iterdir()) == []
    full = write_review(tmp_path / "run.rrd", [f"{n}{'x' * 38}" for n in range(20)], "n" * MAX_NOTE_CHARACTERS, "1")
    assert read_review(tmp_path / "run.rrd") == full and len(full.labels) == MAX_LABELS


@pytest.mark.parametrize("then", [Review(), Review(("b",), "c")])
def test_a_review_that_is_removed_or_replaced_while_it_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, then: Review
):
    run = tmp_path / "run.rrd"
    write_review(run, ["a"], "", run_id="1")
    read, calls = review_file.read_file, []

    def slow(path: Path, most_labels: int) -> tuple[list[str], str]:
        """As another process may do between the opening of a file and its end."""
        calls.append(path)
        if len(calls) == 1:
            write_review(run, then.labels, then.note, run_id="1")
            raise RuntimeError("No such file or directory")
        return read(path, most_labels)

    monkeypatch.setattr(review_file, "read_file", slow)
    assert read_review(run) == then


def test_a_damaged_review_is_a_sentence(tmp_path: Path, rng):
    run = tmp_path / "run.rrd"
    path = review_path(run)
    write_review(run, ["label"], "note " * 100, run_id="1")
    good = path.read_bytes()
    flipped = bytearray(good)
    flipped[int(rng.integers(len(good) // 4, len(good) // 2))] ^= 0xFF
    for content in (b"", b"no recording", good[: len(good) // 2], bytes(len(good)), good + bytes(MAX_BYTES)):
        path.write_bytes(content)
        with pytest.raises(RecordingError, match=r"run\.review\.rrd: labels and note cannot be read; delete the file"):
            read_review(run)
    path.write_bytes(flipped)
    try:
        assert read_review(run).labels in ((), ("label",))
    except RecordingError as error:
        assert "cannot be read" in str(error)


def test_a_recording_that_is_no_review_is_a_sentence(tmp_path: Path):
    """Such as a run that somebody named so."""
    from rerun.chunk import Chunk, LazyChunkStream

    LazyChunkStream.from_iter([Chunk.from_columns("/a", [], [])]).write_rrd(
        review_path(tmp_path / "run.rrd"), application_id=APPLICATION_ID, recording_id="1"
    )
    with pytest.raises(RecordingError, match="cannot be read"):
        read_review(tmp_path / "run.rrd")


def test_a_name_that_leaves_no_room_for_a_review(tmp_path: Path):
    """The run is a run; that it cannot be labelled is a sentence."""
    recording = tmp_path / ("r" * 250 + ".rrd")
    recording.write_text("a run")
    assert read_review(recording) == Review()
    with pytest.raises(RecordingError, match="labels and note cannot be stored"):
        write_review(recording, ["x"], "", run_id="1")


def test_the_run_must_be_one(tmp_path: Path):
    (tmp_path / "bad.rrd").write_bytes(b"no recording")
    with pytest.raises(RecordingError, match="not a whole recording"):
        write_review(tmp_path / "bad.rrd", ["a"], "")
    with pytest.raises(RecordingError, match="no such file"):
        write_review(tmp_path / "none.rrd", ["a"], "")


def test_a_folder_that_cannot_be_written_is_a_sentence(tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError, match="labels and note cannot be stored"):
        write_review(tmp_path / "file" / "run.rrd", ["a"], "", run_id="1")
