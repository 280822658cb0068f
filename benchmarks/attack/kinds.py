"""What spherloc reads, by kind: how an intact one is written, which of its files are damaged, and what reads them.

The intact ones are those that the tests use.
"""

import shutil
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.machine import ROOT

sys.path.extend(str(ROOT / "tests" / name) for name in ("", "cameras", "datasets", "experiments"))


@dataclass(frozen=True)
class Kind:
    """One row of the table."""

    write: Callable[[Path], object]
    """Writes an intact one into an empty folder."""
    damage: tuple[str, ...]
    """Patterns of the files that are damaged, one at a time."""
    read: Callable[[Path, Path], object]
    """Reads it, given the folder and the damaged file; raises ``SpherlocError`` where that cannot be."""
    share: float = 1.0
    """How many are tried, by those of other kinds: fewer of those that take longer."""
    writes: bool = False
    """Whether what reads it also writes there."""


def _text(folder: Path, files: dict[str, str]) -> None:
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(content)


def _load(folder: Path, damaged: Path) -> object:
    from spherloc.datasets import load_scene

    return load_scene(folder / "scene.toml")


def _problem(folder: Path, damaged: Path) -> object:
    from spherloc.datasets import load_scene

    return load_scene(folder / "scene.toml").problem()


def _write_synthetic(folder: Path) -> None:
    from scene_texts import SYNTHETIC

    from spherloc.datasets import bundled_scenes

    scenes = bundled_scenes()
    text = (scenes["mei_outliers_80"].read_text(), scenes["panorama_outliers_80"].read_text(), SYNTHETIC)
    _text(folder, {f"{number}.toml": content for number, content in enumerate(text)})


def _read_synthetic(folder: Path, damaged: Path) -> object:
    from spherloc.datasets import load_scene
    from spherloc.datasets.synthetic import SyntheticScene
    from spherloc.datasets.variation import Variation

    scene = load_scene(damaged)
    # What asks for a hundred thousand matches may have them; that says nothing about the file.
    return Variation(correspondences=50).problem(scene, None) if isinstance(scene, SyntheticScene) else scene.problem()


def _write_measured(folder: Path) -> None:
    from scene_texts import write_measured

    write_measured(folder)


def _write_calibrations(folder: Path) -> None:
    import test_camera_calibration as one
    import test_camera_tools as other

    basalt = (
        '{"value0": {"T_imu_cam": [{"px": 0.1, "py": 0.0, "pz": 0.0, "qx": 0, "qy": 0, "qz": 0, "qw": 1}], '
        '"intrinsics": [{"camera_type": "ds", "intrinsics": {"fx": 158.0, "fy": 158.0, "cx": 254.9, "cy": 256.9, '
        '"xi": -0.17, "alpha": 0.59}}], "resolution": [[512, 512]]}}'
    )
    texts = {
        "kitti360.yaml": one.KITTI360,
        "kalibr.yaml": one.KALIBR,
        "own.toml": one.TOML,
        "adapter.yaml": other.ADAPTER,
        "loc360.yaml": other.LOC360,
        "stella.yaml": other.STELLA,
        "chain.yaml": other.CHAIN,
        "basalt.json": basalt,
    }
    _text(folder, texts)


def _read_calibration(folder: Path, damaged: Path) -> object:
    from spherloc.cameras.calibration import load_camera

    return load_camera(damaged)


def _write_colmap(folder: Path, text: bool) -> None:
    from colmap_samples import binary_files, sample_model, text_files, with_rigs, write

    sample = with_rigs(sample_model(np.random.default_rng(3)), np.random.default_rng(4), frames=2)
    write(folder / "model", (text_files if text else binary_files)(sample))
    (folder / "images").mkdir()
    (folder / "scene.toml").write_text(
        'kind = "colmap"\nname = "small"\nmodel = "model"\nimages = "images"\n'
        f'queries = ["{sample.images[0][3]}"]\n[gravity]\nmap = [0.0, 0.0, -1.0]\n'
    )
    for image in sample.images:
        (folder / "images" / image[3]).parent.mkdir(parents=True, exist_ok=True)
        (folder / "images" / image[3]).write_bytes(b"")


