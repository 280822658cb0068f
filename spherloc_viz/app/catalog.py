"""The scenes and cameras that the page offers, the problems that they give, and what a page asks for."""

import copy
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import chain, count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spherloc.cameras.base import Camera, model_name
from spherloc.datasets import Scene, bundled_scenes, load_scene
from spherloc.datasets.map_scene import MapScene
from spherloc.datasets.staged import StagedScene
from spherloc.datasets.synthetic import SyntheticScene
from spherloc.datasets.variation import Variation
from spherloc.errors import InputError, show
from spherloc.problem import Problem
from spherloc.trace import Trace
from spherloc_viz.gallery import play_of, staged_path
from spherloc_viz.given_files import is_recording
from spherloc_viz.recording.replay import load_recorded_scene

MAX_BRIEF = 8
"""How many recorded problems a page offers beside its scenes."""
MAX_MESHES = 4
"""For how many maps the meshes are kept."""


@dataclass(frozen=True)
class SceneRequest:
    """All that the problem of a page depends on."""

    scene: str
    """The scene's label in the catalog."""
    seed: int
    """Seed of the simulation, of spoiled matches, and of the estimator."""
    query: str | None = None
    """Name of a query image, for scenes made of images; None for the first."""
    variation: Variation = field(default_factory=Variation)
    """What is changed about the scene."""


class Catalog:
    """Scenes by label: the one of the command line first, then those that come with the project, simulations first."""

    def __init__(self, given: Path | None) -> None:
        """``given`` is a scene file or a recording; raises ``SpherlocError`` if it cannot be used."""
        self.scenes: dict[str, Scene] = {}
        self._paths: dict[str, Path] = {}
        if given is not None:
            self.add(load_recorded_scene(given) if is_recording(given) else load_scene(given), given)
        others = [path for path in bundled_scenes().values() if given is None or path.resolve() != given.resolve()]
        loaded = [(load_scene(path), path) for path in others]
        # A simulation shows its first picture at once, images take seconds.
        for scene, path in sorted(loaded, key=lambda pair: not isinstance(pair[0], SyntheticScene)):
            self.add(scene, path)
        self.cameras: dict[str, str] = {}
        """Paths of scene files, by a label of their camera: what a variation takes as its camera."""
        for label, scene in self.scenes.items():
            if isinstance(scene, SyntheticScene):
                self.cameras.setdefault(camera_label(scene.camera), str(self.path(label)))
        self._brief: list[str] = []
        self._caches = _Caches()

    def branch(self) -> "Catalog":
        """A catalog with the same scenes and caches, to which one page can add scenes that others do not see."""
        branch = copy.copy(self)
        branch.scenes, branch._paths, branch.cameras = dict(self.scenes), dict(self._paths), dict(self.cameras)
        branch._brief = list(self._brief)
        return branch

    def add(self, scene: Scene, path: Path, label: str | None = None) -> str:
        """Add a scene, or load it anew if its file is known already; returns its label, by default its name.

        The label is made longer if another scene has, or had, it already.
        """
        path, label = path.resolve(), label or scene.name
        known = next((known for known, file in self._paths.items() if file == path), None)
        names = chain([label, f"{label} ({path.name})"], (f"{label} {number}" for number in count(2)))
        free = known or next(name for name in names if name not in self._paths)
        self.scenes[free], self._paths[free] = scene, path
        return free

    def enter(self, scene: Scene, path: Path, label: str, brief: bool) -> str:
        """``add`` for the scene of a recorded run; of recorded problems (``brief``) only the newest stay."""
        entered = self.add(scene, path, label)
        if brief:
            self._brief = [*(other for other in self._brief if other != entered), entered]
            for old in self._brief[:-MAX_BRIEF]:
                del self.scenes[old]  # its label stays taken: requests of the history have it
            self._brief = self._brief[-MAX_BRIEF:]
        return entered

    def enter_case(self, name: str) -> str:
        """Offer a staged scene of the gallery, by the name of its case (``play_of``); returns its label.

        Raises ``InputError`` if there is no such case, or if its scene is in the catalog already.
        """
        case, play = play_of(name)
        if play.staged is None:
            raise InputError(f"the case {show(name)} is not staged; name its scene.")
        return self.add(play.staged, staged_path(name), case.title)

    def case(self, label: str) -> str | None:
        """The name of the case whose staged scene has that label; None for other scenes."""
        return self._paths[label].stem if isinstance(self.scenes[label], StagedScene) else None

    def path(self, label: str) -> Path:
        """The scene file of that label, absolute."""
        return self._paths[label]

    def problem(self, request: SceneRequest) -> Problem:
        """The problem (cached) that a request describes; raises ``InputError`` if there is none.

        Its pictures may not be drawn yet.
        """
        return self._caches.problem(self._scene(request.scene), request.seed, request.query, request.variation)

    def mesh(self, label: str) -> bytes | None:
        """Binary glTF (cached) of a scene's map, in the map frame; None if it has none. May take a second or two."""
        scene = self.map_scene(label)
        return None if scene is None or scene.mesh is None else self._caches.mesh(scene)

    def known_mesh(self, label: str) -> bytes | None:
        """``mesh`` if it has been made, else None, at once."""
        scene = self.map_scene(label)
        return None if scene is None else self._caches.meshes.get(scene)

    def synthetic(self, label: str) -> SyntheticScene | None:
        """The scene of that label if it is a random one, whose parameters can be changed."""
        scene = self._scene(label)
        return scene if isinstance(scene, SyntheticScene) else None

    def map_scene(self, label: str) -> MapScene | None:
        """The scene of that label if it is made of images, which are localized one by one."""
        scene = self._scene(label)
        return scene if isinstance(scene, MapScene) else None

    def _scene(self, label: str) -> Scene:
        """The scene of that label; raises ``InputError`` for a recorded problem that newer ones have replaced."""
        if label not in self.scenes:
            raise InputError(
                f"{label}: is not offered any more, as {MAX_BRIEF} recordings were opened since; open its recording."
            )
        return self.scenes[label]


