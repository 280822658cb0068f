"""hloc's files, whole and broken: what they hold, or one printable sentence that names the file. Never a pickle."""

import h5py
import numpy as np
import pytest
from hloc_samples import PANORAMA, QUERY, REFERENCES, SCENE, make_world, numbers, pickled, write_all, write_features
from hypothesis import given, settings
from hypothesis import strategies as st
from mutations import mutations

from spherloc.datasets import load_scene
from spherloc.errors import InputError, SpherlocError
from spherloc.formats import hloc_files
from spherloc.formats.hloc_files import (
    open_hdf5,
    read_global_descriptors,
    read_keypoints,
    read_matches,
    read_pairs,
    read_queries,
    read_results,
)
from spherloc.trajectory import rotation_from_wxyz

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

QUERIES = f"{QUERY} {PANORAMA[0]} 1600 800 1600 800\nb.png PINHOLE 640 480 500 501 320 240.5\n"
PAIRS = "q/1.jpg db/7.jpg\nq/1.jpg db/3.jpg\nq/2.jpg db/7.jpg\n"
RESULTS = "a.jpg 0.5 0.5 -0.5 0.5 1 2.5 -3e1\nb.jpg 1 0 0 0 0 0 0\n"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("hloc")


def text(folder, content):
    path = folder / "list.txt"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def test_lists(folder):
    cameras, remarks = read_queries(text(folder, "# comment\n\n" + QUERIES))
    assert list(cameras) == [QUERY, "b.png"] and remarks == []
    assert cameras[QUERY].model == "equirectangular" and cameras["b.png"].height == 480
    assert read_pairs(text(folder, PAIRS)) == {"q/1.jpg": ("db/7.jpg", "db/3.jpg"), "q/2.jpg": ("db/7.jpg",)}
    pose = read_results(text(folder, RESULTS))["a.jpg"]
    assert np.allclose(pose[:, :3], rotation_from_wxyz([0.5, 0.5, -0.5, 0.5]), atol=1e-15)
    assert np.array_equal(pose[:, 3], [1.0, 2.5, -30.0])


def test_cameras_that_are_not_supported_are_counted(folder):
    cameras, (remark,) = read_queries(text(folder, f"{QUERIES}c.png WHO_KNOWS 10 10 1 2 3\n"))
    assert len(cameras) == 2
    assert remark.startswith("1 of 3 queries are skipped for their cameras: ") and "list.txt, line 3" in remark


@pytest.mark.parametrize(
    ("read", "content", "line", "said"),
    [
        (read_queries, f"{QUERIES}{QUERY} PINHOLE 1 1 1 1 1 1\n", 3, "there twice"),
        (read_queries, "a.jpg PINHOLE 640\n", 1, "too few values"),
        (read_queries, "a.jpg PINHOLE 640 480 x 5 5 5\n", 1, "'x' is not a finite number"),
        (read_queries, "a.jpg PINHOLE 640.5 480 5 5 5 5\n", 1, "whole numbers"),
        (read_pairs, f"{PAIRS}one\n", 4, "has 1 names"),
        (read_pairs, f"{PAIRS}one two three\n", 4, "has 3 names"),
        (read_results, f"{RESULTS}b.jpg 1 0 0 0 0 0 0\n", 3, "two poses"),
        (read_results, "c.jpg 1 0 0 0 0 0\n", 1, "a pose has 6 numbers"),
        (read_results, "c.jpg 1 2 3 4 5 6 7\n", 1, "the length 5.48 instead of 1"),
        (read_results, "c.jpg 1 0 0 0 0 0 nan\n", 1, "'nan' is not a finite number"),
        (read_results, "c.jpg 1 0 0 0 0 0 1_0\n", 1, "'1_0' is not a finite number"),
        (read_results, "c.jpg 1 0 0 0 0 0 1e300\n", 1, "beyond 1e+09 m"),
        (read_pairs, b"a b\n\xff\xfe b\n", 2, "not text in UTF-8"),
        (read_pairs, "a " + "b" * 5000, 1, "longer than 4096 bytes"),
    ],
)
def test_wrong_lines_are_named(folder, read, content, line, said):
    with pytest.raises(InputError) as error:
        read(text(folder, content))
    assert f"list.txt, line {line}: " in str(error.value) and said in str(error.value)


