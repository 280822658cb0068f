"""Lessons as HTML: the list of all, the page with a lesson's prose beside the scene, and the hand-out."""

import re
from base64 import b64encode
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import cache
from html import escape, unescape
from pathlib import Path
from string import Template

from latex2mathml.converter import convert
from markdown_it import MarkdownIt

from spherloc.errors import InputError, show
from spherloc_viz import style
from spherloc_viz.lessons.lesson import Lesson, Moment, Question, changed_state, state_parts

FORMULA = re.compile(r"\$\$(.+?)\$\$|\$(.+?)\$", re.DOTALL)
FIELD = re.compile(r"\{([^{}]+)\}")
LINK = re.compile(r'<a href="#([^"]*)">')
CODE = re.compile(r"(?<!<pre>)<code>([^<]*)</code>")
HYPHENED = re.compile(r"[^ ]*-[^ ]*")
"""A word that a browser would break after its hyphens: a command that begins its options with them is read wrongly."""
NBSP = "\N{NO-BREAK SPACE}"
UNIT = re.compile(r"(?<=[\d}]) (?=(?:px|cm|m|km|%)(?![a-z]))(?![^{]*\})")
"""The space between a number, or the field of one, and its unit, where no line should end."""
MARK, END = "\ue000", "\ue001"
"""Around the number of a formula while Markdown is read, which would take its signs for its own."""
PERCENT = "%"
PAIR = "images"
"""Field of the query and the reference image with their matches."""
IMAGES = "/learn/matched-images"
"""Address of such a picture, before its state."""


@dataclass(frozen=True)
class Form:
    """What of a lesson works where it is shown."""

    number: Callable[[str], str]
    """HTML for a number of the run, by its name."""
    state: Callable[[str], str]
    """What the page's script calls a state."""
    change: Callable[[str, str], str]
    """What it calls changes, the second, to a state, the first; empty if it cannot show them."""
    controls: bool
    """Whether sliders, choices and links to the playground work."""
    images: Callable[[str], str] = lambda state: f"{IMAGES}?{state}"
    """Address of the picture of a state's images."""
    setting: Callable[[str, str], str] = lambda key, shown: f"<b>{escape(shown)}</b>"
    """HTML in place of a control, by its key and its value, as it is shown."""


def live_number(name: str) -> str:
    """A place that the page's script fills with a number of the run on the canvas."""
    return f'<output data-number="{name}">…</output>'


LIVE = Form(live_number, lambda state: state, lambda state, changes: changes, controls=True)
"""Form of a lesson beside the playground, with live numbers and controls."""


def printed(numbers: Mapping[str, str], images: Callable[[str], str]) -> Form:
    """On paper, with these numbers."""
    return Form(
        lambda name: f"<b>{escape(numbers[name])}</b>", lambda state: "", lambda state, changes: "", False, images
    )


@cache
def text_of(name: str) -> str:
    """A file of this folder: the scripts and the style of the pages."""
    return Path(__file__).with_name(name).read_text(encoding="utf-8")


@cache
def _markdown() -> MarkdownIt:
    return MarkdownIt("commonmark", {"html": False}).enable("table")


def prose_html(text: str, state: str, form: Form = LIVE) -> str:
    """Markdown of a lesson as HTML; without controls sliders are their value, and links may be their words.

    Raises ``InputError`` for a field that is neither a number nor a control.
    """
    formulas: list[str] = []

    def keep(found: re.Match[str]) -> str:
        formulas.append(convert(found[1] or found[2], display="block" if found[1] else "inline"))
        return f"{MARK}{len(formulas) - 1}{END}"

    html = _markdown().render(FORMULA.sub(keep, text))
    html = CODE.sub(lambda found: f"<code>{HYPHENED.sub(_whole, found[1])}</code>", html)
    html = LINK.sub(lambda found: _link(unescape(found[1]), state, form), html)
    html = FIELD.sub(lambda found: _field(unescape(found[1]), state, form), UNIT.sub(NBSP, html))
    html = re.sub(f"{MARK}\\d+{END}[,.;:?!)]+", _whole, html)  # no line begins with what follows a formula
    return re.sub(f"{MARK}(\\d+){END}", lambda found: formulas[int(found[1])], html)


def names_in(text: str) -> set[str]:
    """Names of the numbers of the run that a text has."""
    return {name for name in FIELD.findall(FORMULA.sub("", text)) if " " not in name and name != PAIR}


def settings_in(text: str) -> dict[str, bool]:
    """Keys of the controls that a text has, and whether they are shown as percentages."""
    fields = [words.split() for words in FIELD.findall(FORMULA.sub("", text)) if " " in words]
    return {key: more[-1] == PERCENT for _, key, *more in fields}


