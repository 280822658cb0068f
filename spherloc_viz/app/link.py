"""The state of a page as text after the "#" of its address, so that a reload or a link brings it back.

The text is a query string, such as ``v=1&scene=street&seed=3&set=outlier_rate%3D0.4&estimator=mc&step=outcome``. It
holds only what differs from the defaults of scene and estimator. It is untrusted, so a scene is named by its label, by
its case of the gallery or by a path in an allowed folder, a camera by its label, and nothing else is read from the
disk.
"""

import json
import math
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, fields, replace
from html import escape
from typing import Any
from urllib.parse import parse_qsl, urlencode

from spherloc.datasets import load_scene
from spherloc.datasets.variation import EDITS, Variation, parse_variation, settings_of
from spherloc.errors import InputError, SpherlocError, show
from spherloc.estimators import default_options, options_type
from spherloc.problem import Problem
from spherloc_viz.app.catalog import Catalog, Run, RunRequest, SceneRequest
from spherloc_viz.app.matches.match_table import NEW_TABLE, TableLook, look_of
from spherloc_viz.app.panels.folders import Roots
from spherloc_viz.app.plots.graph_view import LOOKS
from spherloc_viz.app.review.opened import Opened
from spherloc_viz.layers.withheld import HIDDEN, ONLY_OUTCOME, TOLD
from spherloc_viz.options import option_fields, typed, usable_estimators

VERSION = 1
MAX_LETTERS = 15_000
"""A longer link is not written; one gets so long when some thousand single matches are changed."""
MAX_M, MIN_M = 1e7, 1e-6
"""Largest coordinate of a viewer, and least distance between a viewer and the point that it looks at."""
THEMES = ("dark", "light")
ANSWERS = (TOLD, HIDDEN, ONLY_OUTCOME)
TABS = ("step's", "Yaw", "Graph", "Charts", "Residuals", "Images", "Matches")
"""The tabs of the lower left panel, after the word for the one that goes with the step."""
SIDES = ("Play", "Compare", "Sweep", "Open", "Recordings")
"""The tabs of the panel right of the canvas but for Share, from which links are taken."""
SCENE_KEYS = ("scene", "case", "place")
MAX_NAMED = 5
"""Most matches or estimators that one remark names."""
LISTS = ("spoil", "mend", "hide")
"""Keys of ``EDITS``, in their order."""
ONCE = (
    *("v", "run", "scene", "case", "place", "seed", "query", "camera", *LISTS, "estimator"),
    *("step", "select", "view", "theme", "answers", "tab", "side", "compare", "table", "graph"),
)
MANY = ("set", "option")


@dataclass(frozen=True)
class PageView:
    """How a page shows a run: its step, selection, viewer and what is hidden."""

    step: str
    """Key of the step."""
    selected: tuple[int, ...]
    """Numbers of the selected matches, as they are where nothing is hidden."""
    theme: str
    answers: str = ANSWERS[0]
    """Which answers are told, one of ``ANSWERS``."""
    viewpoint: tuple[float, ...] = ()
    """The viewer's position (3), target (3), and field of view, degrees; empty for the step's own view."""
    tab: str = TABS[0]
    compared: tuple[str, ...] = ()
    """Names of the estimators that are compared on the run's problem."""
    table: TableLook = NEW_TABLE
    """Filter and order of the table of matches."""
    graph: str = LOOKS[0]
    """Look of the graph of balls."""
    side: str = SIDES[0]
    """The tab of the panel right of the canvas."""


