"""A frame: one step of a run, before it is turned into primitives.

A run has up to 200 steps and a page shows one at a time, so a step is planned first, which costs next to nothing, and
drawn when it is looked at.
"""

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field
from functools import cache, cached_property, lru_cache
from itertools import combinations
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from spherloc.bounds import Bounds, bounds_of
from spherloc.geometry import camera_centre, pose
from spherloc.metrics import AWAY, BEYOND, extent_of, is_beyond, said_length
from spherloc.refine import residuals_px
from spherloc.trace import Trace
from spherloc.types import BoolArray, ByteArray, FloatArray
from spherloc_viz import style
from spherloc_viz.layers.primitives import Chart, Focus, Graph, SceneItem, Table

T = TypeVar("T")

SPHERE_SHARE = 0.17
"""Radius at which the unit sphere is drawn, as a share of the map's typical extent."""
DENSE = (0.05, 0.95)
"""Quantiles of each coordinate between which the map lies; points outside count as strays."""
FEW_DOTS = 200
"""Largest number of dots with full size; if there are more, dots are smaller."""
MAPS = 8
"""Number of maps whose points were last shown of which is kept what does not depend on the run."""


@dataclass(frozen=True, eq=False)
class Frame:
    """Caption and contents of one step."""

    caption: str
    """Two sentences with this run's own numbers."""
    equation: str
    cam_from_map: FloatArray
    """Pose (3, 4) between the aligned frames: the camera's, or that of the sphere before a position is known."""
    colors: ByteArray
    """(N, 3) colour of every correspondence, sRGB."""
    rays: BoolArray
    """(N,) mask: correspondences whose match is drawn as a line."""
    note: str = ""
    """What the picture leaves out and by which rule."""
    located: bool = False
    """Whether the position is an estimate, so that the camera is drawn; otherwise only the sphere is."""
    sphere_aside: bool = False
    """Whether the sphere stays in the middle of the map, where it does not hide the estimated position."""
    items: tuple[SceneItem, ...] = ()
    """Primitives that this stage adds to the canvas."""
    tables: tuple[Table, ...] = ()
    focus: Focus | None = None
    """The part of the scene that must be on the screen; None derives it from the fields above (``focus_of``)."""


@dataclass(frozen=True, eq=False)
class Plan:
    """A step and how to draw it."""

    key: str
    """Stable name, such as "yaw-arcs-100"."""
    title: str
    draw: Callable[[], Frame]
    charts: Mapping[str, Callable[[], Chart]] = field(default_factory=dict)
    """Charts by name. They stay until a later step has one of the same name."""
    graph: Callable[[], Graph] | None = None
    """Makes the graph as the step shows it. It is kept until a later step has one."""
    untold: Callable[[], Frame] | None = None
    """Draws the step so that neither this nor its title, charts and graph tell what came out of the run; None if they
    do, so that the step is not shown while answers are hidden."""


