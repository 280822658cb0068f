"""Packages of others that are broken in every way there is: each costs itself only, and is named in one sentence."""

import json
import subprocess
from pathlib import Path

import pytest

from spherloc.registry import KINDS, RANSAC
from spherloc.warm_up import warm_up
from tests.installed import install, python, spherloc_each
from tests.tiny_scene import write_tiny_scene

ESTIMATORS = '''
"""Estimators that work, that fail, and that return what nobody knows; and layers that do so."""
from dataclasses import dataclass, field
import numpy as np
from spherloc.estimators.base import Estimate
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
    things: object = frozenset({1})
    texts: object = field(default_factory=lambda: np.array([{}], dtype=object))


def stage_of(name):
    return dataclass(frozen=True, eq=False)(type(name.title(), (Stage,), {"kind": name, "__annotations__": {}}))


DRAWN = {name: stage_of(name) for name in (
    "good", "crash", "late", "keys", "colors", "item", "chart", "listed", "number", "other", "gone-layer")}


def outcome(aligned, *stages, mask=None):
    mask = np.ones(len(aligned.index), dtype=bool) if mask is None else mask
    return Estimate(stages, np.eye(3, 4), mask)


class Odd:
    """A stage that nothing draws, one of spherloc's own whose numbers cannot be, and those of broken layers."""
    Options = Options

    @staticmethod
    def run(aligned, options, bounds, seed, clock):
        nothing = np.zeros((0, 2), dtype=np.int32)
        yaw = YawStage(1, "no rule", nothing, np.zeros(7), np.zeros(3), 5, (0.0, 1.0), 0.5, nothing)
        ransac = RansacStage(9, 0.5, np.array([1, 2]), np.full((2, 2), 10**6), np.zeros((2, 3, 4)),
                             np.zeros((2, 1), dtype=bool), np.zeros(2, dtype=bool))
        drawn = [kind() for kind in DRAWN.values()]
        return outcome(aligned, GuessStage(3, np.zeros((2, 2))), yaw, ransac, *drawn)


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


class Shapeless:
    name, sample_size, pinhole = "flat", 3, False
    solve = staticmethod(lambda bearings, points: np.eye(3, 4))


class Crashing(Shapeless):
    def solve(self, bearings, points):
        return {}["pose"]


class Sizeless(Shapeless):
    sample_size = "three"
'''

LAYERS = '''
"""Layers that work, and that do not."""
import numpy as np
from odd_pack import DRAWN
from spherloc_viz import style
from spherloc_viz.layers.extension import Layer
from spherloc_viz.layers.frame import Frame, Plan
from spherloc_viz.layers.primitives import Chart, Curve, Points


def frame(view, **changes):
    told = {"caption": "Drawn by the layer.", "equation": "", "cam_from_map": view.standing(np.eye(3)),
            "colors": view.colors(style.UNDECIDED), "rays": view.no_matches()}
    return Frame(**told | changes)


def layer(name, draw, key="", chart=None, kind=None):
    charts = {} if chart is None else {"odd": chart}
    plan = lambda view: Plan(f"{key or name}-1", name, lambda: draw(view), charts)
    return Layer(kind or DRAWN[name], name, lambda view, stage: [plan(view)])


def plans(view, stage):
    return {}["plans"]


GOOD = layer("good", frame)
CRASH = Layer(DRAWN["crash"], "Crash", plans)
LATE = layer("late", lambda view: view.no_such_thing)
KEYS = layer("keys", frame, key="outcome")
COLORS = layer("colors", lambda view: frame(view, colors=np.zeros((3, 3))))
FLAT = Points("odd", "map", np.zeros((3, 2)), np.zeros((3, 3), np.uint8), 1.0)
ITEM = layer("item", lambda view: frame(view, items=(FLAT,)))
CHART = layer("chart", frame, chart=lambda: Chart("odd", "", "", "", (Curve("", np.zeros(3), np.zeros(2), (0, 0, 0)),)))
LISTED = Layer(DRAWN["listed"], "Listed", lambda view, stage: [1, 2])
NUMBER = 3
OTHER = layer("other", frame, kind=type("Other", (DRAWN["other"],), {}))
'''

