"""The folder of a sequence's results: what is written can be read, and what is damaged is said."""

import csv
import io
import json
import math
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spherloc.errors import InputError
from spherloc.experiments import QueryResult, read_results
from spherloc.experiments.configuration import Configuration, read_configuration
from spherloc.experiments.results import COLUMNS, PLACE, ResultsLog, csv_text, folder_for, json_line, row_of_json
from spherloc.geometry import pose
from spherloc.types import FloatArray

CONFIGURATION = Configuration(
    scene="walk.toml",
    scene_sha256="0" * 64,
    name="walk",
    estimator="mc",
    options={"bound_px": 3.0, "gravity_sd_deg": math.inf, "confidence": None, "robust": "none"},
    seed=0,
    versions={"spherloc": "1.0", "numpy": "2.0"},
    queries=4,
    gravity_map=np.array([0.0, 0.0, -1.0]),
    thresholds=((1.0, 0.1), (5.0, 0.5)),
    registration_thresholds_m=(0.1,),
)
POSE = np.arange(12.0).reshape(3, 4) / 7.0

number = st.none() | st.floats(-1e12, 1e12) | st.just(math.inf)
words = st.text(max_size=20)
matrix = st.none() | st.lists(st.floats(-1e6, 1e6), min_size=12, max_size=12).map(lambda x: np.reshape(x, (3, 4)))
VALUES = {
    int: st.integers(0, 10**9),
    int | None: st.none() | st.integers(0, 10**9),
    float | None: number,
    str: words,
    str | None: st.none() | words,
    tuple[str, ...]: st.lists(words, max_size=3).map(tuple),
    FloatArray | None: matrix,
}
"""Values of each type that a column may have: a new column is tried without a change here."""


@st.composite
def rows(draw) -> QueryResult:
    values = {item.name: draw(VALUES[item.type]) for item in fields(QueryResult)}
    status = "localized" if values["cam_from_map"] is not None else draw(st.sampled_from(["failed", "unreadable"]))
    return QueryResult(**values | {"status": status})


def row(index: int, **changes) -> QueryResult:
    found = QueryResult(index, f"image{index}.png", "localized", message="Pose found.", cam_from_map=POSE)
    return replace(found, **changes)


def same(a: QueryResult, b: QueryResult) -> bool:
    pairs = [(getattr(a, item.name), getattr(b, item.name)) for item in fields(QueryResult)]
    return all(type(one) is type(other) and np.array_equal(one, other) for one, other in pairs)


@settings(max_examples=100)
@given(rows())
def test_a_row_read_back_is_the_same_row(written: QueryResult) -> None:
    line = json_line(written)
    assert "\n" not in line and line.isascii()
    assert same(row_of_json(line, "f, line 1"), written)


@settings(max_examples=50)
@given(rows())
def test_rows_of_versions_that_had_fewer_columns_are_read(written: QueryResult) -> None:
    optional = {item.name for item in fields(QueryResult) if item.default is None} - {"cam_from_map"}
    older = {name: value for name, value in json.loads(json_line(written)).items() if name not in optional}
    assert same(row_of_json(json.dumps(older), "f, line 1"), replace(written, **dict.fromkeys(optional)))
    if written.cam_from_map is not None:
        del older["cam_from_map"]
        with pytest.raises(InputError, match="which does not fit its pose"):
            row_of_json(json.dumps(older), "f, line 1")
    del older["message"]
    with pytest.raises(InputError, match="is not a result of a query"):
        row_of_json(json.dumps(older), "f, line 1")