@dataclass(frozen=True, eq=False)
class RunView:
    """A trace, with values that all of its frames share."""

    trace: Trace
    _kept: dict[str, tuple[Hashable, Any]] = field(default_factory=dict, init=False)

    def kept(self, name: str, key: Hashable, make: Callable[[], T]) -> T:
        """The result of ``make``, which is called again only if the ``key`` differs from that of the last call.

        Most steps of a run show what the step before them shows. The same object need not be compared.
        """
        known = self._kept.get(name)
        if known is None or known[0] != key:
            known = self._kept[name] = key, make()
        return known[1]

    def of_map(self, name: str, make: Callable[[], T]) -> T:
        """The result of ``make``, which depends on the points of the map and their unit alone. Runs with the same
        points, as while a slider of the noise is dragged, share it."""
        if name not in self._of_map:
            self._of_map[name] = make()
        return self._of_map[name]

    @cached_property
    def _of_map(self) -> dict[str, Any]:
        points = self.trace.problem.points @ self.trace.problem.aligned.map_turn.T
        made = _made_of_map(points.tobytes(), self.trace.problem.unit)
        made.setdefault("points", points)
        return made

    @property
    def points(self) -> FloatArray:
        """Map points (N, 3) in the aligned map frame, metres."""
        return self._of_map["points"]

    @cached_property
    def numbers(self) -> NDArray[np.int64]:
        """(N,) indices of the correspondences."""
        return np.arange(len(self.points))

    @cached_property
    def middle(self) -> FloatArray:
        """Component-wise median (3,) of the map points."""
        return self.of_map("middle", lambda: np.median(self.points, axis=0))

    @cached_property
    def dense_box(self) -> FloatArray:
        """Lower and upper corner (2, 3) of the map without its strays."""
        ends = [round(share * (len(self.points) - 1)) for share in DENSE]
        return self.of_map("dense box", lambda: np.partition(self.points, ends, axis=0)[ends])

    @cached_property
    def sphere_m(self) -> float:
        """Radius at which the unit sphere is drawn, metres."""
        away = self.of_map("away", lambda: float(np.median(np.linalg.norm(self.points - self.middle, axis=1))))
        return SPHERE_SHARE * max(away, 1e-3)

    @cached_property
    def dot_m(self) -> float:
        """Unit of the sizes of dots, metres: the sphere's radius, or less if there are many dots."""
        return self.sphere_m * min(1.0, (FEW_DOTS / len(self.points)) ** (1 / 3))

    @cached_property
    def truth(self) -> FloatArray | None:
        """True pose (3, 4) between the aligned frames, if known."""
        known = self.trace.problem.truth_cam_from_map
        return None if known is None else self.trace.problem.aligned.align_pose(known)

    @cached_property
    def bounds(self) -> Bounds:
        """Bounds on an inlier's residual."""
        return bounds_of(self.trace.problem.aligned, self.trace.options.bound_px)

    def standing(self, rotation: FloatArray) -> FloatArray:
        """A pose (3, 4) in the middle of the map with a given rotation, used before a position is known."""
        return pose(rotation, -rotation @ self.middle)

    def aligned_pose(self, cam_from_map: FloatArray) -> FloatArray:
        """A pose (3, 4) of the trace, between the aligned frames."""
        return self.trace.problem.aligned.align_pose(cam_from_map)

    def residuals_px(self, cam_from_map: FloatArray) -> FloatArray:
        """Reprojection error (N,) at an aligned pose (3, 4), px; inf for points behind their bearings and for pixels
        without one."""
        aligned = self.trace.problem.aligned
        out = np.full(len(self.points), np.inf)
        out[aligned.index] = residuals_px(aligned, cam_from_map)
        return out

    def colors(self, color: style.RGB, *marks: tuple[np.ndarray, style.RGB]) -> ByteArray:
        """Colours (N, 3): one for all, then others for masks or indices; later ones override earlier ones."""
        out = np.empty((len(self.points), 3), np.uint8)
        out[:] = color
        for where, mark in marks:
            out[where] = mark
        return out

    def no_matches(self) -> BoolArray:
        """A mask (N,) that is false everywhere."""
        return np.zeros(len(self.points), dtype=bool)

    def mask(self, indices: np.ndarray) -> BoolArray:
        """A mask (N,) of the correspondences of these indices, of any shape."""
        out = self.no_matches()
        out[indices.ravel()] = True
        return out

    def shares(self, indices: np.ndarray) -> FloatArray:
        """(N,) how often each correspondence is among these indices, of any shape, as a share of the largest number."""
        counts = np.bincount(indices.ravel(), minlength=len(self.points))
        return counts / max(1, counts.max(initial=0))

    def position(self, cam_from_map: FloatArray) -> str:
        """Camera position of an aligned pose in the problem's own map frame, as text."""
        return self.place(camera_centre(cam_from_map))

    def place(self, position: FloatArray) -> str:
        """A place (3,) of the aligned map frame in the problem's own map frame, as text."""
        if self.is_away(position):
            return AWAY
        return place_text(self.trace.problem.aligned.map_turn.T @ position, 2, self.metric)

    def is_away(self, position: FloatArray) -> bool:
        """Whether a place (3,) of the aligned map frame is absurdly far away from the map."""
        return is_beyond(float(np.linalg.norm(position - self.middle)), self.extent_m)

    @property
    def extent_m(self) -> float:
        """The extent of the map points, see ``spherloc.metrics.extent_of``."""
        return self.of_map("extent", lambda: extent_of(self.points))

    @property
    def metric(self) -> bool:
        """Whether the map's lengths are metres; else they are its own units."""
        return self.trace.problem.metric

    def length(self, metres: float) -> str:
        """A length as text, see ``length``."""
        return length(metres, self.metric, self.extent_m)

    def length_text(self, metres: float) -> str:
        """A length as text, see ``length_text``."""
        return length_text(metres, self.metric, self.extent_m)

    def fixed_length(self, metres: float, digits: int) -> str:
        """A length as text with that many digits behind the point, in metres or units of the map; see ``length``."""
        return said_length(metres, self.extent_m, f"{metres:.{digits}f} {self.trace.problem.unit}")

    def right_ones(self, indices: np.ndarray) -> str:
        """Number of right ones among these correspondences, as part of a sentence; empty if unknown."""
        labels = self.trace.problem.truth_inliers
        return "" if labels is None else f", {np.count_nonzero(labels[indices])} of them right ones"


