"""The widgets that choose a scene and change it."""

import threading
from collections.abc import Callable
from typing import Any

import viser

from spherloc.datasets.map_scene import MapScene
from spherloc.datasets.synthetic import TrueCamera
from spherloc.datasets.variation import Variation
from spherloc.errors import InputError
from spherloc_viz.app.catalog import Catalog, SceneRequest
from spherloc_viz.app.controls.simulation_controls import SimulationControls
from spherloc_viz.app.text import box
from spherloc_viz.app.web.viser_internals import at_once, number_of, put

CHANGED = "Changed from {}"
"""What the list of scenes calls the scene at hand while its simulation is not as its file has it."""
LISTED_QUERIES = 50
"""A page with thousands of entries in a dropdown is slow; of more, those that fit a filter are listed."""

Changed = Callable[[Any], None]


class SceneControls:
    """Scene, query image, what is changed about a simulation, and seed. Changes to single matches are kept elsewhere.

    Everything can be read and written as a ``SceneRequest``. ``changed`` is called with viser's event.
    """

    def __init__(self, gui: viser.GuiApi, catalog: Catalog, changed: Changed) -> None:
        self._catalog = catalog
        self._followed = ""
        self._naming = threading.Lock()
        self._chosen = False
        """Whether a scene was chosen by hand since the last one was followed, be it the same again."""
        self._scene = gui.add_dropdown("Scene", tuple(catalog.scenes))
        self._find = gui.add_text("Find query", "", visible=False, hint="Part of the name of a query image.")
        self._found = gui.add_html("", visible=False)
        nothing: list[str] = ["-"]
        self._query = gui.add_dropdown("Query", nothing, visible=False, hint="The image to localize in the map.")
        self._simulation = SimulationControls(gui, catalog.cameras, changed)
        self._seed = gui.add_text("Seed", "0", hint="Of the simulation and of the estimator's random draws.")
        self._find.on_update(self._filter)
        self._scene.on_update(self._choose)
        for widget in (self._scene, self._query, self._seed):
            widget.on_update(changed)

    @property
    def reset(self) -> viser.GuiButtonGroupHandle:
        """The button that sets everything to the values of the scene file."""
        return self._simulation.reset

    def follow_scene(self) -> bool:
        """If a scene was chosen, set the other widgets to its values; returns whether that was so."""
        label, chosen = self._label(), self._chosen
        if label == self._followed and not chosen:
            return False
        self._chosen = False
        self.write(SceneRequest(label, getattr(self._catalog.scenes[label], "seed", self._read_seed(0))))
        return True

    @property
    def chosen_at(self) -> int:
        """The number of the change that chose the scene."""
        return number_of(self._scene)

    def read(self) -> SceneRequest:
        """What the widgets say now, with all matches as they are.

        Raises ``InputError`` if the seed is not a valid number.
        """
        label, seed = self._label(), self._read_seed()
        if self._catalog.map_scene(label) is not None:
            return SceneRequest(label, seed, self._query.value)
        return SceneRequest(label, seed, None, self._variation(label))

    def read_unchanged(self) -> SceneRequest:
        """The scene and the query that the widgets say, with everything else as the scene has it."""
        label = self._label()
        query = None if self._catalog.map_scene(label) is None else self._query.value
        return SceneRequest(label, getattr(self._catalog.scenes[label], "seed", 0), query)

    def write(self, request: SceneRequest) -> bool:
        """Set the widgets to what a request says but for changes to single matches; tells whether the scene is another.

        Raises ``InputError`` if the catalog does not have the scene, or the scene not the query.
        """
        if request.scene not in self._catalog.scenes:
            raise InputError(f"the scene '{request.scene}' is not open on this page; open it first.")
        another = request.scene != self._followed
        with self._naming:
            self._followed = request.scene
            self._name_scene(request)
        images = self._catalog.map_scene(request.scene)
        if images is not None:
            self._write_query(images, request.query)
        self._simulation.write(self._catalog.synthetic(request.scene), request.variation)
        self.offer(True)
        put(self._seed, str(request.seed))
        return another

    @property
    def at_hand(self) -> str:
        """The label of the scene of which the other widgets tell."""
        return self._followed

    def offer(self, offered: bool) -> None:
        """Show the widgets that the scene at hand has, or hide all that belong to it; what they say stays."""
        images = self._catalog.map_scene(self._followed) if offered else None
        self._query.visible = images is not None
        self._find.visible = self._found.visible = images is not None and len(images.queries) > LISTED_QUERIES
        self._simulation.offer(offered and self._catalog.synthetic(self._followed) is not None)

    def name_scene(self, request: SceneRequest) -> None:
        """Show whether the scene at hand is as its name says, by the request of a run of it; nothing for a run of
        another scene."""
        with self._naming:
            if request.scene == self._followed:
                self._name_scene(request)

    def _name_scene(self, request: SceneRequest) -> None:
        """Offer the scenes that the catalog has now, and show which one a request is of. Its name tells, for example,
        a rate of outliers, so that a changed simulation has another name."""
        labels, shown = tuple(self._catalog.scenes), request.scene
        scene = self._catalog.synthetic(request.scene)
        if any(value != getattr(scene, name) for name, value in request.variation.simulation.items()):
            shown = CHANGED.format(request.scene)
            labels = (shown, *labels)
        # What is shown is on offer at any time.
        for offered in (tuple(dict.fromkeys((*labels, self._scene.value))), labels):
            if offered != tuple(self._scene.options) and self._scene.value in offered:
                self._scene.options = offered
            if self._scene.value != shown:
                put(self._scene, shown)

    @property
    def true_camera(self) -> TrueCamera | None:
        """Where the true camera was moved to: yaw (deg) and position (m) in the map frame; None if it was not."""
        return self._simulation.true_camera

    @true_camera.setter
    def true_camera(self, placed: TrueCamera | None) -> None:
        self._simulation.true_camera = placed

    def next_seed(self) -> None:
        """The next seed; 0 after what is no seed."""
        put(self._seed, str((self._read_seed(-1) + 1) % 2**63))

    def _variation(self, label: str) -> Variation:
        scene = self._catalog.synthetic(label)
        # A scene that was just chosen is still shown with the numbers of the one before.
        return Variation() if scene is None or label != self._followed else self._simulation.read(scene)

    def _write_query(self, images: MapScene, query: str | None) -> None:
        name = images.query(query).name
        put(self._find, "")
        self._list_queries(images, name)
        put(self._query, name)

    def _list_queries(self, images: MapScene, chosen: str) -> None:
        """Offer the queries that fit the filter, and the chosen one."""
        wanted = self._find.value.strip().lower()
        names = [view.name for view in images.queries if wanted in view.name.lower()]
        listed = names[:LISTED_QUERIES]
        if chosen not in listed:
            listed = [chosen, *listed]
        if tuple(listed) != tuple(self._query.options):
            self._query.options = tuple(listed)
        self._found.content = box(
            f"{min(len(names), LISTED_QUERIES):,} of {len(images.queries):,} queries are listed"
            + (f"; {len(names):,} fit." if wanted else "; type part of a name to find others."),
            "font-size:12px;opacity:.65",
        )

    def _filter(self, event: Any) -> None:
        images = self._catalog.map_scene(self._label())
        if images is not None and event.client is not None:
            self._list_queries(images, self._query.value)

    def _label(self) -> str:
        """The label of the scene that the list shows."""
        shown = self._scene.value
        return shown if shown in self._catalog.scenes else self._followed

    @at_once
    def _choose(self, event: Any) -> None:
        self._chosen |= event.client is not None and event.target.value in self._catalog.scenes

    def _read_seed(self, otherwise: int | None = None) -> int:
        text = self._seed.value.strip()
        if text.isascii() and text.isdigit() and len(text) <= 19 and int(text) < 2**63:
            return int(text)
        if otherwise is not None:
            return otherwise
        raise InputError(f"the seed '{text[:30]}' is not a whole number from 0 to 2^63 - 1; type one.")
