"""The command line as a user calls it: a process, its exit code, what it prints."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
SCENE = ROOT / "scenes" / "mei_outliers_80.toml"
ARIA = ROOT / ".." / "shared" / "data" / "aria_adt_fisheye"

CAMERA = """
[camera]
model = "equirectangular"
width = 200
height = 100
"""
GRAVITY = """
[gravity]
camera = [0.0, 1.0, 0.0]
map = [0.0, 1.0, 0.0]
"""
HEAD = 'kind = "correspondences"\nname = "tiny"\ncorrespondences = "matches.csv"\n'
ROWS = "u,v,X,Y,Z\n100,50,0,0,5\n150,40,4,-1,0\n60,70,-3,2,1\n"


def spherloc(*words: str | Path, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run the installed console command."""
    program = Path(sys.executable).with_name("spherloc")
    environment = os.environ | {"COLUMNS": "100"}
    return subprocess.run(
        [program, *map(str, words)], cwd=cwd, capture_output=True, text=True, timeout=240, env=environment, check=False
    )


def one_sentence(result: subprocess.CompletedProcess[str]) -> str:
    """The error of a run that failed as a user's mistake should: exit code 2, one line, nothing on stdout."""
    assert result.returncode == 2, result
    assert result.stdout == ""
    lines = result.stderr.strip().splitlines()
    assert len(lines) == 1, result.stderr
    assert lines[0].startswith("spherloc: ") and "Traceback" not in lines[0]
    return lines[0]


def tiny(folder: Path, toml: str = HEAD + CAMERA + GRAVITY, rows: str | bytes = ROWS) -> Path:
    """A measured scene of three matches."""
    (folder / "matches.csv").write_bytes(rows if isinstance(rows, bytes) else rows.encode())
    (folder / "scene.toml").write_text(toml)
    return folder / "scene.toml"


@pytest.mark.parametrize("estimator", ["mc", "ransac-2p"])
def test_run_prints_one_json_object_a_scene_and_records_each(tmp_path: Path, estimator: str) -> None:
    scenes = [SCENE, ROOT / "scenes" / "panorama_outliers_90.toml"]
    result = spherloc("run", *scenes, "--estimator", estimator, "--seed", "5", "--json", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    records = [json.loads(line) for line in result.stdout.splitlines()]
    assert [record["scene"] for record in records] == [str(scene) for scene in scenes]
    for record in records:
        assert record["estimator"] == estimator and record["seed"] == 5
        rotation = np.array(record["cam_from_map"])[:, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
        assert record["correspondences"] == 100 and 5 <= record["inliers"] <= 25
        assert record["time_ms"] > 0
        assert record["success"] is True
        assert record["rotation_error_deg"] < 1 and record["translation_error_m"] < 0.1
        assert (tmp_path / record["recording"]).is_file()
        assert Path(record["recording"]).parent == Path("recordings")
    assert len(list((tmp_path / "recordings").iterdir())) == len(scenes)


def test_same_seed_same_pose_and_other_seed_other_problem(tmp_path: Path) -> None:
    def solve(seed: int) -> list[list[float]]:
        result = spherloc("run", SCENE, "--seed", str(seed), "--json", "--no-record", cwd=tmp_path)
        record = json.loads(result.stdout)
        assert record["recording"] is None
        return record["cam_from_map"]

    assert solve(3) == solve(3)
    assert solve(3) != solve(4)
    assert not (tmp_path / "recordings").exists()


def test_options_reach_the_estimator(tmp_path: Path) -> None:
    words = ("--estimator", "ransac-2p", "--option", "iterations=50", "confidence=0.9", "--json", "--no-record")
    record = json.loads(spherloc("run", SCENE, *words, cwd=tmp_path).stdout)
    assert record["options"] == {"bound_px": 8.0, "iterations": 50, "confidence": 0.9}


def test_bound_of_the_scene_is_used_and_truth_may_be_unknown(tmp_path: Path) -> None:
    scene = tiny(tmp_path, HEAD + CAMERA + GRAVITY + "\n[options]\nbound_px = 5\n")
    result = spherloc("run", scene, "--json", "--no-record", cwd=tmp_path)
    record = json.loads(result.stdout)
    assert record["options"]["bound_px"] == 5
    assert record["success"] is None and record["rotation_error_deg"] is None


def test_a_wrong_scene_does_not_stop_the_others(tmp_path: Path) -> None:
    result = spherloc("run", "nowhere.toml", SCENE, "--json", "--no-record", cwd=tmp_path)
    assert result.returncode == 2
    assert "nowhere.toml" in result.stderr and len(result.stderr.strip().splitlines()) == 1
    assert json.loads(result.stdout)["success"] is True


def test_text_output_tells_pose_inliers_time_and_errors(tmp_path: Path) -> None:
    result = spherloc("run", SCENE, "--no-record", cwd=tmp_path)
    for part in ("cam_from_map", "20 of 100 correspondences are inliers", " ms", "success:", "precision 0.950"):
        assert part in result.stdout, result.stdout


@pytest.mark.parametrize(
    ("toml", "rows", "parts"),
    [
        (HEAD + CAMERA + GRAVITY + "colour = 3\n", ROWS, ["scene.toml", "colour"]),
        (HEAD + CAMERA + GRAVITY, ROWS.replace("-3,2,1", "-3,nan,1"), ["matches.csv, line 4", "Y"]),
        (HEAD + CAMERA + GRAVITY, "u,v,X,Y,Z\n100,50,0,0,5\n", ["1 usable of 1", "two"]),
        (HEAD + CAMERA.replace("equirectangular", "pinhole") + GRAVITY, ROWS, ["scene.toml", "pinhole", "mei"]),
        (HEAD + CAMERA.replace("200", "[") + GRAVITY, ROWS, ["scene.toml", "TOML"]),
        (HEAD + CAMERA.replace("width = 200\n", "") + GRAVITY, ROWS, ["scene.toml", "width"]),
        (HEAD + CAMERA, ROWS, ["scene.toml", "gravity"]),
        (HEAD + CAMERA + GRAVITY, b"\xff\xfe\x00", ["matches.csv", "UTF-8"]),
        (HEAD.replace("matches", "gone") + CAMERA + GRAVITY, ROWS, ["gone.csv"]),
    ],
    ids=[
        "unknown key",
        "NaN",
        "one match",
        "wrong model",
        "broken calibration",
        "no width",
        "no gravity",
        "binary",
        "gone",
    ],
)
def test_bad_input_is_one_sentence_and_exit_code_2(
    tmp_path: Path, toml: str, rows: str | bytes, parts: list[str]
) -> None:
    message = one_sentence(spherloc("run", tiny(tmp_path, toml, rows), "--no-record", cwd=tmp_path))
    for part in parts:
        assert part in message


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (("run",), "no scene given"),
        (("run", "missing.toml"), "missing.toml"),
        (("run", SCENE, "--estimator", "magic"), "magic"),
        (("run", SCENE, "--option", "colour=3"), "colour"),
        (("run", SCENE, "--option", "bound_px=wide"), "wide"),
        (("run", SCENE, "--option", "bound_px=-1"), "bound_px"),
        (("run", SCENE, "--seed", "-4"), "seed"),
        (("view", "missing.rrd"), "missing.rrd"),
        (("play", "missing.toml"), "missing.toml"),
    ],
)
def test_bad_words_are_one_sentence(tmp_path: Path, words: tuple[str | Path, ...], part: str) -> None:
    assert part in one_sentence(spherloc(*words, cwd=tmp_path))


