"""Scenes of kind "image-folder": a user's own images against a COLMAP model or against images with depth."""

import json
import pickle
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest
from colmap_samples import OPENCV_FISHEYE, binary_files, sample_model, write
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from spherloc.datasets import load_scene
from spherloc.datasets.image_folder import read_depth
from spherloc.errors import InputError
from spherloc.estimators.base import estimate
from spherloc.geometry import so3_exp, transform
from spherloc.metrics import rotation_error_deg, translation_error_m
from tests.needs import real_data

ROOT = Path(__file__).resolve().parents[2]


CAMERA = """
[camera]
model = "equirectangular"
width = 64
height = 32
"""
POSE = "[[1, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, -2]]"
REFERENCE = """
[[references]]
image = "reference.png"
depth = "reference_depth.png"
depth_unit_m = 0.001
along = "ray"
"""
POSED = f"{REFERENCE}cam_from_map = {POSE}\n"
CAMERA_OF = 'camera = {model = "equirectangular", width = 64, height = 32}\n'
DEPTH_MM = 1500


def make_tree(folder, body="", head='images = "queries"'):
    """Two panoramas as queries, one as reference with a constant depth, and a scene file that ends with ``body``."""
    (folder / "queries").mkdir(exist_ok=True)
    for name in ("queries/b.png", "queries/a.jpg", "reference.png"):
        cv2.imwrite(str(folder / name), np.full((32, 64, 3), 90, np.uint8))
    cv2.imwrite(str(folder / "reference_depth.png"), np.full((32, 64), DEPTH_MM, np.uint16))
    path = folder / "scene.toml"
    path.write_text(f'kind = "image-folder"\nname = "own"\n{head}\n{body}')
    return path


def test_a_folder_of_queries_in_the_order_of_names(tmp_path):
    truth = f'[truth]\n"b.png" = {POSE}\n'
    scene = load_scene(make_tree(tmp_path, CAMERA + POSED + truth))
    assert [view.name for view in scene.queries] == ["a.jpg", "b.png"]
    assert scene.queries[0].cam_from_map is None
    np.testing.assert_array_equal(scene.queries[1].cam_from_map[:, 3], [0.5, 0, -2])
    assert scene.queries[1].read().shape == (32, 64, 3)
    assert scene.references[0].camera == scene.queries[0].camera
    assert scene.queries[0].gravity is None and scene.gravity_bound_rad == pytest.approx(np.radians(3))


def test_what_true_poses_are_from_is_told_with_every_problem(tmp_path):
    truth = f'[truth]\n"b.png" = {POSE}\n'
    head = 'images = "queries"\ntruth_source = "mocap0/data.csv, which was aligned with the map"'
    scene = load_scene(make_tree(tmp_path, CAMERA + POSED + truth, head=head))
    assert scene.about_truth == "The true poses are those of mocap0/data.csv, which was aligned with the map."
    assert scene.remarks == scene.problem_remarks[:-1] and scene.problem_remarks[-1] == scene.about_truth
    measured = load_scene(make_tree(tmp_path, CAMERA + POSED + truth))
    assert not measured.about_truth and measured.problem_remarks == measured.remarks
    with pytest.raises(InputError, match="truth_source"):
        load_scene(make_tree(tmp_path, CAMERA + POSED, head='images = "queries"\ntruth_source = 3'))


@pytest.mark.parametrize(
    ("middle", "said"),
    [
        ("cx = 32, cy = 16", ""),
        ("cx = 40, cy = 10", ""),
        ("cx = 16, cy = 32", "is at 16, 32, far from the middle of 64 x 32 pixels; if x and y are exchanged there"),
        ("cx = 70, cy = 16", "is at 70, 16, outside of 64 x 32 pixels; if the images are not cropped"),
    ],
)
def test_a_principal_point_that_seems_to_be_wrong_is_told_once(tmp_path, middle, said):
    lens = f'model = "eucm", width = 64, height = 32, fx = 20, fy = 20, {middle}, alpha = 0.5, beta = 1.0'
    entry = f'[[cameras]]\nimages = "{{}}"\ncamera = {{{{{lens}}}}}\n'
    reference = POSED.replace("cam_from_map", CAMERA_OF + "cam_from_map")
    remarks = load_scene(make_tree(tmp_path, entry.format("b*") + entry.format("a*") + reference)).remarks
    told = [remark for remark in remarks if "principal point" in remark]
    assert len(told) == bool(said) and all(f"of the camera of a.jpg {said}" in remark for remark in told), remarks
    other = lens.replace("beta = 1.0", "beta = 1.1")
    both = f'[[cameras]]\nimages = "b*"\ncamera = {{{other}}}\n' + entry.format("a*")
    more = "So it seems to be in 1 more of the 3 cameras."
    assert (more in load_scene(make_tree(tmp_path, both + reference)).remarks) == bool(said)


