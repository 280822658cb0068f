"""The painter changes what is on the canvas instead of drawing it anew, and hides what a picture does not show."""

import json
from dataclasses import dataclass
from itertools import pairwise
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import trimesh
import viser

from spherloc_viz import style
from spherloc_viz.app.stage.painter import LARGEST_DOT, LARGEST_DOT_INSIDE, MAX_BATCHED, SHELLS, Painter
from spherloc_viz.layers.frame import one_color
from spherloc_viz.layers.primitives import Balls, Label, Mesh, Points, Segments, Textured
from spherloc_viz.layers.selection import HALO

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


@pytest.fixture
def canvas(server: viser.ViserServer) -> Canvas:
    server.scene.reset()
    return Canvas(server.scene)


@pytest.fixture
def picks() -> list[tuple[tuple[int, ...], bool]]:
    """What was picked, and whether it extends the selection."""
    return []


@pytest.fixture
def painter(server: viser.ViserServer, canvas: Canvas, picks: list[tuple[tuple[int, ...], bool]]) -> Painter:
    server.scene._scene_pointer_cb.clear()
    client = cast(viser.ClientHandle, Client(canvas, server.atomic))
    return Painter(client, lambda ids, extend: picks.append((ids, extend)))


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


def test_what_is_hidden_stays_so_until_it_is_shown_again(painter: Painter, canvas: Canvas) -> None:
    painter.draw([dots(5), rays(3)], ALL)
    painter.hide(frozenset({"rays", "nothing"}))
    assert canvas.shown == {"/map/points"}
    painter.draw([dots(5), rays(4)], ALL)
    assert canvas.shown == {"/map/points"}
    painter.hide(frozenset())
    assert canvas.shown == {"/map/points", "/rays"}
    painter.draw([dots(5), rays(4)], ALL - {"rays"})
    painter.hide(frozenset({"map/points"}))
    painter.hide(frozenset())
    assert canvas.shown == {"/map/points"}, "a layer that is off stays off"


def test_many_dots_become_a_cloud_of_full_precision(painter: Painter, canvas: Canvas) -> None:
    painter.draw([dots(MAX_BATCHED)], ALL)
    assert canvas.calls["/map/points"][0] == "add_batched_meshes_simple"
    painter.draw([dots(MAX_BATCHED + 1)], ALL)
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


def test_words_move_and_change_in_place(painter: Painter, canvas: Canvas) -> None:
    painter.draw([Label("scale/length", "scale bar", np.zeros(3), "1 m")], ALL)
    painter.draw([Label("scale/length", "scale bar", np.ones(3), "2 m")], ALL)
    node = canvas.nodes["/scale/length"]
    assert canvas.added == ["/scale/length"] and node.text == "2 m" and np.all(node.position == 1.0)
    painter.draw([Label("scale/length", "scale bar", np.ones(3), "")], ALL)
    assert not canvas.shown


def test_words_grow_for_a_lecture(painter: Painter, canvas: Canvas) -> None:
    painter.draw([Label("scale/length", "scale bar", np.zeros(3), "1 m"), dots(3)], ALL)
    painter.scale_labels(2.5)
    assert canvas.nodes["/scale/length"].font_screen_scale == 2.5
    painter.draw([Label("sphere/name", "sphere", np.zeros(3), "unit sphere")], ALL)
    assert canvas.nodes["/sphere/name"].font_screen_scale == 2.5


def test_a_rim_shows_its_back_only(painter: Painter, canvas: Canvas) -> None:
    """So that the dot inside stays in sight."""
    for name, rim in (("halo", True), ("dot", False)):
        painter.draw([Points(name, "map", np.zeros((1, 3)), one_color(style.SELECTED, 1), 0.1, rim=rim)], ALL)
    assert [canvas.calls[name][1]["side"] for name in ("/halo", "/dot")] == ["back", "front"]


