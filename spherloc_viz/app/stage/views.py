"""Views: positions from which a picture can be read well, without a wall between the viewer and the subject."""

from dataclasses import dataclass

import numpy as np
import viser
from numpy.typing import NDArray

from spherloc.geometry import yaw_rotation
from spherloc.types import FloatArray
from spherloc_viz.app.stage.subjects import centre_and_radius, followed, subject_of, surface_of, walk_at_end
from spherloc_viz.app.stage.walls import Walls
from spherloc_viz.app.web.viser_internals import place_viewer
from spherloc_viz.layers.primitives import Label, Mesh, Picture, Points, SceneItem, Segments, Textured

TARGETS = 24
"""Number of points of a subject to which there should be a line of sight."""
FIELD_OF_VIEW_RAD = np.radians(45.0)
WIDE_RAD = np.radians(85.0)
"""Field of view of a viewer inside the camera."""
UP = np.array([0.0, -1.0, 0.0])
START = (3.0, -3.0, 3.0)
"""Position of a page's viewer until its first view is set."""
MARGINS = np.array([0.1, 0.06])
"""Shares of the canvas' half width and half height that stay free on each side."""
LETTER_PX = 6.8
"""Width of a letter of a label of viser's size."""
WIDE, HIGH = np.array([0.5, 0.0]), np.array([0.6, 1.4])
"""Half a label's width and height, in widths of a letter: per letter, and in addition."""
BESIDE = ("ground", "scale bar")
"""Layers whose labels are the same at every step."""
YIELDING = ("uncertainty", "trajectory", "point cloud", *BESIDE)
"""Layers whose labels are hidden where they would lie over others; those of a later one also by those of an earlier."""
NEAR = 0.6
"""Largest distance of a step's labels from its subject, as a share of the subject's size."""
ROUNDS = 4
"""Number of rounds in which the target is moved to the middle of the projected subject, which perspective shifts."""
MIN_REACH, REACH = 1000.0, 5.0
"""Distance up to which a page draws: at least the first, viser's own, m; and the second times the distance to the
target."""
ROUNDING = 1e-6
"""Share of half the canvas' height by which a label that was fitted to the edge may seem to be cut."""
STILL = 1e-3
"""Largest difference of the positions of two equal views, as a share of the distance to the target."""
MIN_SHARE = 0.5
"""Least share of the canvas' width and height that a subject covers; otherwise it counts as shown too small."""
DIRECTIONS = {
    "Overview": (0.55, -0.6, -0.75),
    "Above": (0.0, -1.0, -0.02),
    "Sphere": (0.3, -0.75, -0.6),
    "Balls": (0.35, -0.45, -0.8),
}
"""Directions of the views, from the subject to the viewer; y points down."""
SIDEWAYS, NEARER = (-0.02, -1.0, 0.0), 0.75
"""Direction of the view from above with the map's x axis upright, which is taken if that brings the viewer to less than
this share of the distance: a street fills a wide canvas so or so."""
STEEP = (0.3, -2.0, -0.6)
"""Direction from which a view looks over walls."""
INSIDE = "From the camera"
NAMES = (*DIRECTIONS, INSIDE)
"""Names of all views."""
TURNING = 0.02
"""Distance, in sphere radii, from a viewer inside the camera to the point around which the mouse turns the view."""
CLOSE = 0.15
"""Distance from a camera's centre, in sphere radii, within which the viewer counts as inside the camera."""
OUTSIDE = 1.2
"""Distance from the sphere's centre, in sphere radii, from which on the viewer counts as outside of it."""
TURNS_RAD = np.radians([0, 30, -30, 60, -60, 90, -90, 120, -120, 150, -150, 180])
"""Rotations of a view about the vertical that are tried, the smallest first."""
YAW_TURNS = np.array([yaw_rotation(turn).T for turn in TURNS_RAD])
"""The same as matrices (T, 3, 3) that turn rows."""


ROUNDED = 1e-4
"""How far a page's report may be from the place where its viewer was put, per coordinate."""


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """Position, target and field of view of the viewer."""

    position: FloatArray
    target: FloatArray
    field_of_view_rad: float = FIELD_OF_VIEW_RAD


