"""``spherloc sweep`` as a user calls it, and the picture that it leaves."""

import csv
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from cli_process import spherloc_here

from spherloc.errors import InputError
from spherloc.experiments.sweep_rows import SweepRow, point_of
from spherloc_viz.commands.sweep import parse_entrant, sweep, sweep_two
from spherloc_viz.layers.sweep import LIMIT, sweep_charts, sweep_colors, sweep_table
from spherloc_viz.plots.sweeps import sweep_png
from tests.tiny_scene import write_tiny_scene
from tests.waiting import LIMIT_S

PROGRAM = [sys.executable, "-c", "import signal\nsignal.signal(signal.SIGINT, signal.default_int_handler)\n"
           "from spherloc_viz.commands.cli import main\nmain()", "sweep"]  # fmt: skip
"""A shell's background job, and what it starts, ignores SIGINT."""
NAME = "tiny $\\frac$"
"""Matplotlib would set it as mathematics."""


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return write_tiny_scene(tmp_path, NAME)


def lines(path: Path) -> int:
    return path.read_bytes().count(b"\n") if path.exists() else 0


def test_two_properties_give_a_row_a_point_and_a_map(scene: Path, tmp_path: Path) -> None:
    """Each point is that of the sweep over one property with the other one set; impossible pairs are a sentence."""
    how = {"settings": [], "runs": 2, "seed": 5, "workers": 1, "scheduler": None}
    out = tmp_path / "two.csv"
    names = ["ransac-2p,iterations=50"]
    sweep_two(
        scene, "outlier_rate", ["0.3", "0.6"], names, by="correspondences", by_values=["12", "24"], out=out, **how
    )
    with out.open(newline="") as file:
        table = list(csv.DictReader(file))
    points = [(row["correspondences"], row["outlier_rate"]) for row in table]
    assert points == [("12.0", "0.3"), ("12.0", "0.6"), ("24.0", "0.3"), ("24.0", "0.6")]
    alone = sweep(
        scene, "outlier_rate", ["0.3", "0.6"], names, out=tmp_path / "one.csv",
        **(how | {"settings": ["correspondences=24"]}),
    )  # fmt: skip
    assert [int(row["successes"]) for row in table[2:]] == [point.successes for point in alone]
    picture = cv2.imread(str(out.with_suffix(".png")))
    assert picture is not None and picture.shape[1] > picture.shape[0]
    with pytest.raises(InputError, match="a sweep over outlier_rate cannot go by 'outlier_rate' too"):
        sweep_two(scene, "outlier_rate", ["0.3"], names, by="outlier_rate", by_values=["1"], out=out, **how)