LOADERS = '''
"""Loads nothing."""
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.errors import CalibrationError

NUMBER = 3


def load(table, path):
    return {}["scene"]


class Late:
    name = "late"

    def problem(self, seed=None):
        return {}["problem"]


class Empty(Late):
    def problem(self, seed=None):
        return None


load_late = lambda table, path: Late()
load_empty = lambda table, path: Empty()
load_nothing = lambda table, path: None


class Lens:
    model = "lens"
    width = height = 10

    @classmethod
    def from_dict(cls, table, where):
        raise ZeroDivisionError("focal length")

    def project(self, points):
        return {}["pixels"]

    unproject = unprojection_jacobian = project

    def to_dict(self):
        return {"model": self.model}


class Crooked(Lens):
    model = "crooked"
    from_dict = classmethod(lambda cls, table, where: cls())


class Misnamed(Lens):
    pass


def read_crashing(path, name):
    raise KeyError("lens")


def read_refusing(path, name):
    if b"refuse" in path.read_bytes():
        raise CalibrationError("line 1 is upside down: turn it.")


def read_text(path, name):
    return path.read_text() if b"refuse" in path.read_bytes() else None


def read_zebra(path, name):
    return Equirectangular(1024, 512) if path.read_bytes().startswith(b"zebra") else None
'''

POINTS = {
    "spherloc.estimators": {
        "odd": "odd_pack:Odd",
        "refusing": "odd_pack:Refusing",
        "wrong": "odd_pack:Wrong",
        "formless": "odd_pack:Formless",
        "bare": "odd_pack:Bare",
        "broken": "odd_pack:Broken",
        "absent": "odd_pack:Absent",
        "gone": "gone_pack:Gone",
        "quitting": "quitting_pack:Any",
        "mc": "odd_pack:Odd",
    },
    "spherloc.solvers": {
        "shapeless": "odd_pack:Shapeless",
        "crashing": "odd_pack:Crashing",
        "sizeless": "odd_pack:Sizeless",
        "number": "odd_loaders:NUMBER",
        "gone": "gone_pack:Gone",
        "2p": "odd_pack:Shapeless",
    },
    "spherloc.datasets": {
        "crashing": "odd_loaders:load",
        "gone": "gone_pack:load",
        "late": "odd_loaders:load_late",
        "empty": "odd_loaders:load_empty",
        "nothing": "odd_loaders:load_nothing",
        "number": "odd_loaders:NUMBER",
    },
    "spherloc.cameras": {
        "lens": "odd_loaders:Lens",
        "crooked": "odd_loaders:Crooked",
        "misnamed": "odd_loaders:Misnamed",
        "number": "odd_loaders:NUMBER",
    },
    "spherloc.calibrations": {
        "crashing": "odd_loaders:read_crashing",
        "gone": "gone_pack:read",
        "number": "odd_loaders:NUMBER",
        "refusing": "odd_loaders:read_refusing",
        "text": "odd_loaders:read_text",
        "zebra": "odd_loaders:read_zebra",
    },
    "spherloc.layers": {
        "good": "odd_layers:GOOD",
        "crash": "odd_layers:CRASH",
        "late": "odd_layers:LATE",
        "keys": "odd_layers:KEYS",
        "colors": "odd_layers:COLORS",
        "item": "odd_layers:ITEM",
        "chart": "odd_layers:CHART",
        "listed": "odd_layers:LISTED",
        "number": "odd_layers:NUMBER",
        "other": "odd_layers:OTHER",
        "gone-layer": "gone_pack:LAYER",
        "yaw": "odd_layers:GOOD",
    },
}
UNUSABLE = {
    "estimators": {"wrong", "formless", "bare", "broken", "absent", "gone", "quitting", "refusing", "mc", "odd"},
    "solvers": {"shapeless", "crashing", "sizeless", "number", "gone", "2p"},
    "datasets": {"gone", "number"},
    "cameras": {"misnamed", "number"},
    "calibrations": {"gone", "number"},
    "layers": {"number", "gone-layer", "yaw"},
}
"""By kind what ``spherloc plugins`` finds; "odd" is twice there, in two packages. What fails only where it is used is
found there."""

ODD = "of the extension odd-pack"

