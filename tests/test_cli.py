"""The command line as a user calls it: a process, its exit code, what it prints."""

import json
import os
import subprocess
import sys
from dataclasses import dataclass, fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from cli_process import ROOT, SCENE, one_sentence, spherloc, spherloc_here

from spherloc.datasets import load_scene
from spherloc.diagnosis import Cause, Diagnosis
from spherloc.errors import InputError
from spherloc.estimators import estimate
from spherloc.trace import Certificate
from spherloc_viz.commands import run
from spherloc_viz.commands.runs import print_runs
from spherloc_viz.options import json_text
from spherloc_viz.recording.index.query import RunQuery
from spherloc_viz.start import answer
from tests.needs import DATA, needs

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


def tiny(folder: Path, toml: str = HEAD + CAMERA + GRAVITY, rows: str | bytes = ROWS) -> Path:
    """A measured scene of three matches."""
    (folder / "matches.csv").write_bytes(rows if isinstance(rows, bytes) else rows.encode())
    (folder / "scene.toml").write_text(toml)
    return folder / "scene.toml"


@pytest.mark.parametrize("estimator", ["mc", "mc-exact", "ransac-2p"])
def test_run_prints_one_json_object_a_scene_and_records_each(tmp_path: Path, estimator: str) -> None:
    scenes = [SCENE, ROOT / "scenes" / "panorama_outliers_90.toml"]
    given = (SCENE, "panorama_outliers_90")
    call = spherloc if estimator == "mc" else spherloc_here
    result = call("run", *given, "--estimator", estimator, "--seed", "5", "--json", cwd=tmp_path)
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
    assert len(list((tmp_path / "recordings").glob("*.rrd"))) == len(scenes)


def test_same_seed_same_pose_and_other_seed_other_problem(tmp_path: Path) -> None:
    def solve(seed: int, call=spherloc_here) -> list[list[float]]:
        result = call("run", SCENE, "--seed", str(seed), "--json", "--no-record", cwd=tmp_path)
        record = json.loads(result.stdout)
        assert record["recording"] is None
        return record["cam_from_map"]

    assert solve(3) == solve(3, spherloc), "in another process too"
    assert solve(3) != solve(4)
    assert not (tmp_path / "recordings").exists()


def test_options_reach_the_estimator(tmp_path: Path) -> None:
    words = ("--estimator", "ransac-2p", "--option", "iterations=50", "confidence=0.9", "--json", "--no-record")
    record = json.loads(spherloc_here("run", SCENE, *words, cwd=tmp_path).stdout)
    options = record["options"]
    assert (options["bound_px"], options["iterations"], options["confidence"]) == (8.0, 50, 0.9)


def refuse(word: str) -> None:
    raise AssertionError(f"{word} is no JSON")


def test_options_of_every_form_reach_the_estimator_and_json(tmp_path: Path) -> None:
    words = ("gravity_sd_deg=inf", "robust=huber", "confidence=none", "local_optimization=true")
    result = spherloc_here(
        "run", SCENE, "--estimator", "ransac-2p", "--json", "--no-record", "--option", *words, cwd=tmp_path
    )
    (line,) = result.stdout.splitlines()
    options = json.loads(line, parse_constant=refuse)["options"]
    assert options["gravity_sd_deg"] == "inf" and options["robust"] == "huber"
    assert options["confidence"] is None and options["local_optimization"] is True


@pytest.mark.parametrize("estimator", ["mc", "mc-exact"])
def test_json_has_certificate_and_diagnosis(tmp_path: Path, estimator: str) -> None:
    scene = ROOT / "scenes" / "mei_outliers_90.toml"
    result = spherloc_here("run", scene, "--estimator", estimator, "--json", "--no-record", cwd=tmp_path)
    record = json.loads(result.stdout, parse_constant=refuse)
    if estimator == "mc":
        assert record["certificate"] is None
    else:
        certificate = record["certificate"]
        assert certificate["upper_bound"] - certificate["lower_bound"] == certificate["gap"] == 0
        assert certificate["proven"] is True and 0 <= certificate["nfa"] < 1e-6
    assert set(record["diagnosis"]) == {item.name for item in fields(Diagnosis)} - {"doubtful"}
    assert record["diagnosis"]["cause"] == "ok" and record["outcome"] == "localized"


