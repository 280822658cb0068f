"""The timeline of a run: previous, next, play, a list of the steps, and what the step at hand says."""

import threading
from collections.abc import Callable, Sequence
from typing import Any

import viser

from spherloc_viz.app.text import step_html, table_html
from spherloc_viz.layers.primitives import Step, Table

PLAY_S = 3.0
"""How long a step stays while playing: time to read its two sentences."""
PREVIOUS, NEXT, PLAY, PAUSE = "Previous", "Next", "Play", "Pause"
HOTKEYS = ((PREVIOUS, "Previous step", "B"), (NEXT, "Next step", "N"), (PLAY, "Play or pause", "P"))
"""viser's canvas takes the arrows and W, A, S, D, Q, E."""


class StepsPanel:
    """Which step is on. Widgets only note wishes; ``settle`` acts on them, on the session's page thread."""

    def __init__(self, gui: viser.GuiApi, changed: Callable[[object], None]) -> None:
        self._changed = changed
        self._lock = threading.Lock()
        self._moves = 0
        self._picked: str | None = None
        self._playing = False
        self._steps: tuple[Step, ...] = ()
        self._index = 0
        titles: list[str] = ["-"]
        self._choice = gui.add_dropdown("Step", titles)
        self._buttons = gui.add_button_group("Keys B, N, P", (PREVIOUS, NEXT, PLAY))
        self._text = gui.add_html("")
        self._choice.on_update(self._pick)
        self._buttons.on_click(self._click)
        for button, label, hotkey in HOTKEYS:
            command: Any = gui.add_command(label, hotkey=hotkey)  # type: ignore[arg-type]
            command.on_trigger(lambda event, button=button: self._press(button))

    @property
    def widgets(self) -> tuple:
        """Those that hold a value."""
        return (self._choice,)

    def settle(self, steps: tuple[Step, ...], asked: bool) -> tuple[int, float | None]:
        """Index of the step to show, and seconds to the next one if playing; ``asked`` is false for its alarm."""
        if steps != self._steps:
            key = self._steps[self._index].key if self._steps else ""
            self._steps, self._index = steps, find_step(steps, key)
        with self._lock:
            moves, self._moves = self._moves, 0
            picked, self._picked = self._picked, None
            last = len(steps) - 1
            if picked in self._choice.options:
                self._index = self._choice.options.index(picked)
            if self._playing and not asked:
                moves += 1
            self._index = min(max(0, min(self._index, last) + moves), last)
            if self._index == last and not asked:
                self._playing = False
            playing = self._playing
        return self._index, PLAY_S if playing else None

    def show(self, playing: bool, tables: Sequence[Table]) -> None:
        """Put the step at hand and its tables on the page."""
        titles = tuple(f"{k}/{len(self._steps)}  {step.title}" for k, step in enumerate(self._steps, 1))
        if self._choice.options != titles:
            self._choice.options = titles
        self._choice.value = titles[self._index]
        self._buttons.options = (PREVIOUS, NEXT, PAUSE if playing else PLAY)
        self._text.content = step_html(self._steps[self._index]) + "".join(table_html(table) for table in tables)

    # viser runs a coroutine as soon as the message is there, a plain function later on some thread: by then the next
    # click, or the next step that is shown, may have changed the widget's value.

    async def _pick(self, event: viser.GuiEvent) -> None:
        # Showing a step sets the list too; only a choice made on the page counts.
        if event.client is not None:
            with self._lock:
                self._picked, self._moves, self._playing = event.target.value, 0, False
            self._changed(event)

    async def _click(self, event: viser.GuiEvent) -> None:
        self._press(event.target.value)

    def _press(self, button: str) -> None:
        with self._lock:
            if button in (PLAY, PAUSE):
                self._playing = not self._playing
                if self._playing and self._index == len(self._steps) - 1:
                    self._moves = -self._index
            else:
                self._playing = False
                self._moves += 1 if button == NEXT else -1
        self._changed(None)


def find_step(steps: Sequence[Step], key: str) -> int:
    """The step of that key; else the last of its kind ("sample-9" of "sample-12"); else the outcome."""
    keys = [step.key for step in steps]
    if key in keys:
        return keys.index(key)
    kind = key.split("-")[0]
    same = [k for k, other in enumerate(keys) if "-" in key and other.split("-")[0] == kind]
    return same[-1] if same else len(keys) - 1
