"""A map scene whose matches are drawn instead of found in images, so that the truth of every number is known.

It is registered as a kind of scene files by a distribution of its own, as somebody else's loader would be.
"""

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.datasets.map_scene import MapScene
from spherloc.datasets.scene_file import check_keys
from spherloc.errors import InputError
from spherloc.frontend.view import Gravity, Matches, View
from spherloc.geometry import pose, transform, yaw_rotation

CAMERA = Equirectangular(width=1024, height=512)
NOISE_PX = 0.3
STANDING = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Camera axes in a map whose z points up."""
GRAVITY_MAP = np.array([0.0, 0.0, -1.0])

KEYS = {"kind", "name"}
OPTIONAL = {
    "queries",
    "broken",
    "few",
    "thin",
    "unknown",
    "wrong",
    "stuck",
    "registered",
    "timed",
    "folder",
    "crashing",
}


def true_pose(place: int) -> np.ndarray:
    """``cam_from_map`` of a query: along a curve, turning."""
    centre = np.array([1.5 * place, 0.3 * place**1.5, 1.7])
    rotation = yaw_rotation(0.2 * place) @ STANDING
    return pose(rotation, -rotation @ centre)


@dataclass(frozen=True)
class DrawnMatches:
    """Draws the matches of a query: 60, 24 for ``thin`` queries, a single one for ``few``, wrong ones for ``wrong``.

    ``stuck`` ones wait until there is a file "go on" beside the images; ``crashing`` ones raise what no loader may.
    """

    references: tuple[View, ...]
    few: tuple[int, ...]
    thin: tuple[int, ...]
    wrong: tuple[int, ...]
    stuck: tuple[int, ...]
    crashing: tuple[int, ...]

    def __call__(self, query: View) -> Matches:
        query.read()
        place = int(query.name[5:-4])
        while place in self.stuck and not query.path.with_name("go on").exists():
            time.sleep(0.01)
        if place in self.crashing:
            raise KeyError("depth")
        rng = np.random.default_rng(place)
        truth = true_pose(place)
        count = 1 if place in self.few else 24 if place in self.thin else 60
        points = rng.uniform(-20.0, 20.0, (count, 3)) - truth[:, :3].T @ truth[:, 3]
        pixels, _ = CAMERA.project(transform(truth, points))
        pixels = np.clip(pixels + NOISE_PX * rng.standard_normal(pixels.shape), 0.01, [1023.99, 511.99])
        false = np.arange(len(points)) % 3 == 0 if place not in self.wrong else np.ones(len(points), dtype=bool)
        pixels[false] = rng.uniform([0.0, 32.0], [1024.0, 480.0], (int(false.sum()), 2))
        index = np.zeros(len(points), dtype=np.int64)
        remarks = (f"{query.name}: few matches.",) if len(points) < 2 else ()
        return Matches(pixels, points, self.references, index, np.full_like(pixels, np.nan), 0.4, remarks)


@dataclass(frozen=True)
class DistanceRegistration:
    """Knows the right place of a query; the second one cannot be registered."""

    thresholds_m: tuple[float, ...] = (0.05, 0.2)

    def __call__(self, query: View, cam_from_map: np.ndarray, references: tuple[View, ...]) -> float:
        place = int(query.name[5:-4])
        if place == 1:
            raise InputError(f"{query.name}: no depth to register.")
        truth = true_pose(place)
        off = float(np.linalg.norm(cam_from_map[:, :3].T @ cam_from_map[:, 3] - truth[:, :3].T @ truth[:, 3]))
        return off if off < 1.0 else np.inf


def load(table: dict[str, Any], path: Path) -> MapScene:
    """Read a scene of ``kind = "drawn"``; its images are written beside it."""
    check_keys(table, KEYS, OPTIONAL, str(path))
    broken, unknown = table.get("broken", []), table.get("unknown", [])
    folder = path.parent / table.get("folder", "images")
    folder.mkdir(exist_ok=True)
    count = table.get("queries", 4)
    queries = []
    for place in range(count):
        image = folder / f"image{place}.png"
        if not image.exists():
            ok, content = cv2.imencode(".png", np.zeros((512, 1024), np.uint8))
            image.write_bytes(content.tobytes() if ok and place not in broken else b"no image")
        known = None if place in unknown else true_pose(place)
        stamp = 1520530308.25 + 0.1 * place if table.get("timed", False) else None
        queries.append(View(image.name, CAMERA, image, known, Gravity(STANDING @ GRAVITY_MAP, "the IMU"), stamp))
    reference = View("reference", CAMERA, folder / "image0.png", true_pose(0))
    chosen = (tuple(table.get(name, ())) for name in ("few", "thin", "wrong", "stuck", "crashing"))
    return MapScene(
        name=table["name"],
        where=str(path),
        queries=tuple(queries),
        references=(reference,),
        matcher=DrawnMatches((reference,), *chosen),
        gravity_map=GRAVITY_MAP,
        thresholds=((0.5, 0.1), (2.0, 0.5)),
        registration=DistanceRegistration() if table.get("registered", False) else None,
        remarks=("The loader skipped nothing of note.",) if table.get("timed", False) else (),
        kind=table["kind"],
    )


def write_scene(folder: Path, **keys: Any) -> Path:
    """A scene file of ``kind = "drawn"``."""
    text = {key: str(value).lower() if isinstance(value, bool) else repr(value) for key, value in keys.items()}
    lines = ['kind = "drawn"', 'name = "drawn walk"', *(f"{key} = {value}" for key, value in text.items())]
    (folder / "scene.toml").write_text("\n".join(lines) + "\n")
    return folder / "scene.toml"


def plug_in(folder: Path) -> dict[str, str]:
    """Install the kind into ``folder``, as pip would; returns the environment in which it is found."""
    information = folder / "drawn_matches-1.0.dist-info"
    information.mkdir(parents=True)
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: drawn-matches\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text("[spherloc.datasets]\ndrawn = drawn_matches:load\n")
    (folder / "drawn_matches.py").write_text(Path(__file__).read_text())
    return os.environ | {"PYTHONPATH": str(folder), "COLUMNS": "100"}
