"""What lessons say is so: every state can be shown, and every statement is recomputed."""

import re

import pytest

from spherloc.errors import InputError
from spherloc_viz.app.linked_run import LinkedRuns
from spherloc_viz.layers import steps
from spherloc_viz.lessons import lessons
from spherloc_viz.lessons.claims import holds, split_claim
from spherloc_viz.lessons.html import FORMULA, changes_in, lesson_page, list_page, names_in
from spherloc_viz.lessons.lesson import changed_state, parse_lesson
from spherloc_viz.lessons.numbers import numbers_of

NUMBER = re.compile(r"(?<![\w.])\d[\d,]*(?:\.\d+)?")
LESSONS = lessons()


@pytest.fixture(scope="module")
def linked():
    runs = LinkedRuns()
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


@pytest.mark.parametrize("lesson", LESSONS, ids=lambda lesson: lesson.name)
def test_no_number_comes_from_nowhere(lesson):
    """A figure in the prose is in a statement that is recomputed, or quoted."""
    claimed = set(lesson.quoted)
    for moment in lesson.moments:
        for claim in moment.claims:
            found = re.findall(r"\d+(?:\.\d+)?", claim.replace("%3D", " "))
            claimed |= {float(number) for number in found} | {100 * float(number) for number in found}
    claimed = {round(number, 6) for number in claimed}
    for moment in lesson.moments:
        for text in texts(moment):
            plain = re.sub(r"\]\(#[^)]*\)|\{[^{}]*\}|`[^`]*`", " ", FORMULA.sub(" ", text))
            unknown = [one for one in NUMBER.findall(plain) if round(float(one.replace(",", "")), 6) not in claimed]
            assert not unknown, f"{moment.title}: nothing tells where {unknown} come from"


def test_pages_of_all_lessons_are_made():
    for lesson in LESSONS:
        page = lesson_page(lesson, LESSONS)
        assert page.count("<section") == len(lesson.moments)
        assert "$" not in re.sub(r"<script>.*?</script>|<style>.*?</style>", "", page, flags=re.DOTALL)
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
