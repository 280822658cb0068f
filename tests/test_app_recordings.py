"""Reviewing on the page: the list and its filters, runs opened as they were, labels, comparisons, and exports."""

import csv
import io
import json
import re
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from datetime import UTC, datetime
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import viser

from spherloc.datasets.variation import Variation
from spherloc.errors import InputError, RecordingError
from spherloc_viz.app import session as session_module
from spherloc_viz.app.catalog import MOST_BRIEF, Catalog
from spherloc_viz.app.page_runs import PageRuns
from spherloc_viz.app.review import bundle as bundle_module
from spherloc_viz.app.review import notes as notes_module
from spherloc_viz.app.review.bundle import bundle, table_csv
from spherloc_viz.app.review.differences import comparison_html
from spherloc_viz.app.review.filters import Counts, filters_html
from spherloc_viz.app.review.look import PAGE, Look
from spherloc_viz.app.review.rows import rows_html
from spherloc_viz.app.review.shelf import Shelf
from spherloc_viz.app.review.summary_page import summary_html
from spherloc_viz.app.server import Sessions
from spherloc_viz.app.services import Services
from spherloc_viz.app.session import Session
from spherloc_viz.app.web.touch import Touch, TouchDesk, Touches
from spherloc_viz.app.web.viser_seams import start_viser, stop_viser
from spherloc_viz.gallery import gallery_cases
from spherloc_viz.recording.background import Recorder
from spherloc_viz.recording.index import RunIndex
from spherloc_viz.recording.query import Range
from spherloc_viz.recording.reader import read_recording
from spherloc_viz.recording.review import read_review
from spherloc_viz.recording.run_row import RunRow
from tests.connected_page import ConnectedPage, until

KEY = "a key of this test"
NOW = datetime(2026, 5, 1, 12, tzinfo=UTC)
PNG = b"\x89PNG\r\n\x1a\n" + bytes(20)
EVIL = "<img src=x onerror=alert(1)>\"'&"
SCENE = """
kind = "synthetic"
name = "tiny"
[camera]
model = "equirectangular"
width = 512
height = 256
[simulation]
correspondences = 20
outlier_rate = 0.25
noise_px = 0.5
seed = 1
"""


def made_row(number: int, **changes: Any) -> RunRow:
    """A run of a list."""
    row = RunRow(
        file=f"run-{number:04}.rrd",
        run_id=f"id-{number}",
        created=f"2026-05-01T10:{number // 60 % 60:02}:{number % 60:02}.000+00:00",
        source="page",
        scene="street.toml",
        name="street",
        query=None,
        estimator=("mc", "ransac-2p")[number % 2],
        seed=number,
        options='{"bound_px": 3.0}',
        problem_key="p",
        outcome=("failure", "success")[number % 3 == 0],
        diagnosis=("too few inliers", "ok")[number % 3 == 0],
        doubtful=number % 3 != 0,
        summary="Few agree.",
        message="Done.",
        correspondences=50,
        inliers=number % 50,
        outlier_rate=(number % 10) / 10,
        rotation_error_deg=float(number),
        translation_error_m=0.1 * number,
        time_ms=2.0,
        proven=None,
        steps=20,
        decisive_step=7,
        thumbnail=PNG,
        size_bytes=1000,
    )
    return replace(row, **changes)


