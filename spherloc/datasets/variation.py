"""Changes to a scene before it is solved: to its simulation, its camera, and single matches."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from spherloc.cameras.base import Camera, model_name
from spherloc.cameras.calibration import load_camera
from spherloc.datasets.map_scene import MapScene
from spherloc.datasets.point_cloud import OUTLIER_KINDS, Lens, OutlierKind
from spherloc.datasets.scene_file import Scene, checked_problem
from spherloc.datasets.synthetic import SyntheticScene, TrueCamera
from spherloc.errors import InputError, show
from spherloc.geometry import transform
from spherloc.problem import Problem
from spherloc.types import FloatArray, IntArray

EDITS = ("spoiled", "mended", "hidden")
SPOIL_STREAM = 17
"""Number of the random stream of spoiled pixels, which keeps their draws apart from those of the simulation."""
SPOIL_DRAWS = 32
SPOIL_LEAST_RAD = np.radians(10.0)
"""Least angle between the bearings of a spoiled pixel and of the true one, where the camera allows it."""


@dataclass(frozen=True)
class Variation:
    """Changes to a scene; the defaults change nothing. Hashable, so that problems can be kept by it.

    Matches are numbered from 0, as in the problem before anything is hidden.
    """

    camera: str | None = None
    """Path of a scene or calibration file whose camera replaces the scene's. This field and the next ones, down to
    ``true_camera``, are for synthetic scenes only; None leaves the scene's value."""
    correspondences: int | None = None
    """Number of correspondences, N."""
    noise_px: float | None = None
    """Standard deviation of the pixel noise, px."""
    outlier_rate: float | None = None
    """Share of wrong correspondences, 0 to 1."""
    outlier_kind: OutlierKind | None = None
    """"random", "coherent" or "repeated", see ``SyntheticScene``."""
    field_of_view_deg: float | None = None
    """Whatever is farther than half of it from the optical axis is not seen, degrees."""
    cloud_height_m: float | None = None
    """Height of the cloud of points, m."""
    gravity_error_deg: float | None = None
    """Standard deviation of the error of the known roll and of the known pitch, degrees."""
    true_camera: TrueCamera | None = None
    """Yaw (deg) and position x, y, z (m) of the true camera in the map frame."""
    spoiled: tuple[int, ...] = ()
    """Matches that get a wrong pixel, which follows from the seed and the number."""
    mended: tuple[int, ...] = ()
    """Matches that get the projection of their point by the true pose as their pixel."""
    hidden: tuple[int, ...] = ()
    """Matches that are left out."""

    def __post_init__(self) -> None:
        for name in EDITS:
            object.__setattr__(self, name, _numbers(name, getattr(self, name)))
        both = set(self.spoiled) & set(self.mended)
        if both:
            raise InputError(f"match {min(both)} is both to be spoiled and to be mended; choose one of the two.")
        if self.true_camera is not None:
            object.__setattr__(self, "true_camera", tuple(map(float, self.true_camera)))

    @property
    def simulation(self) -> dict[str, Any]:
        """The changed fields of a synthetic scene, with their values."""
        return {name: value for name in _SIMULATED if (value := getattr(self, name)) is not None}

    @property
    def edited(self) -> bool:
        """Whether single matches are changed."""
        return bool(self.spoiled or self.mended or self.hidden)

    def without_edits(self) -> "Variation":
        """The same simulation with all matches as they are."""
        return replace(self, spoiled=(), mended=(), hidden=())

    def spoil(self, numbers: Iterable[int]) -> "Variation":
        """These matches spoiled too; they are no longer mended."""
        new = set(numbers)
        return replace(self, spoiled={*self.spoiled, *new}, mended=set(self.mended) - new)

    def mend(self, numbers: Iterable[int]) -> "Variation":
        """These matches mended too; they are no longer spoiled."""
        new = set(numbers)
        return replace(self, mended={*self.mended, *new}, spoiled=set(self.spoiled) - new)

    def hide(self, numbers: Iterable[int]) -> "Variation":
        """These matches left out too."""
        return replace(self, hidden={*self.hidden, *numbers})

    def problem(self, scene: Scene, seed: int | None = None, query: str | None = None) -> Problem:
        """The changed problem of a scene; ``seed`` replaces its own, ``query`` chooses a query image.

        Raises ``InputError`` for a change or a query that the scene does not have, the number of a match that does not
        exist, or a match that cannot be mended.
        """
        return self.edit(self.unedited(scene, seed, query), used_seed(scene, seed))

    def unedited(self, scene: Scene, seed: int | None = None, query: str | None = None) -> Problem:
        """``problem`` with all matches as they are; raises ``InputError`` as it does."""
        changed = self.scene(scene)
        if isinstance(changed, MapScene):
            return checked_problem(changed, lambda: changed.problem(seed, query))
        if query is not None:
            raise InputError(f"{scene.name}: has no query images to choose from; leave out the query.")
        return checked_problem(changed, lambda: changed.problem(seed))

    def scene(self, scene: Scene) -> Scene:
        """The scene with its simulation changed; raises ``InputError`` if it has none."""
        changes = self.simulation
        if not changes:
            return scene
        if not isinstance(scene, SyntheticScene):
            raise InputError(
                f"{scene.name}: {next(iter(changes))} can be changed in synthetic scenes only; leave it out, or choose "
                "a synthetic scene."
            )
        if "camera" in changes:
            changes["camera"] = _camera(Path(changes["camera"]))
        changed = replace(scene, **changes)
        return replace(changed, name=_changed_name(scene, changed, changes.keys()))

    def words(self, scene: SyntheticScene) -> tuple[str, ...]:
        """What is changed about a synthetic scene, a few words for each value, such as "30 % outliers".

        Raises ``InputError`` for a value that it cannot have.
        """
        changed = self.scene(scene)
        assert isinstance(changed, SyntheticScene)
        words = _words(changed)
        return tuple(words[name] for name in words if name in self.simulation)

    def edit(self, problem: Problem, seed: int) -> Problem:
        """An unedited problem with these matches spoiled, mended and hidden."""
        if not self.edited:
            return problem
        self._check(len(problem))
        pixels, labels = problem.pixels.copy(), problem.truth_inliers
        spoiled, mended = list(self.spoiled), list(self.mended)
        if spoiled:
            pixels[spoiled] = _wrong_pixels(problem, self.spoiled, seed)
        if mended:
            pixels[mended] = _right_pixels(problem, self.mended)
        if labels is not None:
            labels = labels.copy()
            labels[spoiled], labels[mended] = False, True
        kept = self.kept(len(problem))
        index, reference_pixels = problem.reference_index, problem.reference_pixels
        return replace(
            problem,
            name=f"{problem.name}, edited",
            pixels=pixels[kept],
            points=problem.points[kept],
            truth_inliers=None if labels is None else labels[kept],
            reference_index=None if index is None else index[kept],
            reference_pixels=None if reference_pixels is None else reference_pixels[kept],
            remarks=(*problem.remarks, self._remark()),
        )

    def kept(self, count: int) -> IntArray:
        """Original numbers (N',) of the correspondences that are not hidden, of ``count`` in all."""
        self._check(count)
        return np.delete(np.arange(count), list(self.hidden))

    def _check(self, count: int) -> None:
        most = max((*self.spoiled, *self.mended, *self.hidden), default=-1)
        if most >= count:
            raise InputError(f"there is no match {most}: the problem has {count}, numbered from 0 to {count - 1}.")

    def _remark(self) -> str:
        edits = [f"{len(getattr(self, name))} {name}" for name in EDITS if getattr(self, name)]
        return f"Matches were changed by hand: {', '.join(edits)}."