def setting_text(value: str, percent: bool) -> str:
    """A value of a state as prose has it."""
    return f"{100 * float(value):.0f} %" if percent else value


def has_images(moment: Moment) -> bool:
    """Whether a moment shows its images."""
    return any(PAIR in FIELD.findall(text) for text in (moment.prose, moment.after))


def links_in(text: str) -> tuple[str, ...]:
    """The changes of the state that the links of a text make."""
    return tuple(unescape(changes) for changes in LINK.findall(_markdown().render(text)))


def _whole(word: re.Match[str]) -> str:
    return f'<span class="whole">{word[0]}</span>'


def _link(changes: str, state: str, form: Form) -> str:
    said = form.change(state, changes)
    if not said:
        return '<a class="still">'
    where = f"/#{escape(changed_state(state, changes))}" if form.controls else "#"
    return f'<a href="{where}" data-change="{escape(said)}">'


def _field(words: str, state: str, form: Form) -> str:
    kind, *rest = words.split(" ", 2)
    if kind == PAIR and not rest:
        alt = "The query and a reference image with their matches"
        later = ' loading="lazy"' if form.controls else ""  # paper may be printed before anybody scrolls
        return f'<img class="pair" src="{escape(form.images(state))}" alt="{alt}"{later}>'
    if not rest:
        return form.number(kind)
    key = rest[0]
    value = state_parts(state).get(key, "").partition("=")[2] if "." in key else state_parts(state).get(key, "")
    if kind == "choice" and len(rest) == 2:
        if not form.controls:
            return form.setting(key, value)
        options = "".join(
            f"<option{' selected' * (word == value)}>{escape(word)}</option>" for word in rest[1].split("|")
        )
        return f'<select data-key="{escape(key)}" aria-label="{escape(key)}">{options}</select>'
    if kind == "slider" and len(rest) == 2:
        first, last, step, *unit = rest[1].split()
        percent = unit == [PERCENT]
        if not value:
            raise InputError(f"the slider of {show(key)} needs a state that says {show(key)}.")
        shown = setting_text(value, percent)
        if not form.controls:
            return form.setting(key, shown)
        name = key.rpartition(".")[2].replace("_", " ")
        return (
            f'<span class="slider"><input type="range" min="{first}" max="{last}" step="{step}" value="{value}" '
            f'data-key="{escape(key)}"{" data-percent" * percent} aria-label="{escape(name)}"><b>{shown}</b></span>'
        )
    raise InputError(f"the text has {show('{' + words + '}')}, which is neither a number nor a control; correct it.")


def _inline(text: str, state: str, form: Form) -> str:
    return prose_html(text, state, form).removeprefix("<p>").removesuffix("</p>\n")


def _question_html(question: Question, state: str, form: Form) -> str:
    answers = []
    for place, answer in enumerate(question.answers):
        mark = "right" if answer.right else "wrong"
        go = f' data-go="{escape(form.change(state, answer.go))}"' if answer.go else ""
        answers.append(
            f'<li class="{mark}"{go} data-answer="{place}"><button type="button" aria-expanded="false">'
            f'{_inline(answer.text, state, form)}<span class="votes"></span></button>'
            f'<div class="shows">{prose_html(answer.shows, state, form)}</div></li>'
        )
    return (
        f'<div class="question"><div class="ask">{prose_html(question.ask, state, form)}</div>'
        f'<ol class="answers">{"".join(answers)}</ol>'
        '<button type="button" class="reveal">Show the answer</button></div>'
    )


def _notes_html(moment: Moment, form: Form) -> str:
    notes = prose_html(moment.notes, moment.state, form)
    return f'<aside class="notes"><h3>For the teacher · {moment.minutes:g} min</h3>{notes}</aside>'


def moment_html(moment: Moment, place: int, form: Form = LIVE) -> str:
    """A moment as a section beside a scene."""
    state = moment.state
    parts = [f"<h2>{escape(moment.title)}</h2>", prose_html(moment.prose, state, form)]
    after = prose_html(moment.after, state, form)
    if moment.question is not None:
        parts.append(_question_html(moment.question, state, form))
        after = f'<div class="after">{after}</div>'
    parts.append(after)
    if moment.notes:
        parts.append(_notes_html(moment, form))
    if form.controls:
        parts.append(f'<p class="open"><a href="/#{escape(state)}" target="_blank">Open in the playground</a></p>')
    before = ""
    if moment.before:
        before = f' data-before="{escape(form.state(changed_state(state, moment.before)))}"'
    return (
        f'<section id="moment-{place}" data-state="{escape(form.state(state))}"{before} tabindex="-1">'
        f"{''.join(parts)}</section>"
    )