class Elements(HTMLParser):
    """The elements of a page, and what can be pressed."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.touches: list[str] = []
        self.links: list[str] = []
        self.attributes: set[str] = set()
        self.feed(html)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes |= {name for name, _ in attrs}
        known = dict(attrs)
        self.touches += [str(known["data-touch"])] if "data-touch" in known else []
        self.links += [str(known["href"])] if "href" in known else []


@pytest.fixture
def shelf(tmp_path: Path) -> Iterator[Shelf]:
    """A list of 50 runs without files."""
    with RunIndex(tmp_path / "recordings") as index:
        index.add_all([made_row(number) for number in range(50)])
        index.stale = False
        yield Shelf(index)


def test_filters_count_what_they_would_leave(shelf: Shelf) -> None:
    look = Look().choose("outcome", "failure").choose("outliers", "80 to 90 %")
    found, _ = shelf.page(look)
    assert found.total == len(found.rows) and all(row.outcome == "failure" for row in found.rows)
    assert {row.outlier_rate for row in found.rows} == {0.8, 0.9}
    counts = shelf.counts(look.unfold("estimator"), found.total)
    assert dict(counts.diagnosis) == {"too few inliers": found.total}
    # A filter's own counts say what another value of it would leave.
    assert dict(counts.outcome)["failure"] == found.total and dict(counts.outcome)["success"] > 0
    assert sum(count for _, count in counts.unfolded) == found.total
    assert shelf.page(look.choose("estimator", "mc"))[0].total == dict(counts.unfolded)["mc"]
    assert not look.cleared().filtered and shelf.page(look.cleared())[0].total == 50
    assert look.choose("outcome", "failure").outcome is None, "pressed again, it is taken away"


def test_the_list_is_sorted_and_turned(shelf: Shelf) -> None:
    newest, _ = shelf.page(Look())
    assert [row.seed for row in newest.rows] == list(range(49, 49 - PAGE, -1))
    last, look = shelf.page(Look().turn("9999"))
    assert look.page == 2 and [row.seed for row in last.rows] == list(range(9, -1, -1)), "the nearest page that exists"
    worst = Look().sorted("rotation_error_deg")
    assert (
        shelf.page(worst)[0].rows[0].seed == 49 and shelf.page(worst.sorted("rotation_error_deg"))[0].rows[0].seed == 0
    )
    assert shelf.place(worst, "run-0040.rrd", 0) == (9, 50) and shelf.place(worst, "gone.rrd", 0) == (None, 50)
    far = made_row(999, file="far.rrd", rotation_error_deg=-1.0)
    shelf._index.add_all([far, *(made_row(number) for number in range(50, 300))])
    assert shelf.place(worst, "far.rrd", 0) == (300, 301), "however far it is"
    assert shelf.place(worst.choose("outcome", "success"), "far.rrd", 200)[0] is not None
    assert shelf.place(worst.choose("outcome", "failure"), "far.rrd", 0)[0] is None
    shelf._index.remove("far.rrd")
    row = shelf.at(worst, 260)
    assert row is not None and row.seed == 39 and shelf.at(worst, 300) is None and shelf.at(worst, -1) is None


@pytest.mark.parametrize(
    "change",
    [
        lambda look: look.choose("outcome", "nonsense"),
        lambda look: look.choose("page", "3"),
        lambda look: look.choose("outliers", "<0.5"),
        lambda look: look.choose("when", "yesterday"),
        lambda look: look.sorted("thumbnail"),
        lambda look: look.unfold("text"),
        lambda look: look.turn("-1"),
        lambda look: look.turn("1" * 30),
        lambda look: look.turn("٣"),
    ],
)
def test_what_a_page_makes_up_changes_nothing(change: Callable[[Look], Look]) -> None:
    assert change(Look()) == Look()


def test_ranges_are_chosen_or_typed() -> None:
    assert Look(outliers=">0.9").query(NOW).outlier_rate == Range(low=0.9, low_open=True)
    assert Look().choose("outliers", "above 95 %").query(NOW).outlier_rate == Range(low=0.95, low_open=True)
    since = Look().choose("when", "last hour").query(NOW).since
    assert since is not None and since.startswith("2026-05-01T11:00")
    with pytest.raises(InputError, match="is no range"):
        Look(outliers="many").query(NOW)
    assert len(Look(text="x" * 5000).query(NOW).text or "") == 200


def evil_row() -> RunRow:
    """A run whose every text is HTML."""
    texts = {field.name: EVIL for field in fields(RunRow) if field.type in ("str", str)}
    return made_row(1, **texts | {"labels": (EVIL,), "query": EVIL, "options": json.dumps({EVIL: EVIL})})


def test_texts_of_strangers_are_no_html() -> None:
    row = evil_row()
    counts = Counts(1, ((EVIL, 1),), ((EVIL, 1),), ((EVIL, 1),))
    pages = (
        rows_html([row], frozenset(), None, 1, Look(), NOW),
        filters_html(Look(scene=EVIL, unfolded="scene"), counts),
        comparison_html(row, made_row(2)),
        summary_html([row], EVIL, NOW),
    )
    for html in pages:
        found = Elements(html)
        # The only picture is the row's own.
        assert "script" not in found.tags and found.tags.count("img") == html.count("data:image/png")
        assert not any(name.startswith("on") for name in found.attributes)
        assert all(link.startswith("/viewer/?run=%3Cimg+src") for link in found.links)
    assert f"run-open:{EVIL}" in Elements(pages[0]).touches


def test_a_row_says_what_came_out_and_where_to_go() -> None:
    row = made_row(4, labels=("seam",), note="look")
    html = rows_html([row], frozenset({row.file}), row.file, 1, Look(), NOW)
    for words in ("failure", "too few inliers", "4/50", "40 % out", "4.00°", "40 cm", "seam", "look", "☑"):
        assert words in html, words
    found = Elements(html)
    assert found.links == ["/viewer/?run=run-0004.rrd&step=7"] and "run-open:run-0004.rrd" in found.touches
    large = replace(row, thumbnail=PNG + bytes(200_000))
    assert "data:image" not in rows_html([large], frozenset(), None, 1, Look(), NOW)
    assert "No recorded run fits" in rows_html([], frozenset(), None, 0, Look(text="x"), NOW)


def test_two_runs_differ_in_what_differs() -> None:
    one = made_row(1, options='{"bound_px": 3.0, "samples": 10}')
    other = made_row(3, options='{"bound_px": 4.0, "samples": 10}')
    html = comparison_html(one, other)
    assert "the same problem" in html and "bound px" in html and "samples" not in html
    assert "different problems" in comparison_html(one, replace(other, problem_key="q"))
    assert "bound px" not in comparison_html(one, replace(other, options="[1"))


def test_an_export_is_whole_readable_and_bounded(shelf: Shelf, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [made_row(0, note="=1+1", labels=("a", "b")), made_row(1), made_row(2), made_row(3, file="../secret.rrd")]
    (tmp_path / "secret.rrd").write_bytes(b"secret")
    for row in rows[:2]:
        (shelf.folder / row.file).write_bytes(row.file.encode())
    (shelf.folder / "run-0000.review.rrd").write_bytes(b"review")
    packed = bundle(shelf.folder, rows, 9, NOW, lambda: False)
    with zipfile.ZipFile(io.BytesIO(packed.content)) as archive:
        names = {f"recordings/{name}" for name in ("run-0000.rrd", "run-0000.review.rrd", "run-0001.rrd")}
        assert set(archive.namelist()) == names | {"index.html", "runs.csv"} and archive.testzip() is None
        assert archive.read("recordings/run-0001.rrd") == b"run-0001.rrd"
        page, table = (archive.read(name).decode() for name in ("index.html", "runs.csv"))
    assert "script" not in Elements(page).tags and "default-src 'none'" in page and "spherloc view" in page
    first = next(csv.DictReader(io.StringIO(table)))
    assert first["note"] == "'=1+1" and first["labels"] == "a; b" and first["rotation_error_deg"] == "0.0"
    assert packed.runs == 2 and "2 were left out, since their files are gone" in packed.sentence
    assert "5 more were left out" in packed.sentence
    monkeypatch.setattr(bundle_module, "MOST_BYTES", 20)
    assert bundle(shelf.folder, rows, 4, NOW, lambda: False).runs == 1
    with pytest.raises(RecordingError, match="nothing to export"):
        bundle(shelf.folder, rows[2:], 2, NOW, lambda: False)
    with pytest.raises(RecordingError, match="page was closed"):
        bundle(shelf.folder, rows, 4, NOW, lambda: True)


def test_a_table_has_every_number() -> None:
    found = next(csv.DictReader(io.StringIO(table_csv([made_row(7)]))))
    assert set(found) == {field.name for field in fields(RunRow)} - {"thumbnail"}
    assert float(found["outlier_rate"]) == 0.7 and found["seed"] == "7"


def test_recorded_problems_do_not_pile_up(tmp_path: Path) -> None:
    (tmp_path / "tiny.toml").write_text(SCENE)
    catalog = Catalog(tmp_path / "tiny.toml")
    page, before = catalog.branch(), len(catalog.scenes)
    scene = catalog.scenes["tiny"]
    labels = [page.enter(scene, tmp_path / f"{k}.rrd", "tiny (recorded)", brief=True) for k in range(20)]
    assert len(page.scenes) == before + MOST_BRIEF and len(catalog.scenes) == before
    assert all(label in page.scenes for label in labels[-MOST_BRIEF:]) and page.path(labels[-1]).name == "19.rrd"
    assert page.enter(scene, tmp_path / "19.rrd", "tiny (recorded)", brief=True) == labels[-1]


class Office:
    """A server whose pages record into a folder and review what is there."""

    def __init__(self, folder: Path) -> None:
        (folder / "tiny.toml").write_text(SCENE)
        self.folder = folder / "recordings"
        self.errors: list[RecordingError] = []
        self.recorder = Recorder(self.folder, self.errors.append)
        catalog = Catalog(folder / "tiny.toml")
        self.services = Services(catalog, (folder,), self.recorder, Shelf(self.recorder.index))
        self.sessions = Sessions(self.services)
        self.server: viser.ViserServer = start_viser(KEY)
        self.sessions.attend(self.server)
        self.visitors: list[Visitor] = []

    def visit(self) -> "Visitor":
        """A new page, once its first run is on the disk."""
        known = set(self.sessions._open)
        page = ConnectedPage(self.server, KEY)
        until(lambda: set(self.sessions._open) - known)
        (number,) = set(self.sessions._open) - known
        self.visitors.append(Visitor(page, self.sessions._open[number]))
        self.visitors[-1].settle()
        return self.visitors[-1]

    @property
    def files(self) -> list[str]:
        return sorted(path.name for path in self.folder.glob("*.rrd") if ".review." not in path.name)

    def close(self) -> None:
        for visitor in self.visitors:
            visitor.page.close()
        self.sessions.close()
        stop_viser(self.server)
        self.recorder.close()
        assert not self.errors


class Visitor:
    """A page with its session."""

    def __init__(self, page: ConnectedPage, session: Session) -> None:
        self.page, self.session = page, session
        self.panel, self.card = session._controls._recordings, session._controls.review

    def touch(self, words: str) -> None:
        action, _, argument = words.partition(":")
        self.session._touches.deliver(Touch(action, argument, 0.5, 0.5, 0.5, 0.5, False))

    def set(self, widget: Any, value: Any) -> None:
        self.page.send({"type": "GuiUpdateMessage", "uuid": widget._impl.uuid, "updates": {"value": value}})

    def settle(self) -> None:
        """Wait until the page's run is recorded, on the disk and diagnosed."""
        session = self.session
        until(lambda: session._run is not None and session._runs.path(session._run.trace) is not None)
        path = session._runs.path(session._run.trace)  # type: ignore[union-attr]
        assert path is not None
        until(path.exists)
        until(lambda: session._diagnosed is not None and session._diagnosed[0] is session._run.trace)  # type: ignore[union-attr]

    @property
    def rows(self) -> str:
        assert self.panel._runs is not None
        return self.panel._runs._rows.content

    @property
    def drawn(self) -> dict[str, Any]:
        return self.session._face.canvas._painter._drawn

    def see(self) -> None:
        """Have the tab in front."""
        self.touch("views:Recordings")


