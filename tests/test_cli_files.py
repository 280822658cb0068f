"""What the command line takes for a scene or a recording: names, patterns, and what it lists."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from cli_process import SCENE, one_sentence, spherloc_here

from scripts.documentation import commands, help_of
from spherloc.datasets import bundled_scenes, load_scene, scene_path
from spherloc.estimators import estimate
from spherloc_viz.given_files import without_reviews
from spherloc_viz.recording.content.writer import write_recording
from spherloc_viz.recording.review_file import write_review


@pytest.mark.usefixtures("own_examiner")
def test_labels_that_a_pattern_finds_too_are_no_recordings(tmp_path: Path) -> None:
    row = write_recording(estimate(load_scene(SCENE).problem(1), "ransac-2p", seed=1), tmp_path / "run.rrd")
    write_review(tmp_path / "run.rrd", ["seen"], "", row.run_id)
    files = sorted(path.name for path in tmp_path.glob("*.rrd"))
    assert files == ["run.review.rrd", "run.rrd"]
    result = spherloc_here("label", *files, "--add", "twice", cwd=tmp_path)
    assert (result.returncode, result.stdout, result.stderr) == (0, "run.rrd: seen, twice\n", "")
    assert without_reviews([*map(Path, files)]) == (Path("run.rrd"),)
    assert without_reviews([Path("a.review.rrd")]) == (Path("a.review.rrd"),), "said to be no recording"


def test_scenes_lists_what_play_and_run_accept(tmp_path: Path) -> None:
    bundled, kinds = spherloc_here("scenes", cwd=tmp_path).stdout.split("\n\n")
    rows = [line.split("  ")[1:] for line in bundled.splitlines()[1:] if not line.startswith("    ")]
    by_name = {name: (kind, title) for name, kind, title in rows}
    assert by_name.keys() == bundled_scenes().keys() and len(rows) >= 9
    assert by_name["mei_outliers_80"] == ("synthetic", "MEI fisheye, 80 % outliers")
    assert "rendered" in {kind for kind, _ in by_name.values()}
    listed = [line.split()[0] for line in kinds.splitlines()[1:]]
    assert listed == sorted(listed) and {"correspondences", "kitti360", "colmap", "rendered"} <= set(listed)
    assert "cannot be read" not in kinds


def test_a_file_goes_before_the_bundled_scene_of_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    name = Path("mei_outliers_80")
    assert scene_path(name) == SCENE and scene_path(Path("no_such")) == Path("no_such")
    name.write_text(SCENE.read_text())
    assert scene_path(name) == name


def test_scenes_shows_how_a_kind_is_written(tmp_path: Path) -> None:
    shown = spherloc_here("scenes", "colmap", cwd=tmp_path).stdout
    assert 'kind = "colmap"' in shown and "``" not in shown and "code-block" not in shown
    assert str(SCENE) in spherloc_here("scenes", "synthetic", cwd=tmp_path).stdout
    assert "'magic'" in one_sentence(spherloc_here("scenes", "magic", cwd=tmp_path))


MISSING = (
    *(["run", "missing.toml", "missing.rrd"], ["localize", "missing.toml"], ["sweep", "missing.toml"]),
    *(["play", "missing.toml"], ["play", "missing.rrd"], ["view", "missing.rrd"], ["repeat", "missing.rrd"]),
    *(["label", "missing.rrd", "--add", "seen"], ["runs", "missing"], ["steps", "step = 1", "missing"]),
    ["reindex", "missing"],
)
ENDED = """
import sys
from spherloc_viz.commands.cli import main
try:
    main()
except SystemExit as end:
    print(end.code, *({"numba", "scipy", "cv2", "rerun", "viser", "pyarrow"} & set(sys.modules)))
"""


@pytest.mark.parametrize("words", MISSING, ids=" ".join)
def test_a_missing_file_is_said_before_anything_large_is_imported(words: list[str], tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, "-c", ENDED, *words], cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout.split() == ["2"], done.stderr
    named = [word for word in words if word.startswith("missing")]
    sentences = done.stderr.splitlines()
    assert len(sentences) == len(named)
    for name, sentence in zip(named, sentences, strict=True):
        assert sentence.startswith(f"spherloc: {name}: no such ")


@pytest.mark.parametrize(
    "words",
    [["map"], ["view"], ["repeat"], ["label"], ["runs"], ["reindex"], ["rerun"], ["steps", "step = 1"], ["run"],
     ["diagnose"], ["check-proof"], ["scenes"], ["lesson"], ["gallery"]],
    ids=lambda words: words[0],
)  # fmt: skip
def test_every_command_says_what_another_file_or_folder_is(words: list[str], tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    given = ("a.vrs", "database.db", "a.mp4", "photos/a.png", "photos/b.png", "a_logs.pkl", "a.docx")
    for name in given:
        (tmp_path / name).write_bytes(b"")
    said = {name: "" for name in (*given, "photos")} | {
        "a.vrs": "is a recording of Project Aria's glasses; save its images",
        "database.db": "is a COLMAP database",
        "a.mp4": "is a video; make a map of its frames with: spherloc map frames --video a.mp4",
        "photos/a.png": "is an image; make a map of all images of its folder with: spherloc map photos",
        "photos": "is a folder of 2 images; make a map of it with: spherloc map photos",
        "a_logs.pkl": "is a pickle; if it is a log of hloc, say why its poses are wrong with: spherloc diagnose a_logs",
    }
    for name in given if words == ["map"] else said:
        if (words[0], name) != ("diagnose", "a_logs.pkl"):
            told = one_sentence(spherloc_here(*words, name, cwd=tmp_path))
            assert told.startswith(f"spherloc: {name}: {said[name]}")
    assert not list(tmp_path.rglob("*.sqlite")), "no list of runs among photographs"


def test_runs_of_results_are_no_folder_of_pictures(tmp_path: Path) -> None:
    """Where results are, pictures of trajectories are, too."""
    for name in ("one/trajectory.png", "two/trajectory.png", "two/recordings/a.txt"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    assert "no run matches, of 0 runs in ." in spherloc_here("runs", ".", cwd=tmp_path).stderr


@pytest.mark.parametrize("command", ["", *commands()])
def test_help_tells_no_union_of_types(command: str) -> None:
    """Such as {None}|STR of a flag that may be left out."""
    text = help_of(*command.split())
    assert "show this help" in text and not re.search(r"None\}|\{None|\}\||\|\{", text)
