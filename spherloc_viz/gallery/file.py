"""Reads ``gallery.toml``: strictly, since a misspelt key would be ignored and its claim not checked."""

import re
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from spherloc.datasets import bundled_scenes, load_scene, scene_file
from spherloc.datasets.scene_file import check_keys, integer, text
from spherloc.datasets.staged import CUBE, Group, StagedScene
from spherloc.datasets.synthetic import SyntheticScene
from spherloc.datasets.variation import EDITS, Variation, parse_variation
from spherloc.diagnosis import Cause
from spherloc.errors import InputError, show
from spherloc.estimators import options_type
from spherloc.files import is_file
from spherloc_viz.gallery.case import MEASURES, Beside, GalleryCase, Play
from spherloc_viz.options import option_fields

_INSTALLED = Path(__file__).resolve().parent / "gallery.toml"
GALLERY = _INSTALLED if _INSTALLED.is_file() else Path(__file__).resolve().parents[2] / "recordings" / "gallery.toml"
"""An installation has it inside of this package, a checkout in its folder of recordings."""
FAILURES = ("position", "rotation", "no pose")
MAX_SEED = 2**63 - 1
PLAY_KEYS = {"scene", "query", "variation", "staged", "seed", "estimator", "options", "facts"}
STAGED_NUMBERS = {"noise_px", "gravity_off_deg", "gravity_bound_deg", "focal_off"}
_KEY = re.compile(r"[a-z0-9]+(-[a-z0-9]+)*")


@lru_cache(maxsize=4)
def gallery_cases(path: Path = GALLERY) -> tuple[GalleryCase, ...]:
    """The cases of the gallery, in its order; nothing is run or rendered.

    Raises ``InputError``, in one sentence, for a file that is missing or says something that is not understood.
    """
    if not is_file(path):
        raise InputError(f"{path}: the file of the gallery is missing; install spherloc again, or restore the file.")
    return parse_gallery(scene_file.read_table(path), path)


def play_of(name: str) -> tuple[GalleryCase, Play]:
    """A case by its key, with its run, or with the run beside it of that number where the name is "KEY_NUMBER".

    Raises ``InputError`` if there is none.
    """
    key = name.partition("_")[0]
    case = next((case for case in gallery_cases() if case.key == key), None)
    plays: dict[str, Play] = {}
    if case is not None:
        plays.update({key: case}, **{f"{key}_{place}": one for place, one in enumerate(case.beside)})
    if case is None or name not in plays:
        raise InputError(f"the gallery has no case {show(name)}; spherloc gallery --list has them all.")
    return case, plays[name]


def staged_path(name: str) -> Path:
    """What stands for the file of a staged scene of the gallery, by the name of its case as in ``play_of``."""
    return GALLERY.with_name("gallery") / f"{name}.rrd"


def parse_gallery(table: Mapping[str, Any], path: Path) -> tuple[GalleryCase, ...]:
    """The cases that the keys of a gallery's file describe; raises as ``gallery_cases`` does."""
    check_keys(table, {"case"}, set(), str(path))
    tables = table["case"]
    if not isinstance(tables, list) or not all(isinstance(item, dict) for item in tables):
        raise InputError(f"{path}: 'case' must be a list of sections [[case]].")
    cases: dict[str, GalleryCase] = {}
    for item in tables:
        key = text(item, "key", str(path))
        where = f"{path}, case {show(key)}"
        if not _KEY.fullmatch(key) or key in cases:
            raise InputError(f"{where}: a key has small letters, digits and single dashes, and is there once only.")
        try:
            cases[key] = _case(item, where)
        except InputError as error:
            inside = str(error)
            raise InputError(inside if inside.startswith(str(path)) else f"{where}: {inside}") from None
    return tuple(cases.values())


