"""Lessons as files, the teacher's pages, and lessons of other packages."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from spherloc_viz import style
from spherloc_viz.app.lesson_file import MAX_BYTES_OF_FILE, exported, handout_of, recorded_states
from spherloc_viz.app.stage.flat_picture import svg
from spherloc_viz.app.stage.still_page import Still, scripts_in
from spherloc_viz.layers.frame import one_color
from spherloc_viz.layers.primitives import Balls, Points
from spherloc_viz.lessons import lesson_named, lessons
from spherloc_viz.lessons.html import list_page, notes_page, teacher_page
from spherloc_viz.lessons.lesson import changed_state
from tests.cli_process import spherloc_here
from tests.installed import install, spherloc_each


@pytest.fixture(scope="module")
def page() -> str:
    return exported(lesson_named("yaw-arcs"), lambda words: None)


def part(page: str, name: str) -> str:
    """The data of an exported page by their name."""
    found = re.search(f'<script type="application/json" id="{name}">(.*?)</script>', page, re.DOTALL)
    assert found is not None, name
    return found[1]


def test_an_exported_lesson_has_all_of_its_scenes_and_no_dead_control(page: str) -> None:
    lesson = lesson_named("yaw-arcs")
    states = recorded_states(lesson)
    assert changed_state(lesson.moments[1].state, "step=yaw-arcs-10") in states
    for place in range(len(states)):
        assert part(page, f"scene-{place}").startswith('window.__VISER_EMBED_DATA__="')
    body = re.sub(r"<script.*?</script>|<style.*?</style>", "", page, flags=re.DOTALL)
    assert not re.search(r'<input|<select|data-press="(views|notes)"|href="/', body)
    assert set(re.findall(r'data-(?:state|before|go|change)="([^"]*)"', body)) == {
        f"at={place}" for place in range(len(states))
    }
    numbers = json.loads(part(page, "numbers"))
    assert numbers[str(states.index(changed_state(lesson.moments[1].state, "")))]["pairs_at_yaw"] == "218"
    assert ">218</output>" in body and ">90 %</b>" in body, "numbers and settings stand there without the script"
    assert len(page.encode()) < MAX_BYTES_OF_FILE


def test_in_an_exported_lesson_a_setting_follows_the_scene() -> None:
    lesson = lesson_named("ransac")
    page, moment = exported(lesson, lambda words: None), lesson.moments[1]
    states, numbers = recorded_states(lesson), json.loads(part(page, "numbers"))
    for changes, percent, samples in (("", "60 %", "40"), ("set=outlier_rate%3D0.8", "80 %", "170")):
        shown = numbers[str(states.index(changed_state(moment.state, changes)))]
        assert (shown["set.outlier_rate"], shown["samples_needed"]) == (percent, samples)
    assert '<b data-number="set.outlier_rate">60 %</b>' in page


def test_an_exported_lesson_uses_no_network(page: str) -> None:
    policy = re.search(r'Content-Security-Policy" content="([^"]+)"', page)
    assert policy is not None
    rules = dict(rule.split(" ", 1) for rule in policy[1].split("; "))
    assert rules["default-src"] == "'none'" and rules["connect-src"] == "data: blob:" and "http" not in policy[1]
    hashes = rules["script-src"].count("'sha256-")
    viewer = json.loads(part(page, "viewer"))
    assert hashes == len(scripts_in(page)) + len(scripts_in(viewer)) + len(recorded_states(lesson_named("yaw-arcs")))


def test_a_hand_out_has_numbers_pictures_and_the_answers_at_its_end() -> None:
    html = handout_of(lesson_named("yaw-arcs"))
    assert html.count("<circle") > 4 * 100 and "<output" not in html and "<input" not in html
    questions, answers = html.split("<h2>Answers</h2>")
    assert questions.count("<figure") == 4 and answers.count("<figure") == 2
    assert "☐ Yes: right pairs" in questions and "✓ <b>Yes: right pairs" in answers
    assert "<b>183</b>" in answers and "<b>183</b>" not in questions, "what follows a question is told with its answer"
    label = ">maximum clique of arcs</text>"
    assert label in answers and label not in questions, "so is its picture"
    assert "For the teacher" not in html


def test_the_answers_of_a_hand_out_are_those_of_the_run_after_the_right_answer() -> None:
    answers = handout_of(lesson_named("your-camera")).split("<h2>Answers</h2>")[1]
    told = re.search(r"with the answer that you chose, is <b>([^<]*)</b>", answers)
    assert told is not None and told[1] == "a success"
    assert "<figure" in answers[told.start() - 300_000 : told.start()]
    answers = handout_of(lesson_named("ransac")).split("<h2>Answers</h2>")[1]
    assert re.search(r"With <b>80 %</b> wrong matches.{0,900}<b>170</b></strong> samples", answers, re.DOTALL)


def test_on_paper_the_camera_is_drawn_over_the_balls_around_it() -> None:
    balls = Balls("balls", "balls", np.zeros((50, 3)), np.ones(50), one_color(style.CLIQUE, 50), 0.3)
    camera = Points("camera", "poses", np.array([[0.5, 0.0, 0.0]]), one_color(style.TRUTH, 1), 0.1)
    origin, forward, up = np.zeros(3), np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
    shown = svg(Still("", "", (camera, balls), None, np.eye(3), -5.0 * forward, origin, up, 1.0, False))
    circles = re.findall("<circle[^>]*>", shown)
    assert len(circles) == 51
    assert f'fill="{style.css(style.TRUTH)}"' in circles[-1], "although it is farther away than their centres"
    opacity = float(re.findall(r'fill-opacity="([^"]+)"', circles[0])[0])
    assert 0.6 < 1.0 - (1.0 - opacity) ** 50 < 0.8, "one sees through all of them together"


def test_the_teacher_is_told_the_timing() -> None:
    lecture = lesson_named("lecture")
    assert sum(moment.minutes for moment in lecture.moments) == 20
    guide, notes = teacher_page(lessons()), notes_page(lecture)
    assert "0–2 min" in guide and "17–20 min" in guide and "#m7" in guide
    assert "minute 17 to 20" in notes and notes.count('data-press="reveal"') == 3
    assert all(moment.notes for moment in lecture.moments)
    assert list_page(lessons(), "/p/").index("For a class") < list_page(lessons(), "/p/").index("/learn/lecture")


def test_the_command_says_what_is_wrong(tmp_path: Path) -> None:
    done = spherloc_here("lesson", cwd=tmp_path)
    assert done.returncode == 0 and len(done.stdout.splitlines()) == len(lessons())
    for words, said in (
        (("lesson", "nothing"), "there is no lesson 'nothing'"),
        (("lesson", "ransac", "--export", str(tmp_path / "no" / "x.html")), "is not a folder"),
        (("lesson", "--export", "x.html"), "name the lesson"),
    ):
        done = spherloc_here(*words, cwd=tmp_path)
        assert done.returncode == 2 and said in done.stderr and done.stderr.count("\n") == 1


LESSON = """+++
title = "A lesson of others"
summary = "One moment."
+++
## One
```moment
state = "scene=panorama%2C+80+%25+outliers&seed=1&estimator=mc&step=outcome"
```
Of {matches} matches {right} are right.
"""


def test_lessons_of_other_packages_are_found_and_broken_ones_are_named(tmp_path: Path) -> None:
    points = {
        "others": "my_lessons:GOOD",
        "broken": "my_lessons:BROKEN",
        "ransac": "my_lessons:GOOD",
        "odd": "json:loads",
    }
    module = (
        "from pathlib import Path\nGOOD, BROKEN = (Path(__file__).with_name(n) for n in ('others.md', 'broken.md'))\n"
    )
    files = {"my_lessons.py": module, "others.md": LESSON, "broken.md": LESSON.replace("title", "titel")}
    install(tmp_path, "my-lessons", {"spherloc.lessons": points}, files)
    paper = tmp_path / "paper.html"
    commands = [["lesson"], ["lesson", "others", "--handout", str(paper)], ["plugins", "--json"]]
    listed, written, told = spherloc_each(tmp_path, commands)
    assert "A lesson of others" in listed.stdout and listed.stdout.count("\n") == len(lessons()) + 1
    assert written.returncode == 0 and "Of <b>100</b> matches <b>20</b> are right." in paper.read_text()
    problems = {row["name"]: row["problem"] for row in map(json.loads, told.stdout.splitlines())}
    assert problems["others"] == "" and "does not know 'titel'" in problems["broken"]
    assert "rename it" in problems["ransac"] and "must be the path of a file odd.md" in problems["odd"]