@pytest.fixture
def office(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Office]:
    monkeypatch.setattr(session_module, "QUIET_S", 0.3)
    monkeypatch.setattr(notes_module, "PAUSE_S", 0.1)
    opened = Office(tmp_path)
    yield opened
    opened.close()


def recorded_twice(office: Office) -> tuple[Visitor, str, str]:
    """A page that has made two runs of two problems, and the runs' files."""
    visitor = office.visit()
    (first,) = office.files
    simulation = visitor.session._controls.scene._simulation
    visitor.set(simulation._outliers, 60.0)
    until(lambda: len(office.files) == 2)
    visitor.settle()
    until(lambda: office.recorder.waiting == 0)
    (second,) = set(office.files) - {first}
    return visitor, first, second


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
    until(lambda: session._run is not None and session._run.wish.scene.variation == Variation())
    until(lambda: f"Opened {first}" in session._status._line.content)
    recorded = read_recording(office.folder / first)
    assert session._run is not None
    assert np.array_equal(session._run.trace.cam_from_map, recorded.cam_from_map)  # type: ignore[arg-type]
    assert np.array_equal(session._run.trace.problem.pixels, recorded.problem.pixels)
    assert session._controls.scene._simulation._outliers.value == 25.0
    until(lambda: "2 of 2" in visitor.card._html.content and visitor.card._html.visible)
    assert "now" not in Elements(visitor.card._html.content).tags
    assert len(office.files) == 2, "it is not recorded once more"

    # The next run by key, then what is changed shows both.
    visitor.touch("run-step:-1")
    until(lambda: visitor.card.opened is not None and visitor.card.opened.recorded.row.file == second)
    until(lambda: session._run is not None and session._run.wish.scene.variation == origin.variation)
    visitor.touch("run-step:-1")
    until(lambda: "first run of the list" in visitor.panel._status.content)
    until(lambda: "first run of the list" in visitor.card._html.content)
    until(lambda: f"Opened {second}" in session._status._line.content)
    visitor.set(session._controls.scene._simulation._noise, 2.5)
    until(lambda: "Changed: noise px" in visitor.card._html.content)
    until(lambda: "recorded/0" in visitor.drawn and visitor.drawn["recorded/0"][0].visible)
    assert "as recorded" in visitor.card._html.content
    visitor.touch("run-return:")
    until(lambda: session._run is not None and session._run.wish.scene.variation == origin.variation)
    until(lambda: not visitor.drawn["recorded/0"][0].visible)
    visitor.touch("run-close:")
    until(lambda: not visitor.card._html.visible and visitor.card.opened is None)