def _case(table: dict[str, Any], where: str) -> GalleryCase:
    required = {"key", "title", "story", "cause", "fails", "step", "estimator"}
    check_keys(table, required, PLAY_KEYS | {"beside", "quoted", "without_truth"}, where)
    play = _play(table, None, where)
    fails = table["fails"]
    if not isinstance(fails, list) or not fails or not all(word in FAILURES for word in fails):
        raise InputError(f"{where}: fails is {show(fails)}; give a list of {', '.join(FAILURES)}.")
    besides = table.get("beside", [])
    if not isinstance(besides, list) or not all(isinstance(item, dict) for item in besides):
        raise InputError(f"{where}: 'beside' must be a list of sections [[case.beside]].")
    found = tuple(_beside(item, play, f"{where}, beside") for item in besides)
    if len({item.name for item in found}) < len(found):
        raise InputError(f"{where}: two runs beside have the same name; name each differently.")
    return GalleryCase(
        **vars_of(play),
        key=text(table, "key", where),
        title=text(table, "title", where),
        story=" ".join(text(table, "story", where).split()),
        cause=_cause(table, "cause", where),
        without_truth=_cause(table, "without_truth", where) if "without_truth" in table else None,
        fails=tuple(fails),
        step=text(table, "step", where),
        quoted=_quoted(table.get("quoted", []), where),
        beside=found,
    )


def _cause(table: Mapping[str, Any], key: str, where: str) -> Cause:
    cause = text(table, key, where)
    if cause not in list(Cause):
        raise InputError(f"{where}: {key} is {show(cause)}; give one of {', '.join(Cause)}.")
    return Cause(cause)


def _beside(table: dict[str, Any], of: Play, where: str) -> Beside:
    """A run beside: what it does not say is as in the case itself, but for the options of another estimator."""
    changeable = PLAY_KEYS - {"scene", "query"}
    check_keys(table, {"name", "succeeds"}, changeable | {"recorded"}, where)
    for key in ("succeeds", "recorded"):
        if not isinstance(table.get(key, False), bool):
            raise InputError(f"{where}: {key} is {show(table[key])}; give true or false.")
    if "seed" in table and of.staged is None:
        raise InputError(f"{where}: another seed is another problem here; stage the problem to change the seed alone.")
    play = _play(table, of, where)
    recorded = table.get("recorded", False)
    return Beside(**vars_of(play), name=text(table, "name", where), succeeds=table["succeeds"], recorded=recorded)


def vars_of(play: Play) -> dict[str, Any]:
    """The fields of a play."""
    return {name: getattr(play, name) for name in Play.__dataclass_fields__}


def _play(table: dict[str, Any], of: Play | None, where: str) -> Play:
    """The run that a table describes, as changes to another one if there is one."""
    if of is None and ("scene" in table) == ("staged" in table):
        raise InputError(f"{where}: give either 'scene', the name of a bundled scene, or 'staged'.")
    if "staged" in table and "variation" in table:
        raise InputError(f"{where}: a staged problem has no variation; change what is staged.")
    estimator = text(table, "estimator", where) if of is None or "estimator" in table else of.estimator
    same = of is not None and estimator == of.estimator
    query = text(table, "query", where) if "query" in table else None
    variation = _variation(scene_file.section(table, "variation", where))
    return Play(
        scene_path=of.scene_path if of is not None else _scene(table, where),
        staged=_staged(table, None if of is None else of.staged, where),
        query=query if of is None else of.query,
        variation=variation if of is None else replace(of.variation, **_changes(variation)),
        seed=integer(table, "seed", where, 0, MAX_SEED) if "seed" in table else 0 if of is None else of.seed,
        estimator=estimator,
        options=_options(estimator, scene_file.section(table, "options", where), of.options if same and of else None),
        facts=_facts(scene_file.section(table, "facts", where), where),
    )


def _changes(variation: Variation) -> dict[str, Any]:
    """What a variation says, by field."""
    edits = {name: getattr(variation, name) for name in EDITS}
    return variation.simulation | {name: value for name, value in edits.items() if value}


