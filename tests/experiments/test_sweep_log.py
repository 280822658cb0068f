"""The files of a sweep: a stop at any byte loses nothing, nothing foreign is taken in, and the summary is right."""

import csv
import json
import math
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sweep_samples import small_plan, write_scene

from spherloc.errors import InputError
from spherloc.experiments.summary import wilson
from spherloc.experiments.sweep import Entrant, SweepPlan, SweepRow
from spherloc.experiments.sweep_log import SweepLog
from spherloc.experiments.sweep_plan import parse_values
from spherloc.experiments.sweep_rows import point_of, row_line, row_of_line, summarize, summary_text


def done(plan: SweepPlan, path: Path, count: int | None = None) -> list[SweepRow]:
    """Rows of a sweep that was stopped after ``count`` runs."""
    rows = plan.solve(list(plan.jobs())[:count])
    with SweepLog(path, plan) as log:
        for row in rows:
            log.append(row)
    return rows


def test_it_goes_on_after_a_stop_at_any_byte(tmp_path: Path) -> None:
    plan, path = small_plan(tmp_path), tmp_path / "out" / "sweep.csv"
    rows = done(plan, path)
    content = path.read_bytes()
    for length in (len(content), len(content) - 1, len(content) // 2, 30, 0):
        path.write_bytes(content[:length])
        whole = content[:length].count(b"\n") - 1
        with SweepLog(path, plan) as log:
            assert log.rows == rows[: max(0, whole)]
            for row in rows:
                if (row.estimator, row.value, row.seed) not in log.done:
                    log.append(row)
        assert path.read_bytes() == content
    with SweepLog(path, plan) as log:
        log.rows.reverse()
        log.finish()
    assert path.read_bytes() == content, "the order does not depend on who was quicker"
    with path.open(newline="") as file:
        table = list(csv.DictReader(file))
    assert [float(line["outlier_rate"]) for line in table[:4]] == [0.5, 0.5, 0.8, 0.8]
    assert [float(line["translation_error_m"]) for line in table] == [row.translation_error_m for row in rows]


def test_more_runs_add_to_what_is_there(tmp_path: Path) -> None:
    path = tmp_path / "sweep.csv"
    rows = done(small_plan(tmp_path, runs=2), path)
    with SweepLog(path, small_plan(tmp_path, runs=3)) as log:
        assert log.rows == rows and log.done_of_plan() == len(rows) == 8
    with SweepLog(path, small_plan(tmp_path, runs=1)) as log:
        assert log.rows == rows and log.done_of_plan() == 4


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"values": (0.5,)}, r"values is \[0.5\], was \[0.5, 0.8\]"),
        ({"first_seed": 4}, "first_seed is 4, was 3"),
        ({"variation": None}, "variation.noise_px is absent, was 1.0"),
        ({"entrants": (Entrant("mc"),)}, "entrants is"),
        ({"over": "noise_px", "values": (1, 2), "variation": None}, "over is 'noise_px', was 'outlier_rate'"),
    ],
)
def test_another_plan_is_refused(tmp_path: Path, changes: dict[str, Any], said: str) -> None:
    path = tmp_path / "sweep.csv"
    done(small_plan(tmp_path), path, 3)
    before = path.read_bytes(), path.with_suffix(".plan.json").read_bytes()
    with pytest.raises(InputError, match=rf"holds the runs of another sweep \(.*{said}.*\); give another file"):
        SweepLog(path, small_plan(tmp_path, **changes))
    assert (path.read_bytes(), path.with_suffix(".plan.json").read_bytes()) == before


def test_an_edited_scene_is_another_plan_and_a_moved_one_is_not(tmp_path: Path) -> None:
    path = tmp_path / "sweep.csv"
    rows = done(small_plan(tmp_path), path, 3)
    (tmp_path / "moved").mkdir()
    with SweepLog(path, small_plan(tmp_path / "moved")) as log:
        assert log.rows == rows
    edited = replace(small_plan(tmp_path), scene_sha256="0" * 64)
    with pytest.raises(InputError, match="scene_sha256 is '000"):
        SweepLog(path, edited)


