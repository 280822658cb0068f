"""The list of runs: every filter against plain Python, and what may be in a row."""

import sys
from typing import Any

import numpy as np
import pytest
from run_index_samples import in_order, random_query, wanted
from run_rows import random_row, some_row

from spherloc.diagnosis import Cause
from spherloc.errors import InputError, RecordingError
from spherloc_viz.recording.index.query import GROUP_KEYS, SORT_KEYS, RunQuery
from spherloc_viz.recording.index.run_index import RunIndex
from spherloc_viz.recording.run_row import RunRow


@pytest.fixture
def rows(index: RunIndex, rng: np.random.Generator) -> list[RunRow]:
    rows = [random_row(rng, number) for number in range(300)]
    index.add_all(rows)
    return rows


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
