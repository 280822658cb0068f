"""A handle on the true camera of a synthetic scene, by which it can be dragged and turned."""

import threading
import time
from collections.abc import Callable

import numpy as np
import viser
import viser.transforms as vtf

from spherloc.geometry import camera_centre, pose, yaw_of, yaw_rotation
from spherloc_viz.layers.primitives import FloatArray

Place = tuple[float, float, float, float]
"""Yaw in degrees and position in metres, of a level camera."""

SIZE_PX = 90.0
CATCH_UP_S = 1.0
"""After a drag, answers to its earlier moves are still on their way for so long, at most."""


class TrueCamera:
    """The handle: arrows and a plane move the camera, and a circle around the vertical turns it.

    Dragging and our own updates do not fight: while it is dragged, and until the answer to the last move has arrived,
    the handle stays where the person put it.
    """

    def __init__(self, client: viser.ClientHandle, moved: Callable[[Place], None]) -> None:
        """``moved`` gets the camera's new yaw and position in the map frame of a level scene, whenever it is dragged;
        it is called on viser's event loop and must return at once."""
        self._moved = moved
        self._lock = threading.Lock()
        self._dragged = False
        self._awaited: tuple[Place, float] | None = None
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
        place = place_of(cam_from_map)
        with self._lock:
            if self._dragged or not self._caught_up(place):
                return
            self._awaited = None
            yaw_deg, *position = place
            for handle in (self._level, self._upright):
                handle.wxyz = vtf.SO3.from_matrix(yaw_rotation(np.radians(yaw_deg)).T).wxyz
                handle.position = np.array(position)

    def _caught_up(self, place: Place) -> bool:
        """Whether this is no answer to an earlier move than the last."""
        if self._awaited is None:
            return True
        last, until = self._awaited
        return bool(np.allclose(last, place, rtol=0.0, atol=1e-6)) or time.monotonic() > until

    async def _drag(self, event: viser.TransformControlsEvent) -> None:
        # On the event loop, since on viser's threads the end of a drag might overtake its last move.
        other = self._upright if event.target is self._level else self._level
        place = place_of(pose_of(self._level.wxyz, event.target.position))
        with self._lock:
            self._dragged = event.phase != "end"
            self._awaited = place, time.monotonic() + CATCH_UP_S
            other.position = event.target.position
        if event.phase != "start":
            self._moved(place)


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
    """Yaw (degrees) and position (metres) of a pose (3, 4); what it leans is lost."""
    x, y, z = camera_centre(cam_from_map)
    return float(np.degrees(yaw_of(cam_from_map[:, :3]))), float(x), float(y), float(z)


def pose_of(wxyz: np.ndarray, position: np.ndarray) -> FloatArray:
    """The pose (3, 4) of a handle with that orientation, map from camera, and position."""
    turn = np.asarray(vtf.SO3(np.asarray(wxyz, dtype=np.float64)).as_matrix().T, np.float64)
    return pose(turn, -turn @ np.asarray(position, dtype=np.float64))
