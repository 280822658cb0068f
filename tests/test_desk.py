"""The triage desk without a browser: its columns, its map, comparisons against known answers, files, and its door."""

import asyncio
import json
import math
import re
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from aiohttp import ClientResponse
from recording_samples import scene_problem
from run_rows import some_row
from scipy import stats
from test_app_front_door import Door, door_to

from spherloc.diagnosis import Measures, diagnose
from spherloc.errors import InputError, RecordingError
from spherloc.estimators import default_options, estimate
from spherloc_viz.app.desk import files
from spherloc_viz.app.desk.columns import NUMBERS, READ, TEXTS, columns_json
from spherloc_viz.app.desk.comparison import compare, compare_pairs, parse_condition
from spherloc_viz.app.desk.page import COLUMNS, desk_page
from spherloc_viz.app.desk.report import comparison_html, comparison_text
from spherloc_viz.app.desk.run_map import FEATURES, run_map
from spherloc_viz.app.review.run_library import RunLibrary
from spherloc_viz.app.web.desk import MAX_REVIEWED, DeskRoom
from spherloc_viz.app.web.downloads import Downloads
from spherloc_viz.recording.content.data import read_recording
from spherloc_viz.recording.content.writer import write_recording
from spherloc_viz.recording.index.query import PAGE_KEPT, RunQuery
from spherloc_viz.recording.index.run_index import RunIndex
from spherloc_viz.recording.origin import Origin
from spherloc_viz.recording.run_row import RunRow
from spherloc_viz.recording.storage.store import RecordingStore
from tests.waiting import LIMIT_S

NOW = datetime(2026, 1, 2, tzinfo=UTC)


def night(count: int, prefix: str = "a", right: Callable[[int], bool] = lambda k: True, **changes: Any) -> list[RunRow]:
    """Runs of different problems."""
    return [
        some_row(
            f"{prefix}{k:03d}.rrd",
            problem_key=f"p{k}",
            outcome="success" if right(k) else "failure",
            rotation_error_deg=float(k),
            **changes,
        )
        for k in range(count)
    ]


# Measures and columns.


def test_measures_say_what_a_run_is_like_and_survive_the_recording(tmp_path: Path) -> None:
    problem = scene_problem("mei_outliers_80")
    trace = estimate(problem, "mc-exact")
    diagnosis = diagnose(trace)
    measures = diagnosis.measures
    assert measures.certificate_gap == 0.0 and trace.certificate is not None and trace.certificate.proven
    assert measures.residual_median is not None and measures.residual_p90 is not None
    assert 0.0 < measures.residual_median < measures.residual_p90 <= 1.0
    assert measures.alternative_support is not None and measures.alternative_support < 0.5, "a clear winner"
    assert measures.position_sd_m is not None and 0.0 < measures.position_sd_m < 0.1
    assert measures.coverage is not None and 0.0 < measures.coverage <= 1.0
    row = write_recording(trace, tmp_path / "a.rrd", diagnosis=diagnosis)
    assert row.certificate_gap == 0.0 and row.residual_p90 == measures.residual_p90
    found = read_recording(tmp_path / "a.rrd").diagnosis
    assert found is not None and found.measures == measures


def test_columns_are_those_of_the_index(tmp_path: Path) -> None:
    rows = [
        some_row("b.rrd", created="2026-01-02T03:04:06.000+00:00", tilt_deg=1.23456789, labels=("x", "y"), note="n"),
        some_row("a.rrd", metric=False, doubtful=None, proven=True, outlier_rate=None, time_ms=float("1e300")),
    ]
    with RunIndex(tmp_path) as index:
        for row in rows:
            (tmp_path / row.file).touch()
        index.add_all(rows)
        columns, notes = index.columns(READ)
    told = json.loads(columns_json(columns, notes, "7"))
    assert told["files"] == ["a.rrd", "b.rrd"] and told["version"] == "7" and told["notes"] == {"b.rrd": "n"}
    values, codes = told["texts"]["proven"]["values"], told["texts"]["proven"]["codes"]
    assert [values[code] for code in codes] == ["yes", ""]
    values, codes = told["texts"]["units"]["values"], told["texts"]["units"]["codes"]
    assert [values[code] for code in codes] == ["units", "m"], "older recordings are metric"
    assert told["numbers"]["outlier_rate"] == [None, 0.75] and told["numbers"]["tilt_deg"] == [None, 1.2346]
    assert told["numbers"]["key_step"] == [13, 13], "counted from 1, as the page and Rerun do"
    assert [json.loads(told["labels"]["values"][code]) for code in told["labels"]["codes"]] == [[], ["x", "y"]]
    assert set(COLUMNS) - {"labels"} <= {*TEXTS, *NUMBERS, "doubtful", "proven", "units"}


