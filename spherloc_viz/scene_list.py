"""``spherloc scenes``: bundled scenes and dataset loaders, as text."""

from pathlib import Path

from spherloc.datasets import bundled_scenes
from spherloc.datasets.loaders import SceneKind, scene_kind, scene_kinds
from spherloc.datasets.scene_file import read_table
from spherloc.errors import InputError


def all_scenes() -> str:
    """A line a bundled scene: file, kind, name and what it is about; then a line a kind. Renders and reads no image."""
    lines = [_scene(path) for path in bundled_scenes().values()]
    kinds = scene_kinds()
    width = max((len(kind.name) for kind in kinds), default=0)
    lines += ["", "Kinds of scene files, for your own data; spherloc scenes KIND shows how one is written:"]
    return "\n".join([*lines, *(f"  {kind.name:<{width}}  {_line(kind)}" for kind in kinds)])


def one_kind(name: str) -> str:
    """What a kind reads, its example file and the packages it needs. Raises ``InputError`` for an unknown kind."""
    kind = scene_kind(name)
    if kind.problem:
        raise InputError(f"scenes of kind {name} cannot be read: {kind.problem}")
    parts = [kind.documentation, *([f"Needs: {_install(kind)}"] if kind.extras else [])]
    return "\n\n".join([*parts, *([f"For example:\n\n{kind.example.strip()}"] if kind.example else [])])


def _scene(path: Path) -> str:
    try:
        table = read_table(path)
    except InputError as error:
        return f"{path}  cannot be used: {error}"
    about = " ".join(str(table.get("about", "")).split())
    return f"{path}  {table.get('kind')}  {table.get('name')}" + (f". {about}" if about else "")


def _line(kind: SceneKind) -> str:
    if kind.problem:
        return f"cannot be read: {kind.problem}"
    first = kind.documentation.partition("\n")[0]
    return first + (f" Needs: {_install(kind)}" if kind.extras else "")


def _install(kind: SceneKind) -> str:
    return f"pip install 'spherloc[{','.join(kind.extras)}]'"
