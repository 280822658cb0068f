"""Undo and redo."""

import dataclasses
import math
import threading
from typing import Any

from spherloc_viz.app.catalog import RunRequest

MAX_REQUESTS = 200
"""How many requests are remembered."""
SAME_MOVE_S = 5.0
"""Changes of the same control count as one while the pointer is held down, and within this time, since a slider is
often corrected after a look at the picture. Another control, or an undo, in between ends the move at once."""
NOT_DRAGGED = frozenset({"seed", "estimator"})
"""Parts of a request that no slider changes: each change of them is a step of its own."""
OPTIONS = "options."
CAMERA = "true_camera"
"""A place that can be dragged; None for the scene's own."""


class History:
    """The requests that a page went through, and where in them it is."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._requests: list[RunRequest] = []
        self._at = -1
        self._noted_s, self._gesture = -math.inf, 0
        self._moved: frozenset[str] = frozenset()
        self._start = -1
        """Place of the request from which the last move began."""

    def note(self, request: RunRequest, now_s: float, gesture: int = 0) -> None:
        """The page asks for this now; what was undone before is forgotten unless it is this very request.

        Changes of the same ``gesture``, if it is not 0, were made without a new press of the pointer or of a key.
        """
        with self._lock:
            if self._at >= 0 and request == self._requests[self._at]:
                return
            moved = _changed(self._requests[self._at], request) if self._at >= 0 else frozenset()
            held = gesture != 0 and gesture == self._gesture
            if not (held or now_s - self._noted_s < SAME_MOVE_S) or not self._goes_on(moved, request):
                self._start = self._at
            del self._requests[self._start + 1 :]
            if self._start < 0 or request != self._requests[self._start]:  # else the move has led back
                self._requests.append(request)
            forgotten = max(0, len(self._requests) - MAX_REQUESTS)
            del self._requests[:forgotten]
            self._start -= forgotten
            self._at, self._noted_s, self._moved, self._gesture = len(self._requests) - 1, now_s, moved, gesture

    def _goes_on(self, moved: frozenset[str], request: RunRequest) -> bool:
        """Whether a change is of the same things as the last one, and all of them can be dragged."""
        if moved != self._moved or moved & NOT_DRAGGED or self._start < 0:
            return False
        parts = [(name, _values(one)[name]) for one in (self._requests[self._at], request) for name in moved]
        return all(type(value) in (int, float) or (name == CAMERA and value is not None) for name, value in parts)

    def step(self, by: int) -> RunRequest | None:
        """The request before (-1) or after (+1), which is then the one that the page is at; None if there is none."""
        with self._lock:
            if not 0 <= self._at + by < len(self._requests):
                return None
            self._at, self._noted_s, self._gesture = self._at + by, -math.inf, 0
            return self._requests[self._at]

    def ways(self) -> tuple[bool, bool]:
        """Whether there is a request before, and one after."""
        with self._lock:
            return self._at > 0, 0 <= self._at < len(self._requests) - 1


def changed_fields(one: RunRequest, other: RunRequest) -> frozenset[str]:
    """Names of the values in which two requests differ."""
    return frozenset(name.removeprefix(OPTIONS) for name in _changed(one, other))


def _changed(one: RunRequest, other: RunRequest) -> frozenset[str]:
    """The same, but those of options begin with ``OPTIONS``: a scene may have a number of the same name."""
    if one.estimator != other.estimator:
        return frozenset({"estimator"})
    before, after = _values(one), _values(other)
    return frozenset(name for name in before if before[name] != after[name])


def _values(request: RunRequest) -> dict[str, Any]:
    """All values of a request, by name."""
    parts = (("", request.scene), ("", request.scene.variation), (OPTIONS, request.options))
    values = {
        prefix + item.name: getattr(part, item.name) for prefix, part in parts for item in dataclasses.fields(part)
    }
    del values["variation"]
    return values
