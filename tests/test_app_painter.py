"""The painter changes what is on the canvas instead of drawing it anew, and hides what a picture does not show."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, cast

import numpy as np
import pytest
import viser

from spherloc_viz import style
from spherloc_viz.app.painter import MOST_BATCHED, SHELLS, Painter
from spherloc_viz.app.viser_seams import start_viser, stop_viser
from spherloc_viz.layers.frame import one_color
from spherloc_viz.layers.primitives import Balls, Mesh, Points, Segments

ALL = frozenset(style.LAYERS)


class Canvas:
    """viser's own scene, with a note of what was added to it, in order."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self.scene = scene
        self.added: list[str] = []
        self.nodes: dict[str, Any] = {}
        self.calls: dict[str, tuple[str, dict[str, Any]]] = {}

    def __getattr__(self, method: str) -> Any:
        real = getattr(self.scene, method)

        def add(name: str, *args: Any, **props: Any) -> Any:
            self.added.append(name)
            self.calls[name] = method, props
            self.nodes[name] = real(name, *args, **props)
            return self.nodes[name]

        return add if method.startswith("add_") else real

    @property
    def shown(self) -> set[str]:
        return {name for name, node in self.nodes.items() if node.visible}


@dataclass
class Client:
    """What a painter needs of a client."""

    scene: Any
    atomic: Any


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    server = start_viser("a key of this test")
    yield server
    stop_viser(server)


@pytest.fixture
def canvas(server: viser.ViserServer) -> Canvas:
    server.scene.reset()
    return Canvas(server.scene)


@pytest.fixture
def painter(server: viser.ViserServer, canvas: Canvas) -> Painter:
    return Painter(cast(viser.ClientHandle, Client(canvas, server.atomic)))


def dots(count: int, at: float = 0.0, color: style.RGB = style.INLIER) -> Points:
    return Points("map/points", "map", np.full((count, 3), at), one_color(color, count), 0.1, np.arange(count))


def rays(count: int) -> Segments:
    return Segments("rays", "rays", np.zeros((count, 2, 3)), one_color(style.INLIER, count), 1.5)


def test_what_keeps_its_size_is_changed_in_place(painter: Painter, canvas: Canvas) -> None:
    painter.draw([dots(5)], ALL)
    painter.draw([dots(5, at=2.0, color=style.OUTLIER)], ALL)
    assert canvas.added == ["/map/points"]
    node = canvas.nodes["/map/points"]
    assert np.all(node.batched_positions == 2.0)
    assert node.batched_colors[0, 0] > node.batched_colors[0, 1], "red"


def test_what_changes_its_size_is_added_again(painter: Painter, canvas: Canvas) -> None:
    painter.draw([dots(5)], ALL)
    painter.draw([dots(6)], ALL)
    assert canvas.added == ["/map/points"] * 2


def test_stepping_hides_and_shows(painter: Painter, canvas: Canvas) -> None:
    painter.draw([dots(5), rays(3)], ALL)
    painter.draw([dots(5), rays(0)], ALL)
    assert canvas.shown == {"/map/points"}
    painter.draw([dots(5)], ALL)
    assert canvas.shown == {"/map/points"}
    painter.draw([dots(5), rays(3)], ALL)
    assert canvas.shown == {"/map/points", "/rays"}
    assert canvas.added == ["/map/points", "/rays"], "nothing was removed or added on the way"


def test_layers_switch_off(painter: Painter, canvas: Canvas) -> None:
    for layers, expected in ((ALL - {"rays"}, {"/map/points"}), (frozenset(), set()), (ALL, {"/map/points", "/rays"})):
        painter.draw([dots(5), rays(3)], frozenset(layers))
        assert canvas.shown == expected


def test_many_dots_become_a_cloud_of_full_precision(painter: Painter, canvas: Canvas) -> None:
    painter.draw([dots(MOST_BATCHED)], ALL)
    assert canvas.calls["/map/points"][0] == "add_batched_meshes_simple"
    painter.draw([dots(MOST_BATCHED + 1)], ALL)
    node = canvas.nodes["/map/points"]
    method, props = canvas.calls["/map/points"]
    assert method == "add_point_cloud" and props["precision"] == "float32"
    assert node.points.dtype == np.float32 and np.array_equal(node.colors[0], style.INLIER), "clouds take sRGB"


def test_lines_have_a_colour_at_each_end(painter: Painter, canvas: Canvas) -> None:
    painter.draw([rays(3)], ALL)
    node = canvas.nodes["/rays"]
    assert node.colors.shape == (3, 2, 3) and node.colors.dtype == np.uint8
    assert (node.thickness, node.thickness_units) == (1.5, "screen")


@pytest.mark.parametrize("count", [1, 7, SHELLS, 80])
def test_balls_are_drawn_from_the_smallest_to_the_largest(painter: Painter, canvas: Canvas, count: int) -> None:
    """Else a large one would hide those in it."""
    rng = np.random.default_rng(count)
    for _ in range(2):
        radii = rng.uniform(0.1, 9.0, count)
        balls = Balls("balls/clique", "balls", rng.normal(size=(count, 3)), radii, one_color(style.CLIQUE, count), 0.2)
        painter.draw([balls], ALL)
        parts = [canvas.nodes[name].batched_scales for name in canvas.added]
        assert np.array_equal(np.sort(np.float32(radii)), np.sort(np.concatenate(parts)))
        assert all(inner.max() <= outer.min() for inner, outer in pairwise(parts))
        assert all(name.startswith("/balls/clique/") for name in canvas.added)
    assert len(canvas.added) == min(count, SHELLS), "the second picture changed the first one's nodes"


def test_another_number_of_balls_adds_all_shells_again(painter: Painter, canvas: Canvas) -> None:
    """Nodes are drawn in the order in which they were added, so one alone may not be replaced."""
    for count in (24, 25):
        canvas.added.clear()
        radii = np.linspace(1.0, 2.0, count)
        painter.draw(
            [Balls("balls/clique", "balls", np.zeros((count, 3)), radii, one_color(style.CLIQUE, count), 0.2)], ALL
        )
        assert len(canvas.added) == SHELLS


def test_a_mesh_moves_but_its_colour_adds_it_anew(painter: Painter, canvas: Canvas) -> None:
    faces = np.array([[0, 1, 2]])
    for at, color in ((0.0, style.SPHERE), (1.0, style.SPHERE), (1.0, style.CLIQUE)):
        painter.draw([Mesh("sphere/surface", "sphere", np.full((3, 3), at), faces, color, 0.2)], ALL)
    assert canvas.added == ["/sphere/surface"] * 2
    node = canvas.nodes["/sphere/surface"]
    assert node.opacity == 0.2 and not node.cast_shadow