def test_a_dot_before_the_viewer_is_small_on_the_screen(painter: Painter, canvas: Canvas) -> None:
    near, far = np.array([0.0, 0.0, 2.0]), np.array([0.0, 0.0, 50.0])
    colors = one_color(style.SELECTED, 2)
    items = [Points(name, "map", np.stack([near, far]), colors, 0.1, rim=name == "rim") for name in ("dot", "rim")]
    painter.see_from(np.zeros(3), in_camera=False)
    painter.draw(items, ALL)
    assert np.allclose(canvas.nodes["/dot"].batched_scales, [2.0 * LARGEST_DOT, 0.1])
    assert np.allclose(canvas.nodes["/rim"].batched_scales, [2.0 * LARGEST_DOT * HALO, 0.1]), "still around its dot"
    assert painter.follows(np.zeros(3), in_camera=True)
    painter.see_from(np.zeros(3), in_camera=True)
    assert np.allclose(canvas.nodes["/dot"].batched_scales, [2.0 * LARGEST_DOT_INSIDE, 0.1])
    assert not painter.follows(0.02 * near, in_camera=True), "a small step changes nothing"
    moved = Points("dot", "map", np.stack([far, near]), colors, 0.1)
    painter.draw([moved], ALL)
    assert np.allclose(canvas.nodes["/dot"].batched_scales, [0.1, 2.0 * LARGEST_DOT_INSIDE]), "the dots moved"
    painter.see_from(100.0 * near, in_camera=False)
    assert np.allclose(canvas.nodes["/dot"].batched_scales, 0.1), "from far away they have their own size"


def test_nothing_is_sent_for_what_stays(server: viser.ViserServer, painter: Painter, canvas: Canvas) -> None:
    items = [dots(5), rays(3), Label("scale/length", "scale bar", np.zeros(3), "1 m"), picture(1, np.eye(3))]
    painter.draw(items, ALL)
    sent: list[object] = []
    queue = server._websock_server.queue_message
    try:
        server._websock_server.queue_message = sent.append  # type: ignore[method-assign]
        painter.draw([dots(5), rays(3), Label("scale/length", "scale bar", np.zeros(3), "1 m"), items[3]], ALL)
        assert not sent
        painter.draw([dots(5, at=1.0), rays(3), *items[2:]], ALL)
        assert [type(message).__name__ for message in sent] == ["SceneNodeUpdateMessage"]
    finally:
        server._websock_server.queue_message = queue  # type: ignore[method-assign]


def picture(key: int, turn: np.ndarray, made: list[int] | None = None, image: Any = "red") -> Textured:
    def make() -> Any:
        (made if made is not None else []).append(key)
        return np.full((4, 8, 3), (200, 30, 40), np.uint8) if isinstance(image, str) else image

    corners, uv = np.eye(3), np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    placed = np.column_stack([2.0 * turn, [1.0, 2.0, 3.0]])
    return Textured("sphere/image", "image", corners, np.array([[0, 1, 2]]), uv, placed, make, key)


def test_a_picture_is_made_once_and_moves_with_its_mesh(painter: Painter, canvas: Canvas) -> None:
    made: list[int] = []
    painter.draw([picture(1, np.eye(3), made)], ALL - {"image"})
    assert not made and not canvas.added, "what is switched off costs nothing"
    turn = trimesh.transformations.rotation_matrix(0.7, [0.0, 1.0, 0.0])[:3, :3]
    for key, turned in ((1, np.eye(3)), (1, turn), (2, turn)):
        painter.draw([picture(key, turned, made)], ALL)
    node = canvas.nodes["/sphere/image"]
    assert made == [1, 2] and canvas.added == ["/sphere/image"] * 2
    assert np.allclose(node.position, [1.0, 2.0, 3.0]) and node.scale == pytest.approx(2.0)
    np.testing.assert_allclose(node.wxyz, [np.cos(0.35), 0.0, np.sin(0.35), 0.0], atol=1e-9)
    painter.draw([picture(2, turn, made)], ALL - {"image"})
    assert not canvas.shown and made == [1, 2]


def test_the_mesh_of_the_map_is_not_before_the_photograph(painter: Painter, canvas: Canvas) -> None:
    """Where the camera's position is not known yet, a tree may stand within the sphere around it."""
    glb = trimesh.creation.box().export(file_type="glb")
    painter.draw([picture(1, np.eye(3))], ALL)
    painter.draw_backdrop(glb, np.eye(3), visible=True)
    assert "/backdrop" in canvas.shown
    painter.see_from(np.zeros(3), in_camera=True)
    assert "/backdrop" not in canvas.shown
    painter.draw_backdrop(glb, np.eye(3), visible=True)
    assert "/backdrop" not in canvas.shown, "however often it is drawn"
    assert painter.follows(np.ones(3), in_camera=False)
    painter.see_from(np.ones(3), in_camera=False)
    assert "/backdrop" in canvas.shown
    painter.draw([picture(1, np.eye(3))], ALL - {"image"})
    painter.see_from(np.zeros(3), in_camera=True)
    assert "/backdrop" in canvas.shown, "without the photograph it is what there is to see"


