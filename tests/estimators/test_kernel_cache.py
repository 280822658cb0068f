"""Compiled kernels follow the sources, and processes that compile at once do not take each other's machine code."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

from spherloc import kernel_cache

ROOT = Path(__file__).resolve().parents[2]

FOLDER = "from spherloc.kernel_cache import kernel_folder; print(kernel_folder())"


def folder_of(copy):
    """Where the kernels of the copy of the package in the folder ``copy`` are kept."""
    environment = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    environment["PYTHONPATH"] = str(copy)
    done = subprocess.run([sys.executable, "-c", FOLDER], env=environment, cwd=copy, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_change_in_a_called_kernel_is_noticed(tmp_path):
    """numba watches only the file of the kernel that it cached, which calls kernels of other files."""
    shutil.copytree(ROOT / "spherloc", tmp_path / "spherloc", ignore=shutil.ignore_patterns("__pycache__"))
    before = [folder_of(tmp_path)]
    assert before[0].startswith(str(tmp_path)) and folder_of(tmp_path) == before[0]
    for file in ("consensus/inliers.py", "gauss_newton.py", "solvers/two_point.py"):
        changed = tmp_path / "spherloc" / file
        changed.write_text(changed.read_text(encoding="utf-8") + "\n", encoding="utf-8")
        found = folder_of(tmp_path)
        assert found not in before, file
        before.append(found)


def halved(value):
    """What the kernels below do."""
    return value / 2


def test_processes_that_compile_at_once_do_not_mix_their_kernels(tmp_path, monkeypatch):
    """Both read the index before either wrote and numbered from 1: the later index led to the earlier code."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(kernel_cache, "kernel_folder", lambda: tmp_path)
    first, second, third = (kernel_cache.kernel()(halved) for _ in range(3))
    files = first._cache._cache_file
    save = files._save_data

    def save_late(name, data):
        assert second(3.0) == 1.5
        save(name, data)

    monkeypatch.setattr(second._cache._cache_file, "_load_index", dict)
    monkeypatch.setattr(files, "_save_data", save_late)
    assert first(3) == 1.5
    assert third(3.0) == 1.5 and third.stats.cache_hits, "the later index was not read"
    assert third(3) == 1.5


def test_another_librarys_kernels_stay_where_they_are(monkeypatch, tmp_path):
    """Importing moves nobody else's cache."""
    script = "import os, numba, spherloc.refine; print(numba.config.CACHE_DIR, 'NUMBA_CACHE_DIR' in os.environ)"
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False"], done.stdout


def test_every_file_with_kernels_is_watched():
    package = ROOT / "spherloc"
    files = {path for path in package.rglob("*.py") if "@kernel(" in path.read_text(encoding="utf-8")}
    watched = {package / name for name in kernel_cache.KERNEL_SOURCES}
    assert len(files) > 20
    assert [path for path in files if not {path, *path.parents} & watched] == []
