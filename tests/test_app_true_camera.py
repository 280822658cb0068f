"""The handle on the true camera: what it tells is the pose that it shows, and dragging wins over our own updates."""

from types import SimpleNamespace
from typing import Any, Literal, cast

import numpy as np
import pytest
import viser
import viser.transforms as vtf
from hypothesis import given, settings
from hypothesis import strategies as st

from spherloc.geometry import pose, yaw_rotation
from spherloc_viz.app.stage.true_camera import Place, TrueCamera, place_of, pose_of
from spherloc_viz.app.web.viser_internals import changes_of

metres = st.floats(-1e3, 1e3)


def level_pose(place: Place) -> np.ndarray:
    turn = yaw_rotation(np.radians(place[0]))
    return pose(turn, -turn @ np.array(place[1:]))


@settings(max_examples=100)
@given(yaw_deg=st.floats(-180.0, 180.0), x=metres, y=metres, z=metres)
def test_a_pose_comes_back_through_the_handle(yaw_deg: float, x: float, y: float, z: float) -> None:
    """Pose, handle, place, and pose again."""
    cam_from_map = level_pose((yaw_deg, x, y, z))
    wxyz = vtf.SO3.from_matrix(cam_from_map[:, :3].T).wxyz
    place = place_of(pose_of(wxyz, np.array(place_of(cam_from_map)[1:])))
    np.testing.assert_allclose(level_pose(place), cam_from_map, atol=1e-9)
    np.testing.assert_allclose(place[1:], (x, y, z), atol=1e-9)
    assert abs((place[0] - yaw_deg + 180.0) % 360.0 - 180.0) < 1e-9


class Hand:
    """A handle on the canvas of a server, what it told, and a person who drags it."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self.told: list[Place] = []
        self.changes = changes_of(scene._owner.gui)
        self.camera = TrueCamera(cast(viser.ClientHandle, SimpleNamespace(scene=scene)), self.told.append)
        self.level, self.upright = (scene._handle_from_transform_controls_name[name] for name in NODES)

    def drag(self, phase: Literal["start", "update", "end"], handle: Any, **where: Any) -> None:
        for name, value in where.items():
            setattr(handle, name, value)
        for callback in handle._impl_aux.update_cb:
            callback(viser.TransformControlsEvent(None, None, handle, phase))

    @property
    def place(self) -> Place:
        """Where the handle is; both of its parts agree."""
        assert np.array_equal(self.level.position, self.upright.position)
        return place_of(pose_of(self.level.wxyz, self.level.position))


NODES = ("/true camera level", "/true camera upright")


@pytest.fixture
def hand(server: viser.ViserServer) -> Hand:
    server.scene.reset()
    return Hand(server.scene)


HERE: Place = (30.0, 1.0, 2.0, 3.0)
THERE: Place = (30.0, 4.0, 2.0, 3.0)


def test_it_is_shown_where_the_true_camera_is_and_hidden_without_one(hand: Hand) -> None:
    assert not hand.level.visible
    hand.camera.show(level_pose(HERE), True)
    assert hand.level.visible and hand.upright.visible
    np.testing.assert_allclose(hand.place, HERE, atol=1e-9)
    hand.camera.show(level_pose(HERE), False)
    assert not hand.level.visible and not hand.upright.visible
    hand.camera.show(None, True)
    assert not hand.level.visible and not hand.told


def test_no_roll_and_no_pitch_can_be_dragged(hand: Hand) -> None:
    """viser draws a circle where both axes of its plane are active."""
    circles = [
        [a and b for a, b in ((y, z), (x, z), (x, y))] for x, y, z in (hand.level.active_axes, hand.upright.active_axes)
    ]
    assert np.any(circles, axis=0).tolist() == [False, True, False]
    assert np.any([hand.level.active_axes, hand.upright.active_axes], axis=0).all(), "but all three arrows are there"


def test_dragging_either_part_tells_the_new_place(hand: Hand) -> None:
    hand.camera.show(level_pose(HERE), True)
    hand.drag("start", hand.level)
    assert not hand.told, "nothing has moved yet"
    hand.drag("update", hand.level, position=np.array(THERE[1:]))
    np.testing.assert_allclose(hand.told[-1], THERE, atol=1e-9)
    hand.drag("end", hand.level)
    hand.drag("start", hand.upright)
    hand.drag("update", hand.upright, position=np.array([4.0, -1.0, 3.0]))
    hand.drag("end", hand.upright)
    np.testing.assert_allclose(hand.told[-1], (30.0, 4.0, -1.0, 3.0), atol=1e-9)
    np.testing.assert_allclose(hand.place, hand.told[-1], atol=1e-9)
    hand.drag("update", hand.level, wxyz=vtf.SO3.from_matrix(yaw_rotation(np.radians(-170.0)).T).wxyz)
    np.testing.assert_allclose(hand.told[-1], (-170.0, 4.0, -1.0, 3.0), atol=1e-9)


def test_the_handle_stays_where_it_was_dragged_until_that_is_answered(hand: Hand) -> None:
    hand.camera.show(level_pose(HERE), True)
    with hand.changes.hearing(NODES[0], None):
        hand.drag("update", hand.level, position=np.array(THERE[1:]))
    before = hand.changes.now() - 1
    with hand.changes.as_of(before):
        hand.camera.show(level_pose(HERE), True)
    np.testing.assert_allclose(hand.place, THERE, atol=1e-9, err_msg="an answer to an earlier change came late")
    hand.camera.show(level_pose(HERE), True)
    np.testing.assert_allclose(hand.place, HERE, atol=1e-9, err_msg="what answers it is followed")
