"""The primitives that a painter can draw. Both the page and the recording draw these and nothing else.

Scene positions are metres in the gravity-aligned map frame: y points down. Colours are sRGB bytes.
"""

import re
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from spherloc.types import ByteArray, FloatArray

HYPHEN_MINUS = re.compile(r"(?<![\w.)\]])-(?=\.?\d)")
"""A hyphen that stands for a minus sign: before a number, and not behind a word or a number as in a range."""


def true_minus(text: str) -> str:
    """Text with minus signs in place of the hyphens that Python writes before negative numbers."""
    return HYPHEN_MINUS.sub("\N{MINUS SIGN}", text) if "-" in text else text


@dataclass(frozen=True, eq=False)
class Primitive:
    """Base of all scene primitives."""

    name: str
    """Unique path within a picture, such as "camera/estimate"; stable over steps and runs."""
    layer: str
    """The layer that users switch on and off; one of ``style.LAYERS``."""


@dataclass(frozen=True, eq=False)
class Points(Primitive):
    """Dots."""

    positions: FloatArray
    """(N, 3) positions, metres."""
    colors: ByteArray
    """(N, 3) colours, sRGB."""
    radius_m: float
    """Radius of every dot, metres."""
    ids: NDArray[np.int64] | None = None
    """(N,) index of the correspondence that each dot shows, if it shows one."""
    photographs: tuple[str, ...] = ()
    """(N,) name of the photograph that was taken at each dot, if the dots show that; else empty."""
    rim: bool = False
    """Whether only the rim of a dot is seen, around a smaller dot at the same position: a ring from every direction."""


@dataclass(frozen=True, eq=False)
class Segments(Primitive):
    """Straight lines."""

    points: FloatArray
    """(N, 2, 3) ends of the lines, metres."""
    colors: ByteArray
    """(N, 3) colours, sRGB."""
    width_px: float
    """Thickness on the screen, px."""
    ids: NDArray[np.int64] | None = None
    """(N, 2) the two correspondences that each line shows, if it shows a pair."""


@dataclass(frozen=True, eq=False)
class Balls(Primitive):
    """Translucent spheres."""

    centers: FloatArray
    """(N, 3) centres, metres."""
    radii_m: FloatArray
    """(N,) radii, metres."""
    colors: ByteArray
    """(N, 3) colours, sRGB."""
    opacity: float
    """Opacity of every ball, 0 to 1."""
    ids: NDArray[np.int64] | None = None
    """(N, 2) the two correspondences that each ball shows, if it shows a pair."""


@dataclass(frozen=True, eq=False)
class Mesh(Primitive):
    """A triangle mesh of one colour."""

    vertices: FloatArray
    """(V, 3) vertices, metres."""
    faces: NDArray[np.int64]
    """(F, 3) indices of vertices."""
    color: tuple[int, int, int]
    opacity: float
    """Opacity of the surface, 0 to 1."""


@dataclass(frozen=True, eq=False)
class Textured(Primitive):
    """A triangle mesh with a texture, visible from both sides."""

    vertices: FloatArray
    """(V, 3) vertices in the mesh's own frame."""
    faces: NDArray[np.int64]
    """(F, 3) indices of vertices."""
    uv: FloatArray
    """(V, 2) position of each vertex in the texture, from its lower left corner, 0 to 1."""
    map_from_mesh: FloatArray
    """(3, 4) rotation times scale, and translation, so that a mesh that moves keeps its vertices and its texture."""
    image: Callable[[], ByteArray | None]
    """Makes the texture, (H, W, 3) sRGB or (H, W, 4) with holes where the last is below 128; None if there is none."""
    key: Hashable
    """Equal keys mean equal meshes with equal textures: a texture is large, so it is made and sent only once."""


@dataclass(frozen=True, eq=False)
class Label(Primitive):
    """A text at a position, which keeps its size on the screen."""

    position: FloatArray
    """(3,) position of its middle, metres."""
    text: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "text", true_minus(self.text))


SceneItem = Points | Segments | Balls | Mesh | Textured | Label


@dataclass(frozen=True, eq=False)
class Focus:
    """The subject of a step, and the direction from which it can be read well."""

    view: Literal["Overview", "Sphere", "Balls"]
    """Name of the view from whose direction the step is seen."""
    points: FloatArray
    """(K, 3) points that must be on the screen."""
    clear: FloatArray | None = None
    """(L, 3) points that map points should not hide; None takes ``points``. Steps with equal ones are seen from the
    same side."""


@dataclass(frozen=True, eq=False)
class Curve:
    """One line of a chart."""

    label: str
    x: FloatArray
    """(K,) x of its points, ascending."""
    y: FloatArray
    """(K,) y of its points."""
    color: tuple[int, int, int]
    kind: Literal["line", "step", "marker", "level"] = "line"
    """"step" holds y[k] from x[k] to x[k + 1]; "marker" is an upright line at x[0] from y = 0 to y[0]; "level" is a
    line from (x[0], y[0]) to (x[1], y[0]), a limit with which other curves are compared."""