def one_color(color: style.RGB, count: int) -> ByteArray:
    """An array (count, 3) of one colour."""
    out = np.empty((count, 3), np.uint8)
    out[:] = color
    return out


@cache
def icosphere(divisions: int) -> tuple[FloatArray, NDArray[np.int64]]:
    """The unit sphere: vertices (10 · 4^n + 2, 3) and faces (20 · 4^n, 3), seen from outside, of an icosahedron whose
    faces were divided into four n times. (trimesh has one, and takes a second to import.)"""
    golden = (1.0 + np.sqrt(5.0)) / 2.0
    corners = np.array([[0.0, a, b * golden] for a in (-1.0, 1.0) for b in (-1.0, 1.0)])
    vertices = np.concatenate([np.roll(corners, shift, axis=1) for shift in range(3)])
    near = np.isclose(np.linalg.norm(vertices[:, None] - vertices, axis=2), 2.0)
    faces = np.array([face for face in combinations(range(12), 3) if near[np.ix_(face, face)].sum() == 6])
    inward = np.linalg.det(vertices[faces]) < 0.0
    faces[inward] = faces[inward][:, ::-1]
    vertices /= np.linalg.norm(vertices[0])
    for _ in range(divisions):
        sides = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        edges, middle = np.unique(sides, axis=0, return_inverse=True)
        ab, bc, ca = (len(vertices) + middle.reshape(-1, 3)).T
        a, b, c = faces.T
        middles = vertices[edges].sum(axis=1)
        vertices = np.concatenate([vertices, middles / np.linalg.norm(middles, axis=1, keepdims=True)])
        parts = (a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)
        faces = np.concatenate([np.stack(part, axis=1) for part in parts])
    return vertices, faces


def even(indices: np.ndarray, count: int) -> np.ndarray:
    """At most ``count`` of the indices, evenly spaced."""
    if len(indices) <= count:
        return indices
    # No two are equal, since they are more than 1 apart before they are rounded.
    return indices[np.linspace(0, len(indices) - 1, count).round().astype(int)]


def growing(total: int, *sizes: int) -> list[int]:
    """The sizes below ``total``, at which something of that size is shown while it grows."""
    return [size for size in sizes if size < total]


def place_text(position: FloatArray, digits: int, metric: bool = True) -> str:
    """A position (3,) as text, in metres or, if not ``metric``, units of the map."""
    unit = "m" if metric else UNITS
    return f"({', '.join(f'{value:.{digits}f}' for value in position)}) {unit}".replace("-", "−")


def length(metres: float, metric: bool = True, extent_m: float = np.inf) -> str:
    """A length as text: in metres, or centimetres if it is short; if not ``metric``, in units of the map. In words if
    it is absurd in a map of that extent (``spherloc.metrics.extent_of``)."""
    if is_beyond(metres, extent_m):
        return BEYOND
    if not metric:
        return f"{metres:.3g} {UNITS}"
    if metres >= 1.0:
        return f"{metres:.2f} m"
    digits = 0 if metres >= 0.1 else 1 if metres >= 0.01 else 2
    return f"{100.0 * metres:.{digits}f} cm" if metres >= MIN_M else "less than 0.1 mm"


MIN_M = 1e-4
"""Shorter lengths are written as "less than" this."""


UNIT, UNITS = "unit", "units"
"""Unit of a map whose scale is unknown."""


def length_text(length_m: float, metric: bool = True, extent_m: float = np.inf) -> str:
    """A length as text with two digits, in a unit that suits its size; if not ``metric``, in units of the map. In words
    if it is absurd in a map of that extent (``spherloc.metrics.extent_of``)."""
    if is_beyond(length_m, extent_m):
        return BEYOND
    if not metric:
        return f"{length_m:.2g} {UNIT if length_m == 1.0 else UNITS}"
    if 0.0 < length_m < MIN_M:
        return "< 0.1 mm"
    for unit, metres in (("km", 1000.0), ("m", 1.0), ("cm", 0.01)):
        if length_m >= 0.995 * metres:
            return f"{_digits(length_m / metres)} {unit}"
    return f"{_digits(1000.0 * length_m)} mm"


def angle_text(angle_deg: float) -> str:
    """An angle as text, with two digits behind the point if it is small."""
    return (
        f"{angle_deg:.3f}°" if angle_deg < 0.0995 else f"{angle_deg:.2f}°" if angle_deg < 9.95 else f"{angle_deg:.0f}°"
    )


def _digits(value: float) -> str:
    return f"{value:.2g}" if value < 99.5 else f"{value:.0f}"


