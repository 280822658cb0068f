"""Rendered scenes: a street, an apartment or a campus, built and drawn by code, with true poses and depth.

References travel along the world's path in good conditions; queries come later, beside the path, in other light,
another season, with people about. Pictures are drawn when they are first needed and kept on disk.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spherloc.cameras.base import Camera
from spherloc.cameras.calibration import camera_from_table
from spherloc.datasets import map_scene, scene_file
from spherloc.datasets.map_scene import MapScene
from spherloc.errors import InputError
from spherloc.files import is_file
from spherloc.frontend.lifting import DepthLift
from spherloc.frontend.pipeline import image_matcher
from spherloc.frontend.stored_matches import SUFFIX, StoredMatches, key_of_table
from spherloc.frontend.view import View
from spherloc.geometry import pose, so3_exp
from spherloc.types import BoolArray, ByteArray, FloatArray
from spherloc.worlds import Conditions, World, build_world, image_path, render, stored_range

MAX_VIEWS = 500
MAX_PIXELS = 4_000_000
"""Largest number of pixels of a picture; a larger one takes too long to draw."""
ROUTE_LIMITS = {"offset_m": (-50.0, 50.0), "heading_deg": (-180.0, 180.0), "start": (0.0, 1.0), "stop": (0.0, 1.0)}
CONDITION_KEYS = {field.name for field in fields(Conditions)}
GRAVITY_DOWN = np.array([0.0, 0.0, -1.0])

EXAMPLE = """kind = "rendered"
name = "Street at dusk"
provenance = "Built and drawn by spherloc's own code."
world = "street"                  # or "apartment", "campus"
seed = 0                          # optional: another street of the sort

[camera]
model = "equirectangular"
width = 1024
height = 512

[references]                      # along the world's path
count = 20

[queries]                         # start, stop: shares of the path; offset_m, heading_deg: to the left
count = 5
start = 0.1
stop = 0.9
offset_m = 0.8
tilt_deg = 0.5                    # largest roll and pitch of a query, which its known gravity does not contain
light = "dusk"                    # day, morning, overcast, dusk, night
season = "autumn"                 # summer, spring, autumn, winter
occluders = 6
"""


@dataclass(frozen=True, eq=False)
class RenderedPicture:
    """A picture by all that determines it, and its name."""

    name: str
    world: World
    camera: Camera
    cam_from_map: FloatArray
    conditions: Conditions
    seed: int

    @property
    def path(self) -> Path:
        """File in which it is kept."""
        return image_path(*self._all)

    @property
    def _all(self) -> tuple[World, Camera, FloatArray, Conditions, int, str]:
        return self.world, self.camera, self.cam_from_map, self.conditions, self.seed, self.name

    def image(self) -> ByteArray:
        """The image (H, W, 3), BGR, drawn if it is not there yet."""
        return render(*self._all).image

    def range_m(self) -> NDArray[np.float32]:
        """Distances (H, W) along the rays, m."""
        kept = stored_range(self.path, self.camera)
        if kept is not None:
            return kept
        return render(*self._all).range_m


@dataclass(frozen=True, eq=False, kw_only=True)
class RenderedView(View):
    """A view whose file is drawn when it is first needed."""

    picture: RenderedPicture

    def read(self) -> ByteArray:
        """See ``View``."""
        return self.picture.image()

    def usable_pixels(self) -> BoolArray:
        """See ``View``. Features are kept by their image's content, and this is asked before they are detected."""
        self.make_file()
        return super().usable_pixels()

    def make_file(self) -> None:
        """See ``View``."""
        if not is_file(self.path):
            self.picture.image()