def stands_at(client: viser.ClientHandle, place: Viewpoint | tuple[float, float, float]) -> bool:
    """Whether the page reports that its viewer is in a view, or at a position; false if its report is not numbers."""
    camera = client.camera
    if not isinstance(place, Viewpoint):
        return bool(np.abs(np.subtract(camera.position, place)).max() < ROUNDED)
    return same(Viewpoint(np.array(camera.position), np.array(camera.look_at), place.field_of_view_rad), place)


def same(view: Viewpoint, other: Viewpoint) -> bool:
    """Whether two views show the same."""
    near = STILL * float(np.linalg.norm(other.target - other.position))
    places = np.stack([view.position - other.position, view.target - other.target])
    return bool(np.all(np.linalg.norm(places, axis=1) <= near)) and view.field_of_view_rad == other.field_of_view_rad


def reach(view: Viewpoint) -> float:
    """Distance up to which a page must draw for a view, m: a map of mountains is larger than viser's default."""
    return max(MIN_REACH, REACH * float(np.linalg.norm(view.target - view.position)))


def look(client: viser.ClientHandle, view: Viewpoint) -> None:
    """Move a client's viewer there."""
    with client.atomic():
        camera, far = client.camera, reach(view)
        # Setting what is so already takes viser as long as drawing a ball.
        if not np.array_equal(camera.up_direction, UP):
            camera.up_direction = UP
        if camera.fov != view.field_of_view_rad:
            camera.fov = view.field_of_view_rad
        if camera.far != far:
            camera.far = far
        place_viewer(client, view.position, view.target)


def follow(picture: Picture, aspect: float, walls: Walls | None = None, letter: float = 0.0) -> Viewpoint:
    """The view of the step's subject, on a canvas with that aspect ratio, between ``walls``. If ``letter``, the width
    of a letter as a share of half the canvas' height, is not 0, the labels beside the subject are in view too."""
    subject, clear = followed(picture)
    view = _clear(picture.focus.view, picture, subject, clear, aspect, walls)
    names = _names(picture, subject) if letter else []
    if not names:
        return view
    held = np.vstack([subject, [label.position for label in names]])
    insets = np.vstack([np.zeros((len(subject), 2)), _half_sizes(names, letter)])
    positions, targets = _fits(held, (view.position - view.target)[None], aspect, insets)
    return Viewpoint(positions[0], targets[0])


def cut(picture: Picture, view: Viewpoint, aspect: float, letter: float) -> frozenset[str]:
    """Names of the labels that the edge of the canvas would cut, or that would cover more important ones."""
    labels = [item for item in picture.scene if isinstance(item, Label)]
    if not labels:
        return frozenset()
    labels.sort(key=lambda label: 1 + YIELDING.index(label.layer) if label.layer in YIELDING else 0)
    seen = projected(view, np.array([label.position for label in labels])) / np.tan(view.field_of_view_rad / 2)
    halves = _half_sizes(labels, letter)
    within = (np.abs(seen) + halves <= np.array([aspect, 1.0]) + ROUNDING).all(axis=1)
    shown: list[int] = []
    for k in np.flatnonzero(within).tolist():
        yields = labels[k].layer in YIELDING
        if not (yields and (np.abs(seen[k] - seen[shown]) < halves[k] + halves[shown]).all(axis=1).any()):
            shown.append(k)
    return frozenset(label.name for k, label in enumerate(labels) if k not in shown)


def covered(picture: Picture, view: Viewpoint, low: FloatArray, high: FloatArray, letter: float) -> float:
    """How much of what matters a card would cover that lies over the canvas from ``low`` to ``high``, (2,) each, right
    and up from its middle in halves of its height: the shares of the selected dots and lines, and a tenth for each
    label, of letters so wide."""
    zoom, hidden = np.tan(view.field_of_view_rad / 2), 0.0
    for item in picture.scene:
        if item.layer == "selection" and isinstance(item, Points | Segments):
            places = item.positions if isinstance(item, Points) else item.points.reshape(-1, 3)
            seen = projected(view, places) / zoom
            hidden += float(((seen >= low) & (seen <= high)).all(axis=1).mean()) if len(seen) else 0.0
    labels = [item for item in picture.scene if isinstance(item, Label)]
    if labels:
        seen = projected(view, np.array([label.position for label in labels])) / zoom
        halves = _half_sizes(labels, letter)
        hidden += 0.1 * int(np.count_nonzero(((seen + halves >= low) & (seen - halves <= high)).all(axis=1)))
    return hidden


