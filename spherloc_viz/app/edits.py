"""What a person does to single matches by hand: select, spoil, mend, hide.

Matches have the numbers that they have where nothing is hidden.
"""

import threading
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from spherloc.datasets.variation import Variation
from spherloc_viz.app.catalog import SceneRequest

Numbers = tuple[int, ...]


class Edits:
    """The selection and the changes of one page. Changes belong to a scene, its seed and its query."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._selected: Numbers = ()
        self._owner: tuple = ()
        self._changes = Variation()

    @property
    def selected(self) -> Numbers:
        """Numbers of the selected matches, ascending."""
        return self._selected

    @property
    def changes(self) -> Variation:
        """What is spoiled, mended and hidden."""
        return self._changes

    def select(self, numbers: Iterable[int], extend: bool = False) -> None:
        """Select these and no others; with ``extend`` add them, or take them away if all are selected already."""
        with self._lock:
            chosen = set(numbers)
            if extend:
                known = set(self._selected)
                chosen = known - chosen if chosen <= known else known | chosen
            self._selected = tuple(sorted(chosen))

    def select_words(self, words: str, extend: bool, kept: NDArray[np.int64]) -> bool:
        """Select the matches whose numbers a page names, such as "3,17"; false if they are not among ``kept`` (N,)."""
        named = words.split(",")
        if not all(word.isascii() and word.isdigit() and len(word) < 10 for word in named):
            return False
        numbers = set(map(int, named))
        if not numbers <= set(kept.tolist()):
            return False
        self.select(numbers, extend)
        return True

    def spoil(self) -> None:
        """Make the selected matches wrong."""
        with self._lock:
            self._changes = self._changes.spoil(self._selected)

    def mend(self) -> None:
        """Make the selected matches right."""
        with self._lock:
            self._changes = self._changes.mend(self._selected)

    def hide(self) -> None:
        """Leave the selected matches out, and select none."""
        with self._lock:
            self._changes, self._selected = self._changes.hide(self._selected), ()

    def show_all(self) -> None:
        """Hide no match any more."""
        with self._lock:
            self._changes = replace(self._changes, hidden=())

    def clear(self) -> None:
        """Take back all changes."""
        with self._lock:
            self._changes = Variation()

    def write(self, request: SceneRequest) -> None:
        """Take over the changes of a request; the selection is dropped if it is of another problem."""
        known = request.variation
        with self._lock:
            if _owner(request) != self._owner:
                self._owner, self._selected = _owner(request), ()
            self._changes = Variation(spoiled=known.spoiled, mended=known.mended, hidden=known.hidden)

    def apply(self, request: SceneRequest) -> SceneRequest:
        """The request with the changes. Those of another problem are dropped, and the selection with them."""
        with self._lock:
            if _owner(request) != self._owner:
                self._owner, self._changes, self._selected = _owner(request), Variation(), ()
            edited, count = self._changes, request.variation.correspondences
            changes = {
                name: tuple(number for number in getattr(edited, name) if count is None or number < count)
                for name in ("spoiled", "mended", "hidden")
            }
            return replace(request, variation=replace(request.variation, **changes))

    def places(self, kept: NDArray[np.int64]) -> Numbers:
        """Indices of the selected matches in a problem with only the matches of the numbers ``kept`` (N,)."""
        return tuple(np.flatnonzero(np.isin(kept, self._selected)).tolist())


def _owner(request: SceneRequest) -> tuple:
    return request.scene, request.seed, request.query
