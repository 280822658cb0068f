"""What is copied from the page gives the very same pose, to the last bit."""

import json
import math
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from cli_process import spherloc_here

from spherloc.datasets import load_scene
from spherloc.datasets.variation import Variation
from spherloc.estimators import default_options, estimate, options_type
from spherloc_viz.commands.run import run_scenes
from spherloc_viz.share import as_command, as_python
from tests.datasets.test_rendered import SMALL
from tests.waiting import LIMIT_S

ROOT = Path(__file__).resolve().parents[1]
MEI = ROOT / "scenes" / "mei_outliers_80.toml"
PANORAMA = ROOT / "scenes" / "panorama_outliers_80.toml"

MANY = Variation(
    camera=str(ROOT / "scenes" / "fisheye_outliers_90.toml"),
    correspondences=73,
    noise_px=0.1 + 0.2,
    outlier_rate=1.0 / 3.0,
    outlier_kind="coherent",
    field_of_view_deg=160.0 / 1.1,
    cloud_height_m=5.5,
    gravity_error_deg=0.7,
    true_camera=(-30.1, 1.0 / 3.0, -0.25, 1e-3),
    spoiled=(3, 5),
    mended=(7,),
    hidden=(1, 2),
)


def pasted(script: str, command: str, cwd: Path) -> tuple[Any, Any]:
    """The poses that the script and, in a shell, the command find in a folder."""
    names: dict[str, Any] = {}
    exec(script.replace("print", "str"), names)
    program = shlex.quote(str(Path(sys.executable).with_name("spherloc")))
    shell = f"{program} {command.removeprefix('spherloc ')} --json --no-record"
    done = subprocess.run(["sh", "-c", shell], cwd=cwd, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    assert done.returncode == 0, done.stderr
    return names["trace"].cam_from_map.tolist(), json.loads(done.stdout)["cam_from_map"]


def test_many_changes_of_a_simulation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    options = options_type("mc-exact")(bound_px=2.7, gravity_sd_deg=math.inf, time_budget_s=7.25, robust="huber")
    request = (MEI, 7, None, MANY, "mc-exact", options)
    expected = estimate(MANY.problem(load_scene(MEI), 7), "mc-exact", options, 7)
    assert expected.cam_from_map is not None
    (tmp_path / "pasted.py").write_text(as_python(*request))
    words = [sys.executable, "pasted.py"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1]) == expected.cam_from_map.tolist()
    words = shlex.split(as_command(*request).removeprefix("spherloc "))
    result = spherloc_here(*words, "--json", "--no-record", cwd=tmp_path)
    assert json.loads(result.stdout)["cam_from_map"] == expected.cam_from_map.tolist(), result.stderr