def test_a_picture_that_is_missing_is_not_drawn(painter: Painter, canvas: Canvas) -> None:
    painter.draw([picture(1, np.eye(3), image=None)], ALL)
    assert not canvas.added


@pytest.mark.parametrize(("channels", "mode"), [(3, None), (4, "MASK")])
def test_a_picture_is_unlit_and_seen_from_both_sides(
    painter: Painter, canvas: Canvas, channels: int, mode: str | None
) -> None:
    painter.draw([picture(1, np.eye(3), image=np.full((4, 8, channels), 90, np.uint8))], ALL)
    glb = canvas.nodes["/sphere/image"].glb_data
    tree = json.loads(glb[20 : 20 + int.from_bytes(glb[12:16], "little")])
    (material,) = tree["materials"]
    assert material["doubleSided"] and material.get("alphaMode", "OPAQUE") == (mode or "OPAQUE")
    assert "KHR_materials_unlit" in material["extensions"] and "KHR_materials_unlit" in tree["extensionsUsed"]


CAMERA = SimpleNamespace(
    position=np.zeros(3), wxyz=np.array([1.0, 0.0, 0.0, 0.0]), fov=np.pi / 2, image_width=400, image_height=400
)
"""Looks along +z; at depth 1 a pixel is 1 / 200."""


def click(server: viser.ViserServer, x_px: float, modifier: str | None = None) -> None:
    """A click that many pixels right of the middle, as the page tells it."""
    ray = np.array([x_px / 200, 0.0, 1.0]) / np.hypot(x_px / 200, 1.0)
    client = cast(viser.ClientHandle, SimpleNamespace(camera=CAMERA))
    place = (0.5 + x_px / 400, 0.5)
    event = viser.SceneClickEvent(client, 0, (0.0, 0.0, 0.0), tuple(ray), place, cast(Any, modifier))
    for entry in server.scene._scene_pointer_cb:
        if entry.event_type == "click" and entry.modifier == modifier:
            entry.callback(event)


def test_a_click_picks_what_is_shown(server: viser.ViserServer, painter: Painter, picks: list) -> None:
    """Each modifier has its own callback, so that one click is never reported twice."""
    ids = np.array([[3, 8]])
    ends = np.array([[[0.5, -1.0, 1.0], [0.5, 1.0, 1.0]]])
    arc = Segments("ring/arcs", "yaw ring", ends, one_color(style.CLIQUE, 1), 2.0, ids)
    point = Points("map/points", "map", np.array([[0.0, 0.0, 1.0]]), one_color(style.INLIER, 1), 1e-3, np.array([7]))
    painter.draw([point, arc], ALL)
    click(server, 3)
    click(server, 3, "shift")
    click(server, 3, "cmd/ctrl")
    click(server, 103)
    click(server, 60)
    assert picks == [((7,), False), ((7,), True), ((7,), True), ((3, 8), False), ((), False)]
    picks.clear()
    painter.draw([point, arc], ALL - {"map"})
    click(server, 3)
    assert picks == [((), False)], "what is switched off cannot be picked"


def test_a_rectangle_picks_all_dots_in_it(server: viser.ViserServer, painter: Painter, picks: list) -> None:
    places = np.array([[0.1, 0.1, 1.0], [0.1, 0.1, 9.0], [-0.5, 0.1, 1.0], [0.1, 0.1, -1.0]])
    painter.draw([Points("map/points", "map", places, one_color(style.INLIER, 4), 0.01, np.array([4, 5, 6, 7]))], ALL)
    client = cast(viser.ClientHandle, SimpleNamespace(camera=CAMERA))
    event = viser.SceneRectSelectEvent(client, 0, (0.5, 0.5), (0.6, 0.6), "shift")
    (entry,) = (entry for entry in server.scene._scene_pointer_cb if entry.event_type == "rect-select")
    entry.callback(event)
    assert entry.modifier == "shift" and picks == [((4, 5), False)], "hidden ones too, but none behind the viewer"
