"""hloc's logs are pickles: their data are read, and nothing in them is ever run."""

import pickle
from collections import OrderedDict, defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_process import spherloc, spherloc_here
from hypothesis import given, settings
from hypothesis import strategies as st
from recording_samples import scene_problem

from spherloc.errors import InputError
from spherloc.formats.colmap_files import read_model
from spherloc.formats.hloc_log import LoggedQuery, read_log, read_log_poses
from spherloc.formats.pickle_data import Noted, PickleDataError, read_pickle_data, value_of
from spherloc.trajectory import wxyz_from_rotation

pycolmap = pytest.importorskip("pycolmap")
PROBLEM = scene_problem("panorama_outliers_90")


class Trap:
    """Makes a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


def plain(found: Any) -> Any:
    """Notes of numpy's numbers and arrays made of their bytes, everywhere inside."""
    found = value_of(found)
    if isinstance(found, dict):
        return {key: plain(value) for key, value in found.items()}
    return type(found)(map(plain, found)) if isinstance(found, list | tuple) else found


leaves = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text() | st.binary()
trees = st.recursive(
    leaves,
    lambda inner: st.lists(inner) | st.tuples(inner, inner, inner, inner) | st.dictionaries(st.text(), inner),
    max_leaves=20,
)


@settings(max_examples=60, deadline=None)
@given(trees, st.integers(0, 5))
def test_data_come_back_as_they_were(tree: Any, protocol: int) -> None:
    # Before protocol 3 bytes are a call, which is noted and not made.
    written = pickle.dumps(tree, protocol)
    if protocol >= 3 or not any(module in written for module in (b"_codecs", b"__builtin__")):
        assert plain(read_pickle_data(written)) == tree


@pytest.mark.parametrize("protocol", range(3, 6))
def test_arrays_numbers_and_shared_parts(protocol: int, rng: np.random.Generator) -> None:
    array = rng.normal(size=(5, 2))
    shared = [array, np.float32(1.5), np.int64(-7)]
    data = {
        "a": shared,
        "again": shared,
        "fortran": np.asfortranarray(array),
        "mask": array[:, 0] > 0.0,
        "big": array.astype(">f8"),
        "lists": defaultdict(list, {np.int64(3): [1]}),
        "order": OrderedDict(x=1),
    }
    found = read_pickle_data(pickle.dumps(data, protocol))
    assert found["a"] is found["again"]
    for name in ("fortran", "big"):
        np.testing.assert_array_equal(value_of(found[name]), array)
    np.testing.assert_array_equal(value_of(found["mask"]), data["mask"])
    assert plain(found["a"])[1:] == [1.5, -7] and found["lists"] == {3: [1]} and found["order"] == {"x": 1}


