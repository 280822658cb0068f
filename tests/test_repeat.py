"""A recorded run solved again: the same to the last bit, or what differs is said; and as a scene like any other."""

import json
import runpy
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recording_samples import RUNS, odd_problem, scene_problem

from spherloc.datasets.variation import Variation
from spherloc.errors import InputError, RecordingError
from spherloc.estimators import estimate, options_type
from spherloc.trace import Certificate, Trace
from spherloc_viz.commands.run import Records, run_scenes
from spherloc_viz.recording import replay as repeating
from spherloc_viz.recording.content.data import read_recording
from spherloc_viz.recording.content.writer import write_recording
from spherloc_viz.recording.origin import Origin
from spherloc_viz.recording.recorded_run import RecordedRun
from spherloc_viz.recording.replay import (
    as_record,
    as_text,
    compare,
    different_fields,
    load_recorded_scene,
    missing_options,
    other_versions,
    recorded_options,
    repeat,
    repeat_all,
)
from spherloc_viz.share import as_command, as_python

ROOT = Path(__file__).resolve().parents[1]
MEI = ROOT / "scenes" / "mei_outliers_80.toml"


@pytest.fixture(scope="module")
def trace() -> Trace:
    options = options_type("ransac-2p")(iterations=40, gravity_sd_deg=float("inf"), bound_px=3.0)
    return estimate(scene_problem("mei_outliers_80"), "ransac-2p", options, seed=11)


@pytest.fixture
def path(trace: Trace, tmp_path: Path) -> Path:
    write_recording(trace, tmp_path / "run.rrd", Origin("command", str(MEI), 0))
    return tmp_path / "run.rrd"


def pretend(monkeypatch: pytest.MonkeyPatch, **changes: Any) -> None:
    """Have another trace come out when a run is repeated, as on another machine."""
    monkeypatch.setattr(repeating, "estimate", lambda *words: replace(estimate(*words), **changes))


@pytest.mark.parametrize(("scene", "estimator"), RUNS)
def test_a_run_repeated_is_the_same_to_the_last_bit(scene: str, estimator: str, tmp_path: Path) -> None:
    trace = estimate(scene_problem(scene), estimator, seed=5)
    write_recording(trace, tmp_path / "run.rrd")
    repeated = repeat(tmp_path / "run.rrd")
    assert repeated.same and not repeated.rounding and repeated.assumed == ()
    assert repeated.trace.seed == 5 and repeated.trace.options == trace.options
    assert repeated.versions == ()
    assert as_text(repeated).splitlines()[0].endswith("run.rrd: the same to the last bit")
    assert len(as_text(repeated).splitlines()) == 2


def test_odd_problems_are_repeated_too(rng: np.random.Generator, tmp_path: Path) -> None:
    for turn in range(4):
        write_recording(estimate(odd_problem(rng, turn), "mc", seed=turn), tmp_path / f"{turn}.rrd")
        repeated = repeat(tmp_path / f"{turn}.rrd")
        named = replace(repeated.run.problem, name="a\n\x1b[31mred")
        text = as_text(replace(repeated, run=replace(repeated.run, problem=named)))
        assert repeated.same and len(text.splitlines()) == 2 and "a  [31mred, mc" in text
        json.loads(json.dumps(as_record(repeated)))


def test_a_difference_by_rounding_is_told_as_one(path: Path, trace: Trace, monkeypatch: pytest.MonkeyPatch) -> None:
    pose = np.array(trace.cam_from_map)
    pose[0, 3] = np.nextafter(pose[0, 3], np.inf)
    pretend(monkeypatch, cam_from_map=pose)
    repeated = repeat(path)
    assert not repeated.same and repeated.rounding and [item.what for item in repeated.differences] == ["pose"]
    assert "differs by rounding only" in as_text(repeated)
    pose = pose.copy()
    pose[0, 3] += 1e-3
    pretend(monkeypatch, cam_from_map=pose)
    repeated = repeat(path)
    assert not repeated.rounding and "moved by 0.001 m" in as_text(repeated)


