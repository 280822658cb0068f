"""Reviewing on connected pages: runs opened as they were, labels, comparisons, exports, the gallery, and notices."""

import re
import threading
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from spherloc.datasets.variation import Variation
from spherloc.errors import InputError, RecordingError
from spherloc.estimators import default_options, estimate
from spherloc.trace import Trace
from spherloc_viz.app import session as session_module
from spherloc_viz.app.catalog import MAX_BRIEF, Catalog, Run, RunRequest, SceneRequest
from spherloc_viz.app.page_runs import LOOK_S, PageRuns
from spherloc_viz.app.review import notes as notes_module
from spherloc_viz.app.review.export import Exporter
from spherloc_viz.app.review.filters import KEPT
from spherloc_viz.app.review.run_library import RunLibrary
from spherloc_viz.app.status import TAIL, _line_html
from spherloc_viz.gallery import gallery_cases
from spherloc_viz.recording.content.data import read_recording
from spherloc_viz.recording.review_file import read_review
from spherloc_viz.recording.reviews import Review
from spherloc_viz.recording.run_row import RunRow
from tests.reviewing_pages import Office, recorded_twice
from tests.tiny_scene import write_tiny_scene
from tests.waiting import LIMIT_S, until


def test_recorded_problems_do_not_pile_up(tmp_path: Path) -> None:
    catalog = Catalog(write_tiny_scene(tmp_path))
    page, before = catalog.branch(), len(catalog.scenes)
    scene = catalog.scenes["tiny"]
    labels = [page.enter(scene, tmp_path / f"{k}.rrd", "tiny (recorded)", brief=True) for k in range(20)]
    assert len(page.scenes) == before + MAX_BRIEF and len(catalog.scenes) == before
    assert all(label in page.scenes for label in labels[-MAX_BRIEF:]) and page.path(labels[-1]).name == "19.rrd"
    assert page.enter(scene, tmp_path / "19.rrd", "tiny (recorded)", brief=True) == labels[-1]
    with pytest.raises(InputError, match=r"is not offered any more, as 8 recordings were opened since"):  # as by Undo
        page.problem(SceneRequest(labels[0], 0))


@pytest.fixture
def office(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Office]:
    monkeypatch.setattr(session_module, "QUIET_S", 0.3)
    monkeypatch.setattr(notes_module, "PAUSE_S", 0.1)
    opened = Office(tmp_path)
    yield opened
    opened.close()


def test_a_run_is_recorded_once_and_kept(office: Office) -> None:
    visitor = office.visit()
    (first,) = office.files
    again = office.visit()
    assert office.files == [first], "another page, or a reload, does the same run"
    until(lambda: f"Recorded as {first}" in again.session._status._line.content)
    simulation = again.session._controls.scene._simulation
    again.set(simulation._outliers, 60.0)
    until(lambda: len(office.files) == 2)
    again.set(simulation._outliers, 25.0)
    until(lambda: f"Recorded as {first}" in again.session._status._line.content)
    assert len(office.files) == 2, "going back makes no third one"
    assert f'data-touch="run-keep:{first}"' in again.session._status._line.content
    visitor.see()
    until(lambda: f"run-keep:{first}" in visitor.rows)
    again.touch(f"run-keep:{first}")
    until(lambda: read_review(office.folder / first).labels == (KEPT,))
    until(lambda: f"run-keep:{first}" not in visitor.rows and KEPT in visitor.rows)
    again.touch("run-keep:../gone.rrd")
    until(lambda: "gone.rrd" in again.panel._status.content)