@settings(max_examples=150)
@given(rows(), st.data())
def test_damaged_rows_are_one_sentence_with_their_place(written: QueryResult, data) -> None:
    content = bytearray(json_line(written).encode())
    if data.draw(st.booleans()):
        content = content[: data.draw(st.integers(0, len(content) - 1))]
    else:
        content[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    try:
        row_of_json(content.decode(errors="replace"), "results.jsonl, line 3")
    except InputError as error:
        assert str(error).startswith("results.jsonl, line 3: ") and "damaged" in str(error)


@pytest.mark.parametrize(
    "change",
    [
        {"index": -1}, {"index": True}, {"index": 1.5}, {"query": None}, {"status": "fine"}, {"status": "failed"},
        {"cam_from_map": [[1, 2, 3, 4]]}, {"cam_from_map": None}, {"f1": "NaN"}, {"f1": 1e999}, {"remarks": "none"},
        {"recording": 3}, {"truth_cam_from_map": [[None] * 4] * 3}, {"matches": 10**400}, {"colour": 3},
    ],
)  # fmt: skip
def test_wrong_values_are_refused(change: dict) -> None:
    values = json.loads(json_line(row(0))) | change
    with pytest.raises(InputError, match=r"^f, line 1: "):
        row_of_json(json.dumps(values), "f, line 1")


@settings(max_examples=60)
@given(st.lists(rows(), max_size=4))
def test_the_table_is_read_by_others_and_holds_no_formula(written: list[QueryResult]) -> None:
    found = list(csv.reader(io.StringIO(csv_text(written, CONFIGURATION), newline="")))
    assert tuple(found[0]) == COLUMNS and len(found) == len(written) + 1
    for cells, original in zip(found[1:], written, strict=True):
        for name, cell in zip(COLUMNS, cells, strict=True):
            if name in PLACE:
                continue
            value = getattr(original, name)
            if isinstance(value, float | int):
                assert float(cell) == value
            elif value is None:
                assert cell == ""
            else:
                text = " ".join(value) if isinstance(value, tuple) else value
                assert cell.lstrip()[:1] not in ("=", "+", "-", "@") and cell.isprintable()
                assert cell.removeprefix("'") == "".join(c if c.isprintable() else " " for c in text).removeprefix("'")
    assert len(csv_text(written, CONFIGURATION).splitlines()) == len(written) + 1


def test_the_table_says_so_where_the_units_of_the_map_are_unknown() -> None:
    names = csv_text([], replace(CONFIGURATION, metric=False)).strip().split(",")
    assert {"x_units", "translation_error_units"} <= set(names) and not [name for name in names if name.endswith("_m")]
    assert "gravity_map" not in names and len(names) == len(COLUMNS)


def place_of(cam_from_map: np.ndarray | None, down: tuple[float, float, float]) -> list[str]:
    status = "failed" if cam_from_map is None else "localized"
    text = csv_text(
        [row(0, status=status, cam_from_map=cam_from_map)], replace(CONFIGURATION, gravity_map=np.array(down))
    )
    return [next(csv.DictReader(io.StringIO(text)))[name] for name in PLACE]


@pytest.mark.parametrize("turned_deg", [0.0, 30.0, -120.0, 179.0])
def test_the_table_tells_where_a_query_is_and_where_it_looks(turned_deg: float) -> None:
    """In a map whose z axis points up, and in one whose y axis points down."""
    turned = np.radians(turned_deg)
    ahead, down = np.array([np.cos(turned), np.sin(turned), 0.0]), np.array([0.0, 0.0, -1.0])
    standing = np.stack([np.cross(down, ahead), down, ahead])
    at = pose(standing, -standing @ [1.5, -2.0, 0.25])
    np.testing.assert_allclose([float(cell) for cell in place_of(at, (0, 0, -1))], [1.5, -2.0, 0.25, turned_deg])
    of_y_down = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # x, y, z to x, -z, y
    same = pose(standing @ of_y_down.T, at[:, 3])
    np.testing.assert_allclose([float(cell) for cell in place_of(same, (0, 1, 0))], [1.5, -0.25, -2.0, turned_deg])


def test_a_query_without_a_pose_has_no_place_and_one_that_looks_down_no_heading() -> None:
    assert place_of(None, (0, 0, -1)) == ["", "", "", ""]
    down = np.diag([1.0, -1.0, -1.0])
    assert place_of(pose(down, -down @ [1.0, 2.0, 3.0]), (0, 0, -1)) == ["1.0", "2.0", "3.0", ""]


def test_results_are_there_after_every_row_in_the_order_of_the_sequence(tmp_path: Path) -> None:
    truth = np.column_stack([np.eye(3), [0.0, 0.0, -2.0]])
    with ResultsLog(tmp_path / "out", CONFIGURATION) as log:
        for count, index in enumerate((2, 0, 3), start=1):
            log.append(row(index, truth_cam_from_map=truth, translation_error_m=0.5, recording=f"r/{index}.rrd"))
            assert len(read_results(tmp_path / "out").rows) == count
            assert len((tmp_path / "out" / "results.csv").read_text().splitlines()) == count + 1
        log.append(row(1, status="failed", cam_from_map=None))
    results = read_results(tmp_path / "out")
    assert results.names == ("image0.png", "image1.png", "image2.png", "image3.png")
    assert results.status == ("localized", "failed", "localized", "localized")
    np.testing.assert_allclose(results.positions_m[0], -POSE[:, :3].T @ POSE[:, 3])
    assert np.isnan(results.positions_m[1]).all() and np.isnan(results.true_positions_m[1]).all()
    np.testing.assert_array_equal(results.true_positions_m[2], [0.0, 0.0, 2.0])
    np.testing.assert_array_equal(results.translation_errors_m, [0.5, np.nan, 0.5, 0.5])
    assert np.isnan(results.rotation_errors_deg).all() and np.isnan(results.registration_errors_m).all()
    assert results.recordings[:2] == (tmp_path / "out" / "r/0.rrd", None)
    assert results.configuration.differences(CONFIGURATION) == []


def test_a_half_written_line_is_removed_wherever_it_was_cut(tmp_path: Path) -> None:
    with ResultsLog(tmp_path, CONFIGURATION) as log:
        log.append(row(0))
        log.append(row(1))
    whole = (tmp_path / "results.jsonl").read_bytes()
    first = whole.index(b"\n") + 1
    for cut in (first + 1, (first + len(whole)) // 2, len(whole) - 1):
        (tmp_path / "results.jsonl").write_bytes(whole[:cut])
        assert read_results(tmp_path).names == ("image0.png",)
        with ResultsLog(tmp_path, CONFIGURATION) as log:
            assert log.repaired and list(log.rows) == ["image0.png"]
            assert len((tmp_path / "results.csv").read_text().splitlines()) == 2
            log.append(row(1))
        assert (tmp_path / "results.jsonl").read_bytes() == whole


def test_damage_elsewhere_is_said_and_nothing_is_overwritten(tmp_path: Path) -> None:
    with ResultsLog(tmp_path, CONFIGURATION) as log:
        log.append(row(0))
        log.append(row(1))
    lines = (tmp_path / "results.jsonl").read_bytes().splitlines(keepends=True)
    for content, said in (
        (lines[0][:40] + b"\n" + lines[1], r"results.jsonl, line 1: is not a result of a query"),
        (lines[0] + b"\0" * 50 + b"\n", r"results.jsonl, line 2: is not a result of a query"),
        (lines[0] + lines[0], r"results.jsonl, line 2: the query 'image0.png' is there a second time"),
    ):
        (tmp_path / "results.jsonl").write_bytes(content)
        for read in (read_results, lambda folder: ResultsLog(folder, CONFIGURATION)):
            with pytest.raises(InputError, match=said):
                read(tmp_path)
        assert (tmp_path / "results.jsonl").read_bytes() == content


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"seed": 1}, "(seed is 1, was 0)"),
        ({"scene_sha256": "1" * 64}, "(the scene file or its map is another one)"),
        ({"options": {"bound_px": 4.0}}, "(options.bound_px is 4.0, was 3.0; options.gravity_sd_deg is absent, was"),
        ({"estimator": "mc-exact", "options": {}}, "(estimator is 'mc-exact', was 'mc')"),
        ({"versions": {"spherloc": "1.1", "numpy": "2.0"}}, "(versions.spherloc is '1.1', was '1.0')"),
        ({"thresholds": ((1.0, 0.2),)}, "(thresholds is [[1.0, 0.2]], was [[1.0, 0.1], [5.0, 0.5]])"),
        ({"queries": 5}, "(queries is 5, was 4)"),
    ],
)
def test_another_configuration_is_refused_by_what_differs(tmp_path: Path, change: dict, said: str) -> None:
    with ResultsLog(tmp_path, CONFIGURATION) as log:
        log.append(row(0))
    with pytest.raises(InputError) as error:
        ResultsLog(tmp_path, replace(CONFIGURATION, **change))
    assert said in str(error.value) and str(error.value).endswith("give another folder (--output).")
    with ResultsLog(tmp_path, replace(CONFIGURATION, scene="moved/walk.toml")) as log:
        assert list(log.rows) == ["image0.png"]