def _names(picture: Picture, subject: FloatArray) -> list[Label]:
    """The labels beside a subject (K, 3)."""
    low, high = np.min(subject, axis=0), np.max(subject, axis=0)
    room = NEAR * float(np.max(high - low))
    labels = [item for item in picture.scene if isinstance(item, Label)]
    own = [label for label in labels if label.layer not in BESIDE]
    return [label for label in own if np.all((label.position > low - room) & (label.position < high + room))]


def _half_sizes(labels: list[Label], letter: float) -> FloatArray:
    """Half the width and height (L, 2) of labels, in the unit of ``letter``."""
    return letter * (np.array([[len(label.text)] for label in labels]) * WIDE + HIGH)


def around(places: FloatArray, aspect: float) -> Viewpoint:
    """An overview of places (K, 3), with room around them."""
    room_m = 0.2 * float(np.max(np.ptp(places, axis=0))) + 1.0
    return _fit(np.vstack([places - room_m, places + room_m]), np.array(DIRECTIONS["Overview"]), aspect)


def shows(view: Viewpoint, subject: FloatArray, aspect: float) -> bool:
    """Whether a subject (K, 3) is inside a view and not shown too small."""
    seen = projected(view, subject) / (np.tan(view.field_of_view_rad / 2) * np.array([aspect, 1.0]))
    inside = bool(np.all(np.abs(seen) <= 1.0))
    return inside and float(np.max(np.ptp(seen, axis=0))) / 2 >= MIN_SHARE


def fits(name: str | None, view: Viewpoint, picture: Picture, aspect: float) -> bool:
    """Whether a view of that name, or the step's view for None, still shows its subject."""
    if name is None:
        return shows(view, followed(picture)[0], aspect)
    return same(view, _inside(picture)) if name == INSIDE else shows(view, subject_of(name, picture), aspect)


def projected(view: Viewpoint, positions: FloatArray) -> FloatArray:
    """Projections (K, 2) of positions (K, 3), right and up, as slopes; infinite behind the viewer."""
    backward, right, up = _axes((view.position - view.target)[None])[:, 0]
    offset = positions - view.position
    depth = -(offset @ backward)
    slopes = np.full((len(positions), 2), np.inf)
    ahead = depth > 0
    slopes[ahead] = (offset[ahead] @ np.column_stack([right, up])) / depth[ahead, None]
    return slopes


def before_the_eyes(picture: Picture, position: FloatArray) -> frozenset[str]:
    """Names of the nodes to hide for a viewer at that position (3,) inside a camera: the camera and things around it,
    whose lines would cross the whole picture, and labels, which would cover the photograph."""
    surface = surface_of(picture)
    if surface is None:
        return frozenset()
    close_m = CLOSE * centre_and_radius(surface)[1]
    cameras = [item for item in picture.scene if isinstance(item, Segments) and item.layer == "cameras"]
    names = {item.name for item in cameras if len(item.points) and _apart(item, position) < close_m}
    if "cameras/estimate" in names:
        names |= {item.name for item in picture.scene if item.layer == "uncertainty"} | {"cameras/error"}
    if inside(picture, position):
        names |= {item.name for item in picture.scene if isinstance(item, Label)}
    return frozenset(names)


def over_the_walk(picture: Picture, position: FloatArray) -> frozenset[str]:
    """Names of the nodes of the sphere, if it would cover where photographs were taken at the outcome, for a viewer at
    that position (3,) outside of it."""
    surface = surface_of(picture)
    if surface is None or walk_at_end(picture) is None:
        return frozenset()
    centre, radius_m = centre_and_radius(surface)
    if np.linalg.norm(position - centre) < OUTSIDE * radius_m:
        return frozenset()
    return frozenset(item.name for item in picture.scene if item.layer in ("sphere", "image"))


