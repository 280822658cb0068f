"""The parts of reviewing: what is asked of the list, how runs are shown and compared, and what an export has."""

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

import pytest

from spherloc.errors import InputError, RecordingError
from spherloc_viz.app.review import export
from spherloc_viz.app.review.card import comparison_html
from spherloc_viz.app.review.export import bundle, summary_html
from spherloc_viz.app.review.filters import PAGE, Counts, Look, filters_html
from spherloc_viz.app.review.gallery_list import file_of, gallery_html
from spherloc_viz.app.review.rows import DESK, WIDTH_PX, rows_html, verdict_html
from spherloc_viz.app.review.run_library import RunLibrary, merged
from spherloc_viz.app.web.touch import MAX_LETTERS, Touch, Touches, parse
from spherloc_viz.commands.cli import app
from spherloc_viz.gallery import gallery_cases
from spherloc_viz.recording.index.query import Range
from spherloc_viz.recording.index.run_index import RunIndex
from spherloc_viz.recording.index.run_text import rows_text
from spherloc_viz.recording.reviews import Review
from spherloc_viz.recording.run_row import RunRow

NOW = datetime(2026, 5, 1, 12, tzinfo=UTC)
PNG = b"\x89PNG\r\n\x1a\n" + bytes(20)
EVIL = "<img src=x onerror=alert(1)>\"'&"


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
        key_step=7,
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
def library(tmp_path: Path) -> Iterator[RunLibrary]:
    """A list of 50 runs without files."""
    with RunIndex(tmp_path / "recordings") as index:
        index.add_all([made_row(number) for number in range(50)])
        index.stale = False
        yield RunLibrary(index)


def test_filters_count_what_they_would_leave(library: RunLibrary) -> None:
    look = Look().choose("outcome", "failure").choose("outliers", "80 to 90 %")
    found, _ = library.page(look)
    assert found.total == len(found.rows) and all(row.outcome == "failure" for row in found.rows)
    assert {row.outlier_rate for row in found.rows} == {0.8, 0.9}
    counts = library.counts(look.unfold("estimator"), found.total)
    assert dict(counts.diagnosis) == {"too few inliers": found.total}
    # A filter's own counts say what another value of it would leave.
    assert dict(counts.outcome)["failure"] == found.total and dict(counts.outcome)["success"] > 0
    assert sum(count for _, count in counts.unfolded) == found.total
    assert library.page(look.choose("estimator", "mc"))[0].total == dict(counts.unfolded)["mc"]
    judged = look.choose("judged", "doubtful")
    assert library.page(judged)[0].total == counts.doubtful == sum(bool(row.doubtful) for row in found.rows) > 0
    assert judged.filtered and not look.choose("judged", "sure").judged
    assert "runs-filter:judged:doubtful" in Elements(filters_html(look, counts)).touches
    assert not look.cleared().filtered and library.page(look.cleared())[0].total == 50
    assert look.choose("outcome", "failure").outcome is None, "pressed again, it is taken away"


def test_the_list_is_sorted_and_turned(library: RunLibrary) -> None:
    newest, _ = library.page(Look())
    assert [row.seed for row in newest.rows] == list(range(49, 49 - PAGE, -1))
    last, look = library.page(Look().turn("9999"))
    assert look.page == 2 and [row.seed for row in last.rows] == list(range(9, -1, -1)), "the nearest page that exists"
    worst = Look().sorted("rotation_error_deg")
    assert (
        library.page(worst)[0].rows[0].seed == 49
        and library.page(worst.sorted("rotation_error_deg"))[0].rows[0].seed == 0
    )
    assert library.place(worst, "run-0040.rrd", 0) == (9, 50) and library.place(worst, "gone.rrd", 0) == (None, 50)
    far = made_row(999, file="far.rrd", rotation_error_deg=-1.0)
    library._index.add_all([far, *(made_row(number) for number in range(50, 300))])
    assert library.place(worst, "far.rrd", 0) == (300, 301), "however far it is"
    assert library.place(worst.choose("outcome", "success"), "far.rrd", 200)[0] is not None
    assert library.place(worst.choose("outcome", "failure"), "far.rrd", 0)[0] is None
    library._index.remove("far.rrd")
    row = library.at(worst, 260)
    assert row is not None and row.seed == 39 and library.at(worst, 300) is None and library.at(worst, -1) is None


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
    with pytest.raises(InputError, match="is not a range"):
        Look(outliers="many").query(NOW)
    assert len(Look(text="x" * 5000).query(NOW).text or "") == 200


