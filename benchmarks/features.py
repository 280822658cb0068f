"""Right matches between real fisheyes of a pair of glasses, by kind of features.

    .venv/bin/python -m benchmarks.features [--data ../shared/data/aria_adt_fisheye] [--method sift --method aliked]

The last image of each camera is matched with the first two of each; a match is right if its point, by the reference's
depth, is within 3 px of where the true pose puts it. ALIKED, also that beside SIFT in sift+aliked, is matched by
LightGlue, the others by nearest neighbours.
"""

import argparse
import json
import time
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from spherloc.cameras.fisheye624 import Fisheye624
from spherloc.datasets.image_folder import read_depth
from spherloc.frontend.features import FeatureOptions, extract
from spherloc.frontend.lifting import DepthLift
from spherloc.frontend.matching import MatchOptions, match
from spherloc.frontend.view import View
from spherloc.geometry import transform

CAMERAS = ("camera-rgb", "camera-slam-left", "camera-slam-right")
DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "aria_adt_fisheye"
RIGHT_PX = 3.0


def views(folder: Path, name: str) -> list[View]:
    """The three images of a camera with their poses, and with points where there is depth."""
    lens = json.loads((folder / "calibration_fisheye624.json").read_text())[name]
    focal, cx, cy, *distortion = lens["params"]
    width, height = lens["size"]
    # The file has the centre of the first pixel at (0, 0).
    camera = Fisheye624(width, height, focal, focal, cx + 0.5, cy + 0.5, tuple(distortion))
    rows = np.loadtxt(folder / "poses_world_device_tum.txt", dtype=np.longdouble)
    found = []
    for path in sorted((folder / "images").glob(f"{name}_*.png")):
        taken_ns = int(path.stem.rpartition("_")[2])
        row = rows[np.abs(rows[:, 0].astype(np.int64) - taken_ns).argmin()].astype(float)
        world_device = np.eye(4)
        world_device[:3, :3], world_device[:3, 3] = Rotation.from_quat(row[4:]).as_matrix(), row[1:4]
        pose = np.linalg.inv(world_device @ np.array(lens["T_device_camera"]))[:3]
        depths = sorted((folder / "depth").glob(f"{name}_*.png"))
        nearest = min(depths, key=lambda file: abs(int(file.stem.rpartition("_")[2]) - taken_ns))
        lift = DepthLift(partial(read_depth, nearest, 0.001), camera, pose, "z")
        found.append(View(path.name, camera, path, pose, lift=lift))
    return found


def main() -> None:
    """Print a row for each pair of cameras and kind of features."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--method", action="append")
    arguments = parser.parse_args()
    images = {name: views(arguments.data, name) for name in CAMERAS}
    print("| features | query | references | matches with a point | right | median px | s a pair |")
    print("|---|---|---|---|---|---|---|")
    for method in arguments.method or ["sift", "orb"]:
        matching = MatchOptions("lightglue" if "aliked" in method else "nearest")
        for query_name in CAMERAS:
            for reference_name in CAMERAS:
                errors, seconds = [], 0.0
                query = images[query_name][2]
                for reference in images[reference_name][:2]:
                    first, second = (extract(view, FeatureOptions(method)) for view in (query, reference))
                    start = time.perf_counter()
                    found = match(first, second, matching)
                    seconds += time.perf_counter() - start
                    assert reference.lift is not None and query.cam_from_map is not None
                    points, lifted = reference.lift(second.pixels[found.reference_index])
                    seen, _ = query.camera.project(transform(query.cam_from_map, points[lifted]))
                    errors.append(np.linalg.norm(seen - first.pixels[found.query_index[lifted]], axis=1))
                every = np.concatenate(errors)
                right = every[every < RIGHT_PX]
                short = [name.removeprefix("camera-") for name in (query_name, reference_name)]
                print(
                    f"| {method} | {short[0]} | 2 of {short[1]} | {len(every):,} | {len(right):,} | "
                    f"{np.median(right):.2f} | {seconds / 2:.1f} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
