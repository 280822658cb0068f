"""Compiled kernels follow the sources: after an update nobody may go on with the old machine code."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

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
