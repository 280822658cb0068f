"""A small KITTI-360 in the exact layout, rendered with known truth: loaded, localized, and with holes in it."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from kitti360_tree import CAMERA, QUERIES, QUERY, REFERENCE, REFERENCES, SCENE, scan_of, write_tree

from spherloc.datasets import load_scene
from spherloc.errors import InputError
from spherloc.estimators.base import estimate
from spherloc.geometry import camera_centre, rotation_angle
from spherloc.worlds import build_world, render
from spherloc_viz.commands.verify import run_sessions, tables_text

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        base = tmp_path_factory.mktemp("kitti360")
        patch.setenv("SPHERLOC_CACHE", str(base / "cache"))
        (base / "scene.toml").write_text(SCENE)
        yield write_tree(base / "KITTI-360")


@pytest.fixture
def copy(tree, tmp_path):
    """A tree that the test may damage."""
    root = shutil.copytree(tree.root, tmp_path / "KITTI-360")
    return type(tree)(root, tree.world_from_imu)


def load(tree, *more, without=""):
    """The scene with more lines in its file."""
    path = tree.root.parent / "scene.toml"
    lines = [line for line in SCENE.splitlines() if not without or not line.startswith(without)]
    path.write_text("\n".join([*lines, *more]))
    return load_scene(path)


def errors(cam_from_map, true):
    """Degrees and metres."""
    angle = rotation_angle(true[:, :3].T @ cam_from_map[:, :3])
    return np.degrees(angle), np.linalg.norm(camera_centre(cam_from_map) - camera_centre(true))


def test_localizes_every_query(tree):
    """The whole way from the files to a pose, far within the strictest threshold of Table II."""
    scene = load(tree)
    assert scene.thresholds == ((1.0, 0.5), (2.0, 1.0), (5.0, 2.0))
    assert len(scene.queries) == len(QUERIES)
    for frame, view in zip(QUERIES, scene.queries, strict=True):
        problem = scene.problem(query=view.name)
        assert len(problem) > 100
        found = estimate(problem, "mc-exact").cam_from_map
        degrees, metres = errors(found, tree.cam_from_map(QUERY, frame))
        assert degrees < 0.2 and metres < 0.05


def test_views_are_those_of_the_files(tree):
    scene = load(tree)
    assert [view.name for view in scene.references] == [f"0005/image_02/{frame:010d}.png" for frame in REFERENCES]
    for sequence, frames, views in ((REFERENCE, REFERENCES, scene.references), (QUERY, QUERIES, scene.queries)):
        for frame, view in zip(frames, views, strict=True):
            assert view.path == tree.image(sequence, frame)
            np.testing.assert_allclose(view.cam_from_map, tree.cam_from_map(sequence, frame), atol=1e-9)
            assert view.camera.project(np.array([[0.3, 0.2, 1.0]]))[0] == pytest.approx(
                CAMERA.project(np.array([[0.3, 0.2, 1.0]]))[0], abs=1e-6
            )
            assert view.gravity is None
    # 2013-05-28 08:46:02 UTC and ten frames a second from there
    assert scene.queries[0].timestamp_s == pytest.approx(1369730762 + 3.1 + 0.004094720, abs=1e-5)


def test_points_of_a_moving_scanner_are_where_they_were_seen(tree, monkeypatch):
    """The scanner turns while the car drives: without the correction, what is beside the car is off."""
    view, frame = load(tree).references[1], REFERENCES[1]
    _, true = scan_of(build_world("street"), tree.world_from_imu[REFERENCE], frame)
    off = np.linalg.norm(view.lift.load_points() - true, axis=1)
    monkeypatch.setattr("spherloc.datasets.kitti360.scan_motion", lambda *_: None)
    uncorrected = np.linalg.norm(view.lift.load_points() - true, axis=1)
    assert np.quantile(off, 0.99) < 0.01
    assert np.median(uncorrected) > 0.15 and uncorrected.max() > 0.4


def test_lifted_pixels_are_as_far_as_the_picture_says(tree):
    view = load(tree).references[0]
    columns, rows = np.meshgrid(np.arange(0, 500, 3) + 0.5, np.arange(0, 500, 3) + 0.5)
    points, known = view.lift(np.column_stack([columns.ravel(), rows.ravel()]))
    true = render(build_world("street"), CAMERA, view.cam_from_map).range_m[rows.astype(int), columns.astype(int)]
    off = np.abs(np.linalg.norm(points - camera_centre(view.cam_from_map), axis=1) - true.ravel())[known]
    assert known.mean() > 0.1
    assert np.median(off) < 0.01 and np.quantile(off, 0.85) < 0.15


def test_neighbouring_scans_make_a_denser_cloud(tree):
    """Three scans from three places of the car: all on the surfaces of the world."""
    one, three = (load(tree, f"scans = {count}").references[1].lift.load_points() for count in (1, 3))
    assert len(three) > 2.8 * len(one)
    centre = camera_centre(tree.cam_from_map(REFERENCE, REFERENCES[1]))
    some = three[::50]
    away = np.linalg.norm(some - centre, axis=1)
    seen = build_world("street").rays.cast(centre, (some - centre) / away[:, None]).range_m
    # What the camera sees too, is where the camera sees it.
    assert np.median(np.abs(seen - away)) < 0.02


def test_frames_and_steps(tree):
    assert [view.path.stem for view in load(tree, "reference_frames = [101, 104]").references] == [
        f"{frame:010d}" for frame in (102, 104)
    ]
    assert [view.path.stem for view in load(tree, "reference_step = 2").references] == [
        f"{frame:010d}" for frame in (100, 104)
    ]
    assert [view.path.stem for view in load(tree, "query_frames = [32, 32]").queries] == [f"{32:010d}"]


def test_holes_are_said_counted_and_skipped(copy):
    """An image without a pose, a pose without an image, an image without a scan."""
    lines = copy.poses_file(REFERENCE).read_text().splitlines()
    copy.poses_file(REFERENCE).write_text("\n".join(line for line in lines if not line.startswith("100 ")))
    copy.image(QUERY, 31).unlink()
    copy.scan(REFERENCE, 104).unlink()
    scene = load(copy)
    assert [view.path.stem for view in scene.references] == [f"{102:010d}"]
    assert [view.path.stem for view in scene.queries] == [f"{32:010d}"]
    said = "\n".join(scene.remarks)
    assert "1 (100) of the 3 images of 2013_05_28_drive_0005_sync, image_02, have no pose" in said
    assert "3 (30, 31, 33) of the 4 poses of 2013_05_28_drive_0004_sync have no image" in said
    assert "1 (104) images of 2013_05_28_drive_0005_sync, image_02, have no laser scan" in said


def test_scan_that_cannot_be_corrected_is_said(copy):
    lines = copy.poses_file(REFERENCE).read_text().splitlines()
    kept = [line for line in lines if not line.startswith(("99 ", "101 "))]
    copy.poses_file(REFERENCE).write_text("\n".join(kept))
    assert any("1 (100) of" in remark and "not corrected for motion" in remark for remark in load(copy).remarks)


def test_nothing_left_is_one_sentence(copy):
    for frame in REFERENCES:
        copy.scan(REFERENCE, frame).unlink()
    with pytest.raises(InputError, match=r"there is no reference image; .*3 \(100, 102, 104\) images .* no laser scan"):
        load(copy)


def test_damaged_scan_costs_its_reference_only(copy):
    scan = copy.scan(REFERENCE, 102)
    scan.write_bytes(scan.read_bytes()[:-3])
    scene = load(copy)
    matches = scene.matcher(scene.queries[0])
    assert any("0000000102" in remark and "damaged" in remark for remark in matches.remarks)
    found = estimate(scene.problem_of(scene.queries[0], matches), "mc-exact").cam_from_map
    degrees, metres = errors(found, copy.cam_from_map(QUERY, QUERIES[0]))
    assert degrees < 1.0 and metres < 0.5


CALIBRATION = ("calibration/image_02.yaml", "calibration/calib_cam_to_pose.txt", "calibration/calib_cam_to_velo.txt")


@pytest.mark.parametrize("name", [*CALIBRATION, "data_poses/2013_05_28_drive_0004_sync/poses.txt"])
def test_missing_file_is_named(copy, name):
    (copy.root / name).unlink()
    with pytest.raises(InputError) as caught:
        load(copy)
    assert str(copy.root / name) in str(caught.value) and "missing" in str(caught.value)


@pytest.mark.parametrize(
    "name",
    [
        "data_2d_raw/2013_05_28_drive_0005_sync/image_02/data_rgb",
        "data_2d_raw/2013_05_28_drive_0004_sync/image_02/data_rgb",
        "data_3d_raw/2013_05_28_drive_0005_sync/velodyne_points/data",
    ],
)
def test_missing_folder_is_named(copy, name):
    shutil.rmtree(copy.root / name)
    with pytest.raises(InputError) as caught:
        load(copy)
    assert str(copy.root / name) in str(caught.value) and "missing" in str(caught.value)


def test_queries_need_no_scans_and_times_are_optional(copy):
    (copy.image(QUERY, 0).parent.parent / "timestamps.txt").unlink()
    assert not copy.scan(QUERY, QUERIES[0]).parent.exists()
    assert load(copy).queries[0].timestamp_s is None


@pytest.mark.parametrize(
    "without, line, says",
    [
        ("camera", 'camera = "image_00"', "image_02, image_03"),
        ("camera", "camera = [2]", "image_02, image_03"),
        ("root", 'root = "elsewhere"', "does not exist"),
        ("reference_sequence", "reference_sequence = 6", "2013_05_28_drive_0006_sync"),
        ("reference_sequence", 'reference_sequence = "5"', "whole number"),
        ("query_sequence", "query_sequence = 5", "both query and reference"),
        ("query_sequence", "query_sequence = -1", "whole number"),
        ("x", "query_frames = [40, 30]", "first, last"),
        ("x", "query_frames = [true, 30]", "first, last"),
        ("x", "query_frames = 3", "first, last"),
        ("x", "query_frames = [33, 99]", "no query image"),
        ("x", "reference_step = 0", "whole number"),
        ("x", "scans = 100", "whole number"),
        ("x", "scan = 1", "unknown key"),
    ],
)
def test_wrong_value_is_one_sentence(tree, without, line, says):
    with pytest.raises(InputError) as caught:
        load(tree, line, without=without)
    message = str(caught.value)
    assert message.startswith(str(tree.root.parent)) and says in message and message.isprintable()


def test_car_in_the_image_is_masked(copy):
    """The dataset's mask is not zero where the car itself is seen; it may have another size than the image."""
    mask = np.zeros((250, 125), dtype=np.uint8)
    mask[150:] = 255
    (copy.root / "fisheye").mkdir()
    np.save(copy.root / "fisheye/mask_left_fisheye.npy", mask)
    scene = load(copy)
    usable = scene.queries[0].usable_pixels()
    assert usable[:300].mean() > 0.6 and not usable[300:].any()
    problem = scene.problem()
    assert len(problem) > 20 and problem.pixels[:, 1].max() < 301
    assert load(copy).problem().reference_pixels[:, 1].max() < 301