def link_of(
    run: Run, view: PageView, catalog: Catalog, known: Iterable[str], roots: Roots, recording: str | None = None
) -> str:
    """The text that brings a run and the view of it back; empty if it would be too long.

    ``known`` are the labels of the scenes that every page has, and ``recording`` is the file in which the run is
    recorded, if it was opened from there.
    """
    request, scene = run.request, run.request.scene
    place = None if scene.scene in known else roots.place(catalog.path(scene.scene))
    variation = scene.variation
    cameras = {path: label for label, path in catalog.cameras.items()}
    default = default_options(request.estimator, run.trace.problem)
    pairs = [
        ("v", str(VERSION)),
        ("run", recording),
        ("scene", scene.scene),
        ("case", catalog.case(scene.scene)),
        ("place", place),
        ("seed", str(scene.seed)),
        ("query", scene.query),
        ("camera", None if variation.camera is None else cameras.get(variation.camera)),
        *(("set", setting) for setting in settings_of(replace(variation, camera=None))),
        *((key, _numbers_text(getattr(variation, name))) for key, name in zip(LISTS, EDITS, strict=True)),
        ("estimator", request.estimator),
        *(("option", f"{name}={typed(value)}") for name, value in _changed(request.options, default)),
        ("step", view.step),
        ("select", _numbers_text(view.selected)),
        ("view", ",".join(f"{number:.6g}" for number in view.viewpoint)),
        ("tab", view.tab if view.tab != TABS[0] else None),
        ("side", view.side if view.side != _usual_side(view.compared) else None),
        ("theme", view.theme if view.theme != THEMES[0] else None),
        ("answers", view.answers if view.answers != ANSWERS[0] else None),
        ("compare", ",".join(view.compared)),
        ("table", view.table.text()),
        ("graph", view.graph if view.graph != LOOKS[0] else None),
    ]
    text = urlencode([(key, value) for key, value in pairs if value])
    return text if len(text) <= MAX_LETTERS else ""


def _changed(options: Any, default: Any) -> list[tuple[str, Any]]:
    names = [item.name for item in fields(options)]
    return [(name, getattr(options, name)) for name in names if getattr(options, name) != getattr(default, name)]


def _numbers_text(numbers: Iterable[int]) -> str:
    """Numbers with commas between them."""
    return ",".join(map(str, numbers))


def address_html(link: str, session: str, followed: int, numbers: Mapping[str, str] | None = None) -> str:
    """Tells the page's script (``link.js``) what to keep as the address, and how many links were followed so far; and
    a lesson around the page the run's ``numbers``, if it has asked for them."""
    told = "" if numbers is None else f' data-numbers="{escape(json.dumps(numbers))}"'
    return f'<div hidden data-address="{escape(link)}" data-session="{session}" data-followed="{followed}"{told}></div>'


@dataclass(frozen=True)
class Followed:
    """What a link asks for, and what of it could not be opened."""

    request: RunRequest | None
    """None for that of the page itself."""
    view: PageView
    remarks: tuple[str, ...]
    """One sentence for each part of the link that could not be opened."""
    opened: Opened | None = None
    """The recording that the link names."""
    step: str | None = None
    """Key of the step that the link itself names."""

    def missing(self, step: str, matches: Collection[int]) -> list[str]:
        """One sentence for each thing that the link names and the run does not have: a step, if ``step`` is shown in
        its place, and selected matches that are not among the numbers ``matches``."""
        remarks = []
        if self.step and self.step.split("-")[0] != step.split("-")[0]:
            remarks.append(f"the run has no step {show(self.step)}; the page shows its outcome.")
        others = [number for number in self.view.selected if number not in matches]
        if others:
            remarks.append(f"the run has no match {_numbers_text(others[:MAX_NAMED])}, which the link selects.")
        return remarks