def test_text_tells_what_is_proven(tmp_path: Path) -> None:
    scene = ROOT / "scenes" / "mei_outliers_90.toml"
    result = spherloc_here("run", scene, "--estimator", "mc-exact", "--no-record", cwd=tmp_path)
    assert "proven optimal: no pose explains more than" in result.stdout
    assert "NFA (expected number of false sets of this size):" in result.stdout and "diagnosis" not in result.stdout


def test_doubtful_runs_get_a_line_of_diagnosis() -> None:
    trace = estimate(load_scene(SCENE).problem(), "mc")
    wrong = Diagnosis(
        Cause.GRAVITY_OFF, True, "It leans.", ("By 3 degrees.",), "Give better gravity.", True, np.eye(3, 4)
    )
    text = run.as_text(SCENE, trace, wrong, None)
    assert "\n  diagnosis: gravity prior off. It leans. Give better gravity." in text
    assert "diagnosis" not in run.as_text(SCENE, trace, replace(wrong, cause=Cause.OK, doubtful=False), None)
    record = json.loads(json_text(run.as_record(SCENE, trace, wrong, None)))
    assert record["diagnosis"]["cause"] == "gravity prior off" and record["diagnosis"]["evidence"] == ["By 3 degrees."]
    assert record["diagnosis"]["alternative_cam_from_map"] == np.eye(3, 4).tolist()


def test_an_answer_that_cannot_be_known_is_said() -> None:
    trace = estimate(load_scene(SCENE).problem(), "mc")
    fine = Diagnosis(Cause.OK, False, "", (), "", True)
    text = run.as_text(SCENE, replace(trace, certificate=Certificate(6, 4, np.inf)), fine, None)
    assert "not proven optimal: no pose explains more than 6, so at most 2 more" in text
    assert "The answer cannot be known: inf sets of 4 wrong matches" in text


@dataclass(frozen=True)
class Every:
    """One option of every form."""

    bound_px: float = 3.0
    tries: int = 7
    wise: bool = False
    kernel: Literal["none", "huber"] = "none"
    limit: float | None = 1.0
    choice: Literal["a", "b"] | None = None


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("bound_px=4", 4.0),
        ("bound_px=inf", np.inf),
        ("bound_px= 1e-2 ", 0.01),
        ("tries=12", 12),
        ("wise=true", True),
        ("wise=False", False),
        ("kernel=none", "none"),
        ("kernel=huber", "huber"),
        ("limit=none", None),
        ("limit=None", None),
        ("limit=2", 2.0),
        ("limit=inf", np.inf),
        ("choice=b", "b"),
        ("choice=none", None),
    ],
)
def test_option_values(monkeypatch: pytest.MonkeyPatch, setting: str, value: object) -> None:
    monkeypatch.setattr(run, "options_type", lambda name: Every)
    found = run.parse_settings("any", [setting])[setting.partition("=")[0]]
    assert found == value and type(found) is type(value)


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("bound_px=wide", "bound_px is 'wide'; give a number."),
        ("bound_px=nan", "bound_px is 'nan'; give a number."),
        ("bound_px=none", "bound_px is 'none'; give a number."),
        ("bound_px=1e-300", "bound_px is 1e-300; give a number from 1e-06 to 1e+06."),
        ("bound_px=-1e300", "bound_px is -1e+300; give a number from 1e-06 to 1e+06."),
        ("limit=1e300", "limit is 1e+300; give a number from 1e-12 to 1e+12."),
        ("tries=1.5", "tries is '1.5'; give a whole number."),
        ("wise=1", "wise is '1'; give true or false."),
        ("kernel=cauchy", "kernel is 'cauchy'; give none or huber."),
        ("limit=soon", "limit is 'soon'; give a number or none."),
        ("choice=c", "choice is 'c'; give a, b or none."),
        ("choice=", "choice is ''; give a, b or none."),
        ("colour=3", "option 'colour=3' is unknown to any; give KEY=VALUE with bound_px, tries,"),
        ("tries", "option 'tries' is unknown to any"),
    ],
)
def test_wrong_option_values_name_what_may_be_given(monkeypatch: pytest.MonkeyPatch, setting: str, said: str) -> None:
    monkeypatch.setattr(run, "options_type", lambda name: Every)
    with pytest.raises(InputError) as error:
        run.parse_settings("any", [setting])
    assert said in str(error.value)