def test_labels_are_stored_and_seen_by_others(office: Office) -> None:
    visitor, first, second = recorded_twice(office)
    other = office.visit()
    until(lambda: office.recorder.waiting == 0)
    for page in (visitor, other):
        page.see()
        until(lambda page=page: f"run-open:{second}" in page.rows)
    visitor.touch(f"run-open:{second}")
    notes = visitor.panel._notes
    until(lambda: notes._labels.visible)
    visitor.set(notes._labels, "seam, look twice")
    visitor.set(notes._note, "<b>a</b> note\nof two lines")
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
    until(lambda: notes._file == first)
    assert (notes._labels.value, notes._note.value) == ("", "")
    until(lambda: "run-label:look twice" in notes._chips.content)
    visitor.touch("run-label:look twice")
    until(lambda: read_review(office.folder / first).labels == ("look twice",))
    visitor.set(notes._labels, ", ".join(f"label {k}" for k in range(50)))
    until(lambda: "too many for a run" in visitor.panel._status.content)
    # What was typed is stored even if the page goes at once.
    visitor.set(notes._labels, "last word")
    until(lambda: notes._labels.value == "last word")
    until(lambda: bool(notes._pending) or read_review(office.folder / first).labels == ("last word",))
    visitor.page.close()
    until(lambda: read_review(office.folder / first).labels == ("last word",))


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
    until(lambda: runs._problem.visible and "is no range" in runs._problem.content)
    visitor.touch("runs-clear:")
    until(lambda: "3 runs" in visitor.rows and not runs._problem.visible)

    for file in (third, second):
        visitor.touch(f"run-mark:{file}")
    until(lambda: "compare the two" in runs._bar.content and runs._bar.visible)
    visitor.touch("runs-compare:")
    until(lambda: "the same problem" in visitor.panel._comparison.content)
    until(lambda: session._run is not None and session._run.trace.estimator == "ransac-2p")
    until(lambda: visitor.card.opened is not None and visitor.card.opened.other is not None)
    until(lambda: "recorded/0" in visitor.drawn and visitor.drawn["recorded/0"][0].visible)
    visitor.touch("runs-uncompare:")
    until(lambda: not visitor.drawn["recorded/0"][0].visible)

    visitor.touch("runs-export:")
    until(lambda: "2 runs," in visitor.panel._status.content)
    (name,) = visitor.page.files
    assert re.fullmatch(r"spherloc-runs-\d{8}T\d{6}Z\.zip", name)
    until(lambda: len(visitor.page.files[name]) > 0 and zipfile.is_zipfile(io.BytesIO(visitor.page.files[name])))
    with zipfile.ZipFile(io.BytesIO(visitor.page.files[name])) as archive:
        assert {f"recordings/{file}" for file in (second, third)} <= set(archive.namelist())
        assert archive.read(f"recordings/{third}") == (office.folder / third).read_bytes()


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
    until(lambda: session._run is not None and session._run.wish.scene.seed == case.seed)
    assert session._run is not None and np.array_equal(session._run.trace.problem.pixels, case.problem().pixels)
    until(lambda: case.story.split(".")[0].split("'")[0] in visitor.panel._gallery._html.content)


