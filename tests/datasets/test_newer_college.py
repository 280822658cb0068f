"""A small Newer College, rendered with known truth: loaded, placed, localized with the IMU's gravity, with holes."""

import shutil
import tomllib

import numpy as np
import pytest
from newer_college_tree import (
    CAM_FROM_BASE,
    CAM_FROM_IMU,
    CAMERA,
    MODEL,
    PRIOR_MAP,
    QUERY_TIMES,
    QUERY_WALK,
    REFERENCE_TIMES,
    REFERENCE_WALK,
    SCENE,
    between,
    image_name,
    map_from_model,
    write_ground_truth,
    write_tree,
)

from spherloc.datasets import load_scene
from spherloc.errors import InputError
from spherloc.estimators.base import estimate
from spherloc.geometry import camera_centre, rotation_angle
from spherloc.verification.sessions import DATASETS, sessions_of
from spherloc_viz.commands.verify import run_sessions

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

GOOD = QUERY_TIMES[1:3]
GIVEN = f"map_from_model = {map_from_model().tolist()}\n"


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        base = tmp_path_factory.mktemp("newer_college")
        patch.setenv("SPHERLOC_CACHE", str(base / "cache"))
        write_tree(base / "newer-college", np.random.default_rng(3))
        yield base


@pytest.fixture
def copy(base, tmp_path):
    """A tree that the test may damage."""
    shutil.copytree(base / "newer-college", tmp_path / "newer-college")
    return tmp_path


def load(base, text=MODEL, without=()):
    path = base / "scene.toml"
    lines = [line for line in SCENE.splitlines() if not line.startswith(tuple(f"{key} " for key in without))]
    path.write_text("\n".join(lines) + "\n" + text)
    return load_scene(path)


def errors(cam_from_map, true):
    """Degrees and metres."""
    angle = rotation_angle(true[:, :3].T @ cam_from_map[:, :3])
    return np.degrees(angle), np.linalg.norm(camera_centre(cam_from_map) - camera_centre(true))


@pytest.mark.parametrize("kind", [MODEL, MODEL + GIVEN, PRIOR_MAP])
def test_localizes_every_query(base, kind):
    """From the files to a pose, within the strictest threshold of Table IV of the exact pose, not of the file's."""
    scene = load(base, kind)
    assert scene.thresholds == ((2.0, 0.25), (5.0, 0.5), (8.0, 1.0))
    assert [view.name for view in scene.queries] == [image_name(time) for time in GOOD]
    for time, view in zip(GOOD, scene.queries, strict=True):
        problem = scene.problem(query=view.name)
        found = estimate(problem, "mc-exact" if kind == MODEL else "mc").cam_from_map
        degrees, metres = errors(found, QUERY_WALK.cam_from_map(time))
        assert degrees < 1.5 and metres < 0.15, f"{degrees} degrees, {metres} m of {len(problem)} matches"


def test_gravity_comes_from_the_imu(base):
    """The device is tilted by up to 12 degrees: within the bound of what is down there."""
    scene = load(base)
    assert scene.gravity_bound_rad == pytest.approx(np.radians(3.0))
    for time, view in zip(GOOD, scene.queries, strict=True):
        down = QUERY_WALK.cam_from_map(time)[:, :3] @ [0.0, 0.0, -1.0]
        assert np.arccos(view.gravity.down @ down) < 0.5 * scene.gravity_bound_rad
        assert np.arccos(down @ [0.0, 1.0, 0.0]) > scene.gravity_bound_rad
        assert view.timestamp_s == pytest.approx(time / 1e9, abs=1e-6)