_SIMULATED = tuple(item.name for item in fields(Variation) if item.name not in EDITS)


def _changed_name(scene: SyntheticScene, changed: SyntheticScene, fields_changed: Iterable[str]) -> str:
    """The scene's name with its outlier rate brought up to date, followed by the other changes."""
    before, now = (f"{100 * rate:.3g} % outliers" for rate in (scene.outlier_rate, changed.outlier_rate))
    name, words = scene.name.replace(before, now), _words(changed)
    told = [words[field] for field in words if field in fields_changed and words[field] not in name]
    return ", ".join([name, *told])


def _words(changed: SyntheticScene) -> dict[str, str]:
    """Every value of a scene that a variation can change, in a few words."""
    return {
        "camera": f"through {model_name(changed.camera)}",
        "correspondences": f"{changed.correspondences} matches",
        "noise_px": f"{changed.noise_px:g} px noise",
        "outlier_rate": f"{100 * changed.outlier_rate:.3g} % outliers",
        "outlier_kind": f"{changed.outlier_kind} outliers",
        "field_of_view_deg": f"{changed.field_of_view_deg:g}° wide",
        "cloud_height_m": f"{changed.cloud_height_m:g} m high",
        "gravity_error_deg": f"gravity error {changed.gravity_error_deg:g}° (1 sd)",
        "true_camera": "camera moved",
    }


def used_seed(scene: Scene, seed: int | None) -> int:
    """The seed itself, or else that of a random scene, or else 0."""
    return getattr(scene, "seed", 0) if seed is None else seed


def _numbers(name: str, values: Iterable[int]) -> tuple[int, ...]:
    found = sorted({int(value) for value in values})
    if found and found[0] < 0:
        raise InputError(f"{name} names the match {found[0]}; matches are numbered from 0.")
    return tuple(found)


def _camera(path: Path) -> Camera:
    """The camera of a file, read once for as long as the file does not change."""
    try:
        state = path.stat()
    except (OSError, ValueError):
        return load_camera(path)  # raises an error that says what is wrong
    return _camera_of_state(path, state.st_mtime_ns, state.st_size)


@lru_cache(maxsize=32)
def _camera_of_state(path: Path, changed_ns: int, size: int) -> Camera:
    return load_camera(path)


