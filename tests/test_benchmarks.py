"""The benchmarks run, resume, and give peers the data in the peers' own convention. No time is asserted."""

import json
from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from benchmarks import certificate, clique, peers, pictures, table
from benchmarks.brute_force import largest_consensus
from benchmarks.cases import ADAPTIVE, simulated
from benchmarks.methods import Answer
from benchmarks.run import arguments, run
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.datasets.synthetic import SyntheticScene
from spherloc.metrics import rotation_error_deg, translation_error_m
from spherloc.refine import residuals_px
from spherloc.trace import Certificate

PEERS = peers.peers()


@pytest.mark.parametrize("name", PEERS)
def test_peers_are_given_the_data_in_their_convention(name):
    """Without noise and outliers a wrong axis, sign or principal point would show at once."""
    scene = replace(simulated(60, 0.0).__self__, noise_px=0.0)
    for seed in range(3):
        problem = scene.problem(seed)
        answer = PEERS[name].prepare(problem, seed)()
        assert answer.cam_from_map is not None
        assert rotation_error_deg(problem.truth_cam_from_map, answer.cam_from_map) < 0.1
        assert translation_error_m(problem.truth_cam_from_map, answer.cam_from_map) < 0.01


@pytest.mark.parametrize("name", PEERS)
def test_peers_threshold_fits_the_noise(name, monkeypatch):
    """A bound of three times the noise is right; one far below the noise must change what comes out."""
    problem = simulated(100, 0.3)(4)
    errors = []
    for bound_px in (3.0, 1e-3):
        monkeypatch.setattr(peers, "BOUND_PX", bound_px)
        answer = PEERS[name].prepare(problem, 0)()
        errors.append(np.inf)
        if answer.cam_from_map is not None:
            errors[-1] = rotation_error_deg(problem.truth_cam_from_map, answer.cam_from_map)
    assert errors[0] < 1.0
    assert errors[1] != errors[0]


def test_faces_cover_the_sphere(rng):
    assert np.allclose(peers.FACES @ peers.FACES.transpose(0, 2, 1), np.eye(3))
    assert np.allclose(np.linalg.det(peers.FACES), 1.0)
    rays = rng.standard_normal((1000, 3))
    faces = peers.face_of(rays)
    inside = np.einsum("nij,nj->ni", peers.FACES[faces], rays)
    assert (np.abs(inside[:, :2]) <= inside[:, 2:] * (1 + 1e-12)).all()
    assert set(faces) == set(range(6))


def test_panorama_is_colmaps(rng):
    rays = rng.standard_normal((200, 3))
    size = np.array([2 * np.pi, np.pi]) * peers.FOCAL_PX
    camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=round(size[0]), height=round(size[1]), params=size)
    assert np.allclose(peers.to_panorama(rays), camera.img_from_cam(rays), atol=1e-6)


def test_pixel_ratio_of_a_camera_twice_as_sharp():
    """An equidistant scene camera with twice the focal length of the peer's: half a pixel a pixel, everywhere."""
    camera = KannalaBrandt(1400, 1400, 2 * peers.FOCAL_PX, 2 * peers.FOCAL_PX, 700.0, 700.0, (0.0, 0.0, 0.0, 0.0))
    problem = SyntheticScene("sharp", camera, 50, 0.0, 0.0, 0).problem()
    assert peers.pixel_ratio(problem, np.arange(50), peers.to_equidistant) == pytest.approx(0.5, rel=1e-6)


