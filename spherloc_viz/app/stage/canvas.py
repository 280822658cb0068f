"""One client's canvas: draws pictures, moves the viewer, and reports what is picked and dragged."""

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import viser

from spherloc.datasets.map_scene import MapScene
from spherloc.geometry import align_to_down
from spherloc_viz.app.catalog import Run
from spherloc_viz.app.controls.controls import DisplayControls
from spherloc_viz.app.stage import views
from spherloc_viz.app.stage.painter import LABEL_SCALE, Painter
from spherloc_viz.app.stage.true_camera import TrueCamera
from spherloc_viz.app.stage.walls import MAX_BYTES, Walls
from spherloc_viz.layers.point_cloud import cloud_items, reference_dots
from spherloc_viz.layers.primitives import Picture

FIRST_CHECKS, MAX_CHECKS, CHECK_S = 8, 40, 0.4
"""Number of checks of the first view, their largest number, and the time between two: a page that is still being built
drops its first view and reports that its viewer has not moved; a slow page does so for many checks."""
MAX_PX = 1 << 20
"""Largest width and height of a window that are accepted from a page."""
SPHERE = "Sphere"
"""Name of the view of the sphere, which shows it in any case."""
HELD = "held"
"""Used in place of a view's name for a view that a link asked for."""
MOVE_S = 5.0
"""Upper limit of the time in which a slow page moves its viewer smoothly (``smooth.js``), while its panels dock."""
RESHAPED = 0.02
"""Relative change of the canvas' aspect ratio, or of the width of its letters, from which on a view is fitted again."""


@dataclass(frozen=True, eq=False)
class _Room:
    """How a viewer sees a picture."""

    hidden: frozenset[str]
    """Names of the nodes that are hidden."""
    seen_from: tuple[np.ndarray, bool]
    """The viewer's position (3,), and whether it is inside a camera."""