def test_bound_of_the_scene_is_used_and_truth_may_be_unknown(tmp_path: Path) -> None:
    scene = tiny(tmp_path, HEAD + CAMERA + GRAVITY + "\n[options]\nbound_px = 5\n")
    result = spherloc_here("run", scene, "--json", "--no-record", cwd=tmp_path)
    record = json.loads(result.stdout)
    assert record["options"]["bound_px"] == 5
    assert record["success"] is None and record["rotation_error_deg"] is None


def test_a_wrong_scene_does_not_stop_the_others(tmp_path: Path) -> None:
    result = spherloc("run", "nowhere.toml", SCENE, "--json", "--no-record", cwd=tmp_path)
    assert result.returncode == 2
    assert "nowhere.toml" in result.stderr and len(result.stderr.strip().splitlines()) == 1
    assert json.loads(result.stdout)["success"] is True


def test_text_output_tells_pose_inliers_time_and_errors(tmp_path: Path) -> None:
    result = spherloc_here("run", SCENE, "--no-record", cwd=tmp_path)
    for part in ("cam_from_map", "20 of 100 matches are inliers", " ms", "success:", "precision 0.950"):
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
    message = one_sentence(spherloc_here("run", tiny(tmp_path, toml, rows), "--no-record", cwd=tmp_path))
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
        (("run", SCENE, "--option", "robust=tukey"), "none, huber, cauchy or adaptive"),
        (("run", SCENE, "--seed", "-4"), "seed"),
        (("play", "missing.toml"), "missing.toml"),
    ],
)
def test_bad_words_are_one_sentence(tmp_path: Path, words: tuple[str | Path, ...], part: str) -> None:
    assert part in one_sentence(spherloc_here(*words, cwd=tmp_path))


@pytest.mark.parametrize("command", ["run", "runs"])
def test_a_path_that_no_disk_takes_is_one_sentence(tmp_path: Path, command: str) -> None:
    message = one_sentence(spherloc_here(command, "x" * 5000, cwd=tmp_path))
    assert ("too long" in message or "no such folder" in message) and len(message) < 500


def test_a_closed_pipe_ends_it_without_a_word(tmp_path: Path) -> None:
    program = [str(Path(sys.executable).with_name("spherloc")), "scenes"]
    reader, writer = os.pipe()
    os.close(reader)
    try:
        done = subprocess.run(program, stdout=writer, stderr=subprocess.PIPE, text=True, cwd=tmp_path, check=False)
    finally:
        os.close(writer)
    assert done.returncode == 141 and done.stderr == ""


def test_a_folder_that_cannot_be_written_keeps_the_result(tmp_path: Path) -> None:
    (tmp_path / "recordings").write_text("in the way")
    result = spherloc_here("run", SCENE, "--json", cwd=tmp_path)
    assert result.returncode == 2
    assert len(result.stderr.strip().splitlines()) == 1 and "recordings" in result.stderr
    record = json.loads(result.stdout)
    assert record["success"] is True and record["recording"] is None


@pytest.mark.parametrize("command", ["run", "localize", "play", "view", "scenes"])
def test_help_has_examples(tmp_path: Path, command: str) -> None:
    result = spherloc_here(command, "--help", cwd=tmp_path)
    assert result.returncode == 0
    assert "For example:" in result.stdout and f"spherloc {command}" in result.stdout