@settings(max_examples=150)
@given(st.data())
def test_a_damaged_configuration_is_one_sentence(tmp_path_factory, data) -> None:
    path = tmp_path_factory.getbasetemp() / "configuration.json"
    content = bytearray(CONFIGURATION.json_text().encode())
    if data.draw(st.booleans()):
        content = content[: data.draw(st.integers(0, len(content)))]
    else:
        content[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    path.write_bytes(content)
    try:
        found = read_configuration(path)
    except InputError as error:
        assert str(path) in str(error) and "\n" not in str(error)
    else:
        assert isinstance(found.seed, int) and found.gravity_map.shape == (3,)


def test_a_configuration_read_back_is_the_same(tmp_path: Path) -> None:
    (tmp_path / "configuration.json").write_text(CONFIGURATION.json_text())
    found = read_configuration(tmp_path / "configuration.json")
    assert found.differences(CONFIGURATION) == [] and found.options["gravity_sd_deg"] == math.inf
    assert found.thresholds == CONFIGURATION.thresholds and found.registration_thresholds_m == (0.1,)


def test_failures_can_be_forgotten(tmp_path: Path) -> None:
    with ResultsLog(tmp_path, CONFIGURATION) as log:
        log.append(row(0))
        log.append(row(1, status="failed", cam_from_map=None))
        log.append(row(2, status="unreadable", cam_from_map=None))
        assert log.forget_failures() == 2
        assert read_results(tmp_path).names == ("image0.png",)
        log.append(row(1))
        assert log.forget_failures() == 0
    assert read_results(tmp_path).status == ("localized", "localized")
    assert len((tmp_path / "results.csv").read_text().splitlines()) == 3


def test_two_at_once_do_not_write_into_one_folder(tmp_path: Path) -> None:
    with ResultsLog(tmp_path, CONFIGURATION), pytest.raises(InputError, match="another process is localizing into it"):
        ResultsLog(tmp_path, CONFIGURATION)
    ResultsLog(tmp_path, CONFIGURATION).__exit__(None, None, None)


def test_places_that_cannot_be_used_are_said(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(InputError, match="results cannot be written there"):
        ResultsLog(tmp_path / "file", CONFIGURATION)
    with pytest.raises(InputError, match=r"nowhere/configuration.json: no such file"):
        read_results(tmp_path / "nowhere")
    (tmp_path / "results.jsonl").write_text(json_line(row(0)) + "\n")
    with pytest.raises(InputError, match=r"already holds results.jsonl, but no configuration.json"):
        ResultsLog(tmp_path, CONFIGURATION)


def test_results_of_another_configuration_lead_to_the_next_folder(tmp_path: Path) -> None:
    base, other = tmp_path / "street_auto_0", replace(CONFIGURATION, seed=CONFIGURATION.seed + 1)
    assert folder_for(base, CONFIGURATION) == base
    for setting, folder in ((CONFIGURATION, base), (other, tmp_path / "street_auto_0_2")):
        assert folder_for(base, setting) == folder
        with ResultsLog(folder, setting):
            pass
        assert folder_for(base, setting) == folder
    assert folder_for(base, replace(other, metric=False)).name == "street_auto_0_3"
    (base / "configuration.json").write_text("{")
    with pytest.raises(InputError, match=r"configuration\.json"):
        folder_for(base, other)


@pytest.mark.parametrize("name", ["results.csv", "summary.json", "trajectory.tum", "truth.tum", "trajectory.png"])
def test_files_of_others_are_not_replaced(name: str, tmp_path: Path) -> None:
    """``--output DIR`` wrote over a summary.json that had nothing to do with it."""
    (tmp_path / name).write_text("somebody's work")
    with pytest.raises(InputError, match=rf"already holds {name}, but no configuration.json.*; give another folder"):
        ResultsLog(tmp_path, CONFIGURATION)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text() == "somebody's work"
    (tmp_path / name).unlink()
    for _ in range(2):  # and a second time among its own
        with ResultsLog(tmp_path, CONFIGURATION) as log:
            log.write(name, b"ours")
