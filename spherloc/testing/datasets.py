"""The contract of kinds of scene files."""

import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from spherloc.datasets.scene_file import SceneKind, load_scene, loader_of, read_table, scene_kind
from spherloc.errors import InputError, show
from spherloc.problem import Problem
from spherloc.testing.saying import Saying, difference


def check_dataset(scene: str | Path, loader: Callable[[dict[str, Any], Path], Any] | None = None) -> None:
    """Raise ``AssertionError`` unless the scene of a file, and its loader, keep the contract of scene files.

    ``loader`` is the one that is registered for the file's kind if it is not given. The scene has a name and gives the
    same ``Problem`` whenever it is asked; the loader refuses unknown keys, and values of other types, with an
    ``InputError`` that names the file; and its module says what it reads and has an ``EXAMPLE`` of its own kind.
    """
    path = Path(scene)
    table = read_table(path)
    say = Saying(f"the dataset {show(table.get('kind'))}")
    load = loader or loader_of(str(table.get("kind")))
    found = load(dict(table), path) if loader else load_scene(path)
    say.need(isinstance(found.name, str) and found.name.isprintable() and bool(found.name), f"names {path} badly")
    problem = found.problem()
    say.need(isinstance(problem, Problem), f"gives {show(problem)} for {path}, which is no Problem")
    changed = difference(problem, found.problem(), "the problem")
    say.need(not changed, f"gives another problem when it is asked again: {changed} of {path} differs")
    changes = [{**table, "no_such_key": 1}]
    changes += [{**table, key: value} for key in table if key != "kind" for value in (-1.5, [], {"no": "key"})]
    for number, values in enumerate(changes):
        key = next(key for key in values if values[key] is not table.get(key))
        what = f"with {key} = {show(values[key])} in {path.name}"
        try:
            load(values, path)
        except InputError as error:
            say.need(path.name in str(error), f"does not name the file {what}: {error}")
        except Exception as error:
            say.fail(f"raises {error!r} {what}; raise InputError")
        else:
            say.need(number > 0, f"takes an unknown key {what}; raise InputError")
    if loader is None:
        _check_kind(scene_kind(str(table["kind"])), say)


def _check_kind(kind: SceneKind, say: Saying) -> None:
    say.need(not kind.problem, f"cannot be described: {kind.problem}")
    say.need(
        kind.documentation.partition("\n")[0].endswith("."), "has no module docstring whose first line is a sentence"
    )
    if kind.example:
        say.need(tomllib.loads(kind.example).get("kind") == kind.name, "has an EXAMPLE of another kind")
