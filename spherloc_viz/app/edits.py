"""What a person does to single matches by hand: select, spoil, mend, hide.

Matches have the numbers that they have where nothing is hidden.
"""

import threading
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from spherloc_viz.app.catalog import SceneWish

Numbers = tuple[int, ...]


@dataclass(frozen=True)
class Changes:
    """What was done to the matches of one problem."""

    spoiled: Numbers = ()
    mended: Numbers = ()
    hidden: Numbers = ()


class Edits:
    """The selection and the changes of one page. Changes belong to a scene, its seed and its query."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._selected: Numbers = ()
        self._owner: tuple = ()
        self._changes = Changes()

    @property
    def selected(self) -> Numbers:
        """Numbers of the selected matches, ascending."""
        return self._selected

    def select(self, numbers: Iterable[int], extend: bool = False) -> None:
        """Select these and no others; with ``extend`` add them, or take them away if all are selected already."""
        with self._lock:
            chosen = set(numbers)
            if extend:
                known = set(self._selected)
                chosen = known - chosen if chosen <= known else known | chosen
            self._selected = tuple(sorted(chosen))

    def spoil(self) -> None:
        """Make the selected matches wrong."""
        self._change("spoiled", "mended")

    def mend(self) -> None:
        """Make the selected matches right."""
        self._change("mended", "spoiled")

    def hide(self) -> None:
        """Leave the selected matches out, and select none."""
        self._change("hidden")
        self.select(())

    def show_all(self) -> None:
        """Hide no match any more."""
        with self._lock:
            self._changes = replace(self._changes, hidden=())

    def clear(self) -> None:
        """Take back all changes."""
        with self._lock:
            self._changes = Changes()

    def write(self, wish: SceneWish) -> None:
        """Take over the changes of a wish."""
        variation = wish.variation
        with self._lock:
            self._owner = _owner(wish)
            self._changes = Changes(variation.spoiled, variation.mended, variation.hidden)

    def apply(self, wish: SceneWish) -> SceneWish:
        """The wish with the changes. Those of another problem are dropped, and the selection with them."""
        with self._lock:
            if _owner(wish) != self._owner:
                self._owner, self._changes, self._selected = _owner(wish), Changes(), ()
            changes, count = self._changes, wish.variation.correspondences
            within = (
                tuple(number for number in numbers if count is None or number < count)
                for numbers in (changes.spoiled, changes.mended, changes.hidden)
            )
            spoiled, mended, hidden = within
            return replace(wish, variation=replace(wish.variation, spoiled=spoiled, mended=mended, hidden=hidden))

    def places(self, kept: NDArray[np.int64]) -> Numbers:
        """Where the selected matches are in a problem in which the matches ``kept`` (N,) are left."""
        return tuple(np.flatnonzero(np.isin(kept, self._selected)).tolist())

    def _change(self, into: str, out_of: str | None = None) -> None:
        with self._lock:
            chosen = set(self._selected)
            values = {into: tuple(sorted(chosen | set(getattr(self._changes, into))))}
            if out_of is not None:
                values[out_of] = tuple(sorted(set(getattr(self._changes, out_of)) - chosen))
            self._changes = replace(self._changes, **values)


def _owner(wish: SceneWish) -> tuple:
    return wish.scene, wish.seed, wish.query
