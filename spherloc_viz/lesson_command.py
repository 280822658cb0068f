"""``spherloc lesson``: lists the lessons, and writes one as a file."""

from pathlib import Path

from spherloc.errors import InputError
from spherloc.warm_up import warm_up
from spherloc_viz.lessons import lesson_named, lessons
from spherloc_viz.progress import say


def list_lessons(export: Path | None, handout: Path | None) -> int:
    """Print a line a lesson. Raises ``InputError`` if a file was asked for."""
    if export is not None or handout is not None:
        raise InputError("name the lesson that is to be written; spherloc lesson lists them.")
    width = max(len(lesson.name) for lesson in lessons())
    for lesson in lessons():
        print(f"{lesson.name:{width}}  {lesson.minutes:2d} min  {lesson.title}")
    return 0


def write_lesson(name: str, export: Path | None, handout: Path | None) -> int:
    """Write the files that are asked for, and print where they are; without any, where the lesson can be read.

    Raises ``InputError`` if there is no such lesson or a file cannot be written.
    """
    lesson = lesson_named(name)
    if export is None and handout is None:
        print(f"{lesson.title}\n{lesson.summary}\nspherloc play, then /learn/{lesson.name}; or --export, --handout.")
        return 0
    for path in filter(None, (export, handout)):
        if not path.parent.is_dir():
            raise InputError(f"{path.parent}: is no folder; give a file in one that exists.")
    from spherloc_viz.app.lesson_file import exported, handout_of

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