def test_a_list_of_queries_and_their_own_gravity(tmp_path):
    gravity = "[gravity]\nmap = [0, 0, -1]\ncamera = [0, 2, 0]\n"
    scene = load_scene(make_tree(tmp_path, CAMERA + POSED + gravity, head='images = ["queries/b.png"]'))
    assert [view.name for view in scene.queries] == ["queries/b.png"]
    np.testing.assert_array_equal(scene.queries[0].gravity.down, [0, 1, 0])
    np.testing.assert_array_equal(scene.gravity_map, [0, 0, -1])
    assert scene.gravity_bound_rad == 0.0 and scene.remarks == ()


def test_queries_of_several_cameras_and_only_some_of_a_folder(tmp_path):
    """A pattern or names give a query its camera; one that neither fits is left out, and one of the map is told."""
    small = '[[cameras]]\nimages = {}\ncamera = {{model = "equirectangular", width = {}, height = {}}}\n'
    path = make_tree(tmp_path, small.format('"b*"', 64, 32) + POSED.replace("cam_from_map", CAMERA_OF + "cam_from_map"))
    scene = load_scene(path)
    assert [view.name for view in scene.queries] == ["b.png"]
    assert "1 query image (a.jpg) left out: no section [[cameras]] has its name." in scene.remarks
    own = small.format('["a.jpg"]', 32, 16) + CAMERA + POSED
    cv2.imwrite(str(tmp_path / "queries" / "a.jpg"), np.full((16, 32, 3), 90, np.uint8))
    both = load_scene(make_tree(tmp_path, own, head='images = "."\nqueries = ["queries/b.png", "reference.png"]'))
    assert [view.name for view in both.queries] == ["queries/b.png", "reference.png"]
    assert any("matched with themselves: 1 query image (reference.png)" in remark for remark in both.remarks)
    assert {view.camera.width for view in both.queries} == {64}
    for wrong, said in (
        (small.format("3", 64, 32), r"\[\[cameras\]\] 1: images is 3; give a list of file names"),
        ('[[cameras]]\nimages = "a*"\n', r"\[\[cameras\]\] 1: has no camera"),
        ("[cameras]\n", "'cameras' must be a list of sections"),
    ):
        with pytest.raises(InputError, match=said):
            load_scene(make_tree(tmp_path, wrong + CAMERA + POSED))
    with pytest.raises(InputError, match="'images' lists files, so 'queries' must be left out"):
        load_scene(make_tree(tmp_path, CAMERA + POSED, head='images = ["queries/b.png"]\nqueries = ["a.jpg"]'))


def test_queries_that_cannot_be_read_are_left_out_and_counted(tmp_path):
    path = make_tree(tmp_path, CAMERA + POSED)
    queries = tmp_path / "queries"
    for at in range(4):
        (queries / f"broken{at}.jpg").write_bytes(b"no image" * at)
    (queries / "notes.txt").write_text("not asked for")
    cv2.imwrite(str(queries / "large.png"), np.zeros((33, 64), np.uint8))
    scene = load_scene(path)
    assert [view.name for view in scene.queries] == ["a.jpg", "b.png"]
    remarks = " ".join(scene.remarks)
    assert (
        "4 query images (broken0.jpg, broken1.jpg, broken2.jpg, ...) left out: not an image that can be read."
        in remarks
    )
    assert "1 query image (large.png) left out: not 64 x 32 pixels" in remarks
    for name in ("a.jpg", "b.png"):
        (queries / name).unlink()
    with pytest.raises(InputError, match=r"there is no query image; 4 query images"):
        load_scene(path)