def test_damage_is_one_sentence(tmp_path: Path) -> None:
    plan, path = small_plan(tmp_path), tmp_path / "sweep.csv"
    done(plan, path, 2)
    good = path.read_text()
    header, first, second = good.splitlines(keepends=True)
    for text, said in (
        (first + second, "line 1: is not the heading"),
        (header + "a,b\n" + second, "line 2: has 2 cells, not 16"),
        (header + first.replace("true", "yes").replace("false", "yes"), "line 2: has 'yes' for success"),
        (
            header + first + second.replace("0.5", "0.6", 1),
            "line 3: holds 'mc-exact' at 0.6, seed 3, not a run of",
        ),
        (header + first + first, "holds a run twice"),
        (header + "\0" * 40 + "\n", "line 2: "),
        (header + '"' + "x" * 200_000 + "\n", "line 2: "),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=said):
            SweepLog(path, plan)
        assert path.read_text() == text
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(InputError, match=r"sweep.csv: is not a regular file; remove it"):
        SweepLog(path, plan)
    path.unlink()
    path.write_text(good)
    beside = path.with_suffix(".plan.json")
    for text in ("[]", "{", "[" * 100_000):
        beside.write_text(text)
        with pytest.raises(InputError, match=r"sweep.plan.json: is damaged|holds the runs of another"):
            SweepLog(path, plan)
    beside.unlink()
    with pytest.raises(InputError, match="is not a table of a sweep, or has lost its"):
        SweepLog(path, plan)
    with pytest.raises(InputError, match=r"sweep.txt: the table of a sweep ends with \.csv"):
        SweepLog(tmp_path / "sweep.txt", plan)
    write_scene(tmp_path)
    with pytest.raises(InputError, match=r"tiny.toml.*: cannot be written"):
        SweepLog(tmp_path / "tiny.toml" / "sweep.csv", plan)


def test_two_processes_do_not_write_to_one_file(tmp_path: Path) -> None:
    plan, path = small_plan(tmp_path), tmp_path / "sweep.csv"
    with SweepLog(path, plan), pytest.raises(InputError, match="another sweep writes to it"):
        SweepLog(path, plan)
    with SweepLog(path, plan):
        pass


FLOATS = st.floats(allow_nan=False)
ROWS = st.builds(
    SweepRow,
    estimator=st.sampled_from(("mc", "ransac-2p iterations=3", 'a "quoted", one')),
    value=FLOATS,
    seed=st.integers(0, 2**63 - 1),
    success=st.booleans(),
    rotation_error_deg=st.none() | FLOATS,
    translation_error_m=st.none() | FLOATS,
    time_ms=FLOATS,
    inliers=st.integers(0, 10_000),
    correspondences=st.integers(0, 10_000),
    precision=st.none() | FLOATS,
    recall=st.none() | FLOATS,
    f1=st.none() | FLOATS,
    upper_bound=st.none() | st.integers(0, 10_000),
    lower_bound=st.none() | st.integers(0, 10_000),
    nfa=st.none() | FLOATS,
    t_error_m=st.none() | FLOATS,
)


@settings(max_examples=100)
@given(row=ROWS)
def test_rows_come_back_as_they_were(row: SweepRow) -> None:
    assert row_of_line(row_line(row).rstrip("\n"), "here") == row


@settings(max_examples=200)
@given(line=st.text(max_size=80) | st.lists(st.sampled_from(["1", "", "nan", "true", "inf", "x"])).map(",".join))
def test_any_line_is_a_row_or_a_sentence(line: str) -> None:
    try:
        assert isinstance(row_of_line(line, "here"), SweepRow)
    except InputError as error:
        assert str(error).startswith("here: ")


BASE = SweepRow("mc", 0.5, 0, True, 0.1, 0.01, 0.01, 5.0, 9, 30, 1.0, 0.5, 2 / 3, None, None, None)


