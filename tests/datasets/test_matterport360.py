"""Matterport360: the layout is read, a panorama is localized, and registration judges where no pose is trusted."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matterport360_tree import write_building, write_dpt, write_pose
from scipy.spatial.transform import Rotation

from spherloc.datasets import load_scene
from spherloc.datasets.map_scene import MapScene
from spherloc.datasets.matterport360 import read_dpt, read_pose
from spherloc.errors import InputError
from spherloc.estimators import estimate
from spherloc.geometry import camera_centre, pose, so3_exp
from spherloc.metrics import evaluate
from spherloc.verification.sessions import DATASETS, sessions_of

SCENE = """
kind = "matterport360"
name = "building"
root = "building"
queries = ["pano2_rgb.png"]
"""


@pytest.fixture(scope="module")
def building(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scene file beside a rendered building of five panoramas."""
    folder = tmp_path_factory.mktemp("matterport360")
    write_building(folder / "building", 5)
    return folder


def scene_of(folder: Path, extra: str = "", name: str = "scene.toml") -> MapScene:
    path = folder / name
    path.write_text(SCENE + extra)
    scene = load_scene(path)
    assert isinstance(scene, MapScene)
    return scene


def test_a_panorama_is_localized_and_registered(building: Path) -> None:
    scene = scene_of(building)
    assert [view.name for view in scene.queries] == ["pano2_rgb.png"] and len(scene.references) == 4
    view = scene.query()
    matches = scene.matcher(view)
    trace = estimate(scene.problem_of(view, matches), "mc-exact")
    metrics = evaluate(trace)
    assert metrics.rotation_error_deg is not None and metrics.rotation_error_deg < 0.5
    assert metrics.translation_error_m is not None and metrics.translation_error_m < 0.05
    assert trace.cam_from_map is not None and scene.registration is not None
    assert scene.registration(view, trace.cam_from_map, matches.references) < 0.05


def test_without_trusted_poses_the_map_is_one_reference_and_registration_judges(building: Path) -> None:
    scene = scene_of(building, "trust_poses = false\n", "untrusted.toml")
    view = scene.query()
    assert view.cam_from_map is None
    matches = scene.matcher(view)
    assert len(matches.references) == 1
    trace = estimate(scene.problem_of(view, matches), "mc-exact")
    assert evaluate(trace).success is None
    assert trace.cam_from_map is not None and scene.registration is not None
    assert scene.registration(view, trace.cam_from_map, matches.references) < scene.registration.thresholds_m[0]


def test_registration_measures_how_far_a_pose_is_off(building: Path) -> None:
    scene = scene_of(building)
    view = scene.query()
    true = view.cam_from_map
    assert true is not None and scene.registration is not None
    near = tuple(sorted(scene.references, key=lambda other: distance(other.cam_from_map, true))[:2])
    assert scene.registration(view, true, near) < 0.02
    for off_m in (0.1, 0.3):
        shifted = pose(true[:, :3], true[:, 3] + off_m * np.array([0.6, 0.0, 0.8]))
        assert scene.registration(view, shifted, near) == pytest.approx(off_m, rel=0.25)
    turned = so3_exp(np.array([0.0, 2.0, 0.0])) @ true
    assert scene.registration(view, turned, near) == np.inf


def distance(a: np.ndarray | None, b: np.ndarray) -> float:
    assert a is not None
    return float(np.linalg.norm(camera_centre(a) - camera_centre(b)))


def test_incomplete_panoramas_are_left_out_and_said(building: Path, tmp_path: Path) -> None:
    for file in (building / "building").iterdir():
        (tmp_path / "building").mkdir(exist_ok=True)
        (tmp_path / "building" / file.name).write_bytes(file.read_bytes())
    (tmp_path / "building" / "pano0_depth.dpt").unlink()
    (tmp_path / "building" / "pano1_pose.txt").write_text("1 2 3 nan 0 0 1")
    scene = scene_of(tmp_path)
    assert [view.name for view in scene.references] == ["pano3_rgb.png", "pano4_rgb.png"]
    assert len(scene.remarks) == 2
    assert "pano0_rgb.png was skipped, since pano0_depth.dpt is missing" in scene.remarks[0]
    assert "pano1_pose.txt" in scene.remarks[1] and "finite" in scene.remarks[1]


