"""Proofs: true ones are believed, and whatever is done to them is seen."""

import subprocess
import sys

import numpy as np
import pytest
from cli_process import SCENE, one_sentence, spherloc_here

from spherloc.errors import InputError
from spherloc.estimators import estimate
from spherloc.proof import write_proof
from spherloc.proof_check import Refused, check


@pytest.fixture(scope="module", params=[0.0, 0.5])
def proof(request, scene_of, tmp_path_factory):
    """A file, with gravity exact or not, and the run that it is of."""
    scene = scene_of("fisheye", correspondences=30, outlier_rate=0.5, noise_px=1.0, gravity_error_deg=request.param)
    trace = estimate(scene.problem(4), "mc-exact")
    path = tmp_path_factory.mktemp("proof") / "proof.npz"
    assert write_proof(trace, path) > 1
    return path, trace


def changed(proof, tmp_path, **arrays):
    """The file with other arrays."""
    with np.load(proof[0]) as file:
        content = {name: file[name] for name in file.files} | arrays
    path = tmp_path / "changed.npz"
    np.savez(path, **content)
    return path


def arrays_of(proof):
    with np.load(proof[0]) as file:
        return {name: file[name] for name in file.files}


def test_a_true_proof_is_believed(proof):
    path, trace = proof
    said = check(path)
    assert f"more than {trace.certificate.upper_bound} of {len(trace.problem)}" in said
    done = subprocess.run(
        [sys.executable, "-m", "spherloc.proof_check", path], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == said


CELL_ARRAYS = ("lower", "upper", "chart", "rule", "bound")


def test_a_missing_cell_is_seen(proof, tmp_path):
    arrays = arrays_of(proof)
    for k in range(0, len(arrays["chart"]), max(1, len(arrays["chart"]) // 10)):
        if arrays["rule"][k] == 0 and (arrays["upper"][k] <= arrays["lower"][k]).any():
            continue
        without = {name: np.delete(arrays[name], k, axis=0) for name in CELL_ARRAYS}
        with pytest.raises(Refused, match="leave out"):
            check(changed(proof, tmp_path, **without))


def test_a_smaller_cell_is_seen(proof, tmp_path):
    arrays = arrays_of(proof)
    for axis in range(4):
        for name, sign in (("lower", 1.0), ("upper", -1.0)):
            ends = arrays[name].copy()
            ends[len(ends) // 2, axis] += sign * 1e-9
            with pytest.raises(Refused, match="leave out"):
                check(changed(proof, tmp_path, **{name: ends}))


def test_other_bounds_are_seen(proof, tmp_path):
    arrays = arrays_of(proof)
    most = int(np.argmax(arrays["bound"]))
    for change in (-1, int(arrays["claim"]) - int(arrays["bound"][most]) + 1):
        bound = arrays["bound"].copy()
        bound[most] += change
        if change > 0 or arrays["rule"][most] != 1:
            with pytest.raises(Refused, match=f"cell {most}"):
                check(changed(proof, tmp_path, bound=bound))
    for claim in (arrays["claim"] - 1, 2):
        with pytest.raises(Refused):
            check(changed(proof, tmp_path, claim=claim))
    with pytest.raises(Refused, match="pose"):
        check(changed(proof, tmp_path, found=arrays["found"] + 1))


def test_other_problems_are_seen(proof, tmp_path):
    """A proof of one problem proves nothing of another: points moved, bound or tilt widened, outliers made inliers."""
    arrays = arrays_of(proof)
    with pytest.raises(Refused):
        check(
            changed(proof, tmp_path, points=arrays["points"] + np.linspace(0, 3, arrays["points"].size).reshape(-1, 3))
        )
    with pytest.raises(Refused):
        check(changed(proof, tmp_path, bound_px=3.0 * arrays["bound_px"]))
    with pytest.raises(Refused, match="leave out"):
        check(changed(proof, tmp_path, gravity_bound_rad=arrays["gravity_bound_rad"] + 0.01))
    pose = arrays["cam_from_map"][0]
    rays = arrays["points"] @ pose[:, :3].T + pose[:, 3]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    basis = np.linalg.svd(rays[:, None, :])[2][:, 1:]
    with pytest.raises(Refused):
        check(changed(proof, tmp_path, bearings=rays, pixel_from_bearing=300.0 * basis))


@pytest.mark.parametrize("name", ["points", "lower", "upper", "scale", "bound", "claim"])
def test_broken_files_are_refused(proof, tmp_path, name):
    arrays = arrays_of(proof)
    value = arrays[name].astype(float)
    value.flat[0] = np.nan
    with pytest.raises(Refused):
        check(changed(proof, tmp_path, **{name: value}))
    with pytest.raises(Refused):
        check(
            changed(proof, tmp_path, **{name: np.array([object()])} if name == "points" else {name: np.empty((0, 0))})
        )


def test_what_is_no_proof_is_refused(tmp_path, scene_of):
    (tmp_path / "words.npz").write_text("no numbers")
    for name in ("words.npz", "absent.npz"):
        with pytest.raises(Refused):
            check(tmp_path / name)
    with pytest.raises(InputError, match="run mc-exact"):
        write_proof(estimate(scene_of("mei", outlier_rate=0.5).problem(0), "ransac-2p"), tmp_path / "none.npz")


def test_on_the_command_line(tmp_path):
    given = ("run", SCENE, "--estimator", "mc-exact", "--no-record", "--proof", "proof.npz")
    done = spherloc_here(*given, cwd=tmp_path)
    assert done.returncode == 0 and "check them" in done.stderr
    checked = spherloc_here("check-proof", "proof.npz", cwd=tmp_path)
    assert checked.returncode == 0 and "cells hold every pose" in checked.stdout
    content = (tmp_path / "proof.npz").read_bytes()
    (tmp_path / "proof.npz").write_bytes(content[: len(content) // 2])
    refused = spherloc_here("check-proof", "proof.npz", cwd=tmp_path)
    assert refused.returncode == 1 and refused.stderr.startswith("refused: ") and "Traceback" not in refused.stderr
    twice = spherloc_here("run", SCENE, SCENE, "--estimator", "mc-exact", "--proof", "proof.npz", cwd=tmp_path)
    assert twice.returncode == 2 and "one scene" in one_sentence(twice)