@needs("aria_adt_fisheye")
@pytest.mark.parametrize("estimator", ["mc", "ransac-2p"])
def test_real_problems_from_the_command_line(tmp_path: Path, estimator: str) -> None:
    limits = {"rgb": (0.3, 0.02), "slam_left": (0.3, 0.02), "slam_right": (1.0, 0.03)}
    scenes = [DATA / "aria_adt_fisheye" / f"{name}.toml" for name in limits]
    result = spherloc_here("run", *scenes, "--estimator", estimator, "--json", "--no-record", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    for line, (degrees, metres) in zip(result.stdout.splitlines(), limits.values(), strict=True):
        record = json.loads(line)
        assert record["rotation_error_deg"] < degrees and record["translation_error_m"] < metres, record


def test_the_first_screen_names_every_command_and_fits() -> None:
    from scripts.documentation import commands
    from spherloc_viz.start import COMMANDS

    def start(*words: str) -> subprocess.CompletedProcess[str]:
        program = [sys.executable, "-c", "from spherloc_viz.start import main; main()", *words]
        return subprocess.run(program, capture_output=True, text=True, cwd=ROOT, check=False)

    told = start("--help")
    assert told.returncode == 0 and told.stdout == start("-h").stdout
    lines = told.stdout.splitlines()
    assert len(lines) <= 40 and max(map(len, lines)) <= 100
    assert {name for named in COMMANDS.values() for name in named} == set(commands())
    nothing = start()
    assert (nothing.returncode, nothing.stdout) == (2, told.stdout)
    assert start("--version").stdout.strip() == f"spherloc {version('spherloc')}"


def test_openblas_has_one_thread_unless_another_number_is_set() -> None:
    """Before numpy is imported, which reads it once."""
    program = "import os, sys\nfrom spherloc_viz.start import main\nassert 'numpy' not in sys.modules\n"
    program += "try: main()\nfinally: print(os.environ['OPENBLAS_NUM_THREADS'])"
    others = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    for given, threads in ({}, "1"), ({"OPENBLAS_NUM_THREADS": "3"}, "3"):
        words, environment = [sys.executable, "-c", program, "--version"], others | given
        said = subprocess.run(words, env=environment, capture_output=True, text=True, cwd=ROOT, check=False).stdout
        assert said.split()[-1] == threads, said


def test_a_word_that_is_no_command_is_told_what_to_do(tmp_path: Path) -> None:
    assert answer(["play"]) is None and answer(["--unknown"]) is None
    for name in ("scene.toml", "run.rrd"):
        path = tmp_path / name
        path.touch()
        told, code = answer(["open", str(path)]) or ("", 0)
        assert code == 2 and f"to open '{path}': spherloc play {path}" in told
        assert answer([str(path)]) == (told.replace("'open'", f"'{path}'"), 2)
    for name, said in (("photos.zip", "is an archive; unpack it"), ("trip.pdf", "is a PDF document; save the photo")):
        path = tmp_path / name
        path.touch()
        told, code = answer([str(path)]) or ("", 0)
        assert code == 2 and f"spherloc: {path}: {said}" in told and "play" not in told
    told, code = answer(["localise", str(tmp_path)]) or ("", 0)
    assert code == 2 and "did you mean 'localize'?" in told


def test_runs_of_a_results_folder_are_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The recordings of a sequence lie in a folder of its results; the list above says so."""
    results = tmp_path / "recordings" / "street_auto_0"
    spherloc_here("run", SCENE, "--recordings", str(results / "recordings"), cwd=tmp_path)
    capsys.readouterr()
    print_runs(results, RunQuery(), None, None, "table")
    assert "MEI fisheye" in capsys.readouterr().out
    print_runs(tmp_path / "recordings", RunQuery(), None, None, "table")
    told = capsys.readouterr()
    assert "no run matches, of 0 runs" in told.err and f"There are others in {results / 'recordings'}." in told.err
