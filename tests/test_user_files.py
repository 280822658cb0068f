"""Whatever a user's path names, a reader gives an answer or one sentence: never a traceback, a wait or all memory."""

import ast
import os
import re
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from spherloc import files
from spherloc.cameras.calibration import load_camera
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.tool_files import read_kalibr_chain
from spherloc.datasets import load_scene, newer_college
from spherloc.datasets.correspondences import read_csv
from spherloc.datasets.image_folder import read_depth
from spherloc.datasets.matterport360 import read_dpt, read_pose
from spherloc.datasets.scene_file import scene_kinds
from spherloc.errors import MAX_UNBROKEN, CalibrationError, InputError, SpherlocError, legible, show
from spherloc.experiments.configuration import read_configuration
from spherloc.experiments.results import read_results
from spherloc.formats import kitti360_files
from spherloc.formats.colmap_files import read_model
from spherloc.formats.hloc_files import open_hdf5, read_pairs, read_queries
from spherloc.formats.hloc_files import read_results as read_hloc_results
from spherloc.formats.kapture_files import read_kapture
from spherloc.frontend.learned import _network
from spherloc.images import read_depth_png, read_image, read_size
from spherloc.trajectory import read_euroc, read_newer_college, read_tum

SOURCES = Path(__file__).resolve().parents[1] / "spherloc"


def _hdf5(path: Path) -> None:
    with open_hdf5(path):
        pass


def _mask(path: Path) -> None:
    kitti360_files.without_car(path, Equirectangular(width=8, height=4))


READERS: dict[str, Callable[[Path], Any]] = {
    "scene": load_scene,
    "matches": read_csv,
    "calibration": load_camera,
    "camera chain": read_kalibr_chain,
    "image": read_image,
    "size of an image": read_size,
    "depth as PNG": read_depth_png,
    "depth as npy": lambda path: read_depth(path, 0.001),
    "TUM": read_tum,
    "EuRoC": read_euroc,
    "Newer College": read_newer_college,
    "dpt": read_dpt,
    "pose of a panorama": read_pose,
    "laser scan": kitti360_files.read_scan,
    "poses of a drive": kitti360_files.read_poses,
    "times of a drive": kitti360_files.read_timestamps,
    "mask of the car": _mask,
    "point cloud": newer_college.read_cloud,
    "pairs": read_pairs,
    "queries": read_queries,
    "poses of hloc": read_hloc_results,
    "HDF5": _hdf5,
    "weights": lambda path: _network("ALIKED", path),
    "configuration": read_configuration,
    "results": read_results,
    "COLMAP model": read_model,
    "kapture": lambda path: read_kapture(path, "scene.toml"),
    "images by time": newer_college.images_in,
}


@pytest.fixture(scope="module")
def hostile(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Paths that are no file that anybody could read, by what is wrong with them."""
    folder = tmp_path_factory.mktemp("hostile")
    os.mkfifo(folder / "pipe.npy")
    (folder / "zero.npy").symlink_to("/dev/zero")
    (folder / "folder.npy").mkdir()
    (folder / "circle.npy").symlink_to("circle.npy")
    server = socket.socket(socket.AF_UNIX)
    here = Path.cwd()
    os.chdir(folder)  # a socket's name is short
    server.bind("socket.npy")
    os.chdir(here)
    server.close()
    return {
        "missing": folder / "missing.npy",
        "pipe": folder / "pipe.npy",
        "device": folder / "zero.npy",
        "folder": folder / "folder.npy",
        "circle": folder / "circle.npy",
        "socket": folder / "socket.npy",
        "long name": folder / ("n" * 300 + ".npy"),
        "long path": Path("/".join(["n" * 200] * 100)),
        "zero byte": folder / "a\0b.npy",
        "below a file": Path(__file__) / "x.npy",
        "no UTF-8": folder / "caf\udce9.npy",
    }


@pytest.mark.parametrize("reader", READERS)
def test_what_is_no_file_is_one_sentence(reader: str, hostile: dict[str, Path]) -> None:
    """Named pipes were waited for without end, /dev/zero filled the memory, long names were a raw OSError."""
    for what, path in hostile.items():
        with pytest.raises(SpherlocError) as caught:
            READERS[reader](path)
        sentence = str(caught.value)
        assert len(sentence) < 1500 and sentence.isprintable(), f"{reader}, {what}: {sentence}"
        assert max(map(len, sentence.split())) <= MAX_UNBROKEN + 5, f"{reader}, {what}: {sentence}"


def test_paths_within_scenes_too(tmp_path: Path) -> None:
    """Every text of every kind's example, replaced by names that no file has."""
    scene = tmp_path / "scene.toml"
    for kind in scene_kinds():
        texts = [match for match in re.finditer(r'= \[?"([^"\n]*)"', kind.example) if match[1] != kind.name]
        assert texts or kind.name == "synthetic", kind.name
        for match in texts:
            for name in ("n" * 300, "a\\u0000b", "n/" * 3000):
                scene.write_text(kind.example[: match.start(1)] + name + kind.example[match.end(1) :])
                try:
                    load_scene(scene)
                except InputError as error:
                    assert len(str(error)) < 2100 and str(error).isprintable()


OPENERS = {"read_text", "read_bytes", "is_file", "is_dir", "iterdir", "open"}
OWN_FILES = {
    "files",
    "kernel_cache",
    "worlds.render",
    "disk_cache",
    "datasets.scene_file",
    "mapping.two_view.matched",
    "mapping.models.reconstruction",
    "mapping.models.later",
}
"""Those that open what spherloc itself wrote or brings: the fifth its own scenes, the last three their database."""


def _opens(node: ast.AST) -> str:
    """What a call opens or looks at by itself; empty if it is another call or writes."""
    if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in OPENERS):
        return ""
    owner = node.func.value.id if isinstance(node.func.value, ast.Name) else ""
    mode = node.args[0].value if node.args and isinstance(node.args[0], ast.Constant) else ""
    writes = node.func.attr == "open" and isinstance(mode, str) and bool(set(mode) & set("wax"))
    return "" if writes or owner in ("Image", "os") else node.func.attr