def load(table: dict[str, Any], path: Path) -> MapScene:
    """Read a scene file with ``kind = "rendered"``; nothing is drawn yet.

    Raises ``InputError`` for unknown or missing keys, an unknown world, or a value outside its limits.
    """
    where = str(path)
    known = map_scene.REQUIRED | {"world", "provenance", "camera", "references", "queries"}
    scene_file.check_keys(table, known, map_scene.OPTIONAL | {"seed"}, where)
    scene_file.text(table, "provenance", where)
    seed = scene_file.integer(table, "seed", where, 0, 2**31 - 1) if "seed" in table else 0
    try:
        world = build_world(scene_file.text(table, "world", where), seed)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    camera = camera_from_table(scene_file.section(table, "camera", where), f"{where} [camera]")
    if camera.width * camera.height > MAX_PIXELS:
        raise InputError(f"{where} [camera]: more than {MAX_PIXELS:,} pixels take too long to draw; give fewer.")
    queries, tilt_deg = _queries(scene_file.section(table, "queries", where), f"{where} [queries]", world, camera)
    settings = map_scene.read_settings(table, where, gravity_bound_deg=tilt_deg)
    references = _references(scene_file.section(table, "references", where), f"{where} [references]", world, camera)
    matcher = image_matcher(references, settings.frontend, where, path.parent)
    if path.resolve().parent == scene_file.BUNDLED:
        matcher = StoredMatches(matcher, references, path.with_suffix(SUFFIX), key_of_table(table))
    return settings.scene(path, queries, references, GRAVITY_DOWN, mesh=world.glb, matcher=matcher)


def _references(table: Mapping[str, Any], where: str, world: World, camera: Camera) -> tuple[View, ...]:
    """Views of the references: level cameras with depth."""
    scene_file.check_keys(table, {"count"}, ROUTE_LIMITS.keys() | CONDITION_KEYS, where)
    conditions = _conditions(table, where)
    views = []
    for number, place in enumerate(_poses(table, where, world)):
        picture = RenderedPicture(f"reference_{number:03d}", world, camera, place, conditions, number)
        lift = DepthLift(picture.range_m, camera, place, along="ray")
        views.append(_view(picture, lift=lift))
    return tuple(views)


def _queries(table: Mapping[str, Any], where: str, world: World, camera: Camera) -> tuple[tuple[View, ...], float]:
    """Views, and the limit of their tilt, degrees: their gravity is taken from a reference, which is level."""
    scene_file.check_keys(table, {"count"}, ROUTE_LIMITS.keys() | CONDITION_KEYS | {"tilt_deg"}, where)
    conditions = _conditions(table, where)
    tilt_deg = scene_file.number(table, "tilt_deg", where, 0.0, 10.0) if "tilt_deg" in table else 0.0
    views = []
    for number, place in enumerate(_poses(table, where, world)):
        # Occluders and noise differ from those of the references.
        tilted, seed = _tilted(place, tilt_deg, number), MAX_VIEWS + number
        views.append(_view(RenderedPicture(f"query_{number:03d}", world, camera, tilted, conditions, seed)))
    return tuple(views), tilt_deg


def _view(picture: RenderedPicture, lift: DepthLift | None = None) -> RenderedView:
    return RenderedView(
        name=picture.name,
        camera=picture.camera,
        path=picture.path,
        cam_from_map=picture.cam_from_map,
        lift=lift,
        picture=picture,
    )


def _poses(table: Mapping[str, Any], where: str, world: World) -> FloatArray:
    count = scene_file.integer(table, "count", where, 1, MAX_VIEWS)
    number = partial(scene_file.number, table, where=where)
    route = {key: number(key, lowest=low, highest=high) for key, (low, high) in ROUTE_LIMITS.items() if key in table}
    return world.route(count, **route)


def _conditions(table: Mapping[str, Any], where: str) -> Conditions:
    try:
        return Conditions(**{key: table[key] for key in CONDITION_KEYS & table.keys()})
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def _tilted(cam_from_map: FloatArray, tilt_deg: float, number: int) -> FloatArray:
    """The pose turned about a level axis through the camera, by at most ``tilt_deg``."""
    rng = np.random.default_rng([number, 37])
    angle, size = rng.uniform(0, 2 * np.pi), np.radians(tilt_deg) * np.sqrt(rng.uniform())
    turn = so3_exp(size * np.array([np.cos(angle), 0.0, np.sin(angle)]))
    return pose(turn @ cam_from_map[:, :3], turn @ cam_from_map[:, 3])
