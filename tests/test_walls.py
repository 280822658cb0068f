"""The house keeps its walls and floors (docs/architecture.md; one reads the code from the ground to the roof).

1. ``spherloc`` knows no screen: no viewer, server or command line library, and no ``spherloc_viz``.
2. A file imports only from floors below its own, or from its own floor where that makes no circle.
3. What both painters draw (``spherloc_viz.layers``) knows neither of them, and no painter knows the program around it.
"""

import ast
import functools
import re
import subprocess
import sys
import tomllib
from collections import defaultdict
from importlib.metadata import packages_distributions, requires
from pathlib import Path

import networkx as nx
import pytest

ROOT = Path(__file__).resolve().parents[1]

SCREENS = {"viser", "rerun", "rerun_sdk", "rerun_bindings", "plotly", "aiohttp", "tyro", "spherloc_viz"}

FLOORS = (
    ("spherloc.errors", "spherloc.types", "spherloc.processors", "spherloc.proof_check", "spherloc"),
    (
        "spherloc.files",
        "spherloc.ranges",
        "spherloc.registry",
        "spherloc.geometry",
        "spherloc.kernel_cache",
        "spherloc.small_arrays",
        "spherloc.watch",
        "spherloc.disk_cache",
        "spherloc.images",
    ),
    ("spherloc.cameras", "spherloc.gauss_newton", "spherloc.solvers", "spherloc.trajectory"),
    ("spherloc.narrowing", "spherloc.worlds", "spherloc.formats"),
    ("spherloc.problem", "spherloc.bounds", "spherloc.consensus"),
    (
        "spherloc.trace",
        "spherloc.noise_scale",
        "spherloc.refine",
        "spherloc.last_step",
        "spherloc.free_gravity",
        "spherloc.metrics",
        "spherloc.datasets",
        "spherloc.frontend",
    ),
    (
        "spherloc.estimators",
        "spherloc.warm_up",
        "spherloc.proof",
        "spherloc.diagnosis",
        "spherloc.outcome",
        "spherloc.experiments",
    ),
    ("spherloc.localization", "spherloc.testing", "spherloc.mapping", "spherloc.verification"),
    (
        "spherloc_viz.style",
        "spherloc_viz.layers",
        "spherloc_viz.options",
        "spherloc_viz.given_files",
        "spherloc_viz.importing",
        "spherloc_viz.share",
        "spherloc_viz",
    ),
    ("spherloc_viz.recording", "spherloc_viz.plots"),
    ("spherloc_viz.gallery",),
    ("spherloc_viz.app", "spherloc_viz.lessons", "spherloc_viz.plugins"),
    ("spherloc_viz.commands", "spherloc_viz.showing", "spherloc_viz.start"),
)
"""From the ground up; a room is a module or a package with all of its files."""

MAPPING = ("advice", "parallel", "rig", "two_view", "images", "alignment", "models", "scenes")
"""Rooms of spherloc.mapping, each of which imports only from itself and those before it."""

FORBIDDEN = (
    # (files whose name starts with this, must not import this, why)
    ("spherloc_viz.layers", ("viser", "rerun", "aiohttp", "tyro"), "layers describe pictures for both painters"),
    ("spherloc_viz.style", ("viser", "rerun", "aiohttp", "tyro"), "colours are for both painters"),
    ("spherloc_viz.recording", ("viser", "tyro", "spherloc_viz.app"), "recordings are written without a page"),
    ("spherloc_viz.app", ("rerun", "tyro"), "the page does not draw recordings itself"),
)


def sources():
    """Path of every module by its dotted name."""
    found = {}
    for package in ("spherloc", "spherloc_viz"):
        for path in sorted((ROOT / package).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


MODULES = sources()


def imports(module):
    """(line, dotted name) of every import of a module, inside functions too; the name of a file if it is one."""
    return imports_of(module, MODULES[module])


@functools.cache
def imports_of(module, path):
    return tuple(parsed_imports(module, path))


def parsed_imports(module, path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                package = module if path.stem == "__init__" else module.rpartition(".")[0]
                above = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*above, *([base] if base else [])])
            for alias in node.names:
                whole = f"{base}.{alias.name}"
                yield node.lineno, whole if whole in MODULES else base


