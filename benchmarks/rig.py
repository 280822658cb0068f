"""Maps of two rendered fisheyes of a car that look to the left and to the right: a Markdown table of their errors.

    .venv/bin/python -m benchmarks.rig [campus:0 campus:7 ...]     # two minutes each

A world and its seed are one row. The fisheyes (140 degrees apart, 150 degrees wide) are cut from panoramas along the
world's path, and mapped by ``spherloc map`` twice: with names that do not tell which of them were taken together, and
with names that do. Errors are distances to the truth after the similarity that most images agree with, of the largest
map. Needs the extra ``colmap``.
"""

import argparse
import json
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from benchmarks.maps import errors_m
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.datasets.scene_file import load_scene
from spherloc.errors import InputError
from spherloc.geometry import camera_centre, yaw_rotation
from spherloc.mapping.images.photographs import photographs
from spherloc.mapping.make import make_map
from spherloc.mapping.request import MapRequest
from spherloc.types import ByteArray, FloatArray

WORLDS = ("campus:0", "campus:7", "campus:11", "apartment:5")
TIMES, FAR_M = 14, 3.0
LOOKS_DEG = {"left": -70.0, "right": 70.0}
FISHEYE = KannalaBrandt(560, 560, 205.0, 205.0, 280.0, 280.0, (0.01, -0.002, 0.0, 0.0))
SCENE = """
kind = "rendered"
name = "{world}"
provenance = "spherloc"
world = "{world}"
seed = {seed}
[camera]
model = "equirectangular"
width = 1536
height = 768
[references]
count = {count}
[queries]
count = 1
start = 0.5
stop = 0.6
tilt_deg = 1.0
"""


def cut(panorama: ByteArray, yaw_deg: float) -> ByteArray:
    """The fisheye of a panorama (H, W, 3) in that direction."""
    columns, rows = np.meshgrid(np.arange(FISHEYE.width) + 0.5, np.arange(FISHEYE.height) + 0.5)
    bearings, seen = FISHEYE.unproject(np.column_stack([columns.ravel(), rows.ravel()]))
    camera = Equirectangular(panorama.shape[1], panorama.shape[0])
    pixels, _ = camera.project(bearings @ yaw_rotation(np.radians(yaw_deg)).T)
    at = np.where(seen[:, None], pixels - 0.5, -1.0).astype(np.float32).reshape(FISHEYE.height, FISHEYE.width, 2)
    return cv2.remap(panorama, at, None, cv2.INTER_LINEAR)  # pyright: ignore[reportCallIssue, reportArgumentType]


def photographed(world: str, seed: int, folder: Path, times: int = TIMES) -> dict[str, FloatArray]:
    """Write the fisheyes of so many times into two folders in a folder; returns their true poses (3, 4) by name."""
    path = folder.with_suffix(".toml")
    path.write_text(SCENE.format(world=world, seed=seed, count=times))
    poses = {}
    for camera in LOOKS_DEG:
        (folder / camera).mkdir(parents=True)
        said = "\n".join(f"{key} = {json.dumps(value)}" for key, value in FISHEYE.to_dict().items())
        (folder / camera / "camera.toml").write_text(f"[camera]\n{said}\n")
    for time, view in enumerate(load_scene(path).references):
        panorama = view.read()
        for camera, yaw_deg in LOOKS_DEG.items():
            name = f"{camera}/{time:03d}.png"
            cv2.imwrite(str(folder / name), cut(panorama, yaw_deg))
            poses[name] = yaw_rotation(np.radians(yaw_deg)).T @ view.cam_from_map
    return poses


def renamed(folder: Path, places: dict[str, FloatArray]) -> dict[str, FloatArray]:
    """The same images in names without numbers, in the same order."""
    found = {}
    for name, place in places.items():
        path = Path(name)
        word = f"{path.parent}/{chr(ord('a') + int(path.stem))}.png"
        (folder / name).rename(folder / word)
        found[word] = place
    return found


def cells(folder: Path, output: Path, places: dict[str, FloatArray]) -> str:
    """Some cells of the table: images in the map, their median error, how many are far off, and the largest error."""
    try:
        made = make_map(MapRequest(photographs(folder, {}).views, folder), output)
    except InputError as error:
        return f"none: {error} | | |"
    off = errors_m(made.written.poses, places)
    return f"{len(off)} of {len(places)} | {np.median(off):.2f} | {np.count_nonzero(off > FAR_M)} | {off.max():.1f} |"


def main() -> None:
    """Print the table."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("worlds", nargs="*", default=WORLDS, metavar="WORLD:SEED")
    given = words.parse_args()
    errors = f"median, m | > {FAR_M:g} m | most, m |"
    print(f"| | images alone | {errors} taken together | {errors}")
    print("|---|---|---|---|---|---|---|---|---|")
    for one in given.worlds:
        world, _, seed = one.partition(":")
        with TemporaryDirectory() as place:
            folder = Path(place) / "images"
            poses = photographed(world, int(seed), folder)
            places = {name: camera_centre(pose) for name, pose in poses.items()}
            together = cells(folder, Path(place) / "together", places)
            alone = cells(folder, Path(place) / "alone", renamed(folder, places))
        print(f"| {one} | {alone} {together}", flush=True)


if __name__ == "__main__":
    main()
