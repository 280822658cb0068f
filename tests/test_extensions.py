"""Packages of others that are broken in every way there is: each costs itself only, and is named in one sentence."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

SCENE = """
kind = "synthetic"
name = "tiny"
[camera]
model = "equirectangular"
width = 1024
height = 512
[simulation]
correspondences = 30
outlier_rate = 0.25
noise_px = 0.5
seed = 1
"""

ESTIMATORS = '''
"""Estimators that work, that fail, and that return what nobody knows."""
from dataclasses import dataclass
from typing import Any, ClassVar
import numpy as np
from spherloc.estimators.base import Outcome
from spherloc.refine import RefinementOptions
from spherloc.trace import RansacStage, Stage, YawStage


@dataclass(frozen=True)
class Options(RefinementOptions):
    bound_px: float = 3.0


@dataclass(frozen=True)
class Listed(Options):
    names: list[str] | None = None


@dataclass(frozen=True, eq=False)
class GuessStage(Stage):
    kind = "guess"
    tries: int
    table: np.ndarray


def outcome(aligned, *stages, mask=None):
    mask = np.ones(len(aligned.index), dtype=bool) if mask is None else mask
    return Outcome(stages, np.eye(3, 4), mask)


class Odd:
    """A stage that nothing draws, and one of spherloc's own whose numbers cannot be."""
    Options = Options

    @staticmethod
    def run(aligned, options, bounds, seed, clock):
        nothing = np.zeros((0, 2), dtype=np.int32)
        yaw = YawStage(1, "no rule", nothing, np.zeros(7), np.zeros(3), 5, (0.0, 1.0), 0.5, nothing)
        ransac = RansacStage(9, 0.5, np.array([1, 2]), np.full((2, 2), 10**6), np.zeros((2, 3, 4)),
                             np.zeros((2, 1), dtype=bool), np.zeros(2, dtype=bool))
        return outcome(aligned, GuessStage(3, np.zeros((2, 2))), yaw, ransac)


class Refusing:
    Options = Options

    @staticmethod
    def run(aligned, options, bounds, seed, clock):
        raise ValueError("at least\\nten thousand matches \\x1b[31m" + "!" * 1000)


class Wrong(Refusing):
    run = staticmethod(lambda aligned, *rest: outcome(aligned, mask=np.ones(3)))


class Formless(Odd):
    Options = Listed


class Bare:
    pass


class Broken(Refusing):
    class Options(Options):
        def __post_init__(self):
            raise RuntimeError("no licence")
'''

LOADERS = '''
"""Loads nothing."""
def load(table, path):
    return {}["scene"]


class Lens:
    @classmethod
    def from_dict(cls, table, where):
        raise ZeroDivisionError("focal length")