@pytest.mark.parametrize("protocol", range(6))
@pytest.mark.parametrize("name", ["results.txt_logs.pkl", "renamed.txt", "renamed.h5"])
def test_pickles_are_refused_unopened(tmp_path, protocol, name):
    path, trap = tmp_path / name, tmp_path / "trap"
    path.write_bytes(pickled(trap, protocol))
    for read in (read_pairs, read_queries, read_results):
        with pytest.raises(InputError, match="is a Python pickle, and reading one runs whatever code is in it"):
            read(path)
    with pytest.raises(InputError, match="is a Python pickle"), open_hdf5(path):
        pass
    assert not trap.exists()


@settings(max_examples=100)
@given(
    st.sampled_from([(read_queries, QUERIES), (read_pairs, PAIRS), (read_results, RESULTS)]).flatmap(
        lambda case: st.tuples(st.just(case[0]), st.one_of(mutations(case[1]), st.binary(max_size=100)))
    )
)
def test_any_text(folder, case):
    """A list, or one sentence with the file, and with the line unless all of the file is wrong."""
    read, content = case
    path = text(folder, content)
    try:
        read(path)
    except SpherlocError as error:
        message = str(error)
        assert message.startswith((f"{path}, line ", f"{path}: is a Python pickle")) and message.isprintable()
        assert len(message) < 600


@pytest.fixture
def world(tmp_path, rng):
    return make_world(tmp_path, rng)


def keypoints(path, name=QUERY):
    with open_hdf5(path) as file:
        return read_keypoints(file, name)


def test_keypoints(world, tmp_path):
    """Half a pixel is added; the step of half floats doubles at 1024 and at 2048."""
    path = tmp_path / "feats.h5"
    write_features(world, path, dtype=np.float64)
    found = keypoints(path)
    assert np.abs(found.pixels - world.pixels[QUERY]).max() < 1e-12
    assert found.image_size == PANORAMA[1:3] and found.uncertainty_px == 1.0 and found.rounding_px < 1e-12
    assert keypoints(path, "query/night") is None and keypoints(path, "nobody.jpg") is None
    for largest, step in ((1000.0, 0.5), (1030.0, 1.0), (2050.0, 2.0)):
        world.pixels[QUERY] = np.array([[3.5, largest]])
        write_features(world, path, dtype=np.float16)
        assert keypoints(path).rounding_px == step
    world.pixels[QUERY] = np.empty((0, 2))
    write_features(world, path)
    assert keypoints(path).pixels.shape == (0, 2)


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("old", [False, True])
def test_matches(tmp_path, old, turned):
    names = ("b-2.jpg", "q-1.jpg") if turned else ("q-1.jpg", "b-2.jpg")
    path = tmp_path / "matches.h5"
    with h5py.File(path, "w") as file:
        file[f"{('_' if old else '/').join(names)}/matches0"] = np.array([2, -1, 0], np.int16)
    with open_hdf5(path) as file:
        assert read_matches(file, "q/nobody.jpg", "b/2.jpg", (3, 3)) is None
        found = read_matches(file, "q/1.jpg", "b/2.jpg", (3, 3))
        assert found.tolist() == ([[2, 0], [0, 2]] if turned else [[0, 2], [2, 0]])
        for counts in ((3, 2), (2, 3), (4, 3), (3, 4)):
            own = counts[1] if turned else counts[0]
            other = counts[0] if turned else counts[1]
            if own == 3 and other > 2:
                assert len(read_matches(file, "q/1.jpg", "b/2.jpg", counts)) == 2
            else:
                with pytest.raises(InputError, match="the features and the model that were matched"):
                    read_matches(file, "q/1.jpg", "b/2.jpg", counts)


def test_matches_beyond_16_bits(tmp_path):
    """Of 40,000 keypoints, the index 32,768 wraps to -32,768."""
    path = tmp_path / "matches.h5"
    with h5py.File(path, "w") as file:
        file["a/b/matches0"] = np.array([32_768], np.int64).astype(np.int16)
    with open_hdf5(path) as file, pytest.raises(InputError, match=r"names the keypoint -32768 of the 40000 of 'b'"):
        read_matches(file, "a", "b", (1, 40_000))


