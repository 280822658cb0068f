"""``spherloc localize`` as a user calls it: what it leaves in its folder, and how it ends, even when it is killed."""

import csv
import importlib
import json
import os
import re
import resource
import signal
import subprocess
import sys
import time
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from sequence_samples import true_pose, write_scene

from spherloc import registry
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.datasets import load_scene
from spherloc.datasets.map_scene import OPTIONAL, OPTIONAL_EXAMPLE, MapScene
from spherloc.errors import SpherlocError
from spherloc.experiments import read_results
from spherloc.experiments.kept_results import kept_results
from spherloc.experiments.sequence import inputs_of, localize_queries
from spherloc.experiments.summary import summarize
from spherloc.frontend.view import Gravity, View
from spherloc.geometry import pose
from spherloc.mapping.scenes.scene_files import MODEL, SCENE
from spherloc.metrics import AWAY, BEYOND
from spherloc.trajectory import read_tum
from spherloc.warm_up import warm_up
from spherloc_viz.app.catalog import Catalog
from spherloc_viz.app.controls.query_strip import said_of
from spherloc_viz.app.controls.sequence_panel import sequence_html
from spherloc_viz.app.server import best_localized
from spherloc_viz.commands.bundled import all_scenes, one_kind
from spherloc_viz.commands.image_commands import _results_name
from spherloc_viz.commands.localize import Solving, compare_sequences, localize_in_maps, localize_sequence
from spherloc_viz.commands.run import Records
from spherloc_viz.commands.sequence_text import sequence_text
from spherloc_viz.plots.trajectories import backdrop_of, trajectory_png
from spherloc_viz.recording.content.data import read_recording
from spherloc_viz.recording.index.query import RunQuery
from spherloc_viz.recording.index.run_index import RunIndex
from spherloc_viz.recording.reviews import review_path
from spherloc_viz.recording.storage.store import LOG_NAME
from tests.cli_process import spherloc_here
from tests.waiting import LIMIT_S

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = [sys.executable, "-c", "import signal\nsignal.signal(signal.SIGINT, signal.default_int_handler)\n"
           "from spherloc_viz.start import main\nmain()", "localize"]  # fmt: skip
"""A shell's background job, and what it starts, ignores SIGINT."""


def command(*words: str | Path, environment: dict[str, str], **more) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [*PROGRAM, *map(str, words)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment, **more
    )


def run(scene: Path, output: Path, **changes: Any) -> int:
    words = {"estimator": "mc", "seed": 0, "settings": (), "queries": (), "retry_failed": False, "records": None}
    words |= changes
    how = [Solving(words["estimator"], words["settings"], output, words["records"])]
    return localize_sequence(scene, how, words["seed"], words["queries"], words["retry_failed"])


def table(folder: Path) -> list[dict[str, str]]:
    with (folder / "results.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def lines(path: Path) -> int:
    return path.read_bytes().count(b"\n") if path.exists() else 0


def wait_for(reached, process: subprocess.Popen[str]) -> None:
    while not reached():
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)