def test_one_row_runs_and_a_second_run_resumes(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("benchmarks.run.draw", lambda results: None)
    monkeypatch.setattr("benchmarks.run.fingerprint", lambda: "these sources")
    command = ["--case", "n50-90", "--problems", "2", "--method", ADAPTIVE, "--method", "PoseLib rig"]
    chosen = arguments([*command, "--out", str(tmp_path)])
    assert run(chosen) == 0
    (row,) = json.loads((tmp_path / "results.json").read_text())["rows"]
    assert set(row["methods"]) == {ADAPTIVE, "PoseLib rig"}
    assert row["methods"][ADAPTIVE]["problems"] == 2
    assert row["settings"]["PoseLib rig"]["max_iterations"] == 100_000
    assert row["machine"]["versions"]["poselib"] != "not installed"
    text = (tmp_path / "table.md").read_text()
    assert "N=50, 90 % outliers" in text and "PoseLib rig" in text
    monkeypatch.setattr("benchmarks.run.measure", lambda *_: pytest.fail("a finished row was measured again"))
    capsys.readouterr()
    assert run(chosen) == 0
    assert "already measured" in capsys.readouterr().out
    with pytest.raises(pytest.fail.Exception):  # stopped in the middle of a row
        run(arguments([*command, "--fresh", "--out", str(tmp_path)]))
    assert json.loads((tmp_path / "results.json").read_text())["rows"] == [row]
    monkeypatch.setattr("benchmarks.run.fingerprint", lambda: "other sources")
    with pytest.raises(pytest.fail.Exception):
        run(chosen)


def test_unknown_rows_are_named(capsys):
    assert run(arguments(["--case", "n7-7"])) == 2
    assert "no row n7-7" in capsys.readouterr().err


def test_brute_force_finds_what_the_truth_explains():
    """And stays within what there is; noise up to the bound leaves the truth explaining all inliers."""
    for seed in range(15):
        problem, bound_px, _ = certificate.random_problem(seed)
        truth = problem.truth_cam_from_map
        explained = np.count_nonzero(residuals_px(problem.aligned, problem.aligned.align_pose(truth)) <= bound_px)
        assert explained <= largest_consensus(problem.aligned, bound_px, truth) <= len(problem)


def test_brute_force_does_not_need_the_truth():
    problem = simulated(12, 0.25)(0)
    wrong = problem.truth_cam_from_map.copy()
    wrong[:, 3] += 3.0
    assert largest_consensus(problem.aligned, 4.0, wrong) == 9


def test_certificate_is_honest_on_a_few():
    checks = [certificate.check(seed) for seed in range(4, 12)]
    assert certificate.summary(checks)["dishonest"] == []


def test_a_dishonest_certificate_is_noticed(monkeypatch):
    """Bounds that are one too small must be listed."""

    def lying(problem, *_):
        class Run:
            certificate = Certificate(1, 1, 0.0)

        return Run()

    monkeypatch.setattr(certificate, "estimate", lying)
    assert certificate.summary([certificate.check(seed) for seed in range(3)])["dishonest"] == [0, 1, 2]


def test_cliques_have_one_size():
    graph = clique.ball_graph(80, 0.1, 12, 3)
    assert (graph == graph.T).all()
    sizes = {len(list(clique.LIBRARIES[library](graph)())) for library in ("spherloc", "networkx")}
    assert len(sizes) == 1 and sizes.pop() >= 12


def test_slope_of_a_power_law():
    rows = [
        {
            "facts": {"correspondences": size, "outlier_rate": 0.9},
            "methods": {"made up": {"median_ms": 3e-3 * size**1.7}},
        }
        for size in (50, 100, 400, 2000)
    ]
    slope, low, high = table.growth_slopes(rows)["made up"]
    assert (round(slope, 6), low, high) == (1.7, 50, 2000)


def test_labels_are_moved_apart_and_no_farther_than_needed():
    moved = pictures._apart(np.array([0.1, 0.1, 0.5]), 0.05)
    assert np.allclose(moved, [0.075, 0.125, 0.5])


def test_answers_without_a_finite_pose_are_none():
    assert peers._answer(np.eye(3), [np.nan, 0.0, 0.0]).cam_from_map is None
    assert isinstance(peers._answer(np.eye(3), np.zeros(3)), Answer)
