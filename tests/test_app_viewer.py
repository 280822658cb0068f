"""The viewer's room behind the front door: a run at a step, all that it loads, and nothing else."""

import asyncio
import base64
import hashlib
import re
import threading
from collections.abc import Awaitable, Callable
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import pytest
import rerun as rr
from recording_samples import scene_problem
from rerun.chunk import Chunk, LazyChunkStream
from test_app_front_door import Door, door_to

from spherloc.errors import InputError, RecordingError
from spherloc.estimators import estimate
from spherloc_viz.app.web import viewer
from spherloc_viz.app.web.access import sorry_page
from spherloc_viz.app.web.viewer import (
    Viewable,
    ViewerRoom,
    of_index,
    viewer_link,
    viewer_page,
    viewer_policy,
)
from spherloc_viz.recording.content.writer import write_recording
from spherloc_viz.recording.index.run_index import RunIndex
from spherloc_viz.recording.rerun_program import viewer_version
from spherloc_viz.recording.review_file import write_review
from spherloc_viz.recording.reviews import review_path
from spherloc_viz.recording.run_row import RunRow
from spherloc_viz.recording.viewer import step_of
from tests.waiting import LIMIT_S

Folder = tuple[Path, RunRow]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Folder:
    """A run with labels, one without, one in the gallery, and what must not be had; and the first run's row."""
    home = tmp_path_factory.mktemp("viewer")
    (home / "secret.rrd").write_bytes(b"secret")
    runs = home / "runs"
    (runs / "gallery").mkdir(parents=True)
    row = write_recording(estimate(scene_problem("mei_outliers_80"), "mc"), runs / "good.rrd")
    write_review(runs / "good.rrd", ["odd"], "a note")
    for copy in ("plain.rrd", "gallery/case.rrd", "damaged.rrd"):
        (runs / copy).write_bytes((runs / "good.rrd").read_bytes())
    review_path(runs / "damaged.rrd").write_bytes(b"no review")
    write_review(runs / "plain.rrd", ["another's"], "", run_id="another")
    (runs / "noise.rrd").write_bytes(bytes(range(256)) * 40)
    (runs / "way-out.rrd").symlink_to(home / "secret.rrd")
    chunk = Chunk.from_columns("/text", [], rr.TextDocument.columns(text=["secret"]))
    LazyChunkStream.from_iter([chunk]).write_rrd(runs / "foreign.rrd", application_id="other", recording_id="1")
    return runs, row


def visit(folder: Path, row: RunRow, calls: Callable[[Door], Awaitable[None]]) -> None:
    """Knock on a front door with the viewer of a folder whose index knows one run."""

    async def run() -> None:
        with RunIndex(folder) as index:
            index.add(row)
            async with door_to(1, viewer=ViewerRoom(of_index(index))) as door:
                await calls(door)

    asyncio.run(asyncio.wait_for(run(), LIMIT_S))


