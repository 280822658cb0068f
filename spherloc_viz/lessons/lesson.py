"""What a lesson is, and how its file is read.

A lesson is a Markdown file. It begins with TOML between lines of ``+++``, and each heading ``## Title`` begins a
moment.
Fenced blocks say what is not prose:

- ``moment``, TOML, once a moment: ``state`` is the text behind the "#" of the page's address; ``minutes`` is how long
  it takes in front of a class; ``claims`` are statements about its run that a test recomputes;
  ``before`` is what of the state is different until the moment's question is answered.
- ``question``, TOML: ``ask``, and ``answers``, each with ``text``, ``shows``, ``right`` if it is, and ``go``, what of
  the state changes to show why. What follows the question is told once it is answered.
- ``notes``, Markdown: for the teacher only.

In the prose ``$...$`` is a formula (LaTeX), ``{name}`` a number of the run at hand (``numbers.py``),
``[words](#changes)`` a link that changes the state, and ``{slider KEY FIRST LAST STEP}`` a slider of a key of it,
such as ``seed``, ``set.outlier_rate`` or ``option.iterations``; ``{choice KEY ONE|OTHER}`` offers words.
"""

import contextlib
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, urlencode

from spherloc import registry
from spherloc.errors import InputError, show

MANY = ("set", "option")
"""Keys of a state that may be said several times, each with a name of its own."""
HEAD = re.compile(r"\A\+\+\+\n(.*?)\n\+\+\+\n", re.DOTALL)
BLOCK = re.compile(r"^```(moment|question|notes)\n(.*?)^```$\n?", re.DOTALL | re.MULTILINE)
LESSON_KEYS = {"title", "summary", "order", "quoted", "picture", "lecture"}
MOMENT_KEYS = {"state", "minutes", "claims", "before"}
QUESTION_KEYS = {"ask", "answers"}
ANSWER_KEYS = {"text", "shows", "right", "go"}


@dataclass(frozen=True)
class Answer:
    """One answer to choose."""

    text: str
    shows: str
    """What is said once it is chosen; Markdown."""
    right: bool
    go: str
    """What of the moment's state changes then; may be empty."""


@dataclass(frozen=True)
class Question:
    """To be answered before the moment goes on."""

    ask: str
    answers: tuple[Answer, ...]


@dataclass(frozen=True)
class Moment:
    """A state of the page and what is said beside it."""

    title: str
    state: str
    before: str
    minutes: float
    prose: str
    """Markdown, before the question if there is one."""
    question: Question | None
    after: str
    """Markdown that follows the question."""
    notes: str
    """Markdown for the teacher."""
    claims: tuple[str, ...]


@dataclass(frozen=True)
class Lesson:
    """A sequence of moments."""

    name: str
    """Stem of its file."""
    title: str
    summary: str
    """One sentence."""
    order: int
    """Place in the course."""
    lecture: bool
    """Whether it is for the front of a class, and not of the course."""
    picture: int
    """Number of the moment whose picture stands for the lesson, from 0 on."""
    quoted: Mapping[float, str] = field(hash=False)
    """Numbers in the text that come from elsewhere than from a run, and where they come from."""
    introduction: str
    """Markdown before the first moment."""
    moments: tuple[Moment, ...]

    @property
    def minutes(self) -> int:
        """How long it takes in front of a class."""
        return round(sum(moment.minutes for moment in self.moments))


def read_lesson(path: Path) -> Lesson:
    """The lesson of a file; raises ``InputError`` that says what is wrong where."""
    try:
        text = path.read_text(encoding="utf-8").replace("\r\n", "\n")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as a lesson ({error}); give a Markdown file.") from None
    return parse_lesson(text, path.stem, str(path))


def parse_lesson(text: str, name: str, where: str) -> Lesson:
    """The lesson in a text; raises ``InputError`` that says what is wrong, with ``where`` in front."""
    head = HEAD.match(text)
    if head is None:
        raise InputError(f"{where}: a lesson begins with TOML between two lines of +++; see docs/lessons.md.")
    table = _table(head[1], LESSON_KEYS, f"{where}: the head")
    introduction, *parts = re.split(r"^## +", text[head.end() :], flags=re.MULTILINE)
    if not parts:
        raise InputError(f"{where}: has no moment; begin each with a heading of two number signs.")
    moments = tuple(_moment(part, where) for part in parts)
    picture = _get(table, "picture", int, where, 0)
    if not 0 <= picture < len(moments):
        raise InputError(f"{where}: picture is {picture}; give the number of a moment, 0 to {len(moments) - 1}.")
    return Lesson(
        name,
        _get(table, "title", str, where),
        _get(table, "summary", str, where),
        _get(table, "order", int, where, 1000),
        _get(table, "lecture", bool, where, False),
        picture,
        _quoted(_get(table, "quoted", dict, where, {}), where),
        introduction.strip(),
        moments,
    )


