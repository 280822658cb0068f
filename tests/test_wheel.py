"""A wheel, built without network from a source archive, has all that the checkout has beside its packages."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from tests.waiting import LIMIT_S

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ("pyproject.toml", "MANIFEST.in", "README.md", "LICENSE", "scripts", "scenes", "recordings/gallery.toml")
PACKAGES = ("spherloc", "spherloc_viz")
FILES = sorted(path.name for path in (ROOT / "scenes").iterdir())
SCENES = [name for name in FILES if name.endswith(".toml")]

BUILD = "import sys; from setuptools import build_meta; build_meta.{hook}(sys.argv[1])"
LOOK = """
from spherloc.datasets import bundled_scenes, load_scene
from spherloc_viz.gallery import GALLERY, gallery_cases
for path in bundled_scenes().values():
    load_scene(path)
    print(path)
print(GALLERY)
print(len(gallery_cases()))
"""


def run(*words: str | Path, cwd: Path, **environment: str) -> str:
    done = subprocess.run(
        [sys.executable, *map(str, words)],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        env=os.environ | environment,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from a source archive, as an index would do it; the checkout is left alone."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    for name in (*SOURCES, *PACKAGES):
        target = source / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, target, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(ROOT / name, target)
    run("-c", BUILD.format(hook="build_sdist"), folder, cwd=source)
    (archive,) = folder.glob("*.tar.gz")
    run("-m", "tarfile", "-e", archive, folder / "unpacked", cwd=folder)
    (unpacked,) = (folder / "unpacked").iterdir()
    run("-c", BUILD.format(hook="build_wheel"), folder, cwd=unpacked)
    (built,) = folder.glob("*.whl")
    return built


def test_a_wheel_has_scenes_gallery_and_every_file_of_the_packages(wheel: Path):
    with zipfile.ZipFile(wheel) as packed:
        names = set(packed.namelist())
    wanted = {f"spherloc/datasets/scenes/{name}" for name in FILES} | {"spherloc_viz/gallery/gallery.toml"}
    for package in PACKAGES:
        files = (path.relative_to(ROOT) for path in (ROOT / package).rglob("*") if path.is_file())
        wanted |= {path.as_posix() for path in files if "__pycache__" not in path.parts}
    assert {name for name in names if ".dist-info/" not in name} == wanted


def test_what_is_installed_from_a_wheel_needs_no_checkout(wheel: Path, tmp_path: Path):
    installed, elsewhere = tmp_path / "installed", tmp_path / "elsewhere"
    with zipfile.ZipFile(wheel) as packed:
        packed.extractall(installed)
    elsewhere.mkdir()
    *scenes, gallery, cases = run("-c", LOOK, cwd=elsewhere, PYTHONPATH=str(installed)).splitlines()
    assert [Path(path).name for path in scenes] == SCENES
    assert all(Path(path).is_relative_to(installed) for path in (*scenes, gallery))
    assert int(cases) >= 12
    assert list(elsewhere.iterdir()) == []