def test_a_folder_that_cannot_be_written_keeps_the_result(tmp_path: Path) -> None:
    (tmp_path / "recordings").write_text("in the way")
    result = spherloc("run", SCENE, "--json", cwd=tmp_path)
    assert result.returncode == 2
    assert len(result.stderr.strip().splitlines()) == 1 and "recordings" in result.stderr
    record = json.loads(result.stdout)
    assert record["success"] is True and record["recording"] is None


@pytest.mark.parametrize("command", ["run", "play", "view", "scenes"])
def test_help_has_examples(tmp_path: Path, command: str) -> None:
    result = spherloc(command, "--help", cwd=tmp_path)
    assert result.returncode == 0
    assert "For example:" in result.stdout and f"spherloc {command}" in result.stdout


def test_scenes_lists_what_play_and_run_accept(tmp_path: Path) -> None:
    result = spherloc("scenes", cwd=tmp_path)
    listed = [Path(line.split("  ")[0]) for line in result.stdout.splitlines()]
    assert len(listed) >= 6 and all(path.is_file() for path in listed)


@pytest.mark.skipif(not ARIA.is_dir(), reason="the shared Aria data are not beside the project")
@pytest.mark.parametrize("estimator", ["mc", "ransac-2p"])
def test_real_problems_from_the_command_line(tmp_path: Path, estimator: str) -> None:
    limits = {"rgb": (0.3, 0.02), "slam_left": (0.3, 0.02), "slam_right": (1.0, 0.03)}
    scenes = [ARIA / f"{name}.toml" for name in limits]
    result = spherloc("run", *scenes, "--estimator", estimator, "--json", "--no-record", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    for line, (degrees, metres) in zip(result.stdout.splitlines(), limits.values(), strict=True):
        record = json.loads(line)
        assert record["rotation_error_deg"] < degrees and record["translation_error_m"] < metres, record
