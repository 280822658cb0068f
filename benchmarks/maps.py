"""Maps of rendered panoramas whose true positions are known: a Markdown table of right and wrong images.

    .venv/bin/python -m benchmarks.maps [apartment:12 campus:20:7:uneven ...]
    .venv/bin/python -m benchmarks.maps --features sift+aliked           # with the extra ``learned``
    .venv/bin/python -m benchmarks.maps --pairs                          # right and wrong pairs by how sure they are

A world, a number of panoramas, evenly along its path, and the world's seed (0 if none is given) are one row; with
``uneven`` behind it exposure, colour, sharpness and noise differ, as in photographs that one takes in passing, with
``plain`` textures have a third of their contrast, as in rooms with plain walls. With ``unlike`` photographs are
uneven, and no two parts of floors, wallpaper and bookcases look the same, as they do in the worlds: a floor of tiles of
two metres puts images of one room into another. Each of
the maps that ``spherloc map`` makes of them is put onto the truth by the similarity that most of its images agree with;
an image that is then more than ``WRONG_M`` off is wrong. Maps of two images are not judged. Needs the extra ``colmap``.
"""

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from benchmarks.judged_pairs import judged_pairs, print_table
from spherloc.datasets.scene_file import load_scene
from spherloc.errors import InputError
from spherloc.experiments.summary import align
from spherloc.geometry import camera_centre
from spherloc.mapping.images.photographs import photographs
from spherloc.mapping.make import make_map
from spherloc.mapping.request import MapRequest
from spherloc.types import ByteArray, FloatArray
from spherloc.worlds.world import Surfaces, World
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
REPEATED, SHOWN = ("parquet", "stone_floor", "ceiling", "paper", "books"), 0.6
"""Beginnings of the names of textures that are seen many times, and the share of the sides of one that a piece shows
in an ``unlike`` world."""
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


CHANGES: Mapping[str, Callable[[ByteArray, np.random.Generator], ByteArray]] = {
    "uneven": uneven,
    "plain": plain,
    "unlike": uneven,
}
"""What makes photographs of rendered images."""


def unlike(world: World) -> World:
    """A world in which each piece of a floor, of wallpaper and of a row of books shows another part of its texture,
    mirrored or not."""

    def build() -> Surfaces:
        made, rng = world.build(), np.random.default_rng([world.seed, 3])
        mesh, boxes, uv = made.mesh, made.atlas.boxes, made.mesh.uv.copy()
        for surface in np.unique(mesh.surface):
            faces = np.flatnonzero(mesh.surface == surface)
            if not made.atlas.names[mesh.tile[faces[0]]].startswith(REPEATED):
                continue
            low, size = np.split(boxes[mesh.tile[faces[0]]].astype(float), 2)
            corners, shown, mirrored = (
                np.unique(mesh.faces[faces]),
                rng.uniform(0.0, 1.0 - SHOWN, 2),
                rng.random(2) < 0.5,
            )
            within = (uv[corners] - low) / size
            uv[corners] = low + size * (shown + SHOWN * np.where(mirrored, 1.0 - within, within))
        return replace(made, mesh=replace(mesh, uv=uv))

    return replace(world, kind=f"{world.kind} unlike", build=build)


def photographed(world: str, count: int, seed: int, change: str, folder: Path) -> dict[str, FloatArray]:
    """Write the panoramas into a folder; returns their true poses (3, 4), metres, by name."""
    rng = np.random.default_rng(seed)
    path = folder.with_suffix(".toml")
    path.write_text(SCENE.format(world=world, count=count, seed=seed))
    folder.mkdir()
    pictures = [view.picture for view in load_scene(path).references]
    place = unlike(pictures[0].world) if change == "unlike" else pictures[0].world
    poses = {}
    for picture in pictures:
        name, image = f"{picture.name}.png", replace(picture, world=place).image()
        cv2.imwrite(str(folder / name), CHANGES[change](image, rng) if change else image)
        poses[name] = picture.cam_from_map
    return poses


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


def row(one: str, features: str) -> str:
    """One line of the table."""
    world, count, seed, change = parts_of(one)
    title = f"{world}, {count}" + (f", seed {seed}" if seed else "") + (f", {change}" if change else "")
    with TemporaryDirectory() as place:
        folder = Path(place) / "panoramas"
        poses = photographed(world, count, seed, change, folder)
        return f"| {title} | {cells(folder, {name: camera_centre(one) for name, one in poses.items()}, features)}"


def pairs_of(one: str, features: str) -> list[tuple[float, bool]]:
    """How sure the pairs of a set are, and which are right."""
    with TemporaryDirectory() as place:
        folder = Path(place) / "panoramas"
        poses = photographed(*parts_of(one), folder)
        return judged_pairs(folder, [poses[name] for name in sorted(poses)], features)


def parts_of(one: str) -> tuple[str, int, int, str]:
    """World, number of panoramas, seed and change of a set."""
    world, count, *more = one.split(":")
    return world, int(count), int(more[0]) if more else 0, more[1] if len(more) > 1 else ""


def print_tables(
    description: str | None,
    metavar: str,
    sets: Sequence[str],
    row: Callable[[str, str], str],
    pairs_of: Callable[[str, str], list[tuple[float, bool]]],
) -> None:
    """Print a table of maps or of pairs, as the command line says; ``row`` and ``pairs_of`` take a set and features."""
    words = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("sets", nargs="*", default=sets, metavar=metavar)
    words.add_argument("--features", default="sift")
    words.add_argument("--pairs", action="store_true")
    given = words.parse_args()
    if given.pairs:
        print_table([pair for one in given.sets for pair in pairs_of(one, given.features)])
        return
    print("| images | maps of | right | wrong | median of the right ones, cm |\n|---|---|---|---|---|")
    for one in given.sets:
        print(row(one, given.features), flush=True)


def main() -> None:
    """Print the table."""
    print_tables(__doc__, "WORLD:COUNT[:SEED[:CHANGE]]", SETS, row, pairs_of)


if __name__ == "__main__":
    main()
