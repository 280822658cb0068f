"""The lessons that there are: every Markdown file in the folder ``texts``, and those that other packages register."""

import contextlib
from functools import cache
from pathlib import Path

from spherloc import registry
from spherloc.errors import InputError, show
from spherloc_viz.lessons.lesson import Lesson, read_lesson

TEXTS = Path(__file__).with_name("texts")
KIND = "lessons"


@cache
def lessons() -> tuple[Lesson, ...]:
    """All lessons that can be read, by their place in the course; ``spherloc plugins`` names the others."""
    found = list(map(read_lesson, TEXTS.glob("*.md")))
    for name in registry.names(KIND):
        if name not in own_names():
            with contextlib.suppress(InputError):
                found.append(lesson_of(name))
    return tuple(sorted(found, key=lambda lesson: (lesson.order, lesson.name)))


def own_names() -> tuple[str, ...]:
    """Names of spherloc's own lessons."""
    return tuple(path.stem for path in TEXTS.glob("*.md"))


def lesson_of(name: str) -> Lesson:
    """The lesson that another package registers in the group ``spherloc.lessons``: the path of a Markdown file whose
    stem is the entry point's name.

    Raises ``InputError`` if there is none, or if it cannot be read.
    """
    path = registry.lookup(KIND, name)
    if not isinstance(path, str | Path) or Path(path).stem != name:
        raise InputError(f"{registry.title(KIND, name)} must be the path of a file {name}.md; mend or uninstall it.")
    return read_lesson(Path(path))


def lesson_named(name: str) -> Lesson:
    """The lesson of this name; raises ``InputError`` that names those there are."""
    found = next((lesson for lesson in lessons() if lesson.name == name), None)
    if found is None:
        raise InputError(f"there is no lesson {show(name)}; there are {', '.join(one.name for one in lessons())}.")
    return found
