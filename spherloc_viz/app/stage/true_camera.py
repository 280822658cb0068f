"""A handle on the true camera of a synthetic scene, by which it can be dragged and turned."""

from collections.abc import Callable

import numpy as np
import viser
import viser.transforms as vtf

from spherloc.geometry import camera_centre, pose, yaw_of, yaw_rotation
from spherloc.types import FloatArray
from spherloc_viz.app.web.viser_internals import at_once, put_handle

Place = tuple[float, float, float, float]
"""Yaw (degrees) and position x, y, z (metres) of a level camera."""

SIZE_PX = 90.0


class TrueCamera:
    """The handle: arrows and a plane move the camera, and a circle around the vertical turns it.

    It stays where the user put it until the answer to that move, or to a later change, arrives.
    """

    def __init__(self, client: viser.ClientHandle, moved: Callable[[Place], None]) -> None:
        """``moved`` gets the camera's new yaw and position in the map frame of a level scene, whenever it is dragged;
        it is called on viser's event loop and must return at once."""
        self._moved = moved
        # viser shows a circle where both of its axes are active: two handles have all arrows and no roll or pitch.
        self._level = _handle(client, "level", (True, False, True))
        self._upright = _handle(client, "upright", (False, True, False))
        self._level.on_update(self._drag)
        self._upright.on_update(self._drag)

    def show(self, cam_from_map: FloatArray | None, visible: bool) -> None:
        """Put the handle at the true camera, a pose (3, 4) between the aligned frames, or hide it."""
        for handle in (self._level, self._upright):
            handle.visible = visible and cam_from_map is not None
        if cam_from_map is None:
            return
        yaw_deg, *position = place_of(cam_from_map)
        wxyz = vtf.SO3.from_matrix(yaw_rotation(np.radians(yaw_deg)).T).wxyz
        for handle in (self._level, self._upright):
            put_handle(handle, wxyz, position)

    @at_once
    def _drag(self, event: viser.TransformControlsEvent) -> None:
        # On viser's threads the end of a drag might overtake its last move.
        other = self._upright if event.target is self._level else self._level
        put_handle(other, other.wxyz, event.target.position)
        if event.phase != "start":
            self._moved(place_of(pose_of(self._level.wxyz, event.target.position)))


def _handle(client: viser.ClientHandle, name: str, axes: tuple[bool, bool, bool]) -> viser.TransformControlsHandle:
    return client.scene.add_transform_controls(
        f"/true camera {name}",
        scale=SIZE_PX,
        fixed=True,
        line_width=3.0,
        active_axes=axes,
        depth_test=False,
        opacity=0.8,
        visible=False,
    )


def place_of(cam_from_map: FloatArray) -> Place:
    """Yaw (degrees) and position (metres) of a pose (3, 4); its tilt is dropped."""
    x, y, z = camera_centre(cam_from_map)
    return float(np.degrees(yaw_of(cam_from_map[:, :3]))), float(x), float(y), float(z)


def pose_of(wxyz: np.ndarray, position: np.ndarray) -> FloatArray:
    """The pose (3, 4) of a handle with that orientation, map from camera, and position."""
    turn = np.asarray(vtf.SO3(np.asarray(wxyz, dtype=np.float64)).as_matrix().T, np.float64)
    return pose(turn, -turn @ np.asarray(position, dtype=np.float64))
