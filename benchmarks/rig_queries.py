"""Queries of two rendered fisheyes that are fixed to each other: a Markdown table of right and wrong poses.

    .venv/bin/python -m benchmarks.rig_queries [campus:7 apartment:5:half ...]     # one to two minutes each

A world and its seed are one row. The fisheyes are those of ``benchmarks.rig``, at twice as many times. Those of every
second time are the map, with their true poses, and all others are queries, which are localized by themselves and then
judged together. With ``half``, the map has only the first half of the way, and with ``sparse`` only every fourth time:
then queries look for places that the map has not. A pose is wrong that is more than ``WRONG_M`` or ``WRONG_DEG`` off.
"""

import argparse
import json
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.rig import FISHEYE, TIMES, photographed
from spherloc.datasets.map_scene import MapScene
from spherloc.datasets.scene_file import load_scene
from spherloc.estimators import options_type
from spherloc.experiments.results import DOUBTFUL, LOCALIZED, QueryResult
from spherloc.experiments.sequence import How, localize_queries
from spherloc.mapping.scenes.joint_outcome import judged_together

ROWS = (
    *("campus:7", "campus:11", "campus:3", "campus:21", "apartment:5", "apartment:12", "apartment:3"),
    *("street:5", "street:9", "campus:3:half", "apartment:5:half", "apartment:8:half", "street:9:half"),
    *("campus:31", "apartment:21:half"),
)
WHOLE, HALF, SPARSE = "", "half", "sparse"
WRONG_M, WRONG_DEG = 1.0, 5.0
ESTIMATOR = "auto"
SCENE = """
kind = "image-folder"
name = "drive"
images = {queries}
[camera]
{camera}
[gravity]
map = [0.0, 0.0, -1.0]
query = "lines"
bound_deg = 3.0
"""


def scene_of(world: str, seed: int, part: str, folder: Path) -> MapScene:
    """Render the fisheyes into a folder, and load the scene of which they are references and queries."""
    poses = photographed(world, seed, folder, 2 * TIMES)
    times = {name: int(Path(name).stem) for name in poses}
    step, last = (4 if part == SPARSE else 2), (TIMES if part == HALF else 2 * TIMES)
    camera = "\n".join(f"{key} = {json.dumps(value)}" for key, value in FISHEYE.to_dict().items())
    queries = [name for name, time in times.items() if time % 2]
    lines = [SCENE.format(queries=json.dumps(sorted(queries)), camera=camera)]
    for name, time in times.items():
        if time % step == 0 and time <= last:
            pose = json.dumps(poses[name].tolist())
            lines.append(f'[[references]]\nimage = "{name}"\ncam_from_map = {pose}')
    lines.append("[truth]")
    lines += [f'"{name}" = {json.dumps(poses[name].tolist())}' for name in queries]
    (folder / "scene.toml").write_text("\n".join(lines) + "\n")
    scene = load_scene(folder / "scene.toml")
    assert isinstance(scene, MapScene)
    return scene


def cells(rows: Iterable[QueryResult]) -> str:
    """Some cells of the table: right and wrong poses of localized and of doubtful queries, and those without one."""
    counts: Counter[tuple[str, bool]] = Counter()
    for row in rows:
        off_m, off_deg = row.translation_error_m, row.rotation_error_deg
        right = off_m is not None and off_deg is not None and off_m <= WRONG_M and off_deg <= WRONG_DEG
        counts[row.status, right] += 1
    told = [counts[status, right] for status in (LOCALIZED, DOUBTFUL) for right in (True, False)]
    return " | ".join(str(count) for count in (*told, counts.total() - sum(told)))


def main() -> None:
    """Print the table."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("rows", nargs="*", default=ROWS, metavar="WORLD:SEED[:half|:sparse]")
    given = words.parse_args()
    told = "localized: right | wrong | doubtful: right | wrong | no pose |"
    print(f"| | by themselves: {told} together: {told}")
    print(f"|---|{'---|' * 10}")
    how = How(ESTIMATOR, options_type(ESTIMATOR)(), 0)
    for one in given.rows:
        world, seed, part = (*one.split(":"), WHOLE)[:3]
        with TemporaryDirectory() as place:
            scene = scene_of(world, int(seed), part, Path(place) / "images")
            before = {row.query: row for row, _ in localize_queries(scene, scene.queries, *how[:3])}
            after = before | {row.query: row for row, _ in judged_together(scene, tuple(before.values()), how)}
        print(f"| {one} | {cells(before.values())} | {cells(after.values())} |", flush=True)


if __name__ == "__main__":
    main()
