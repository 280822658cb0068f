"""``spherloc compare`` and ``rerun`` on recorded runs."""

import json
from pathlib import Path

import pytest
from recording_samples import scene_problem

from spherloc.errors import InputError, SpherlocError
from spherloc.estimators import default_options, estimate
from spherloc_viz.app.desk.files import save_set
from spherloc_viz.commands.compare import compare_runs, rerun, wanted
from spherloc_viz.commands.run import Records
from spherloc_viz.recording.content.data import read_recording
from spherloc_viz.recording.content.writer import write_recording
from spherloc_viz.recording.index.query import RunQuery
from spherloc_viz.recording.review_file import write_review

SPOILED = {"iterations": 1}
"""Options with which RANSAC fails."""


@pytest.fixture(scope="module")
def nights(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two folders of runs on the same problems; in the second one RANSAC fails."""
    from dataclasses import replace

    monday, tuesday = (tmp_path_factory.mktemp(name) for name in ("monday", "tuesday"))
    for scene in ("mei_outliers_80", "fisheye_outliers_80"):
        problem = scene_problem(scene)
        good = default_options("ransac-2p", problem)
        write_recording(estimate(problem, "ransac-2p", good, 3), monday / f"{scene}.rrd")
        bad = replace(good, **SPOILED)
        write_recording(estimate(problem, "ransac-2p", bad, 3), tuesday / f"{scene}.rrd")
    write_review(tuesday / "mei_outliers_80.rrd", ["hard"], "")
    return monday, tuesday


def test_what_broke_fails_the_build(
    nights: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = wanted(["new failures > 0"], tmp_path / "new" / "night.html", False)
    assert compare_runs(*nights, (None, None), asked) == 1
    told = capsys.readouterr()
    assert "new failures 2, mended 0" in told.out and "'new failures > 0' holds" in told.err
    assert "2 new failures, 0 mended" in (tmp_path / "new" / "night.html").read_text()
    assert compare_runs(*nights[::-1], (None, None), wanted(["new failures > 0"], None, True)) == 0
    table = json.loads(capsys.readouterr().out)
    assert table["mended"] == 2 and table["failed_conditions"] == [] and len(table["mended_runs"]) == 2


def test_labels_choose_runs(nights: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    assert compare_runs(*nights, (None, "hard"), wanted([], None, True)) == 0
    table = json.loads(capsys.readouterr().out)
    assert table["pairs"] == 1 and table["unpaired"] == 1
    with pytest.raises(InputError, match="has no such run"):
        compare_runs(*nights, (None, "soft"), wanted([], None, True))


def test_failures_are_run_again(nights: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    records = Records(tmp_path / "again")
    query = RunQuery(outcome="failure")
    assert rerun([nights[1]], query, None, ["iterations=1000"], None, records, wanted([], None, True)) == 0
    table = json.loads(capsys.readouterr().out)
    assert table["mended"] == table["pairs"] == 2 and table["new failures"] == 0
    (again,) = (path for path in (tmp_path / "again").glob("*mei*.rrd"))
    run, before = read_recording(again), read_recording(nights[1] / "mei_outliers_80.rrd")
    assert run.seed == 3 and run.row.problem_key == before.row.problem_key and run.row.source == "command"


def test_a_set_is_run_again_by_another_estimator(
    nights: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    chosen = save_set(nights[1], "hard ones", ["mei_outliers_80.rrd", "gone.rrd"])
    records = Records(tmp_path / "again")
    done = rerun([chosen], RunQuery(), "mc", [], None, records, wanted(["mended > 0"], None, False))
    assert done == 1 and "1 pair of runs" in capsys.readouterr().out
    (path,) = (path for path in (tmp_path / "again").glob("*.rrd"))
    assert read_recording(path).estimator == "mc"


def test_what_cannot_be_run_again(
    nights: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    records, asked = Records(tmp_path / "again"), wanted([], None, False)
    with pytest.raises(InputError, match="is unknown to ransac-2p"):
        rerun([nights[0]], RunQuery(), None, ["speed=3"], None, records, asked)
    with pytest.raises(SpherlocError):
        rerun([tmp_path / "none.rrd"], RunQuery(), None, [], None, records, asked)
    mixed = tmp_path / "mixed"
    problem = scene_problem("mei_outliers_80")
    for name in ("mc", "ransac-2p"):
        write_recording(estimate(problem, name), mixed / f"{name}.rrd")
    with pytest.raises(InputError, match="give one with --estimator"):
        rerun([mixed], RunQuery(), None, ["bound_px=4"], None, records, asked)
    with pytest.raises(InputError, match="give the name of an HTML file"):
        wanted([], Path("night.pdf"), False)
    assert capsys.readouterr().out == ""