def test_a_query_image(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a scene in the folder, whose name needs quotes."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / 'it\'s a "small" street.toml'
    path.write_text(SMALL)
    variation = Variation(spoiled=(4,), hidden=(0,))
    options = options_type("ransac-2p")(confidence=0.99, local_optimization=True, scoring="msac")
    expected = estimate(variation.problem(load_scene(path), 3, "query_001"), "ransac-2p", options, 3)
    assert expected.cam_from_map is not None
    request = (path, 3, "query_001", variation, "ransac-2p", options)
    script, command = as_python(*request), as_command(*request)
    assert str(tmp_path) not in script + command
    assert pasted(script, command, tmp_path) == (expected.cam_from_map.tolist(), expected.cam_from_map.tolist())


@pytest.mark.parametrize("bound_px", [3.0, 4.5, 8.0])
@pytest.mark.parametrize("stated", [None, 4.5])
def test_a_pixel_bound_that_the_scene_states(tmp_path: Path, stated: float | None, bound_px: float) -> None:
    """Neither of the two may take the scene's bound where the page took another."""
    path = tmp_path / "scene.toml"
    path.write_text(PANORAMA.read_text() + (f"[options]\nbound_px = {stated}\n" if stated else ""))
    scene = load_scene(path)
    options = options_type("mc")(bound_px=bound_px)
    script = as_python(path, 0, None, Variation(), "mc", options)
    names: dict[str, Any] = {}
    exec(script.replace("print", "str"), names)
    assert names["trace"].options == options
    words = shlex.split(as_command(path, 0, None, Variation(), "mc", options))
    given = [word for word in words if word.startswith("bound_px=")]
    used = default_options("mc", scene.problem())
    assert replace(used, bound_px=float(given[0].removeprefix("bound_px="))) == options if given else used == options


def test_only_what_differs_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    plain = (PANORAMA, 5, None, Variation(), "mc", options_type("mc")())
    assert as_command(*plain) == "spherloc run scenes/panorama_outliers_80.toml --seed 5 --estimator mc"
    script = as_python(*plain)
    assert "Variation" not in script and "options" not in script
    assert (
        'spherloc.load_scene("scenes/panorama_outliers_80.toml")' in script
        and 'spherloc.estimate(problem, "mc", seed=5)' in script
    )
    changed = (PANORAMA, 5, None, Variation(outlier_rate=0.9), "ransac-2p", options_type("ransac-2p")(iterations=50))
    assert as_command(*changed).endswith("--set outlier_rate=0.9 --seed 5 --estimator ransac-2p --option iterations=50")
    assert "Variation(outlier_rate=0.9).problem(scene, 5)" in as_python(*changed)
    assert 'estimate(problem, "ransac-2p", {"iterations": 50}, seed=5)' in as_python(*changed)


@pytest.mark.parametrize("folder", [ROOT, ROOT / "scenes", ROOT / "docs"])
def test_a_path_is_written_from_the_current_folder_if_it_is_inside(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    variation = Variation(camera=str(MEI))
    words = shlex.split(as_command(PANORAMA, 0, None, variation, "mc", options_type("mc")()))
    inside = folder != ROOT / "docs"
    assert Path(words[2]).is_absolute() != inside and Path(words[2]).resolve() == PANORAMA
    camera = words[words.index("--set") + 1].removeprefix("camera=")
    assert Path(camera).is_absolute() != inside and Path(camera).resolve() == MEI


def test_names_that_look_like_flags_or_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "-x; rm $HOME.toml"
    for query in ("--seed", "a b'c\"d\\e\n", "$(id)"):
        request = (path, 0, query, Variation(), "mc", options_type("mc")())
        words = shlex.split(as_command(*request))
        assert words[2] == f"./{path.name}" and (
            f"--query={query}" in words or words[words.index("--query") + 1] == query
        )
        compile(as_python(*request), "pasted.py", "exec")
        assert repr(query) in as_python(*request) or f'"{query}"' in as_python(*request)


def test_every_scene_is_changed_and_a_wrong_one_is_a_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    street = ROOT / "scenes" / "street_fisheye.toml"
    changes = Variation(outlier_rate=0.5, correspondences=40, hidden=(0, 1))
    assert run_scenes([MEI, street, PANORAMA], "ransac-2p", None, [], True, None, variation=changes) == 2
    printed = capsys.readouterr()
    records = [json.loads(line) for line in printed.out.splitlines()]
    assert [record["correspondences"] for record in records] == [38, 38] and all(r["success"] for r in records)
    lines = [line for line in printed.err.splitlines() if "only" in line]
    assert len(lines) == 1 and "street_fisheye.toml: " in lines[0]
    assert "correspondences can be changed in synthetic scenes only" in lines[0]


def test_settings_after_one_flag_or_after_several(tmp_path: Path) -> None:
    words = ["--set", "outlier_rate=0.5", "correspondences=40", "--set", "noise_px=0.25", "--hide", "0,1"]
    options = ["--option", "bound_px=2", "--option", "max_balls=30", "robust=huber"]
    result = spherloc_here("run", PANORAMA, *words, *options, "--json", "--no-record", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    record = json.loads(result.stdout)
    assert record["correspondences"] == 38 and record["rotation_error_deg"] < 0.2
    assert [record["options"][name] for name in ("bound_px", "max_balls", "robust")] == [2.0, 30, "huber"]


def test_a_mistyped_setting_is_one_line(tmp_path: Path) -> None:
    result = spherloc_here("run", PANORAMA, "--set", "noise_px=1", "loud=1", cwd=tmp_path)
    assert result.returncode == 2 and result.stdout == "" and len(result.stderr.splitlines()) == 1
    assert "setting 'loud=1' is unknown; give KEY=VALUE with camera, correspondences, noise_px" in result.stderr


@pytest.mark.parametrize(
    ("variation", "query", "sentence"),
    [
        (Variation(hidden=(100,)), None, "there is no match 100: the problem has 100"),
        (Variation(outlier_rate=7.0), None, "outlier_rate is 7.0; give a number from 0 to 1"),
        (Variation(camera="gone.toml"), None, "gone.toml: "),
        (Variation(), "a.png", "no query images"),
    ],
)
def test_what_cannot_be_is_one_line(
    capsys: pytest.CaptureFixture[str], variation: Variation, query: str | None, sentence: str
) -> None:
    assert run_scenes([PANORAMA], "mc", None, [], True, None, query=query, variation=variation) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("spherloc: ")]
    assert len(lines) == 1 and sentence in lines[0] and str(PANORAMA) in lines[0]
