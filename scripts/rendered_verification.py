"""Writes docs/verification/applications.md: what ``spherloc verify`` makes of rendered copies of the paper's datasets.

    python -m scripts.rendered_verification [FOLDER]

Copies, results and tables stay in FOLDER (build/rendered); the same command goes on from there. The copies have the
exact layouts of KITTI-360, Newer College and Matterport360, written by the helpers of the tests.
"""

import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from spherloc.experiments.summary import summarize
from spherloc.verification.sessions import DATASETS, sessions_of
from spherloc.worlds import Conditions
from spherloc_viz.commands.localize import Solving, localized
from spherloc_viz.commands.verify import measured_table, run_sessions
from spherloc_viz.commands.verify_pictures import failure_table, session_pictures

ROOT = Path(__file__).resolve().parent.parent
PAGES = ROOT / "docs" / "verification"
sys.path.insert(0, str(ROOT / "tests" / "datasets"))
TRACKING: dict[str, tuple[str, tuple[str, ...], str | None]] = {
    "mc alone": ("mc", (), None),
    "mc-exact alone": ("mc-exact", (), None),
    "2P alone (100 samples)": ("ransac-2p", ("iterations=100",), None),
    "mc initialises, 2P tracks": ("ransac-2p", ("iterations=100",), "mc"),
    "mc-exact initialises, 2P tracks": ("ransac-2p", ("iterations=100",), "mc-exact"),
}
"""Estimator, options and initialiser."""


def main() -> None:
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "build" / "rendered"
    folders = {
        "kitti360": kitti360(folder / "KITTI-360"),
        "newer-college": newer_college(folder / "NewerCollege", folder / "results"),
        "matterport360": matterport360(folder / "Matterport360"),
    }
    found = run_sessions(folders, folder / "results", quick=False)
    parts = [HEAD, TABLES]
    for number, dataset in (("II", "kitti360"), ("IV and V", "newer-college"), ("III", "matterport360")):
        parts.append(f"### Table {number}\n\n" + measured_table([item for item in found if item.dataset == dataset]))
    files, words = session_pictures(folder / "results", "newer-college", "math-medium")
    for name, content in files.items():
        (PAGES / name).write_bytes(content)
    parts += [failure_table(folder / "results"), words]
    parts.append(tracking(folder))
    parts.append(VEHICLE)
    (PAGES / "applications.md").write_text("\n".join(parts), encoding="utf-8")


def kitti360(root: Path) -> Path:
    """Drive 5 as the reference; drive 4 under clouds, drive 6 at night."""
    tree: Any = import_module("kitti360_tree")
    if root.exists():
        return root
    world = tree.build_world("street")
    mapped, first, second = (100, 102, 104, 106), (31, 32, 33, 34), (51, 52, 53, 54)
    poses = {
        5: tree.drive_poses(world, mapped, 0.0, 30.0, (0.3, -0.2)),
        4: tree.drive_poses(world, first, 0.6, 31.0, (-0.2, 0.4)),
        6: tree.drive_poses(world, second, -0.5, 31.5, (0.3, 0.3)),
    }
    made = tree.Tree(root, poses)
    tree.write_calibration(root)
    tree.write_drive(made, 5, mapped, scans=range(mapped[0], mapped[-1] + 1))
    tree.write_drive(made, 4, first, {"conditions": Conditions(light="overcast"), "seed": 1})
    tree.write_drive(made, 6, second, {"conditions": Conditions(light="night"), "seed": 2})
    return root