'''

ENTRY_POINTS = """
[spherloc.estimators]
odd = odd_pack:Odd
refusing = odd_pack:Refusing
wrong = odd_pack:Wrong
formless = odd_pack:Formless
bare = odd_pack:Bare
broken = odd_pack:Broken
absent = odd_pack:Absent
gone = gone_pack:Gone
quitting = quitting_pack:Any
mc = odd_pack:Odd

[spherloc.datasets]
crashing = odd_loaders:load
gone = gone_pack:load

[spherloc.cameras]
lens = odd_loaders:Lens
"""
REFUSED = {"wrong", "formless", "bare", "broken", "absent", "gone", "quitting", "refusing"}

SCRIPT = """
import json, sys
from pathlib import Path
from spherloc import registry
from spherloc.cameras.calibration import camera_from_table
from spherloc.datasets import load_scene
from spherloc.diagnosis import diagnose
from spherloc.errors import CalibrationError
from spherloc.estimators import estimate, options_type
from spherloc_viz.app.server import _prepare
from spherloc_viz.layers import paint, steps
from spherloc_viz.options import option_fields, usable_estimators
from spherloc_viz.recording.content.reader import read_recording
from spherloc_viz.recording.content.writer import write_recording

_prepare()
trace = estimate(load_scene(Path("tiny.toml")).problem(), "odd")
captions = {stop.key: paint(trace, place).step.caption for place, stop in enumerate(steps(trace))}
write_recording(trace, Path("odd.rrd"), None, diagnose(trace))
try:
    camera_from_table({"model": "lens"}, "camera.toml")
except CalibrationError as error:
    lens = str(error)
print(json.dumps({
    "usable": usable_estimators(),
    "fields": [field.name for name in usable_estimators() for field in option_fields(options_type(name))],
    "captions": captions,
    "recorded": read_recording(Path("odd.rrd")).estimator,
    "lens": lens,
    "mc": options_type("mc").__module__,
}))
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a scene, and with what pip would have installed."""
    folder = tmp_path_factory.mktemp("extensions")
    (folder / "tiny.toml").write_text(SCENE)
    (folder / "crashing.toml").write_text('kind = "crashing"\n')
    (folder / "gone.toml").write_text('kind = "gone"\n')
    (folder / "odd_pack.py").write_text(ESTIMATORS)
    (folder / "odd_loaders.py").write_text(LOADERS)
    (folder / "quitting_pack.py").write_text("raise SystemExit(7)\n")
    information = folder / "odd_pack-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: odd-pack\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text(ENTRY_POINTS)
    return folder


def process(place: Path, *words: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": str(place)}
    done = subprocess.run(
        [sys.executable, "-c", *words], cwd=place, env=environment, capture_output=True, text=True, timeout=280
    )
    assert "Traceback" not in done.stderr, done.stderr
    return done


def spherloc(place: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return process(place, "from spherloc_viz.start import main\nmain()", *words)


def test_kinds_that_cannot_be_imported_are_a_line(place: Path) -> None:
    done = spherloc(place, "scenes")
    assert done.returncode == 0 and done.stderr == ""
    lines = {line.split()[0]: line for line in done.stdout.splitlines() if line.strip()}
    assert "of the extension odd-pack cannot be imported (ModuleNotFoundError" in lines["gone"]
    assert "Loads nothing." in lines["crashing"] and "kitti360" in lines


def test_scenes_and_estimators_of_others_hinder_nothing(place: Path) -> None:
    """Each was a traceback, before anything was solved. An estimator is announced only where it is to be used."""
    done = spherloc(place, "run", "crashing.toml", "gone.toml", "tiny.toml", "--estimator", "odd", "--json")
    assert done.returncode == 2
    crashing, gone = done.stderr.splitlines()
    assert "crashing.toml: the dataset 'crashing' of the extension odd-pack failed (KeyError: 'scene')" in crashing
    assert "the dataset 'gone' of the extension odd-pack cannot be imported" in gone
    assert all(len(line) < 400 and line.isprintable() for line in (crashing, gone))
    record = json.loads(done.stdout)
    assert record["estimator"] == "odd" and Path(place / record["recording"]).is_file()
    done = spherloc(place, "run", "tiny.toml", "--estimator", "quitting", "--no-record")
    assert done.returncode == 2 and done.stdout == "" and done.stderr.count("\n") == 1
    assert "of the extension odd-pack cannot be imported (SystemExit: 7)" in done.stderr


def test_the_page_the_painter_and_the_recorder_go_on(place: Path) -> None:
    """A stage of another kind was a KeyError in all of them; a page that does not start has nobody to tell."""
    done = process(place, SCRIPT)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert not set(told["usable"]) & (REFUSED - {"wrong", "refusing"}) and {"odd", "mc"} <= set(told["usable"])
    assert "The stage guess has no drawing here." in told["captions"]["stage-guess"]
    assert "odd of odd-pack" in told["captions"]["stage-guess"] and "outcome" in told["captions"]
    assert any("cannot be drawn (" in caption for caption in told["captions"].values())
    assert told["recorded"] == "odd"
    assert "of the extension odd-pack failed (ZeroDivisionError: focal length)" in told["lens"]
    assert told["mc"] == "spherloc.estimators.mc", "an extension cannot take the place of spherloc's own"
    for name in REFUSED:
        assert sum(f"estimator '{name}'" in line for line in done.stderr.splitlines()) == 1, f"{name}\n{done.stderr}"
    assert all(len(line) < 400 and line.isprintable() for line in done.stderr.splitlines())