PAGE = """
import json, sys, threading
from pathlib import Path
from spherloc.cameras.calibration import camera_from_table
from spherloc.datasets import load_scene
from spherloc.diagnosis import diagnose
from spherloc.errors import CalibrationError, InputError
from spherloc.estimators import estimate, options_type
from spherloc_viz.app.panels.compare_panel import ComparePanel
from spherloc_viz.app.compilation import first_and_later
from spherloc_viz.app.server import _prepare
from spherloc_viz.app.web.touch import Touches
from spherloc_viz.app.web.viser_internals import start_viser, stop_viser
from spherloc_viz.layers import paint, steps
from spherloc_viz.options import option_fields, usable_estimators
from spherloc_viz.recording.content.data import read_recording
from spherloc_viz.recording.content.writer import write_recording

_prepare(first_and_later()[0])
problem = load_scene(Path("tiny.toml")).problem()
trace = estimate(problem, "odd")
pictures = [paint(trace, place) for place, stop in enumerate(steps(trace))]
write_recording(trace, Path("odd.rrd"), None, diagnose(trace), full=True)
cameras = {}
for model in ("lens", "crooked", "misnamed", "number"):
    try:
        camera_from_table({"model": model}, "camera.toml")
    except CalibrationError as error:
        cameras[model] = str(error)

server = start_viser("a key of this test")
panel = ComparePanel(server.gui, Touches(print), print, lambda event: None)
panel.draw(estimate(problem, "mc"))
panel._ticked = {"refusing", "mc", "ransac-2p", "ransac-shapeless"}
try:
    panel._compare(threading.Event())
except InputError as error:
    compared = str(error)
table = panel._table.content
panel.close()
stop_viser(server)
print(json.dumps({
    "usable": usable_estimators(),
    "fields": [field.name for name in usable_estimators() for field in option_fields(options_type(name))],
    "captions": {picture.step.key: picture.step.caption for picture in pictures},
    "stages": {picture.step.key: picture.step.stage for picture in pictures},
    "charts": [chart.name for chart in pictures[-1].charts],
    "recorded": read_recording(Path("odd.rrd")).estimator,
    "cameras": cameras,
    "mc": options_type("mc").__module__,
    "compared": compared,
    "table": [name for name in ("mc", "ransac-2p", "refusing") if f"use:{name}" in table],
}))
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with scenes, and with what pip would have installed: a package, and another with one of its names."""
    folder = tmp_path_factory.mktemp("extensions")
    write_tiny_scene(folder)
    for kind in POINTS["spherloc.datasets"]:
        (folder / f"{kind}.toml").write_text(f'kind = "{kind}"\n')
    (folder / "refuse.cal").write_text("# refuse\n\x00")
    (folder / "zebra.cal").write_text("zebra\n")
    modules = {"odd_pack.py": ESTIMATORS, "odd_layers.py": LAYERS, "odd_loaders.py": LOADERS}
    install(folder, "odd-pack", POINTS, modules | {"quitting_pack.py": "raise SystemExit(7)\n"})
    install(folder, "twin-pack", {"spherloc.estimators": {"odd": "odd_pack:Bare"}}, {})
    return folder


@pytest.fixture(scope="module")
def done(place: Path) -> list[subprocess.CompletedProcess[str]]:
    """All commands, in one process."""
    warm_up()  # they tell of compiling
    run = ["run", "tiny.toml", "--no-record", "--estimator"]
    wanted = [
        ["scenes"],
        ["run", *(f"{kind}.toml" for kind in POINTS["spherloc.datasets"]), "tiny.toml", "--estimator", "odd", "--json"],
        [*run, "quitting"],
        [*run, "ransac-shapeless"],
        [*run, "ransac-sizeless"],
        [*run, "mc", "--set", "camera=refuse.cal"],
        [*run, "mc", "--set", "camera=zebra.cal"],
        ["sweep", "tiny.toml", *["--values", "0.2", "--runs", "2", "--workers", "1", "--no-record", "--out", "a.csv"]],
    ]
    wanted[-1] += ["--estimator", "mc", "--estimator", "refusing"]
    wanted += [["plugins", "--json"], ["plugins"]]
    return spherloc_each(place, wanted)


