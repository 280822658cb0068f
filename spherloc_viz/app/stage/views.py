"""Where the viewer stands: places from which a picture reads well."""

from dataclasses import dataclass

import numpy as np
import viser

from spherloc.geometry import yaw_rotation
from spherloc_viz.layers.primitives import Balls, FloatArray, Mesh, Picture, Points, SceneItem, Segments, Textured

FIELD_OF_VIEW_RAD = np.radians(45.0)
WIDE_RAD = np.radians(85.0)
"""Field of view of who stands in the camera."""
UP = np.array([0.0, -1.0, 0.0])
START = (3.0, -3.0, 3.0)
"""Where a page's viewer stands until its first view is set."""
MARGINS = np.array([0.13, 0.06])
"""Shares of the canvas' half width and half height that stay free on every side: labels are wide."""
ROUNDS = 4
"""Perspective shifts the middle of what is seen, so the target is moved there a few times."""
ROOM = 1.35
"""Radius of what the view of the sphere holds, in sphere radii."""
RING = 3.0
"""Radius of the yaw ring with its outline, in sphere radii."""
DIRECTIONS = {
    "Overview": (0.55, -0.6, -0.75),
    "Above": (0.0, -1.0, -0.02),
    "Sphere": (0.3, -0.75, -0.6),
    "Balls": (0.35, -0.45, -0.8),
}
"""From the subject to the viewer; y points down."""
INSIDE = "From the camera"
NAMES = (*DIRECTIONS, INSIDE)
"""All views."""
TURNING = 0.02
"""How far before the eye of who stands in the camera the point lies around which the mouse turns, in sphere radii."""
CLOSE = 0.15
"""Who is this close to a camera's centre stands in it, in sphere radii."""
SUBJECTS = (
    ("Balls", "balls/clique"),
    ("Balls", "balls/others"),
    ("Overview", "pairs/clique"),
    ("Sphere", "ring/arcs"),
    ("Sphere", "ring/bound"),
    ("Overview", "rays"),
    ("Sphere", "sphere/surface"),
)
"""What a step is about: the first of these primitives that it draws, and the view that shows it."""
TURNS_RAD = np.radians([0, 30, -30, 60, -60, 90, -90, 120, -120, 150, -150, 180])
"""Turns of a view about the vertical, the least first."""


@dataclass(frozen=True, eq=False)
class View:
    """A place to look from."""

    position: FloatArray
    target: FloatArray
    field_of_view_rad: float = FIELD_OF_VIEW_RAD


def is_unmoved(client: viser.ClientHandle) -> bool:
    """Whether the page says that its viewer still stands where it started."""
    return bool(np.allclose(client.camera.position, START))


def look(client: viser.ClientHandle, view: View) -> None:
    """Move a client's viewer there."""
    with client.atomic():
        camera = client.camera
        camera.up_direction = UP
        camera.fov = view.field_of_view_rad
        camera.position = view.position
        camera.look_at = view.target


def fitting(picture: Picture) -> tuple[str, str]:
    """The name of the view that shows what this step is about, and the primitive that it is about."""
    drawn = {item.name: item for item in picture.scene if not isinstance(item, Segments) or len(item.points)}
    for name, subject in SUBJECTS:
        if subject in drawn:
            return name, subject
    return "Overview", "map/points"


def before_the_eyes(picture: Picture, position: FloatArray) -> frozenset[str]:
    """Names of the cameras in which a viewer at that position (3,) stands, and of what is drawn around them: their
    lines would cross all that is seen."""
    items = {item.name: item for item in picture.scene}
    surface = items.get("sphere/surface")
    if not isinstance(surface, Mesh):
        return frozenset()
    close = CLOSE * float(np.max(surface.vertices[:, 0] - _centre(surface)[0]))
    cameras = [item for item in picture.scene if isinstance(item, Segments) and item.layer == "cameras"]
    names = {item.name for item in cameras if len(item.points) and _apart(item, position) < close}
    if "cameras/estimate" in names:
        names |= {item.name for item in picture.scene if item.layer == "uncertainty"} | {"cameras/error"}
    return frozenset(names)


def _apart(camera: Segments, position: FloatArray) -> float:
    """From a camera's centre, where its first line begins."""
    return float(np.linalg.norm(camera.points[0, 0] - position))


def find(name: str, picture: Picture, aspect: float) -> View:
    """The view of that name, fitted to a picture and to a canvas of that width over height.

    Close views are turned about the vertical until few map points stand in their way.
    """
    if name == INSIDE:
        return _inside(picture)
    subject = _subject(name, picture)
    turns = TURNS_RAD if name in ("Sphere", "Balls") else TURNS_RAD[:1]
    directions = [yaw_rotation(turn) @ np.array(DIRECTIONS[name]) for turn in turns]
    views = [_fit(subject, direction, aspect) for direction in directions]
    points = next(item for item in picture.scene if isinstance(item, Points) and item.name == "map/points")
    hidden = [_in_the_way(view, points.positions) + 0.5 * k for k, view in enumerate(views)]
    return views[int(np.argmin(hidden))]