def _read_colmap(folder: Path, damaged: Path) -> object:
    from spherloc.formats.colmap_files import read_model

    read_model(folder / "model")
    return _load(folder, damaged)


def _write_kapture(folder: Path) -> None:
    from kapture_samples import write_kapture

    names = ("left/0.jpg", "right/0.jpg", "left/1.jpg", "right/1.jpg", "right/2.jpg", "left/2.jpg")
    write_kapture(folder / "tree", names)
    (folder / "scene.toml").write_text(
        'kind = "kapture"\nname = "small"\nroot = "tree"\nqueries = ["left/0.jpg"]\n[gravity]\nmap = [0.0, 1.0, 0.0]\n'
    )


def _write_hloc(folder: Path) -> None:
    from hloc_samples import make_world, write_all

    rng = np.random.default_rng(5)
    write_all(make_world(folder, rng), rng)


def _write_kitti360(folder: Path) -> None:
    from kitti360_tree import SCENE, write_tree

    write_tree(folder / "KITTI-360")
    (folder / "scene.toml").write_text(SCENE)


def _read_kitti360(folder: Path, damaged: Path) -> object:
    from spherloc.formats.kitti360_files import read_scan

    return read_scan(damaged) if damaged.suffix == ".bin" else _load(folder, damaged)


def _write_newer_college(folder: Path) -> None:
    from newer_college_tree import PRIOR_MAP, SCENE, write_tree

    write_tree(folder / "newer-college", np.random.default_rng(6))
    (folder / "scene.toml").write_text(SCENE.replace("cam_from_base", f"{PRIOR_MAP}cam_from_base"))


def _read_newer_college(folder: Path, damaged: Path) -> object:
    from spherloc.datasets.newer_college import read_cloud

    return read_cloud(damaged) if damaged.suffix == ".ply" else _load(folder, damaged)


def _write_matterport(folder: Path) -> None:
    from matterport360_tree import write_building
    from test_matterport360 import SCENE

    write_building(folder / "building", 3, width=128)
    (folder / "scene.toml").write_text(SCENE)


def _read_matterport(folder: Path, damaged: Path) -> object:
    from spherloc.datasets.matterport360 import read_dpt

    return read_dpt(damaged) if damaged.suffix == ".dpt" else _load(folder, damaged)


def _write_folder(folder: Path) -> None:
    from test_image_folder import CAMERA, POSE, POSED, make_tree

    make_tree(folder, f'{CAMERA}{POSED}[truth]\n"b.png" = {POSE}\n')


def _write_images(folder: Path) -> None:
    import cv2

    picture = (255 * np.random.default_rng(7).random((48, 64, 3))).astype(np.uint8)
    for ending in ("png", "jpg", "webp", "tif", "bmp"):
        cv2.imwrite(str(folder / f"image.{ending}"), picture)
    cv2.imwrite(str(folder / "depth.png"), picture[..., 0].astype(np.uint16) * 100)


def _read_image(folder: Path, damaged: Path) -> object:
    from spherloc.images import read_depth_png, read_image, read_size

    if damaged.name == "depth.png":
        return read_depth_png(damaged)
    read_size(damaged)
    return read_image(damaged)


def _write_trajectories(folder: Path) -> None:
    from test_trajectory import EUROC, NEWER_COLLEGE, TUM

    _text(folder, {"tum.txt": TUM, "euroc.csv": EUROC, "newer_college.csv": NEWER_COLLEGE})


def _read_trajectory(folder: Path, damaged: Path) -> object:
    from spherloc import trajectory

    return getattr(trajectory, f"read_{damaged.stem}")(damaged)