def test_global_descriptors(tmp_path, monkeypatch):
    path = tmp_path / "global.h5"
    with h5py.File(path, "w") as file:
        file["a/1.jpg/global_descriptor"] = np.array([3.0, 4.0], np.float16)
        file["b.jpg/global_descriptor"] = np.array([0.0, -2.0], np.float32)
        file["zero/global_descriptor"] = np.zeros(2)
        file["long/global_descriptor"] = np.ones(3)
        file["inf/global_descriptor"] = np.array([1.0, np.inf], np.float16)
        file["large/global_descriptor"] = np.array([1e200, 1e200])
    found = read_global_descriptors(path, ["b.jpg", "nobody", "a/1.jpg"])
    assert np.allclose(found, [[0.0, -1.0], [np.nan, np.nan], [0.6, 0.8]], equal_nan=True, atol=1e-6)
    assert np.isnan(read_global_descriptors(path, ["x", "y"])).all()
    for name in ("zero", "long", "inf", "large"):
        with pytest.raises(InputError, match=f"the descriptor of '{name}' is damaged"):
            read_global_descriptors(path, ["b.jpg", name])
    monkeypatch.setattr(hloc_files, "MAX_TOTAL_BYTES", 20)
    with pytest.raises(InputError, match="give a list of pairs instead"):
        read_global_descriptors(path, ["b.jpg", "nobody", "a/1.jpg"])


def hostile(path, kind, trap):
    """A features.h5 whose keypoints are something else."""
    with h5py.File(path, "w") as file:
        group = file.create_group(QUERY)
        if kind == "huge":
            group.create_dataset("keypoints", shape=(10**12, 2), dtype="f4", chunks=(1000, 2))
        elif kind == "huge chunk":
            group.create_dataset("keypoints", shape=(4, 2), maxshape=(None, 2), dtype="f4", chunks=(2**27, 2))
        elif kind == "objects":
            group.create_dataset("keypoints", data=["text"] * 4, dtype=h5py.string_dtype())
        elif kind == "integers":
            group["keypoints"] = np.ones((4, 2), np.int32)
        elif kind == "flat":
            group["keypoints"] = np.ones(4)
        elif kind == "one column":
            group["keypoints"] = np.ones((4, 1))
        elif kind == "nan":
            group["keypoints"] = np.full((4, 2), np.nan)
        elif kind == "far":
            group["keypoints"] = np.full((4, 2), -1e300)
        elif kind == "empty":
            group.create_dataset("keypoints", data=h5py.Empty("f4"))
        elif kind == "group":
            group.create_group("keypoints")
        elif kind == "type":
            group["keypoints"] = np.dtype("f4")
        elif kind == "soft loop":
            group["keypoints"] = h5py.SoftLink(f"/{QUERY}/keypoints")
        elif kind == "external link":
            group["keypoints"] = h5py.ExternalLink(str(trap), "/secret")
        elif kind == "external data":
            group.create_dataset("keypoints", shape=(4, 2), dtype="f4", external=[(str(trap), 0, 32)])
        elif kind == "virtual":
            layout = h5py.VirtualLayout(shape=(4, 2), dtype="f4")
            layout[:] = h5py.VirtualSource(str(trap), "secret", shape=(4, 2))
            group.create_virtual_dataset("keypoints", layout)
        elif kind == "size":
            group["keypoints"] = np.ones((4, 2))
            group["image_size"] = np.array([1600, -1])
        elif kind == "sizes":
            group["keypoints"] = np.ones((4, 2))
            group["image_size"] = np.array([1600, 800, 3])


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("huge", "claims 8,000,000,000,000 bytes"),
        ("huge chunk", "claims 1,073,741,824 bytes"),
        ("objects", "holds 'object' in 1 dimensions"),
        ("integers", "holds 'int32' in 2 dimensions"),
        ("flat", "holds 'float64' in 1 dimensions"),
        ("one column", "not rows of two pixel coordinates"),
        ("nan", "not rows of two pixel coordinates"),
        ("far", "not rows of two pixel coordinates"),
        ("empty", "in 0 dimensions"),
        ("group", "is not an array of numbers"),
        ("type", "is not an array of numbers"),
        ("soft loop", "is a link, which is not followed"),
        ("external link", "is a link, which is not followed"),
        ("external data", "lies in another file"),
        ("virtual", "lies in another file"),
        ("size", "its image_size is not a width and a height"),
        ("sizes", "its image_size is not a width and a height"),
    ],
)
def test_hostile_files(tmp_path, kind, said):
    trap = tmp_path / "other.h5"
    with h5py.File(trap, "w") as file:
        file["secret"] = np.ones((4, 2), np.float32)
    path = tmp_path / "feats.h5"
    hostile(path, kind, trap)
    with pytest.raises(InputError) as error:
        keypoints(path)
    assert str(error.value).startswith(f"{path}: ") and said in str(error.value) and str(error.value).isprintable()


