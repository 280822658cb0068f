"""``spherloc runs``, ``steps``, ``label`` and ``reindex`` on real recordings."""

import csv
import io
import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from cli_process import one_sentence, spherloc, spherloc_here
from recording_samples import scene_problem
from run_rows import random_row, some_row

from spherloc.errors import InputError
from spherloc.estimators import default_options, estimate
from spherloc_viz.commands.recording_commands import label, reindex, runs, steps
from spherloc_viz.commands.runs import diagnosis_of, sort_key
from spherloc_viz.recording.content.writer import write_recording
from spherloc_viz.recording.index.query import RunQuery
from spherloc_viz.recording.index.run_index import RunIndex
from spherloc_viz.recording.index.run_text import WIDTH, counts_text, rows_text
from spherloc_viz.recording.index.steps import find_steps
from spherloc_viz.recording.origin import Origin
from spherloc_viz.recording.review_file import read_review, write_review
from spherloc_viz.recording.reviews import Review
from spherloc_viz.recording.run_row import RunRow


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four runs, listed: two right ones, one of too few samples, and one whose truth nobody knows."""
    folder = tmp_path_factory.mktemp("recordings")
    problem = scene_problem("mei_outliers_80")
    hurried = replace(default_options("ransac-2p", problem), iterations=1)
    blind = replace(problem, truth_cam_from_map=None, truth_inliers=None, name="blind")
    traces = {
        "right": estimate(problem, "mc"),
        "sampled": estimate(problem, "ransac-2p"),
        "hurried": estimate(problem, "ransac-2p", hurried),
        "blind": estimate(blind, "mc"),
    }
    for name, trace in traces.items():
        write_recording(trace, folder / f"{name}.rrd", Origin(source="command"))
    with RunIndex(folder) as index:
        assert index.refresh().read == 4
    return folder


@pytest.fixture
def folder(recorded: Path, tmp_path: Path) -> Path:
    """A copy that may be changed."""
    copy = tmp_path / "recordings"
    shutil.copytree(recorded, copy)
    return copy


def listed(capsys: pytest.CaptureFixture[str]) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(capsys.readouterr().out)))


def test_runs_are_filtered_sorted_and_printed(folder: Path, capsys: pytest.CaptureFixture[str]):
    assert runs(folder, csv=True) == 0
    rows = {row["file"]: row for row in listed(capsys)}
    assert set(rows) == {"right.rrd", "sampled.rrd", "hurried.rrd", "blind.rrd"}
    assert {name: row["outcome"] for name, row in rows.items()} == {
        "right.rrd": "success",
        "sampled.rrd": "success",
        "hurried.rrd": "failure",
        "blind.rrd": "unknown",
    }
    asked = {
        "failed": {"failed": True},
        "few": {"inliers": f"<={rows['hurried.rrd']['inliers']}"},
        "far": {"rotation_error": ">1", "sort": "rotation-error"},
        "wrong": {"diagnosis": "iterations", "outliers": "0.8"},
        "fast": {"estimator": "ransac-2p", "outcome": "failure", "since": "1h"},
    }
    for name, words in asked.items():
        assert runs(folder, csv=True, **words) == 0
        assert [row["file"] for row in listed(capsys)] == ["hurried.rrd"], name
    assert runs(folder, csv=True, sort="rotation-error", ascending=True) == 0
    errors = [row["rotation_error_deg"] for row in listed(capsys)]
    assert errors[-1] == "" and [float(e) for e in errors[:-1]] == sorted(float(e) for e in errors[:-1])
    assert runs(folder, until="2020-01-01") == 0
    captured = capsys.readouterr()
    assert captured.out == "" and "no run matches, of 4 runs" in captured.err


def test_forms_say_the_same(folder: Path, capsys: pytest.CaptureFixture[str]):
    with RunIndex(folder) as index:
        rows = index.find(RunQuery()).rows
    runs(folder, json=True)
    tables = json.loads(capsys.readouterr().out)
    assert [table["file"] for table in tables] == [row.file for row in rows]
    for table, row in zip(tables, rows, strict=True):
        assert table["rotation_error_deg"] == row.rotation_error_deg
        assert table["options"] == json.loads(row.options)
        assert "thumbnail" not in table
    runs(folder)
    out = capsys.readouterr().out
    assert all(str(folder / row.file) in out for row in rows)
    assert all(len(line) <= WIDTH for line in out.splitlines() if str(folder) not in line)
    runs(folder, group="outcome", json=True)
    assert json.loads(capsys.readouterr().out) == [
        {"outcome": "success", "runs": 2},
        {"outcome": "failure", "runs": 1},
        {"outcome": "unknown", "runs": 1},
    ]
    runs(folder, group="outcome")
    assert capsys.readouterr().out.splitlines()[0].split() == ["success", "2", "50.0%"]
    runs(folder, limit=1)
    captured = capsys.readouterr()
    assert len(captured.out.splitlines()) == 3 and "1 of 4 runs; --limit 0 shows all" in captured.err


@pytest.mark.parametrize(
    "words, told",
    [
        ({"outcome": "bad"}, "unknown outcome 'bad': choose one of success, failure, unknown"),
        ({"diagnosis": "flu"}, "unknown diagnosis 'flu': choose one of ok, too few inliers, "),
        ({"diagnosis": "e"}, "unknown diagnosis 'e'"),
        ({"estimator": "best"}, "unknown estimator 'best': choose one of auto, mc, "),
        ({"source": "me"}, "unknown source 'me'"),
        ({"sort": "luck"}, "unknown sort 'luck': choose one of created, "),
        ({"group": "luck"}, "unknown group 'luck'"),
        ({"json": True, "csv": True}, "two forms of one answer"),
        ({"outliers": "many"}, "'many' is not a range"),
        ({"since": "long ago"}, "'long ago' is not a time"),
        ({"limit": -1}, "--limit -1 is negative"),
        ({"failed": True, "outcome": "success"}, "exclude each other"),
    ],
)
def test_wrong_words_are_sentences(tmp_path: Path, words: dict, told: str):
    with pytest.raises(InputError) as caught:
        runs(tmp_path, **words)
    assert told in str(caught.value)


def test_groups_of_no_runs_are_a_sentence(folder: Path, capsys: pytest.CaptureFixture[str]):
    assert runs(folder, estimator="ransac-odlt", group="diagnosis") == 0
    captured = capsys.readouterr()
    assert not captured.out and "no run of those that are asked for has a 'diagnosis'" in captured.err


def test_an_unknown_scene_names_those_that_there_are(folder: Path, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(InputError, match="no run of scene 'moon': there are synthetic: N 100, "):
        runs(folder, scene="moon")
    assert runs(folder, scene="blind", csv=True) == 0
    assert [row["file"] for row in listed(capsys)] == ["blind.rrd"]


def test_a_missing_folder_is_a_sentence_and_stays_missing(tmp_path: Path):
    for command in (
        lambda: runs(tmp_path / "none"),
        lambda: reindex(tmp_path / "none"),
        lambda: steps("step=1", tmp_path / "none"),
    ):
        with pytest.raises(InputError, match="no such folder"):
            command()
    assert not (tmp_path / "none").exists()


def test_words_of_the_command_line():
    assert diagnosis_of("Wrong-Reference") == "wrong reference image"
    assert diagnosis_of("ok") == "ok" and diagnosis_of("none") == ""
    assert sort_key("position-error") == "translation_error_m" and sort_key("inliers") == "inliers"


def test_labels_are_given_found_and_taken_away(folder: Path, capsys: pytest.CaptureFixture[str]):
    run = folder / "right.rrd"
    assert label((run,), add=("wrong map", "x"), note="See\nstep 4.") == 0
    assert capsys.readouterr().out == f"{run}: wrong map, x; note: See step 4.\n"
    assert read_review(run) == Review(("wrong map", "x"), "See\nstep 4.")
    runs(folder, label="wrong map", csv=True)
    (row,) = listed(capsys)
    assert (row["file"], row["labels"], row["note"]) == ("right.rrd", "wrong map; x", "See step 4.")
    runs(folder, text="STEP 4")
    assert f"{run} [wrong map] [x] See step 4." in capsys.readouterr().out or len(str(run)) > WIDTH - 33
    assert label((run,), remove=("x",), add=("y",)) == 0
    assert read_review(run) == Review(("wrong map", "y"), "See\nstep 4.")
    capsys.readouterr()
    assert label((run, folder / "none.rrd", folder / "sampled.rrd"), remove=("wrong map",)) == 2
    captured = capsys.readouterr()
    assert f"{run}: y; note" in captured.out
    assert "none.rrd: no such file" in captured.err and "sampled.rrd: has no label 'wrong map'" in captured.err
    label((run,), remove=("y",), note="")
    assert not (folder / "right.review.rrd").exists()


def test_reindex_brings_all_back(folder: Path, capsys: pytest.CaptureFixture[str]):
    """Without the database: rows, labels and notes; what is no run is named, and the others are listed."""
    write_review(folder / "hurried.rrd", ["look"], "note")
    (folder / "gallery").mkdir()
    shutil.copy(folder / "blind.rrd", folder / "gallery" / "case.rrd")
    write_review(folder / "gallery" / "case.rrd", ["of the gallery"], "")
    (folder / "bad.rrd").write_bytes((folder / "blind.rrd").read_bytes()[:5000])
    (folder / "sampled.review.rrd").write_bytes(b"broken")
    with RunIndex(folder) as index:
        index.refresh()
        before = index.find(RunQuery(), None).rows
    (folder / "runs.sqlite").unlink()
    capsys.readouterr()
    assert reindex(folder) == 1
    captured = capsys.readouterr()
    assert "5 runs in " in captured.out and "2 files left out" in captured.out
    assert "bad.rrd: not a whole recording" in captured.err
    assert "sampled.review.rrd: labels and note cannot be read" in captured.err
    with RunIndex(folder) as index:
        assert index.find(RunQuery(), None).rows == before
        assert dict(index.groups(RunQuery(), "label")) == {"look": 1, "of the gallery": 1}
        assert index.get("gallery/case.rrd") is not None


def test_as_a_user_calls_it(folder: Path):
    done = spherloc("runs", "--failed", "--outliers", ">0.7", "--sort", "position-error", cwd=folder.parent)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines()[0].split()[:4] == ["Run", "Estimator", "Outcome", "Diagnosis"]
    assert done.stdout.splitlines()[2].strip() == "recordings/hurried.rrd"
    assert "'x' is not a range" in one_sentence(spherloc_here("runs", "--outliers", "x", cwd=folder.parent))


def test_steps_are_asked_for_over_all_runs(folder: Path, capsys: pytest.CaptureFixture[str]):
    with RunIndex(folder) as index:
        rows = {row.file: row for row in index.find(RunQuery()).rows}
    assert steps("step = key_step AND correspondences = 100", folder, csv=True) == 0
    found = listed(capsys)
    assert {row["file"]: int(row["step"]) for row in found} == {name: row.key_step + 1 for name, row in rows.items()}
    assert steps("position_error_m < 0.1 AND stage = 'Refinement'", folder, json=True) == 0
    near = json.loads(capsys.readouterr().out)
    assert {row["file"] for row in near} == {"right.rrd", "sampled.rrd"}
    last = [row for row in near if row["file"] == "right.rrd"][-1]
    assert last["position_error_m"] == pytest.approx(rows["right.rrd"].translation_error_m)
    assert steps("position_error_m IS NULL AND name = 'blind'", folder) == 0
    out = capsys.readouterr().out
    assert "blind, mc: unknown" in out and "step   1 of" in out and out.count("    step ") > 2
    assert steps("step >= 0", folder, limit=3) == 0
    captured = capsys.readouterr()
    assert captured.out.count("    step ") == 3 and "--limit 0 shows all" in captured.err
    assert steps("agreeing > 1000", folder) == 0
    assert "no step matches in 4 runs" in capsys.readouterr().err
    for condition in ("stage > 3", "step", "step = ", "step = 1 1", "step / 0 = 1", "not " * 240 + "true"):
        with pytest.raises(InputError, match=r"the condition cannot be answered \(.+\): compare columns") as caught:
            steps(condition, folder)
        assert "\n" not in str(caught.value)


def test_steps_count_from_1_in_recordings_of_every_format(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "format_3.rrd").write_bytes((Path(__file__).parent / "data" / "format_3.rrd").read_bytes())
    write_recording(estimate(scene_problem("mei_outliers_80"), "mc"), tmp_path / "now.rrd")
    assert steps("step = key_step OR step < 1 OR step >= steps", tmp_path, csv=True) == 0
    found = {(row["file"], int(row["step"]), int(row["key_step"]), int(row["steps"])) for row in listed(capsys)}
    with RunIndex(tmp_path) as index:
        rows = index.find(RunQuery()).rows
    expected = {
        (row.file, number, row.key_step + 1, row.steps) for row in rows for number in (row.key_step + 1, row.steps)
    }
    assert found == expected and [row.on_timeline(1) for row in sorted(rows, key=lambda row: row.file)] == [0, 1]


def test_steps_of_runs_that_cannot_be_asked(folder: Path, capsys: pytest.CaptureFixture[str]):
    """Copies have the same id, old formats no numbers, and files vanish: none of them costs the others."""
    shutil.copy(folder / "right.rrd", folder / "copy.rrd")
    assert steps("step = 1 AND estimator = 'mc' AND outcome = 'success'", folder, csv=True) == 0
    assert len(listed(capsys)) == 1
    assert "left out" not in capsys.readouterr().err
    with RunIndex(folder) as index:
        rows = index.find(RunQuery()).rows
        (folder / "vanished.rrd").write_text("no run")
        vanished = replace(rows[0], run_id="0", file="vanished.rrd")
        steps_found = find_steps(folder, [vanished, *rows], "step = 1")
        assert steps_found.refused == ("vanished.rrd",)
        (folder / "vanished.rrd").unlink()
        assert {step.run.run_id for step in steps_found.found} == {row.run_id for row in rows}
        for row in rows:
            index.add(replace(row, format_version=1))
    assert steps("step = 1", folder, csv=True) == 0
    assert listed(capsys) == []


def hostile_row() -> RunRow:
    evil = '=HYPERLINK("http://x")\x1b[2J\n<script>\u202e'
    return some_row(
        name=evil, title=evil, note=evil, labels=(evil,), estimator="x" * 60, options="[" * 3000, scene="@x"
    )


@pytest.mark.parametrize("form", ("table", "json", "csv"))
def test_untrusted_strings_cannot_act(form: str):
    """No control character, no formula, one line a row."""
    text = rows_text(Path("recordings"), [hostile_row(), some_row("b.rrd", options='{"a": NaN, "b": 1e999}')], form)
    assert "\x1b" not in text and "\u202e" not in text
    if form == "csv":
        rows = list(csv.DictReader(io.StringIO(text)))
        assert len(rows) == 2
        assert rows[0]["name"].startswith("'=") and rows[0]["scene"] == "'@x" and rows[0]["labels"].startswith("'=")
    elif form == "json":
        assert [row["options"] for row in json.loads(text)] == ["[" * 3000, {"a": "NaN", "b": "inf"}]
    else:
        assert all(len(line) <= WIDTH for line in text.splitlines())
    assert "\x1b" not in counts_text("scene", [("\x1b[2J", 2), ("", 1)], form)


def test_a_table_fits_and_is_aligned(rng):
    rows = [
        replace(random_row(rng, k), name="a long name of a scene " * 3, diagnosis="larger false consensus")
        for k in range(9)
    ]
    rows += [
        replace(rows[0], correspondences=100_000, inliers=99_999, rotation_error_deg=179.9, translation_error_m=1e9)
    ]
    lines = rows_text(Path("recordings"), rows, "table").splitlines()
    assert all(len(line) <= WIDTH for line in lines)
    head = lines[0]
    for name in ("Outcome", "Diagnosis"):
        start = head.index(name)
        assert all(
            line[start - 2 : start] == "  " and line[start] != " " for line in lines[1:] if not line.startswith("    ")
        )
    assert rows_text(Path("recordings"), [], "table") == ""
    assert json.loads(rows_text(Path("recordings"), [], "json")) == []