def test_nothing_opens_a_path_but_files() -> None:
    """A reader that opens a user's path by itself would wait for pipes again."""
    found = []
    for source in sorted(SOURCES.rglob("*.py")):
        name = ".".join(source.relative_to(SOURCES).with_suffix("").parts)
        for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
            if name not in OWN_FILES and (what := _opens(node)):
                found.append(f"{name}, line {getattr(node, 'lineno', 0)}: {what}")
    assert found == []


def test_a_file_that_does_not_tell_its_size_is_bounded(tmp_path: Path) -> None:
    assert b"Name" in files.read_file(Path("/proc/self/status"), 100_000)  # says that it has 0 bytes
    with pytest.raises(OSError, match="larger than 100 bytes"):
        files.read_file(Path("/proc/self/status"), 100)
    sparse = tmp_path / "sparse"
    with sparse.open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(OSError, match="larger than 1 MiB"):
        files.read_file(sparse, 1 << 20)
    sparse.write_bytes(b"x" * 100)
    assert files.read_file(sparse, 100) == b"x" * 100


BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{new}: &{new} [{', '.join(['*' + old] * 9)}]\n" for old, new in zip("abcdefgh", "bcdefghi", strict=True)
)
YAMLS = {
    "aliases that multiply": ("model_type: MEI\n" + BOMB + "image_width: *i\n", "aliases"),
    "an alias of itself": ("cam0: &a [*a]\n", "contains itself"),
    "a table in itself": ("cam0: &a\n  camera_model: *a\n", "contains itself"),
    "a long text": ("cam0:\n  camera_model: " + "x" * 100_000 + "\n  distortion_model: none\n", "is not supported"),
    "a long key": ("cam0:\n  ? " + "[" * 90 + "]" * 90 + "\n  : 1\n", ""),
    "control characters": ('cam0:\n  camera_model: "\\e[31m\\u202e"\n  distortion_model: none\n', r"\x1b[31m\u202e"),
}


@pytest.mark.parametrize("what", YAMLS)
def test_a_calibration_cannot_fill_the_screen(what: str, tmp_path: Path) -> None:
    """Aliases of 500 bytes made one sentence of 600 kB."""
    content, said = YAMLS[what]
    path = tmp_path / "camera.yaml"
    path.write_text(content)
    with pytest.raises(CalibrationError) as caught:
        load_camera(path)
    assert said in str(caught.value) and len(str(caught.value)) < 800 and str(caught.value).isprintable()


def test_aliases_that_do_not_multiply_are_read(tmp_path: Path) -> None:
    path = tmp_path / "chain.yaml"
    path.write_text(
        "cam0: &first\n  camera_model: pinhole\n  distortion_model: equidistant\n  intrinsics: [300, 300, 320, 240]\n"
        "  distortion_coeffs: &k [0.1, 0.01, 0.0, 0.0]\n  resolution: [640, 480]\n"
        "cam1:\n  camera_model: pinhole\n  distortion_model: equidistant\n  intrinsics: [301, 300, 320, 240]\n"
        "  distortion_coeffs: *k\n  resolution: [640, 480]\ncam2: *first\n"
    )
    assert load_camera(path, "cam1").to_dict()["distortion"] == [0.1, 0.01, 0.0, 0.0]
    assert load_camera(path, "cam2") == load_camera(path, "cam0")


def test_quotes_are_short_and_whole() -> None:
    deep: Any = "x"
    for _ in range(40):
        deep = [deep] * 9
    for value in ("a" * 10**6, [1] * 10**6, deep, {"k": deep}, 10**5000, b"\0" * 10**6, "\x1b\n\u202e" * 99):
        assert 0 < len(show(value)) <= 60 and show(value).isprintable()
    assert show("sixty" * 11) == repr("sixty" * 11) and show(1.5) == "1.5"
    sentence = legible(f"/home/{'d' * 5000}/scene.toml: key {show('x' * 99)} is wrong\n; correct it.")
    assert sentence.startswith("/home/ddd") and sentence.endswith(r"is wrong\n; correct it.") and len(sentence) < 500
    assert str(InputError("x " * 10**6)).endswith("x ") and len(str(InputError("x " * 10**6))) <= 2000