def inside(picture: Picture, position: FloatArray) -> bool:
    """Whether a viewer at that position (3,) is in the estimated camera or in the sphere's centre."""
    surface = surface_of(picture)
    if surface is None:
        return False
    camera = next((item for item in picture.scene if item.name == "cameras/estimate"), None)
    centre, radius_m = centre_and_radius(surface)
    apart_m = [float(np.linalg.norm(centre - position))]
    if isinstance(camera, Segments) and len(camera.points):
        apart_m.append(_apart(camera, position))
    return min(apart_m) < CLOSE * radius_m


def _apart(camera: Segments, position: FloatArray) -> float:
    """Distance, m, from a camera's centre, at which its first line begins."""
    return float(np.linalg.norm(camera.points[0, 0] - position))


def find(name: str, picture: Picture, aspect: float, walls: Walls | None = None) -> Viewpoint:
    """The view of that name, fitted to a picture and to a canvas with that aspect ratio.

    Close views are turned about the vertical until few ``walls`` and map points are in the way.
    """
    if name == INSIDE:
        return _inside(picture)
    subject = subject_of(name, picture)
    return _clear(name, picture, subject, subject, aspect, walls)


def _clear(
    name: str, picture: Picture, subject: FloatArray, clear: FloatArray, aspect: float, walls: Walls | None
) -> Viewpoint:
    """A view of a subject (K, 3) from the direction of a named view, turned so that little hides ``clear`` (L, 3)."""
    if name == "Above":
        positions, targets = _fits(subject, np.array([DIRECTIONS[name], SIDEWAYS]), aspect)
        upright, sideways = np.linalg.norm(positions - targets, axis=1)
        turned = int(sideways < NEARER * upright)
        return Viewpoint(positions[turned], targets[turned])
    if name not in ("Sphere", "Balls") and (name != "Overview" or walls is None):
        return _fit(subject, np.array(DIRECTIONS[name]), aspect)
    sides = [DIRECTIONS[name]] if walls is None else [DIRECTIONS[name], STEEP]
    directions = (np.array(sides)[:, None, None] @ YAW_TURNS).reshape(-1, 3)
    points = next(item for item in picture.scene if isinstance(item, Points) and item.name == "map/points")
    positions, targets = _fits(subject, directions, aspect)
    fitted = (positions, targets) if clear is subject else _fits(clear, directions, aspect)
    hidden = _in_the_way(*fitted, points.positions) + 0.5 * np.arange(len(directions))
    if walls is not None or name == "Balls":
        looked_at, surface = _sample(subject), surface_of(picture)
        if walls is not None:
            hidden += len(points.positions) * np.array([walls.blocked(position, looked_at) for position in positions])
        if name == "Balls" and surface is not None:
            hidden += len(points.positions) * np.mean(_behind(surface, positions, looked_at), axis=1)
    best = int(np.argmin(hidden))
    return Viewpoint(positions[best], targets[best])


