"""Primitives that all pictures share: map points, the unit sphere with its bearings and the query image, matches, true
and estimated camera with the error, a scale bar, and a localized sequence."""

from collections.abc import Sequence
from functools import cache, partial

import cv2
import numpy as np

from spherloc.cameras.base import Camera, in_image
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.experiments.results import QueryResult
from spherloc.experiments.summary import timed
from spherloc.geometry import camera_centre
from spherloc.metrics import extent_of
from spherloc.problem import Problem
from spherloc.types import ByteArray, FloatArray, IntArray
from spherloc_viz import style
from spherloc_viz.layers.camera_shape import CORNERS, camera
from spherloc_viz.layers.frame import Frame, RunView, even, icosphere, one_color
from spherloc_viz.layers.point_cloud import MAX_NAMED, WRONG_RAYS
from spherloc_viz.layers.primitives import Label, Mesh, Points, SceneItem, Segments, Textured
from spherloc_viz.layers.query_image import modified, sphere_texture
from spherloc_viz.layers.scale_bar import round_length, scale_bar
from spherloc_viz.layers.uncertainty import error_items, is_close_up

CELL_SHARE, GROUND_SHARE = 0.2, 0.9
"""Largest side of a cell of the ground, and the ground's radius, as shares of the map's width."""
RIM = 72
"""Number of straight pieces of the ground's edge."""


def ground(view: RunView) -> list[SceneItem]:
    """A round grid below the map, which shows the horizontal and distances, with the map's horizontal axes."""
    low, high = view.dense_box
    middle, extent = 0.5 * (low + high), max(float((high - low)[[0, 2]].max()), 1e-3)
    cell, radius = round_length(CELL_SHARE * extent), GROUND_SHARE * extent
    lines: list[FloatArray] = []
    for axis, other in ((0, 2), (2, 0)):
        first, last = (int(np.floor((middle[axis] + side * radius) / cell)) for side in (-1, 1))
        places = cell * np.arange(first + 1, last + 1)
        half = np.sqrt(np.maximum(radius**2 - (places - middle[axis]) ** 2, 0.0))
        ends = np.tile(np.array([0.0, high[1], 0.0]), (len(places), 2, 1))
        ends[:, :, axis] = places[:, None]
        ends[:, :, other] = middle[other] + half[:, None] * np.array([-1.0, 1.0])
        lines.append(ends)
    turns = np.linspace(0.0, 2.0 * np.pi, RIM + 1)
    rim = np.tile([middle[0], high[1], middle[2]], (RIM + 1, 1))
    rim[:, [0, 2]] += radius * np.column_stack([np.cos(turns), np.sin(turns)])
    lines.append(np.stack([rim[:-1], rim[1:]], axis=1))
    grid = np.concatenate(lines)
    edge = np.array([middle[0], high[1], middle[2]])
    names = (("x axis", np.array([1.0, 0.0, 0.0])), ("z axis (yaw 0°)", np.array([0.0, 0.0, 1.0])))
    return [
        Segments("ground/grid", "ground", grid, one_color(style.GROUND, len(grid)), 1.0),
        *(Label(f"ground/{text[0]}", "ground", edge + (radius + 0.4 * cell) * along, text) for text, along in names),
    ]


CAMERA = 1.9
"""Size of a camera, in sphere radii."""
GHOST_AWAY = 0.3
"""Least distance from the estimated camera, in sphere radii, at which the true one is drawn with a body."""
UNDER_IMAGE = 0.98
"""Radius of the bare sphere where the query image is around it, in sphere radii."""
COLUMNS, ROWS = 96, 48
"""Numbers of cells of the sphere with the image."""
COVERAGE = Equirectangular(512, 256)
"""Panorama at whose pixels it is computed whether the camera sees the direction."""


FINE = 3
"""How often the faces of the sphere are divided."""


def base_items(view: RunView, frame: Frame) -> tuple[SceneItem, ...]:
    """The primitives that do not depend on the stage."""
    pose = frame.cam_from_map.tobytes()
    # A translucent surface hides things behind it that are drawn later: so the ghost is drawn before the sphere.
    return (
        *_ghost(view, frame),
        Points("map/points", "map", view.points, frame.colors, 0.07 * view.dot_m, view.numbers),
        *_sphere(view, frame),
        *view.kept("located", (pose, frame.located, is_close_up(frame)), lambda: _located(view, frame)),
        *view.of_map("scale bar", lambda: scale_bar("scale", view.dense_box, view.metric)),
        *view.of_map("ground", lambda: ground(view)),
    )