def test_gravity_and_options_can_be_changed(tree):
    scene = load(tree, "[gravity]", "bound_deg = 4", "[options]", "bound_px = 5", without="x")
    assert scene.gravity_bound_rad == pytest.approx(np.radians(4)) and scene.bound_px == 5
    np.testing.assert_array_equal(scene.gravity_map, [0, 0, -1])
    assert load(tree).gravity_bound_rad == pytest.approx(np.radians(2))


def test_scene_survives_without_the_working_directory(tree, monkeypatch, tmp_path):
    """``root`` is relative to the scene file."""
    scene = load(tree)
    monkeypatch.chdir(tmp_path)
    assert load_scene(Path(scene.where)).references[0].path.is_file()


@pytest.mark.usefixtures("no_pictures")
def test_the_papers_table_of_a_copy_of_the_dataset(tree, tmp_path):
    """Table II by one command: the sessions that are there, by all of its methods, resumed without a run."""
    found = run_sessions({"kitti360": tree.root}, tmp_path, quick=True)
    assert {item.session for item in found} == {"seq1"}
    assert [item.method for item in found] == [
        "MC",
        "2P100",
        "2P1k",
        "SVD100",
        "ML100",
        "mc",
        "mc-exact",
        "ransac-2p 1k",
    ]
    rates = {item.method: [rate.rate for rate in item.summary.success] for item in found}
    assert rates["mc"][-1] == 1.0 and all(len(several) == 3 for several in rates.values())
    assert [(rate.metres, rate.degrees) for rate in found[0].summary.success] == [(0.5, 1.0), (1.0, 2.0), (2.0, 5.0)]
    text = tables_text(found)
    assert "| seq1 | mc |" in text and "| seq2 | ML100 | 0.4 / 8.8 / 39.8 |" in text
    assert "spherloc verify --matterport360 DIR" in text
    before = (tmp_path / "kitti360_seq1" / "MC" / "results.jsonl").read_bytes()
    run_sessions({"kitti360": tree.root}, tmp_path, quick=True)
    assert (tmp_path / "kitti360_seq1" / "MC" / "results.jsonl").read_bytes() == before


def test_a_folder_without_the_papers_sessions_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"holds no session of KITTI-360 .* spherloc scenes kitti360 shows"):
        run_sessions({"kitti360": tmp_path}, tmp_path / "out", quick=True)
    with pytest.raises(InputError, match=r"no such folder; give the folder of Matterport360\."):
        run_sessions({"matterport360": tmp_path / "nowhere"}, tmp_path / "out", quick=True)
