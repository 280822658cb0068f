"""Stands in for a page: presses elements, and notes what came of it."""

from spherloc_viz.app.web.touch import Touch, Touches


class Page:
    """The presses of a page and what came of them."""

    def __init__(self) -> None:
        self.failures: list[Exception] = []
        self.touches = Touches(self.failures.append)
        self.selected: list[tuple[str, bool]] = []
        self.redraws = 0
        self.touches.on("select", lambda touch: self.selected.append((touch.argument, touch.extend)))

    def changed(self, event: object) -> None:
        self.redraws += 1

    def press(self, action: str, x: float = 0.5, y: float = 0.5, extend: bool = False) -> None:
        name, _, argument = action.partition(":")
        self.touches.deliver(Touch(name, argument, x, y, x, y, extend))
        assert not self.failures
