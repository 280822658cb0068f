"""A run's row is the same after its way through a file, another process and the list, whatever its texts are."""

import json
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recording_samples import scene_problem

from spherloc.estimators import estimate
from spherloc_viz.recording.content.writer import write_recording
from spherloc_viz.recording.index.query import RunQuery
from spherloc_viz.recording.index.run_index import RunIndex
from spherloc_viz.recording.origin import Origin
from spherloc_viz.recording.review_file import write_review
from spherloc_viz.recording.reviews import checked_review
from spherloc_viz.recording.run_row import RunRow
from spherloc_viz.recording.sandbox.examiner import examine
from spherloc_viz.recording.sandbox.row_checks import row_from_table, table_from_row

pytestmark = pytest.mark.usefixtures("own_examiner")

anything = st.text(st.characters(exclude_categories=["Cs"]), max_size=60)
"""Any text but halves of characters, which no file can hold."""
share = st.floats(0.0, 1.0)
rows = st.builds(
    RunRow,
    file=st.just("run.rrd"),
    run_id=st.from_regex(r"[A-Za-z0-9_.-]{1,40}", fullmatch=True),
    created=st.datetimes(datetime(1970, 1, 1), datetime(2200, 1, 1)).map(
        lambda when: when.replace(tzinfo=UTC).isoformat(timespec="milliseconds")
    ),
    source=st.sampled_from(["page", "command", "sweep", "sequence", "gallery", "unknown"]),
    scene=anything,
    name=anything,
    query=st.none() | anything,
    estimator=st.from_regex(r"[a-z0-9-]{1,20}", fullmatch=True),
    seed=st.integers(-(2**63), 2**63 - 1),
    options=st.dictionaries(anything, anything | share, max_size=3).map(json.dumps),
    problem_key=st.from_regex(r"[0-9a-f]{32}", fullmatch=True),
    outcome=st.sampled_from(["success", "failure", "unknown"]),
    diagnosis=st.sampled_from(["", "ok", "ambiguous", "larger false consensus"]),
    doubtful=st.none() | st.booleans(),
    summary=anything,
    message=anything,
    correspondences=st.integers(100, 10**6),
    inliers=st.integers(0, 100),
    outlier_rate=st.none() | share,
    rotation_error_deg=st.none() | st.floats(0.0, 180.0),
    translation_error_m=st.none() | st.floats(0.0, 1e300),
    time_ms=st.floats(0.0, 1e300),
    proven=st.none() | st.booleans(),
    steps=st.integers(50, 10**6),
    key_step=st.integers(0, 49),
    title=anything,
    labels=st.lists(anything, max_size=3, unique=True).map(tuple),
    note=anything,
    size_bytes=st.integers(0, 2**62),
    thumbnail=st.sampled_from([b"", b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR\0\0\0\x60\0\0\0\x40\xff"]),
    format_version=st.integers(0, 9),
)


@given(rows)
@settings(max_examples=40)
def test_a_row_passes_between_processes_unchanged(row: RunRow) -> None:
    assert row_from_table(json.loads(json.dumps(table_from_row(row))), Path("recordings/run.rrd")) == row


def test_a_row_passes_through_the_index_unchanged(tmp_path: Path) -> None:
    (tmp_path / "run.rrd").touch()
    with RunIndex(tmp_path) as index:

        @given(rows)
        @settings(max_examples=25)
        def check(row: RunRow) -> None:
            index.add(row)
            assert index.get(row.file) == row
            assert index.find(RunQuery(scene=row.scene, estimator=row.estimator)).rows == (row,)
            for label in row.labels:
                assert index.find(RunQuery(label=label)).rows == (row,)

        check()


def test_texts_pass_through_a_file_unchanged(tmp_path: Path) -> None:
    trace = estimate(scene_problem("mei_outliers_80"), "ransac-2p")
    path = tmp_path / "run.rrd"

    @given(name=anything, scene=anything, message=anything, title=anything, label=anything, note=anything)
    @settings(max_examples=5)
    def check(name: str, scene: str, message: str, title: str, label: str, note: str) -> None:
        run = replace(trace, problem=replace(trace.problem, name=name, scene=scene), message=message)
        written = write_recording(run, path, Origin("page", title=title))
        review = checked_review([label], note)
        write_review(path, review.labels, review.note)
        row = examine(path)
        assert (row.name, row.scene, row.message, row.title) == (name, scene, message, title)
        assert row == replace(written, labels=review.labels, note=review.note)
        with RunIndex(tmp_path) as index:
            # Through the child that runs already: others take seconds to start.
            assert index.refresh(read=lambda paths: ((path, examine(path)) for path in paths)).read == 1
            found = index.find(RunQuery()).rows
        assert found == (row,)

    check()
