"""The settings that determine the results of a sequence: stored with them, so that two settings are never mixed."""

import hashlib
import json
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from spherloc.datasets.map_scene import MapScene, Thresholds
from spherloc.datasets.scene_file import numbers
from spherloc.errors import InputError, show
from spherloc.estimators.base import versions
from spherloc.files import read_file, reading, size_of
from spherloc.types import FloatArray

MAX_TOLD = 3


def differences(before: Mapping[str, Any], now: Mapping[str, Any], uncompared: Collection[str]) -> dict[str, str]:
    """Phrases such as "seed is 1, was 0" by dotted keys such as "options.bound_px"; absent is the same as None.

    ``uncompared`` are top-level keys that may differ.
    """
    tables = [{key: value for key, value in table.items() if key not in uncompared} for table in (before, now)]
    a, b = (dict(_flat(table)) for table in tables)
    different = [key for key in {**a, **b} if a.get(key) != b.get(key)]
    return {key: f"{key} is {_shown(b, key)}, was {_shown(a, key)}" for key in different}


def in_short(phrases: Sequence[str]) -> str:
    """The first few phrases, and how many more there are."""
    more = len(phrases) - MAX_TOLD
    return "; ".join([*phrases[:MAX_TOLD], *([f"and {more} more"] if more > 0 else [])])