def test_commands_go_on(place: Path, done: list[subprocess.CompletedProcess[str]]) -> None:
    """Each was a traceback, or the end of all, before anything was solved."""
    scenes, several, quitting, shapeless, sizeless, refuse, zebra, sweep = done[:-2]

    assert scenes.returncode == 0 and scenes.stderr == ""
    lines = {line.split()[0]: line for line in scenes.stdout.splitlines() if line.strip()}
    assert "of the extension odd-pack cannot be imported (ModuleNotFoundError" in lines["gone"]
    assert "'number' of the extension odd-pack is 3, not a function" in lines["number"]
    assert "Loads nothing." in lines["crashing"] and "kitti360" in lines

    assert several.returncode == 2
    told = several.stderr.splitlines()
    told = [line for line in told if ".toml: " in line or "late" in line or "empty" in line]
    for line, words in zip(
        told,
        (
            "crashing.toml: the dataset 'crashing' of the extension odd-pack failed (KeyError: 'scene')",
            "gone.toml: the dataset 'gone' of the extension odd-pack cannot be imported",
            "the dataset 'late' of the extension odd-pack failed (KeyError: 'problem')",
            "the dataset 'empty' of the extension odd-pack gave None, which is not a Problem",
            "nothing.toml: the dataset 'nothing' of the extension odd-pack gave None, which has no name",
            "number.toml: the dataset 'number' of the extension odd-pack is 3, not a function",
        ),
        strict=True,
    ):
        assert words in line and len(line) < 400 and line.isprintable()
    record = json.loads(several.stdout)
    assert record["estimator"] == "odd" and Path(place / record["recording"]).is_file()

    for ended, words in (
        (quitting, f"the estimator 'quitting' {ODD} cannot be imported (SystemExit: 7)"),
        (
            shapeless,
            "the solver 'shapeless' of the extension odd-pack returned an array of shape (3, 4), not (S, 3, 4)",
        ),
        (sizeless, f"the solver 'sizeless' {ODD} has no usable sample_size"),
        (refuse, f"the calibration reader 'crashing' {ODD} failed (KeyError: 'lens')"),
        (
            refuse,
            "the calibration reader 'refusing' of the extension odd-pack refuses it (line 1 is upside down: turn it)",
        ),
        (refuse, f"the calibration reader 'text' {ODD} gave '# refuse\\n\\x00', which is not a camera"),
        (refuse, f"the calibration reader 'gone' {ODD} cannot be imported"),
    ):
        assert ended.returncode == 2 and ended.stdout == "" and words in ended.stderr, ended
        assert all(line.isprintable() for line in ended.stderr.splitlines())
    assert refuse.stderr.count("\n") == 1 and quitting.stderr.count("\n") == 1
    assert zebra.returncode == 0 and "success" in zebra.stdout and zebra.stderr == ""

    assert sweep.returncode == 0, sweep.stderr
    rows = (place / "a.csv").read_text().splitlines()[1:]
    assert sorted((row.split(",")[0], row.split(",")[3]) for row in rows) == [
        *[("mc", "true")] * 2,
        *[("refusing", "false")] * 2,
    ]
    assert sweep.stderr.count("Such runs count as failures.") == 1
    assert "refusing at outlier rate 0.2, seed " in sweep.stderr


def test_the_list_says_what_cannot_be_used(done: list[subprocess.CompletedProcess[str]]) -> None:
    as_json, as_text = done[-2:]
    assert as_json.returncode == as_text.returncode == 1 and as_json.stderr == as_text.stderr == ""
    found = [json.loads(line) for line in as_json.stdout.splitlines()]
    assert len(found) == sum(map(len, POINTS.values())) + 1
    for group, points in POINTS.items():
        kind = group.removeprefix("spherloc.")
        of_kind = [entry for entry in found if entry["kind"] == kind]
        assert {entry["name"]: entry["target"] for entry in of_kind if entry["package"] == "odd-pack"} == points
        assert {entry["name"] for entry in of_kind if entry["problem"]} == UNUSABLE[kind]
    problems = {(entry["package"], entry["kind"], entry["name"]): entry["problem"] for entry in found}
    assert all(len(problem) < 400 and problem.isprintable() for problem in problems.values())
    assert all(name in problem for (_, _, name), problem in problems.items() if problem)
    assert {entry["version"] for entry in found} == {"1.0"}
    for key, words in {
        ("odd-pack", "estimators", "mc"): f"'mc' {ODD} is not used, since spherloc has one of that name; rename it.",
        ("odd-pack", "estimators", "odd"): "",
        ("odd-pack", "solvers", "2p"): f"'2p' {ODD} is not used, since spherloc has an estimator 'ransac-2p'",
        ("odd-pack", "layers", "yaw"): f"the layer 'yaw' {ODD} is not used, since spherloc has one of that name",
        ("odd-pack", "cameras", "misnamed"): f"the camera 'misnamed' {ODD} calls its model 'lens'",
        ("odd-pack", "solvers", "crashing"): "failed (KeyError: 'pose')",
        ("odd-pack", "layers", "number"): f"the layer 'number' {ODD} is 3, no Layer",
        ("twin-pack", "estimators", "odd"): "not used, since the extension odd-pack has one of that name; rename it.",
    }.items():
        assert words in problems[key] and bool(words) == bool(problems[key])
    assert as_text.stdout.count(": cannot be used; ") == sum(bool(problem) for problem in problems.values())
    assert all(problem in as_text.stdout for problem in problems.values())
    assert "built in: auto, mc, mc-exact, ransac-2p, " in as_text.stdout