def test_the_map_is_that_of_principal_components() -> None:
    rng = np.random.default_rng(5)
    apart = rng.uniform(1.0, 2.0, (200, 1)) * rng.uniform(0.5, 2.0, 8) + 0.01 * rng.normal(size=(200, 8))
    columns = {name: list(apart[:, k]) for k, name in enumerate(FEATURES)}
    drawn = run_map(columns)
    assert np.var(drawn.x) > 20 * np.var(drawn.y), "one direction has nearly all"
    assert abs(np.dot(drawn.x, drawn.y)) < 1e-6 * len(drawn.x) and abs(drawn.x.mean()) < 1e-9
    again = run_map(columns)
    assert np.array_equal(again.x, drawn.x) and drawn.x_words == again.x_words
    unknown = run_map({name: [None] * 3 for name in FEATURES})
    assert not unknown.x.any() and unknown.x_words == ""
    assert len(run_map({name: [] for name in FEATURES}).x) == 0
    some = {name: [None, 1.0, 2.0] for name in FEATURES}
    assert np.isfinite(run_map(some).x).all() and len(set(run_map(some).x.round(6))) > 1


# Two sets of runs.


def test_a_comparison_counts_and_tests_what_changed() -> None:
    before = night(30, "a", lambda k: k >= 5)
    after = [replace(row, rotation_error_deg=row.rotation_error_deg + 1.0) for row in night(30, "b", lambda k: k < 28)]
    found = compare(before, after)
    assert len(found.pairs) == 30 and [pair.after.file for pair in found.broken] == ["b028.rrd", "b029.rrd"]
    assert len(found.mended) == 5 and found.right_before == 25 and found.right_after == 28
    assert found.p == pytest.approx(stats.binomtest(2, 7).pvalue)
    turn = found.changes[0]
    assert turn.difference == 1.0 and turn.pairs == 30 and turn.p == pytest.approx(stats.wilcoxon(np.ones(30)).pvalue)
    assert found.changes[2].p == 1.0, "no time differs"
    text = comparison_text(found, "monday", "tuesday")
    assert "new failures 2, mended 5" in text and "b029.rrd" in text
    html = comparison_html(found, "monday", "<i>", NOW)
    assert "2 new failures, 5 mended" in html and "<i>" not in html and "b028.rrd" in html


def test_pairs_are_by_what_both_sides_share() -> None:
    one, other = night(4, "a", estimator="mc"), night(4, "b", estimator="ransac-2p", seed=9)
    assert len(compare(one, other).pairs) == 4, "different estimators and seeds: by the problem"
    both = [*one, *night(4, "c", estimator="ransac-2p")]
    found = compare(both, other)
    assert {pair.before.file[0] for pair in found.pairs} == {"c"}, "the same estimator, if it is there"
    assert found.only_before == 4
    newest = replace(one[0], file="z.rrd", created="2027-01-01T00:00:00.000+00:00")
    assert compare([newest, *one], other).pairs[0].before.file == "z.rrd"
    with pytest.raises(InputError, match="no problem occurs in both"):
        compare(one, night(3, "b", **{"scene": "x"})[:0])
    with pytest.raises(InputError):
        compare(one, one)


def test_without_the_truth_the_diagnosis_judges() -> None:
    before, after = some_row("a", outcome="unknown", doubtful=False), some_row("b", outcome="unknown", doubtful=True)
    assert len(compare([before], [after]).broken) == 1
    undiagnosed = replace(after, doubtful=None)
    found = compare([before], [undiagnosed])
    assert found.judged == 0 and not found.broken and not parse_condition("success < 1").holds(found)


