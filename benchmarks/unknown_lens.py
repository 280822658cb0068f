"""Fisheyes mapped with their true calibration and without any: a Markdown table of how far lens and map are off.

    .venv/bin/python -m benchmarks.unknown_lens                  # two to three minutes; needs the extra ``colmap``
    .venv/bin/python -m benchmarks.unknown_lens --panoramas FOLDER    # fisheyes that are cut out of your panoramas

Each row is a rendered walk with a known lens. "lens off": the largest difference between the angles to the optical axis
that the found and the true lens give to pixels within 80 % of the image's half diagonal, or of its circle. A map is
compared with the truth as by ``benchmarks.maps``; a row says "refused" where the photographs do not tell their lens.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.maps import FEW, errors_m
from spherloc.cameras.base import Camera
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.datasets.scene_file import load_scene
from spherloc.errors import InputError
from spherloc.files import is_image, names_in
from spherloc.geometry import camera_centre
from spherloc.images import read_image
from spherloc.mapping.images.folder_cameras import CalibratedLens
from spherloc.mapping.images.photographs import photographs
from spherloc.mapping.images.unknown_lens import find_lens
from spherloc.mapping.make import make_map
from spherloc.mapping.request import MapRequest
from spherloc.mapping.scenes.scene_files import toml_value
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
CUT = KannalaBrandt(1000, 1000, 312.6, 312.6, 505.0, 492.0, (-1 / 24, 1 / 1920, 0.0, 0.0))
"""The lens of fisheyes cut out of panoramas: equisolid, 195 degrees across a circle of ``CUT_RADIUS_PX``."""
CUT_RADIUS_PX = 470.0
CUT_HEADINGS_DEG = ((0.0, 50.0), (-25.0, 30.0), (10.0, -40.0), (35.0, -10.0), (-15.0, 60.0))
"""Two directions of view in each panorama, over and over."""
TILT_SD_DEG = 3.0


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
    Walk("square, equidistant, straight", "campus", EQUIDISTANT, 20),
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


def cut(panoramas: Path, folder: Path) -> None:
    """Write fisheyes that are cut out of the panoramas of a folder."""
    rng = np.random.default_rng(0)
    columns, rows = np.meshgrid(np.arange(CUT.width) + 0.5, np.arange(CUT.height) + 0.5)
    bearings, _ = CUT.unproject(np.column_stack([columns.ravel(), rows.ravel()]))
    dark = np.hypot(columns - CUT.cx, rows - CUT.cy) > CUT_RADIUS_PX
    folder.mkdir()
    for number, name in enumerate(name for name in names_in(panoramas) if is_image(name)):
        image = read_image(panoramas / name)
        sphere = Equirectangular(image.shape[1], image.shape[0])
        for heading_deg in CUT_HEADINGS_DEG[number % len(CUT_HEADINGS_DEG)]:
            angles = [heading_deg, *rng.normal(0.0, TILT_SD_DEG, 2)]
            turn = Rotation.from_euler("yxz", angles, degrees=True).as_matrix()
            places = (sphere.project(np.nan_to_num(bearings) @ turn.T)[0] - 0.5).astype(np.float32)
            u, v = places.T.reshape(2, CUT.height, CUT.width)
            seen = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
            seen[dark] = 0
            cv2.imwrite(str(folder / f"{number:03d}_{heading_deg:+.0f}.png"), seen)


def of_panoramas(panoramas: Path) -> str:
    """How well the lens of fisheyes is found that are cut out of panoramas."""
    with TemporaryDirectory() as place:
        folder = Path(place) / "images"
        cut(panoramas, folder)
        try:
            found = photographs(folder, {}, find_lens=_find)
        except InputError as error:
            return str(error)
    lens = found.calibrated[""].camera
    off_deg = lens_off_deg(lens, CUT, CUT_RADIUS_PX)
    focal = f"{lens.to_dict()['fx']:.1f} pixels per radian, in truth {CUT.fx}"
    return f"{found.remarks[0]}\nThe lens is {off_deg:.2f}° off at most: {focal}."


def _find(paths: Sequence[Path], size: tuple[int, int]) -> CalibratedLens:
    return find_lens(paths, size, lambda *_: None)


def lens_off_deg(found: Camera, true: KannalaBrandt, radius_px: float) -> float:
    """Largest difference of the angles to the optical axis, degrees."""
    radii = np.linspace(0.0, REACH * radius_px, RADII)
    angles = [
        np.arccos(camera.unproject(np.column_stack([camera.cx + radii, np.full(RADII, camera.cy)]))[0][:, 2])
        for camera in (found, true)
    ]
    return float(np.degrees(np.nanmax(np.abs(angles[0] - angles[1]))))


def mapped(folder: Path, cameras: dict[str, Camera], places: dict[str, FloatArray]) -> tuple[str, Camera | None]:
    """How the maps of a folder are off, in a cell of the table, and the lens that was found."""
    photos = photographs(folder, cameras, find_lens=_find)
    with TemporaryDirectory() as place:
        made = make_map(MapRequest(photos.views, folder, lens=photos.calibrated.get("")), Path(place) / "map")
        maps = [one.written.poses for one in (made, *made.groups)]
    off = np.concatenate([errors_m(poses, places) for poses in maps if len(poses) >= FEW])
    sizes = " + ".join(str(len(poses)) for poses in maps)
    doubt = ", in doubt" if made.doubts else ""
    return f"{sizes}: {100 * np.median(off):.1f} cm{doubt}", None if made.lens is None else made.lens.camera


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
    half_diagonal_px = float(np.hypot(walk.camera.width, walk.camera.height)) / 2
    off = "" if lens is None else f"{lens_off_deg(lens, walk.camera, half_diagonal_px):.1f}°"
    return f"| {walk.name} | {off} | {known} | {without} |"


def main() -> None:
    """Print the table."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("--panoramas", type=Path, metavar="FOLDER")
    given = words.parse_args()
    if given.panoramas is not None:
        print(of_panoramas(given.panoramas))
        return
    print("| walk | lens off | map with the true lens, median error | without a calibration |\n|---|---|---|---|")
    for walk in WALKS:
        print(row(walk), flush=True)


if __name__ == "__main__":
    main()