class Follower:
    """Follows links on one page. Each wrong part of a link becomes a remark, and the page keeps its own value there."""

    def __init__(
        self,
        catalog: Catalog,
        roots: Roots,
        problem: Callable[[SceneRequest], Problem],
        open_recording: Callable[[str], Opened],
    ) -> None:
        """``problem`` gives the problem of a request; it may take long, and raises ``InputError`` if there is none.
        ``open_recording`` opens a file of the run library, and raises ``RecordingError`` if it cannot."""
        self._catalog, self._roots, self._problem, self._open_recording = catalog, roots, problem, open_recording

    def follow(self, text: str, now: RunRequest, view: PageView) -> Followed:
        """Where a link leads from what the page shows ``now``. Raises ``Cancelled`` if the map's work is ended."""
        remarks: list[str] = []
        said = _read(text, remarks)
        opened = self._recorded(said, remarks)
        request = self._request(said, now, remarks) if opened is None else opened.request
        if request is None:
            return Followed(None, view, tuple(remarks))
        return Followed(request, _view(said, view, opened, remarks), tuple(remarks), opened, said.get("step"))

    def _recorded(self, said: dict[str, Any], remarks: list[str]) -> Opened | None:
        """The recording that a link names; if it cannot be opened, the rest of the link is solved."""
        if "run" not in said:
            return None
        try:
            return self._open_recording(said["run"])
        except SpherlocError as error:
            remarks.append(str(error))
            return None

    def _request(self, said: dict[str, Any], now: RunRequest, remarks: list[str]) -> RunRequest | None:
        """What a link asks for; None if it names a recording or scene that cannot be opened, and no other scene: the
        rest of it means nothing for the run that the page shows."""
        if "run" in said and not any(key in said for key in SCENE_KEYS):
            return None
        try:
            label = self._label(said, now.scene.scene)
        except SpherlocError as error:
            remarks.append(str(error))
            return None
        scene = self._scene(said, label, remarks)
        estimator = said.get("estimator", now.estimator)
        if estimator not in usable_estimators():
            remarks.append(f"the estimator {show(estimator)} is unknown.")
            estimator = now.estimator
        try:
            problem = self._problem(scene)
        except InputError as error:
            remarks.append(str(error))
            scene = SceneRequest(scene.scene, scene.seed)
            problem = self._problem(scene)
        options = self._options(said.get("option", ()), default_options(estimator, problem), estimator, remarks)
        return RunRequest(scene, estimator, options)

    def _scene(self, said: dict[str, Any], label: str, remarks: list[str]) -> SceneRequest:
        """The scene of that label with the link's changes."""
        scene = self._catalog.scenes[label]
        seed = said.get("seed", str(getattr(scene, "seed", 0)))
        if not (seed.isascii() and seed.isdigit() and len(seed) < 20 and int(seed) < 2**63):
            remarks.append(f"the seed {show(seed)} is not a whole number from 0 to 2^63 - 1.")
            seed = "0"
        query, images = said.get("query"), self._catalog.map_scene(label)
        try:
            query = None if images is None else images.query(query).name
        except InputError as error:
            remarks.append(str(error))
            query = None
        return SceneRequest(label, int(seed), query, self._variation(said, label, remarks))

    def _label(self, said: dict[str, Any], now: str) -> str:
        if "place" in said:
            path = self._roots.find(said["place"])
            return self._catalog.add(load_scene(path), path)
        if "case" in said:
            return self._catalog.enter_case(said["case"])
        label = said.get("scene", now)
        if label not in self._catalog.scenes:
            raise InputError(f"the scene {show(label)} is not open here; open it in the tab Open.")
        return label

    def _variation(self, said: dict[str, Any], label: str, remarks: list[str]) -> Variation:
        settings = said.get("set", ())
        try:
            if any(setting.startswith("camera=") for setting in settings):
                raise InputError("a link names a camera by its label, not by its file.")
            variation = parse_variation(settings, *(said.get(key) for key in LISTS))
        except InputError as error:
            remarks.append(str(error))
            return Variation()
        if self._catalog.synthetic(label) is None:
            return Variation(spoiled=variation.spoiled, mended=variation.mended, hidden=variation.hidden)
        camera = said.get("camera")
        if camera is not None and camera not in self._catalog.cameras:
            remarks.append(f"the camera {show(camera)} is unknown.")
            camera = None
        return replace(variation, camera=None if camera is None else self._catalog.cameras[camera])

    def _options(self, texts: Iterable[str], default: Any, estimator: str, remarks: list[str]) -> Any:
        known = {item.name: item for item in option_fields(options_type(estimator))}
        try:
            values = {}
            for text in texts:
                name, _, value = text.partition("=")
                if name not in known:
                    raise InputError(f"the estimator {estimator} has no option {show(name)}.")
                values[name] = known[name].parse(value)
            return replace(default, **values)
        except InputError as error:
            remarks.append(str(error))
            return default