def test_not_hdf5(tmp_path):
    path = tmp_path / "feats.h5"
    for content in (b"", b"no HDF5", b"\x89HDF\r\n\x1a\n", b"\x89HDF\r\n\x1a\n" + bytes(100)):
        path.write_bytes(content)
        with pytest.raises(InputError, match="no HDF5 data that can be read"):
            keypoints(path)
    with pytest.raises(InputError, match="a folder, not a file"):
        keypoints(tmp_path)


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """A small world's files of features, with checksums as hloc writes them and without."""
    folder = tmp_path_factory.mktemp("sound")
    world = make_world(folder, np.random.default_rng(5))
    for libver in ("latest", "earliest"):
        write_features(world, folder / f"{libver}.h5", libver=libver)
    return [(folder / f"{libver}.h5").read_bytes() for libver in ("latest", "earliest")]


@settings(max_examples=75)
@given(st.data())
def test_flipped_and_truncated_hdf5(folder, sound, data):
    """Numbers, nothing or one sentence; in no case gigabytes, a crash or another exception."""
    content = bytearray(data.draw(st.sampled_from(sound)))
    # Flips where there is structure: most of the rest are numbers that may be any.
    used = np.flatnonzero(np.frombuffer(bytes(content), np.uint8)).tolist()
    for _ in range(data.draw(st.integers(0, 4))):
        content[data.draw(st.sampled_from(used))] ^= 1 << data.draw(st.integers(0, 7))
    if data.draw(st.booleans()):
        del content[data.draw(st.integers(0, len(content))) :]
    path = folder / "flipped.h5"
    path.write_bytes(content)
    for name in (QUERY, *REFERENCES):
        try:
            found = keypoints(path, name)
        except SpherlocError as error:
            assert str(error).startswith(f"{path}: ") and str(error).isprintable() and len(str(error)) < 600
        else:
            assert found is None or (np.isfinite(found.pixels).all() and found.pixels.shape[1] == 2)


def test_a_pickle_in_a_scene(world, rng):
    """The key that names hloc's logs is refused when the scene is loaded, not when it is run."""
    write_all(world, rng)
    logs = world.outputs / "results.txt_logs.pkl"
    logs.write_bytes(pickled(world.folder / "trap", 4))
    for key, name in (("truth", "truth.txt"), ("pairs", "pairs.txt"), ("matches", "matches.h5")):
        scene = world.folder / "bad.toml"
        scene.write_text(SCENE.replace(f'{key} = "outputs/{name}"', f'{key} = "outputs/{logs.name}"'))
        with pytest.raises(InputError, match="is a Python pickle"):
            load_scene(scene)
    assert not (world.folder / "trap").exists()


def test_text_of_numbers_reads_back(folder, rng):
    """Quaternions of any rotation, however they are rounded."""
    quaternions = rng.normal(size=(20, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    rows = [f"{index}.jpg {numbers(q)} {numbers(rng.normal(size=3))}\n" for index, q in enumerate(quaternions)]
    for pose, q in zip(read_results(text(folder, "".join(rows))).values(), quaternions, strict=True):
        assert np.allclose(pose[:, :3] @ pose[:, :3].T, np.eye(3), atol=1e-14)
        assert np.allclose(pose[:, :3], rotation_from_wxyz(-q), atol=1e-14)
