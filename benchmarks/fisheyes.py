"""Maps of rendered images of one fisheye on a head that walks through a flat and looks about: a Markdown table.

    .venv/bin/python -m benchmarks.fisheyes [apartment:31:rgb ...]    # two minutes each
    .venv/bin/python -m benchmarks.fisheyes --features sift+aliked    # with the extra ``learned``
    .venv/bin/python -m benchmarks.fisheyes --pairs                   # right and wrong pairs by how sure they are

A world, its seed and a lens are one row: ``rgb`` sees 66 degrees from its axis to the edge of the image, ``slam`` 76 by
57. The head turns 45 degrees to either side and nods (standard deviations of 45 and 9 degrees), and the images differ
in exposure, colour, sharpness and noise. Maps are compared with the truth as by ``benchmarks.maps``. Needs the extra
``colmap``.
"""

import json
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.judged_pairs import judged_pairs
from benchmarks.maps import cells, print_tables, uneven
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.geometry import camera_centre, pose
from spherloc.types import FloatArray
from spherloc.worlds import Conditions, build_world, render

SETS = tuple(f"apartment:{seed}:{lens}" for seed in (31, 32, 33) for lens in ("rgb", "slam"))
LENSES = {
    "rgb": KannalaBrandt(704, 704, 305.0, 305.0, 350.0, 354.0, (0.01, -0.004, 0.001, 0.0)),
    "slam": KannalaBrandt(640, 480, 241.0, 241.0, 318.0, 242.0, (0.0, 0.0, 0.0, 0.0)),
}
COUNT = 36
YAW_SD_DEG, PITCH_DEG, PITCH_SD_DEG, ROLL_SD_DEG, ASIDE_SD_M, UP_SD_M = 45.0, 8.0, 9.0, 4.0, 0.15, 0.03
"""Of the head, which is turned down by the second on average."""


def smooth(rng: np.random.Generator, sd: float, reach: int) -> FloatArray:
    """Random numbers (COUNT,) of which ``2 reach + 1`` neighbours are alike."""
    weights = np.hanning(2 * reach + 3)[1:-1]
    numbers = np.convolve(rng.normal(size=COUNT + 2 * reach), weights, "valid")
    return sd * numbers / np.linalg.norm(weights)


def photographed(world: str, seed: int, lens: str, folder: Path) -> dict[str, FloatArray]:
    """Write the fisheyes with their calibration into a folder; returns their true poses (3, 4) by name."""
    place, camera, rng = build_world(world, seed), LENSES[lens], np.random.default_rng([seed, len(lens)])
    turns = np.column_stack(
        [smooth(rng, ROLL_SD_DEG, 2), PITCH_DEG + smooth(rng, PITCH_SD_DEG, 2), smooth(rng, YAW_SD_DEG, 3)]
    )
    moves = np.column_stack([smooth(rng, ASIDE_SD_M, 3), smooth(rng, UP_SD_M, 2), np.zeros(COUNT)])
    folder.mkdir()
    said = "\n".join(f"{key} = {json.dumps(value)}" for key, value in camera.to_dict().items())
    (folder / "camera.toml").write_text(f"[camera]\n{said}\n")
    poses = {}
    for number, level in enumerate(place.route(COUNT, start=0.02, stop=0.98)):
        turn = Rotation.from_euler("ZXY", turns[number], degrees=True).as_matrix()
        name, found = f"{number:03d}.jpg", pose(turn @ level[:, :3], turn @ (level[:, 3] - moves[number]))
        image = render(place, camera, found, Conditions(noise=2.0), number, f"fisheye_{number:03d}").image
        cv2.imwrite(str(folder / name), uneven(image, rng))
        poses[name] = found
    return poses


def row(one: str, features: str) -> str:
    """One line of the table."""
    world, seed, lens = one.split(":")
    with TemporaryDirectory() as place:
        folder = Path(place) / "images"
        poses = photographed(world, int(seed), lens, folder)
        return f"| {one} | {cells(folder, {name: camera_centre(one) for name, one in poses.items()}, features)}"


def pairs_of(one: str, features: str) -> list[tuple[float, bool]]:
    """How sure the pairs of a set are, and which are right."""
    world, seed, lens = one.split(":")
    with TemporaryDirectory() as place:
        folder = Path(place) / "images"
        return judged_pairs(folder, list(photographed(world, int(seed), lens, folder).values()), features)


def main() -> None:
    """Print the table."""
    print_tables(__doc__, "WORLD:SEED:LENS", SETS, row, pairs_of)


if __name__ == "__main__":
    main()