def test_pages_hear_of_the_recordings(office: Office) -> None:
    office.sessions.notice("3 recordings were deleted to make room.")
    visitor = office.visit()
    notices = visitor.session._notices
    until(lambda: notices._shown is not None)
    first = notices._shown
    assert first is not None and first.body == "3 recordings were deleted to make room."
    office.sessions.notice("2 recordings were recovered.")
    assert notices._shown is not None and notices._shown is not first
    assert notices._shown.body == "2 recordings were recovered."


def test_a_press_is_heard_by_all_who_listen() -> None:
    heard: list[str] = []
    touches = Touches(lambda error: heard.append(type(error).__name__))
    touches.on("views", lambda touch: 1 / 0)
    touches.on("views", lambda touch: heard.append(touch.argument))
    touches.deliver(Touch("views", "Yaw", 0.0, 0.0, 0.0, 0.0, False))
    assert heard == ["ZeroDivisionError", "Yaw"]
    desk = TouchDesk()
    desk.add(touches)
    report = {"session": touches.token, "action": "views:\ud800", "at": [0, 0], "from": [0, 0], "extend": False}
    assert not desk.deliver(json.dumps(report).encode()) and len(heard) == 2


def test_a_waiting_queue_is_told(tmp_path: Path) -> None:
    class Slow:
        overload = "7 runs wait to be recorded."

        def submit(self, *words: object) -> Path:
            return tmp_path / "run.rrd"

    (tmp_path / "tiny.toml").write_text(SCENE)
    catalog = Catalog(tmp_path / "tiny.toml")
    runs = PageRuns(Slow(), catalog)  # type: ignore[arg-type]
    from spherloc.estimators import default_options, estimate
    from spherloc_viz.app.catalog import SceneWish
    from spherloc_viz.app.wish import Run, Wish

    problem = catalog.problem(SceneWish("tiny", 1))
    wish = Wish(SceneWish("tiny", 1), "mc", default_options("mc", problem))
    run = Run(wish, estimate(problem, "mc", wish.options, 1), np.arange(len(problem)))
    assert runs.settle(run, None) == ("Recorded as run.rrd. 7 runs wait to be recorded.", None)
    assert PageRuns(None, catalog).settle(run, None) == ("Runs are not recorded.", None)
