"""The lessons that there are: every Markdown file in the folder ``texts``."""

from functools import cache
from pathlib import Path

from spherloc.errors import InputError, show
from spherloc_viz.lessons.lesson import Lesson, read_lesson

TEXTS = Path(__file__).with_name("texts")
PICTURES = Path(__file__).with_name("pictures")


@cache
def lessons() -> tuple[Lesson, ...]:
    """All lessons, by their place in the course."""
    return tuple(sorted(map(read_lesson, TEXTS.glob("*.md")), key=lambda lesson: (lesson.order, lesson.name)))


def lesson_named(name: str) -> Lesson:
    """The lesson of this name; raises ``InputError`` that names those there are."""
    found = next((lesson for lesson in lessons() if lesson.name == name), None)
    if found is None:
        raise InputError(f"there is no lesson {show(name)}; there are {', '.join(one.name for one in lessons())}.")
    return found


def picture_of(name: str, place: int) -> bytes | None:
    """The picture of a moment of a lesson, WebP; None if it has none."""
    path = PICTURES / f"{name}-{place}.webp"
    return path.read_bytes() if path.is_file() else None
