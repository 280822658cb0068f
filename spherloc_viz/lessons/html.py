"""Lessons as HTML: the list of all, and the page with a lesson's prose beside the live canvas."""

import re
from collections.abc import Callable, Collection, Mapping
from functools import cache
from html import escape, unescape
from pathlib import Path
from string import Template

from latex2mathml.converter import convert
from markdown_it import MarkdownIt

from spherloc.errors import InputError, show
from spherloc_viz.lessons.lesson import Lesson, Moment, Question, changed_state, state_parts

FORMULA = re.compile(r"\$\$(.+?)\$\$|\$(.+?)\$", re.DOTALL)
FIELD = re.compile(r"\{([^{}]+)\}")
LINK = re.compile(r'<a href="#([^"]*)">')
MARK, END = "\ue000", "\ue001"
"""Around the number of a formula while Markdown is read, which would take its signs for its own."""
PERCENT = "%"

NumberOf = Callable[[str], str]
"""What stands for a number of the run, by its name."""


@cache
def text_of(name: str) -> str:
    """A file of this folder: the script and the style of the pages."""
    return Path(__file__).with_name(name).read_text(encoding="utf-8")


@cache
def _markdown() -> MarkdownIt:
    return MarkdownIt("commonmark", {"html": False}).enable("table")


def live_number(name: str) -> str:
    """A place that the page's script fills with a number of the run on the canvas."""
    return f'<output data-number="{name}">…</output>'


def prose_html(text: str, state: str, number: NumberOf = live_number, live: bool = True) -> str:
    """Markdown of a lesson as HTML; where it is not ``live``, sliders are their value and links their words.

    Raises ``InputError`` for a field that is neither a number nor a control.
    """
    formulas: list[str] = []

    def keep(found: re.Match[str]) -> str:
        formulas.append(convert(found[1] or found[2], display="block" if found[1] else "inline"))
        return f"{MARK}{len(formulas) - 1}{END}"

    html = _markdown().render(FORMULA.sub(keep, text))
    html = LINK.sub(lambda found: _link(unescape(found[1]), state, live), html)
    html = FIELD.sub(lambda found: _field(unescape(found[1]), state, number, live), html)
    return re.sub(f"{MARK}(\\d+){END}", lambda found: formulas[int(found[1])], html)


def names_in(text: str) -> set[str]:
    """Names of the numbers of the run that a text has."""
    return {name for name in FIELD.findall(FORMULA.sub("", text)) if " " not in name}


def changes_in(text: str) -> tuple[str, ...]:
    """The changes of the state that a text offers: its links, and both ends of its sliders."""
    found = [unescape(changes) for changes in LINK.findall(_markdown().render(text))]
    for words in FIELD.findall(text):
        kind, *rest = words.split(" ", 2)
        if kind == "slider":
            first, last, *_ = rest[1].split()
            found += [_change(rest[0], first), _change(rest[0], last)]
        elif kind == "choice":
            found += [_change(rest[0], word) for word in rest[1].split("|")]
    return tuple(found)


def _change(key: str, value: str) -> str:
    return changed_state("", f"{key.replace('.', '=', 1)}%3D{value}" if "." in key else f"{key}={value}")


def _link(changes: str, state: str, live: bool) -> str:
    if not live:
        return '<a class="still">'
    return f'<a href="/#{escape(changed_state(state, changes))}" data-change="{escape(changes)}">'


def _field(words: str, state: str, number: NumberOf, live: bool) -> str:
    kind, *rest = words.split(" ", 2)
    if not rest:
        return number(kind)
    key = rest[0]
    value = state_parts(state).get(key, "").partition("=")[2] if "." in key else state_parts(state).get(key, "")
    if kind == "choice" and len(rest) == 2:
        if not live:
            return f"<b>{escape(value)}</b>"
        options = "".join(
            f"<option{' selected' * (word == value)}>{escape(word)}</option>" for word in rest[1].split("|")
        )
        return f'<select data-key="{escape(key)}" aria-label="{escape(key)}">{options}</select>'
    if kind == "slider" and len(rest) == 2:
        first, last, step, *unit = rest[1].split()
        percent = unit == [PERCENT]
        if not value:
            raise InputError(f"the slider of {show(key)} needs a state that says {show(key)}.")
        shown = f"{100 * float(value):.0f} %" if percent else value
        if not live:
            return f"<b>{shown}</b>"
        name = key.rpartition(".")[2].replace("_", " ")
        return (
            f'<span class="slider"><input type="range" min="{first}" max="{last}" step="{step}" value="{value}" '
            f'data-key="{escape(key)}"{" data-percent" * percent} aria-label="{escape(name)}"><b>{shown}</b></span>'
        )
    raise InputError(f"the text has {show('{' + words + '}')}, which is no number and no control.")