def test_the_imu_s_own_clock_is_believed(base, copy):
    """An IMU whose clock is 0.4 s ahead, with that written into the calibration, says the same."""
    folder = copy / "newer-college"
    table = tomllib.loads(SCENE)
    imu, calibration = folder / table["query_imu"], folder / table["calibration"]
    rows = [line.split(",") for line in imu.read_text().splitlines()[1:]]
    times = [int(sec) * 10**9 + int(nsec) + 400_000_000 for _, sec, nsec, *_ in rows]
    ahead = [
        ",".join([row[0], str(time // 10**9), str(time % 10**9), *row[3:]])
        for row, time in zip(rows, times, strict=True)
    ]
    imu.write_text("\n".join(["#counter,sec,nsec,wx,wy,wz,ax,ay,az", *ahead]) + "\n")
    calibration.write_text(calibration.read_text() + "  timeshift_cam_imu: 0.4\n")
    for view, expected in zip(load(copy).queries, load(base).queries, strict=True):
        assert np.allclose(view.gravity.down, expected.gravity.down, atol=1e-9)


def test_poses_are_the_ground_truth_s(base):
    """Of the base, turned into the camera; between two rows, where the person sways, a little off."""
    for view, time in zip(load(base).queries, GOOD, strict=True):
        degrees, metres = errors(view.cam_from_map, QUERY_WALK.cam_from_map(time))
        assert degrees < 0.6 and metres < 0.02
    for view, time in zip(load(base, PRIOR_MAP).references, REFERENCE_TIMES, strict=True):
        degrees, metres = errors(view.cam_from_map, REFERENCE_WALK.cam_from_map(time))
        assert degrees < 0.6 and metres < 0.02
        assert view.camera == CAMERA


def test_base_is_the_imu_unless_it_is_given(base):
    bare = load(base, without=["cam_from_base"]).queries[0].cam_from_map
    full = load(base).queries[0].cam_from_map
    in_imu = np.linalg.inv(CAM_FROM_IMU) @ np.vstack([bare, [0, 0, 0, 1]])
    in_base = np.linalg.inv(CAM_FROM_BASE) @ np.vstack([full, [0, 0, 0, 1]])
    np.testing.assert_allclose(in_imu, in_base, atol=1e-9)


def test_model_is_placed_by_the_ground_truth(base):
    """Its frame is turned, shifted and scaled; a remark says how well it fits."""
    scene = load(base)
    placed = next(remark for remark in scene.remarks if "was placed by" in remark)
    assert "4 of 4 camera positions of easy.csv: scale 2.70" in placed
    for view, given in zip(scene.references, load(base, MODEL + GIVEN).references, strict=True):
        degrees, metres = errors(view.cam_from_map, given.cam_from_map)
        assert degrees < 1.5 and metres < 0.02
    for view, time in zip(load(base, MODEL + GIVEN).references, REFERENCE_TIMES, strict=True):
        degrees, metres = errors(view.cam_from_map, REFERENCE_WALK.cam_from_map(time))
        assert degrees < 1e-4 and metres < 1e-6


@pytest.mark.parametrize("kind", [MODEL + GIVEN, PRIOR_MAP])
def test_points_lie_where_the_camera_sees_them(base, kind):
    """Lifted points, projected with the exact pose, are back at their pixel."""
    scene = load(base, kind)
    view, time = scene.references[1], REFERENCE_TIMES[1]
    if kind == PRIOR_MAP:
        columns, rows = np.meshgrid(np.arange(5, 495, 7), np.arange(5, 370, 7))
        pixels = np.column_stack([columns.ravel(), rows.ravel()]) + 0.5
    else:
        pixels = view.lift.image.pixels
    points, known = view.lift(pixels)
    assert known.sum() > 300
    cam_from_map = REFERENCE_WALK.cam_from_map(time)
    again, _ = CAMERA.project(points[known] @ cam_from_map[:, :3].T + cam_from_map[:, 3])
    off = np.linalg.norm(again - pixels[known], axis=1)
    assert np.median(off) < (1e-3 if kind != PRIOR_MAP else 1.5)


def test_holes_are_said_counted_and_skipped(copy):
    images = copy / "newer-college/quad-easy/cam0"
    (images / image_name(REFERENCE_TIMES[0])).unlink()
    (copy / "newer-college/quad-hard/cam0/preview.png").write_bytes(b"no time")
    said = "\n".join(load(copy).remarks)
    assert "1 of the 4 images of" in said and "are not in" in said
    assert "1 images of" in said and "no time in their names" in said
    assert "2 of the 5 query images fall into gaps of hard.csv or outside of it" in said
    assert "1 of the 5 query images fall into gaps of imu.csv or outside of it" in said
    scene = load(copy, PRIOR_MAP)
    assert len(scene.references) == 3
    write_ground_truth(copy / "newer-college/ground_truth/easy.csv", REFERENCE_WALK, between(REFERENCE_WALK, 5, 7, 10))
    scene = load(copy, PRIOR_MAP)
    assert len(scene.references) == 2
    assert any("1 of the 3 reference images fall into gaps of easy.csv" in remark for remark in scene.remarks)


def test_steps(base):
    assert len(load(base, MODEL + "reference_step = 2\n").references) == 2
    assert len(load(base, PRIOR_MAP + "reference_step = 3\n").references) == 2
    assert [view.name for view in load(base, MODEL + "query_step = 2\n").queries] == [image_name(QUERY_TIMES[2])]


FILES = {
    "calibration": "calibration/camchain.yaml",
    "query_ground_truth": "ground_truth/hard.csv",
    "query_imu": "quad-hard/imu.csv",
    "reference_ground_truth": "ground_truth/easy.csv",
}


@pytest.mark.parametrize("name", FILES.values())
def test_missing_file_is_named(copy, name):
    (copy / "newer-college" / name).unlink()
    with pytest.raises(InputError) as caught:
        load(copy)
    assert str(copy / "newer-college" / name) in str(caught.value) and "missing" in str(caught.value)


@pytest.mark.parametrize("name", ["quad-hard/cam0", "quad-easy/cam0", "colmap", "colmap/images.txt"])
def test_missing_folder_is_named(copy, name):
    path = copy / "newer-college" / name
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    with pytest.raises(InputError) as caught:
        load(copy)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    "without, text, says",
    [
        ((), "", "one of the keys 'model'"),
        ((), MODEL + PRIOR_MAP, "one of the keys 'model'"),
        ((), PRIOR_MAP + GIVEN, "belongs to a model"),
        ((), 'prior_map = "none.ply"', "none.ply is missing"),
        ((), MODEL + "map_from_model = [[1, 0, 0, 0], [0, 2, 0, 0], [0, 0, 1, 0]]", "not a rotation times"),
        ((), MODEL + "map_from_model = [[-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0]]", "not a rotation times"),
        ((), MODEL + "map_from_model = 1", "3 x 4"),
        (["cam_from_base"], MODEL + "cam_from_base = [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0]]", "scale 2"),
        (["camera"], MODEL + 'camera = "cam1"', "give one of cam0"),
        (["reference_ground_truth"], MODEL, "reference_ground_truth"),
        (["reference_ground_truth"], MODEL + 'reference_ground_truth = "ground_truth/hard.csv"', "cannot be placed"),
        (["query_imu"], MODEL + 'query_imu = "ground_truth/hard.csv"', "line 2"),
        (["query_ground_truth"], MODEL + 'query_ground_truth = "quad-hard/imu.csv"', "line 2"),
        ((), MODEL + "steps = 2", "unknown key"),
        ((), MODEL + "query_step = 0.5", "whole number"),
    ],
)
def test_wrong_value_is_one_sentence(base, without, text, says):
    with pytest.raises(InputError) as caught:
        load(base, text, without)
    message = str(caught.value)
    assert str(base) in message and says in message and message.isprintable()


def test_model_needs_no_ground_truth_where_its_place_is_given(base):
    assert len(load(base, MODEL + GIVEN, without=["reference_ground_truth"]).references) == 4


def test_ground_truth_of_another_walk_is_noticed(copy, rng):
    """Poses that have nothing to do with the model's must not place it silently."""
    path = copy / "newer-college/ground_truth/easy.csv"
    header, *rows = [line.split(",") for line in path.read_text().splitlines()]
    rows = [[*row[:2], *map(str, rng.normal(0, 4, 3)), *row[5:]] for row in rows]
    path.write_text("\n".join(",".join(row) for row in [header, *rows]) + "\n")
    with pytest.raises(InputError, match="do not fit"):
        load(copy)


def test_walk_straight_ahead_places_nothing(copy):
    """The rotation about the line that all cameras are on is open, so that the user must give it."""
    path = copy / "newer-college/ground_truth/easy.csv"
    header, *rows = [line.split(",") for line in path.read_text().splitlines()]
    rows = [[*row[:2], str(0.1 * number), "0", "0", "0", "0", "0", "1"] for number, row in enumerate(rows)]
    path.write_text("\n".join(",".join(row) for row in [header, *rows]) + "\n")
    with pytest.raises(InputError, match=r"on a line.*give map_from_model"):
        load(copy, without=["cam_from_base"])


def test_camera_without_its_place_at_the_imu_is_one_sentence(copy):
    path = copy / "newer-college/calibration/camchain.yaml"
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:1] + lines[6:]))
    with pytest.raises(InputError, match="no T_cam_imu"):
        load(copy)