def _write_upload(folder: Path) -> None:
    from scene_texts import CSV
    from test_camera_calibration import KALIBR

    _text(folder, {"matches.csv": CSV, "calibration": KALIBR, "gravity": "0 1 0"})


def _read_upload(folder: Path, damaged: Path) -> object:
    from spherloc_viz.app.panels.uploads import MAX_BYTES, File, UploadForm, open_upload

    def content(name: str) -> bytes:
        path = folder / name
        # The browser reads the file, so what is none never comes.
        return path.read_bytes()[:MAX_BYTES] if path.is_file() else b""

    target = folder / "scratch"
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir()
    gravity = content("gravity").decode("utf-8", "replace")
    files = (File(f"m\u202e{'x' * 300}.csv", content("matches.csv")), File("../../c", content("calibration")))
    return open_upload(UploadForm(*files, gravity, "0 0 -1", "1", ""), target)[1].problem()


def _write_recordings(folder: Path) -> None:
    from spherloc.datasets import bundled_scenes, load_scene
    from spherloc.estimators import estimate
    from spherloc_viz.recording.content.writer import write_recording
    from spherloc_viz.recording.review_file import write_review

    problem = load_scene(bundled_scenes()["mei_outliers_80"]).problem()
    for estimator in ("mc", "mc-exact", "ransac-2p"):
        write_recording(estimate(problem, estimator), folder / f"{estimator}.rrd")
        write_review(folder / f"{estimator}.rrd", ["blurred"], "a note")


def _read_recording(folder: Path, damaged: Path) -> object:
    from spherloc_viz.recording.content.data import read_recording
    from spherloc_viz.recording.sandbox.examiner import examine
    from spherloc_viz.recording.viewer import labels_of

    row = examine(damaged)
    labels_of(damaged, row.run_id)
    return read_recording(damaged)


def _read_review(folder: Path, damaged: Path) -> object:
    from spherloc_viz.recording.sandbox.examiner import examine, examine_review

    recording = damaged.with_name(damaged.name.replace(".review", ""))
    examine(recording)
    return examine_review(recording)


def _write_index(folder: Path) -> None:
    _write_recordings(folder)
    for name in ("mc-exact", "ransac-2p"):
        for path in folder.glob(f"{name}*"):
            path.unlink()
    from spherloc_viz.recording.index.run_index import RunIndex

    with RunIndex(folder) as index:
        index.refresh()


def _read_index(folder: Path, damaged: Path) -> object:
    from spherloc_viz.recording.index.query import RunQuery
    from spherloc_viz.recording.index.run_index import RunIndex

    with RunIndex(folder) as index:
        index.groups(RunQuery())
        found = index.find(RunQuery(text="mei"))
        if not found.rows:
            index.refresh()
            found = index.find(RunQuery())
        return found


def _sweep_plan(folder: Path) -> Any:
    from sweep_samples import small_plan

    return small_plan(folder)


def _write_sweep(folder: Path) -> None:
    from spherloc.estimators import estimate
    from spherloc.experiments.sweep_log import SweepLog
    from spherloc.experiments.sweep_rows import row_of

    plan = _sweep_plan(folder)
    from spherloc.datasets import load_scene

    with SweepLog(folder / "sweep.csv", plan) as log:
        for seed in range(plan.first_seed, plan.first_seed + 3):
            trace = estimate(load_scene(folder / "tiny.toml").problem(seed), "mc-exact", seed=seed)
            log.append(row_of(trace, plan.labels[1], plan.values[0]))
        log.finish()


def _read_sweep(folder: Path, damaged: Path) -> object:
    from spherloc.experiments.sweep_log import SweepLog

    with SweepLog(folder / "sweep.csv", _sweep_plan(folder)) as log:
        return log.done_of_plan()