def test_all_that_differs_is_told(path: Path, trace: Trace, monkeypatch: pytest.MonkeyPatch) -> None:
    mask = trace.inlier_mask.copy()
    mask[np.flatnonzero(mask)[:2]] = False
    proof = Certificate(upper_bound=30, lower_bound=20, nfa=1e-3)
    pretend(
        monkeypatch,
        cam_from_map=None,
        inlier_mask=mask,
        certificate=proof,
        message="Nothing.",
        versions=dict(trace.versions) | {"numpy": "9.9"},
    )
    repeated = repeat(path)
    count = int(trace.inlier_mask.sum())
    assert {item.what: item.sentence for item in repeated.differences} == {
        "pose": "a pose was recorded, no pose is found now.",
        "inliers": f"{count} were recorded, {count - 2} are found now: 0 more, 2 no longer.",
        "certificate": "none was recorded, 20 to 30 inliers and 0.001 sets by chance is found now.",
        "message": f"it was “{trace.message}” and is “Nothing.”",
    }
    assert not repeated.rounding
    text = as_text(repeated)
    assert f"numpy: {trace.versions['numpy']} then, 9.9 now" in text and "spherloc:" not in text
    assert as_record(repeated)["same"] is False and as_record(repeated)["cam_from_map"] is None


def test_certificates_that_differ_by_rounding(trace: Trace, path: Path) -> None:
    run = read_recording(path)
    before = Certificate(upper_bound=30, lower_bound=20, nfa=1e-3)

    def told(now: Certificate) -> list[bool]:
        found = compare(replace(run, certificate=before), replace(trace, certificate=now))
        return [item.rounding for item in found]

    assert told(before) == []
    assert told(replace(before, nfa=float(np.nextafter(1e-3, 1)))) == [True]
    assert told(replace(before, nfa=2e-3)) == told(replace(before, upper_bound=31)) == [False]


def test_versions_that_are_not_what_they_were() -> None:
    then, now = {"python": "3.11", "numpy": "2.0", "torch": "1"}, {"python": "3.11", "numpy": "2.1", "machine": "x"}
    found = [(item.name, item.recorded, item.here) for item in other_versions(then, now)]
    assert found == [("numpy", "2.0", "2.1"), ("machine", None, "x"), ("torch", "1", None)]


def test_the_command_ends_with_what_it_found(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert repeat_all([path, path], as_json=False) == 0
    assert capsys.readouterr().out.count("the same to the last bit") == 2
    assert repeat_all([path, path.with_name("none.rrd"), MEI], as_json=True) == 2
    captured = capsys.readouterr()
    (line,) = captured.out.splitlines()
    record = json.loads(line)
    assert record["same"] is True and record["options"]["gravity_sd_deg"] == "inf" and record["seed"] == 11
    assert record["cam_from_map"] == record["recorded_cam_from_map"]
    assert [line.partition(": ")[2] for line in captured.err.splitlines()] == [
        f"{path.with_name('none.rrd')}: no such file; give the path of a recording (.rrd).",
        f"{MEI}: is a TOML file; open it with: spherloc play {MEI}",
    ]
    with pytest.raises(InputError, match="no recording given"):
        repeat_all([], as_json=False)


def test_a_run_that_differs_ends_with_one(
    path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pretend(monkeypatch, message="Else.")
    assert repeat_all([path], as_json=False) == 1
    assert "run.rrd: differs" in capsys.readouterr().out


def changed(run: RecordedRun, **options: Any) -> RecordedRun:
    return replace(run, options={**run.options, **options})


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"magic": 1}, "ransac-2p has no option 'magic' here"),
        ({"iterations": "many"}, "option iterations is 'many', which it cannot be"),
        ({"iterations": True}, "option iterations is True"),
        ({"iterations": 2.5}, "option iterations is 2.5"),
        ({"iterations": -1}, "has options that cannot be"),
        ({"bound_px": float("nan")}, "option bound_px is nan"),
        ({"bound_px": None}, "option bound_px is None"),
        ({"bound_px": 1e-300}, "option bound_px is 1e-300; give a number from 1e-06 to 1e.06"),
        ({"noise_px": 1e300}, "option noise_px is 1e.300"),
        ({"gravity_sd_deg": 1e-300}, "option gravity_sd_deg is 1e-300; give a number from 1e-12"),
        ({"bound_px": [3.0]}, r"option bound_px is \[3.0\]"),
        ({"robust": "welsch"}, "option robust is 'welsch'"),
        ({"<b>" * 500: 1}, "has no option '<b><b>"),
    ],
)
def test_options_that_cannot_be_are_one_sentence(path: Path, options: dict[str, Any], said: str) -> None:
    run = changed(read_recording(path), **options)
    with pytest.raises(RecordingError, match=said) as error:
        recorded_options(run, path)
    assert str(error.value).startswith(f"{path}: ") and len(str(error.value)) < 500