def _located(view: RunView, frame: Frame) -> list[SceneItem]:
    """The estimated and the true camera, as far as they are known, and the error."""
    items: list[SceneItem] = []
    if frame.located:
        items.append(camera("cameras/estimate", frame.cam_from_map, CAMERA * view.sphere_m, style.ESTIMATE, 2.5))
    if view.truth is not None:
        truth = view.truth
        items.append(view.kept("truth", None, lambda: _true_camera(view, truth)))
        if frame.located:
            ends = np.array([[camera_centre(truth), camera_centre(frame.cam_from_map)]])
            items.append(Segments("cameras/error", "cameras", ends, one_color(style.OUTLIER, 1), 3.0))
    return [*items, *error_items(view, frame)]


def _true_camera(view: RunView, truth: FloatArray) -> Segments:
    return camera("cameras/truth", truth, CAMERA * view.sphere_m, style.TRUTH, 2.5)


def _sphere(view: RunView, frame: Frame) -> list[SceneItem]:
    aligned = view.trace.problem.aligned
    key = frame.cam_from_map.tobytes(), frame.sphere_aside, _changed(view.trace.problem)
    surfaces, dots = view.kept("sphere", key, lambda: _placed_sphere(view, frame))
    drawn = even(np.flatnonzero(frame.rays[aligned.index]), style.MAX_DRAWN_RAYS)
    colors = frame.colors[aligned.index]
    return [
        *surfaces,
        Points("sphere/bearings", "sphere", dots, colors, 0.04 * view.dot_m, aligned.index),
        *_rays(view, dots[drawn], aligned.index[drawn], colors[drawn]),
    ]


def _rays(view: RunView, starts: FloatArray, matches: IntArray, colors: ByteArray) -> list[SceneItem]:
    """The lines from bearings (R, 3) to the map points of their matches (R,), in colours (R, 3); from their middle on
    those of matches that are wrong by the truth have the outliers' colour."""
    ends, right = np.stack([starts, view.points[matches]], axis=1), view.trace.problem.truth_inliers
    if right is None or right[matches].all():
        return [Segments("rays", "rays", ends, colors, 1.5)]
    wrong = np.flatnonzero(~right[matches])
    halves = np.stack([ends[wrong].mean(axis=1), ends[wrong, 1]], axis=1)
    ends[wrong, 1] = halves[:, 0]
    return [
        Segments("rays", "rays", ends, colors, 1.5),
        Segments(WRONG_RAYS, "rays", halves, one_color(style.OUTLIER, len(halves)), 1.5),
    ]


def _placed_sphere(view: RunView, frame: Frame) -> tuple[list[SceneItem], FloatArray]:
    """The sphere with the query image, and the positions (A, 3) of the bearings on it."""
    rotation, problem = frame.cam_from_map[:, :3], view.trace.problem
    centre = camera_centre(view.standing(rotation) if frame.sphere_aside else frame.cam_from_map)
    vertices, faces = icosphere(FINE)
    radius_m = view.sphere_m if problem.image is None else UNDER_IMAGE * view.sphere_m
    surface = Mesh("sphere/surface", "sphere", centre + radius_m * vertices, faces, style.SPHERE, 0.25)
    image = [] if problem.image is None else [_image(problem, centre, view.sphere_m * rotation.T)]
    return [surface, *image], centre + view.sphere_m * problem.aligned.bearings @ rotation


def _image(problem: Problem, centre: FloatArray, map_from_sphere: FloatArray) -> Textured:
    """The query image on the sphere. Vertices are bearings of the aligned camera frame."""
    vertices, faces, uv = _panorama()
    placed = np.column_stack([map_from_sphere, centre])
    key = (problem.image, _changed(problem), problem.camera, problem.aligned.camera_turn.tobytes())
    return Textured("sphere/image", "image", vertices, faces, uv, placed, partial(_sphere_image, problem), key)


def _changed(problem: Problem) -> int:
    """When the query image was written, ns; a rendered one may be written only after the run."""
    return 0 if problem.image is None else modified(problem.image)


@cache
def _panorama() -> tuple[FloatArray, np.ndarray, FloatArray]:
    """A sphere that is open along its seam: vertices (V, 3), faces (F, 3), and texture coordinates (V, 2)."""
    across, up = np.meshgrid(np.linspace(0.0, 1.0, COLUMNS + 1), np.linspace(0.0, 1.0, ROWS + 1))
    uv = np.column_stack([across.ravel(), up.ravel()])
    longitude, latitude = 2.0 * np.pi * (uv[:, 0] - 0.5), np.pi * (uv[:, 1] - 0.5)
    level = np.cos(latitude)
    vertices = np.column_stack([level * np.sin(longitude), -np.sin(latitude), level * np.cos(longitude)])
    corner = (np.arange(ROWS)[:, None] * (COLUMNS + 1) + np.arange(COLUMNS)).ravel()
    beside, above = corner + 1, corner + COLUMNS + 1
    faces = np.concatenate([np.stack(cell, axis=1) for cell in ((corner, above, beside), (beside, above, above + 1))])
    return vertices, faces, uv


