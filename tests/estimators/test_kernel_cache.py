"""Compiled kernels follow the sources, and processes that compile at once do not take each other's machine code."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

from spherloc import kernel_cache

ROOT = Path(__file__).resolve().parents[2]

RUN = """
import numpy as np
from spherloc.estimators.mc import _most_inliers
from spherloc.gauss_newton import Matches

bearings, points = np.eye(3), np.eye(3) * [[1.0], [2.0], [3.0]]
jacobian = np.array([[np.eye(3)[(k + 1) % 3], np.eye(3)[(k + 2) % 3]] for k in range(3)])
translations = np.array([[9.0, 9.0, 9.0], [0.0, 0.0, 0.0]])
print(_most_inliers(np.zeros(2), translations, Matches(bearings, points, jacobian), np.full(3, 0.1)))
"""
"""Of two poses, only the second, which looks along the bearings at their points, explains anything."""


def best_of_two(folder):
    """What a kernel of one file, which calls those of another, finds with the copy of the package in ``folder``."""
    environment = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    environment["PYTHONPATH"] = str(folder)
    done = subprocess.run([sys.executable, "-c", RUN], env=environment, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_change_in_a_called_kernel_is_noticed(tmp_path):
    """numba watches only the file of the kernel that it cached, and this one calls a kernel of another file."""
    shutil.copytree(ROOT / "spherloc", tmp_path / "spherloc", ignore=shutil.ignore_patterns("__pycache__"))
    assert best_of_two(tmp_path) == "1"
    counting = tmp_path / "spherloc" / "consensus" / "inliers.py"
    text = counting.read_text(encoding="utf-8")
    assert text.count("        if inliers < floors[b]:\n            return False\n") == 1
    changed = text.replace("        if inliers < floors[b]:\n            return False\n", "        return False\n")
    counting.write_text(changed, encoding="utf-8")
    assert best_of_two(tmp_path) == "0"


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
