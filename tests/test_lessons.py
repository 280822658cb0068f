"""What lessons say is so: every state can be shown, and every statement is recomputed."""

import re

import pytest

from spherloc.errors import InputError
from spherloc_viz import style
from spherloc_viz.app.lesson_file import LinkedRuns, images_of, images_picture
from spherloc_viz.layers import steps
from spherloc_viz.lessons import lesson_named, lessons
from spherloc_viz.lessons.html import FIELD, FORMULA, IMAGES, lesson_page, links_in, list_page, names_in, prose_html
from spherloc_viz.lessons.lesson import MANY, changed_state, parse_lesson, state_parts
from spherloc_viz.lessons.numbers import numbers_of
from tests.lesson_claims import holds, split_claim

NUMBER = re.compile(r"(?<![\w.])\d[\d,]*(?:\.\d+)?")
LESSONS = lessons()


@pytest.fixture(scope="module")
def runs():
    return LinkedRuns()


@pytest.fixture(scope="module")
def linked(runs):
    known = {}

    def numbers(state):
        """Numbers of a state's run, and the keys of its steps."""
        key = changed_state(state, "step=")
        if key not in known:
            trace = runs.run(state).run.trace
            known[key] = numbers_of(trace), {step.key for step in steps(trace)}
        return known[key]

    return numbers


def texts(moment):
    """Everything of a moment that is read."""
    said = [moment.prose, moment.after]
    if moment.question is not None:
        said += [moment.question.ask, *(part for one in moment.question.answers for part in (one.text, one.shows))]
    return said


def changes_in(text: str) -> tuple[str, ...]:
    """The changes of the state that a text offers: its links, and both ends of its sliders."""
    found = list(links_in(text))
    for words in FIELD.findall(text):
        kind, *rest = words.split(" ", 2)
        if kind == "slider":
            first, last, *_ = rest[1].split()
            found += [change_of(rest[0], first), change_of(rest[0], last)]
        elif kind == "choice":
            found += [change_of(rest[0], word) for word in rest[1].split("|")]
    return tuple(found)


def change_of(key: str, value: str) -> str:
    return changed_state("", f"{key.replace('.', '=', 1)}%3D{value}" if "." in key else f"{key}={value}")


def moments():
    return [pytest.param(lesson, moment, id=f"{lesson.name}-{k}")
            for lesson in LESSONS for k, moment in enumerate(lesson.moments)]  # fmt: skip


@pytest.mark.parametrize("lesson, moment", moments())
def test_a_moment_holds(linked, lesson, moment):
    """Its state and what it offers can be shown, the numbers in it exist, and its statements are true."""
    from urllib.parse import parse_qs

    offered = [change for text in texts(moment) for change in changes_in(text)]
    answers = () if moment.question is None else moment.question.answers
    for change in ("", moment.before, *offered, *(one.go for one in answers)):
        state = changed_state(moment.state, change)
        numbers, keys = linked(state)
        step = parse_qs(state).get("step", ["outcome"])[0]
        assert step in keys or change, f"{moment.title}: the run has no step {step}; it has {sorted(keys)}"
        if not change:
            missing = {name for text in [*texts(moment), moment.notes] for name in names_in(text)} - numbers.keys()
            assert not missing, f"{moment.title}: the run has no {missing}"
    for claim in moment.claims:
        changes, expression = split_claim(claim)
        runs = [linked(changed_state(moment.state, change))[0] for change in changes]
        assert holds(expression, runs), f"{moment.title}: {claim} does not hold of {runs[0]}"


def plain(text):
    """What of a text is prose: no formula, link, number of the run, control or code."""
    return re.sub(
        r"\]\(#[^)]*\)|\{[^{}]*\}|`[^`]*`|^```.*?^```", " ", FORMULA.sub(" ", text), flags=re.DOTALL | re.MULTILINE
    )


def known_numbers(moment):
    """Those in its claims and settings; shares as percentages, too; and how many seeds a claim is about."""
    answers = () if moment.question is None else moment.question.answers
    changes = [moment.state, *(changed_state("", one) for one in (moment.before, *(answer.go for answer in answers)))]
    settings = [value for state in changes for key, value in state_parts(state).items() if key.startswith(MANY)]
    found = [float(one) for text in (*moment.claims, *settings)
             for one in re.findall(r"\d+(?:\.\d+)?", text.replace("%3D", " "))]  # fmt: skip
    found += [float(len(split_claim(claim)[0])) for claim in moment.claims]
    return {round(number, 6) for number in found + [100 * one for one in found if one <= 1]}