@pytest.mark.parametrize(
    ("text", "holds"),
    [
        ("new failures > 0", True),
        ("new failures > 2", False),
        ("NEW FAILURES >= 2", True),
        ("success < 95 %", True),
        ("success < 0.5", False),
        ("mended = 5 and p > 0.05", True),
        ("mended = 5 and p < 0.05", False),
        ("net failures < 0", True),
        ("unpaired > 0", False),
    ],
)
def test_conditions(text: str, holds: bool) -> None:
    found = compare(night(30, "a", lambda k: k >= 5), night(30, "b", lambda k: k < 28))
    assert parse_condition(text).holds(found) is holds


@pytest.mark.parametrize("text", ["", "failures", "> 3", "new failures > ", "p ~ 3", "speed > 1", "p > 1.2.3", "p > ."])
def test_what_is_no_condition(text: str) -> None:
    with pytest.raises(InputError, match=r"quantities are new failures, mended"):
        parse_condition(text)


def test_no_pair_has_no_numbers() -> None:
    found = compare_pairs((), 3)
    assert (
        math.isnan(found.changes[0].before)
        and found.p == 1.0
        and "none can be judged" in comparison_text(found, "", "")
    )


# Views and sets.


def test_views_and_sets_are_files(tmp_path: Path) -> None:
    files.save_view(tmp_path, "hard ones", {"search": "x"})
    files.save_view(tmp_path, "hard ones", {"search": "y"})
    assert files.views(tmp_path) == {"hard ones": {"search": "y"}}
    (tmp_path / "views" / "bad.json").write_text("[1")
    assert list(files.views(tmp_path)) == ["hard ones"]
    files.delete_view(tmp_path, "hard ones")
    files.delete_view(tmp_path, "hard ones")
    assert files.views(tmp_path) == {}
    path = files.save_set(tmp_path, "night", ["b.rrd", "a.rrd", "b.rrd"])
    assert files.read_set(path) == ("b.rrd", "a.rrd") and files.sets(tmp_path) == {"night": 2}
    with pytest.raises(InputError, match="no run is selected"):
        files.save_set(tmp_path, "none", [])
    with pytest.raises(RecordingError, match="cannot be read"):
        files.read_set(tmp_path / "sets" / "gone.txt")


@pytest.mark.parametrize("name", ["", "../up", "a/b", ".hidden", "x" * 61, "ä", "a\nb", "a\\b"])
def test_names_stay_inside_the_folder(name: str, tmp_path: Path) -> None:
    for act in (
        lambda: files.save_view(tmp_path, name, {}),
        lambda: files.save_set(tmp_path, name, ["a"]),
        lambda: files.delete_view(tmp_path, name),
        lambda: files.set_path(tmp_path, name),
    ):
        with pytest.raises(InputError, match="cannot be the name of a file"):
            act()
    assert not list(tmp_path.iterdir())


