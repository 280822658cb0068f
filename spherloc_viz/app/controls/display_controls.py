"""What of the canvas is shown, and from where."""

from collections.abc import Callable
from typing import Literal

import viser

from spherloc_viz import style
from spherloc_viz.app.stage import views
from spherloc_viz.app.web.viser_internals import at_once, put


class DisplayControls:
    """View buttons, whether the view follows the steps, dark or light, and a switch for each layer."""

    def __init__(self, gui: viser.GuiApi, changed: Callable[[object], None]) -> None:
        self._changed = changed
        self._wanted: str | None = None
        self._views = gui.add_button_group("View", views.NAMES)
        self._dark = gui.add_checkbox("Dark", True, hint="Dark for a screen, light for a projector and for print.")
        self._hide = gui.add_checkbox(
            "Hide answers", False, hint="No true pose, no true labels, and no outcome before the last step."
        )
        with gui.add_folder("Layers", expand_by_default=False):
            self._follow = gui.add_checkbox("Follow steps", True, hint="Move to where the step's subject reads best.")
            self._layers = {name: gui.add_checkbox(name.capitalize(), True) for name in style.LAYERS}
        self._views.on_click(self._press)
        for widget in (self._dark, self._hide, *self._layers.values()):
            widget.on_update(changed)

    @property
    def theme(self) -> Literal["dark", "light"]:
        """How the page shall look."""
        return "dark" if self._dark.value else "light"

    @theme.setter
    def theme(self, theme: str) -> None:
        put(self._dark, theme == "dark")

    @property
    def answers_hidden(self) -> bool:
        """Whether the truth, and before the last step the outcome too, are not to be told."""
        return self._hide.value

    @answers_hidden.setter
    def answers_hidden(self, hidden: bool) -> None:
        put(self._hide, hidden)

    @property
    def follow(self) -> bool:
        """Whether the view follows the steps."""
        return self._follow.value

    def layers(self) -> frozenset[str]:
        """Layers that are switched on."""
        return frozenset(name for name, widget in self._layers.items() if widget.value)

    def take_view(self) -> str | None:
        """The view that was asked for since the last call, if any."""
        wanted, self._wanted = self._wanted, None
        return wanted

    @at_once
    def _press(self, event: viser.GuiEvent) -> None:
        self._wanted = event.target.value
        self._changed(event)
