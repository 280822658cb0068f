"""``spherloc scenes``: bundled scenes and dataset loaders, as text."""

from pathlib import Path

from spherloc.datasets import bundled_scenes
from spherloc.datasets.scene_file import SceneKind, read_table, scene_kind, scene_kinds
from spherloc.errors import InputError


def all_scenes() -> str:
    """Name, kind and title of every bundled scene, what it is about, and a line a kind. Renders and reads no image."""
    lines = ["Bundled scenes; play, run, localize and sweep take their names in any folder:"]
    lines += [_scene(path) for path in bundled_scenes().values()]
    kinds = scene_kinds()
    width = max((len(kind.name) for kind in kinds), default=0)
    lines += ["", "Kinds of scene files, for your own data; spherloc scenes KIND shows how one is written:"]
    return "\n".join([*lines, *(f"  {kind.name:<{width}}  {_line(kind)}" for kind in kinds)])


def one_kind(name: str) -> str:
    """How a kind is written, the packages it needs, and bundled scenes. Raises ``InputError`` for an unknown kind."""
    kind = scene_kind(name)
    if kind.problem:
        raise InputError(f"scenes of kind {name} cannot be read: {kind.problem}")
    parts = [_plain(kind.documentation)]
    if kind.example:
        parts.append(f"For example:\n\n{kind.example.strip()}")
    if bundled := [str(path) for path in bundled_scenes().values() if _kind(path) == name]:
        parts.append("\n".join(["Bundled:", *bundled]))
    return "\n\n".join([*parts, *([f"Needs: {_install(kind)}"] if kind.extras else [])])


def _scene(path: Path) -> str:
    try:
        table = read_table(path)
    except InputError as error:
        return f"  {path.stem}  cannot be used: {error}"
    about = " ".join(str(table.get("about", "")).split())
    return f"  {path.stem}  {table.get('kind')}  {table.get('name')}" + (f"\n    {about}" if about else "")


def _kind(path: Path) -> object:
    try:
        return read_table(path).get("kind")
    except InputError:
        return None


def _line(kind: SceneKind) -> str:
    if kind.problem:
        return f"cannot be read: {kind.problem}"
    first = _plain(kind.documentation).partition("\n")[0].removeprefix(f'Scenes of kind = "{kind.name}": ')
    return first + (f" Needs: {_install(kind)}" if kind.extras else "")


def _plain(documentation: str) -> str:
    """A docstring without its markup."""
    return documentation.replace("``", "").replace(".. code-block:: toml\n\n", "")


def _install(kind: SceneKind) -> str:
    return f"pip install 'spherloc[{','.join(kind.extras)}]'"