@pytest.mark.parametrize("file", ["poses.txt", "data.csv"])
def test_references_from_a_trajectory(tmp_path, file):
    """The pose of the body at the time of the image, and where the camera sits on it; of TUM's rows and of EuRoC's."""
    turn = so3_exp(np.array([0.1, -0.7, 0.3]))
    x, y, z, w = 0.0, np.sin(0.2), 0.0, np.cos(0.2)
    tum = f"# t\n10.0 1 2 3 {x} {y} {z} {w}\n10.4 1 2 4 {x} {y} {z} {w}\n20.0 0 0 0 0 0 0 1\n"
    euroc = f"#t\n{10**10},1,2,3,{w},{x},{y},{z}\n10400000000,1,2,4,{w},{x},{y},{z}\n{2 * 10**10},0,0,0,1,0,0,0\n"
    (tmp_path / file).write_text(tum if file == "poses.txt" else euroc)
    mount = np.column_stack([turn, [0.1, 0.2, 0.3]])
    rows = [*mount.tolist(), [0, 0, 0, 1]]
    timed = f'{REFERENCE}trajectory = "{file}"\nbody_from_camera = {rows}\ntimestamp_ns = '
    scene = load_scene(make_tree(tmp_path, CAMERA + timed + "10100000000\n" + timed + "15000000000\n"))
    assert len(scene.references) == 1
    assert "1 of 2 references were left out" in scene.remarks[0]
    map_from_body = np.column_stack([so3_exp(np.array([0, 0.4, 0])), [1, 2, 3.25]])
    in_camera = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]])
    in_map = transform(map_from_body, transform(mount, in_camera))
    np.testing.assert_allclose(transform(scene.references[0].cam_from_map, in_map), in_camera, atol=1e-12)


@pytest.mark.parametrize("along", ["ray", "z"])
def test_depth_lifts_along_the_ray_or_the_axis(along, tmp_path):
    np.save(tmp_path / "depth.npy", np.full((32, 64), 3.0))
    entry = POSED.replace("reference_depth.png", "depth.npy").replace("0.001", "0.5").replace("ray", along)
    reference = load_scene(make_tree(tmp_path, CAMERA + entry)).references[0]
    pixels = np.array([[32.0, 16.0], [36.0, 12.0]])
    points, known = reference.lift(pixels)
    assert known.all()
    in_camera = transform(reference.cam_from_map, points)
    measured = np.linalg.norm(in_camera, axis=1) if along == "ray" else in_camera[:, 2]
    np.testing.assert_allclose(measured, 1.5, rtol=1e-6)
    np.testing.assert_allclose(reference.camera.project(in_camera)[0], pixels, atol=1e-6)


def test_depth_files_are_read_as_numbers_only(tmp_path):
    cv2.imwrite(str(tmp_path / "d.png"), np.array([[0, 1, 65535]], np.uint16))
    np.testing.assert_allclose(read_depth(tmp_path / "d.png", 0.001), [[0, 0.001, 65.535]], rtol=1e-6)

    class Harmful:
        def __reduce__(self):
            return (open, (str(tmp_path / "was_here"), "w"))

    (tmp_path / "pickle.npy").write_bytes(pickle.dumps(Harmful()))
    np.save(tmp_path / "objects.npy", np.array([[Harmful()]], dtype=object), allow_pickle=True)
    np.save(tmp_path / "flat.npy", np.zeros(5))
    np.save(tmp_path / "text.npy", np.array([["a"]]))
    np.savez(tmp_path / "many.npz", np.zeros((2, 2)))
    (tmp_path / "many.npz").rename(tmp_path / "many.npy")
    for name in ("pickle", "objects", "flat", "text", "many", "none"):
        with pytest.raises(InputError, match=f"{name}.npy"):
            read_depth(tmp_path / f"{name}.npy", 1.0)
    assert not (tmp_path / "was_here").exists()


def test_an_array_file_that_announces_more_than_it_holds(tmp_path):
    np.save(tmp_path / "d.npy", np.zeros((4, 4)))
    content = (tmp_path / "d.npy").read_bytes()
    (tmp_path / "d.npy").write_bytes(content.replace(b"(4, 4)", b"(9000000, 9000000)").replace(b" " * 14, b"", 1))
    with pytest.raises(InputError, match=r"d.npy: is missing or damaged"):
        read_depth(tmp_path / "d.npy", 1.0)


@given(data=st.data())
@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_damaged_array_files(data, tmp_path):
    path = tmp_path / "d.npy"
    np.save(path, np.ones((3, 5), np.float32))
    content = bytearray(path.read_bytes())
    at = data.draw(st.integers(0, len(content) - 1))
    content[at : at + data.draw(st.integers(0, 3))] = data.draw(st.binary(max_size=3))
    path.write_bytes(bytes(content[: data.draw(st.sampled_from([len(content), at]))]))
    try:
        depth = read_depth(path, 2.0)
    except InputError as error:
        assert str(path) in str(error)
    else:
        assert depth.ndim == 2 and depth.dtype == np.float32 and depth.size <= len(content)


