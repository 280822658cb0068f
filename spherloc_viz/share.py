"""What is on screen as a script and as a command: pasting either gives the same pose, to the last bit."""

import math
import shlex
from dataclasses import fields
from pathlib import Path
from typing import Any

from spherloc.datasets import scene_file
from spherloc.datasets.variation import EDITS, Variation, settings_of
from spherloc.errors import InputError
from spherloc.estimators import options_type
from spherloc_viz.given_files import is_recording
from spherloc_viz.options import typed

WORDS = {"spoiled": "--spoil", "mended": "--mend", "hidden": "--hide"}


def as_python(
    scene_path: Path, seed: int, query: str | None, variation: Variation, estimator: str, options: Any
) -> str:
    """A script that solves the problem and prints the pose with all its digits; it says what differs from defaults.

    ``scene_path`` is a scene file or a recording.
    """
    changes, recorded = _written_changes(variation), is_recording(scene_path)
    given = ", ".join(f"{name}={_code(value)}" for name, value in changes.items())
    chosen = [str(seed)] if query is None else [str(seed), _code(query)]
    options_given = ", ".join(
        f"{_code(name)}: {_code(value)}" for name, value in _changed(scene_path, estimator, options)
    )
    file = _code(_written(scene_path))
    lines = [
        *(["from pathlib import Path", ""] if recorded else []),
        "import spherloc",
        *(["from spherloc.datasets.variation import Variation"] if changes else []),
        *(["from spherloc_viz.recording.replay import load_recorded_scene"] if recorded else []),
        "",
        f"scene = load_recorded_scene(Path({file}))" if recorded else f"scene = spherloc.load_scene({file})",
        f"problem = Variation({given}).problem(scene, {', '.join(chosen)})"
        if changes
        else f"problem = scene.problem({', '.join(chosen)})",
        f"trace = spherloc.estimate(problem, {_code(estimator)}, "
        f"{f'{{{options_given}}}, ' if options_given else ''}seed={seed})",
        "print(trace.message)",
        "print(None if trace.cam_from_map is None else trace.cam_from_map.tolist())",
    ]
    return "\n".join(lines) + "\n"


def as_command(
    scene_path: Path, seed: int, query: str | None, variation: Variation, estimator: str, options: Any
) -> str:
    """A command line that solves the problem, quoted for a shell; it says what differs from defaults.

    ``scene_path`` is a scene file or a recording.
    """
    changes = _written_changes(variation)
    words = ["spherloc", "run", _written(scene_path)]
    if words[-1].startswith("-"):
        words[-1] = f"./{words[-1]}"
    simulated = Variation(**{name: value for name, value in changes.items() if name not in EDITS})
    for setting in settings_of(simulated):
        words += ["--set", setting]
    for name in EDITS:
        if name in changes:
            words += [WORDS[name], ",".join(map(str, changes[name]))]
    words += ["--seed", str(seed)]
    if query is not None:
        words += [f"--query={query}"] if query.startswith("-") else ["--query", query]
    words += ["--estimator", estimator]
    for name, value in _changed(scene_path, estimator, options):
        words += ["--option", f"{name}={typed(value)}"]
    return shlex.join(words)


def _written_changes(variation: Variation) -> dict[str, Any]:
    """The fields of a variation that change something, with its camera's path as it is written."""
    changes = variation.simulation
    if "camera" in changes:
        changes["camera"] = _written(Path(changes["camera"]))
    return changes | {name: getattr(variation, name) for name in EDITS if getattr(variation, name)}


def _written(path: Path) -> str:
    """A path from the current folder if it is inside it, else an absolute one."""
    path, here = path.resolve(), Path.cwd().resolve()
    return str(path.relative_to(here) if path.is_relative_to(here) else path)


def _changed(scene_path: Path, estimator: str, options: Any) -> list[tuple[str, Any]]:
    """Options that are not what the estimator would take for the scene."""
    kind = options_type(estimator)
    pairs = [(item.name, getattr(options, item.name)) for item in fields(options)]
    if is_recording(scene_path):
        # Its problem may state a bound, which is not known here: what is named is right in either case.
        return [(name, value) for name, value in pairs if name == "bound_px" or value != getattr(kind(), name)]
    try:
        stated = scene_file.bound_px(scene_file.read_table(scene_path), str(scene_path))
    except InputError:
        stated = None
    default = kind() if stated is None else kind(bound_px=stated)
    return [(name, value) for name, value in pairs if value != getattr(default, name)]


def _code(value: Any) -> str:
    """A value as Python code."""
    if isinstance(value, float) and math.isinf(value):
        return f'float("{value}")'
    if isinstance(value, str) and value.isprintable() and not set(value) & set('"\\'):
        return f'"{value}"'
    return repr(value)
