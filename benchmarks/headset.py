"""Rendered images of a headset with four fisheyes, mapped and localized by one command: a Markdown table.

    .venv/bin/python -m benchmarks.headset [apartment:8:-13 street:2:13 ...] [--data FOLDER]   # a minute or more each

Lenses, and how the cameras are fixed to each other, are those of the real headset whose problems lie in ``--data``. A
world, its seed, and the angle in degrees by which the head turns from one time to the next are one row: at nine times,
0.1 s and 5.5 cm apart, the four cameras take an image each. ``spherloc map`` gets those of six times, a calibration
and, as new images, those of the three times in the middle. Positions and rotations are compared with the truth after
the similarity that fits the images of the map best. Needs the extra ``colmap``.
"""

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from spherloc.cameras.fisheye624 import Fisheye624
from spherloc.datasets.map_scene import MapScene
from spherloc.datasets.scene_file import load_scene
from spherloc.experiments.results import LOCALIZED, read_results
from spherloc.geometry import camera_centre, rotation_angle
from spherloc.types import FloatArray
from spherloc.worlds import Conditions, build_world, render

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "aria_gen2"
ROWS = (
    *("apartment:8:-13", "apartment:3:13", "apartment:11:35", "street:2:13", "street:7:-20"),
    *("campus:4:13", "campus:9:-13", "campus:13:13"),
)
TIMES, NEW = 9, (3, 4, 5)
STEP_NS, EXPOSED_APART_NS, START_NS = 100_000_000, 700_001, 7_385_024_932_864
MOVE_M = (0.033, 0.003, 0.044)
"""What the headset moves from one time to the next: to the right, down and ahead."""
CONDITIONS = Conditions(noise=3.0, motion_blur_px=1.5)
PLACES = 40


def headset(data: Path) -> dict[str, tuple[Fisheye624, FloatArray]]:
    """Lens and ``body_from_camera`` (4, 4) of each camera, by its name; the body is level and looks ahead."""
    lenses, cam_from_map = {}, {}
    for path in sorted(data.glob("*.toml")):
        name = path.stem.rpartition("_")[0]
        if name not in lenses:
            problem = load_scene(path).problem(0)
            assert isinstance(problem.camera, Fisheye624) and problem.truth_cam_from_map is not None
            lenses[name] = problem.camera
            cam_from_map[name] = np.vstack([problem.truth_cam_from_map, [0.0, 0.0, 0.0, 1.0]])
    ahead = np.sum([pose[2, :3] for name, pose in cam_from_map.items() if "front" in name], axis=0)
    ahead[2] = 0.0  # z of the map is up
    ahead /= np.linalg.norm(ahead)
    down = np.array([0.0, 0.0, -1.0])
    body_from_map = np.eye(4)
    body_from_map[:3, :3] = [np.cross(down, ahead), down, ahead]
    body_from_map[:3, 3] = -body_from_map[:3, :3] @ camera_centre(next(iter(cam_from_map.values())))
    return {name: (lens, body_from_map @ np.linalg.inv(cam_from_map[name])) for name, lens in lenses.items()}


def photographed(world: str, seed: int, turn_deg: float, folder: Path, data: Path) -> dict[str, FloatArray]:
    """Write the images to map, the new ones and the calibration into a folder; returns true poses (3, 4) by name."""
    cameras, made, poses = headset(data), build_world(world, seed), {}
    start = np.eye(4)
    start[:3] = made.route(PLACES, start=0.05, stop=0.95)[seed % PLACES]
    for kind in ("map", "new"):
        (folder / kind).mkdir()
    for k in range(TIMES):
        moved = np.eye(4)
        angles = [turn_deg * k, 3.0 * np.sin(0.5 * k), 2.0 * np.sin(0.8 * k + 1.0)]
        moved[:3, :3] = Rotation.from_euler("yxz", angles, degrees=True).as_matrix()
        moved[:3, 3] = k * np.array(MOVE_M)
        for number, (camera, (lens, body_from_camera)) in enumerate(cameras.items()):
            name = f"{camera}_{START_NS + k * STEP_NS + number * EXPOSED_APART_NS}.png"
            poses[name] = (np.linalg.inv(moved @ body_from_camera) @ start)[:3]
            image = render(made, lens, poses[name], CONDITIONS, k, name).image
            grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
            cv2.imwrite(str(folder / ("new" if k in NEW else "map") / name), grey)
    (folder / "calibration.json").write_text(json.dumps({name: as_json(*one) for name, one in cameras.items()}))
    return poses


