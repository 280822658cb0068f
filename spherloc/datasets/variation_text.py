"""A variation as people type it: KEY=VALUE for the simulation, and lists of numbers for matches."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from spherloc.datasets.outliers import OUTLIER_KINDS
from spherloc.datasets.variation import Variation
from spherloc.errors import InputError, show

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