def test_what_others_said_meanwhile_stays() -> None:
    before = Review(("a", "b"), "note")
    assert merged(before, before, Review(("c",), "")) == Review(("c",), "")
    theirs = Review(("a", "d"), "their note")
    assert merged(theirs, before, Review(("a", "b", "c"), "note")) == Review(("a", "d", "c"), "their note")
    assert merged(theirs, before, Review(("b",), "my note")) == Review(("d",), "my note"), "of two notes the last"


def evil_row() -> RunRow:
    """A run whose every text is HTML."""
    texts = {field.name: EVIL for field in fields(RunRow) if field.type in ("str", str)}
    return made_row(1, **texts | {"labels": (EVIL,), "query": EVIL, "options": json.dumps({EVIL: EVIL})})


def test_untrusted_texts_are_no_html() -> None:
    row = evil_row()
    counts = Counts(1, ((EVIL, 1),), ((EVIL, 1),), 0, ((EVIL, 1),))
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
        assert all(link.startswith("/viewer/?run=%3Cimg+src") for link in found.links if link != DESK)
    assert f"run-open:{EVIL}" in Elements(pages[0]).touches


def test_a_row_says_what_came_out_and_where_to_go() -> None:
    row = made_row(4, labels=("seam",), note="look")
    html = rows_html([row], frozenset({row.file}), row.file, 1, Look(), NOW)
    for words in ("failure", "too few inliers", "4/50", "40 % out", "4.00°", "40 cm", "seam", "look", "☑"):
        assert words in html, words
    found = Elements(html)
    assert found.links == [DESK, "/viewer/?run=run-0004.rrd&step=8"] and "run-open:run-0004.rrd" in found.touches
    large = replace(row, thumbnail=PNG + bytes(200_000))
    assert "data:image" not in rows_html([large], frozenset(), None, 1, Look(), NOW)
    assert "No recorded run fits" in rows_html([], frozenset(), None, 0, Look(text="x"), NOW)


def test_a_verdict_names_the_cause_and_a_doubtful_success_stays_one() -> None:
    failed, sure, doubtful = made_row(1), made_row(3), made_row(3, diagnosis="too few inliers")
    assert verdict_html(failed).endswith(">too few inliers</b>") and 'title="failure"' in verdict_html(failed)
    assert verdict_html(sure).endswith(">success</b>")
    assert verdict_html(doubtful).endswith(">success</b>, too few inliers?")


def test_the_gallery_has_room_for_pictures_once_there_are_some() -> None:
    cases = gallery_cases()
    shown = cases[3].key
    without = gallery_html(cases, {}, shown)
    row = replace(made_row(1), file=file_of(cases[0]))
    assert f"width:{WIDTH_PX}px" not in without
    assert gallery_html(cases, {row.file: row}, None).count(f"width:{WIDTH_PX}px") == len(cases)
    assert without.count("data-reveal") == 1 and f'data-reveal="{shown}"' in without
    assert "data-reveal" not in gallery_html(cases, {}, None)


def test_two_runs_differ_in_what_differs() -> None:
    one = made_row(1, options='{"bound_px": 3.0, "samples": 10}')
    other = made_row(3, options='{"bound_px": 4.0, "samples": 10}')
    html = comparison_html(one, other)
    assert "the same problem" in html and "bound px" in html and "samples" not in html
    assert "different problems" in comparison_html(one, replace(other, problem_key="q"))
    assert "bound px" not in comparison_html(one, replace(other, options="[1"))


