"""The scenes and cameras that the page offers, and the problems that they give."""

from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

from spherloc.cameras.base import Camera
from spherloc.datasets import Scene, bundled_scenes, load_scene
from spherloc.datasets.map_scene import MapScene
from spherloc.datasets.synthetic import SyntheticScene
from spherloc.datasets.variation import Variation
from spherloc.problem import Problem


@dataclass(frozen=True)
class SceneWish:
    """What the page asks of a scene."""

    scene: str
    """Its label in the catalog."""
    seed: int
    """Of the simulation, of spoiled matches, and of the estimator."""
    query: str | None = None
    """Name of a query image, for scenes made of images; None for the first."""
    variation: Variation = field(default_factory=Variation)
    """What is changed about the scene."""


class Catalog:
    """Scenes by label: the one of the command line first, then those that come with the project, simulations first."""

    def __init__(self, given: Path | None) -> None:
        """Raises ``InputError`` if the given scene cannot be used."""
        self.scenes: dict[str, Scene] = {}
        self._paths: dict[str, Path] = {}
        if given is not None:
            self._add(load_scene(given), given)
        others = [path for path in bundled_scenes().values() if given is None or path.resolve() != given.resolve()]
        loaded = [(load_scene(path), path) for path in others]
        # A simulation shows its first picture at once, images take seconds.
        for scene, path in sorted(loaded, key=lambda pair: not isinstance(pair[0], SyntheticScene)):
            self._add(scene, path)
        self.cameras: dict[str, str] = {}
        """Paths of scene files, by a label of their camera: what a variation takes as its camera."""
        for label, scene in self.scenes.items():
            if isinstance(scene, SyntheticScene):
                self.cameras.setdefault(camera_label(scene.camera), str(self.path(label)))
        self._unedited = lru_cache(maxsize=16)(self._draw)
        self.problem = lru_cache(maxsize=16)(self._problem)
        """The problem (cached) that a wish describes; raises ``InputError`` if there is none."""
        self.mesh = lru_cache(maxsize=4)(self._mesh)
        """Binary glTF (cached) of a scene's map, in the map frame, by its label; None if it has none."""

    def path(self, label: str) -> Path:
        """The scene file of that label, absolute."""
        return self._paths[label]

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
        self.scenes[label], self._paths[label] = scene, path.resolve()

    def _problem(self, wish: SceneWish) -> Problem:
        # Images take long to match: one more spoiled match must not have them matched again.
        unedited = self._unedited(replace(wish, variation=wish.variation.without_edits()))
        return wish.variation.edit(unedited, wish.seed)

    def _draw(self, wish: SceneWish) -> Problem:
        return wish.variation.unedited(self.scenes[wish.scene], wish.seed, wish.query)

    def _mesh(self, label: str) -> bytes | None:
        scene = self.map_scene(label)
        return None if scene is None or scene.mesh is None else scene.mesh()


def camera_label(camera: Camera) -> str:
    """What a camera is called on the page."""
    return f"{camera.model.replace('_', ' ')}, {camera.width} × {camera.height}"