def lesson_page(lesson: Lesson, others: Collection[Lesson]) -> str:
    """The live page of a lesson; ``others`` are all lessons, by their order. No lesson leads on to a lecture."""
    course = list(others)
    place = [one.name for one in course].index(lesson.name)
    following = next((one for one in course[place + 1 :] if not one.lecture), None)
    onward = (
        f'<a href="/learn/{following.name}">Next lesson: {escape(following.title)}</a>'
        if following
        else '<a href="/learn">All lessons</a>'
    )
    bar = Template(text_of("live_bar.html")).substitute(name=escape(lesson.name))
    forms = [LIVE] * len(lesson.moments)
    return _lesson_html(lesson, forms, bar, onward, "", text_of("live.js") + text_of("lesson.js"))


def exported_page(lesson: Lesson, forms: Collection[Form], data: str) -> str:
    """The page of a lesson as a file: a form for each moment, and ``data``, HTML with what the script shows."""
    bar = '<span class="dim">A recorded lesson of <i>spherloc</i></span>'
    onward = '<span class="dim">In the playground this lesson has sliders, and any scene can be changed.</span>'
    return _lesson_html(lesson, forms, bar, onward, data, text_of("recorded.js") + text_of("lesson.js"))


def _lesson_html(lesson: Lesson, forms: Collection[Form], bar: str, onward: str, data: str, script: str) -> str:
    both = zip(lesson.moments, forms, strict=True)
    return _page(
        "lesson.html",
        title=escape(lesson.title),
        summary=escape(lesson.summary),
        minutes=str(lesson.minutes),
        introduction=prose_html(lesson.introduction, ""),
        sections="".join(moment_html(moment, place, form) for place, (moment, form) in enumerate(both)),
        bar=bar,
        onward=onward,
        count=str(len(lesson.moments)),
        legend=_legend(),
        data=data,
        script=script,
    )


@dataclass(frozen=True)
class Sheet:
    """What a moment has on paper."""

    numbers: Mapping[str, str]
    """Numbers of the moment's run, after the right answer if it has a question, as text."""
    picture: str
    """The scene of that run, SVG."""
    asked_numbers: Mapping[str, str]
    """Numbers of the run that is shown until the question is answered."""
    asked_picture: str
    """The scene until then."""


def right_changes(moment: Moment) -> str:
    """What the right answer of a moment changes of its state; empty without a question."""
    return "" if moment.question is None else next(one.go for one in moment.question.answers if one.right)


def handout_page(lesson: Lesson, sheets: Collection[Sheet], images: Callable[[str], str]) -> str:
    """A lesson to be printed. What is told once a question is answered stands with the answers, on the last pages;
    ``images`` is as in ``Form``."""
    parts, solutions = [], []
    for place, (moment, sheet) in enumerate(zip(lesson.moments, sheets, strict=True), 1):
        title, state, question = escape(moment.title), moment.state, moment.question
        form, told = printed(sheet.asked_numbers, images), printed(sheet.numbers, images)
        parts.append(f"<section><h2>{place}. {title}</h2>{_figure(sheet.asked_picture, title)}")
        parts.append(prose_html(moment.prose, state, form))
        answered = changed_state(state, right_changes(moment))
        after = prose_html(moment.after, answered, told)
        if question is not None:
            answers = "".join(f"<li>☐ {_inline(answer.text, state, form)}</li>" for answer in question.answers)
            asked = prose_html(question.ask, state, form)
            parts.append(f'<div class="question">{asked}<ol class="answers">{answers}</ol></div>')
            told_why = "".join(
                f"<li>{'✓' if answer.right else '✗'} <b>{_inline(answer.text, state, told)}.</b> "
                f"{_inline(answer.shows, answered, told)}</li>"
                for answer in question.answers
            )
            figure = _figure(sheet.picture, title) if sheet.picture != sheet.asked_picture else ""
            solutions.append(
                f'<section><h3>{place}. {title}</h3><ul class="answers">{told_why}</ul>{figure}{after}</section>'
            )
            after = ""
        parts.append(f"{after}</section>")
    if solutions:
        parts.append(f'<div class="solutions"><h2>Answers</h2>{"".join(solutions)}</div>')
    return _page(
        "handout.html",
        title=escape(lesson.title),
        summary=escape(lesson.summary),
        introduction=prose_html(lesson.introduction, ""),
        sections="".join(parts),
        legend=_legend(),
    )


def _figure(picture: str, title: str) -> str:
    return f'<figure role="img" aria-label="The scene of {title}">{picture}</figure>'