def _question_html(question: Question, state: str, number: NumberOf, live: bool) -> str:
    answers = []
    for place, answer in enumerate(question.answers):
        said = prose_html(answer.shows, state, number, live)
        mark = "right" if answer.right else "wrong"
        text = prose_html(answer.text, state, number, live).removeprefix("<p>").removesuffix("</p>\n")
        head = (
            f'<button type="button" aria-expanded="false">{text}<span class="votes"></span></button>'
            if live
            else f"<p><b>{text}</b></p>"
        )
        go = f' data-go="{escape(answer.go)}"' if answer.go else ""
        answers.append(f'<li class="{mark}"{go} data-answer="{place}">{head}<div class="shows">{said}</div></li>')
    ask = prose_html(question.ask, state, number, live)
    reveal = '<button type="button" class="reveal">Show the answer</button>' if live else ""
    listed = f'<ol class="answers">{"".join(answers)}</ol>'
    if not live:
        listed = f"<details><summary>Predict first; then open the answers</summary>{listed}</details>"
    return f'<div class="question"><div class="ask">{ask}</div>{listed}{reveal}</div>'


def moment_html(moment: Moment, place: int, number: NumberOf = live_number, picture: str = "") -> str:
    """A moment as a section; with the address of a ``picture`` it is a still one, without controls."""
    live = not picture
    state = moment.state
    parts = [f"<h2>{escape(moment.title)}</h2>"]
    if picture:
        parts.append(f'<img src="{picture}" alt="The scene at the moment: {escape(moment.title)}">')
    parts.append(prose_html(moment.prose, state, number, live))
    after = prose_html(moment.after, state, number, live)
    if moment.question is not None:
        parts.append(_question_html(moment.question, state, number, live))
        after = (
            f'<div class="after">{after}</div>'
            if live
            else f"<details><summary>What follows</summary>{after}</details>"
        )
    parts.append(after)
    if moment.notes:
        notes = prose_html(moment.notes, state, number, live)
        parts.append(f'<aside class="notes"><h3>For the teacher · {moment.minutes:g} min</h3>{notes}</aside>')
    if live:
        parts.append(f'<p class="open"><a href="/#{escape(state)}" target="_blank">Open in the playground</a></p>')
    before = f' data-before="{escape(changed_state(state, moment.before))}"' if moment.before else ""
    return f'<section id="moment-{place}" data-state="{escape(state)}"{before} tabindex="-1">{"".join(parts)}</section>'


def lesson_page(lesson: Lesson, others: Collection[Lesson]) -> str:
    """The live page of a lesson; ``others`` are those of the course, by their order."""
    course = list(others)
    place = [one.name for one in course].index(lesson.name)
    following = course[place + 1] if place + 1 < len(course) else None
    onward = (
        f'<a href="/learn/{following.name}">Next lesson: {escape(following.title)}</a>'
        if following
        else '<a href="/learn">All lessons</a>'
    )
    sections = "".join(moment_html(moment, number) for number, moment in enumerate(lesson.moments))
    return _page(
        "lesson.html",
        title=escape(lesson.title),
        summary=escape(lesson.summary),
        minutes=str(lesson.minutes),
        introduction=prose_html(lesson.introduction, ""),
        sections=sections,
        onward=onward,
        first=escape(_first_state(lesson)),
        count=str(len(lesson.moments)),
        script=text_of("lesson.js"),
    )


def _first_state(lesson: Lesson) -> str:
    first = lesson.moments[0]
    return changed_state(first.state, first.before)


def list_page(course: Collection[Lesson], pictures: Mapping[str, str]) -> str:
    """The list of all lessons; ``pictures`` are addresses of images by the name of a lesson."""
    rows = []
    for lesson in course:
        picture = pictures.get(lesson.name)
        image = f'<img src="{picture}" alt="">' if picture else '<div class="blank"></div>'
        rows.append(
            f'<li><a href="/learn/{escape(lesson.name)}">{image}<div><h2>{escape(lesson.title)}</h2>'
            f"<p>{escape(lesson.summary)}</p><p class='dim'>{len(lesson.moments)} moments, about {lesson.minutes} min"
            "</p></div></a></li>"
        )
    return _page("list.html", rows="".join(rows))


def _page(name: str, **values: str) -> str:
    return Template(text_of(name)).substitute(values, style=text_of("lesson.css"))