def test_a_run_is_recorded_with_its_origin_and_opened_exactly(office: Office) -> None:
    visitor, first, second = recorded_twice(office)
    origin = read_recording(office.folder / second).origin
    assert origin is not None and (origin.source, origin.scene_seed) == ("page", 1)
    assert origin.variation == Variation(outlier_rate=0.6)
    assert visitor.rows == "", "nobody sees the list yet"
    visitor.see()
    until(lambda: f"run-open:{first}" in visitor.rows and f"run-open:{second}" in visitor.rows)
    assert "2 runs" in visitor.rows

    session = visitor.session
    visitor.touch(f"run-open:{first}")
    until(lambda: session._run is not None and session._run.request.scene.variation == Variation())
    until(lambda: f"Opened {first}" in session._status._line.content)
    recorded = read_recording(office.folder / first)
    assert session._run is not None
    assert np.array_equal(session._run.trace.cam_from_map, recorded.cam_from_map)  # type: ignore[arg-type]
    assert np.array_equal(session._run.trace.problem.pixels, recorded.problem.pixels)
    assert session._controls.scene._simulation._outliers.value == 25.0
    until(lambda: "2 of 2" in visitor.card._places[0].content and visitor.card._places[0].visible)
    assert "runs-beside" not in visitor.card._places[0].content
    assert len(office.files) == 2, "it is not recorded once more"

    # The next run by key, then what is changed shows both.
    visitor.touch("run-step:-1")
    until(lambda: visitor.card.opened is not None and visitor.card.opened.recorded.row.file == second)
    until(lambda: session._run is not None and session._run.request.scene.variation == origin.variation)
    visitor.touch("run-step:-1")
    until(lambda: "first run of the list" in visitor.panel._status.content)
    until(lambda: "first run of the list" in visitor.card._places[0].content)
    until(lambda: f"Opened {second}" in session._status._line.content)
    visitor.set(session._controls.scene._simulation._noise, 2.5)
    until(lambda: "Changed: noise px" in visitor.card._places[0].content)
    until(lambda: "recorded/0" in visitor.drawn and visitor.drawn["recorded/0"][0].visible)
    assert "as recorded" in visitor.card._places[0].content
    visitor.touch("run-return:")
    until(lambda: session._run is not None and session._run.request.scene.variation == origin.variation)
    until(lambda: not visitor.drawn["recorded/0"][0].visible)
    visitor.touch("run-close:")
    until(lambda: not visitor.card._places[0].visible and visitor.card.opened is None)


