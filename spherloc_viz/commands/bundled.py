"""``spherloc lesson`` and ``spherloc scenes``: what is bundled, as text or as files."""

from pathlib import Path

from spherloc.datasets import bundled_scenes
from spherloc.datasets.scene_file import SceneKind, read_table, scene_kind, scene_kinds
from spherloc.errors import InputError
from spherloc.registry import extension_of
from spherloc_viz.given_files import no_such_name

PROBLEMS = ("correspondences", "synthetic")
"""Kinds of scenes that are one problem, not made of images."""


def list_lessons(export: Path | None, handout: Path | None) -> int:
    """Print a line for each lesson. Raises ``InputError`` if a file was asked for."""
    if export is not None or handout is not None:
        raise InputError("name the lesson that is to be written; spherloc lesson lists them.")
    from spherloc_viz.lessons import lessons

    width = max(len(lesson.name) for lesson in lessons())
    for lesson in lessons():
        print(f"{lesson.name:{width}}  {lesson.minutes:2d} min  {lesson.title}")
    return 0


def write_lesson(name: str, export: Path | None, handout: Path | None) -> int:
    """Write the files that are asked for, and print where they are; without any, where the lesson can be read.

    Raises ``InputError`` if there is no such lesson or a file cannot be written.
    """
    from spherloc_viz.lessons import lesson_named

    try:
        lesson = lesson_named(name)
    except InputError as error:
        raise no_such_name(name, error) from None
    if export is None and handout is None:
        print(f"{lesson.title}\n{lesson.summary}\nspherloc play, then /learn/{lesson.name}; or --export, --handout.")
        return 0
    for path in filter(None, (export, handout)):
        if not path.parent.is_dir():
            raise InputError(f"{path.parent}: is not a folder; give a file in one that exists.")
    from spherloc.warm_up import warm_up
    from spherloc_viz.app.lesson_file import exported, handout_of
    from spherloc_viz.commands.progress import say

    warm_up(say, ["mc"])
    if handout is not None:
        _write(handout, handout_of(lesson))
    if export is not None:
        _write(export, exported(lesson, say))
    return 0


def _write(path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); give another --export or --handout.") from None
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")


def all_scenes() -> str:
    """Name, kind and title of every bundled scene, what it is about, and a line a kind. Renders and reads no image."""
    lines = ["Bundled scenes; play, run, localize and sweep take their names in any folder:"]
    lines += [_scene(path) for path in bundled_scenes().values()]
    kinds = scene_kinds()
    width = max((len(kind.name) for kind in kinds), default=0)
    lines += ["", "Kinds of scene files, for your own data; spherloc scenes KIND shows how one is written:"]
    return "\n".join([*lines, *(f"  {kind.name:<{width}}  {_line(kind)}" for kind in kinds)])


def one_kind(name: str) -> str:
    """An example of a kind, the packages it needs, and its bundled scenes. Raises ``InputError`` for an unknown
    kind."""
    try:
        kind = scene_kind(name)
    except InputError as error:
        raise no_such_name(name, error) from None
    if kind.problem:
        raise InputError(f"scenes of kind {name} cannot be read: {kind.problem}")
    parts = [_plain(kind.documentation)]
    if kind.example:
        parts.append(f"For example:\n\n{kind.example.strip()}")
    if name not in PROBLEMS and not extension_of("datasets", name):
        from spherloc.datasets.map_scene import OPTIONAL_EXAMPLE  # takes half a second

        parts.append(f"Every scene of images may also have:\n\n{OPTIONAL_EXAMPLE.strip()}")
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