def inside(name, room):
    return name == room or name.startswith(room + ".")


def room_of(module):
    rooms = [room for floor in FLOORS for room in floor if inside(module, room)]
    return max(rooms, key=len)


def floor_of(module):
    return next(number for number, floor in enumerate(FLOORS) if room_of(module) in floor)


def place(module, line):
    return f"{MODULES[module].relative_to(ROOT)}:{line}"


def test_rooms_of_mapping_import_from_those_before_them():
    rooms = [f"spherloc.mapping.{name}" for name in MAPPING]
    wrong = []
    for number, room in enumerate(rooms):
        below = rooms[: number + 1]
        for module in (name for name in MODULES if inside(name, room)):
            wrong += [
                f"{place(module, line)} imports {name}"
                for line, name in imports(module)
                if inside(name, "spherloc.mapping") and not any(inside(name, one) for one in below)
            ]
    assert not wrong, wrong


def test_every_module_has_a_floor():
    """A new room must be given a place, else its imports would go unchecked."""
    homeless = [name for name in MODULES if room_of(name) in ("spherloc", "spherloc_viz") and "." in name]
    assert not homeless, f"no floor for {', '.join(homeless)}: add the room to FLOORS in {Path(__file__).name}"


def test_spherloc_names_no_screen():
    broken = [
        f"{place(module, line)} imports {name}"
        for module in MODULES
        if inside(module, "spherloc")
        for line, name in imports(module)
        if name.partition(".")[0] in SCREENS
    ]
    assert not broken, "spherloc must work without any screen; move this to spherloc_viz:\n" + "\n".join(broken)


def distribution(requirement):
    """The name of what is required by a line such as "numpy>=2.0,<3"."""
    return re.split(r"[^\w.-]", requirement)[0].lower()


def test_what_is_imported_is_installed_with_the_package():
    """Or comes with what is declared. A package of an extra may only be asked for where it is needed, in a function,
    which can say what is missing."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    declared = {distribution(line) for line in project["dependencies"]}
    declared |= {
        distribution(line) for name in declared.copy() for line in requires(name) or () if "extra ==" not in line
    }
    makers = packages_distributions()
    broken = []
    for module, path in MODULES.items():
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and not node.level:
                names = [node.module or ""]
            for package in {name.partition(".")[0] for name in names} - {"spherloc", "spherloc_viz"}:
                made_by = {maker.lower() for maker in makers.get(package, [])}
                if package not in sys.stdlib_module_names and not made_by & declared:
                    broken.append(f"{place(module, node.lineno)} imports {package}")
    assert not broken, "not among the dependencies in pyproject.toml:\n" + "\n".join(broken)


LOADER = """
import importlib, sys
for name in {names!r}:
    importlib.import_module(name)