@pytest.mark.usefixtures("no_pictures")
def test_the_papers_table_of_a_copy_of_the_dataset(copy, tmp_path):
    """Tables IV and V by one command; what the copy has elsewhere is said in the session's scene file."""
    root = copy / "newer-college"
    (root / "quad-easy").rename(root / "quad-medium")
    (root / "colmap").rename(root / "quad-medium/colmap")
    (root / "ground_truth/easy.csv").rename(root / "gt-nc-quad-medium.csv")
    (root / "ground_truth/hard.csv").rename(root / "gt-nc-quad-hard.csv")
    dataset = next(item for item in DATASETS if item.key == "newer-college")
    (session,) = sessions_of(dataset, root)
    scene = tmp_path / "out/newer-college_quad-hard/scene.toml"
    scene.parent.mkdir(parents=True)
    extra = next(line for line in SCENE.splitlines() if line.startswith("cam_from_base"))
    scene.write_text(session.scene.replace("query_step = 10", "query_step = 1") + extra + "\n")
    found = run_sessions({"newer-college": root}, tmp_path / "out", quick=True)
    assert {"R+EPro", "R+EPnP", "R+oDLT"} <= {item.method for item in found}
    best = next(item.summary for item in found if item.method == "mc")
    assert [(rate.metres, rate.degrees) for rate in best.success] == [(0.25, 2.0), (0.5, 5.0), (1.0, 8.0)]
    assert best.success[-1].successes >= 1