def as_json(lens: Fisheye624, body_from_camera: FloatArray) -> dict[str, object]:
    """A camera as Project Aria's tools write it, with the centre of the first pixel at (0, 0)."""
    parameters = [lens.fx, lens.cx - 0.5, lens.cy - 0.5, *lens.distortion]
    size, transform = [lens.width, lens.height], body_from_camera.tolist()
    return {"model": "FISHEYE624", "params": parameters, "size": size, "T_device_camera": transform}


def localized(results: Path) -> dict[str, FloatArray]:
    """Poses (3, 4) of the new images that are localized, by name."""
    rows = read_results(results).rows
    return {row.query: row.cam_from_map for row in rows if row.status == LOCALIZED and row.cam_from_map is not None}


def aligned(mapped: Mapping[str, FloatArray], poses: Mapping[str, FloatArray]) -> tuple[float, FloatArray, FloatArray]:
    """Scale, rotation (3, 3) and translation (3,) from the map to the world: by all orientations, as positions that lie
    close together fix no rotation, and then by all positions."""
    turns = Rotation.from_matrix([poses[name][:, :3].T @ pose[:, :3] for name, pose in mapped.items()])
    rotation = turns.mean().as_matrix()
    found = np.array([camera_centre(pose) for pose in mapped.values()]) @ rotation.T
    true = np.array([camera_centre(poses[name]) for name in mapped])
    spread = found - found.mean(axis=0)
    scale = float(np.sum(spread * (true - true.mean(axis=0))) / np.sum(spread**2))
    return scale, rotation, true.mean(axis=0) - scale * found.mean(axis=0)


def cells(folder: Path, poses: Mapping[str, FloatArray], calibration: str = "calibration.json") -> str:
    """A row of the table: what the command makes of the images in ``folder``, in ``map`` and ``new``, with a
    ``calibration`` there."""
    words = [Path(sys.executable).with_name("spherloc"), "map", "map", "--camera", calibration]
    begin = time.perf_counter()
    done = subprocess.run([*words, "--localize", "new"], cwd=folder, capture_output=True, text=True)
    seconds = time.perf_counter() - begin
    if not (folder / "map_map" / "scene.toml").exists():
        return f"{done.stderr.strip().splitlines()[-1]} | | | | | | | {seconds:.0f}"
    scene = load_scene(folder / "map_map" / "scene.toml")
    assert isinstance(scene, MapScene)
    mapped = {
        view.name: view.cam_from_map for view in (*scene.references, *scene.queries) if view.cam_from_map is not None
    }
    scale, rotation, shift = aligned(mapped, poses)
    scale_line = next(line for line in done.stdout.splitlines() if line.startswith("scale"))
    found = localized(next((folder / "recordings").glob("*/"))) if (folder / "recordings").exists() else {}

    def off(these: Mapping[str, FloatArray]) -> str:
        if not these:
            return " | "
        centres = scale * np.array([camera_centre(pose) for pose in these.values()]) @ rotation.T + shift
        off_m = np.linalg.norm(centres - [camera_centre(poses[name]) for name in these], axis=1)
        turned = [rotation_angle(pose[:, :3] @ rotation.T @ poses[name][:, :3].T) for name, pose in these.items()]
        return f"{100 * np.median(off_m):.1f} ({100 * off_m.max():.1f}) | {np.degrees(np.median(turned)):.2f}"

    images = len(mapped), len(found)
    asked = [len(list((folder / kind).iterdir())) for kind in ("map", "new")]
    in_map, new = (f"{have} of {count}" for have, count in zip(images, asked, strict=True))
    known = "units unknown"
    if scene.metric:
        said = scale_line.rpartition("good to ")
        known = f"{100 * (1.0 / scale - 1.0):+.1f}" + (f" ({said[2]})" if said[1] else "")
    return f"{in_map} | {off(mapped)} | {known} | {new} | {off(found)} | {seconds:.0f}"


def print_head() -> None:
    """The head of the table."""
    off = "cm off: median (most) | ° off"
    print(f"| | in the map | {off} | scale, % off (said) | new images localized | {off} | s |")
    print("|---|---|---|---|---|---|---|---|---|")


def main() -> int:
    """Print the table."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("rows", nargs="*", default=ROWS, metavar="WORLD:SEED:DEGREES")
    words.add_argument("--data", type=Path, default=DATA)
    given = words.parse_args()
    if not given.data.is_dir():
        print(f"Left out: there is no folder {given.data}.")
        return 0
    print_head()
    for row in given.rows:
        world, seed, turn_deg = row.split(":")
        with TemporaryDirectory() as place:
            poses = photographed(world, int(seed), float(turn_deg), Path(place), given.data)
            print(f"| {row} | {cells(Path(place), poses)} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