# The door.


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with three real runs."""
    folder = tmp_path_factory.mktemp("desk") / "runs"
    folder.mkdir()
    problem = scene_problem("mei_outliers_80")
    for name, estimator in (("a", "mc"), ("b", "ransac-2p"), ("c", "mc-exact")):
        write_recording(estimate(problem, estimator), folder / f"{name}.rrd")
    return folder


def visit(
    folder: Path, calls: Callable[[Door], Awaitable[None]], token: bool = False, allowed: Sequence[Path] = ()
) -> None:
    async def run() -> None:
        with RunIndex(folder) as index:
            index.refresh()
            downloads = Downloads()
            room = DeskRoom(RunLibrary(index), downloads, allowed)
            async with door_to(1, token=token, downloads=downloads, desk=room) as door:
                await calls(door)
            downloads.close()

    asyncio.run(asyncio.wait_for(run(), LIMIT_S))


async def do(door: Door, what: object, **headers: str) -> ClientResponse:
    """Ask the desk to do something, as its page does."""
    given = {"Origin": door.url.rstrip("/"), "Content-Type": "application/json"} | headers
    body = what if isinstance(what, bytes) else json.dumps(what).encode()
    return await door.post("desk/do", body, **{name: value for name, value in given.items() if value})


def test_the_page_and_what_it_shows(recorded: Path) -> None:
    async def calls(door: Door) -> None:
        response = await door.get("desk")
        page = await response.text()
        assert response.headers["Content-Security-Policy"] == desk_page()[1] and "Triage desk" in page
        assert not re.search(r'(src|href)="(?!/|data:)', page), "nothing from elsewhere"
        told = await (await door.get("desk/runs", **{"Accept-Encoding": "gzip"})).json()
        assert told["files"] == ["a.rrd", "b.rrd", "c.rrd"]
        plain = await (await door.get("desk/runs", **{"Accept-Encoding": "identity"})).json()
        assert plain == told and (await (await door.get("desk/version")).json())["version"] == told["version"]
        run = await (await door.get("desk/run?run=a.rrd")).json()
        assert run["outcome"] == "success" and run["viewer"] == f"/viewer/?run=a.rrd&step={run['step']}"
        evidence = await (await door.get("desk/evidence?run=a.rrd")).json()
        assert any("agree" in sentence for sentence in evidence["evidence"])
        picture = await door.get("desk/picture?run=a.rrd")
        assert (await picture.read()).startswith(b"\x89PNG") and picture.content_type == "image/png"
        for wrong in ("desk/run?run=../a.rrd", "desk/evidence?run=/etc/passwd", "desk/picture", "desk/else"):
            response = await door.get(wrong)
            assert response.status == 404 and "error" in await response.json(), wrong

    visit(recorded, calls)


def test_labels_are_given_taken_back_and_kept(recorded: Path) -> None:
    async def calls(door: Door) -> None:
        changes = [
            {"file": name, "add": ["odd"], "remove": [], "note": None} for name in ("a.rrd", "b.rrd", "gone.rrd")
        ]
        told = await (await do(door, {"do": "review", "changes": changes})).json()
        assert [run["labels"] for run in told["done"]] == [["odd"], ["odd"]] and told["failed"][0]["file"] == "gone.rrd"
        note = [{"file": "a.rrd", "add": ["seen"], "remove": ["odd"], "note": "look"}]
        (run,) = (await (await do(door, {"do": "review", "changes": note})).json())["done"]
        assert run == {"file": "a.rrd", "before": ["odd"], "noteBefore": "", "labels": ["seen"], "note": "look"}
        runs = await (await door.get("desk/runs")).json()
        assert runs["notes"] == {"a.rrd": "look"} and runs["version"] != told["version"]
        many = [changes[0]] * (MAX_REVIEWED + 1)
        assert (await do(door, {"do": "review", "changes": many})).status == 400

    visit(recorded, calls)


def test_sets_are_compared_and_reported(recorded: Path) -> None:
    async def calls(door: Door) -> None:
        stored = await (await do(door, {"do": "save_set", "name": "one", "files": ["a.rrd", "gone.rrd"]})).json()
        assert stored["runs"] == 1 and stored["sets"] == {"one": 1}
        asked = {"do": "compare", "before_set": "one", "after": ["c.rrd"], "before_name": "one", "after_name": "<b>"}
        told = await (await do(door, asked)).json()
        assert told["pairs"] == 1 and told["broken"] == [] and told["rightAfter"] == 1
        html = await (await door.get(told["address"].lstrip("/"))).text()
        assert "0 new failures, 0 mended" in html and "<b> against" not in html
        report = await (await do(door, {"do": "report", "files": ["a.rrd", "b.rrd"]})).json()
        html = await (await door.get(report["address"].lstrip("/"))).text()
        assert "2 recorded runs" in html and html.count("data:image/png") == 2
        saved = await (await door.get("desk/saved")).json()
        assert saved == {"views": {}, "sets": {"one": 1}}
        refused = await do(
            door, {"do": "compare", "before": ["a.rrd"], "after": [], "before_name": "", "after_name": ""}
        )
        assert refused.status == 400 and "no problem occurs in both" in (await refused.json())["error"]

    visit(recorded, calls)


def test_a_folder_is_compared_with_another_one_that_may_be_opened(recorded: Path, tmp_path: Path) -> None:
    other = tmp_path / "nights" / "tuesday"
    secret = tmp_path / "secret"
    for folder in (other, secret, other / "gallery"):
        RunIndex(folder).close()
    lost = replace(default_options("ransac-2p", scene_problem("mei_outliers_80")), iterations=1)
    write_recording(estimate(scene_problem("mei_outliers_80"), "ransac-2p", lost, 1), other / "x.rrd")
    (tmp_path / "nights" / "way out").symlink_to(secret)

    async def calls(door: Door) -> None:
        told = await (await door.get("desk/folders")).json()
        assert told == {"folders": [{"place": "1:tuesday", "name": "nights/tuesday"}]}
        asked = {"do": "compare", "before": ["b.rrd"], "before_name": "monday", "after_name": "tuesday"}
        found = await (await do(door, asked | {"after_folder": "1:tuesday"})).json()
        assert found["broken"] == [["b.rrd", "x.rrd"]] and found["pairs"] == 1
        for place in ("1:../secret", "1:way out", "0:..", "9:", "1:", str(other), "1:tuesday/gone"):
            refused = await do(door, asked | {"after_folder": place})
            assert refused.status == 400 and "error" in await refused.json(), place

    visit(recorded, calls, allowed=[tmp_path / "nights"])


@pytest.mark.parametrize(
    "what",
    [
        b"{",
        b"[" * 100_000,
        b"\xff",
        [],
        {},
        {"do": "format"},
        {"do": "review"},
        {"do": "review", "changes": [3]},
        {"do": "review", "changes": [{"file": "a.rrd", "add": [3]}]},
        {"do": "review", "changes": [{"file": "a.rrd", "note": 3}]},
        {"do": "save_view", "name": "x", "state": []},
        {"do": "save_view", "name": "../x", "state": {}},
        {"do": "save_view", "name": "x", "state": {"a": "b" * 30_000}},
        {"do": "save_set", "name": "x", "files": []},
        {"do": "report", "files": ["gone.rrd"]},
        {"do": "compare"},
    ],
    ids=lambda what: str(what)[:40],
)
def test_what_the_desk_cannot_do(what: object, recorded: Path) -> None:
    async def calls(door: Door) -> None:
        response = await do(door, what)
        assert response.status == 400 and (await response.json())["error"].endswith(".")

    visit(recorded, calls)


def test_nobody_else_may_ask(recorded: Path) -> None:
    view = {"do": "save_view", "name": "stolen", "state": {}}

    async def calls(door: Door) -> None:
        assert (await do(door, view, Origin="http://evil.example")).status == 403
        assert (await do(door, view, Origin="")).status == 403, "a POST without an origin is no page of ours"
        assert (await do(door, view, **{"Content-Type": "text/plain"})).status == 400, "as a foreign form sends it"
        assert (await door.post("desk/runs", b"{}", Origin=door.url.rstrip("/"))).status == 405
        assert files.views(recorded) == {}

    visit(recorded, calls)

    async def untrusted(door: Door) -> None:
        assert (await door.get("desk")).status == 403 and (await do(door, view)).status == 403

    visit(recorded, untrusted, token=True)

    async def without() -> None:
        async with door_to(1) as door:
            assert (await door.get("desk")).status == 404

    asyncio.run(asyncio.wait_for(without(), LIMIT_S))


# Order in the folder.


def test_page_runs_are_apart_and_few_are_kept(tmp_path: Path) -> None:
    times = [f"2026-01-01T00:{k // 60:02d}:{k % 60:02d}.000+00:00" for k in range(PAGE_KEPT + 6)]
    rows = [some_row(f"p{k:03d}.rrd", source="page", created=created) for k, created in enumerate(times)]
    rows[0] = replace(rows[0], labels=("kept",))
    rows[1] = replace(rows[1], note="look at this")
    with RecordingStore(tmp_path, lambda sentence: None) as store:
        for row in (*rows, some_row("n.rrd", source="sweep", problem_key="other")):
            (tmp_path / row.file).touch()
            store.index.add(row)
        assert store.index.find(RunQuery(pages=False), 0).total == 2, "a labelled run is listed with the others"
        assert store.index.find(RunQuery(pages=True), 0).total == PAGE_KEPT + 5
        assert [row.file for row in store.index.old_page_runs(PAGE_KEPT)] == [f"p{k:03d}.rrd" for k in range(2, 6)]
        trace = estimate(scene_problem("mei_outliers_80"), "mc")
        assert store.known(trace, "page") is None
        path = store.record(trace, Origin("page"))
        assert store.known(trace, "page") == path and store.known(trace, "command") is None
        left = {file.name for file in tmp_path.glob("p*.rrd")}
        assert {"p000.rrd", "p001.rrd"} <= left and len(left) == PAGE_KEPT + 1 and "p002.rrd" not in left
        assert "p002.rrd" in (tmp_path / "pruned.log").read_text()
        path.unlink()
        assert store.known(trace, "page") is None


def test_measures_have_columns() -> None:
    assert set(Measures.__dataclass_fields__) == set(FEATURES) and set(FEATURES) <= set(COLUMNS)
