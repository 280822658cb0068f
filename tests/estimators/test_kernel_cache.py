"""Compiled kernels follow the sources: after an update nobody may go on with the old machine code."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

RUN = f"""
from pathlib import Path
from spherloc.datasets import load_scene
from spherloc.estimators import estimate
print(estimate(load_scene(Path({str(ROOT / "scenes" / "mei_outliers_80.toml")!r})).problem(), "ransac-2p").message)
"""


def message(folder):
    """The outcome of one run with the copy of the package in ``folder``."""
    environment = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    environment["PYTHONPATH"] = str(folder)
    done = subprocess.run([sys.executable, "-c", RUN], env=environment, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_change_in_a_called_kernel_is_noticed(tmp_path):
    """numba watches only the file of the kernel that it cached, and RANSAC's loop calls a solver of another file."""
    shutil.copytree(ROOT / "spherloc", tmp_path / "spherloc", ignore=shutil.ignore_patterns("__pycache__"))
    assert message(tmp_path).startswith("Pose found")
    solver = tmp_path / "spherloc" / "solvers" / "two_point.py"
    text = solver.read_text(encoding="utf-8")
    assert text.count("if si <= 0.0 or sj <= 0.0:") == 1
    solver.write_text(text.replace("if si <= 0.0 or sj <= 0.0:", "if True:"), encoding="utf-8")
    assert message(tmp_path).startswith("No pose")
