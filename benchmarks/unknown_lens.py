"""Fisheyes mapped with their true calibration and without any: a Markdown table of how far lens and map are off.

    .venv/bin/python -m benchmarks.unknown_lens          # two to three minutes; needs the extra ``colmap``

Each row is a rendered walk with a known lens. "lens off": the largest difference between the angles to the optical axis
that the found and the true lens give to pixels within 80 % of the image's half diagonal. A map is compared with the
truth as by ``benchmarks.maps``; a row says "refused" where the photographs do not tell their lens.
"""

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from benchmarks.maps import FEW, errors_m
from spherloc.cameras.base import Camera
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.datasets.scene_file import load_scene
from spherloc.errors import InputError
from spherloc.geometry import camera_centre
from spherloc.mapping.make import ScaleMeasurement, make_map
from spherloc.mapping.photographs import photographs
from spherloc.mapping.scene_files import toml_value
from spherloc.mapping.unknown_lens import find_lens
from spherloc.types import FloatArray

SCENE = """
kind = "rendered"
name = "{world}"
provenance = "spherloc"
world = "{world}"
[camera]
{camera}
[references]
count = {count}
[queries]
count = {turned}
start = 0.05
stop = 0.95
heading_deg = {heading}
tilt_deg = 3.0
offset_m = 0.3
"""
REACH = 0.8
RADII = 20


@dataclass(frozen=True)
class Walk:
    """Images along a path, and as many of them turned to the left as said."""

    name: str
    world: str
    camera: KannalaBrandt
    count: int
    turned: int = 0
    heading_deg: float = 0.0


EQUIDISTANT = KannalaBrandt(640, 640, 239.0, 239.0, 319.3, 321.6, (0.003, 0.001, 0.0, 0.0))
EQUISOLID = KannalaBrandt(700, 700, 250.0, 250.0, 344.0, 355.0, (-1 / 24, 1 / 1920, 0.0, 0.0))
ACTION = KannalaBrandt(900, 600, 430.0, 430.0, 455.0, 296.0, (-0.02, 0.003, 0.0, 0.0))
STEREOGRAPHIC = KannalaBrandt(800, 600, 230.0, 230.0, 402.0, 305.0, (1 / 12, 1 / 120, 0.0, 0.0))
WALKS = (
    Walk("flat, equidistant", "apartment", EQUIDISTANT, 20),
    Walk("flat, equisolid", "apartment", EQUISOLID, 16),
    Walk("square, action camera, turned", "campus", ACTION, 8, 8, 35.0),
    Walk("square, stereographic, turned", "campus", STEREOGRAPHIC, 8, 8, -40.0),
    Walk("square, stereographic, straight", "campus", STEREOGRAPHIC, 14),
)


def photographed(walk: Walk, folder: Path) -> dict[str, FloatArray]:
    """Write the images into a folder; returns their true positions (3,), metres, by name."""
    lines = "\n".join(f"{key} = {toml_value(value)}" for key, value in walk.camera.to_dict().items())
    path = folder.with_suffix(".toml")
    words = {"world": walk.world, "camera": lines, "count": walk.count, "heading": walk.heading_deg}
    path.write_text(SCENE.format(**words, turned=max(1, walk.turned)))
    folder.mkdir()
    scene = load_scene(path)
    views = [*scene.references, *(scene.queries if walk.turned else ())]
    places = {}
    for number, view in enumerate(sorted(views, key=lambda view: float(camera_centre(view.cam_from_map)[0]))):
        name = f"{number:03d}.png"
        cv2.imwrite(str(folder / name), view.read())
        places[name] = camera_centre(view.cam_from_map)
    return places


def lens_off_deg(found: Camera, true: KannalaBrandt) -> float:
    """Largest difference of the angles to the optical axis, degrees."""
    radii = np.linspace(0.0, REACH * np.hypot(true.width, true.height) / 2, RADII)
    angles = [
        np.arccos(camera.unproject(np.column_stack([camera.cx + radii, np.full(RADII, camera.cy)]))[0][:, 2])
        for camera in (found, true)
    ]
    return float(np.degrees(np.nanmax(np.abs(angles[0] - angles[1]))))


def mapped(folder: Path, cameras: dict[str, Camera], places: dict[str, FloatArray]) -> tuple[str, Camera | None]:
    """How the maps of a folder are off, in a cell of the table, and the lens that was found."""
    photos = photographs(folder, cameras, find_lens=lambda paths, size: find_lens(paths, size, lambda *_: None))
    with TemporaryDirectory() as place:
        made = make_map(photos.views, folder, Path(place) / "map", ScaleMeasurement(), None, lambda *_: None)
        maps = [one.written.poses for one in (made, *made.groups)]
    off = np.concatenate([errors_m(poses, places) for poses in maps if len(poses) >= FEW])
    sizes = " + ".join(str(len(poses)) for poses in maps)
    return f"{sizes}: {100 * np.median(off):.1f} cm", photos.calibrated.get("")


def row(walk: Walk) -> str:
    """One line of the table."""
    with TemporaryDirectory() as place:
        folder = Path(place) / "images"
        places = photographed(walk, folder)
        known, _ = mapped(folder, {"": walk.camera}, places)
        try:
            without, lens = mapped(folder, {}, places)
        except InputError as error:
            print(error)
            return f"| {walk.name} | refused | {known} | |"
    off = "" if lens is None else f"{lens_off_deg(lens, walk.camera):.1f}°"
    return f"| {walk.name} | {off} | {known} | {without} |"


def main() -> None:
    """Print the table."""
    print("| walk | lens off | map with the true lens, median error | without a calibration |\n|---|---|---|---|")
    for walk in WALKS:
        print(row(walk), flush=True)


if __name__ == "__main__":
    main()
