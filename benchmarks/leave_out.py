"""Photographs left out of a map and localized in it, by how far they are from where the map of all has them: a table.

    .venv/bin/python -m benchmarks.leave_out FOLDER [--out 2.jpg 4.jpg] [--width 1920] [--features sift]

For panoramas without a known truth. The map of all of them, at their own size, stands for it; the others are shrunk to
the width first. Without ``--out`` every second photograph is left out, in the order of names. Lengths are in the units
of the map of all: metres, if the photographs have GPS. Needs the extra ``colmap``.
"""

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from spherloc.datasets.map_scene import MapScene
from spherloc.datasets.scene_file import load_scene
from spherloc.errors import InputError
from spherloc.estimators import estimate
from spherloc.files import is_image, names_in
from spherloc.geometry import camera_centre
from spherloc.mapping.images.photographs import photographs
from spherloc.mapping.make import Map, make_map
from spherloc.mapping.request import MapRequest
from spherloc.mapping.scenes.new_images import new_images_of
from spherloc.outcome import judge
from spherloc.types import FloatArray
from spherloc_viz.commands.map import how_of


def mapped(images: Path, output: Path, features: str | None, queries: Path | None = None) -> Map:
    """The map of a folder of panoramas, with a scene for the photographs in ``queries``."""
    found = photographs(images, {})
    others = None if queries is None else new_images_of(queries, found)[0]
    return make_map(MapRequest(found.views, images, new_images=others, how=how_of(features)), output)


def shrunk(source: Path, target: Path, width: int | None) -> None:
    """Write a panorama at a width of pixels, or as it is."""
    image = cv2.imread(str(source))
    if image is None:
        raise InputError(f"{source}: cannot be read; give a folder of photographs.")
    if width is not None and width < image.shape[1]:
        image = cv2.resize(image, (width, width // 2), interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(target), image, (cv2.IMWRITE_JPEG_QUALITY, 95))


def onto(poses: dict[str, FloatArray], truth: dict[str, FloatArray]) -> tuple[float, FloatArray, FloatArray]:
    """Scale, rotation (3, 3) and offset (3,) that take a map's places to those of the map of all.

    The rotation is the mean of those of the images, so that two images are enough.
    """
    names = sorted(poses.keys() & truth.keys())
    left, _, right = np.linalg.svd(sum(truth[name][:, :3].T @ poses[name][:, :3] for name in names))
    rotation = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    here = np.array([camera_centre(poses[name]) for name in names]) @ rotation.T
    there = np.array([camera_centre(truth[name]) for name in names])
    spread, wide = here - here.mean(axis=0), there - there.mean(axis=0)
    scale = float((spread * wide).sum() / max((spread**2).sum(), 1e-300))
    return scale, rotation, there.mean(axis=0) - scale * here.mean(axis=0)


def rows(made: Map, truth: dict[str, FloatArray], estimator: str) -> list[str]:
    """A line of the table for each photograph that was left out."""
    assert made.written.new_scene is not None
    scene = load_scene(made.written.new_scene)
    assert isinstance(scene, MapScene)
    scale, rotation, offset = onto(made.written.poses, truth)
    lines = []
    for view in scene.queries:
        try:
            trace = estimate(scene.problem(query=view.name), estimator, seed=0)
        except InputError as error:
            lines.append(f"| {view.name} | no matches: {error} | | | |")
            continue
        pose, told = trace.cam_from_map, str(judge(trace).outcome)
        agree = f"{np.count_nonzero(trace.inlier_mask):,} of {len(trace.problem):,}"
        if pose is None or view.name not in truth:
            lines.append(f"| {view.name} | {told} | {agree} | | |")
            continue
        off = np.linalg.norm(scale * rotation @ camera_centre(pose) + offset - camera_centre(truth[view.name]))
        turn = pose[:, :3] @ rotation.T @ truth[view.name][:, :3].T
        angle = np.degrees(np.arccos(np.clip((np.trace(turn) - 1.0) / 2.0, -1.0, 1.0)))
        lines.append(f"| {view.name} | {told} | {agree} | {angle:.2f} | {off:.3f} |")
    return lines


def main() -> None:
    """Print the table."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("folder", type=Path)
    words.add_argument("--out", nargs="+", metavar="NAME")
    words.add_argument("--width", type=int)
    words.add_argument("--features")
    words.add_argument("--estimator", default="auto")
    given = words.parse_args()
    names = sorted(filter(is_image, names_in(given.folder)))
    out = set(given.out or names[1::2])
    with TemporaryDirectory() as place:
        folder = Path(place)
        whole = mapped(given.folder, folder / "all", given.features)
        truth = whole.written.poses
        for name in names:
            target = folder / ("queries" if name in out else "references")
            target.mkdir(exist_ok=True)
            shrunk(given.folder / name, target / name, given.width)
        print(f"{len(truth)} of {len(names)} in the map of all, scale from {whole.scale.source or 'nothing'}; ", end="")
        made = mapped(folder / "references", folder / "map", given.features, folder / "queries")
        print(f"{len(made.written.poses)} of {len(names) - len(out)} in the map without those left out\n")
        print("| left out | judged | matches that agree | rotation (deg) | position |\n|---|---|---|---|---|")
        print("\n".join(rows(made, truth, given.estimator)))


if __name__ == "__main__":
    main()