def test_a_colmap_model_as_the_map(rng, tmp_path):
    sample = sample_model(rng, models=(OPENCV_FISHEYE,))
    write(tmp_path / "sparse", binary_files(sample))
    for image in sample.images:
        path = tmp_path / "mapping" / image[3]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    scene = load_scene(make_tree(tmp_path, f'{CAMERA}[map]\nmodel = "sparse"\nimages = "mapping"\n'))
    assert [view.name for view in scene.references] == [image[3] for image in sample.images]
    assert scene.references[0].camera.model == "kannala_brandt"
    assert scene.queries[0].camera.model == "equirectangular"
    assert scene.gravity_map[1] > 0.99
    down, units = scene.remarks
    assert down.startswith("Down in the map is the mean +y axis") and units.startswith("Lengths are told in metres, as")
    np.testing.assert_array_equal(scene.cloud, [point[1] for point in sample.points])


def test_a_panorama_of_another_size_is_a_query_too(tmp_path):
    path = make_tree(tmp_path, CAMERA + POSED)
    cv2.imwrite(str(tmp_path / "queries" / "double.png"), np.zeros((64, 128, 3), np.uint8))
    scene = load_scene(path)
    assert [(view.name, view.camera.width, view.camera.height) for view in scene.queries] == [
        ("a.jpg", 64, 32),
        ("b.png", 64, 32),
        ("double.png", 128, 64),
    ]
    assert scene.queries[2].read().shape == (64, 128, 3) and "left out" not in str(scene.remarks)


MAP = '[map]\nmodel = "queries"\nimages = "queries"\n'


@pytest.mark.parametrize(
    "body, words",
    [
        (CAMERA, r"needs either a section \[map\]"),
        (CAMERA + MAP + POSED, r"needs either a section \[map\]"),
        (CAMERA + MAP, "no COLMAP model"),
        (POSED, "the query images have no camera"),
        ('calibration = "none.yaml"\n' + POSED, "none.yaml"),
        ('calibration = "none.yaml"\n' + CAMERA + POSED, "both 'camera' and 'calibration'"),
        (CAMERA + POSED.replace("reference.png", "lost.png"), r"\[\[references\]\] 1: the image .*lost.png"),
        (CAMERA + POSED.replace("reference_depth.png", "lost.png"), r"\[\[references\]\] 1: the depth map .*lost.png"),
        (CAMERA + POSED.replace('"ray"', '"up"'), "along is 'up'"),
        (CAMERA + POSED.replace('along = "ray"', ""), "key 'along' is missing"),
        (CAMERA + POSED.replace("depth_unit_m = 0.001", ""), "key 'depth_unit_m' is missing"),
        (CAMERA + POSED.replace("0.001", "0"), "depth_unit_m is 0"),
        (CAMERA + POSED.replace("[0, 1, 0, 0]", "[0, 2, 0, 0]"), "cam_from_map is not a rigid pose"),
        (CAMERA + POSED.replace("[0, 1, 0, 0]", "[0, -1, 0, 0]"), "cam_from_map is not a rigid pose"),
        (CAMERA + POSED.replace("[0, 1, 0, 0], ", ""), "cam_from_map must hold 3 x 4"),
        (CAMERA + POSED + 'trajectory = "t.txt"\ntimestamp_ns = 1\n', "unknown key 'cam_from_map'"),
        (CAMERA + REFERENCE + 'trajectory = "t.txt"\n', "key 'timestamp_ns' is missing"),
        (CAMERA + REFERENCE + 'trajectory = "t.txt"\ntimestamp_ns = 1\n', "t.txt: no such file"),
        (CAMERA + REFERENCE + 'trajectory = "t.txt"\ntimestamp_ns = 1\ntrajectory_unit = "h"\n', "unit is 'h'"),
        (CAMERA + REFERENCE, "key 'cam_from_map' is missing"),
        (CAMERA + POSED + f'[truth]\n"c.png" = {POSE}\n', "'c.png' is not a query image"),
        (CAMERA + POSED + '[truth]\n"a.jpg" = [1]\n', "must hold 3 x 4"),
        (CAMERA + POSED + "[gravity]\ncamera = [0, 0, 0]\n", "camera has the length 0"),
        (CAMERA + POSED + "[other]\n", "unknown key 'other'"),
    ],
)
def test_wrong_keys_and_values(body, words, tmp_path):
    path = make_tree(tmp_path, body)
    with pytest.raises(InputError, match=words):
        load_scene(path)