@pytest.mark.parametrize("lesson", LESSONS, ids=lambda lesson: lesson.name)
def test_no_number_comes_from_nowhere(lesson):
    """A figure in a moment is in a statement about it that is recomputed, or its source is said."""
    spoken = set()
    everything = set().union(*map(known_numbers, lesson.moments))
    places = [(lesson.title, [lesson.title, lesson.summary, lesson.introduction], everything)]
    for moment in lesson.moments:
        places.append((moment.title, [moment.notes, *texts(moment)], known_numbers(moment)))
    for title, said, known in places:
        figures = [one.replace(",", "") for text in said for one in NUMBER.findall(plain(text))]
        unknown = [one for one in figures if round(float(one), 6) not in known | lesson.quoted.keys()]
        assert not unknown, f"{title}: nothing tells where {unknown} come from"
        spoken |= {float(one) for one in figures}
    assert lesson.quoted.keys() <= spoken, "a source is said for a number that the text does not have"


def test_formulas_of_numbers_are_true():
    """Such as 0.5^2 = 0.25; to the digits that are given."""
    checked = 0
    for moment in (moment for lesson in LESSONS for moment in lesson.moments):
        for text in texts(moment):
            for formula in ("".join(found) for found in FORMULA.findall(text)):
                left, equals, right = formula.replace("\\cdot", "*").replace("^", "**").partition("=")
                if equals and re.fullmatch(r"[\d.*/+() -]+", left):
                    digits = len(right.strip().partition(".")[2])
                    assert holds(f"round({left}, {digits}) == {right}", [{}]), f"{moment.title}: {formula}"
                    checked += 1
    assert checked >= 5


def test_the_images_of_a_moment_are_seen(runs):
    lesson = next(one for one in LESSONS if one.name == "images")
    night = lesson.moments[2]
    assert f"{IMAGES}?{night.state.replace('&', '&amp;')}" in lesson_page(lesson, LESSONS)
    assert IMAGES not in {f"/learn/{one.name}" for one in LESSONS}
    picture = images_of(runs, night.state)
    assert picture.count('<image href="data:image/jpeg;base64,') == 2
    assert f'stroke="{style.css(style.INLIER)}"' in picture
    with pytest.raises(InputError, match="no lesson shows"):
        images_picture(changed_state(night.state, "seed=5"))


def test_pages_of_all_lessons_are_made():
    for lesson in LESSONS:
        page = lesson_page(lesson, LESSONS)
        assert page.count("<section") == len(lesson.moments)
        assert "$" not in re.sub(r"<script>.*?</script>|<style>.*?</style>", "", page, flags=re.DOTALL)
        following = re.search(r'<p class="onward"><a href="/learn/([^"]*)">', page)
        assert following is None or not lesson_named(following[1]).lecture
    assert '<span class="whole">--camera</span> ' in lesson_page(lesson_named("your-camera"), LESSONS)
    assert re.search(r'<span class="whole"><math.*</math>,</span> with', prose_html("It is $w^2$, with the share", ""))
    assert prose_html("Half of 4 m, {off_cm} cm {slider seed 1 2 1 %}", "seed=1").count("\N{NO-BREAK SPACE}") == 2
    assert len(set(LESSONS)) == len(LESSONS), "their pictures are kept by lesson"
    listed = list_page(LESSONS, "/p/")
    assert all(f"/learn/{lesson.name}" in listed for lesson in LESSONS)


GOOD = """+++
title = "T"
summary = "S."
+++
## One
```moment
state = "seed=1"
claims = ["matches == 7"]
```
Text.
"""


@pytest.mark.parametrize(
    "old, new, said",
    [
        ("+++", "---", "begins with TOML"),
        ("title", "titel", "does not know 'titel'"),
        ("## One", "One", "no moment"),
        ("state", "stade", "does not know 'stade'"),
        ("Text.", "```question\nask = 'Q'\nanswers = [{text = 'a', shows = 'b'}]\n```", "one is right"),
    ],
)
def test_a_wrong_lesson_is_named(old, new, said):
    with pytest.raises(InputError, match=said):
        parse_lesson(GOOD.replace(old, new), "t", "t.md")


def test_claims_that_do_not_hold_or_cannot_be_understood_are_noticed(linked):
    numbers, _ = linked(LESSONS[0].moments[0].state)
    assert not holds("matches == 7", [numbers])
    for claim in ("matches", "nothing == 1", "__import__('os') == 1", "matches.real == 1"):
        with pytest.raises(InputError):
            holds(claim, [numbers])