def _sphere_image(problem: Problem) -> ByteArray | None:
    """The query image around the sphere, with a hole where the camera sees nothing."""
    texture = sphere_texture(problem)
    if texture is None:
        return None
    seen = _seen(problem.camera, problem.aligned.camera_turn)
    if seen.all():
        return texture
    height, width = texture.shape[:2]
    alpha = cv2.resize(seen, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(np.dstack([texture, alpha]), np.uint8)


def _seen(camera: Camera, camera_turn: FloatArray) -> ByteArray:
    """255 where the camera sees the direction of a pixel of ``COVERAGE``, else 0."""
    columns, rows = np.meshgrid(np.arange(COVERAGE.width) + 0.5, np.arange(COVERAGE.height) + 0.5)
    bearings, _ = COVERAGE.unproject(np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64))
    pixels, valid = camera.project(bearings @ camera_turn)
    return np.where(valid & in_image(camera, pixels), 255, 0).astype(np.uint8).reshape(rows.shape)


def _ghost(view: RunView, frame: Frame) -> list[Mesh]:
    """The true camera's translucent body; empty if the estimated camera is too near."""
    if view.truth is None:
        return []
    truth, away = view.truth, camera_centre(frame.cam_from_map)
    if frame.located and np.linalg.norm(camera_centre(truth) - away) < GHOST_AWAY * view.sphere_m:
        return []
    return [view.kept("ghost", None, lambda: _body(truth, CAMERA * view.sphere_m))]


def _body(cam_from_map: FloatArray, size_m: float) -> Mesh:
    corners = camera_centre(cam_from_map) + size_m * np.vstack([np.zeros(3), CORNERS]) @ cam_from_map[:, :3]
    faces = np.array([[k % 4 + 1, k, 0] for k in range(1, 5)])
    return Mesh("cameras/ghost", "cameras", corners, np.vstack([faces, faces[:, ::-1]]), style.TRUTH, 0.16)


DOT_SHARE, LEAST_DOT_SHARE = 0.06, 1e-3
"""Radius of a dot as a share of the usual distance to the nearest other one, so that dots do not hide each other, but
at least the second share of the extent of all, so that they can be seen."""


def trajectory_items(rows: Sequence[QueryResult], map_turn: FloatArray, limit_m: float) -> tuple[SceneItem, ...]:
    """Primitives of a localized sequence.

    ``rows`` are in the order of the sequence, ``map_turn`` (3, 3) turns the map to the aligned map, and ``limit_m``
    is the loosest limit of success. Few queries are named. Poses whose truth is unknown have the estimate's colour; a
    query without a pose is a dot in the outliers' colour where it truly was. True positions are joined only where the
    queries follow each other in time.
    """
    truth = np.array([row.true_position_m for row in rows]).reshape(-1, 3) @ map_turn.T
    found = np.array([row.position_m for row in rows]).reshape(-1, 3) @ map_turn.T
    errors: FloatArray = np.linalg.norm(found - truth, axis=1)
    known, located = np.isfinite(truth[:, 0]), np.isfinite(found[:, 0])
    colors = np.where(known[:, None], style.error_colors(errors, limit_m), np.array(style.ESTIMATE, np.uint8))
    places = np.where(located[:, None], found, truth)
    colors[~located] = style.OUTLIER
    shown = located | known
    followed = known[:-1] & known[1:] & timed(rows)
    legs = np.stack([truth[:-1], truth[1:]], axis=1)[followed]
    both = known & located
    offsets = np.stack([truth, found], axis=1)[both]
    taken = tuple(row.query for row, is_shown in zip(rows, shown, strict=True) if is_shown)
    dot_m = _dot_radius_m(places[shown]) or limit_m
    above = np.array([0.0, -3.0 * dot_m, 0.0])  # names of the map's images are below their dots
    names = [
        Label(f"trajectory/name-{k}", "trajectory", place + above, name)
        for k, place, name in zip(np.flatnonzero(shown).tolist(), places[shown], taken, strict=True)
    ]
    return (
        Points("trajectory/queries", "trajectory", places[shown], colors[shown], dot_m, photographs=taken),
        Segments("trajectory/truth", "trajectory", legs, one_color(style.TRUTH, len(legs)), 2.0),
        Segments("trajectory/errors", "trajectory", offsets, colors[both], 2.0),
        *(names if len(names) <= MAX_NAMED else ()),
    )


def _dot_radius_m(places: FloatArray) -> float:
    """Radius of dots at places (K, 3), of which those at one spot count once; 0 if they are all at one spot."""
    from scipy.spatial import KDTree  # takes half a second

    spots = np.unique(places, axis=0)
    if len(spots) < 2:
        return 0.0
    nearest = KDTree(spots).query(spots, k=2)[0][:, 1]
    return max(DOT_SHARE * float(np.median(nearest)), LEAST_DOT_SHARE * extent_of(spots))