@pytest.mark.usefixtures("no_pictures")
def test_everything_is_written(tmp_path: Path, drawn: dict[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    scene, out = write_scene(tmp_path, queries=5, few=[1], broken=[3], timed=True), tmp_path / "out"
    assert run(scene, out, records=Records(out / "recordings")) == 1
    rows = table(out)
    assert [row["query"] for row in rows] == [f"image{place}.png" for place in range(5)]
    assert [row["status"] for row in rows] == ["localized", "failed", "localized", "unreadable", "localized"]
    assert rows[0]["timestamp_s"] == "1520530308.25" and rows[1]["remarks"] == "image1.png: few matches."
    results = read_results(out)
    assert [None if path is None else path.parent for path in results.recordings] == [
        out / "recordings", None, out / "recordings", None, out / "recordings"
    ]  # fmt: skip
    assert len(list((out / "recordings").glob("*.rrd"))) == 3
    assert results.recordings[2] is not None
    recorded = read_recording(results.recordings[2])
    np.testing.assert_array_equal(recorded.cam_from_map, results.rows[2].cam_from_map)
    estimated, truth = read_tum(out / "trajectory.tum"), read_tum(out / "truth.tum")
    assert len(estimated) == 3 and len(truth) == 5
    for at, place in enumerate((0, 2, 4)):
        whole = np.vstack([true_pose(place), [0, 0, 0, 1]])
        np.testing.assert_allclose(truth.map_from_body[place], np.linalg.inv(whole)[:3], atol=1e-9)
        off = np.linalg.norm(estimated.map_from_body[at][:, 3] - truth.map_from_body[place][:, 3])
        assert off == pytest.approx(float(rows[place]["translation_error_m"]), abs=1e-9)
    summary = json.loads((out / "summary.json").read_text())
    assert (summary["localized"], summary["failed"], summary["unreadable"]) == (3, 1, 1)
    assert [rate["judged"] for rate in summary["success"]] == [4, 4]
    configuration = json.loads((out / "configuration.json").read_text())
    assert configuration["options"]["bound_px"] == 3.0 and configuration["versions"]["opencv"] == cv2.__version__
    told = capsys.readouterr()
    assert "75.0 % (3 of 4; 95 %: 30.1 to 95.4 %)" in told.out and "not judged: 1 with an unreadable image" in told.out
    assert "no pose: drawn walk, image1.png: 1 usable of 1" in told.out
    assert "The loader skipped nothing of note." in told.err


@pytest.mark.usefixtures("no_pictures")
def test_a_killed_run_goes_on_and_ends_as_if_nothing_had_happened(
    tmp_path: Path, drawn: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    scene, out, whole = write_scene(tmp_path, queries=6, stuck=[3]), tmp_path / "out", tmp_path / "whole"
    words = (scene, "--output", out, "--estimator", "ransac-2p", "--seed", "3")
    process = command(*words, environment=drawn)
    wait_for(lambda: lines(out / "results.jsonl") >= 2, process)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    (tmp_path / "images" / "go on").touch()
    done = lines(out / "results.jsonl")
    assert 2 <= done <= 3
    # Not more than the query in flight is lost: nothing else was recorded.
    assert done <= len([path for path in (out / "recordings").iterdir() if path.suffix == ".rrd"]) <= done + 1
    half = (out / "results.jsonl").read_bytes() + b'{"index": 5, "query": "ima'
    (out / "results.jsonl").write_bytes(half)
    assert run(scene, out, estimator="ransac-2p", seed=3, records=Records(out / "recordings")) == 0
    errors = capsys.readouterr().err
    assert "removed a half written line" in errors and f"{done} of 6 queries are done already" in errors
    assert run(scene, whole, estimator="ransac-2p", seed=3) == 0
    resumed, at_once = read_results(out), read_results(whole)
    assert resumed.names == at_once.names and len(resumed.names) == 6
    for a, b in zip(resumed.rows, at_once.rows, strict=True):
        np.testing.assert_array_equal(a.cam_from_map, b.cam_from_map)
    assert all(path is not None and read_recording(path) for path in resumed.recordings)
    assert (out / "trajectory.tum").read_bytes() == (whole / "trajectory.tum").read_bytes()


def test_ctrl_c_ends_at_once_and_says_how_to_go_on(tmp_path: Path, drawn: dict[str, str]) -> None:
    warm_up(estimators=["auto"])  # it would tell of compiling
    scene, out = write_scene(tmp_path, queries=3, stuck=[1]), tmp_path / "out"
    process = command(scene, "--output", out, "--no-record", environment=drawn)
    wait_for(lambda: lines(out / "results.jsonl") >= 1, process)  # and then the second query is being matched
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 130 and output == ""
    # Ctrl-C may come after the row is on the disk and before the program has counted it.
    assert re.fullmatch(
        r"[^\n]*stopped; [01] of 3 queries are done in .*out, and the same command goes on from there\.\n", errors
    )


@pytest.mark.usefixtures("no_pictures")
def test_a_full_disk_keeps_what_is_done(tmp_path: Path, drawn: dict[str, str]) -> None:
    warm_up(estimators=["mc"])  # whose cache the limit below would otherwise hit
    scene, out = write_scene(tmp_path, queries=9), tmp_path / "out"

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (4000, 4000))

    # Python would leave the first half of compiled modules behind.
    environment = drawn | {"PYTHONDONTWRITEBYTECODE": "1"}
    words = (scene, "--output", out, "--estimator", "mc", "--no-record")
    process = command(*words, environment=environment, preexec_fn=limit)
    output, errors = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 2 and output == "", errors
    (sentence,) = errors.strip().splitlines()
    kept = lines(out / "results.jsonl")
    assert kept >= 1 and f"what is done is kept ({kept} queries): make room there" in sentence
    assert "results.jsonl: cannot be written (File too large)" in sentence
    assert run(scene, out) == 0 and len(read_results(out).rows) == 9


@pytest.mark.usefixtures("drawn", "no_pictures")
def test_a_recording_that_finds_no_room_ends_the_run(tmp_path: Path) -> None:
    """Not recorded is not done: when there is room again, no recording is missing."""
    scene, out = write_scene(tmp_path, queries=2), tmp_path / "out"
    out.mkdir()
    (out / "recordings").write_text("in the way")
    with pytest.raises(SpherlocError, match=r"recordings.*the run cannot be recorded.* is kept \(0 of 2 queries\)"):
        run(scene, out, records=Records(out / "recordings"))
    assert lines(out / "results.jsonl") == 0
    (out / "recordings").unlink()
    assert run(scene, out, records=Records(out / "recordings")) == 0 and None not in read_results(out).recordings


@pytest.mark.usefixtures("drawn", "no_pictures")
def test_chosen_queries_first_then_the_others(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene, out = write_scene(tmp_path, queries=5, few=[3]), tmp_path / "out"
    assert run(scene, out, queries=["0:5:4"]) == 0
    assert [row["query"] for row in table(out)] == ["image0.png", "image4.png"]
    assert "2 of 2 queries are localized, 0 more have a doubtful pose, of 5 in the scene" in capsys.readouterr().out
    assert run(scene, out, queries=["image4.png", "image2.png"]) == 0
    assert [row["index"] for row in table(out)] == ["0", "2", "4"]
    assert run(scene, out) == 1
    assert run(scene, out, queries=["0:3"]) == 0


@pytest.mark.usefixtures("drawn", "no_pictures")
def test_failures_are_done_again_when_asked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene, out = write_scene(tmp_path, queries=3, broken=[1]), tmp_path / "out"
    assert run(scene, out) == 1
    first = table(out)
    assert run(scene, out) == 1 and "done again" not in capsys.readouterr().err
    assert run(scene, out, retry_failed=True) == 1
    assert "queries without a pose that are done again: 1." in capsys.readouterr().err
    (tmp_path / "images" / "image1.png").write_bytes((tmp_path / "images" / "image0.png").read_bytes())
    assert run(scene, out) == 0 and "of image1.png has changed" in capsys.readouterr().err
    assert [row["status"] for row in table(out)] == ["localized"] * 3
    assert table(out)[0] == first[0]


@pytest.mark.usefixtures("drawn", "no_pictures")
def test_a_query_that_has_changed_is_done_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The others stay as they are, and so do results of versions that did not note what they depend on."""
    scene, out = write_scene(tmp_path, queries=3), tmp_path / "out"
    assert run(scene, out) == 0
    rows = [json.loads(line) for line in (out / "results.jsonl").read_text().splitlines()]
    now = [row["inputs"] for row in rows]
    assert all(now) and len(set(now)) == 3

    def again(*before: str | None) -> str:
        for row, inputs in zip(rows, before, strict=True):
            row.pop("inputs", None)
            row |= {} if inputs is None else {"inputs": inputs}
        (out / "results.jsonl").write_text("".join(f"{json.dumps(row)}\n" for row in rows))
        assert run(scene, out) == 0
        assert [row.status for row in read_results(out).rows] == ["localized"] * 3
        return capsys.readouterr().err

    told = again(now[0], "0" * 16, now[2])
    assert f"gravity or true pose of {rows[1]['query']} has changed: done again" in told
    assert "2 of 3 queries are done already" in told and [row.inputs for row in read_results(out).rows] == now
    told = again(None, "0" * 16, "1" * 16)
    assert f"true pose of {rows[1]['query']} and 1 more has changed" in told and "1 of 3 queries are done" in told


@pytest.mark.usefixtures("drawn", "no_pictures")
def test_what_was_localized_before_is_found(tmp_path: Path) -> None:
    """The newest results of the scene as it is now, without queries that have changed since."""
    path, folder = write_scene(tmp_path, queries=3), tmp_path / "results"
    scene = load_scene(path)
    assert isinstance(scene, MapScene) and kept_results(folder, scene, path) is None
    assert run(path, folder / "all") == 0 and run(path, folder / "one", queries=["image1.png"]) == 0
    (folder / "damaged").mkdir()
    (folder / "damaged" / "configuration.json").write_text("{")
    for name, age_s in (("all", 10.0), ("one", 0.0)):
        os.utime(folder / name / "configuration.json", (1e9 - age_s, 1e9 - age_s))
    found = kept_results(folder, scene, path)
    assert found is not None and found.folder == folder / "one" and found.names == ("image1.png",)
    os.utime(folder / "one" / "configuration.json", (1e9 - 20.0, 1e9 - 20.0))
    (tmp_path / "images" / "image1.png").write_bytes(b"another image")
    found = kept_results(folder, scene, path)
    assert found is not None and found.folder == folder / "all" and found.names == ("image0.png", "image2.png")
    path.write_text(path.read_text().replace("drawn walk", "another walk"))
    assert kept_results(folder, scene, path) is None


@pytest.mark.usefixtures("drawn", "no_pictures")
def test_pages_begin_with_the_best_query_that_was_localized_before(tmp_path: Path) -> None:
    """That of most inliers among the localized ones, by the estimator that found it."""
    path, folder = write_scene(tmp_path, queries=3), tmp_path / "results"
    catalog = Catalog(path)
    assert best_localized(catalog, folder) is None
    assert run(path, folder / "all") == 0
    rows = read_results(folder / "all").rows
    best = max(rows, key=lambda row: row.inliers or 0)
    begin = best_localized(catalog, folder)
    assert begin is not None and begin.estimator == read_results(folder / "all").configuration.estimator
    assert begin.scene.query == best.query and begin.scene.scene == next(iter(catalog.scenes))
    lines = (folder / "all" / "results.jsonl").read_text().splitlines()
    doubted = [json.loads(line) | {"status": "doubtful"} if best.query in line else json.loads(line) for line in lines]
    (folder / "all" / "results.jsonl").write_text("".join(f"{json.dumps(row)}\n" for row in doubted))
    begin = best_localized(catalog, folder)
    assert begin is not None and begin.scene.query != best.query


def test_what_a_result_depends_on_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(b"1234")
    camera = KannalaBrandt(400, 300, 90.0, 90.0, 200.0, 150.0, (0.0, 0.0, 0.0, 0.0))
    down = np.array([0.0, 1.0, 0.0])
    view = View("a.png", camera, path, np.eye(3, 4), Gravity(down, "the IMU", 0.01))
    others = (
        replace(view, camera=replace(camera, fx=91.0)),
        replace(view, cam_from_map=np.eye(3, 4) + 0.01),
        replace(view, cam_from_map=None),
        replace(view, gravity=Gravity(-down, "the IMU", 0.01)),
        replace(view, gravity=Gravity(down, "the IMU", 0.02)),
        replace(view, gravity=None),
        replace(view, path=tmp_path / "none.png"),
    )
    assert len({inputs_of(one) for one in (view, *others)}) == 1 + len(others)
    assert inputs_of(view) == inputs_of(replace(view, name="b.png", gravity=Gravity(down + 1e-9, "another", 0.01)))
    before = inputs_of(view)
    path.write_bytes(b"12345")
    assert inputs_of(view) != before


@pytest.mark.usefixtures("drawn")
def test_wrong_words_are_one_sentence(tmp_path: Path) -> None:
    scene, out = write_scene(tmp_path, queries=2), tmp_path / "out"
    assert run(scene, out) == 0
    bundled = ROOT / "scenes" / "mei_outliers_80.toml"
    for path, changes, said in (
        (scene, {"seed": 1}, "(seed is 1, was 0); give another folder (--output)."),
        (scene, {"settings": ["bound_px=4"]}, "(options.bound_px is 4.0, was 3.0); give another folder (--output)."),
        (scene, {"settings": ["bound_px=-1"]}, "bound_px"),
        (scene, {"queries": ["7:9"]}, "'7:9' chooses none of the 2 queries"),
        (scene, {"estimator": "magic"}, "'magic': choose one of"),
        (scene, {"seed": -1}, "seed is -1"),
        (bundled, {}, f"is one problem, no sequence of query images; solve it by: spherloc run {bundled}"),
    ):
        with pytest.raises(SpherlocError) as error:
            run(path, out, **changes)
        assert said in str(error.value)
    scene.write_text(scene.read_text() + "# edited\n")
    with pytest.raises(SpherlocError, match=r"\(the scene file or its map is another one\)"):
        run(scene, out)
    assert len(table(out)) == 2


def test_results_of_two_maps_do_not_meet(tmp_path: Path) -> None:
    """Nor do those of the groups in them."""
    places = [tmp_path / name for name in ("attic_map", "cellar_map", "cellar_map/group_2")]
    for place in places:
        (place / MODEL).mkdir(parents=True)
        (place / SCENE).touch()
    assert [_results_name(place / "new.toml") for place in places] == [
        "attic_map_new",
        "cellar_map_new",
        "cellar_map_group_2_new",
    ]
    assert _results_name(tmp_path / "street.toml") == "street"


@pytest.mark.usefixtures("drawn", "no_pictures")
def test_a_place_is_doubted_where_another_map_explains_more(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    solvings = {}
    for folder, kind in ((first, {"wrong": [2]}), (second, {"thin": [1, 2]})):
        folder.mkdir()
        solvings[write_scene(folder, queries=3, **kind)] = Solving("auto", (), folder / "out", None)
    for _ in range(2):  # what is done already is compared too
        assert localize_in_maps(solvings) == 0
        assert [row["status"] for row in table(first / "out")] == ["localized", "localized", "doubtful"]
        told = table(second / "out")
        assert [row["status"] for row in told] == ["localized", "doubtful", "localized"]
        assert told[1]["remarks"] == (
            f"More of its matches agree with a pose in the map of {first / 'scene.toml'}; it may have been taken there."
        )
        summary = json.loads((second / "out" / "summary.json").read_text())
        assert (summary["localized"], summary["doubtful"]) == (2, 1)
        said = capsys.readouterr().out
        assert f"image1.png: {told[1]['remarks'][:-1]}" in said
        assert said.endswith(
            "3 of 3 queries are localized in one of these 2 maps\n"
            f"  2 in {first / 'scene.toml'}: image0.png, image1.png\n"
            f"  2 in {second / 'scene.toml'}: image0.png, image2.png\n"
        )
    write_scene(second, queries=3, wrong=[2])
    assert localize_in_maps({**solvings, second / "scene.toml": Solving("auto", (), tmp_path / "new", None)}) == 1
    assert capsys.readouterr().out.endswith("\n  1 in none: image2.png\n")


def pixels_of(png: bytes) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return image[..., ::-1].astype(int)


def near(image: np.ndarray, color: tuple[int, int, int]) -> int:
    return int((np.abs(image - color).max(axis=2) < 12).sum())


@pytest.mark.usefixtures("drawn")
def test_the_picture_shows_truth_errors_and_failures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from spherloc_viz.style import OUTLIER, TRUTH

    good = write_scene(tmp_path, queries=4, timed=True)
    assert run(good, tmp_path / "good") == 0
    png = (tmp_path / "good" / "trajectory.png").read_bytes()
    scene = load_scene(good)
    assert isinstance(scene, MapScene)
    backdrop = backdrop_of(scene)
    assert trajectory_png(read_results(tmp_path / "good"), backdrop) == png
    assert near(pixels_of(png), TRUTH) > 500 and near(pixels_of(png), OUTLIER) == 0
    (tmp_path / "unordered").mkdir()
    run(write_scene(tmp_path / "unordered", queries=4), tmp_path / "unordered" / "out")
    unordered = pixels_of((tmp_path / "unordered" / "out" / "trajectory.png").read_bytes())
    assert 0 < near(unordered, TRUTH) < 500  # photographs without an order in time are not joined
    (tmp_path / "bad").mkdir()
    bad = write_scene(tmp_path / "bad", queries=4, few=[1], wrong=[2])
    run(bad, tmp_path / "bad" / "out")
    shown = pixels_of((tmp_path / "bad" / "out" / "trajectory.png").read_bytes())
    assert near(shown, OUTLIER) > 200
    (tmp_path / "blind").mkdir()
    blind = write_scene(tmp_path / "blind", queries=3, unknown=[0, 1, 2], few=[1])
    blind.write_text(blind.read_text().replace("drawn walk", r"cost $\\frac$ 5 \u8857"))
    capsys.readouterr()
    assert run(blind, tmp_path / "blind" / "out") == 1
    said = capsys.readouterr().out
    assert "errors are unknown: these queries have no true poses" in said and "nothing to judge" not in said
    assert near(pixels_of((tmp_path / "blind" / "out" / "trajectory.png").read_bytes()), TRUTH) == 0
    assert not (tmp_path / "blind" / "out" / "truth.tum").exists()
    told = read_results(tmp_path / "blind" / "out")
    posed = tuple(replace(item, status="localized") for item in told.rows if item.cam_from_map is not None)
    believed, doubted = (
        near(pixels_of(trajectory_png(replace(told, rows=rows), backdrop)), OUTLIER)
        for rows in (posed, (*posed[:-1], replace(posed[-1], status="doubtful")))
    )
    assert believed == 0 and doubted > 20, "a pose that is not believed looks like one that is"
    (tmp_path / "none").mkdir()
    assert run(write_scene(tmp_path / "none", queries=2, few=[0, 1]), tmp_path / "none" / "out") == 1


@pytest.mark.usefixtures("drawn", "no_pictures")
def test_what_other_queries_say_is_written_and_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A doubt and a new run, which is recorded, though all queries were done before; a comparison has neither."""
    scene, out, why = (
        write_scene(tmp_path, queries=3),
        tmp_path / "out",
        "Taken together with b.png, it should be away.",
    )

    def judged(scene, rows, how, report, say):
        report(1, 1)
        trace = next(trace for _, trace in localize_queries(scene, scene.queries[2:], *how[:3]))
        yield rows[1].doubted(why), None
        yield replace(rows[2], inliers=7), trace

    assert run(scene, out, estimator="mc") == 0
    monkeypatch.setattr("spherloc_viz.commands.localize.judged_together", judged)
    capsys.readouterr()
    assert run(scene, out, estimator="mc", records=Records(out / "recordings")) == 1
    assert f"image1.png: {why.removesuffix('.')}" in capsys.readouterr().out
    results = read_results(out)
    assert results.status == ("localized", "doubtful", "localized") and results.rows[1].doubts == (why,)
    assert [row["status"] for row in table(out)] == list(results.status) and table(out)[2]["inliers"] == "7"
    assert json.loads((out / "summary.json").read_text())["doubtful"] == 1
    assert results.recordings[1] is None and results.recordings[2] is not None and results.recordings[2].exists()
    loaded = load_scene(scene)
    assert isinstance(loaded, MapScene)
    assert said_of("image1.png", results.rows[1], loaded).endswith(why) and not results.rows[0].doubts
    assert f"image1.png is doubtful: {why}" in sequence_html(results.rows, loaded)
    far = replace(results.rows[0], cam_from_map=pose(np.eye(3), np.full(3, 1e9)), translation_error_m=1e9)
    lost = replace(results, rows=(far, *results.rows[1:]))
    known = replace(loaded, cloud=np.eye(3))
    text = sequence_text(lost, summarize(lost), known)
    assert f"image0.png: localized, at {AWAY}, " in text and f"deg and {BEYOND} off" in text
    assert f"ATE of all 3 poses: {BEYOND}" in text
    assert BEYOND in said_of("image0.png", far, known) and "e+0" not in text and "00000" not in text
    aligned = replace(loaded, truth_source="mocap0, aligned with the map")
    assert "The true poses are those of mocap0, aligned with the map." in sequence_html(results.rows, aligned)
    assert "  the true poses are those of mocap0, al" in sequence_text(results, summarize(results), aligned)
    assert "true poses" not in sequence_text(results, summarize(results), loaded)
    assert compare_sequences({scene: [Solving("mc", (), tmp_path / "mc", None)]}, 0, (), False, tmp_path) == 0


@pytest.mark.usefixtures("drawn", "no_pictures")
def test_a_query_that_is_tried_anew_keeps_one_recording(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """That which the table names; one that somebody labelled stays, and the command says so."""
    scene, out = write_scene(tmp_path, queries=2), tmp_path / "out"
    records = Records(out / "recordings")

    def judged(scene, rows, how, report, say):
        trace = next(trace for _, trace in localize_queries(scene, scene.queries[1:], *how[:3]))
        yield replace(rows[1], inliers=rows[1].inliers - 1), trace

    assert run(scene, out, estimator="mc", records=records) == 0
    first = read_results(out).recordings
    monkeypatch.setattr("spherloc_viz.commands.localize.judged_together", judged)
    assert run(scene, out, estimator="mc", records=records) == 0
    second = read_results(out).recordings
    assert second[0] == first[0] and second[1] != first[1]
    assert set(records.folder.glob("*.rrd")) == set(second), "the first try is gone"
    with RunIndex(records.folder, print) as index:
        assert {row.file for row in index.find(RunQuery()).rows} == {path.name for path in second}
    assert first[1].name in (records.folder / LOG_NAME).read_text()
    review_path(second[1]).write_bytes(b"")
    capsys.readouterr()
    assert run(scene, out, estimator="mc", records=records) == 0
    third = read_results(out).recordings
    assert third[1] != second[1] and second[1].exists() and third[1].exists()
    assert f"{second[1].name}: stays, although image1.png was tried anew" in capsys.readouterr().err


@pytest.mark.usefixtures("drawn", "no_pictures")
def test_several_estimators_and_scenes_in_one_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Each result is that of the estimator alone, and the same command goes on."""
    out, scenes = tmp_path / "both", {}
    for name in ("day", "night"):
        (tmp_path / name).mkdir()
        path = write_scene(tmp_path / name, queries=4, few=[1] if name == "night" else [])
        path.write_text(path.read_text().replace("drawn walk", f"walk by {name}"))
        how = [("mc", ()), ("ransac-2p", ("iterations=200",))]
        scenes[path] = [Solving(estimator, options, out / name / estimator, None) for estimator, options in how]
    assert compare_sequences(scenes, 0, (), False, out) == 1
    told = capsys.readouterr().out
    with (out / "comparison.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    named = [("walk by day", "mc"), ("walk by day", "ransac-2p iterations=200")]
    named += [(name.replace("day", "night"), label) for name, label in named]
    assert [(row["scene"], row["estimator"]) for row in rows] == named
    assert [(row["localized"], row["no pose"]) for row in rows] == [("4 of 4", "0")] * 2 + [("3 of 4", "1")] * 2
    assert "walk by night" in told and (out / "comparison.md").read_text().count("\n") == 6
    assert near(pixels_of((out / "walk_by_day.png").read_bytes()), (27, 108, 168)) > 100  # the first one's colour
    run(next(iter(scenes)), tmp_path / "alone", estimator="ransac-2p", settings=("iterations=200",))
    alone, other = read_results(tmp_path / "alone").rows, read_results(out / "day" / "ransac-2p").rows
    for a, b in zip(alone, other, strict=True):
        np.testing.assert_array_equal(a.cam_from_map, b.cam_from_map)
    compare_sequences(scenes, 0, (), False, out)
    assert "4 of 4 queries are done already" in capsys.readouterr().err
    for path in scenes:
        path.write_text(path.read_text().replace("walk by night", "walk by day"))
    alike = {path: [Solving("mc", (), tmp_path / path.parent.name, None)] for path in scenes}
    compare_sequences(alike, 0, (), False, tmp_path / "alike")
    assert {path.name for path in (tmp_path / "alike").glob("*.png")} == {"walk_by_day.png", "walk_by_day_2.png"}


@pytest.mark.usefixtures("drawn", "no_pictures")
def test_one_query_of_a_scene_can_be_run_alone(tmp_path: Path) -> None:
    scene = write_scene(tmp_path, queries=3, few=[1], timed=True)

    def alone(*words: str | Path) -> subprocess.CompletedProcess[str]:
        return spherloc_here("run", "--no-record", "--json", *words, cwd=tmp_path)

    found = alone(scene, "--query", "image2.png")
    assert found.returncode == 0 and "The loader skipped nothing of note." in found.stderr
    record = json.loads(found.stdout)
    assert record["name"] == "drawn walk, image2.png" and record["translation_error_m"] < 0.1
    few = alone(scene, "--query", "image1.png")
    assert few.returncode == 2 and "image1.png: few matches." in few.stderr and "1 usable of 1" in few.stderr
    other = alone(ROOT / "scenes" / "mei_outliers_80.toml", "--query", "image1.png")
    assert other.returncode == 2 and "has no query images to choose from; leave out the query." in other.stderr


@pytest.mark.usefixtures("drawn")
def test_scenes_names_kinds_that_others_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "drawn_matches", raising=False)
    assert "A map scene whose matches are drawn" in one_kind("drawn") and "may also have" not in one_kind("drawn")
    assert tomllib.loads(OPTIONAL_EXAMPLE).keys() == OPTIONAL - {"gravity"}
    assert OPTIONAL_EXAMPLE.strip() in one_kind("colmap") and "may also have" not in one_kind("synthetic")
    with pytest.raises(SpherlocError, match=r"choose one of .*drawn"):
        one_kind("magic")
    registry.lookup.cache_clear()
    monkeypatch.delitem(sys.modules, "drawn_matches")
    (tmp_path / "plug-in" / "drawn_matches.py").write_text("import nothing_of_that_name\n")
    importlib.invalidate_caches()
    (line,) = [line for line in all_scenes().splitlines() if line.split()[:1] == ["drawn"]]
    assert "cannot be imported (ModuleNotFoundError: No module named 'nothing_of_that_name')" in line
    with pytest.raises(SpherlocError, match="scenes of kind drawn cannot be read"):
        one_kind("drawn")
