"""The section [frontend] of a scene file."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from spherloc.errors import InputError, show
from spherloc.files import is_file
from spherloc.frontend.features import FeatureOptions
from spherloc.frontend.matching import MatchOptions

MOST_REFERENCES = 100

_FEATURE_KEYS = {"features": "method", "max_features": "max_features", "feature_weights": "weights"}
_MATCH_KEYS = {"matching": "method", "ratio": "ratio", "matching_weights": "weights"}


@dataclass(frozen=True)
class FrontendOptions:
    """How correspondences are found."""

    features: FeatureOptions = field(default_factory=FeatureOptions)
    """``features``, ``max_features`` and ``feature_weights``."""
    matching: MatchOptions = field(default_factory=MatchOptions)
    """``matching``, ``ratio`` and ``matching_weights``."""
    references: int = 4
    """How many references, the most similar ones, are matched with a query."""


def frontend_options(table: Mapping[str, Any], where: str, folder: Path) -> FrontendOptions:
    """The options in a section [frontend]; files of weights are relative to ``folder``.

    Raises ``InputError`` for an unknown key, a wrong value or a missing file.
    """
    place = f"{where} [frontend]"
    known = [*_FEATURE_KEYS, *_MATCH_KEYS, "references"]
    for key in table:
        if key not in known:
            raise InputError(f"{place}: unknown key {show(key)}; the known ones are {', '.join(sorted(known))}.")
    values = dict(table)
    for key in ("feature_weights", "matching_weights"):
        if key in values:
            values[key] = _weights(folder, key, values[key], place)
    if values.get("matching") == "lightglue" and "ratio" in values:
        raise InputError(f"{place}: LightGlue has no ratio; remove that key.")
    try:
        features = FeatureOptions(**{own: values[key] for key, own in _FEATURE_KEYS.items() if key in values})
        matching = MatchOptions(**{own: values[key] for key, own in _MATCH_KEYS.items() if key in values})
    except InputError as error:
        raise InputError(f"{place}: {error}") from None
    count = values.get("references", FrontendOptions.references)
    if isinstance(count, bool) or not isinstance(count, int) or not 1 <= count <= MOST_REFERENCES:
        raise InputError(f"{place}: references is {show(count)}; give a whole number from 1 to {MOST_REFERENCES}.")
    return FrontendOptions(features, matching, count)


def _weights(folder: Path, key: str, value: Any, place: str) -> Path:
    if not isinstance(value, str) or not value or "\0" in value:
        raise InputError(f"{place}: {key} is {show(value)}; give the path of an ONNX file.")
    path = folder / value
    if not is_file(path):
        raise InputError(f"{place}: {key} names {path}, which is no file; correct the path.")
    return path