def test_the_page_the_painter_and_the_recorder_go_on(place: Path) -> None:
    """A stage of another kind was a KeyError in all of them; a page that does not start has nobody to tell."""
    done = python(place, PAGE)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    unusable = UNUSABLE["estimators"] - {"wrong", "refusing", "mc", "odd"}
    assert not set(told["usable"]) & unusable and {"odd", "mc", "ransac-shapeless"} <= set(told["usable"])
    assert not set(told["usable"]) & {"ransac-sizeless", "ransac-number", "ransac-gone"}
    captions = told["captions"]
    assert "The stage guess has no drawing here." in captions["stage-guess"]
    assert "odd of odd-pack" in captions["stage-guess"] and "outcome" in captions
    assert captions["good-1"] == "Drawn by the layer." and told["stages"]["good-1"] == "good"
    assert captions["chart-1"] == "Drawn by the layer." and "odd" not in told["charts"]
    for key, words in {
        "stage-yaw": "The stage yaw cannot be drawn (",
        "stage-crash": "The stage crash cannot be drawn by the layer of odd-pack (KeyError: 'plans').",
        "late-1": "The stage late cannot be drawn by the layer of odd-pack (AttributeError: ",
        "stage-keys": "the key 'outcome-1' of a plan does not begin with 'keys'",
        "colors-1": "colors of the frame is float64 of shape (3, 3), not an array of uint8 of shape (20, 3)",
        "item-1": "positions of the primitive odd is float64 of shape (3, 2), not an array of numbers of shape (N, 3)",
        "stage-listed": "plans() gives [1, 2], no list of Plan",
        "stage-number": "The layer 'number' of the extension odd-pack is 3, no Layer with title and plans",
        "stage-other": "The layer 'other' of the extension odd-pack draws another class than odd_pack.Other.",
        "stage-gone-layer": "The layer 'gone-layer' of the extension odd-pack cannot be imported (ModuleNotFoundError",
    }.items():
        assert words in captions[key], captions.get(key)
    assert told["recorded"] == "odd"
    assert "of the extension odd-pack failed (ZeroDivisionError: focal length)" in told["cameras"]["lens"]
    assert "of the extension odd-pack failed (KeyError: 'pixels')" in told["cameras"]["crooked"]
    assert "calls its model 'lens'" in told["cameras"]["misnamed"] and "is 3, not a class" in told["cameras"]["number"]
    assert told["mc"] == "spherloc.estimators.mc", "an extension cannot take the place of spherloc's own"
    assert told["table"] == ["mc", "ransac-2p"]
    assert all(f"'{name}' {ODD}" in told["compared"] for name in ("refusing", "shapeless"))
    for kind, names in UNUSABLE.items():
        for name in names:
            # A solver that fails does so as an estimator.
            named = (f"the {KINDS[kind]} '{name}'", *((f"'{RANSAC}{name}'",) if kind == "solvers" else ()))
            lines = [line for line in done.stderr.splitlines() if any(words in line for words in named)]
            assert len(lines) == 1, f"{named}\n{done.stderr}"
    assert all(len(line) < 400 and line.isprintable() for line in done.stderr.splitlines())