def _bundled(name: str, where: str) -> Path:
    scenes = bundled_scenes()
    if name not in scenes:
        raise InputError(f"{where}: no bundled scene {show(name)}; there are {', '.join(scenes)}.")
    return scenes[name]


def _scene(table: Mapping[str, Any], where: str) -> Path | None:
    return _bundled(text(table, "scene", where), where) if "scene" in table else None


def _variation(table: Mapping[str, Any]) -> Variation:
    settings = [f"{key}={_typed(value)}" for key, value in table.items() if key not in EDITS]
    variation = parse_variation(settings, *(_typed(table[name]) if name in table else None for name in EDITS))
    if variation.camera is None:
        return variation
    return replace(variation, camera=str(_bundled(variation.camera, "[variation] camera")))


def _typed(value: Any) -> str:
    """A value as people type it."""
    if isinstance(value, list):
        return ",".join(map(_typed, value))
    return str(value).lower() if isinstance(value, bool) else str(value)


def _options(estimator: str, table: Mapping[str, Any], base: Any) -> Any:
    """The estimator's options with those of the table; ``base`` are the others, None for the defaults."""
    kind = options_type(estimator)
    known = {item.name: item for item in option_fields(kind)}
    for key in table:
        if key not in known:
            raise InputError(f"option {show(key)} is unknown to {estimator}; it has {', '.join(known)}.")
    given = {key: known[key].parse(_typed(value)) for key, value in table.items()}
    return kind(**given) if base is None else replace(base, **given)


def _staged(table: Mapping[str, Any], base: StagedScene | None, where: str) -> StagedScene | None:
    if "staged" not in table:
        return base
    staged, place = scene_file.section(table, "staged", where), f"{where} [staged]"
    given: dict[str, Any] = {}
    if base is None:
        check_keys(staged, {"camera", "groups"}, STAGED_NUMBERS | {"seed"}, place)
        given["name"] = text(table, "title", where)
    else:
        check_keys(staged, set(), STAGED_NUMBERS | {"camera", "groups"}, place)
    if "camera" in staged:
        name = text(staged, "camera", place)
        simulation = load_scene(_bundled(name, place))
        if not isinstance(simulation, SyntheticScene):
            raise InputError(f"{place}: camera is that of a simulation, and {show(name)} is none; name another scene.")
        given["camera"] = simulation.camera
    if "groups" in staged:
        given["groups"] = _groups(staged["groups"], place)
    if "seed" in staged:
        given["seed"] = integer(staged, "seed", place, 0, MAX_SEED)
    given |= {key: scene_file.number(staged, key, place, -1e3, 1e3) for key in STAGED_NUMBERS & staged.keys()}
    return StagedScene(**given) if base is None else replace(base, **given)


def _groups(value: Any, where: str) -> tuple[Group, ...]:
    """[[how many, which kind], ...] or [[how many, which kind, where], ...]."""
    rows = value if isinstance(value, list) else []
    right = [isinstance(row, list) and [type(part) for part in row] in ([int, str], [int, str, str]) for row in rows]
    if not rows or not all(right):
        raise InputError(f'{where}: groups must be a list such as [[40, "right"], [60, "random"]].')
    return tuple(Group(row[1], row[0], row[2] if len(row) > 2 else CUBE) for row in rows)


def _quoted(value: Any, where: str) -> tuple[float, ...]:
    if not isinstance(value, list):
        raise InputError(f"{where}: quoted is {show(value)}; give a list of numbers.")
    return tuple(scene_file.numbers(value, (len(value),), "quoted", where).tolist())


def _facts(table: Mapping[str, Any], where: str) -> dict[str, float]:
    for key, value in table.items():
        if key not in MEASURES:
            raise InputError(f"{where}: there is no fact {show(key)}; there are {', '.join(MEASURES)}.")
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise InputError(f"{where}: fact {show(key)} is {show(value)}; give a number.")
    return dict(table)