def _read(text: str, remarks: list[str]) -> dict[str, Any]:
    """The values of a link by key: a text, or a list of texts for the keys in ``MANY``."""
    said: dict[str, Any] = {}
    try:
        pairs = parse_qsl(text, keep_blank_values=True, max_num_fields=200, errors="strict")
    except ValueError:
        remarks.append("the link is damaged.")
        return said
    for key, value in pairs:
        if key in MANY:
            said.setdefault(key, []).append(value)
        elif key in ONCE and key not in said:
            said[key] = value
        else:
            remarks.append(f"the link says {show(key)}, which this version does not know.")
    version = said.get("v", str(VERSION))
    if version != str(VERSION):
        remarks.insert(0, f"the link is of version {show(version)}, and this is version {VERSION}.")
    return said


def _view(said: dict[str, Any], view: PageView, opened: Opened | None, remarks: list[str]) -> PageView:
    """The view that a link asks for; a recording without a step opens at its key step."""
    theme = _one_of(said, "theme", THEMES, remarks)
    answers = _one_of(said, "answers", ANSWERS, remarks)
    selected: tuple[int, ...] = ()
    viewpoint: tuple[float, ...] = ()
    try:
        selected = _numbers(said.get("select", ""))
    except InputError as error:
        remarks.append(str(error))
    try:
        viewpoint = _viewpoint(said.get("view", ""))
    except InputError as error:
        remarks.append(str(error))
    step = said.get("step", view.step if opened is None else "")
    tab = _one_of(said, "tab", TABS, remarks)
    table = NEW_TABLE
    try:
        table = look_of(said.get("table", ""))
    except InputError as error:
        remarks.append(str(error))
    graph = _one_of(said, "graph", LOOKS, remarks)
    compared = _compared(said.get("compare", ""), remarks)
    side = _one_of(said, "side", SIDES, remarks) if "side" in said else _usual_side(compared)
    return PageView(step, selected, theme, answers, viewpoint, tab, compared, table, graph, side)


def _usual_side(compared: tuple[str, ...]) -> str:
    """The tab right of the canvas where a link names none."""
    return "Compare" if compared else SIDES[0]


def _compared(text: str, remarks: list[str]) -> tuple[str, ...]:
    """The names of a list that are estimators."""
    known, names = usable_estimators(), dict.fromkeys(text.split(",") if text else ())
    unknown = [show(name) for name in names if name not in known][:MAX_NAMED]
    if unknown:
        remarks.append(f"the estimator {' or '.join(unknown)} is unknown, so it is not compared.")
    return tuple(name for name in names if name in known)


def _viewpoint(text: str) -> tuple[float, ...]:
    """Where a viewer stands, what it looks at, and its field of view."""
    if not text:
        return ()
    try:
        numbers = tuple(map(float, text.split(",")))
    except ValueError:
        numbers = ()
    sensible = len(numbers) == 7 and all(abs(number) < MAX_M for number in numbers) and 1.0 <= numbers[6] <= 170.0
    if not sensible or math.dist(numbers[:3], numbers[3:6]) < MIN_M:
        raise InputError(
            f"view is {show(text)}; give a place, what is looked at, and a field of view from 1 to 170 degrees: seven "
            "numbers with commas between them."
        )
    return numbers


def _one_of(said: dict[str, Any], key: str, words: tuple[str, ...], remarks: list[str]) -> str:
    """The value of a key that takes one of ``words``; without it, the first of them."""
    word = said.get(key, words[0])
    if word not in words:
        known = [known for known in words if known != TABS[0]]
        remarks.append(f"{key} is {show(word)}; give {', '.join(known[:-1])} or {known[-1]}.")
        return words[0]
    return word


def _numbers(text: str) -> tuple[int, ...]:
    words = text.split(",") if text else []
    if not all(word.isascii() and word.isdigit() and len(word) < 10 for word in words):
        raise InputError(f"select is {show(text)}; give the numbers of matches with commas between them, such as 3,5.")
    return tuple(map(int, words))