def _legend() -> str:
    rows = "".join(
        f'<li><i style="background:{style.css(color)}"></i>{escape(words)}</li>'
        for color, words in style.LEGEND
        if color != style.SELECTED
    )
    return f'<ul class="legend" aria-label="Colours">{rows}</ul>'


def notes_page(lesson: Lesson) -> str:
    """What only the teacher sees, in a window of its own: notes, time and answers, which follow the lesson's page."""
    rows, minute = [], 0.0
    for place, moment in enumerate(lesson.moments):
        form = Form(lambda name: f'<output data-number="{name}">…</output>', str, lambda state, changes: "", False)
        right = ""
        if moment.question is not None:
            answer = next(one for one in moment.question.answers if one.right)
            right = (
                f'<p><b>Answer:</b> {_inline(answer.text, moment.state, form)} <span class="votes"></span></p>'
                '<button type="button" data-press="reveal">Show the answer to the class</button>'
            )
        when = f"minute {minute:g} to {minute + moment.minutes:g}"
        notes = prose_html(moment.notes, moment.state, form)
        rows.append(
            f'<li data-place="{place}" data-ends="{minute + moment.minutes:g}"><h2><button type="button" '
            f'data-press="go:{place}">{place + 1}. {escape(moment.title)}</button></h2>'
            f'<p class="dim">{when}</p>{notes}{right}</li>'
        )
        minute += moment.minutes
    return _page(
        "notes.html",
        title=escape(lesson.title),
        minutes=f"{minute:g}",
        rows="".join(rows),
        script=text_of("notes.js"),
    )


def list_page(course: Collection[Lesson], pictures: str) -> str:
    """The list of all lessons; ``pictures`` is the address of images, which have the names of lessons."""
    rows: dict[bool, list[str]] = {False: [], True: []}
    for lesson in course:
        image = f'<img src="{pictures}{escape(lesson.name)}" alt="" loading="lazy">'
        rows[lesson.lecture].append(
            f'<li><a href="/learn/{escape(lesson.name)}">{image}<div><h2>{escape(lesson.title)}</h2>'
            f"<p>{UNIT.sub(NBSP, escape(lesson.summary))}</p>"
            f"<p class='dim'>{len(lesson.moments)} parts, about {lesson.minutes} min</p></div></a></li>"
        )
    return _page("list.html", lessons="".join(rows[False]), lectures="".join(rows[True]))


def teacher_page(course: Collection[Lesson]) -> str:
    """How to teach with the lessons: the lecture moment by moment with its timing, and what each lesson has."""
    lectures, rows = [], []
    for lesson in course:
        name, title = escape(lesson.name), escape(lesson.title)
        if lesson.lecture:
            lectures.append(_timetable(lesson))
        asked = sum(moment.question is not None for moment in lesson.moments)
        rows.append(
            f'<tr><td><a href="/learn/{name}">{title}</a></td><td class="when">{lesson.minutes} min</td>'
            f"<td>{asked}</td>"
            f'<td><a href="/learn/{name}/notes">notes</a></td>'
            f'<td><a href="/learn/{name}/handout">paper</a></td></tr>'
        )
    return _page("teacher.html", lectures="".join(lectures), rows="".join(rows))


def _timetable(lesson: Lesson) -> str:
    name, minute, rows = escape(lesson.name), 0.0, []
    for place, moment in enumerate(lesson.moments):
        notes = prose_html(moment.notes, moment.state, Form(lambda name: "…", str, lambda state, changes: "", False))
        rows.append(
            f'<tr><td class="when">{minute:g}–{minute + moment.minutes:g} min</td>'
            f'<td><a href="/learn/{name}#m{place}"><b>{escape(moment.title)}</b></a>{notes}</td></tr>'
        )
        minute += moment.minutes
    return (
        f'<h2><a href="/learn/{name}">{escape(lesson.title)}</a></h2>'
        f"<p>{escape(lesson.summary)} {minute:g} minutes.</p>"
        f'<table class="timetable">{"".join(rows)}</table>'
    )


def _page(name: str, **values: str) -> str:
    page = Template(text_of(name)).substitute(values, style=text_of("lesson.css"))
    return page.replace("<style>", f"<style>{_font()}", 1) if "<math" in page else page


@cache
def _font() -> str:
    """The font of formulas, with the measures by which a browser sets them: many machines have none that has them."""
    font = Path(__file__).with_name("font").joinpath("formulas.woff2").read_bytes()
    return f"@font-face{{font-family:formulas;src:url(data:font/woff2;base64,{b64encode(font).decode()})}}\n"
