"""The scenes and cameras that the page offers, and the problems that they give."""

import dataclasses
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from spherloc.cameras.base import Camera
from spherloc.datasets import Scene, bundled_scenes, load_scene
from spherloc.datasets.map_scene import MapScene
from spherloc.datasets.synthetic import SyntheticScene
from spherloc.problem import Problem

OWN_CAMERA = "the scene's own"


@dataclass(frozen=True)
class SceneWish:
    """What the page asks of a scene."""

    scene: str
    """Its label in the catalog."""
    seed: int
    query: str | None = None
    """Name of a query image, for scenes made of images; None for the first."""
    camera: str = OWN_CAMERA
    """Label of a camera in the catalog. This and what follows is for synthetic scenes only."""
    correspondences: int = 0
    noise_px: float = 0.0
    outlier_rate: float = 0.0
    gravity_error_deg: float = 0.0


class Catalog:
    """Scenes by label: the one of the command line first, then those that come with the project, simulations first."""

    def __init__(self, given: Path | None) -> None:
        """Raises ``InputError`` if the given scene cannot be used."""
        self.scenes: dict[str, Scene] = {}
        if given is not None:
            self._add(load_scene(given), given)
        others = [path for path in bundled_scenes().values() if given is None or path.resolve() != given.resolve()]
        loaded = [(load_scene(path), path) for path in others]
        # A simulation shows its first picture at once, images take seconds.
        for scene, path in sorted(loaded, key=lambda pair: not isinstance(pair[0], SyntheticScene)):
            self._add(scene, path)
        self.cameras: dict[str, Camera] = {}
        for scene in self.scenes.values():
            if isinstance(scene, SyntheticScene):
                self.cameras.setdefault(_camera_label(scene.camera), scene.camera)
        self.problem = lru_cache(maxsize=16)(self._problem)
        """The problem (cached) that a wish describes; raises ``InputError`` if there is none."""
        self.mesh = lru_cache(maxsize=4)(self._mesh)
        """Binary glTF (cached) of a scene's map, in the map frame, by its label; None if it has none."""

    def synthetic(self, label: str) -> SyntheticScene | None:
        """The scene of that label if it is a random one, whose parameters can be changed."""
        scene = self.scenes[label]
        return scene if isinstance(scene, SyntheticScene) else None

    def map_scene(self, label: str) -> MapScene | None:
        """The scene of that label if it is made of images, which are localized one by one."""
        scene = self.scenes[label]
        return scene if isinstance(scene, MapScene) else None

    def _add(self, scene: Scene, path: Path) -> None:
        label = scene.name if scene.name not in self.scenes else f"{scene.name} ({path.name})"
        self.scenes[label] = scene

    def _problem(self, wish: SceneWish) -> Problem:
        images = self.map_scene(wish.scene)
        if images is not None:
            return images.problem(wish.seed, wish.query)
        scene = self.synthetic(wish.scene)
        if scene is None:
            return self.scenes[wish.scene].problem(wish.seed)
        changed = dataclasses.replace(
            scene,
            camera=scene.camera if wish.camera == OWN_CAMERA else self.cameras[wish.camera],
            correspondences=wish.correspondences,
            noise_px=wish.noise_px,
            outlier_rate=wish.outlier_rate,
            gravity_error_deg=wish.gravity_error_deg,
        )
        return changed.problem(wish.seed)

    def _mesh(self, label: str) -> bytes | None:
        scene = self.map_scene(label)
        return None if scene is None or scene.mesh is None else scene.mesh()


def _camera_label(camera: Camera) -> str:
    return f"{camera.model.replace('_', ' ')}, {camera.width} × {camera.height}"