@pytest.mark.parametrize("value", ["[]", "[1]", "3", '"nowhere"', '["a\\u0000b"]'])
def test_wrong_images(value, tmp_path):
    with pytest.raises(InputError, match="images"):
        load_scene(make_tree(tmp_path, CAMERA + POSED, head=f"images = {value}"))


def aria_scene(aria, folder, query, reference):
    """A frame of one camera against two earlier frames of another, with their z-depth and the device's poses."""
    calibration = json.loads((aria / "calibration_fisheye624.json").read_text())
    fits = json.loads((aria / "kb4_fit_of_fisheye624.json").read_text())
    frames = {"rgb": (87551170813262, 87551204152300), "slam-left": (87551170910700, 87551204238700)}[reference]
    poses, depths = (87551170910000, 87551204238000), (87551170910000, 87551204237999)
    measured = tomllib.loads((aria / f"{query.replace('-', '_')}.toml").read_text())

    def camera(name):
        fx, fy, cx, cy, *distortion = fits[f"camera-{name}"]["params"]
        width, height = calibration[f"camera-{name}"]["size"]
        numbers = f"width = {width}, height = {height}, fx = {fx}, fy = {fy}, cx = {cx}, cy = {cy}"
        return f'{{model = "kannala_brandt", {numbers}, distortion = {distortion}}}'

    root = aria.resolve()
    image = f"{root}/{measured['image']}"
    parts = [f'kind = "image-folder"\nname = "aria"\nimages = ["{image}"]\ncamera = {camera(query)}\n']
    for frame, pose_time, depth_time in zip(frames, poses, depths, strict=True):
        parts.append(
            f'[[references]]\nimage = "{root}/images/camera-{reference}_{frame}.png"\n'
            f'depth = "{root}/depth/camera-{reference}_{depth_time}.png"\ndepth_unit_m = 0.001\nalong = "z"\n'
            f'camera = {camera(reference)}\ntrajectory = "{root}/poses_world_device_tum.txt"\ntrajectory_unit = "ns"\n'
            f"timestamp_ns = {pose_time}\n"
            f"body_from_camera = {calibration[f'camera-{reference}']['T_device_camera']}\n"
        )
    parts.append(f"[gravity]\nmap = {measured['gravity']['map']}\ncamera = {measured['gravity']['camera']}\n")
    parts.append(f'[truth]\n"{image}" = {measured["truth"]["cam_from_map"]}\n')
    path = folder / "aria.toml"
    path.write_text("".join(parts))
    return load_scene(path)


@pytest.mark.parametrize("query, reference", [("rgb", "slam-left"), ("slam-left", "rgb")])
def test_real_fisheye_against_the_depth_of_another_camera(query, reference, aria, tmp_path):
    scene = aria_scene(aria, tmp_path, query, reference)
    problem = scene.problem()
    assert len(problem) > 100
    for estimator in ("mc-exact", "ransac-2p"):
        pose = estimate(problem, estimator).cam_from_map
        assert rotation_error_deg(problem.truth_cam_from_map, pose) < 0.5
        assert translation_error_m(problem.truth_cam_from_map, pose) < 0.03


def test_the_real_panorama_against_its_model(tmp_path):
    """The query has no gravity of its own and no pose, and is in the model itself: it is not matched with itself."""
    root = real_data("stella_equirect_pair")
    path = tmp_path / "walk.toml"
    path.write_text(
        f'kind = "image-folder"\nname = "walk"\nimages = ["{root}/equirectangular_image_002.jpg"]\n'
        f"{CAMERA.replace('64', '1920').replace('32', '960')}"
        f'[map]\nmodel = "{root}/colmap_equirect/0"\nimages = "{root}"\n'
    )
    scene = load_scene(path)
    problem = scene.problem()
    assert [image.name for image in problem.reference_images] == ["equirectangular_image_001.jpg"]
    pose = estimate(problem, "mc-exact").cam_from_map
    truth = next(view for view in scene.references if view.name.endswith("002.jpg")).cam_from_map
    assert rotation_error_deg(truth, pose) < 0.5