@dataclass(frozen=True, eq=False)
class Chart:
    """A plot."""

    name: str
    """Unique in a picture, such as "yaw"."""
    title: str
    x_label: str
    y_label: str
    curves: tuple[Curve, ...]


@dataclass(frozen=True, eq=False)
class Nodes:
    """The nodes of a run's graph that are drawn, K of them, in the order of the matrix: the maximum clique first, then
    those that agree with most of it."""

    name: str
    """Name of one node, such as "ball"."""
    number: NDArray[np.int64]
    """(K,) index of each node in its stage."""
    total: int
    """Number of nodes, drawn or not."""
    places: FloatArray
    """(K, 2) positions in the drawing, from -1 to 1: nodes near the clique in space are near the middle, in their
    directions."""
    matches: NDArray[np.int64]
    """(K, P) the correspondences of each node: two for a ball, one for a match."""
    agrees: NDArray[np.bool_]
    """(K, K) whether two nodes agree: symmetric, false on the diagonal."""
    clique: int
    """Number of nodes of the maximum clique, which come first."""

    @cached_property
    def edges(self) -> NDArray[np.int64]:
        """(E, 2) nodes that agree, the first of each pair being the smaller."""
        return np.argwhere(np.triu(self.agrees))

    def lit(self, selected: tuple[int, ...]) -> NDArray[np.int64]:
        """Nodes of the selected correspondences: for one, all nodes with it; for several, the nodes among them."""
        inside = np.isin(self.matches, selected).sum(axis=1)
        return np.flatnonzero(inside >= max(1, min(self.matches.shape[1], len(selected))))


@dataclass(frozen=True, eq=False)
class BallRows:
    """All balls that the steps so far have added, T of them, drawn in the graph or not: those that the step is about
    first, and the small ones of both first."""

    pairs: NDArray[np.int64]
    """(T, 2) the correspondences of each ball."""
    radii: tuple[str, ...]
    """Radius of each ball, as text with its unit."""
    overlaps: NDArray[np.int64]
    """(T,) number of others among these that each ball overlaps."""
    marked: int
    """Number of balls that the step is about, which come first."""


@dataclass(frozen=True, eq=False)
class Graph:
    """The graph as a step shows it."""

    nodes: Nodes
    shown: NDArray[np.bool_]
    """(K,) mask of the nodes that the steps so far have added."""
    count: int
    """Number of nodes that the steps so far have added, drawn or not."""
    marked: NDArray[np.bool_]
    """(K,) mask of the nodes that the step is about."""
    color: tuple[int, int, int]
    """Colour of the marked nodes."""
    words: str
    """A sentence that says what is marked."""
    list_balls: Callable[[], BallRows] | None = None
    """Lists the balls, if the nodes are balls."""


@dataclass(frozen=True, eq=False)
class Table:
    """Rows of text and numbers."""

    name: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]

    def __post_init__(self) -> None:
        rows = (tuple(true_minus(word) if isinstance(word, str) else word for word in row) for row in self.rows)
        object.__setattr__(self, "rows", tuple(rows))


@dataclass(frozen=True)
class StepHeading:
    """The part of a step that is known before it is painted."""

    key: str
    """Stable name, such as "yaw-arcs" or "sample-3"."""
    title: str
    """Title of the step, a few words."""
    stage: str = ""
    """Named stage, such as "Yaw"."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "title", true_minus(self.title))


@dataclass(frozen=True, eq=False)
class Step:
    """The texts of one step of a run."""

    key: str
    """Stable name, such as "yaw-arcs" or "sample-3"."""
    title: str
    """Title of the step, a few words."""
    caption: str
    """Two sentences with this run's own numbers, plain text."""
    equation: str
    """The equation that this step computes, with its number in the paper, plain text; may be empty."""
    note: str = ""
    """What the picture leaves out and by which rule, plain text; may be empty."""
    stage: str = ""
    """Named stage, such as "Yaw"."""

    def __post_init__(self) -> None:
        for name in ("title", "caption", "note"):
            object.__setattr__(self, name, true_minus(getattr(self, name)))


@dataclass(frozen=True, eq=False)
class Picture:
    """The picture of a step of a run."""

    step: Step
    scene: tuple[SceneItem, ...]
    tables: tuple[Table, ...]
    focus: Focus
    draw_charts: Callable[[], tuple[Chart, ...]] = tuple
    """Makes the charts; charts and graph are made when they are first used."""
    draw_graph: Callable[[], Graph | None] = lambda: None

    @property
    def charts(self) -> tuple[Chart, ...]:
        """Charts of this step and of the steps before it."""
        return self.draw_charts()

    @property
    def graph(self) -> Graph | None:
        """The run's graph as known at this step; None before there is one."""
        return self.draw_graph()
