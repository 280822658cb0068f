"""The widgets that choose a scene and change it."""

from collections.abc import Callable

import viser

from spherloc.datasets.variation import Variation
from spherloc.errors import InputError
from spherloc_viz.app.catalog import Catalog, SceneWish

OWN_CAMERA = "the scene's own"
MOST_POINTS, MOST_NOISE_PX, MOST_OUTLIERS, MOST_GRAVITY_DEG = 500, 10.0, 99.0, 2.0


class SceneControls:
    """Scene, query image, camera, number of points, noise, outliers, gravity error and seed."""

    def __init__(self, gui: viser.GuiApi, catalog: Catalog, changed: Callable[[object], None]) -> None:
        self._catalog = catalog
        self._scene = gui.add_dropdown("Scene", tuple(catalog.scenes))
        queries: list[str] = ["-"]
        self._query = gui.add_dropdown("Query", queries, visible=False, hint="The image to localize in the map.")
        self._camera = gui.add_dropdown(
            "Camera", (OWN_CAMERA, *catalog.cameras), hint="Sees the same simulation through another lens."
        )
        self._points = gui.add_slider("Points", 10, MOST_POINTS, 1, 100, hint="Correspondences, N.")
        self._noise = gui.add_slider("Noise (px)", 0.0, MOST_NOISE_PX, 0.1, 1.0, hint="Standard deviation of a pixel.")
        self._outliers = gui.add_slider("Outliers (%)", 0.0, MOST_OUTLIERS, 1.0, 80.0, hint="Share of wrong matches.")
        self._gravity = gui.add_slider(
            "Gravity error (deg)",
            0.0,
            MOST_GRAVITY_DEG,
            0.05,
            0.0,
            hint="Standard deviation of the error of the known roll and pitch; the problem states it.",
        )
        self._seed = gui.add_text("Seed", "0", hint="Of the simulation and of the estimator's random draws.")
        self._simulated = (self._camera, self._points, self._noise, self._outliers, self._gravity)
        self._followed = ""
        for widget in self.widgets:
            widget.on_update(changed)

    @property
    def widgets(self) -> tuple:
        """All of them."""
        return (self._scene, self._query, *self._simulated, self._seed)

    def follow_scene(self) -> bool:
        """If another scene was chosen, set the other widgets to what it says, and tell so."""
        label = self._scene.value
        if label == self._followed:
            return False
        self._followed = label
        scene = self._catalog.synthetic(label)
        for widget in self._simulated:
            widget.visible = scene is not None
        images = self._catalog.map_scene(label)
        self._query.visible = images is not None
        if images is not None:
            self._query.options = tuple(view.name for view in images.queries)
            self._query.value = self._query.options[0]
        if scene is None:
            return True
        self._camera.value = OWN_CAMERA
        self._points.min, self._points.max = min(10, scene.correspondences), max(MOST_POINTS, scene.correspondences)
        self._points.value = scene.correspondences
        self._noise.max = max(MOST_NOISE_PX, scene.noise_px)
        self._noise.value = float(scene.noise_px)
        percent = round(100.0 * scene.outlier_rate, 6)
        self._outliers.max = max(MOST_OUTLIERS, percent)
        self._outliers.value = percent
        self._gravity.max = max(MOST_GRAVITY_DEG, scene.gravity_error_deg)
        self._gravity.value = float(scene.gravity_error_deg)
        self._seed.value = str(scene.seed)
        return True

    def read(self) -> SceneWish:
        """What the widgets say now.

        Raises ``InputError`` if the seed is no seed.
        """
        label, seed = self._scene.value, self._read_seed()
        if self._catalog.map_scene(label) is not None:
            return SceneWish(label, seed, self._query.value)
        if self._catalog.synthetic(label) is None:
            return SceneWish(label, seed)
        changes = {
            "correspondences": int(self._points.value),
            "noise_px": float(self._noise.value),
            "outlier_rate": round(self._outliers.value / 100.0, 8),
            "gravity_error_deg": float(self._gravity.value),
        }
        scene = self._catalog.synthetic(label)
        changed: dict = {name: value for name, value in changes.items() if value != getattr(scene, name)}
        return SceneWish(label, seed, None, Variation(camera=self._catalog.cameras.get(self._camera.value), **changed))

    def next_seed(self) -> None:
        """The next seed; 0 after what is no seed."""
        try:
            self._seed.value = str((self._read_seed() + 1) % 2**63)
        except InputError:
            self._seed.value = "0"

    def _read_seed(self) -> int:
        text = self._seed.value.strip()
        if not (text.isascii() and text.isdigit() and len(text) <= 19 and int(text) < 2**63):
            raise InputError(f"the seed '{text[:30]}' is no whole number from 0 to 2^63 - 1; type one.")
        return int(text)
