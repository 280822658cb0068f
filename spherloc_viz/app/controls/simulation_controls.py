"""The widgets that change a simulation."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import viser

from spherloc.datasets.synthetic import LIMITS, SyntheticScene, TrueCamera
from spherloc.datasets.variation import Variation
from spherloc_viz.app.text import box
from spherloc_viz.app.web.viser_internals import changes_of, put
from spherloc_viz.layers.primitives import true_minus

OWN_CAMERA = "the scene's own"
RANGES: Mapping[str, int] = {"to 500": 500, "to 5,000": 5000}
MIN_POINTS = 10
MAX_NOISE_PX, MAX_OUTLIERS, MAX_GRAVITY_DEG = 10.0, 99.0, 3.0
KINDS: Mapping[str, str] = {
    "random": "random",
    "coherent: one wrong pose": "coherent",
    "repeated structure": "repeated",
}
"""What kinds of outliers are called."""
TRUE_CAMERA = "true camera"
"""What stands for it among what is changed."""
SIMULATED = (
    "correspondences",
    "noise_px",
    "outlier_rate",
    "outlier_kind",
    "field_of_view_deg",
    "cloud_height_m",
    "gravity_error_deg",
)
"""Fields of a synthetic scene and of a variation that widgets show."""


class SimulationControls:
    """Points, noise and outliers, and in a folder what is changed less often."""

    def __init__(self, gui: viser.GuiApi, cameras: Mapping[str, str], changed: Callable[[Any], None]) -> None:
        """``cameras`` are paths of scene files by a label of their camera."""
        self._cameras = dict(cameras)
        self._changed = changed
        self._changes = changes_of(gui)
        self._true_camera: TrueCamera | None = None
        self._rate = (80.0, 0.8)
        """What the slider shows, and the rate that it means, which may have more digits."""
        self._points = gui.add_slider("Points", MIN_POINTS, 500, 1, 100, hint="Correspondences, N.")
        self._noise = gui.add_slider("Noise (px)", 0.0, MAX_NOISE_PX, 0.1, 1.0, hint="Standard deviation of a pixel.")
        self._outliers = gui.add_slider("Outliers (%)", 0.0, MAX_OUTLIERS, 1.0, 80.0, hint="Share of wrong matches.")
        self._kind = gui.add_dropdown(
            "Wrong matches", tuple(KINDS), hint="Each by chance, all as another camera saw them, or copies of a facade."
        )
        self._folder = gui.add_folder("More of the scene", expand_by_default=False)
        with self._folder:
            self._camera = gui.add_dropdown(
                "Camera", (OWN_CAMERA, *self._cameras), hint="Sees the same simulation through another lens."
            )
            self._view = gui.add_slider(
                "Field of view (deg)", *LIMITS["field_of_view_deg"], 5.0, 360.0, hint="Matches outside it are replaced."
            )
            self._height = gui.add_slider(
                "Height (m)",
                *LIMITS["cloud_height_m"],
                0.1,
                10.0,
                hint="Of the cloud of points. Near 0 all are as high as the drawn camera.",
            )
            self._gravity = gui.add_slider(
                "Gravity error (deg)",
                0.0,
                MAX_GRAVITY_DEG,
                0.05,
                0.0,
                hint="Standard deviation of the error of the known roll and pitch; the problem states it.",
            )
            self._range = gui.add_dropdown("Points slider", tuple(RANGES), hint="How far the slider of points goes.")
            self._moved = gui.add_html("", visible=False)
            self._home = gui.add_button_group("", ("Put the camera back",), visible=False)
            self.reset = gui.add_button_group("", ("Reset to the scene",), hint="As its file has it.")
        for widget in self.widgets:
            widget.on_update(changed)
        self._range.on_update(self._rescale)
        self._home.on_click(self._put_back)

    @property
    def widgets(self) -> tuple:
        """All that hold a value."""
        return (
            self._points,
            self._noise,
            self._outliers,
            self._kind,
            self._camera,
            self._view,
            self._height,
            self._gravity,
            self._range,
        )

    @property
    def true_camera(self) -> TrueCamera | None:
        """Yaw (deg) and position (m) that the true camera was moved to, if it was."""
        return self._true_camera

    @true_camera.setter
    def true_camera(self, placed: TrueCamera | None) -> None:
        with self._changes.writing(TRUE_CAMERA):
            self._show_true_camera(placed)

    def _show_true_camera(self, placed: TrueCamera | None) -> None:
        self._true_camera = placed
        self._moved.visible = self._home.visible = placed is not None
        if placed is not None:
            yaw_deg, x, y, z = placed
            words = f"The true camera was moved: yaw {yaw_deg:.1f}°, at ({x:.2f}, {y:.2f}, {z:.2f}) m."
            self._moved.content = box(true_minus(words), "font-size:12px")

    def read(self, scene: SyntheticScene) -> Variation:
        """What is changed about the scene; values that equal the scene's are left out."""
        shown, rate = self._rate
        percent = float(self._outliers.value)
        values: dict[str, Any] = {
            "correspondences": int(self._points.value),
            "noise_px": float(self._noise.value),
            "outlier_rate": rate if percent == shown else round(percent / 100.0, 8),
            "outlier_kind": KINDS[self._kind.value],
            "field_of_view_deg": float(self._view.value),
            "cloud_height_m": float(self._height.value),
            "gravity_error_deg": float(self._gravity.value),
        }
        changes = {name: value for name, value in values.items() if value != getattr(scene, name)}
        camera = self._cameras.get(self._camera.value)
        return Variation(camera=camera, true_camera=self._true_camera, **changes)

    def offer(self, offered: bool) -> None:
        """Show the widgets, or hide them; what they say stays."""
        for widget in (self._folder, self._points, self._noise, self._outliers, self._kind):
            widget.visible = offered

    def write(self, scene: SyntheticScene | None, variation: Variation) -> None:
        """Show the settings of a scene with a variation; none for a scene that is not a simulation."""
        self.offer(scene is not None)
        with self._changes.writing(TRUE_CAMERA) as number:
            if number is not None:
                self._show_true_camera(variation.true_camera)
        if scene is None:
            return
        values = {name: getattr(scene, name) for name in SIMULATED}
        values |= {name: value for name, value in variation.simulation.items() if name in values}
        self._write_points(values["correspondences"])
        self._rate = (round(100.0 * values["outlier_rate"], 6), values["outlier_rate"])
        _slide(self._noise, values["noise_px"], MAX_NOISE_PX)
        _slide(self._outliers, self._rate[0], MAX_OUTLIERS)
        _slide(self._gravity, values["gravity_error_deg"], MAX_GRAVITY_DEG)
        put(self._view, values["field_of_view_deg"])
        put(self._height, values["cloud_height_m"])
        put(self._kind, next(name for name, kind in KINDS.items() if kind == values["outlier_kind"]))
        put(self._camera, self._camera_label(variation.camera))

    def _write_points(self, count: int) -> None:
        if count > RANGES[self._range.value]:
            put(self._range, max(RANGES, key=lambda name: RANGES[name]))
        self._points.min = min(MIN_POINTS, count)
        self._points.max = max(RANGES[self._range.value], count)
        put(self._points, count)

    def _camera_label(self, path: str | None) -> str:
        """The entry of the dropdown for a camera; one that is new is added."""
        if path is None:
            return OWN_CAMERA
        label = next((label for label, known in self._cameras.items() if known == path), None)
        if label is None:
            label = f"{Path(path).name} ({len(self._cameras)})"
            self._cameras[label] = path
            self._camera.options = (OWN_CAMERA, *self._cameras)
        return label

    def _rescale(self, event: Any) -> None:
        if event.client is None:
            return
        most = RANGES[self._range.value]
        if self._points.value > most:
            put(self._points, most)
            self._changed(event)
        self._points.max = most

    def _put_back(self, event: Any) -> None:
        self.true_camera = None
        self._changed(event)


def _slide(slider: Any, value: float, usual_most: float) -> None:
    """Set a slider, which goes farther than usual where the value does."""
    slider.max = max(usual_most, float(value))
    put(slider, float(value))