def _write_results(folder: Path) -> None:
    from test_sequence_results import CONFIGURATION, NUMBERS, POSE

    from spherloc.experiments import QueryResult
    from spherloc.experiments.results import ResultsLog

    numbers = {name: 0.5 + place for place, name in enumerate(NUMBERS)}
    with ResultsLog(folder / "out", CONFIGURATION) as log:
        for index in range(3):
            log.append(
                QueryResult(
                    index=index, query=f"{index}.jpg", status="localized", references=2, matches=60, inliers=40,
                    registration_error_m=0.1, diagnosis="ok", recording="a.rrd", message="40 of 60.", remarks=("one",),
                    cam_from_map=POSE, truth_cam_from_map=POSE, **numbers,
                )
            )  # fmt: skip


def _read_results(folder: Path, damaged: Path) -> object:
    from spherloc.experiments import read_results
    from spherloc.experiments.summary import summarize

    return summarize(read_results(folder / "out"))


KINDS: dict[str, Kind] = {
    "simulation (TOML)": Kind(_write_synthetic, ("*.toml",), _read_synthetic),
    "scene of matches (TOML)": Kind(_write_measured, ("scene.toml",), _problem),
    "matches (CSV)": Kind(_write_measured, ("matches.csv",), _problem),
    "calibration (YAML, JSON, TOML)": Kind(_write_calibrations, ("*.yaml", "*.json", "*.toml"), _read_calibration, 2.0),
    "upload (CSV, calibration, form)": Kind(_write_upload, ("matches.csv", "calibration", "gravity"), _read_upload),
    "COLMAP, binary": Kind(lambda folder: _write_colmap(folder, False), ("scene.toml", "model/*"), _read_colmap, 0.5),
    "COLMAP, text": Kind(lambda folder: _write_colmap(folder, True), ("scene.toml", "model/*"), _read_colmap, 0.5),
    "kapture": Kind(_write_kapture, ("scene.toml", "tree/sensors/*.txt"), _load),
    "hloc (HDF5, lists)": Kind(
        _write_hloc, ("scene.toml", "queries.txt", "outputs/*.*", "outputs/sfm/*"), _problem, 0.5
    ),
    "KITTI-360": Kind(
        _write_kitti360,
        ("scene.toml", "KITTI-360/**/*.txt", "KITTI-360/**/*.yaml", "KITTI-360/**/*.bin"),
        _read_kitti360,
    ),
    "Newer College": Kind(
        _write_newer_college,
        ("scene.toml", "newer-college/**/*.csv", "newer-college/**/*.yaml", "newer-college/*.ply"),
        _read_newer_college,
        0.5,
    ),
    "Matterport360": Kind(_write_matterport, ("scene.toml", "building/*"), _read_matterport),
    "folder of images": Kind(_write_folder, ("scene.toml", "*.png", "queries/*"), _load),
    "images (PNG, JPEG, ...)": Kind(_write_images, ("*.*",), _read_image),
    "trajectories (TUM, EuRoC, ...)": Kind(_write_trajectories, ("*.*",), _read_trajectory),
    "recordings (RRD)": Kind(_write_recordings, ("mc.rrd", "mc-exact.rrd", "ransac-2p.rrd"), _read_recording, 0.5),
    "reviews (RRD)": Kind(_write_recordings, ("*.review.rrd",), _read_review, 0.2),
    "list of runs (SQLite)": Kind(_write_index, ("runs.sqlite*",), _read_index, 0.1, writes=True),
    "sweep (CSV, plan)": Kind(_write_sweep, ("sweep.csv", "sweep.plan.json"), _read_sweep, 0.5, writes=True),
    "sequence (JSON lines)": Kind(_write_results, ("out/configuration.json", "out/results.jsonl"), _read_results),
}


def targets(kind: Kind, folder: Path) -> Sequence[Path]:
    """The files of an intact one that are damaged."""
    found = {path for pattern in kind.damage for path in folder.glob(pattern) if path.is_file()}
    return sorted(found)