def test_nothing_is_compared_before_the_page_shows_the_recorded_run(
    office: Office, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The run that the page still shows is another one, and was not made by changing the recorded one."""
    visitor, first, _ = recorded_twice(office)
    gate, session = threading.Event(), visitor.session

    def later(*words: Any) -> Trace:
        assert gate.wait(LIMIT_S)
        return estimate(*words)

    monkeypatch.setattr(session_module, "estimate", later)
    visitor.see()
    until(lambda: f"run-open:{first}" in visitor.rows)
    visitor.touch(f"run-open:{first}")
    until(lambda: "The page still shows another run." in visitor.card._places[0].content)
    assert "runs-beside" not in visitor.card._places[0].content and "Changed" not in visitor.card._places[0].content
    gate.set()
    until(lambda: session._run is not None and session._run.request.scene.variation == Variation())
    until(lambda: "another run" not in visitor.card._places[0].content)


def test_labels_are_stored_and_seen_by_others(office: Office) -> None:
    visitor, first, second = recorded_twice(office)
    other = office.visit()
    until(lambda: office.recorder.waiting == 0)
    for page in (visitor, other):
        page.see()
        until(lambda page=page: f"run-open:{second}" in page.rows)
    visitor.touch(f"run-open:{second}")
    notes = visitor.panel._notes
    until(lambda: notes._fields.labels.visible)
    visitor.set(notes._fields.labels, "seam, look twice")
    visitor.set(notes._fields.note, "<b>a</b> note\nof two lines")
    path = office.folder / second
    until(lambda: read_review(path).note != "" and read_review(path).labels == ("seam", "look twice"))
    assert read_review(path).note == "<b>a</b> note\nof two lines"
    for page in (visitor, other):
        until(lambda page=page: "look twice" in page.rows and "&lt;b&gt;a&lt;/b&gt; note" in page.rows)
    until(lambda: 'aria-pressed="true" title="seam"' in notes._chips.content)
    visitor.touch("run-label:seam")
    until(lambda: read_review(path).labels == ("look twice",))
    # Another run has the labels that were used as chips, and none of its own.
    visitor.touch(f"run-open:{first}")
    until(lambda: notes._file == first and not visitor.opening)
    assert (notes._fields.labels.value, notes._fields.note.value) == ("", "")
    # The gallery has no room for what is said of a run.
    visitor.touch("recordings:gallery")
    until(lambda: not any(part.visible for part in (*notes.widgets, notes._chips)))
    visitor.touch("recordings:runs")
    until(lambda: all(widget.visible for widget in notes.widgets))
    until(lambda: "run-label:look twice" in notes._chips.content)
    visitor.touch("run-label:look twice")
    until(lambda: read_review(office.folder / first).labels == ("look twice",))
    visitor.set(notes._fields.labels, ", ".join(f"label {k}" for k in range(50)))
    until(lambda: "too many for a run" in visitor.panel._status.content)
    # What was typed is stored even if the page goes at once.
    visitor.set(notes._fields.labels, "last word")
    until(lambda: notes._fields.labels.value == "last word")
    until(lambda: bool(notes._pending) or read_review(office.folder / first).labels == ("last word",))
    visitor.page.close()
    until(lambda: read_review(office.folder / first).labels == ("last word",))


def test_two_pages_review_one_run_without_losing_words(office: Office) -> None:
    visitor, _, second = recorded_twice(office)
    other = office.visit()
    path = office.folder / second
    for page in (visitor, other):
        page.see()
        page.touch(f"run-open:{second}")
        until(lambda page=page: page.panel._notes._file == second)
    one, two = visitor.panel._notes, other.panel._notes
    # The second page does not look at its list, and so does not hear of the first one's words.
    other.touch("views:")
    visitor.set(one._fields.note, "a note")
    until(lambda: read_review(path).note == "a note")
    other.set(two._fields.labels, "seam")
    until(lambda: read_review(path).labels == ("seam",))
    assert read_review(path).note == "a note"
    for page in (visitor, other):
        until(lambda page=page: page.panel._notes._fields.note.value == "a note")
        until(lambda page=page: page.panel._notes._fields.labels.value == "seam")
        until(lambda page=page: page.card.opened.recorded.row.labels == ("seam",))  # type: ignore[union-attr]
    other.touch("run-label:seam")
    until(lambda: read_review(path).labels == ())
    until(lambda: one._fields.labels.value == "")
    assert read_review(path).note == "a note"


def test_what_arrives_when_another_run_is_open_is_of_the_run_it_was_typed_for(office: Office) -> None:
    visitor, first, second = recorded_twice(office)
    visitor.see()
    notes = visitor.panel._notes
    for file in (first, second):
        visitor.touch(f"run-open:{file}")
        until(lambda file=file: notes._file == file and not visitor.opening)
    visitor.set(notes._others.note, "of the first")
    visitor.set(notes._fields.note, "of the second")
    for file, words in ((first, "of the first"), (second, "of the second")):
        until(lambda file=file, words=words: read_review(office.folder / file).note == words)
    visitor.touch(f"run-open:{first}")
    until(lambda: notes._file == first and notes._fields.note.value == "of the first")
    assert notes._others.note.value == "of the second" and not notes._others.note.visible


def test_words_that_are_refused_leave_nothing_in_those_typed_meanwhile(
    office: Office, monkeypatch: pytest.MonkeyPatch
) -> None:
    visitor, first, _ = recorded_twice(office)
    visitor.see()
    visitor.touch(f"run-open:{first}")
    notes = visitor.panel._notes
    until(lambda: notes._file == first and not visitor.opening)
    visitor.touch("run-label:seam")
    until(lambda: read_review(office.folder / first).labels == ("seam",))
    until(lambda: notes._storing is None)
    review, at_work, go_on = RunLibrary.review, threading.Event(), threading.Event()

    def refused(*words: Any) -> RunRow:
        at_work.set()
        go_on.wait(LIMIT_S)
        monkeypatch.setattr(RunLibrary, "review", review)
        raise RecordingError("these words are refused.")

    monkeypatch.setattr(RunLibrary, "review", refused)
    visitor.set(notes._fields.labels, "refused")
    until(at_work.is_set)
    visitor.set(notes._fields.labels, "taken")
    until(lambda: first in notes._pending)
    go_on.set()
    until(lambda: "taken" in read_review(office.folder / first).labels)
    assert read_review(office.folder / first).labels == ("taken",)


def test_words_for_a_run_that_is_gone_do_not_cost_those_for_another(office: Office) -> None:
    visitor, first, second = recorded_twice(office)
    visitor.see()
    visitor.touch(f"run-open:{first}")
    notes = visitor.panel._notes
    until(lambda: notes._file == first and not visitor.opening)
    (office.folder / first).unlink()
    with notes._lock:
        notes._pending = {file: (Review(), Review(("seam",))) for file in (first, second)}
    visitor.touch("run-label:late")
    until(lambda: "there is no such run" in visitor.panel._status.content)
    until(lambda: read_review(office.folder / second).labels == ("seam",))
    until(lambda: not notes._pending and notes._storing is None)
    assert notes._fields.labels.value == "late", "what was typed stays where it can be copied"


def test_a_list_goes_on_when_its_folder_is_back(office: Office) -> None:
    visitor, first, _ = recorded_twice(office)
    visitor.see()
    until(lambda: "2 runs" in visitor.rows)
    away = office.folder.with_name("away")
    office.folder.rename(away)
    until(lambda: "No run is recorded" in visitor.rows)
    away.rename(office.folder)
    until(lambda: "2 runs" in visitor.rows)
    visitor.touch(f"run-open:{first}")
    until(lambda: visitor.card.opened is not None)
    assert visitor.card.opened.recorded.row.file == first


def test_a_comparison_ends_with_its_runs(office: Office) -> None:
    visitor, first, second = recorded_twice(office)
    visitor.see()
    until(lambda: f"run-open:{second}" in visitor.rows)
    other = made_anew(office, second)
    for file in (first, second):
        visitor.touch(f"run-mark:{file}")
    visitor.touch("runs-compare:")
    until(lambda: "two problems" in visitor.panel._comparison.content and visitor.panel._comparison.visible)
    visitor.touch(f"run-open:{second}")
    until(lambda: visitor.card.opened is not None)
    assert visitor.panel._comparison.visible, "one of the two is opened"
    visitor.touch("recordings:gallery")
    until(lambda: not visitor.panel._comparison.visible)
    visitor.touch("recordings:runs")
    until(lambda: visitor.panel._comparison.visible)
    visitor.touch(f"run-open:{other}")
    until(lambda: not visitor.panel._comparison.visible and not visitor.opening)
    office.recorder.index.remove(second)
    visitor.touch("runs-compare:")
    until(lambda: "not in the list any more" in visitor.panel._status.content)


def made_anew(office: Office, file: str) -> str:
    """The same run as another recording, which the list has too."""
    (office.folder / "again.rrd").write_bytes((office.folder / file).read_bytes())
    row = office.recorder.index.get(file)
    assert row is not None
    office.recorder.index.add(replace(row, file="again.rrd"))
    return "again.rrd"


def test_the_list_is_searched_marked_compared_and_exported(office: Office) -> None:
    visitor, first, second = recorded_twice(office)
    session = visitor.session
    visitor.set(session._controls.estimator._estimator, "ransac-2p (two points)")
    until(lambda: len(office.files) == 3)
    visitor.settle()
    until(lambda: office.recorder.waiting == 0)
    (third,) = set(office.files) - {first, second}
    visitor.see()
    until(lambda: f"run-open:{third}" in visitor.rows)
    runs = visitor.panel._runs
    assert runs is not None
    visitor.set(runs._search, "no such words")
    until(lambda: "No recorded run fits" in visitor.rows)
    visitor.set(runs._search, "tiny")
    until(lambda: "3 runs" in visitor.rows)
    visitor.touch("runs-filter:estimator:ransac-2p")
    until(lambda: "1 run<" in visitor.rows and third in visitor.rows and second not in visitor.rows)
    visitor.touch("runs-unfold:outliers")
    until(lambda: runs._range.visible)
    visitor.set(runs._range, "much")
    until(lambda: runs._problem.visible and "is not a range" in runs._problem.content)
    visitor.touch("runs-clear:")
    until(lambda: "3 runs" in visitor.rows and not runs._problem.visible)

    for file in (third, second):
        visitor.touch(f"run-mark:{file}")
    until(lambda: "runs-compare:" in runs._bar.content and runs._bar.visible)
    visitor.touch("runs-compare:")
    until(lambda: "the same problem" in visitor.panel._comparison.content)
    until(lambda: session._run is not None and session._run.trace.estimator == "ransac-2p")
    until(lambda: visitor.card.opened is not None and visitor.card.opened.other is not None)
    until(lambda: "recorded/0" in visitor.drawn and visitor.drawn["recorded/0"][0].visible)
    visitor.touch("runs-uncompare:")
    until(lambda: not visitor.drawn["recorded/0"][0].visible)

    visitor.touch("runs-export:")
    until(lambda: "2 runs," in visitor.panel._status.content)
    parts = visitor.panel._parts
    exporter = next(part for part in parts if isinstance(part, Exporter))
    until(lambda: exporter._link.visible)
    found = re.search(
        r'data-fetch href="(/download/[\w-]{40,}/spherloc-runs-\d{8}T\d{6}Z\.zip)"', exporter._link.content
    )
    assert found is not None
    offered = office.services.downloads._offered[found[1]]
    with zipfile.ZipFile(offered.path) as archive:
        assert {f"recordings/{file}" for file in (second, third)} <= set(archive.namelist())
        assert archive.read(f"recordings/{third}") == (office.folder / third).read_bytes()
    visitor.page.close()
    until(lambda: not office.services.downloads._offered and not offered.path.exists())


def test_what_cannot_be_opened_is_a_sentence(office: Office) -> None:
    visitor, first, second = recorded_twice(office)
    visitor.see()
    until(lambda: f"run-open:{second}" in visitor.rows)
    before = visitor.session._run
    (office.folder / first).write_bytes(b"RRF2" + bytes(300))
    for words, sentence in (
        (f"run-open:{first}", "not a whole recording"),
        ("run-open:../tiny.toml", "not in the list any more"),
        ("run-open:", "not in the list any more"),
    ):
        visitor.panel._say("")
        visitor.touch(words)
        until(lambda sentence=sentence: sentence in visitor.panel._status.content)
    for words in ("run-step:9", "run-step:", "run-mark:", "runs-page:x", "gallery-open:x", "gallery-beside:x:1"):
        visitor.touch(words)
    assert visitor.session._run is before and visitor.card.opened is None
    visitor.touch(f"run-open:{second}")
    until(lambda: visitor.card.opened is not None)


def test_the_gallery_opens_in_one_press(office: Office) -> None:
    visitor = office.visit()
    case = next(case for case in gallery_cases() if case.staged is None and case.query is None)
    visitor.see()
    visitor.touch("recordings:gallery")
    until(lambda: f"gallery-open:{case.key}" in visitor.panel._gallery._html.content)
    assert all(f"gallery-open:{other.key}" in visitor.panel._gallery._html.content for other in gallery_cases())
    visitor.touch(f"gallery-open:{case.key}")
    session = visitor.session
    until(lambda: session._run is not None and session._run.trace.estimator == case.estimator)
    until(lambda: session._run is not None and session._run.request.scene.seed == case.seed)
    assert session._run is not None and np.array_equal(session._run.trace.problem.pixels, case.problem().pixels)
    until(lambda: case.story.split(".")[0].split("'")[0] in visitor.panel._gallery._html.content)


def test_pages_hear_of_the_recordings(office: Office) -> None:
    office.sessions.notice("3 recordings were deleted to make room.")
    visitor = office.visit()
    notices = visitor.session.notices
    until(lambda: notices._shown is not None)
    first = notices._shown
    assert first is not None and first.body == "3 recordings were deleted to make room."
    office.sessions.notice("2 recordings were recovered.")
    assert notices._shown is not None and notices._shown is not first
    assert notices._shown.body == "2 recordings were recovered."


def test_a_run_is_said_to_be_recorded_when_it_is_and_failures_stand_until_then(office: Office) -> None:
    visitor, _, _ = recorded_twice(office)
    session, away = visitor.session, office.folder.with_name("away")
    line, notices, noise = session._status._line, session.notices, session._controls.scene._simulation._noise
    office.folder.rename(away)
    office.folder.write_text("in the way")
    for count, px in enumerate((1.5, 2.5), start=1):
        visitor.set(noise, px)
        until(lambda: session._run is not None and session._run.request.scene.variation.noise_px == px)  # noqa: B023
        until(lambda: "the run cannot be recorded" in line.content)
        until(lambda: notices._failure is not None)
        if count > 1:
            until(lambda: notices._failure.body.endswith("2 runs were not recorded."))  # type: ignore[union-attr]
    late = office.visit(recorded=False).session
    until(lambda: late.notices._failure is not None and "runs were not" in late.notices._failure.body)
    until(lambda: len(office.errors) == 3 and office.recorder.waiting == 0)
    office.folder.unlink()
    away.rename(office.folder)
    before = set(office.files)
    visitor.set(noise, 3.5)
    until(lambda: "Recorded as" in line.content)
    (new,) = {name for name in office.files if name in line.content}
    assert new not in before and read_recording(office.folder / new).origin is not None
    until(lambda: notices._failure is None and late.notices._failure is None)
    until(lambda: notices._shown is not None and "Runs are recorded again; 3 were not." in notices._shown.body)
    visitor.see()
    until(lambda: "3 runs" in visitor.rows)
    office.errors.clear()


def test_what_becomes_of_a_run_is_told_when_it_is_known(tmp_path: Path) -> None:
    class Slow:
        overload = "7 runs wait to be recorded."

        def submit(
            self, trace: object, origin: object, diagnosis: object, ended: Callable[..., None], known: object
        ) -> Path:
            self.ended = ended
            return tmp_path / "run.rrd"

    catalog, slow = Catalog(write_tiny_scene(tmp_path)), Slow()
    runs = PageRuns(slow, catalog)  # type: ignore[arg-type]
    problem = catalog.problem(SceneRequest("tiny", 1))
    request = RunRequest(SceneRequest("tiny", 1), "mc", default_options("mc", problem))
    run = Run(request, estimate(problem, "mc", request.options, 1), np.arange(len(problem)))
    assert runs.finish(run, None) == ("Recording as run.rrd … 7 runs wait to be recorded.", LOOK_S)
    assert runs.path(run.trace) is None
    slow.ended(None)
    assert runs.finish(run, None) == ("Recorded as run.rrd", None) and runs.path(run.trace) == tmp_path / "run.rrd"
    other = replace(run, trace=replace(run.trace))
    runs.finish(other, None)
    slow.ended(RecordingError("run.rrd: no room."))
    assert runs.finish(other, None) == ("run.rrd: no room.", None) and runs.path(other.trace) is None
    assert PageRuns(None, catalog).finish(run, None) == ("Runs are not recorded.", None)


def test_a_query_that_is_tried_anew_keeps_one_recording(tmp_path: Path) -> None:
    """The last one; that of another query, or of the same query in an earlier sequence, is not touched."""
    told: list[Path | None] = []

    class Counting:
        def submit(self, trace: object, origin: object, *, instead_of: Path | None) -> Path:
            told.append(instead_of)
            return tmp_path / f"{len(told)}.rrd"

    catalog = Catalog(write_tiny_scene(tmp_path))
    runs = PageRuns(Counting(), catalog)  # type: ignore[arg-type]
    trace = estimate(catalog.problem(SceneRequest("tiny", 1)), "mc", seed=1)
    asked = [("a", False), ("b", False), ("a", True), ("a", False), ("a", True), ("c", True)]
    for query, anew in asked:
        runs.record(trace, SceneRequest("tiny", 1, query), anew)
    assert told == [None, None, tmp_path / "1.rrd", None, tmp_path / "4.rrd", None]


def test_a_long_name_of_a_recording_is_cut_in_its_middle() -> None:
    """What is seen ends with what makes the name unique; the text is whole, so that it can be selected and copied."""
    name = f"20261129T192212Z_{'long-' * 12}name_ransac-2p_0_4de9384d.rrd"
    shown = _line_html(f"Recorded as {name}")
    assert re.sub("<[^>]*>", "", shown) == f"Recorded as {name}" and f'title="Recorded as {name}"' in shown
    *_, last = re.findall("<span>([^<]*)</span>", shown)
    assert "_0_4de9384d.rrd" in last and len(last) == TAIL
    assert "file-name" not in _line_html(f"{name}: not recorded.") + _line_html(f"No room for {name}", wrong=True)