def newer_college(root: Path, results: Path) -> Path:
    """Walks of quad and math; hard ones sway more. The base of the ground truth stands in the scene files."""
    tree: Any = import_module("newer_college_tree")
    if not root.exists():
        rng = np.random.default_rng(3)
        tree.write_calibration(root / "calibration/camchain.yaml")
        for name, start_m in (("quad-medium", 4.0), ("math-easy", 9.0)):
            walk = replace(tree.REFERENCE_WALK, start_m=start_m)
            times = [walk.start_ns + round(t * tree.NS) for t in np.arange(4.0, 12.0, 1.03)]
            pictures = tree.write_images(root / name / "cam0", walk, times)
            tree.write_ground_truth(root / f"gt-nc-{name}.csv", walk, tree.between(walk, 2, 14, 10))
            tree.write_model(root / name / "colmap", walk, pictures)
        queries = (
            ("quad-easy", 4.5, 4.0, 4, {}),
            ("quad-hard", 4.6, 12.0, 4, {"conditions": Conditions(light="overcast")}),
            ("math-medium", 9.4, 8.0, 16, {"conditions": Conditions(light="overcast")}),
            ("math-hard", 9.6, 20.0, 4, {"conditions": Conditions(light="night")}),
        )
        for number, (name, start_m, sway_deg, count, conditions) in enumerate(queries):
            walk = replace(tree.QUERY_WALK, start_m=start_m, sway_deg=sway_deg)
            # Every tenth image is a query: the others are not read, so that empty files do.
            times = [walk.start_ns + round(t * tree.NS) for t in np.linspace(4.2, 10.5, count)]
            tree.write_images(root / name / "cam0", walk, times, seed=number + 1, **conditions)
            tree.write_ground_truth(root / f"gt-nc-{name}.csv", walk, tree.between(walk, 2, 14, 10))
            tree.write_imu(root / name / "imu.csv", walk, tree.between(walk, 0, 13, 200), rng)
    dataset = next(item for item in DATASETS if item.key == "newer-college")
    for session in sessions_of(dataset, root):
        scene = results / f"newer-college_{session.name}" / "scene.toml"
        if not scene.exists():
            scene.parent.mkdir(parents=True, exist_ok=True)
            text = session.scene.replace("query_step = 10", "query_step = 1")
            scene.write_text(f"{text}cam_from_base = {tree.CAM_FROM_BASE[:3].tolist()}\n")
    return root


def matterport360(root: Path) -> Path:
    """One building, a sixth of whose panoramas are queries."""
    tree: Any = import_module("matterport360_tree")
    if not root.exists():
        tree.write_building(root / "apartment", 12)
    return root


def tracking(folder: Path) -> str:
    """Sec. VI-C: one estimator initialises, another one tracks along math-medium."""
    scene = folder / "results" / "newer-college_math-medium" / "scene.toml"
    solvings = [
        Solving(estimator, settings, folder / "tracking" / f"{number}", None, first)
        for number, (estimator, settings, first) in enumerate(TRACKING.values())
    ]
    results = localized(scene, solvings, 0, (), False).results
    lines = [
        TRACKS,
        "| system | localized | initialised | success (0.25 m 2° / 0.5 m 5° / 1 m 8°) | estimating, all (ms) |",
    ]
    lines.append("|---|---|---|---|---|")
    for name, found in zip(TRACKING, results, strict=True):
        told = summarize(found)
        first = sum(any(remark.startswith("Initialised") for remark in row.remarks) for row in found.rows)
        rates = " / ".join("–" if rate.rate is None else f"{100 * rate.rate:.1f}" for rate in told.success)
        spent = sum(row.estimating_ms or 0.0 for row in found.rows)
        initialised = str(first) if TRACKING[name][2] else "–"
        lines.append(f"| {name} | {told.localized} of {told.done} | {initialised} | {rates} | {spent:.0f} |")
    return "\n".join(lines) + "\n"


HEAD = """\
# Applications

The paper's datasets are not bundled. Here is what the same commands make of small **rendered copies** in their exact
layouts (streets and an apartment that never existed, with exact truth): they show that one command fills every table
and picture by all methods at all thresholds. They say nothing about the paper's numbers. `python -m
scripts.rendered_verification` writes this page; on your copies of the datasets it is

```sh
spherloc verify --kitti360 KITTI-360 --newer-college NewerCollege --matterport360 Matterport360
```
"""
TABLES = """\
## Tables II to V on rendered copies

Iterations are those of the paper; R+* are rectified to 120° and sampled by EPnP, the rows below them have wide views
and P3P samples (see [Baselines](baselines.md)). EPro-PnP is its solver with equal weights: the learned ones are
missing. Times are of one process beside other work.
"""
TRACKS = """\
## MC initialises, 2P tracks (Sec. VI-C)

`spherloc localize SCENE --initialise mc --estimator ransac-2p` solves the first query by the one and all others by
the other; a query that is not localized, and the one after it, go to the initialiser again. Session math-medium of
the rendered copy:
"""
VEHICLE = """\
## From the camera to the vehicle (Sec. III)

KITTI-360 has the place of each camera at the IMU/GPS (`calib_cam_to_pose.txt`), Newer College that of each camera at
the IMU (`camchain.yaml`) or at the base of its ground truth (`cam_from_base`): `spherloc localize` and `spherloc
verify` write `vehicle.tum` beside the camera's `trajectory.tum` for them. Matterport360's tripod is no vehicle; its
camera is what is localized.
"""

if __name__ == "__main__":
    main()