def test_a_point_is_what_its_runs_come_to(tmp_path: Path) -> None:
    rows = [replace(BASE, seed=seed, translation_error_m=0.01 * seed, time_ms=1.0 + seed) for seed in range(1, 6)]
    lost = replace(BASE, seed=9, success=False, rotation_error_deg=None, translation_error_m=None, precision=0.0)
    point = point_of([*rows, lost, replace(lost, seed=10), replace(lost, seed=11)])
    assert (point.runs, point.successes, point.rate) == (8, 5, 0.625)
    assert (point.low, point.high) == wilson(5, 8)
    assert point.translation_error_m.median == 0.04 and point.translation_error_m.upper == math.inf
    assert point.success_translation_error_m is not None and point.success_translation_error_m.median == 0.03
    assert point.mean_precision == pytest.approx(5 / 8) and point.proven is None
    nothing = point_of([lost])
    assert nothing.success_rotation_error_deg is None and nothing.rotation_error_deg.median == math.inf
    proven = [replace(BASE, seed=s, upper_bound=9, lower_bound=9 - s) for s in (0, 1)]
    assert point_of(proven).proven == 1
    points = summarize(
        ("ransac", "mc"), [replace(BASE, estimator="ransac", value=0.7), *rows, replace(BASE, value=0.4)]
    )
    assert [(p.estimator, p.value, p.runs) for p in points] == [("ransac", 0.7, 1), ("mc", 0.4, 1), ("mc", 0.5, 5)]
    (tmp_path / "summary.csv").write_text(summary_text("noise_px", points))
    with (tmp_path / "summary.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert float(table[2]["median_translation_error_m"]) == 0.03 and table[0]["noise_px"] == "0.7"
    assert json.loads(table[2]["successes"]) == 5 and None not in table[2]


@pytest.mark.parametrize(
    ("texts", "values"),
    [
        (["0.5:0.98:0.04"], [0.5 + 0.04 * k for k in range(13)]),
        (["0:10:2.5", "12,14"], [0, 2.5, 5, 7.5, 10, 12, 14]),
        (["0.5:0.95:0.1"], [0.5, 0.6, 0.7, 0.8, 0.9]),
        (["3:3:1"], [3]),
    ],
)
def test_values_as_people_type_them(texts: list[str], values: list[float]) -> None:
    found = parse_values(texts)
    assert found == pytest.approx(values) and all(len(repr(value)) < 8 for value in found)


@pytest.mark.parametrize("text", ["", "a", "1:2", "1:2:0", "2:1:1", "1:2:-1", "0:inf:1", "nan:1:1", "1:2:3:4"])
def test_other_values_are_one_sentence(text: str) -> None:
    with pytest.raises(InputError, match="give numbers, or FIRST:LAST:STEP such as"):
        parse_values([text])


def test_too_many_values_are_one_sentence() -> None:
    with pytest.raises(InputError, match="more than 200; give a larger step"):
        parse_values(["0:1:1e-300"])


@pytest.mark.parametrize("other", ["photo.png", "photo.plan.json", "photo.summary.csv", "photo.csv"])
def test_files_of_others_are_not_replaced(other: str, tmp_path: Path) -> None:
    """``--out photo.csv`` wrote over the photo beside it."""
    plan, path, own = small_plan(tmp_path), tmp_path / "photo.csv", tmp_path / other
    content = b'{"a": 1}' if other.endswith("json") else b"somebody's work"
    own.write_bytes(content)
    for link in (False, True):
        with pytest.raises(InputError, match=r"photo\.(png|plan\.json|summary\.csv|csv).*; give another file"):
            SweepLog(path, plan)
        assert sorted(tmp_path.glob("photo*")) == [own], "nothing is left of what was not begun"
        if link:
            assert own.is_symlink()
        else:
            assert own.read_bytes() == content
            own.unlink()
            own.symlink_to(tmp_path / "elsewhere")  # which is not there: writing would make it


def test_its_own_files_are_written_again(tmp_path: Path) -> None:
    plan, path = small_plan(tmp_path), tmp_path / "photo.csv"
    done(plan, path)
    with SweepLog(path, plan) as log:
        log.write(log.beside(".png"), b"a picture")
        log.finish()
    with SweepLog(path, plan) as log:
        log.finish()
    path.unlink()  # what remains says whose it is
    with SweepLog(path, plan) as log:
        assert log.rows == []