@pytest.mark.parametrize(
    "extra, sentence",
    [
        ('depth = "range"\n', 'depth is \'range\'; give "ray" or "z"'),
        ("trust_poses = 1\n", "trust_poses is 1; give true or false"),
        ("colour = 1\n", "unknown key 'colour'"),
        ("", None),
    ],
)
def test_wrong_keys_are_sentences(tmp_path: Path, extra: str, sentence: str | None) -> None:
    (tmp_path / "building").mkdir()
    with pytest.raises(InputError) as caught:
        scene_of(tmp_path, extra)
    assert (sentence or "has no file *_rgb.png; give the folder of one building") in str(caught.value)


def test_poses_round_trip(tmp_path: Path, rng: np.random.Generator) -> None:
    for rotation in Rotation.random(20, rng).as_matrix():
        given_pose = pose(rotation, rng.normal(size=3))
        write_pose(tmp_path / "pose.txt", given_pose)
        assert np.abs(read_pose(tmp_path / "pose.txt") - given_pose).max() < 1e-7


def test_a_camera_that_looks_forward_stands_upright(tmp_path: Path) -> None:
    """Turned by 90 degrees about x, Blender's camera looks along the world's y, with z up."""
    half = np.sqrt(0.5)
    (tmp_path / "pose.txt").write_text(f"1 2 3 {half} 0 0 {half}")
    found = read_pose(tmp_path / "pose.txt")
    assert np.allclose(found[:, :3] @ [0, 1, 0], [0, 0, 1]) and np.allclose(found[:, :3] @ [0, 0, -1], [0, 1, 0])
    assert np.allclose(camera_centre(found), [1, 2, 3])


def test_depth_round_trips(tmp_path: Path, rng: np.random.Generator) -> None:
    depth = rng.uniform(0, 10, (7, 13)).astype(np.float32)
    depth[2, 3] = np.nan
    write_dpt(tmp_path / "a.dpt", depth)
    assert np.array_equal(read_dpt(tmp_path / "a.dpt"), depth, equal_nan=True)


def test_wrong_endianness_is_named(tmp_path: Path) -> None:
    write_dpt(tmp_path / "a.dpt", np.ones((2, 3)))
    content = (tmp_path / "a.dpt").read_bytes()
    (tmp_path / "a.dpt").write_bytes(np.frombuffer(content, "<u4").astype(">u4").tobytes())
    with pytest.raises(InputError, match="byte order is reversed"):
        read_dpt(tmp_path / "a.dpt")


@settings(max_examples=150)
@given(data=st.data())
def test_damaged_depth_is_a_sentence(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    path = tmp_path_factory.getbasetemp() / "fuzz.dpt"
    write_dpt(path, np.ones((4, 6)))
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        content[data.draw(st.integers(0, 15))] = data.draw(st.integers(0, 255))
    path.write_bytes(content[: data.draw(st.integers(0, len(content)))])
    try:
        assert read_dpt(path).size <= 24
    except InputError as error:
        assert str(path) in str(error) and str(error).endswith(".")


@settings(max_examples=150)
@given(content=st.one_of(st.binary(max_size=200), st.text(" 0123456789.e+-naif", max_size=80).map(str.encode)))
def test_damaged_poses_are_sentences(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "fuzz_pose.txt"
    path.write_bytes(content)
    try:
        found = read_pose(path)
        assert np.allclose(found[:, :3] @ found[:, :3].T, np.eye(3))
    except InputError as error:
        assert str(path) in str(error)


def test_each_building_of_a_copy_is_a_session_of_the_papers_table(building: Path, tmp_path: Path) -> None:
    """Table III: judged by registration at the paper's limits. (Tables II, IV and V are made in their own tests.)"""
    root = tmp_path / "Matterport360"
    shutil.copytree(building / "building", root / "house")
    for path in sorted((root / "house").glob("pano2_*")):
        path.rename(path.with_name(path.name.replace("pano2", "pano5")))
    (root / "empty").mkdir()
    dataset = next(item for item in DATASETS if item.key == "matterport360")
    (session,) = sessions_of(dataset, root)
    (tmp_path / "scene.toml").write_text(session.scene)
    scene = load_scene(tmp_path / "scene.toml")
    assert isinstance(scene, MapScene) and scene.registration is not None
    assert session.name == "house" and [view.name for view in scene.queries] == ["pano5_rgb.png"]
    assert scene.registration.thresholds_m == (0.4, 0.6, 0.8)
