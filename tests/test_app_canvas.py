"""The picture of one page, on a real viser server and for a page without a browser."""

import threading
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import viser
from test_app_views import box, glb

from spherloc.datasets import bundled_scenes, load_scene
from spherloc.datasets.map_scene import MapScene
from spherloc.datasets.synthetic import SyntheticScene
from spherloc.estimators import default_options, estimate
from spherloc_viz.app.catalog import Run, RunRequest, SceneRequest
from spherloc_viz.app.controls.controls import DisplayControls
from spherloc_viz.app.matches.match_card import MARGIN_PX, WIDTH_PX, MatchCard
from spherloc_viz.app.stage import canvas as stage
from spherloc_viz.app.stage import views
from spherloc_viz.app.stage.canvas import Canvas
from spherloc_viz.app.stage.walls import Walls
from spherloc_viz.app.web.viser_internals import start_viser, stop_viser
from spherloc_viz.layers import paint, steps
from tests.connected_page import HELLO, KEY, ConnectedPage
from tests.waiting import LIMIT_S, until


@pytest.fixture
def page() -> Iterator[ConnectedPage]:
    server: viser.ViserServer = start_viser(KEY)
    page = ConnectedPage(server, KEY)
    yield page
    page.close()
    stop_viser(server)


def test_a_page_that_arrives_late_sees_around_walls_that_came_meanwhile(
    page: ConnectedPage, scene_of: Callable[..., SyntheticScene], monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = scene_of("panorama", correspondences=40, outlier_rate=0.3).problem()
    request = RunRequest(SceneRequest("scene", 0), "mc", default_options("mc", problem))
    run = Run(request, estimate(problem, "mc"), np.arange(len(problem)))
    timeline = steps(run.trace)
    picture = next(one for one in (paint(run.trace, k) for k in range(1, len(timeline))) if one.focus.view == "Sphere")
    places: list[dict[str, Any]] = []
    page.answer = lambda message: places.append(message) if message["type"].startswith("SetCamera") else None
    shown = Canvas(
        page.handle, DisplayControls(page.handle.gui, print), lambda *_: None, lambda _: None, lambda *_: None, 0
    )

    def placed(what: str) -> list[np.ndarray]:
        return [np.array(place[what]) for place in places if what in place]

    def stand(position: np.ndarray) -> None:
        told = {"position": position.tolist(), "look_at": target.tolist(), "fov": float(page.handle.camera.fov)}
        page.send(HELLO | told)

    shown.draw(run, picture, None, False)
    until(lambda: placed("look_at"))
    (there,), (target,) = placed("position"), placed("look_at")
    stand((there + HELLO["position"]) / 2)
    until(lambda: not np.allclose(page.handle.camera.position, there))

    monkeypatch.setattr(stage, "MOVE_S", 0.0)
    subject = picture.focus.points
    middle = subject.mean(axis=0)
    half_m = 0.4 * float(np.linalg.norm(there - middle)) * np.array([1.0, 1.0, 0.1])
    turn = problem.aligned.map_turn
    wall = (middle + 0.6 * (there - middle)) @ turn  # in the map's frame, as a mesh is
    mesh = glb(box(tuple(wall - half_m), tuple(wall + half_m)))
    shown.draw(run, picture, mesh, False)
    assert len(placed("position")) == 1, "a person may be moving it"
    stand(there)
    until(lambda: len(placed("position")) == 2)
    walls = Walls(mesh, turn)
    assert walls.blocked(there, subject) > 0.5 and walls.blocked(placed("position")[1], subject) < 0.2


def test_a_view_that_was_kept_while_a_slider_moved_is_part_of_the_link(
    page: ConnectedPage, scene_of: Callable[..., SyntheticScene]
) -> None:
    """A page that opens the link would put its viewer elsewhere by itself."""
    shown = Canvas(
        page.handle, DisplayControls(page.handle.gui, print), lambda *_: None, lambda _: None, lambda *_: None, 0
    )
    for noise_px in (1.0, 1.1):
        problem = scene_of("panorama", correspondences=40, outlier_rate=0.3, noise_px=noise_px).problem()
        request = RunRequest(SceneRequest("scene", 0), "mc", default_options("mc", problem))
        run = Run(request, estimate(problem, "mc"), np.arange(len(problem)))
        index = next(k for k, step in enumerate(steps(run.trace)) if step.key == "clique")
        shown.draw(run, paint(run.trace, index), None, False)
        looked = shown._looked
        assert looked is not None
        there = {"position": looked[1].position.tolist(), "look_at": looked[1].target.tolist()}
        page.send(HELLO | there | {"fov": float(looked[1].field_of_view_rad)})
        until(lambda looked=looked: views.stands_at(page.handle, looked[1]))
        told = shown.viewpoint()
        if noise_px == 1.0:
            assert told == ()
            lower_px = HELLO["image_height"] - 1
            page.send(HELLO | there | {"fov": float(looked[1].field_of_view_rad), "image_height": lower_px})
            until(lambda lower_px=lower_px: page.handle.camera.image_height == lower_px)
            assert shown.viewpoint() == ()
    np.testing.assert_allclose(told[:6], [*looked[1].position, *looked[1].target])


def test_a_view_that_a_link_asked_for_stays_in_the_link_while_a_page_is_built(
    page: ConnectedPage, scene_of: Callable[..., SyntheticScene]
) -> None:
    """Such a page reports that its viewer has not moved; a reload at that time must not lose the view."""
    shown = Canvas(
        page.handle, DisplayControls(page.handle.gui, print), lambda *_: None, lambda _: None, lambda *_: None, 0
    )
    problem = scene_of("panorama", correspondences=40, outlier_rate=0.3).problem()
    request = RunRequest(SceneRequest("scene", 0), "mc", default_options("mc", problem))
    run = Run(request, estimate(problem, "mc"), np.arange(len(problem)))
    picture = paint(run.trace, 0)
    asked = (1.0, -2.0, -5.0, 0.0, 0.0, 0.0, 45.0)
    shown.hold(picture.step.key, asked)
    assert shown.viewpoint() == asked

    def stand(position: tuple[float, ...]) -> None:
        page.send(HELLO | {"position": position, "look_at": asked[3:6], "fov": float(np.radians(asked[6]))})
        until(lambda: np.allclose(page.handle.camera.position, position))

    stand(views.START)
    shown.draw(run, picture, None, False)
    assert shown.viewpoint() == asked
    stand(asked[:3])
    assert shown.viewpoint() == asked
    stand((2.0, -2.0, -5.0))
    assert shown.viewpoint()[:3] == (2.0, -2.0, -5.0)


def test_a_page_that_was_still_being_built_sees_the_map_that_is_opened(page: ConnectedPage) -> None:
    """Before there is a run: such a page drops the view, and would stand among the points."""
    street = load_scene(bundled_scenes()["street_fisheye"])
    assert isinstance(street, MapScene)
    shown = Canvas(
        page.handle, DisplayControls(page.handle.gui, print), lambda *_: None, lambda _: None, lambda *_: None, 0
    )
    places: list[Any] = []
    page.answer = lambda message: places.append(message) if message["type"] == "SetCameraPositionMessage" else None
    shown.draw_map("street", street, None)
    until(lambda: len(places) == 1)
    page.send(HELLO | {"position": views.START, "look_at": (0.0, 0.0, 0.0), "fov": 0.8})
    until(lambda: len(places) == 2)
    assert places[0]["position"] == places[1]["position"]


def test_what_is_hidden_is_right_for_where_the_viewer_stands_at_last(
    page: ConnectedPage, scene_of: Callable[..., SyntheticScene]
) -> None:
    """While a thread waits that heard of an earlier place, outside of the camera, the viewer comes to stand inside."""
    problem = scene_of("panorama", correspondences=40, outlier_rate=0.3).problem()
    request = RunRequest(SceneRequest("scene", 0), "mc", default_options("mc", problem))
    run = Run(request, estimate(problem, "mc"), np.arange(len(problem)))
    picture = paint(run.trace, len(steps(run.trace)) - 1)
    shown = Canvas(
        page.handle, DisplayControls(page.handle.gui, print), lambda *_: None, lambda _: None, lambda *_: None, 0
    )
    shown.draw(run, picture, None, False)
    inside = views.find("From the camera", picture, 1.5)
    outside = inside.position + np.array([0.0, -30.0, 0.0])

    def stand(position: np.ndarray) -> None:
        page.send(HELLO | {"position": position.tolist(), "look_at": inside.target.tolist()})
        until(lambda: np.allclose(page.handle.camera.position, position, atol=1e-6))

    stand(outside)
    until(lambda: "cameras/estimate" not in shown._painter.hidden)
    with shown._lock:  # all threads wait
        waiting = threading.Thread(target=shown._make_room)
        shown._painter.hidden = frozenset({"map/points"})  # so that it has something to do
        waiting.start()
        page.handle.camera._state.position = inside.position
    waiting.join(LIMIT_S)
    assert "cameras/estimate" in shown._painter.hidden and "map/points" not in shown._painter.hidden


def test_a_card_has_a_side_whatever_a_page_tells_of_its_viewer(
    page: ConnectedPage, scene_of: Callable[..., SyntheticScene]
) -> None:
    """It may tell no place at all."""
    problem = scene_of("panorama", correspondences=40, outlier_rate=0.3).problem()
    trace = estimate(problem, "mc")
    picture = paint(trace, len(steps(trace)) - 1)
    shown = Canvas(
        page.handle, DisplayControls(page.handle.gui, print), lambda *_: None, lambda _: None, lambda *_: None, 0
    )
    for position in ((1.0, 2.0), "here", None):
        page.handle.camera._state.position = position  # type: ignore[assignment]
        shown._painter.clicked_x = 0.2
        assert shown.card_is_right(picture, 310.0, 290.0)
        shown._painter.clicked_x = 0.8
        assert not shown.card_is_right(picture, 310.0, 290.0)


@pytest.mark.parametrize("window_px", [500, 1024, 1366, 1920, 2560, 3840])
def test_a_card_is_not_over_the_panels_beside_the_canvas(page: ConnectedPage, window_px: int) -> None:
    placed: list[float] = []
    scale, between_px = stage.text_scale(window_px), stage.canvas_width_px(window_px)
    card = MatchCard(page.handle.gui, True, scale, 0.0)
    card._panel.float = lambda x, y, width: placed.append(width)  # type: ignore[method-assign]
    card.fit(scale, between_px)
    assert placed[-1] + 2 * MARGIN_PX <= between_px and placed[-1] >= 0.9 * WIDTH_PX * scale