def _quoted(table: Mapping[str, object], where: str) -> dict[float, str]:
    found = {}
    for number, source in table.items():
        try:
            found[float(number)] = str(source)
        except ValueError:
            raise InputError(f"{where}: quoted has {show(number)}, which is not a number; correct it.") from None
    return found


def _moment(text: str, where: str) -> Moment:
    title, _, body = text.partition("\n")
    title = title.strip()
    where = f"{where}: moment {show(title)}"
    blocks = BLOCK.findall(body)
    for kind in ("moment", "question", "notes"):
        if sum(found == kind for found, _ in blocks) > 1:
            raise InputError(f"{where}: has two blocks {kind}; keep one.")
    said = dict(blocks)
    if "moment" not in said:
        raise InputError(f"{where}: has no block ```moment with its state.")
    table = _table(said["moment"], MOMENT_KEYS, where)
    prose, _, after = re.sub(
        BLOCK, lambda found: "\f" if found[1] == "question" else "", body
    ).partition("\f")  # fmt: skip
    before = _get(table, "before", str, where, "")
    if before and "question" not in said:
        raise InputError(f"{where}: says before, but has no question that would end it.")
    return Moment(
        title,
        _get(table, "state", str, where),
        before,
        float(_get(table, "minutes", (int, float), where, 2)),
        prose.strip(),
        _question(said["question"], where) if "question" in said else None,
        after.strip(),
        said.get("notes", "").strip(),
        tuple(map(str, _get(table, "claims", list, where, []))),
    )


def _question(text: str, where: str) -> Question:
    table = _table(text, QUESTION_KEYS, f"{where}: the question")
    answers = []
    for row in _get(table, "answers", list, where):
        if not isinstance(row, dict) or row.keys() - ANSWER_KEYS:
            raise InputError(f"{where}: an answer has text, shows, right and go, and nothing else.")
        go, right = _get(row, "go", str, where, ""), _get(row, "right", bool, where, False)
        answers.append(Answer(_get(row, "text", str, where), _get(row, "shows", str, where), right, go))
    if len(answers) < 2 or sum(answer.right for answer in answers) != 1:
        raise InputError(f"{where}: a question has two answers or more, of which one is right.")
    return Question(_get(table, "ask", str, where), tuple(answers))


def _table(text: str, keys: set[str], where: str) -> dict[str, Any]:
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{where}: is no TOML ({error}).") from None
    if unknown := sorted(table.keys() - keys):
        raise InputError(f"{where}: does not know {show(unknown[0])}; it takes {', '.join(sorted(keys))}.")
    return table


def _get(table: Mapping[str, Any], key: str, kind: Any, where: str, default: Any = None) -> Any:
    value = table.get(key, default)
    if value is None:
        raise InputError(f"{where}: lacks {key}.")
    if not isinstance(value, kind):
        raise InputError(f"{where}: {key} is {show(str(value))}, which is of another type.")
    return value


def changed_state(state: str, changes: str) -> str:
    """A state with changes to it, both as in the page's address: of ``set`` and ``option`` those of that name only.

    An empty value takes its key away, such as ``seed=`` or ``option=iterations%3D``.
    """
    pairs = state_parts(state) | state_parts(changes)
    return urlencode([(name.partition(".")[0] if name.partition(".")[0] in MANY else name, value)
                      for name, value in pairs.items() if value and not value.endswith("=")])  # fmt: skip


def state_parts(state: str) -> dict[str, str]:
    """Values of a state by key, such as ``seed``; those of ``MANY``, with their name, by ``set.outlier_rate``."""
    pairs: Sequence[tuple[str, str]] = parse_qsl(state, keep_blank_values=True)
    return {f"{key}.{value.partition('=')[0]}" if key in MANY else key: value for key, value in pairs}


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
        raise InputError(f"{registry.title(KIND, name)} must be the path of a file {name}.md; repair or uninstall it.")
    return read_lesson(Path(path))


def lesson_named(name: str) -> Lesson:
    """The lesson of this name; raises ``InputError`` that names those there are."""
    found = next((lesson for lesson in lessons() if lesson.name == name), None)
    if found is None:
        raise InputError(f"there is no lesson {show(name)}; there are {', '.join(one.name for one in lessons())}.")
    return found