class _Caches:
    """Newest problems and meshes. Keys are the scenes, since one label can mean two scenes on two pages."""

    def __init__(self) -> None:
        self.problem = lru_cache(maxsize=16)(self._problem)
        self._unedited = lru_cache(maxsize=16)(self._draw)
        self.meshes: dict[MapScene, bytes] = {}

    def _problem(self, scene: Scene, seed: int, query: str | None, variation: Variation) -> Problem:
        # Images take long to match: one more spoiled match must not have them matched again.
        return variation.edit(self._unedited(scene, seed, query, variation.without_edits()), seed)

    def _draw(self, scene: Scene, seed: int, query: str | None, variation: Variation) -> Problem:
        stored = scene.stored_problem(query) if isinstance(scene, MapScene) and not variation.simulation else None
        return variation.unedited(scene, seed, query) if stored is None else stored

    def mesh(self, scene: MapScene) -> bytes | None:
        """Made once; the newest few are kept."""
        found = self.meshes.get(scene)
        if found is None and scene.mesh is not None:
            found = scene.mesh()
            for old in tuple(self.meshes)[: 1 - MAX_MESHES]:
                self.meshes.pop(old, None)
            self.meshes[scene] = found
        return found


def camera_label(camera: Camera) -> str:
    """What a camera is called on the page."""
    return f"{model_name(camera)}, {camera.width} × {camera.height}"


@dataclass(frozen=True)
class RunRequest:
    """All that a run depends on."""

    scene: SceneRequest
    estimator: str
    """Registered name."""
    options: Any
    """The estimator's options dataclass."""


@dataclass(frozen=True, eq=False)
class Run:
    """A request with its problem and its trace."""

    request: RunRequest
    trace: Trace
    kept: NDArray[np.int64]
    """(N,) number that each correspondence of the problem has where nothing is hidden."""
