"""The scenes and cameras that the page offers, and the problems that they give."""

import dataclasses
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from spherloc.cameras.base import Camera
from spherloc.datasets import Scene, bundled_scenes, load_scene
from spherloc.datasets.synthetic import SyntheticScene
from spherloc.problem import Problem

OWN_CAMERA = "the scene's own"


@dataclass(frozen=True)
class SceneWish:
    """What the page asks of a scene."""

    scene: str
    """Its label in the catalog."""
    seed: int
    camera: str = OWN_CAMERA
    """Label of a camera in the catalog. This and what follows is for synthetic scenes only."""
    correspondences: int = 0
    noise_px: float = 0.0
    outlier_rate: float = 0.0
    gravity_error_deg: float = 0.0


class Catalog:
    """Scenes by label: the one of the command line first, then those that come with the project."""

    def __init__(self, given: Path | None) -> None:
        """Raises ``InputError`` if the given scene cannot be used."""
        self.scenes: dict[str, Scene] = {}
        if given is not None:
            self._add(load_scene(given), given)
        for path in bundled_scenes().values():
            if given is None or path.resolve() != given.resolve():
                self._add(load_scene(path), path)
        self.cameras: dict[str, Camera] = {}
        for scene in self.scenes.values():
            if isinstance(scene, SyntheticScene):
                self.cameras.setdefault(_camera_label(scene.camera), scene.camera)
        self.problem = lru_cache(maxsize=16)(self._problem)
        """The problem (cached) that a wish describes; raises ``InputError`` if there is none."""

    def synthetic(self, label: str) -> SyntheticScene | None:
        """The scene of that label if it is a random one, whose parameters can be changed."""
        scene = self.scenes[label]
        return scene if isinstance(scene, SyntheticScene) else None

    def _add(self, scene: Scene, path: Path) -> None:
        label = scene.name if scene.name not in self.scenes else f"{scene.name} ({path.name})"
        self.scenes[label] = scene

    def _problem(self, wish: SceneWish) -> Problem:
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


def _camera_label(camera: Camera) -> str:
    return f"{camera.model.replace('_', ' ')}, {camera.width} × {camera.height}"