def test_an_export_is_whole_readable_and_bounded(
    library: RunLibrary, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = [made_row(0, note="=1+1", labels=("a", "b")), made_row(1), made_row(2), made_row(3, file="../secret.rrd")]
    (tmp_path / "secret.rrd").write_bytes(b"secret")
    for row in rows[:2]:
        (library.folder / row.file).write_bytes(row.file.encode())
    (library.folder / "run-0000.review.rrd").write_bytes(b"review")
    path = library.folder / "runs.zip"
    packed = bundle(path, library.folder, rows, 9, NOW, lambda: False)
    with zipfile.ZipFile(path) as archive:
        names = {f"recordings/{name}" for name in ("run-0000.rrd", "run-0000.review.rrd", "run-0001.rrd")}
        assert set(archive.namelist()) == names | {"index.html", "runs.csv"} and archive.testzip() is None
        assert archive.read("recordings/run-0001.rrd") == b"run-0001.rrd"
        page, table = (archive.read(name).decode() for name in ("index.html", "runs.csv"))
    assert "script" not in Elements(page).tags and "default-src 'none'" in page and "spherloc view" in page
    first = next(csv.DictReader(io.StringIO(table)))
    assert first["note"] == "'=1+1" and first["labels"] == "a; b" and first["rotation_error_deg"] == "0.0"
    assert packed.runs == 2 and "2 were left out, since their files are gone" in packed.sentence
    assert "5 more were left out" in packed.sentence
    monkeypatch.setattr(export, "MAX_BYTES", 20)
    assert bundle(path, library.folder, rows, 4, NOW, lambda: False).runs == 1
    with pytest.raises(RecordingError, match="nothing to export"):
        bundle(path, library.folder, rows[2:], 2, NOW, lambda: False)
    with pytest.raises(RecordingError, match="page was closed"):
        bundle(path, library.folder, rows, 4, NOW, lambda: True)
    with pytest.raises(RecordingError, match=r"cannot be written \(.*\); make room"):
        bundle(library.folder / "none" / "runs.zip", library.folder, rows, 4, NOW, lambda: False)


def test_an_export_names_commands_that_there_are() -> None:
    named = set(re.findall("<code>spherloc ([a-z-]+)", summary_html([made_row(1)], "", NOW)))
    assert "repeat" in named and named <= set(app._subcommands)


def test_a_table_has_every_number() -> None:
    found = next(csv.DictReader(io.StringIO(rows_text(Path("recordings"), [made_row(7)], "csv"))))
    assert set(found) == {field.name for field in fields(RunRow)} - {"thumbnail"}
    assert float(found["outlier_rate"]) == 0.7 and found["seed"] == "7"


def test_a_press_is_heard_by_all_who_listen() -> None:
    heard: list[str] = []
    touches = Touches(lambda error: heard.append(type(error).__name__))
    touches.on("views", lambda touch: 1 / 0)
    touches.on("views", lambda touch: heard.append(touch.argument))
    touches.deliver(Touch("views", "Yaw", 0.0, 0.0, 0.0, 0.0, False))
    assert heard == ["ZeroDivisionError", "Yaw"]
    touches.receive(report("views:Charts"))
    assert heard[2:] == ["ZeroDivisionError", "Charts"]


def report(action: str = "select:12", **changes: object) -> str:
    return json.dumps({"action": action, "at": [0.75, 0.5], "from": [0.25, 0.5], "extend": True} | changes)


@pytest.mark.parametrize(
    "wrong",
    [
        *(None, 7, "", "[]", "{}", b"\xff", "[" * 2000, report("views:\ud800"), report(" " * MAX_LETTERS)),
        *(report(at=place) for place in ([0.5], [2.0, 0.5], [float("nan"), 0.5], [10**400, 0.5], "ab", None)),
    ],
)
def test_what_is_no_report_is_no_press(wrong: object) -> None:
    assert parse(wrong) is None
    assert parse(report()) == Touch("select", "12", 0.75, 0.5, 0.25, 0.5, True)
    assert parse(report("select:a:b", extend=1)) == Touch("select", "a:b", 0.75, 0.5, 0.25, 0.5, False)
