"""Whether fisheyes that are stored sideways are told from upright ones: sets of views cut from real panoramas.

    .venv/bin/python -m benchmarks.sideways [--data FOLDER] [--sets 5]

Each set has twelve fisheyes of two places. They look anywhere around, and are tilted and rolled at random, as by a
head. A row counts the sets that the images alone tell, rightly and wrongly, and those that are taken for what they are
in a map, with its rotations.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.frontend.view import View
from spherloc.geometry import so3_exp
from spherloc.images import read_image
from spherloc.mapping.alignment.line_gravity import gravity_by_lines

DATA = Path(__file__).parents[2] / "shared" / "data" / "pano_vertical_pairs"
PANORAMAS = ("room_up.png", "hall_up.png", "room_down.png", "hall_down.png")
CAMERA = KannalaBrandt(640, 480, 240.0, 240.0, 320.0, 240.0, (0.0, 0.0, 0.0, 0.0))
IMAGES = 12
HEADS = ((5.0, 3.0, 0.0), (12.0, 6.0, 0.0), (12.0, 6.0, -20.0), (18.0, 8.0, 0.0))
"""Standard deviations of pitch and roll, and mean pitch, degrees."""


def cut(panorama: Path, cam_from_panorama: np.ndarray, path: Path) -> View:
    """A fisheye of a panorama, written to ``path``; ``cam_from_panorama`` (3, 3) turns it."""
    image = read_image(panorama)
    columns, rows = np.meshgrid(np.arange(CAMERA.width) + 0.5, np.arange(CAMERA.height) + 0.5)
    bearings, seen = CAMERA.unproject(np.column_stack([columns.ravel(), rows.ravel()]))
    there, _ = Equirectangular(image.shape[1], image.shape[0]).project(bearings @ cam_from_panorama)
    u, v = (there.T - 0.5).reshape(2, CAMERA.height, CAMERA.width).astype(np.float32)
    found = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    found[~seen.reshape(CAMERA.height, CAMERA.width)] = 0
    cv2.imwrite(str(path), found)
    return View(path.name, CAMERA, path, np.column_stack([cam_from_panorama, np.zeros(3)]))


def maps_of(views: Sequence[View]) -> tuple[list[dict[str, np.ndarray]], np.ndarray]:
    """A map of views: their poses by name, and a point below them."""
    return [{view.name: np.asarray(view.cam_from_map) for view in views}], np.array([[0.0, 1.0, 0.0]])


def views(folder: Path, data: Path, head: tuple[float, float, float], sideways: bool, seed: int) -> list[View]:
    """A set of fisheyes, written into ``folder``."""
    rng = np.random.default_rng(seed)
    found = []
    for number in range(IMAGES):
        yaw = np.radians(rng.uniform(-180.0, 180.0))
        pitch, roll = np.radians([head[2] + rng.normal(0.0, head[0]), rng.normal(0.0, head[1])])
        turn = so3_exp(np.array([0.0, yaw, 0.0])) @ so3_exp(np.array([pitch, 0.0, 0.0]))
        turn = turn @ so3_exp(np.array([0.0, 0.0, roll + np.pi / 2 * sideways]))
        found.append(cut(data / PANORAMAS[number % len(PANORAMAS)], turn.T, folder / f"{number}.png"))
    return found


def main() -> None:
    """Print the table."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("--data", type=Path, default=DATA)
    words.add_argument("--sets", type=int, default=5)
    given = words.parse_args()
    print("| stored | pitch and roll, sd | mean pitch | rightly | wrongly | in the map |\n|---|---|---|---|---|---|")
    with TemporaryDirectory() as place:
        for sideways in (False, True):
            for head in HEADS:
                sets = (views(Path(place), given.data, head, sideways, seed) for seed in range(given.sets))
                told = [(gravity_by_lines(one, lambda *_: None), one) for one in sets]
                clear = [lines.sideways == sideways for lines, _ in told if not lines.unsure]
                in_map = [lines.in_maps(*maps_of(one)).sideways == sideways for lines, one in told]
                way = "sideways" if sideways else "upright"
                tilts = f"{head[0]:g}°, {head[1]:g}° | {head[2]:g}°"
                counts = f"{sum(clear)} | {len(clear) - sum(clear)} | {sum(in_map)} of {given.sets}"
                print(f"| {way} | {tilts} | {counts} |", flush=True)


if __name__ == "__main__":
    main()
