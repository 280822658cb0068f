"""Undo and redo."""

import dataclasses
import threading

from spherloc_viz.app.wish import Wish

MOST = 200
"""Wishes that are remembered."""
SAME_MOVE_S = 1.0
"""Changes of the same things within this time, such as those of a slider that is dragged, count as one."""
SINGLE = frozenset({"scene", "query", "seed", "camera", "outlier_kind", "spoiled", "mended", "hidden", "estimator"})
"""What is not dragged: each change counts."""


class History:
    """The wishes that a page went through, and where in them it is."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._wishes: list[Wish] = []
        self._at = -1
        self._noted_s = -SAME_MOVE_S
        self._moved: frozenset[str] = frozenset()

    def note(self, wish: Wish, now_s: float) -> None:
        """The page asks for this now; what was undone before is forgotten unless it is this very wish."""
        with self._lock:
            if self._at >= 0 and wish == self._wishes[self._at]:
                return
            moved = changed_fields(self._wishes[self._at], wish) if self._at >= 0 else frozenset()
            same_move = self._at > 0 and moved == self._moved and now_s - self._noted_s < SAME_MOVE_S
            same_move = same_move and not moved & SINGLE
            del self._wishes[self._at + (0 if same_move else 1) :]
            self._wishes.append(wish)
            del self._wishes[:-MOST]
            self._at, self._noted_s, self._moved = len(self._wishes) - 1, now_s, moved

    def step(self, by: int) -> Wish | None:
        """The wish before (-1) or after (+1), which is then the one that the page is at; None if there is none."""
        with self._lock:
            if not 0 <= self._at + by < len(self._wishes):
                return None
            self._at, self._noted_s = self._at + by, -SAME_MOVE_S
            return self._wishes[self._at]

    def ways(self) -> tuple[bool, bool]:
        """Whether there is a wish before, and one after."""
        with self._lock:
            return self._at > 0, 0 <= self._at < len(self._wishes) - 1


def changed_fields(one: Wish, other: Wish) -> frozenset[str]:
    """Names of what differs."""
    if one.estimator != other.estimator:
        return frozenset({"estimator"})
    parts = (
        (one.scene, other.scene),
        (one.scene.variation, other.scene.variation),
        (one.options, other.options),
    )
    return frozenset(
        item.name
        for before, after in parts
        for item in dataclasses.fields(before)
        if item.name != "variation" and getattr(before, item.name) != getattr(after, item.name, None)
    )
