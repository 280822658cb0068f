"""The packages of docs/extending.md are built as wheels, installed, and do what the page says."""

import json
import re
import shlex
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rerun.chunk import RrdReader

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.datasets import bundled_scenes, load_scene
from spherloc.worlds import build_world
from spherloc.worlds.render import draw
from tests.installed import SEVERAL, python
from tests.waiting import LIMIT_S

PAGE = Path(__file__).resolve().parents[1] / "docs" / "extending.md"
FILE = re.compile(r"^`([\w./-]+)`\n\n```\w+\n(.*?)^```$", re.MULTILINE | re.DOTALL)
COMMANDS = re.compile(r"^```sh\n(.*?)^```$", re.MULTILINE | re.DOTALL)
PACKAGES = {
    "stereographic-lens",
    "acme-calibration",
    "dlt-solver",
    "guess-estimator",
    "npz-scenes",
    "frame-scenes",
    "guess-layer",
}
BUILD = """
import os, sys
from setuptools import build_meta
for project in sys.argv[1:]:
    os.chdir(project)
    build_meta.build_wheel("..")
    os.chdir("..")
"""
CHECKS = """
from pathlib import Path
import stereographic_lens
from spherloc.testing import check_calibration_reader, check_camera, check_dataset, check_estimator, check_solver

check_camera(stereographic_lens.Stereographic(1200, 1200, 300.0, 600.0, 600.0))
check_calibration_reader("acme", "lens.ini")
check_solver("dlt")
check_estimator("ransac-dlt")
check_estimator("guess")
check_dataset("matches.toml")
check_dataset("stereographic.toml")
check_dataset("frames.toml")
"""
PAINT = """
import json
from spherloc.datasets import bundled_scenes, load_scene
from spherloc.estimators import estimate
from spherloc_viz import style
from spherloc_viz.layers import paint, steps
from spherloc_viz.layers.key_step import match_colors
trace = estimate(load_scene(bundled_scenes()["mei_outliers_80"]).problem(), "guess")
headings = steps(trace)
(place,) = [number for number, heading in enumerate(headings) if heading.key == "guess-best"]
picture = paint(trace, place)
pink = int((match_colors(picture) == style.SAMPLE).all(axis=1).sum())
print(json.dumps([headings[place].stage, picture.step.caption, [chart.name for chart in picture.charts], pink]))
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the files of the page, where its packages are installed from wheels."""
    folder = tmp_path_factory.mktemp("extending")
    files = dict(FILE.findall(PAGE.read_text()))
    for name, text in files.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)
    projects = {name.partition("/")[0] for name in files if name.endswith("pyproject.toml")}
    assert projects == PACKAGES
    subprocess.run(
        [sys.executable, "-c", BUILD, *projects], cwd=folder, check=True, capture_output=True, timeout=LIMIT_S
    )
    for wheel in folder.glob("*.whl"):
        with zipfile.ZipFile(wheel) as packed:
            packed.extractall(folder)
    problem = load_scene(bundled_scenes()["panorama_outliers_80"]).problem()
    names = ("pixels", "points", "gravity_camera", "gravity_map")
    np.savez(folder / "matches.npz", **{name: getattr(problem, name) for name in names})
    write_frames(folder)
    return folder


def write_frames(folder: Path) -> None:
    """The images, depth maps and poses of ``frames.toml``: three references and a query in a drawn street."""
    world, camera = build_world("street"), Equirectangular(512, 256)
    frames = []
    for number, cam_from_map in enumerate(world.route(4, start=0.4, stop=0.5)):
        drawn, name = draw(world, camera, cam_from_map), f"frame_{number}"
        (folder / f"{name}.png").write_bytes(cv2.imencode(".png", drawn.image)[1].tobytes())
        frame = {"image": f"{name}.png", "cam_from_map": cam_from_map.tolist()}
        if number != 2:
            np.save(folder / f"{name}.npy", drawn.range_m)
            frame["depth"] = f"{name}.npy"
        frames.append(frame)
    (folder / "frames.json").write_text(json.dumps(frames))


def commands(page: str) -> list[list[str]]:
    """All commands of the page."""
    lines = [line for block in COMMANDS.findall(page) for line in block.splitlines()]
    words = [shlex.split(line) for line in lines]
    assert all(line[0] == "spherloc" for line in words)
    return [line[1:] for line in words]


@pytest.fixture(scope="module")
def told(place: Path) -> tuple[list[Any], list[Any]]:
    """What the script printed of the layer, and of each command its words, exit code, output and errors."""
    asked = commands(PAGE.read_text())
    done = python(place, CHECKS + PAINT + SEVERAL, json.dumps(asked))
    assert done.returncode == 0, done.stderr
    painted, found = map(json.loads, done.stdout.splitlines())
    return painted, [(words, *rest) for words, rest in zip(asked, found, strict=True)]


def test_the_packages_keep_the_contracts_and_the_layer_draws(told: tuple[list[Any], list[Any]]) -> None:
    """What the layer gives is what the page's painter gets."""
    stage, caption, charts, pink = told[0]
    assert stage == "Guesses" and re.match(r"Of 300 guesses the one by the matches \d+ and \d+ explains most", caption)
    assert charts == ["guess"] and pink == 2


def test_the_commands_of_the_page_work(place: Path, told: tuple[list[Any], list[Any]]) -> None:
    """The last recording is one with the layer, the last command the list of what is installed."""
    assert {words[0] for words, *_ in told[1]} == {"run", "scenes", "localize", "plugins"}
    recordings = []
    for words, code, output, errors in told[1]:
        assert code == 0, (words, errors)
        if words[0] == "run":
            assert "matches are inliers" in output and "doubtful" not in output
            recordings += re.findall(r"recorded: (.*)", output)
        elif words == ["scenes", "npz"]:
            assert "Matches in a file of numpy" in output and 'matches = "matches.npz"' in output
        elif words == ["scenes", "frames"]:
            assert "Frames in a JSON file" in output and 'frames = "frames.json"' in output
        elif words[0] == "localize":
            assert "1 of 1 queries are localized" in output and "success within 1 deg, 0.1 m: 100.0 %" in output
    listed = told[1][-1][2]
    assert listed.count(": usable; ") == len(PACKAGES) and "cannot be used" not in listed
    assert "guess: usable; guess-layer 1.0, guess_layer:GUESSES" in listed
    assert drawn(place / recordings[-1]) and not drawn(place / recordings[0])


def drawn(recording: Path) -> bool:
    """Whether a recording has the chart and the step of the layer."""
    chunks = RrdReader(recording).stream().to_chunks()
    entities = {chunk.entity_path for chunk in chunks}
    titles = str([chunk.to_record_batch().to_pydict() for chunk in chunks if chunk.entity_path == "/step"])
    return any(entity.startswith("/charts/guess/") for entity in entities) and "explains most" in titles