def test_options_of_older_recordings_have_their_defaults_and_are_named(path: Path) -> None:
    run = read_recording(path)
    old = replace(run, options={name: value for name, value in run.options.items() if name != "robust"})
    assert recorded_options(run, path) == recorded_options(old, path) and missing_options(old) == ("robust",)
    with pytest.raises(RecordingError, match="unknown estimator 'gone': choose one of"):
        recorded_options(replace(run, estimator="gone"), path)
    with pytest.raises(RecordingError, match="are not a table"):
        recorded_options(replace(run, options=[1]), path)  # type: ignore[arg-type]


def test_a_recording_is_a_scene(path: Path, trace: Trace) -> None:
    scene = load_recorded_scene(path)
    assert scene.name == trace.problem.name and scene.seed == 11
    problem = scene.problem(3)
    assert different_fields(problem, trace.problem) == () and problem is scene.problem()
    moved = replace(problem, points=problem.points + 1e-16 * np.abs(problem.points).max())
    assert different_fields(replace(problem, name="other", remarks=("x",)), problem) == ()
    assert different_fields(moved, problem) == ("points",)
    camera = replace(problem.camera, fx=problem.camera.fx + 1e-9)  # type: ignore[attr-defined]
    assert different_fields(replace(problem, camera=camera, bound_px=2.0), problem) == ("camera", "bound_px")
    with pytest.raises(RecordingError, match="no such file"):
        load_recorded_scene(path.with_name("none.rrd"))
    with pytest.raises(InputError, match="can be changed in synthetic scenes only"):
        Variation(noise_px=1.0).problem(scene)


def test_the_command_run_solves_recordings(path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    again = Records(tmp_path / "again")
    assert (
        run_scenes([path], "ransac-2p", None, ["iterations=40", "gravity_sd_deg=inf", "bound_px=3"], True, again) == 0
    )
    record = json.loads(capsys.readouterr().out)
    recorded = read_recording(path)
    assert record["cam_from_map"] == recorded.cam_from_map.tolist() and record["seed"] == 11
    kept = read_recording(Path(record["recording"]))
    assert kept.origin == Origin("command", str(MEI), 0) and kept.row.problem_key == recorded.row.problem_key
    hidden = Variation(hidden=(0, 1))
    assert run_scenes([path], "mc", 3, [], True, again, variation=hidden) == 0
    record = json.loads(capsys.readouterr().out)
    kept = read_recording(Path(record["recording"]))
    assert record["correspondences"] == 98 and kept.origin == Origin("command", str(path), 3, None, hidden)


def test_pasted_code_solves_the_recorded_problem(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    problem = replace(scene_problem("mei_outliers_80"), bound_px=2.5)
    options = options_type("mc")(bound_px=3.0, max_balls=300)
    trace = estimate(problem, "mc", options, 6)
    path = tmp_path / "a run.rrd"
    write_recording(trace, path)
    words = (path, 6, None, Variation(hidden=()), "mc", options)
    (tmp_path / "pasted.py").write_text(as_python(*words))
    capsys.readouterr()
    runpy.run_path("pasted.py")
    assert json.loads(capsys.readouterr().out.splitlines()[-1]) == np.array(trace.cam_from_map).tolist()
    command = shlex.split(as_command(*words))
    assert command[:3] == ["spherloc", "run", "a run.rrd"]
    settings = [command[k + 1] for k, word in enumerate(command) if word == "--option"]
    assert settings == ["bound_px=3.0", "max_balls=300"]
    defaults = as_command(path, 6, None, Variation(), "mc", options_type("mc")())
    assert defaults.endswith("--estimator mc --option bound_px=3.0")  # not that of the problem