class Parsed(HTMLParser):
    """What a browser makes of a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.body: dict[str, str] = {}
        self.texts: dict[str, str] = {}
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        if tag == "body":
            self.body = {name: value or "" for name, value in attrs}

    def handle_data(self, data: str) -> None:
        last = self.tags[-1] if self.tags else ""
        self.texts[last] = self.texts.get(last, "") + data


def test_a_link_opens_its_run_at_its_step(folder: Folder) -> None:
    async def calls(door: Door) -> None:
        response = await door.get(viewer_link("good.rrd", 2).lstrip("/"))
        assert response.status == 200
        page = Parsed(await response.text())
        assert page.texts["title"].strip() == f"{row.name}, mc, seed 0: step 2 - spherloc"
        assert (page.body["data-timeline"], page.body["data-step"]) == ("step", "2")
        run, review = page.body["data-files"].split()
        assert await (await door.get(run.lstrip("/"))).read() == (runs / "good.rrd").read_bytes()
        assert await (await door.get(review.lstrip("/"))).read() == (runs / "good.review.rrd").read_bytes()
        for url in (run, review):
            again = await door.get(url.lstrip("/"))
            known = await door.get(url.lstrip("/"), **{"If-None-Match": again.headers["ETag"]})
            assert known.status == 304, "unchanged data are not sent again, and changed ones are"
            assert (
                again.headers["Cache-Control"] == "no-cache" and "sandbox" in again.headers["Content-Security-Policy"]
            )

    runs, row = folder
    visit(runs, row, calls)


def test_without_a_step_it_is_the_key_step(folder: Folder) -> None:
    async def calls(door: Door) -> None:
        response = await door.get("viewer/?run=good.rrd")
        assert Parsed(await response.text()).body["data-step"] == str(decided.key_step + 1)

    runs, row = folder
    decided = replace(row, key_step=row.steps - 2)
    visit(runs, decided, calls)


def test_runs_that_the_index_does_not_know_are_examined(folder: Folder) -> None:
    async def calls(door: Door) -> None:
        page = Parsed(await (await door.get(viewer_link("gallery/case.rrd", 1).lstrip("/"))).text())
        run, review = page.body["data-files"].split()
        assert await (await door.get(run.lstrip("/"))).read() == (runs / "gallery/case.rrd").read_bytes()
        assert (await door.get(review.lstrip("/"))).status == 204, "there are no labels"

    runs, row = folder
    visit(runs, row, calls)


def test_the_program_is_fetched_once_for_all_time(folder: Folder) -> None:
    async def calls(door: Door) -> None:
        page = Parsed(await (await door.get("viewer/?run=good.rrd")).text())
        program = page.body["data-program"].lstrip("/")
        assert viewer_version() in program, "so that another version has other addresses"
        wasm = await door.get(f"{program}re_viewer_bg.wasm")
        assert (await wasm.read()).startswith(b"\0asm") and wasm.headers["Content-Type"] == "application/wasm"
        assert "immutable" in wasm.headers["Cache-Control"]
        script = await door.get(f"{program}re_viewer.js")
        assert "wasm_bindgen" in await script.text() and script.headers["Content-Type"] == "text/javascript"
        for wrong in ("viewer/program/0.1.0/re_viewer.js", f"{program}index.html", f"{program}../{viewer_version()}/x"):
            assert (await door.get(wrong)).status == 404

    visit(*folder, calls)


HOSTILE = (
    "?run=../secret.rrd",
    "?run=..%2Fsecret.rrd",
    "?run=%2e%2e%2f%2e%2e%2fetc%2fpasswd",
    "?run=../../etc/passwd",
    "?run=/etc/passwd",
    "?run=way-out.rrd",
    "?run=foreign.rrd",
    "?run=noise.rrd",
    "?run=good.review.rrd",
    "?run=runs.sqlite",
    "?run=unknown.rrd",
    "?run=good.rrd%00.rrd",
    "?run=gallery",
    "?run=" + "a" * 5000 + ".rrd",
    "?run=%ff%fe.rrd",
    "?run=<script>alert(1)</script>.rrd",
    "?run=",
    "",
    "index.html",
    "../viewer/nothing",
    "data/../secret.rrd",
    "data/..%2fsecret.rrd",
    "data/%2e%2e/secret.rrd",
    "data//etc/passwd",
    "data/way-out.rrd",
    "data/foreign.rrd",
    "data/runs.sqlite",
    "data/noise.rrd",
    "data/way-out.review.rrd",
    "data/",
    "program/../../data/good.rrd",
    "program/..%2f..%2fsecret.rrd",
)


def test_nothing_else_is_served(folder: Folder) -> None:
    """Every answer is one sentence, and none has a byte of another file."""

    async def calls(door: Door) -> None:
        host, port = door.url.split("/")[2].split(":")
        for path in HOSTILE:
            reader, writer = await asyncio.open_connection(host, int(port))
            writer.write(f"GET /viewer/{path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n".encode())
            head, _, body = (await reader.read()).partition(b"\r\n\r\n")
            writer.close()
            await writer.wait_closed()
            assert re.match(rb"HTTP/1.1 40[04] ", head), path
            text = " ".join(
                re.sub(r"<title>.*?</title>|<style>.*?</style>|<[^>]+>", "", body.decode(), flags=re.S).split()
            )
            assert text.endswith(".") and "Traceback" not in text, (path, text)
            assert b"secret\n" not in body and b"root:" not in body and b"<script" not in body, path

    visit(*folder, calls)


@pytest.mark.parametrize("step", ["abc", "-1", "1e1", "1.0", "", "99999999999999999999", "4096", "٣", "1&step=abc"])
def test_a_step_that_is_none_is_one_sentence(folder: Folder, step: str) -> None:
    async def calls(door: Door) -> None:
        response = await door.get(f"viewer/?run=good.rrd&step={step}")
        if step == "1&step=abc":
            assert response.status == 200, "the first one counts"
        else:
            assert response.status == 404 and re.search(r"<p>[^<]*step[^<]*\.</p>", await response.text())

    visit(*folder, calls)


@pytest.mark.parametrize("run, words", [("damaged", "cannot be read"), ("plain", "of another run")])
def test_labels_that_cannot_be_shown_are_told(folder: Folder, run: str, words: str) -> None:
    """The run opens all the same: its page shows the sentence that it gets in place of the labels."""

    async def calls(door: Door) -> None:
        assert (await door.get(f"viewer/?run={run}.rrd")).status == 200
        response = await door.get(f"viewer/data/{run}.review.rrd")
        assert response.status == 404 and f"labels and note {words}" in await response.text()

    visit(*folder, calls)


def test_other_sites_are_refused_here_too(folder: Folder) -> None:
    async def calls(door: Door) -> None:
        for path in ("viewer/?run=good.rrd", "viewer/data/good.rrd", f"viewer/program/{viewer_version()}/re_viewer.js"):
            assert (await door.get(path, Host="rebound.example")).status == 403
            assert (await door.get(path, Origin="http://evil.example")).status == 403
            assert (await door.get(path, "POST")).status == 405
            found = await door.get(path)
            assert found.headers["Cross-Origin-Resource-Policy"] == "same-origin"
            assert found.headers["X-Content-Type-Options"] == "nosniff"

    visit(*folder, calls)


def test_a_run_that_goes_meanwhile_is_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewer, "resolve_inside", lambda folder, file: folder / file)
    with RunIndex(tmp_path) as index, pytest.raises(RecordingError, match=r"gone\.rrd: the recording cannot be read"):
        of_index(index)("gone.rrd")


def test_where_nothing_is_recorded_it_says_so() -> None:
    async def calls() -> None:
        async with door_to(1) as door:
            response = await door.get(viewer_link("good.rrd", 1).lstrip("/"))
            assert response.status == 404 and "--no-record" in await response.text()

    asyncio.run(calls())


def test_a_run_that_takes_long_keeps_nobody_waiting() -> None:
    """Its file may have to be examined, and the viewer's program to be unpacked."""

    async def calls() -> None:
        go_on = threading.Event()

        def find(file: str) -> Viewable:
            assert go_on.wait(LIMIT_S)
            raise InputError("Not today.")

        async with door_to(1, viewer=ViewerRoom(find)) as door:
            slow = [asyncio.create_task(door.get(f"viewer/?run={k}.rrd")) for k in range(4)]
            assert (await door.get()).status == 200
            assert not any(task.done() for task in slow)
            go_on.set()
            assert ["Not today." in await (await task).text() for task in slow] == [True] * len(slow)

    asyncio.run(asyncio.wait_for(calls(), LIMIT_S))