STRAY = 4.0
"""Map points farther from the middle than this many times the median distance are not framed: they would make all
others small."""
SPHERE_ROOM = 1.35
"""Radius of what is framed around the unit sphere, in sphere radii."""
RING_ROOM = 3.0
"""Radius of the yaw ring with its outline, in sphere radii."""
CAMERA_ROOM = 2.0
"""Radius of what is framed around a camera, in sphere radii."""
FEW_SEEN = 10
"""Least number of seen points that show where a camera is in the map."""
FEW_BALLS = 3
"""Largest number of balls that are all framed completely."""


@lru_cache(maxsize=MAPS)
def _made_of_map(points: bytes, unit: str) -> dict[str, Any]:
    """What was made of these points, by name: nothing at first."""
    return {}


def focus_of(view: RunView, frame: Frame) -> Focus:
    """The focus of a frame: its own, else its ring, else its sphere; the whole map where matches are drawn as rays or
    the camera has a position."""
    if frame.focus is not None:
        return frame.focus
    if any(item.layer == "yaw ring" for item in frame.items):
        return ring_focus(view)
    if frame.located or frame.rays.any() or any(item.layer == "pairs" for item in frame.items):
        return map_focus(view, frame.cam_from_map)
    return Focus("Sphere", view.of_map("sphere focus", lambda: sphere_box(view.middle, SPHERE_ROOM * view.sphere_m)))


def ring_focus(view: RunView, *more: FloatArray) -> Focus:
    """The yaw ring, and ``more`` points (K, 3)."""
    ring = view.of_map("ring focus", lambda: circle(view.middle, RING_ROOM * view.sphere_m))
    return Focus("Sphere", np.vstack([ring, *more]) if more else ring, ring)


def map_focus(view: RunView, cam_from_map: FloatArray, seen: BoolArray | None = None) -> Focus:
    """The map without its strays, the true camera, and a camera at a pose (3, 4). Of the map only the ``seen`` points
    (N,), if these are enough to show where the camera is: a street is much longer than the part that is seen."""
    if seen is not None and np.count_nonzero(seen) >= FEW_SEEN:
        dense = dense_points(view.points[seen])
    else:
        dense = view.of_map("dense map", lambda: dense_points(view.points))
    cameras = [cam_from_map] if view.truth is None else [cam_from_map, view.truth]
    boxes = [sphere_box(camera_centre(pose), CAMERA_ROOM * view.sphere_m) for pose in cameras]
    return Focus("Overview", np.vstack([dense, *boxes]), dense)


def close_focus(view: RunView, cam_from_map: FloatArray, *more: FloatArray) -> Focus:
    """A camera at a pose (3, 4), and ``more`` points (K, 3)."""
    box = sphere_box(camera_centre(cam_from_map), CAMERA_ROOM * view.sphere_m)
    return Focus("Sphere", np.vstack([box, *more]))


def dense_points(positions: FloatArray) -> FloatArray:
    """The points (N, 3) without strays."""
    away = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    return positions[away <= STRAY * np.median(away)]


def sphere_box(centre: FloatArray, reach_m: float) -> FloatArray:
    """Points (6, 3) at a distance along all axes from a position."""
    sides = np.vstack([np.eye(3), -np.eye(3)])
    return centre + reach_m * sides


def circle(centre: FloatArray, radius_m: float) -> FloatArray:
    """Points (36, 3) of a horizontal circle."""
    angle = np.linspace(0.0, 2.0 * np.pi, 36, endpoint=False)
    return centre + radius_m * np.column_stack([np.cos(angle), 0.0 * angle, np.sin(angle)])


def level_circles(centers: FloatArray, radii_m: FloatArray) -> FloatArray:
    """Lines (48 B, 2, 3) of the level circles around balls (B, 3), (B,)."""
    turns = np.linspace(0.0, 2.0 * np.pi, 49)
    level = np.column_stack([np.cos(turns), 0.0 * turns, np.sin(turns)])
    lines = centers[:, None] + radii_m[:, None, None] * level
    return np.stack([lines[:, :-1], lines[:, 1:]], axis=2).reshape(-1, 2, 3)


def ball_boxes(centers: FloatArray, radii_m: FloatArray) -> FloatArray:
    """Points (K, 3) to all sides of balls (B, 3), (B,): of all of a few; of more, of the denser half.

    These are the balls nearest to the median of the smaller half: a ball as large as the map holds it all in it.
    """
    if len(radii_m) > FEW_BALLS:
        small = np.argsort(radii_m, kind="stable")[: max(1, len(radii_m) // 2)]
        away = np.linalg.norm(centers - np.median(centers[small], axis=0), axis=1)
        near = np.argsort(away, kind="stable")[: max(FEW_BALLS, len(away) // 2)]
    else:
        near = np.arange(len(radii_m))
    # Not two corners of a box: seen along its diagonal they are one.
    return np.vstack([sphere_box(centers[ball], float(radii_m[ball])) for ball in near])
