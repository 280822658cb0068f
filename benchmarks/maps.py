"""Maps of rendered panoramas whose true positions are known: a Markdown table of right and wrong images.

    .venv/bin/python -m benchmarks.maps [apartment:12 campus:20:7:uneven ...]
    .venv/bin/python -m benchmarks.maps --features sift+aliked           # with the extra ``learned``

A world, a number of panoramas, evenly along its path, and the world's seed (0 if none is given) are one row; with
``uneven`` behind it exposure, colour, sharpness and noise differ, as in photographs that one takes in passing, with
``plain`` textures have a third of their contrast, as in rooms with plain walls. Each of
the maps that ``spherloc map`` makes of them is put onto the truth by the similarity that most of its images agree with;
an image that is then more than ``WRONG_M`` off is wrong. Maps of two images are not judged. Needs the extra ``colmap``.
"""

import argparse
from collections.abc import Callable, Mapping
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from spherloc.datasets.scene_file import load_scene
from spherloc.errors import InputError
from spherloc.experiments.summary import align
from spherloc.geometry import camera_centre
from spherloc.mapping.images.photographs import photographs
from spherloc.mapping.make import make_map
from spherloc.mapping.request import MapRequest
from spherloc.types import ByteArray, FloatArray
from spherloc_viz.commands.map import how_of

SETS = (
    *(f"apartment:{count}" for count in (10, 12, 16, 22)),
    *(f"apartment:14:{seed}:uneven" for seed in (21, 22, 23, 24)),
    "apartment:16:101:plain",
    "apartment:16:103:plain",
    "campus:12",
    "campus:20",
)
WRONG_M = 0.25
FEW = 3
"""Images that fix a similarity."""
SCENE = """
kind = "rendered"
name = "{world}"
provenance = "spherloc"
world = "{world}"
seed = {seed}
[camera]
model = "equirectangular"
width = 896
height = 448
[references]
count = {count}
[queries]
count = 1
start = 0.5
stop = 0.6
"""


def uneven(image: ByteArray, rng: np.random.Generator) -> ByteArray:
    """A rendered image (H, W, 3) as a photograph with its own exposure, colour, sharpness and noise."""
    light = np.clip(image / 255.0 * rng.uniform(0.6, 1.5), 0.0, 1.0) ** rng.uniform(0.8, 1.2)
    coloured = np.clip(255.0 * light * rng.uniform(0.92, 1.08, 3), 0.0, 255.0)
    blurred = cv2.GaussianBlur(coloured, (0, 0), rng.uniform(0.4, 1.0))
    noisy = np.clip(blurred + rng.normal(0.0, 2.5, image.shape), 0.0, 255.0).astype(np.uint8)
    _, packed = cv2.imencode(".jpg", noisy, [cv2.IMWRITE_JPEG_QUALITY, 70])
    return np.asarray(cv2.imdecode(packed, cv2.IMREAD_COLOR), np.uint8)


def plain(image: ByteArray, rng: np.random.Generator) -> ByteArray:
    """A rendered image (H, W, 3) with faint textures, an exposure of its own and noise."""
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 15.0)
    faint = np.clip((smooth + 0.35 * (image - smooth)) * rng.uniform(0.7, 1.3), 0.0, 255.0)
    noisy = np.clip(faint + rng.normal(0.0, 1.5, image.shape), 0.0, 255.0).astype(np.uint8)
    _, packed = cv2.imencode(".jpg", noisy, [cv2.IMWRITE_JPEG_QUALITY, 85])
    return np.asarray(cv2.imdecode(packed, cv2.IMREAD_COLOR), np.uint8)


CHANGES: Mapping[str, Callable[[ByteArray, np.random.Generator], ByteArray]] = {"uneven": uneven, "plain": plain}
"""What makes photographs of rendered images."""


def photographed(world: str, count: int, seed: int, change: str, folder: Path) -> dict[str, FloatArray]:
    """Write the panoramas into a folder; returns their true positions (3,), metres, by name."""
    rng = np.random.default_rng(seed)
    path = folder.with_suffix(".toml")
    path.write_text(SCENE.format(world=world, count=count, seed=seed))
    folder.mkdir()
    places = {}
    for view in load_scene(path).references:
        name = f"{view.name}.png"
        cv2.imwrite(str(folder / name), CHANGES[change](view.read(), rng) if change else view.read())
        places[name] = camera_centre(view.cam_from_map)
    return places


def errors_m(poses: dict[str, FloatArray], places: dict[str, FloatArray]) -> FloatArray:
    """Distances (K,) to the truth after the similarity of three images that most images agree with."""
    found = np.array([camera_centre(poses[name]) for name in sorted(poses)])
    true = np.array([places[name] for name in sorted(poses)])
    best = np.full(len(found), np.inf)
    for three in combinations(range(len(found)), FEW):
        chosen = list(three)
        aligned = align(found[chosen], true[chosen], with_scale=True)
        if aligned is None:
            continue
        scale, rotation, offset = aligned
        off = np.linalg.norm(scale * found @ rotation.T + offset - true, axis=1)
        if (np.count_nonzero(off > WRONG_M), off.sum()) < (np.count_nonzero(best > WRONG_M), best.sum()):
            best = off
    return best


def cells(folder: Path, places: dict[str, FloatArray], features: str) -> str:
    """Some cells of a table: the maps of the images in a folder with known positions (3,), how many of these are right
    and wrong in them, and their median error."""
    views = photographs(folder, {}).views
    try:
        made = make_map(MapRequest(views, folder, how=how_of(features)), folder.with_name("map"))
    except InputError as error:
        return f"none: {error} | | | |"
    maps = [one.written.poses for one in (made, *made.groups)]
    off = [errors_m(poses, places) for poses in maps if len(poses) >= FEW]
    pairs = sum(len(poses) < FEW for poses in maps)
    joined = np.concatenate(off) if off else np.empty(0)
    wrong, right = np.count_nonzero(joined > WRONG_M), joined[joined <= WRONG_M]
    sizes = " + ".join(str(len(errors)) for errors in off) + (f" and {pairs} of two" if pairs else "")
    median = f"{100 * np.median(right):.1f}" if len(right) else "-"
    return f"{sizes} | {len(right)} | {wrong} | {median} |"


def row(world: str, count: int, seed: int, change: str, features: str) -> str:
    """One line of the table."""
    title = f"{world}, {count}" + (f", seed {seed}" if seed else "") + (f", {change}" if change else "")
    with TemporaryDirectory() as place:
        folder = Path(place) / "panoramas"
        return f"| {title} | {cells(folder, photographed(world, count, seed, change, folder), features)}"


def main() -> None:
    """Print the table."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("sets", nargs="*", default=SETS, metavar="WORLD:COUNT[:SEED[:uneven|plain]]")
    words.add_argument("--features", default="sift")
    given = words.parse_args()
    print("| panoramas | maps of | right | wrong | median of the right ones, cm |\n|---|---|---|---|---|")
    for one in given.sets:
        world, count, *more = one.split(":")
        seed = int(more[0]) if more else 0
        print(row(world, int(count), seed, more[1] if len(more) > 1 else "", given.features), flush=True)


if __name__ == "__main__":
    main()
