"""Rendered images of a car with four fisheyes, mapped and localized by one command: a Markdown table.

    .venv/bin/python -m benchmarks.car [street:2 campus:0:moment ...]   # a minute or two each

The cameras look ahead, to both sides and back, 20 degrees down, and their calibrations are written as WoodScape's are,
each camera turned by a tenth of a degree and moved by half a centimetre against what is rendered (standard deviations
of each axis). The car goes 60 cm and turns by 4 degrees from one time to the next. ``spherloc map`` gets the images of
six times and, as new images, those of the three times in the middle; in rows that end in ``moment``, the images of one
time and those of the next. Positions and rotations are compared with the truth after the similarity that fits the
images of the map best. Needs the extra ``colmap``.
"""

import argparse
import json
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.headset import cells, print_head
from spherloc.cameras.radial_poly import RadialPoly
from spherloc.geometry import camera_centre, inverse_pose
from spherloc.types import FloatArray
from spherloc.worlds import Conditions, build_world, render

WORLDS = ("street:2", "street:5", "campus:0", "campus:4")
ROWS = tuple(f"{world}{times}" for world in WORLDS for times in ("", ":moment"))
WIDTH, HEIGHT, CURVE = 640, 484, (170.0, -16.0, 24.0, -3.6)
"""Size, and pixels from the principal point by powers of the angle."""
CAMERAS = {
    "FV": (0.0, (3.7, 0.0, 0.7)),
    "MVL": (90.0, (2.0, 0.95, 0.95)),
    "MVR": (-90.0, (2.0, -0.95, 0.95)),
    "RV": (180.0, (-0.5, 0.0, 0.9)),
}
"""By name, the angle to the left at which a camera looks, degrees, and where it is: ahead, to the left and up, m."""
DOWN_DEG, STEP_M, TURN_DEG = 20.0, 0.6, 4.0
CALIBRATION_OFF_RAD, CALIBRATION_OFF_M = float(np.radians(0.1)), 0.005
TIMES, NEW = 9, (3, 4, 5)
PLACES = 60
ROUTE_HEIGHT_M = 0.9
"""How much higher the routes of rendered worlds are than the ground below the car's middle is assumed to be."""


def car_from_camera(name: str) -> FloatArray:
    """Pose (4, 4) of a camera in the frame of the car: x ahead, y to the left, z up."""
    left_deg, place = CAMERAS[name]
    level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    found = np.eye(4)
    found[:3, :3] = (
        Rotation.from_euler("z", left_deg, degrees=True).as_matrix()
        @ level
        @ Rotation.from_euler("x", -DOWN_DEG, degrees=True).as_matrix()
    )
    found[:3, 3] = place
    return found


def as_woodscape(name: str, rng: np.random.Generator) -> dict[str, object]:
    """The calibration of a camera as WoodScape has it, a little off."""
    pose = car_from_camera(name)
    turn = Rotation.from_rotvec(CALIBRATION_OFF_RAD * rng.normal(size=3)) * Rotation.from_matrix(pose[:3, :3])
    place = pose[:3, 3] + CALIBRATION_OFF_M * rng.normal(size=3)
    powers = {f"k{power}": value for power, value in enumerate(CURVE, start=1)}
    centre = {"cx_offset": 0.0, "cy_offset": 0.0, "aspect_ratio": 1.0, "width": WIDTH, "height": HEIGHT}
    return {
        "extrinsic": {"quaternion": turn.as_quat().tolist(), "translation": place.tolist()},
        "intrinsic": {"model": "radial_poly", "poly_order": len(CURVE), **powers, **centre},
        "name": name,
    }


def photographed(world: str, seed: int, moment: bool, folder: Path) -> dict[str, FloatArray]:
    """Write the images to map, the new ones and the calibrations into a folder; returns true poses (3, 4) by name."""
    made, rng = build_world(world, seed), np.random.default_rng(seed)
    lens = RadialPoly(
        WIDTH, HEIGHT, CURVE[0], CURVE[0], WIDTH / 2, HEIGHT / 2, (*(value / CURVE[0] for value in CURVE[1:]),)
    )
    start = made.route(PLACES, start=0.05, stop=0.95)[seed % PLACES]
    ahead = start[2, :3] * [1.0, 1.0, 0.0]
    ahead /= np.linalg.norm(ahead)
    up = np.array([0.0, 0.0, 1.0])
    for kind in ("map", "new", "calibration"):
        (folder / kind).mkdir()
    poses: dict[str, FloatArray] = {}
    for k in range(2 if moment else TIMES):
        way = Rotation.from_rotvec(np.radians(TURN_DEG * k) * up).apply(ahead)
        world_from_car = np.eye(4)
        world_from_car[:3, :3] = np.column_stack([way, np.cross(up, way), up])
        world_from_car[:3, 3] = camera_centre(start) + STEP_M * k * way - ROUTE_HEIGHT_M * up
        new = k == 1 if moment else k in NEW
        for camera in CAMERAS:
            name = f"{k:05d}_{camera}.png"
            poses[name] = inverse_pose((world_from_car @ car_from_camera(camera))[:3])
            image = render(made, lens, poses[name], Conditions(noise=3.0), k, name).image
            cv2.imwrite(str(folder / ("new" if new else "map") / name), image)
    for camera in CAMERAS:
        (folder / "calibration" / f"{camera}.json").write_text(json.dumps(as_woodscape(camera, rng)))
    return poses


def main() -> int:
    """Print the table."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("rows", nargs="*", default=ROWS, metavar="WORLD:SEED[:moment]")
    print_head()
    for row in words.parse_args().rows:
        world, seed, *moment = row.split(":")
        with TemporaryDirectory() as place:
            poses = photographed(world, int(seed), bool(moment), Path(place))
            print(f"| {row} | {cells(Path(place), poses, 'calibration')} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