def test_policy_lets_nothing_out_and_runs_only_our_script(folder: Folder) -> None:
    page = viewer_page("good.rrd", folder[1], 0, "0.0", "step")
    scripts = re.findall(r"<script\b[^>]*>(.*?)</script>", page, flags=re.DOTALL)
    rules = dict(rule.split(" ", 1) for rule in viewer_policy().split("; "))
    digest = base64.b64encode(hashlib.sha256(scripts[0].encode()).digest()).decode()
    assert len(scripts) == 1 and f"'sha256-{digest}'" in rules["script-src"]
    assert rules["default-src"] == "'none'" and rules["connect-src"] == "'self'"
    assert "unsafe" not in rules["script-src"].replace("'wasm-unsafe-eval'", "")
    assert not re.search(r"https?:|\*", viewer_policy())


def test_what_a_recording_says_is_text(folder: Folder) -> None:
    evil = "</title></p><script>alert(1)</script>\"'><img src=x> $title ${script} {sentence}"
    row = replace(folder[1], name=evil, estimator=evil)
    pages = [
        viewer_page("a b&c.rrd", row, 0, "0.0", "step"),
        viewer_page("a.rrd", replace(row, title=evil), 1, "0", "s"),
    ]
    tags = Parsed(viewer_page("a.rrd", folder[1], 0, "0.0", "step")).tags
    for page in pages:
        assert Parsed(page).tags == tags and evil in Parsed(page).texts["title"]
    assert Parsed(sorry_page(evil)).tags == Parsed(sorry_page("x")).tags and evil in unescape(sorry_page(evil))


def test_links_survive_odd_names() -> None:
    for file in ("gallery/a.rrd", "a b+c&step=9#ü.rrd"):
        parts = urlsplit(viewer_link(file, 7))
        assert parts.path == "/viewer/" and parse_qs(parts.query) == {"run": [file], "step": ["7"]}


def test_step_of(folder: Folder) -> None:
    row = replace(folder[1], steps=5, key_step=3)
    assert [step_of(row, request) for request in (None, 1, 5)] == [4, 1, 5]
    for request in (0, 6):
        with pytest.raises(InputError, match="steps 1 to 5"):
            step_of(row, request)
    assert step_of(replace(row, steps=0, key_step=0), 7) == 7, "the first version does not say how many there are"