def _wrong_pixels(problem: Problem, numbers: tuple[int, ...], seed: int) -> FloatArray:
    """Random pixels (K, 2), far from the right ones, in the part of the image where the problem has its matches."""
    camera, index = problem.camera, list(numbers)
    size = np.array([camera.width, camera.height])
    draws = [np.random.default_rng([seed, SPOIL_STREAM, number]).uniform(size=(SPOIL_DRAWS, 2)) for number in numbers]
    candidates = np.array(draws) * size
    bearings, valid = camera.unproject(candidates.reshape(-1, 2))
    bearings, valid = bearings.reshape(len(numbers), SPOIL_DRAWS, 3), valid.reshape(len(numbers), SPOIL_DRAWS)
    right = problem.bearings[index]
    if problem.truth_cam_from_map is not None:
        right = transform(problem.truth_cam_from_map, problem.points[index])
        right /= np.maximum(np.linalg.norm(right, axis=1, keepdims=True), 1e-12)
    least_z = np.nanmin(problem.bearings[:, 2])
    usable = valid & (bearings[:, :, 2] >= least_z)
    angle = np.arccos(np.clip(np.nan_to_num(np.einsum("kdi,ki->kd", bearings, right)), -1.0, 1.0))
    # The first candidate that is far off; if none is, the farthest; pixels outside the used part of the image last.
    score = np.where(usable, np.minimum(angle, SPOIL_LEAST_RAD) + 10.0, np.where(valid, angle, -1.0))
    best = np.argmax(score, axis=1)
    lost = score[np.arange(len(numbers)), best] < 0.0
    if lost.any():
        raise InputError(f"match {numbers[int(np.argmax(lost))]} cannot be spoiled: the camera sees too few pixels.")
    return candidates[np.arange(len(numbers)), best]


def _right_pixels(problem: Problem, numbers: tuple[int, ...]) -> FloatArray:
    """The projections (K, 2) of the points by the true pose."""
    if problem.truth_cam_from_map is None:
        raise InputError(f"match {numbers[0]} cannot be mended: the true pose of {show(problem.name)} is not known.")
    pixels, visible = Lens(problem.camera).project(problem.truth_cam_from_map, problem.points[list(numbers)])
    if not visible.all():
        number = numbers[int(np.argmin(visible))]
        raise InputError(f"match {number} cannot be mended: the camera does not see its point; hide it instead.")
    return pixels


PLACE = "yaw,x,y,z: degrees and metres, four numbers with commas between them"


def _kind(text: str) -> str:
    return OUTLIER_KINDS[OUTLIER_KINDS.index(text)]


def _place(text: str) -> tuple[float, ...]:
    yaw_deg, x, y, z = map(float, text.split(","))
    return yaw_deg, x, y, z


def _path(text: str) -> str:
    if not text:
        raise ValueError
    return text


KEYS: Mapping[str, tuple[Callable[[str], Any], str]] = {
    "camera": (_path, "the path of a scene or calibration file"),
    "correspondences": (int, "a whole number"),
    "noise_px": (float, "a number"),
    "outlier_rate": (float, "a number"),
    "outlier_kind": (_kind, ", ".join(OUTLIER_KINDS[:-1]) + f" or {OUTLIER_KINDS[-1]}"),
    "field_of_view_deg": (float, "a number"),
    "cloud_height_m": (float, "a number"),
    "gravity_error_deg": (float, "a number"),
    "true_camera": (_place, PLACE),
}
"""How each change to a simulation is read, and what may be given."""


def parse_variation(
    settings: Sequence[str], spoil: str | None = None, mend: str | None = None, hide: str | None = None
) -> Variation:
    """The variation that "KEY=VALUE" texts and lists of matches such as "3,5" say.

    Raises ``InputError``, which names what may be given, for an unknown key, a key that is given twice, or a value
    of another form. What a number may be is checked by the scene that it changes.
    """
    changes: dict[str, Any] = {}
    for setting in settings:
        key, equals, text = setting.partition("=")
        if not equals or key not in KEYS:
            raise InputError(f"setting {show(setting)} is unknown; give KEY=VALUE with {', '.join(KEYS)}.")
        if key in changes:
            raise InputError(f"setting {key} is given twice; give it once.")
        parse, accepted = KEYS[key]
        try:
            changes[key] = parse(text.strip())
        except ValueError:
            raise InputError(f"setting {key} is {show(text)}; give {accepted}.") from None
    for name, word, text in (("spoiled", "spoil", spoil), ("mended", "mend", mend), ("hidden", "hide", hide)):
        changes[name] = _matches(word, text)
    return Variation(**changes)


def _matches(name: str, text: str | None) -> tuple[int, ...]:
    try:
        return tuple(int(number) for number in text.split(",")) if text is not None else ()
    except ValueError:
        raise InputError(
            f"{name} is {show(text)}; give the numbers of matches with commas between them, such as 3,5."
        ) from None


def settings_of(variation: Variation) -> tuple[str, ...]:
    """The "KEY=VALUE" texts from which ``parse_variation`` makes the same simulation again, to the last bit."""
    return tuple(f"{key}={_text(value)}" for key, value in variation.simulation.items())


def _text(value: Any) -> str:
    if isinstance(value, tuple):
        return ",".join(map(repr, value))
    return value if isinstance(value, str) else repr(value)