def _sample(subject: FloatArray) -> FloatArray:
    """About ``TARGETS`` points: some of a subject (K, 3), which may be its outermost ones alone, as many halfway to its
    middle, and the middle."""
    outer, middle = subject[:: max(1, -(-2 * len(subject) // TARGETS))], np.mean(subject, axis=0)
    return np.vstack([outer, (outer + middle) / 2, middle])


def _behind(surface: Mesh, positions: FloatArray, targets: FloatArray) -> NDArray[np.bool_]:
    """Whether the sphere hides targets (K, 3) from positions (D, 3), as (D, K)."""
    sight = targets - positions[:, None]
    centre, radius_m = centre_and_radius(surface)
    to_centre = (centre - positions)[:, None]
    share = np.clip(np.sum(to_centre * sight, axis=2) / np.sum(sight**2, axis=2), 0.0, 1.0)
    return np.linalg.norm(share[..., None] * sight - to_centre, axis=2) < radius_m


def _inside(picture: Picture) -> Viewpoint:
    """The view along the camera's axis from the camera or, while its position is unknown, from the sphere's centre."""
    items = {item.name: item for item in picture.scene}
    surface = surface_of(picture)
    assert surface is not None
    centre, radius_m = centre_and_radius(surface)
    axis = _axis(items)
    camera = items.get("cameras/estimate")
    if isinstance(camera, Segments):
        centre = camera.points[0, 0]
    return Viewpoint(centre, centre + TURNING * radius_m * axis, WIDE_RAD)


def _axis(items: dict[str, SceneItem]) -> FloatArray:
    """Direction (3,) of the camera's axis; the map's +z if the picture does not show it."""
    camera, image = items.get("cameras/estimate"), items.get("sphere/image")
    if isinstance(camera, Segments):
        axis = np.sum(camera.points[:4, 1] - camera.points[:4, 0], axis=0)
    else:
        axis = image.map_from_mesh[:, 2] if isinstance(image, Textured) else np.array([0.0, 0.0, 1.0])
    return axis / np.linalg.norm(axis)


def _fit(subject: FloatArray, direction: FloatArray, aspect: float) -> Viewpoint:
    """The nearest view in that direction in which all of the subject (K, 3) is on the canvas."""
    positions, targets = _fits(subject, direction[None], aspect)
    return Viewpoint(positions[0], targets[0])


def _fits(
    subject: FloatArray, directions: FloatArray, aspect: float, insets: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """The same for directions (D, 3): positions (D, 3) and targets (D, 3).

    ``insets`` (K, 2) are least distances of the points from the edge, as shares of half the canvas' height, where they
    are larger than the margins.
    """
    axes = _axes(directions)
    edges = np.array([aspect, 1.0])
    free = np.broadcast_to(MARGINS * edges, (len(subject), 2))
    if insets is not None:  # some room is left on a canvas that is narrower than its words
        free = np.clip(insets, free, 0.9 * edges)
    slopes = (np.tan(FIELD_OF_VIEW_RAD / 2) * (edges - free)).T[:, None]
    room = slopes.max(axis=2, keepdims=True) - slopes
    middle = (subject.min(axis=0) + subject.max(axis=0)) / 2
    # Of the subject (D, K) and (2, D, K), and of the target (2, D, 1), which moves: towards the viewer, and to the
    # right and up.
    depth, *sides = axes @ (subject - middle).T
    across, target = np.array(sides), np.zeros((2, len(directions), 1))

    def least_distance() -> FloatArray:
        """Least distances (D, 1) from which the subject is within the slopes."""
        needed = np.abs(across - target) / slopes
        return np.maximum(1e-3, (needed.max(axis=0) + depth).max(axis=1, keepdims=True))

    for _ in range(ROUNDS):
        distance = least_distance()
        seen = (across - target) / np.maximum(distance - depth, 1e-3)
        low, high = (seen - room).min(axis=2, keepdims=True), (seen + room).max(axis=2, keepdims=True)
        target += distance * (low + high) / 2
    targets = middle + (target * axes[1:]).sum(axis=0)
    return targets + least_distance() * axes[0], targets


def _axes(directions: FloatArray) -> FloatArray:
    """Unit vectors (3, D, 3) towards viewers in those directions (D, 3), and to each viewer's right and up."""
    backward = directions / np.sqrt((directions**2).sum(axis=1, keepdims=True))
    x, y, z = backward.T
    level = np.hypot(x, z)  # up is -y
    zero = np.zeros_like(x)
    right = np.array([-z, zero, x]) / level
    up = np.array([-x * y, level**2, -y * z]) / level
    return np.array([backward, right.T, -up.T])


def _in_the_way(standing: FloatArray, targets: FloatArray, positions: FloatArray) -> FloatArray:
    """How much (D,) the points (N, 3) in front of the targets cover views from positions (D, 3) to targets (D, 3); a
    point as far away as its target counts 1."""
    forward = targets - standing
    distance = np.linalg.norm(forward, axis=1)[:, None]
    depth = (forward @ positions.T - np.sum(forward * standing, axis=1)[:, None]) / distance
    away = np.linalg.norm(positions - standing[:, None], axis=2)
    before = (depth > 0) & (depth < 0.9 * distance) & (depth > np.cos(FIELD_OF_VIEW_RAD / 2) * away)
    return np.sum(before * (distance / np.maximum(depth, 1e-3)) ** 2, axis=1)