class Canvas:
    """The 3-D picture of one client."""

    def __init__(
        self,
        client: viser.ClientHandle,
        display: DisplayControls,
        picked: Callable[[tuple[int, ...], bool], None],
        moved: Callable[[tuple[float, float, float, float]], None],
        photograph: Callable[[str, str], None],
        docked_px: int,
    ) -> None:
        """``picked`` gets indices of correspondences in the problem, ``moved`` the true camera's new pose, and
        ``photograph`` the layer and the name of a photograph whose dot was pressed.

        ``docked_px`` is the width of the panels beside the canvas.
        """
        client.scene.set_up_direction("-y")
        self._client, self._display = client, display
        self._text_scale, self._enlarged = text_scale(client.camera.image_width), 1.0
        self._label_scale = LABEL_SCALE * self._text_scale
        self._painter = Painter(client, picked, photograph, self._label_scale)
        self._camera = TrueCamera(client, moved)
        self._full_width = client.camera.image_width
        self._docked_px = docked_px if self._full_width >= NARROW_PX else 0
        self._step: tuple[str, str] | None = None
        self._followed: views.Viewpoint | None = None
        """The view that showed the subject of the last step that moved the viewer."""
        self._looked: tuple[str | None, views.Viewpoint, float, float] | None = None
        """The last view that was set: its name, or None for that of the step; the view; the canvas' aspect ratio; and
        the width of a letter in it."""
        self._taken_s = -math.inf
        """When that view was set, seconds of a monotonic clock, ..."""
        self._arrived = True
        """... and whether the viewer has been there since."""
        self._held: tuple[str, views.Viewpoint] | None = None
        """The key of a step, and the view that a link asked for at that step."""
        self._held_step_came = False
        """Whether that step has been shown: pictures that were requested before may come first."""
        self._scene: str | None = None
        self._checks, self._movable = 0, False
        self._lock = threading.Lock()
        self._picture: Picture | None = None
        self._walls: Walls | None = None
        self._walls_came = False
        """Whether there are walls that the view that was set last does not know."""
        client.camera.on_update(lambda camera: self._follow_page())

    def draw(self, run: Run, picture: Picture, mesh: bytes | None, movable: bool) -> None:
        """Show a picture of a run; ``mesh`` is the map's, and ``movable`` whether the true camera may be dragged."""
        problem, layers = run.trace.problem, self._display.layers()
        if mesh is not None and "mesh" in layers:  # the mesh has a ground of its own
            layers -= {"ground"}
        with self._lock:
            self._painter.dark = self._display.theme == "dark"
            self._painter.draw(picture.scene, layers)
            self._painter.draw_backdrop(mesh, problem.aligned.map_turn, "mesh" in layers)
            self._picture = picture
            solid = mesh if "mesh" in layers else None
            walls = Walls(solid, problem.aligned.map_turn) if solid is not None and len(solid) <= MAX_BYTES else None
            self._walls_came |= walls is not None and self._walls is None
            self._walls = walls
        if movable or self._movable:
            truth = problem.truth_cam_from_map
            self._camera.show(None if truth is None else problem.aligned.align_pose(truth), movable)
            self._movable = movable
        self._move_viewer(run, picture)
        self._make_room()

    def draw_map(self, label: str, scene: MapScene, mesh: bytes | None) -> None:
        """Show a scene before there is a run of it: its mesh, and where its references stand."""
        turn, layers = align_to_down(scene.gravity_map), self._display.layers()
        dots = reference_dots(scene, turn)
        places = dots.positions
        with self._lock:
            self._picture = None
            self._painter.draw(cloud_items(scene, turn) or [dots], layers)
            self._painter.draw_backdrop(mesh, turn, "mesh" in layers)
        if self._movable:
            self._camera.show(None, False)
            self._movable = False
        if label != self._scene and len(places):
            self._scene = label
            self._take(None, views.around(places, self._aspect()), self._aspect())

    def hold(self, step_key: str, viewpoint: tuple[float, ...]) -> None:
        """Keep the view ``viewpoint``, as the method of that name returns it, while this step is shown and the viewer
        is not moved."""
        *numbers, degrees = viewpoint
        self._held = step_key, views.Viewpoint(np.array(numbers[:3]), np.array(numbers[3:]), np.radians(degrees))
        self._looked, self._held_step_came = None, False

    def enlarge_labels(self, factor: float) -> None:
        """Draw labels so many times as large as usual, and fit the view to them."""
        self._enlarged = factor
        self._scale_labels()

    def fit_text(self, scale: float) -> None:
        """Draw labels for text of another size (``text_scale``), and fit the view to them."""
        self._text_scale = scale
        self._scale_labels()

    def _scale_labels(self) -> None:
        with self._lock:
            self._label_scale = LABEL_SCALE * self._text_scale * self._enlarged
            self._painter.scale_labels(self._label_scale)
        self._follow_page()

    def fill_page(self) -> None:
        """Use the whole page for the canvas, without panels, as in a lesson."""
        self._docked_px = 0
        self._follow_page()

    def viewpoint(self) -> tuple[float, ...]:
        """The viewer's position (3), target (3), and field of view, degrees; empty if it is the view that the step has
        by itself, where a page begins there."""
        held, looked, picture = self._held, self._looked, self._picture
        at_start = views.stands_at(self._client, views.START)
        if held is not None and (looked is None or looked[0] != HELD or at_start or self._untouched()):
            view = held[1]  # also while the page is still being built or on the way there
        elif looked is None or picture is None or at_start:
            return ()
        elif looked[0] is None and self._untouched():
            # While a slider changes the step, its view is kept for as long as the subject is in it. A canvas that is
            # hardly reshaped keeps it too, though it is not quite the view of the new shape.
            _, view, aspect, letter = looked
            if views.same(view, views.follow(picture, aspect, self._walls, letter)):
                return ()
        else:
            camera = self._client.camera
            view = views.Viewpoint(np.array(camera.position), np.array(camera.look_at), float(camera.fov))
        degrees = float(np.degrees(view.field_of_view_rad))
        return (*view.position.tolist(), *view.target.tolist(), degrees)

    def _make_room(self) -> None:
        """Hide what would cover the view of a viewer inside a camera; called on threads of viser and of the page."""
        room = self._room()
        # Does not wait, since the viewer moves often, for a picture that is being drawn.
        if room is None or (room.hidden == self._painter.hidden and not self._painter.follows(*room.seen_from)):
            return
        with self._lock:
            room = self._room()  # of where the viewer stands by now: a thread that began earlier may come later
            if room is not None:
                self._painter.hide(room.hidden)
                self._painter.see_from(*room.seen_from)

    def _room(self) -> "_Room | None":
        """What a viewer where the page's viewer stands must not see; None if there is nothing to see, or if the page
        has told no position."""
        picture, position = self._picture, self._position()
        if picture is None or position is None:
            return None
        hidden = views.before_the_eyes(picture, position) | self._cut(picture, position)
        if self._looked is None or self._looked[0] != SPHERE:
            hidden |= views.over_the_walk(picture, position)
        return _Room(hidden, (position, views.inside(picture, position)))

    def _position(self) -> np.ndarray | None:
        """Where the page's viewer stands (3,); None if the page has told no position."""
        try:
            return np.array(self._client.camera.position, dtype=np.float64).reshape(3)
        except (TypeError, ValueError):  # viser does not check what a page sends about its camera
            return None

    def _cut(self, picture: Picture, position: np.ndarray) -> frozenset[str]:
        """Names of the labels that the canvas' edge would cut for a viewer at that position (3,)."""
        view = self._view_from(position)
        return frozenset() if view is None else views.cut(picture, view, self._aspect(), self._letter())

    def _view_from(self, position: np.ndarray) -> views.Viewpoint | None:
        """The view of a viewer at that position (3,); None if what the page sent is none."""
        camera = self._client.camera
        try:
            target, angle = np.array(camera.look_at, dtype=np.float64).reshape(3), float(camera.fov)
        except (TypeError, ValueError):
            return None
        away = target - position
        if not (0.0 < angle < np.pi and 0.0 < np.hypot(away[0], away[2]) < np.inf):  # a page may send anything
            return None
        return views.Viewpoint(position, target, angle)

    def _letter(self) -> float:
        """Width of a letter in the canvas, as a share of half the canvas' height."""
        height_px = max(1, min(self._client.camera.image_height, MAX_PX))
        return views.LETTER_PX * self._label_scale / (0.5 * height_px)

    def card_is_right(self, picture: Picture, width_px: float, height_px: float) -> bool:
        """Whether a card of that size hides less of the selection and of the labels at the upper right of the canvas
        than at its upper left; where it is the same, whether the last click was in the left half."""
        position = self._position()
        view = None if position is None else self._view_from(position)
        if view is None:
            return self._painter.clicked_x < 0.5
        aspect, half_px = self._aspect(), 0.5 * max(1, min(self._client.camera.image_height, MAX_PX))
        width, height = width_px / half_px, height_px / half_px
        left, right = (
            views.covered(picture, view, np.array([x, 1.0 - height]), np.array([x + width, 1.0]), self._letter())
            for x in (-aspect, aspect - width)
        )
        return right < left if right != left else self._painter.clicked_x < 0.5

    def check(self) -> float | None:
        """Seconds until the next check of whether the page dropped its first view; None if no more checks are
        needed."""
        self._checks += 1
        most = MAX_CHECKS if views.stands_at(self._client, views.START) else FIRST_CHECKS
        return CHECK_S if self._checks <= most else None

    def _move_viewer(self, run: Run, picture: Picture) -> None:
        """Set the view that the user chose or, if that is to follow the steps, the best view of the step's subject.

        The latter also if another scene was opened, which may be out of sight, and when its walls have arrived.
        """
        # Not compared by the problem's name, which changes with every slider.
        wanted, scene, query = self._display.take_view(), run.request.scene.scene, run.request.scene.query
        step = (f"{scene}, {query}", picture.step.key)
        at_held = self._held is not None and self._held[0] == step[1]
        if wanted is not None or (self._held_step_came and not at_held):
            self._held = None
        self._held_step_came = self._held is not None and (self._held_step_came or at_held)
        other_step, elsewhere = step != self._step, self._scene not in (None, scene)
        other_query = other_step and self._step is not None and self._step[1] == step[1]
        same_name = other_query and self._looked is not None and self._looked[0] in views.NAMES
        self._step, self._scene = step, scene
        if wanted is not None:
            self._look(wanted, picture)
        elif self._held is not None and at_held:
            self._look_again(self._held[1])
        elif elsewhere or views.stands_at(self._client, views.START):
            self._look(None, picture)
        elif self._looked is not None and (self._walls_came or same_name) and self._untouched():
            self._look(self._looked[0], picture)
        elif self._display.follow and (other_step or self._untouched()):
            self._follow_step(picture, other_step)

    def _follow_step(self, picture: Picture, other_step: bool) -> None:
        """Set the step's view unless it is set already; at the same step, keep the view and fit it again if necessary.

        A view that was chosen by name is kept, however often the same step is drawn.
        """
        aspect = self._aspect()
        if other_step:
            self._walls_came = False
            view = views.follow(picture, aspect, self._walls, self._letter())
            if self._followed is None or not views.same(view, self._followed):
                self._take(None, view, aspect)
        elif self._looked is not None:
            name = self._looked[0] if self._looked[0] in views.NAMES else None
            if not views.fits(name, self._looked[1], picture, aspect):
                self._look(name, picture)

    def _look_again(self, view: views.Viewpoint) -> None:
        """Set a view that is kept, also again after a page that was still being built has dropped it."""
        if self._looked is None or self._looked[0] != HELD or views.stands_at(self._client, views.START):
            self._take(HELD, view, self._aspect())

    def _look(self, name: str | None, picture: Picture) -> None:
        """Set the view of that name, or that of the step for None."""
        aspect = self._aspect()
        walls, self._walls_came = self._walls, False
        wanted = (
            views.follow(picture, aspect, walls, self._letter())
            if name is None
            else views.find(name, picture, aspect, walls)
        )
        self._take(name, wanted, aspect)

    def _take(self, name: str | None, view: views.Viewpoint, aspect: float) -> None:
        if name is None:
            self._followed = view
        self._looked, self._taken_s = (name, view, aspect, self._letter()), time.monotonic()
        self._arrived = False
        picture = self._picture
        self._painter.see_from(view.position, picture is not None and views.inside(picture, view.position))
        views.look(self._client, view)

    def _untouched(self) -> bool:
        """Whether the viewer is still where it was put, or on the way there."""
        if self._looked is None:
            return False
        there = views.stands_at(self._client, self._looked[1])
        self._arrived = self._arrived or there
        return there or (not self._arrived and time.monotonic() - self._taken_s < MOVE_S)

    def _follow_page(self) -> None:
        """Called on viser's threads when the page's viewer has moved or its canvas has another shape. A slow page tells
        late that the viewer has arrived: walls may have come meanwhile."""
        self._make_room()
        looked, picture = self._looked, self._picture
        if looked is None:
            return
        untouched = self._untouched()
        if views.stands_at(self._client, views.START):  # a page that was still being built has dropped the view
            with self._lock:
                self._take(*looked[:3])
            return
        changed = self._walls_came or self._is_reshaped(*looked[2:])
        if picture is not None and looked[0] != HELD and untouched and changed:
            with self._lock:
                self._look(looked[0], picture)

    def _is_reshaped(self, aspect: float, letter: float) -> bool:
        """Whether the canvas' aspect ratio or the size of its letters is not what it was."""
        return max(abs(math.log(self._aspect() / aspect)), abs(math.log(self._letter() / letter))) > RESHAPED

    def _aspect(self) -> float:
        """Width over height of the canvas."""
        camera = self._client.camera
        # The page sends its size before it docks the panels, and again some frames later.
        if camera.image_width != self._full_width:
            self._docked_px = 0
        width_px, height_px = min(camera.image_width, MAX_PX), min(camera.image_height, MAX_PX)
        return max(0.3, (width_px - self._docked_px) / max(1, height_px))


def panel_widths_px(window_px: int) -> tuple[int, int]:
    """Widths of the panels left and right of the canvas."""
    return next(widths for least, widths, _ in WINDOWS_PX if window_px >= least)


def canvas_width_px(window_px: int) -> int:
    """Width of the canvas between the panels, or of the whole window where they are not beside it."""
    return window_px - (sum(panel_widths_px(window_px)) if window_px >= NARROW_PX else 0)


def text_scale(window_px: int) -> float:
    """Factor of the text size in a window of that width, compared with a laptop, as in ``touch.css``."""
    return next(scale for least, _, scale in WINDOWS_PX if window_px >= least)


NARROW_PX = 600
"""Least width of a window with panels beside its canvas (``captions.js``)."""
WINDOWS_PX: tuple[tuple[int, tuple[int, int], float], ...] = (
    (3400, (860, 780), 2.0),
    (2500, (650, 585), 1.5),
    (1800, (500, 450), 1.15),
    (1600, (480, 400), 1.0),
    (1000, (380, 340), 1.0),
    (0, (340, 340), 1.0),
)
"""By the least width of the window, px: widths of the panels left and right, px, and the factor of the text size."""
