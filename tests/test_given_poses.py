"""Poses that another program found: read from its files, recorded, diagnosed, and solved again."""

import json
from pathlib import Path

import numpy as np
import pytest
from recording_samples import scene_problem

from spherloc import registry
from spherloc.datasets import bundled_scenes
from spherloc.errors import InputError
from spherloc.estimators import estimate, options_type
from spherloc.formats.pose_files import read_poses
from spherloc.geometry import so3_exp
from spherloc.trajectory import wxyz_from_rotation
from spherloc.types import FloatArray
from spherloc_viz.batch import Records
from spherloc_viz.given_poses import diagnose_poses
from spherloc_viz.options import usable_estimators
from spherloc_viz.recording.content.data import read_recording
from spherloc_viz.recording.replay import repeat
from spherloc_viz.recording.reviews import read_review

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


def test_pickles_are_refused_and_missing_files_named(tmp_path: Path) -> None:
    (tmp_path / "logs.pkl").write_bytes(b"cos\nsystem\n(S'touch /tmp/owned'\ntR.")
    with pytest.raises(InputError, match="is a pickle, which could run code"):
        read_poses(tmp_path / "logs.pkl")
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