def _inside(picture: Picture) -> View:
    """From where the camera, or, while its position is unknown, the sphere is, along its axis."""
    items = {item.name: item for item in picture.scene}
    surface = items["sphere/surface"]
    assert isinstance(surface, Mesh)
    centre = _centre(surface)
    axis = _axis(items)
    camera = items.get("cameras/estimate")
    if isinstance(camera, Segments):
        centre = camera.points[0, 0]
    radius = float(np.max(surface.vertices[:, 0] - _centre(surface)[0]))
    return View(centre, centre + TURNING * radius * axis, WIDE_RAD)


def _axis(items: dict[str, SceneItem]) -> FloatArray:
    """Where the camera looks (3,); +z of the map if the picture does not tell."""
    camera, image = items.get("cameras/estimate"), items.get("sphere/image")
    if isinstance(camera, Segments):
        axis = np.sum(camera.points[:4, 1] - camera.points[:4, 0], axis=0)
    else:
        axis = image.map_from_mesh[:, 2] if isinstance(image, Textured) else np.array([0.0, 0.0, 1.0])
    return axis / np.linalg.norm(axis)


def _fit(subject: FloatArray, direction: FloatArray, aspect: float) -> View:
    """The nearest place in that direction from which the canvas holds all of the subject (K, 3)."""
    backward = direction / np.linalg.norm(direction)
    right = np.cross(UP, backward)
    right /= np.linalg.norm(right)
    sideways = np.column_stack([right, np.cross(backward, right)])
    slopes = np.tan(FIELD_OF_VIEW_RAD / 2) * (1.0 - MARGINS) * np.array([aspect, 1.0])
    target, distance = (np.min(subject, axis=0) + np.max(subject, axis=0)) / 2, 1.0
    for _ in range(ROUNDS):
        offset = subject - target
        depth, across = offset @ backward, offset @ sideways
        distance = max(1e-3, float(np.max(np.max(np.abs(across) / slopes, axis=1) + depth)))
        seen = across / np.maximum(distance - depth, 1e-3)[:, None]
        target = target + distance * sideways @ ((np.min(seen, axis=0) + np.max(seen, axis=0)) / 2)
    return View(target + distance * backward, target)


def _in_the_way(view: View, positions: FloatArray) -> float:
    """How much of a view the points (N, 3) before its target cover; one as far as the target counts 1."""
    forward = view.target - view.position
    distance = float(np.linalg.norm(forward))
    offset = positions - view.position
    depth = offset @ forward / distance
    away = np.linalg.norm(offset, axis=1)
    before = (depth > 0) & (depth < 0.9 * distance) & (depth > np.cos(FIELD_OF_VIEW_RAD / 2) * away)
    return float(np.sum((distance / np.maximum(depth[before], 1e-3)) ** 2))


def _subject(name: str, picture: Picture) -> FloatArray:
    """Points (K, 3) that a view must hold."""
    items = {item.name: item for item in picture.scene}
    if name == "Sphere":
        return _sphere(items["sphere/surface"], any(item.layer == "yaw ring" for item in picture.scene))
    if name == "Balls":
        for key in ("balls/clique", "balls/others"):
            balls = items.get(key)
            if isinstance(balls, Balls):
                return _balls(balls)
    points, surface = items["map/points"], items["sphere/surface"]
    assert isinstance(points, Points) and isinstance(surface, Mesh)
    lines = [
        item.points.reshape(-1, 3)
        for item in picture.scene
        if isinstance(item, Segments) and item.layer in ("cameras", "scale bar")
    ]
    route = [item.positions for item in picture.scene if isinstance(item, Points) and item.layer == "trajectory"]
    return np.vstack([_dense(points.positions), surface.vertices, *lines, *route])


def _sphere(surface: object, ring: bool) -> FloatArray:
    """The sphere with some room, or the ring around it."""
    assert isinstance(surface, Mesh)
    centre = _centre(surface)
    if not ring:
        return centre + ROOM * (surface.vertices - centre)
    angle = np.linspace(0, 2 * np.pi, 36)
    circle = np.column_stack([np.cos(angle), 0 * angle, np.sin(angle)])
    return centre + RING * np.max(surface.vertices[:, 0] - centre[0]) * circle


def _centre(surface: Mesh) -> FloatArray:
    return (np.min(surface.vertices, axis=0) + np.max(surface.vertices, axis=0)) / 2


def _balls(balls: Balls) -> FloatArray:
    """Boxes around the denser half of the balls, and as much again around these.

    These are the balls nearest to the median of the smaller half.
    """
    small = np.argsort(balls.radii_m)[: max(1, len(balls.radii_m) // 2)]
    away = np.linalg.norm(balls.centers - np.median(balls.centers[small], axis=0), axis=1)
    near = np.argsort(away)[: max(1, len(away) // 2)]
    reach = 2.0 * balls.radii_m[near, None]
    return np.vstack([balls.centers[near] - reach, balls.centers[near] + reach])


def _dense(positions: FloatArray) -> FloatArray:
    """Without stray points, which would make all others small."""
    away = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    return positions[away <= 4.0 * np.median(away)]