def test_ctrl_c_keeps_what_is_done_and_the_same_command_goes_on(scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "results" / "sweep.csv"
    words = ["--values", "0.5:0.9:0.2", "--estimator", "mc", "--estimator", "ransac-2p,iterations=50"]
    words += [
        "--set",
        "noise_px=1",
        "correspondences=30",
        "--runs",
        "3000",
        "--workers",
        "1",
        "--out",
        str(out),
        "--no-record",
    ]
    process = subprocess.Popen([*PROGRAM, scene, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    while lines(out) < 20:
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=LIMIT_S)
    assert (process.returncode, output) == (130, "")
    done = lines(out) - 1
    (sentence,) = errors.splitlines()
    stopped = re.search(r"stopped; ([\d,]+) runs are in (.*), and the same command goes on from there\.$", sentence)
    assert stopped is not None and 0 <= done - int(stopped[1].replace(",", "")) <= 1 and stopped[2] == str(out)
    assert done < 18_000 and not out.with_suffix(".png").exists()
    words[words.index("3000")] = str(-(-done // 6) + 1)
    finished = spherloc_here("sweep", scene, *words, cwd=tmp_path)
    assert finished.returncode == 0, finished.stderr
    assert "runs are done already" in finished.stderr
    with out.open(newline="") as file:
        table = list(csv.DictReader(file))
    assert len({(row["estimator"], row["outlier_rate"], row["seed"]) for row in table}) == len(table)
    assert {row["correspondences"] for row in table} == {"30"}
    with out.with_suffix(".summary.csv").open(newline="") as file:
        points = list(csv.DictReader(file))
    assert [point["estimator"] for point in points] == ["mc"] * 3 + ["ransac-2p iterations=50"] * 3
    assert sum(int(point["runs"]) for point in points) == len(table) >= 6 * int(words[words.index("--runs") + 1])
    assert finished.stdout.splitlines()[-1].startswith(f"written to {out}, sweep.summary.csv and sweep.png")
    image = cv2.imread(str(out.with_suffix(".png")))
    assert image is not None and image.shape[1] >= 1280


def test_wrong_words_are_one_sentence(scene: Path, tmp_path: Path) -> None:
    def call(**changes: object) -> int:
        given = {"scene": scene, "over": "noise_px", "values": ["1"], "estimators": ["mc"], "settings": []}
        more = {"runs": 1, "seed": 0, "workers": 1, "scheduler": None, "out": tmp_path / "out.csv"}
        return sweep(**(given | more | changes))  # type: ignore[arg-type]

    for changes, said in (
        ({"values": ["1:2"]}, "give numbers, or FIRST:LAST:STEP"),
        ({"estimators": ["magic"]}, "'magic': choose one of"),
        ({"estimators": ["mc,magic=1"]}, "option 'magic=1' is unknown to mc; give KEY=VALUE with"),
        ({"settings": ["magic=1"]}, "setting 'magic=1' is unknown"),
        ({"settings": ["noise_px=1"]}, "noise_px is set, and the sweep goes over it"),
        ({"workers": 65}, "65 workers; give a number from 1 to 64"),
        ({"out": tmp_path}, r"ends with \.csv"),
    ):
        with pytest.raises(InputError, match=said):
            call(**changes)
    with pytest.raises(InputError, match="is not a simulation"):
        matches = Path(__file__).resolve().parents[1] / "scenes" / "street_fisheye.toml"
        call(scene=matches)


def test_entrants_as_people_type_them() -> None:
    assert parse_entrant("ransac-2p,iterations=50,gravity_sd_deg=inf").changes == (
        ("iterations", 50),
        ("gravity_sd_deg", float("inf")),
    )
    assert parse_entrant("mc").label == "mc"


def row(label: str, value: float, seed: int, error: float | None) -> SweepRow:
    good = error is not None and error < 0.1
    return SweepRow(label, value, seed, good, error, error, error, 2.0 + seed, 5, 20, 1.0, 0.5, 0.6, None, None, None)


LABELS = ("mc", "ransac-2p iterations=50", "ransac-2p iterations=500")
POINTS = tuple(
    point_of([row(label, value, seed, None if seed < lost else 0.01 * (seed + 1)) for seed in range(5)])
    for label, losses in zip(LABELS, ((0, 0, 1), (0, 3, 5), (0, 0, 0)), strict=True)
    for value, lost in zip((0.5, 0.7, 0.9), losses, strict=True)
)


def test_the_charts_show_the_points() -> None:
    success, position, rotation, times = sweep_charts("outlier_rate", LABELS, POINTS)
    assert [chart.log for chart in (success, position, rotation, times)] == [False, True, True, True]
    curves = {curve.label: curve for curve in success.chart.curves}
    assert curves[LABELS[1]].y.tolist() == [100.0, 40.0, 0.0] and LIMIT not in curves
    low, high = success.bands[LABELS[1]]
    assert low[2] == 0.0 and high[2] == pytest.approx(43.4, abs=0.1)  # Wilson, 0 of 5
    errors = {curve.label: curve for curve in position.chart.curves}
    np.testing.assert_array_equal(errors[LABELS[1]].y, [0.03, np.nan, np.nan])
    assert errors[LIMIT].kind == "level" and errors[LIMIT].y[0] == 0.1
    for chart in (position, rotation, times):
        assert all(np.isfinite(side).all() and (side > 0).all() for band in chart.bands.values() for side in band)
    table = sweep_table("outlier_rate", POINTS)
    assert table.rows[4][:3] == (LABELS[1], "0.7", "2 of 5") and table.rows[4][4] == "no pose"


def test_no_runs_and_perfect_runs_have_charts_too() -> None:
    assert all(not chart.chart.curves for chart in sweep_charts("noise_px", LABELS, ()))
    assert sweep_png("empty", "noise_px", LABELS, ())[:4] == b"\x89PNG"
    exact = (point_of([row("mc", 0.0, 0, 0.0)]),)
    for chart in sweep_charts("noise_px", ("mc",), exact):
        assert all(np.isfinite(curve.y).all() for curve in chart.chart.curves)
    assert sweep_png("exact", "noise_px", ("mc",), exact)[:4] == b"\x89PNG"


def test_colours_tell_estimators_apart() -> None:
    colors = sweep_colors(LABELS)
    assert len(set(colors.values())) == 3 and sweep_colors(("mc",))["mc"] == colors["mc"]


def test_the_picture_has_every_curve() -> None:
    png = sweep_png(NAME, "outlier_rate", LABELS, POINTS)
    assert png == sweep_png(NAME, "outlier_rate", LABELS, POINTS)
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    for color in sweep_colors(LABELS).values():
        assert (np.abs(image[..., ::-1].astype(int) - color).max(axis=2) < 8).sum() > 300