@pytest.mark.parametrize("protocol", range(6))
def test_nothing_is_run(tmp_path: Path, protocol: int) -> None:
    trap = tmp_path / "trap"
    content = pickle.dumps({"loc": {"a.jpg": Trap(trap)}}, protocol)
    found = read_pickle_data(content)["loc"]["a.jpg"]
    assert isinstance(found, Noted) and not trap.exists()
    path = tmp_path / "logs.pkl"
    path.write_bytes(content)
    assert read_log_poses(path) == {} and not trap.exists()
    pickle.loads(content)
    assert trap.exists(), "Python's own reader runs it"


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b".",
        b"garbage",
        b"\x80\x04]\x94.",
        b"(lp0\n",
        b"}(]Nu.",  # a list as a key
        b"(tN\x86b.",
        b"Pid\n.",
        b"\x80\x04\x95\xff\xff\xff\xff\xff\xff\xff\x7f.",
        b"\x8e\xff\xff\xff\xff\xff\xff\xff\x7fx.",
        b"cos\nsystem\n(S'touch /tmp/owned'\ntR.",
        b"(" * 1000 + b"t" * 999,
    ],
)
def test_what_is_no_log_is_a_sentence(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "logs.pkl"
    path.write_bytes(content)
    with pytest.raises(InputError, match="not a log of hloc") as caught:
        read_log_poses(path)
    assert str(caught.value).startswith(f"{path}: ") and str(caught.value).isprintable()


def test_arrays_that_lie_are_refused() -> None:
    content = bytearray(pickle.dumps(np.arange(6.0), 4))
    at = content.index(bytes([ord("K"), 6]))
    content[at + 1] = 7
    with pytest.raises(PickleDataError, match="does not hold numbers"):
        value_of(read_pickle_data(bytes(content)))
    with pytest.raises(PickleDataError, match="does not hold numbers"):
        value_of(read_pickle_data(pickle.dumps(np.array([None, "x"], dtype=object), 4)))


def logged(**changes: Any) -> dict[str, Any]:
    """A log of today's hloc with two queries, one of which was not localized."""
    pose = PROBLEM.truth_cam_from_map
    camera = PROBLEM.camera
    assert pose is not None
    result = {
        "cam_from_world": pycolmap.Rigid3d(pose),
        "num_inliers": 3,
        "camera": pycolmap.Camera(
            model="EQUIRECTANGULAR", width=camera.width, height=camera.height, params=[camera.width, camera.height]
        ),
    }
    entry = {
        "db": [1, 2],
        "PnP_ret": result,
        "keypoints_query": PROBLEM.pixels,
        "points3D_xyz": PROBLEM.points,
        "points3D_ids": [np.int64(k) for k in range(len(PROBLEM))],
        "num_matches": 7,
    }
    lost = entry | {"PnP_ret": None}
    return {"features": Path("feats.h5"), "loc": {"q/a.jpg": entry | changes, "q/b.jpg": lost}}


def test_logs_of_both_ages_give_the_same_query(tmp_path: Path) -> None:
    pose = PROBLEM.truth_cam_from_map
    assert pose is not None
    camera = PROBLEM.camera
    old = {
        "success": True,
        "qvec": wxyz_from_rotation(pose[:, :3]),
        "tvec": list(pose[:, 3]),
        "cfg": {"model": "EQUIRECTANGULAR", "width": camera.width, "height": camera.height}
        | {"params": [camera.width, camera.height]},
    }
    clusters = {"best_cluster": np.int64(1), "log_clusters": [{}, logged()["loc"]["q/a.jpg"]]}
    for number, log in enumerate((logged(), logged(PnP_ret=old), {"loc": {"q/a.jpg": clusters}})):
        path = tmp_path / f"{number}.pkl"
        path.write_bytes(pickle.dumps(log))
        (name, query), *others = read_log(path, None).items()
        assert name == "q/a.jpg" and others in ([], [("q/b.jpg", None)]) and isinstance(query, LoggedQuery)
        np.testing.assert_allclose(query.cam_from_map, pose, atol=1e-12)
        np.testing.assert_array_equal(query.pixels, PROBLEM.pixels)
        np.testing.assert_array_equal(query.points, PROBLEM.points)
        assert (query.camera.width, query.camera.height) == (camera.width, camera.height)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"points3D_xyz": None}, "give the COLMAP model"),
        ({"points3D_xyz": None, "points3D_ids": ["x"]}, "are not ids of points"),
        ({"keypoints_query": PROBLEM.pixels[:4]}, "has 4 keypoints but"),
        ({"keypoints_query": np.zeros(4)}, "not an array of 2 columns"),
        ({"keypoints_query": np.array([[None, "x"]], dtype=object)}, "does not hold numbers"),
        ({"PnP_ret": {"cam_from_world": pycolmap.Rigid3d()}}, "has no camera"),
        ({"PnP_ret": {"success": True, "qvec": [1, 0, 0], "tvec": [0, 0, 0]}}, "qvec is not 4 numbers"),
        ({"PnP_ret": {"success": True, "qvec": [2, 0, 0, 0], "tvec": [0, 0, 0]}}, "has the length 2"),
    ],
)
def test_queries_that_cannot_be_used_say_why(changes: dict[str, Any], said: str, tmp_path: Path) -> None:
    path = tmp_path / "logs.pkl"
    path.write_bytes(pickle.dumps(logged(**changes)))
    error = read_log(path, None)["q/a.jpg"]
    assert isinstance(error, InputError) and said in str(error) and str(error).startswith(f"{path}: 'q/a.jpg'")


def test_a_query_without_a_camera_has_that_of_its_image_in_the_model_or_the_one_that_is_given(tmp_path: Path) -> None:
    """As newer versions of hloc write them."""
    pose, camera = PROBLEM.truth_cam_from_map, PROBLEM.camera
    assert pose is not None
    entry = logged(PnP_ret={"cam_from_world": pycolmap.Rigid3d(pose)})["loc"]["q/a.jpg"]
    (tmp_path / "logs.pkl").write_bytes(pickle.dumps({"loc": {"q/a.jpg": entry, "other.jpg": entry}}))
    size = f"{camera.width // 2} {camera.height // 2}"
    (tmp_path / "cameras.txt").write_text(f"1 EQUIRECTANGULAR {size} {size}\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 q/a.jpg\n\n")
    (tmp_path / "points3D.txt").write_text("")
    found = read_log(tmp_path / "logs.pkl", read_model(tmp_path), camera)
    assert [query.camera.width for query in found.values() if isinstance(query, LoggedQuery)] == [
        camera.width // 2,
        camera.width,
    ]
    alone = read_log(tmp_path / "logs.pkl", read_model(tmp_path))
    assert isinstance(alone["q/a.jpg"], LoggedQuery) and "by --camera" in str(alone["other.jpg"])
    (tmp_path / "camera.toml").write_text(
        f'[camera]\nmodel = "equirectangular"\nwidth = {camera.width}\nheight = {camera.height}\n'
    )
    told = spherloc_here("diagnose", "logs.pkl", "--camera", "camera.toml", "--no-record", cwd=tmp_path)
    assert "q/a.jpg: " in told.stdout and "other.jpg: " in told.stdout and "left out" not in told.stderr


def test_a_log_is_diagnosed_without_a_scene(tmp_path: Path) -> None:
    (tmp_path / "results.txt_logs.pkl").write_bytes(pickle.dumps(logged()))
    down = [repr(float(x)) for x in PROBLEM.gravity_map]
    done = spherloc("diagnose", "results.txt_logs.pkl", "--recordings", "runs", "--map-down", *down, cwd=tmp_path)
    assert done.returncode in (0, 1) and f"q/a.jpg: 9 of {len(PROBLEM)} agree" in done.stdout, done.stderr
    assert "results.txt_logs.pkl: hloc found no pose of 1 query (q/b.jpg), of which nothing is told" in done.stderr