def _flat(table: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{above}{key}.")
        else:
            yield above + key, value


def _shown(table: Mapping[str, Any], key: str) -> str:
    return show(table[key]) if key in table else "absent"


FORMAT = 1
MAX_BYTES = 1_000_000
DIGITS = 6
"""Decimals of a pose that count: of a rotation, and of metres."""
_KINDS = {"scene": str, "scene_sha256": str, "name": str, "estimator": str, "seed": int, "queries": int}
_UNCOMPARED = {"scene"}
"""Keys that may differ: a scene file that was moved or copied is still the same scene."""


@dataclass(frozen=True, eq=False)
class Configuration:
    """The resolved settings of a sequence's run."""

    scene: str
    """Path of the scene file."""
    scene_sha256: str
    """Hash of its content, of the poses of its references, which change with the map, and of what matches are read
    from."""
    name: str
    """The scene's name."""
    estimator: str
    """Registered name of the estimator."""
    options: Mapping[str, Any]
    """The estimator's options, all of them."""
    seed: int
    """Seed of the estimator, the same for every query."""
    versions: Mapping[str, str]
    """Versions of all software that can change a number."""
    queries: int
    """Number of query images in the scene."""
    gravity_map: FloatArray
    """Unit vector (3,) pointing down in the map frame."""
    thresholds: Thresholds
    """Limits of success (degrees, metres), strictest first."""
    registration_thresholds_m: tuple[float, ...] | None
    """Limits of success of the registration error; None if the scene does not judge by it."""
    metric: bool = True
    """Whether the map's lengths are metres; if not, they are its own units."""

    @property
    def unit(self) -> str:
        """Unit of the map's lengths: "m" or "units"."""
        return "m" if self.metric else "units"

    def length(self, metres: float, digits: int = 2) -> str:
        """A length as text: in centimetres, in metres from one on, or in units of the map with three digits."""
        if not self.metric:
            return f"{metres:.3g} {self.unit}"
        return f"{100 * metres:.{digits}f} cm" if metres < 1.0 else f"{metres:.{digits}f} m"

    def json_text(self) -> str:
        """The text of ``configuration.json``; infinity is the text "inf"."""
        return json.dumps({"format": FORMAT} | _plain(self), indent=2, allow_nan=False) + "\n"

    def differences(self, now: "Configuration") -> list[str]:
        """The differences to ``now``, as phrases such as "seed is 1, was 0"."""
        found = differences(_plain(self), _plain(now), _UNCOMPARED)
        # Options of two different estimators cannot be compared.
        told = found | ({"scene_sha256": "the scene file or its map is another one"} if "scene_sha256" in found else {})
        return [said for key, said in told.items() if "estimator" not in found or not key.startswith("options.")]


def configuration_of(
    scene: MapScene, path: Path, estimator: str, options: Any, seed: int, initialiser: str | None = None
) -> Configuration:
    """The configuration of localizing the queries of the scene file ``path``; ``options`` is the resolved dataclass.

    If there is an ``initialiser``, its name and options are stored as one text among the options.

    Raises ``InputError`` if the file, or one that matches are read from, can no longer be read.
    """
    return Configuration(
        scene=str(path),
        scene_sha256=scene_sha256(scene, path),
        name=scene.name,
        estimator=estimator,
        options=asdict(options) | ({} if initialiser is None else {"initialise": initialiser}),
        seed=seed,
        versions={**versions(), "opencv": cv2.__version__},
        queries=len(scene.queries),
        gravity_map=np.asarray(scene.gravity_map, dtype=np.float64),
        thresholds=scene.thresholds,
        registration_thresholds_m=None if scene.registration is None else tuple(scene.registration.thresholds_m),
        metric=scene.metric,
    )


def scene_sha256(scene: MapScene, path: Path) -> str:
    """The hash of the scene of the file ``path`` that a configuration has.

    Raises ``InputError`` if the file, or one that matches are read from, can no longer be read.
    """
    with reading(path, "keep the scene file where it is"):
        content = read_file(path, MAX_BYTES)
    return hashlib.sha256(content + _poses_of(scene) + _sizes_of(scene)).hexdigest()


def _poses_of(scene: MapScene) -> bytes:
    """The poses of the references, rounded, so that another processor finds the same."""
    posed = [view.cam_from_map for view in scene.references if view.cam_from_map is not None]
    return (np.round(np.array(posed, dtype=np.float64), DIGITS) + 0.0).tobytes()


def _sizes_of(scene: MapScene) -> bytes:
    """The sizes of the files that matches are read from."""
    sizes = []
    for file in scene.matched_files:
        with reading(file, "keep it where it is"):
            sizes.append(str(size_of(file)))
    return " ".join(sizes).encode()


def read_configuration(path: Path) -> Configuration:
    """A ``configuration.json``. Raises ``InputError`` if it is missing, unreadable, damaged or of another version."""
    with reading(path, "give the folder of a sequence's results"):
        content = read_file(path, MAX_BYTES)
    try:
        table = json.loads(content.decode("utf-8"))
    except (ValueError, RecursionError):
        raise InputError(f"{path}: is damaged; give another folder and localize the sequence again.") from None
    if isinstance(table, dict) and table.get("format") != FORMAT:
        raise InputError(f"{path}: has the format {show(table.get('format'))}, not {FORMAT}; give another folder.")
    try:
        return _parsed(table, str(path))
    except (KeyError, TypeError, ValueError, AttributeError, InputError):
        raise InputError(f"{path}: is damaged; give another folder and localize the sequence again.") from None


def _parsed(table: Any, where: str) -> Configuration:
    limits = table["thresholds"]
    pairs = numbers(limits, (len(limits), 2), "thresholds", where)
    registration = table["registration_thresholds_m"]
    for key, kind in {
        "scene": str,
        "scene_sha256": str,
        "name": str,
        "estimator": str,
        "seed": int,
        "queries": int,
    }.items():
        if type(table[key]) is not kind:
            raise TypeError(key)
    return Configuration(
        **{key: table[key] for key in _KINDS},
        options={key: math.inf if value == "inf" else value for key, value in table["options"].items()},
        versions={str(key): str(value) for key, value in table["versions"].items()},
        gravity_map=numbers(table["gravity_map"], (3,), "gravity_map", where),
        thresholds=tuple((float(degrees), float(metres)) for degrees, metres in pairs),
        registration_thresholds_m=None
        if registration is None
        else tuple(map(float, numbers(registration, (len(registration),), "registration_thresholds_m", where))),
        metric=table.get("metric", True) is True,
    )


def _plain(configuration: Configuration) -> dict[str, Any]:
    """The configuration as a table of plain JSON values."""
    values = dict(vars(configuration))
    values["options"] = {
        key: "inf" if isinstance(value, float) and math.isinf(value) else value
        for key, value in configuration.options.items()
    }
    values["versions"] = dict(configuration.versions)
    values["gravity_map"] = configuration.gravity_map.tolist()
    values["thresholds"] = [list(pair) for pair in configuration.thresholds]
    if configuration.registration_thresholds_m is not None:
        values["registration_thresholds_m"] = list(configuration.registration_thresholds_m)
    return values