print(" ".join(sorted({{name.partition(".")[0] for name in sys.modules}})))
"""


def loaded_by(names):
    """Top-level modules in a fresh interpreter after importing ``names``."""
    return told_by(LOADER.format(names=sorted(names)))


def told_by(code):
    """Words that a fresh interpreter prints."""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return set(done.stdout.split())


@pytest.mark.parametrize("packages", [("spherloc",), ("spherloc_viz.layers", "spherloc_viz.style")])
def test_no_screen_is_loaded(packages):
    """Also not by something that is imported by something else."""
    top = packages[0].partition(".")[0]
    loaded = loaded_by(name for name in MODULES if any(inside(name, package) for package in packages))
    found = loaded & (SCREENS - {top})
    assert top in loaded
    assert not found, f"importing all of {' and '.join(packages)} also loads {', '.join(sorted(found))}"


def test_the_command_line_answers_before_anything_large_is_loaded():
    """``spherloc --help`` and ``spherloc scenes`` are asked while somebody waits."""
    large = {"numba", "scipy", "cv2", "rerun", "viser", "pyarrow"}
    assert not loaded_by(["spherloc_viz.commands.cli", "spherloc_viz.commands.recording_commands"]) & {*large, "numpy"}
    scenes = "from spherloc_viz.commands.bundled import all_scenes; all_scenes()"
    assert not told_by(scenes + LOADER.format(names=[])) & large


def test_a_map_alone_does_not_load_what_localizes():
    code = "from spherloc_viz.commands.image_commands import _localize_by_default; assert _localize_by_default(()) == 0"
    assert not told_by(f"{code}\nimport sys; print(*sys.modules)") & {"spherloc_viz.commands.localize", "numpy"}


def test_the_first_picture_waits_for_nothing_that_it_does_not_need():
    """Recordings and lessons come later, and what they need takes a fifth of all imports: see what the functions that
    read and write them import themselves."""
    later = {"rerun", "rerun_bindings", "pyarrow", "markdown_it", "latex2mathml"}
    assert later <= loaded_by(["spherloc_viz.recording.content.writer", "spherloc_viz.app.lesson_file"])
    loaded = loaded_by(["spherloc_viz.app.server"])
    assert "viser" in loaded
    assert not loaded & later, f"the server also loads {', '.join(sorted(loaded & later))}: import it where it is used"


def test_every_import_goes_down():
    broken = []
    for module in MODULES:
        for line, name in imports(module):
            if name in MODULES and floor_of(name) > floor_of(module):
                broken.append(
                    f"{place(module, line)} (floor {floor_of(module)}) imports {name} (floor {floor_of(name)}): "
                    "move what both need down, or this file up"
                )
    assert not broken, "a file may import from its own floor and those below only:\n" + "\n".join(broken)


def pairwise_around(circle):
    return zip(circle, circle[1:] + circle[:1], strict=True)


def test_no_circles():
    """Between files and between rooms: two rooms of one floor may lean on each other in one direction only."""
    for unit, what in ((lambda name: name, "files"), (room_of, "rooms")):
        graph = nx.DiGraph()
        for module in MODULES:
            for line, name in imports(module):
                if name in MODULES and unit(name) != unit(module):
                    graph.add_edge(unit(module), unit(name), where=place(module, line))
        circles = [
            "\n    ".join(
                [" -> ".join(circle + circle[:1]), *(graph.edges[edge]["where"] for edge in pairwise_around(circle))]
            )
            for circle in nx.simple_cycles(graph)
        ]
        assert not circles, f"{what} import each other in a circle:\n" + "\n".join(circles)


@pytest.mark.parametrize("room, names, why", FORBIDDEN)
def test_painters_are_kept_apart(room, names, why):
    broken = [
        f"{place(module, line)} imports {name}"
        for module in MODULES
        if inside(module, room)
        for line, name in imports(module)
        if any(inside(name, forbidden) for forbidden in names)
    ]
    assert not broken, f"{why}:\n" + "\n".join(broken)


def test_no_two_classes_have_one_name():
    where = defaultdict(list)
    for module, path in MODULES.items():
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef):
                where[node.name].append(module)
    assert len(where) > 100
    assert {name: modules for name, modules in where.items() if len(modules) > 1} == {}


def test_walls_would_be_noticed(monkeypatch, tmp_path):
    """The checks above read imports of every form; a form that they overlook would be a hole in the wall."""
    path = tmp_path / "hole.py"
    path.write_text(
        "import viser.uplot as u\nfrom rerun import blueprint\n"
        "def f():\n    from spherloc_viz import app\n    from . import errors\n    from .cameras import base as b\n"
    )
    monkeypatch.setitem(MODULES, "spherloc.hole", path)
    names = [name for _, name in imports("spherloc.hole")]
    assert names == ["viser.uplot", "rerun", "spherloc_viz.app", "spherloc.errors", "spherloc.cameras.base"]
    assert room_of("spherloc.hole") == "spherloc"
