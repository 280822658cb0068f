"""Poses that another program found: read from its files, recorded, diagnosed, and solved again."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cli_process import spherloc_here
from recording_samples import scene_problem

from spherloc import registry
from spherloc.datasets import bundled_scenes
from spherloc.datasets.match_table import read_match_table
from spherloc.diagnosis import Cause, diagnose
from spherloc.errors import InputError
from spherloc.estimators import estimate, options_type
from spherloc.formats.pose_files import read_poses
from spherloc.geometry import so3_exp
from spherloc.problem import Problem
from spherloc.trajectory import wxyz_from_rotation
from spherloc.types import FloatArray
from spherloc_viz.commands import image_commands
from spherloc_viz.commands.diagnose import diagnose_poses
from spherloc_viz.commands.run import Records
from spherloc_viz.options import usable_estimators
from spherloc_viz.recording.content.data import read_recording
from spherloc_viz.recording.replay import repeat
from spherloc_viz.recording.review_file import read_review
from tests.datasets.hloc_samples import QUERY, make_world, write_all

NAME = "mei_outliers_80"


def words(name: str, pose: FloatArray, sign: str = " ") -> str:
    """A line of a file of poses."""
    return sign.join([name, *(repr(float(x)) for x in (*wxyz_from_rotation(pose[:, :3]), *pose[:, 3]))]) + "\n"


def true_pose() -> FloatArray:
    pose = scene_problem(NAME).truth_cam_from_map
    assert pose is not None
    return pose


def wrong_pose() -> FloatArray:
    turned = so3_exp(np.array([0.0, 0.3, 0.0])) @ true_pose()
    return turned + np.array([[0, 0, 0, 1.0]] * 3)


def test_poses_are_read_from_csv_and_from_lines(tmp_path: Path) -> None:
    text, table = tmp_path / "results.txt", tmp_path / "poses.CSV"
    text.write_text("# hloc\n" + words("a.jpg", true_pose()) + words("b.jpg", wrong_pose()))
    table.write_text("\ufeffScore, name,qw,qx,qy,qz,tx,ty,tz\n" + "3," + words("a.jpg", true_pose(), ",") + "\n")
    lines, cells = read_poses(text), read_poses(table)
    assert list(lines) == ["a.jpg", "b.jpg"] and list(cells) == ["a.jpg"]
    np.testing.assert_allclose(cells["a.jpg"], true_pose(), atol=1e-12)
    np.testing.assert_allclose(lines["b.jpg"], wrong_pose(), atol=1e-12)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("name,qw,qx,qy,qz,tx,ty\n", "has no column tz"),
        ("", "has no column name"),
        ("name,qw,qx,qy,qz,tx,ty,tz\na,1,0,0,0,0,0\n", "line 2: has 7 cells; its first line has 8"),
        ("name,qw,qx,qy,qz,tx,ty,tz\na,1,0,0,0,0,0,x\n", "line 2"),
        ("name,qw,qx,qy,qz,tx,ty,tz\na,1,0,0,0,0,0,nan\n", "line 2"),
        ("name,qw,qx,qy,qz,tx,ty,tz\na,2,0,0,0,0,0,0\n", "has the length 2"),
        ("name,qw,qx,qy,qz,tx,ty,tz\na,1,0,0,0,0,0,0\na,1,0,0,0,0,0,0\n", "line 3: 'a' has two poses"),
        ("\x00\n", "poses.csv"),
    ],
)
def test_wrong_tables_of_poses(content: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    path.write_text(content)
    with pytest.raises(InputError, match=said):
        read_poses(path)


def test_missing_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_poses(tmp_path / "gone.csv")


def test_a_given_pose_is_a_run_that_no_list_offers() -> None:
    assert "given-pose" not in registry.names("estimators") and "given-pose" not in usable_estimators()
    kind, problem = options_type("given-pose"), scene_problem(NAME)
    w, x, y, z = (float(q) for q in wxyz_from_rotation(true_pose()[:, :3]))
    tx, ty, tz = (float(t) for t in true_pose()[:, 3])
    trace = estimate(problem, "given-pose", kind(qw=w, qx=x, qy=y, qz=z, tx=tx, ty=ty, tz=tz))
    assert trace.cam_from_map is not None and problem.truth_inliers is not None
    np.testing.assert_allclose(trace.cam_from_map, true_pose(), atol=1e-12)
    assert trace.inlier_mask[problem.truth_inliers].mean() > 0.9, "the right matches agree with the true pose"
    with pytest.raises(InputError, match="length 1"):
        kind(qw=0.5)
    with pytest.raises(InputError):
        kind(tx=np.inf)


def test_poses_become_runs_with_a_diagnosis(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    poses = tmp_path / "poses.csv"
    head = "name,qw,qx,qy,qz,tx,ty,tz\n"
    poses.write_text(head + words(NAME, wrong_pose(), ",") + words("nobody", true_pose(), ","))
    records = Records(tmp_path / "runs")
    assert diagnose_poses(poses, [bundled_scenes()[NAME]], 4.0, "theirs", True, records) == 1
    told = capsys.readouterr()
    assert "1 of 2 poses have no query" in told.err
    assert json.loads(told.out)["estimator"] == "given-pose"
    (path,) = (path for path in (tmp_path / "runs").glob("*.rrd") if ".review." not in path.name)
    run = read_recording(path)
    assert run.row.outcome == "failure" and run.row.diagnosis == "search missed the best pose"
    assert run.options["bound_px"] == 4.0 and read_review(path).labels == ("theirs",)
    assert run.diagnosis is not None and run.diagnosis.alternative_cam_from_map is not None, "the better pose"
    assert repeat(path).same
    poses.write_text(head + words(NAME, true_pose(), ","))
    assert diagnose_poses(poses, [bundled_scenes()[NAME]], None, None, False, None) == 0
    assert f"{NAME}: " in capsys.readouterr().out
    poses.write_text(head + words("nobody", true_pose(), ","))
    with pytest.raises(InputError, match="no image of a pose is a query"):
        diagnose_poses(poses, [bundled_scenes()[NAME]], None, None, False, None)


def test_queries_of_a_scene_without_a_given_pose_are_counted_and_named(
    tmp_path: Path, rng: np.random.Generator, capsys: pytest.CaptureFixture[str]
) -> None:
    """hloc lists a query that it could not localize, and gives it no line of results."""
    world = write_all(make_world(tmp_path, rng), rng)
    listed = world.folder / "queries.txt"
    camera = listed.read_text().partition(" ")[2]
    for k in range(4):
        (world.folder / "images" / f"lost{k}.jpg").write_bytes(b"")
    listed.write_text(listed.read_text() + "".join(f"lost{k}.jpg {camera}" for k in range(4)))
    poses = tmp_path / "results.txt"
    poses.write_text(words(QUERY, world.truth))
    diagnose_poses(poses, [world.scene], None, None, False, None)
    said = capsys.readouterr().err
    assert "4 queries (lost0.jpg, lost1.jpg, lost2.jpg, ...) of 5 have no pose that is given" in said
    listed.write_text(f"{QUERY} {camera}")
    diagnose_poses(poses, [world.scene], None, None, False, None)
    assert "no pose that is given" not in capsys.readouterr().err


def matches_of(name: str, extra: str = "") -> list[str]:
    problem = scene_problem(NAME)
    rows = np.hstack([problem.pixels, problem.points])
    return [",".join([name, *(repr(float(x)) for x in row)]) + extra for row in rows]


def table_files(folder: Path, *rows: str) -> tuple[Path, Path, Path]:
    """A CSV of matches, a calibration, and a gravity file of the queries a.jpg and b.jpg."""
    matches, camera, gravity = folder / "matches.csv", folder / "camera.toml", folder / "gravity.txt"
    matches.write_text("name,u,v,X,Y,Z\n" + "\n".join(rows) + "\n")
    scene = bundled_scenes()[NAME].read_text()
    camera.write_text("[camera]\n" + scene.partition("[camera]\n")[2].partition("\n[")[0])
    down = scene_problem(NAME).gravity_camera
    gravity.write_text("\n".join(f"{name} {down[0]} {down[1]} {down[2]} 0" for name in ("a.jpg", "b.jpg")) + "\n")
    return matches, camera, gravity


def test_a_better_pose_is_found_although_gravity_has_a_wide_bound() -> None:
    """That of the given pose has one of 5 degrees, within which wrong matches lead a fit away from nine right ones."""
    problem = scene_problem("panorama_outliers_90")
    pose = problem.truth_cam_from_map
    assert pose is not None
    problem = replace(
        problem, pixels=problem.pixels + 0.5, gravity_bound_rad=np.radians(5.0),
        truth_cam_from_map=None, truth_inliers=None,
    )  # fmt: skip
    turned, moved = wxyz_from_rotation(pose[:, :3]), pose[:, 3] + [3.0, 0.0, 1.0]
    numbers = dict(zip(("qw", "qx", "qy", "qz", "tx", "ty", "tz"), map(float, (*turned, *moved)), strict=True))
    diagnosis = diagnose(estimate(problem, "given-pose", options_type("given-pose")(**numbers)))
    assert diagnosis.cause is Cause.SEARCH_MISSED and "one with 9 of 100 matches exists" in diagnosis.summary


def test_matches_of_all_queries_come_in_one_table(tmp_path: Path) -> None:
    # The queries' rows need not be together.
    mixed = [row for pair in zip(matches_of("b.jpg"), matches_of("a.jpg"), strict=True) for row in pair]
    matches, camera, gravity = table_files(tmp_path, *mixed)
    problem = scene_problem(NAME)
    down = tuple(2.0 * float(x) for x in problem.gravity_map)  # of any length
    table = read_match_table(matches, camera, gravity, down)
    poses = {"a.jpg": true_pose()}
    read = table.problem("a.jpg", poses["a.jpg"])
    assert isinstance(read, Problem) and read.name == "a.jpg"
    np.testing.assert_array_equal(read.pixels, problem.pixels)
    np.testing.assert_array_equal(read.points, problem.points)
    np.testing.assert_allclose(read.gravity_map, problem.gravity_map, atol=1e-12)
    np.testing.assert_allclose(read.gravity_camera, problem.gravity_camera, atol=1e-12)
    assert read.gravity_bound_rad == 0.0 and list(table.matches) == ["b.jpg", "a.jpg"]
    # Without a gravity file the poses tell it.
    read = read_match_table(matches, camera, None, down).problem("a.jpg", poses["a.jpg"])
    assert isinstance(read, Problem) and read.gravity_source == "the given pose"
    np.testing.assert_allclose(read.gravity_camera, true_pose()[:, :3] @ problem.gravity_map, atol=1e-12)
    assert np.degrees(read.gravity_bound_rad) == pytest.approx(5.0)


def test_poses_with_a_table_of_matches_are_diagnosed(tmp_path: Path) -> None:
    matches, camera, gravity = table_files(tmp_path, *matches_of("a.jpg"), *matches_of("b.jpg"), "c.jpg,1,2,3,4,5")
    rows = (words("a.jpg", true_pose(), ","), words("b.jpg", wrong_pose(), ","), words("c.jpg", true_pose(), ","))
    (tmp_path / "poses.csv").write_text("name,qw,qx,qy,qz,tx,ty,tz\n" + "".join(rows))
    down = [repr(float(x)) for x in scene_problem(NAME).gravity_map]
    files = ["--matches", matches, "--camera", camera, "--gravity", gravity, "--recordings", "runs"]
    done = spherloc_here("diagnose", "poses.csv", *files, "--map-down", *down, cwd=tmp_path)
    assert done.returncode == 2 and "c.jpg: has no row in the gravity file" in done.stderr
    assert "a.jpg: " in done.stdout and "b.jpg: " in done.stdout and "search missed the best pose" in done.stdout
    recorded = [path for path in (tmp_path / "runs").glob("*.rrd") if ".review." not in path.name]
    assert len(recorded) == 2 and all(repeat(path).same for path in recorded)


def test_a_principal_point_that_seems_to_be_wrong_is_told_of_a_table(tmp_path: Path, capsys) -> None:
    matches, camera, gravity = table_files(tmp_path, *matches_of("a.jpg"), *matches_of("b.jpg"))
    poses, down = tmp_path / "poses.txt", tuple(map(float, scene_problem(NAME).gravity_map))
    poses.write_text(words("a.jpg", true_pose()))
    right = camera.read_text()
    for changed, said in ((right, ""), (re.sub(r"(?m)^cx = .*", "cx = 1500.0", right), "is at 1500, ")):
        camera.write_text(changed)
        table = read_match_table(matches, camera, gravity, down)
        diagnose_poses(poses, [table], None, None, False, None)
        told = [line for line in capsys.readouterr().err.splitlines() if "The principal point of" in line]
        assert len(told) == bool(said) and all(f"of the camera of a.jpg {said}" in line for line in told)
        problem = table.problem("a.jpg", None)
        assert isinstance(problem, Problem) and len(problem.remarks) == bool(said)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("u,v,X,Y,Z\n1,2,3,4,5\n", "column 'name' is missing"),
        ("name,name,u,v,X,Y,Z\n", "column 'name' is given twice"),
        ("name,u,v,X,Y,Z\na,1,2,3,4\n", "line 2: 5 values under 6 columns"),
        ("name,u,v,X,Y,Z\na,1,2,3,4,nan\n", "line 2: Z is nan"),
    ],
)
def test_wrong_tables_of_matches(content: str, said: str, tmp_path: Path) -> None:
    matches, camera, _ = table_files(tmp_path)
    matches.write_text(content)
    with pytest.raises(InputError, match=said):
        read_match_table(matches, camera, None, (0.0, 0.0, -1.0))


def test_arguments_that_do_not_go_together(tmp_path: Path) -> None:
    matches, camera, gravity = table_files(tmp_path, *matches_of("a.jpg"))
    poses = tmp_path / "poses.csv"
    poses.write_text("name,qw,qx,qy,qz,tx,ty,tz\n" + words("a.jpg", true_pose(), ","))
    for given, said in (
        ({}, "no scene given"),
        ({"model": tmp_path}, "or with hloc's log"),
        ({"matches": matches}, "needs --camera"),
        ({"gravity": gravity, "scene": bundled_scenes()[NAME]}, "nor --gravity goes with scenes"),
        ({"matches": matches, "camera": camera, "map_down": (0.0, 0.0, 0.0)}, "has the length 0"),
    ):
        scenes = (given.pop("scene"),) if "scene" in given else ()
        with pytest.raises(InputError, match=said):
            image_commands.diagnose(poses, scenes, record=False, **given)
