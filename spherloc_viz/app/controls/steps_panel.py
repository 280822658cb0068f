"""The timeline of a run: a slider, its stages, a list of the steps, previous, next, play, and the step's caption."""

import threading
from collections.abc import Callable, Sequence
from html import escape
from typing import Any, Literal

import viser

from spherloc_viz import style
from spherloc_viz.app.glossary import linked
from spherloc_viz.app.introduction import opening_step
from spherloc_viz.app.text import box, step_html, table_html
from spherloc_viz.app.web.viser_internals import at_once, put, update_widget
from spherloc_viz.layers.primitives import Step, StepHeading, Table

PLAY_S = 3.0
"""How long a step stays while playing: time to read its two sentences."""
SHORT = 0.4
"""Share of that time that the steps of a long stage stay, but for the last, which says what came of them."""
LONG_STAGE = 6
"""Least number of steps of a long stage."""
PACES = {"1×": 1.0, "2×": 2.0, "4×": 4.0, "½×": 0.5}
PREVIOUS, NEXT, PLAY, PAUSE = "Previous", "Next", "Play", "Pause"
BACK, ON = "Previous stage", "Next stage"
HOTKEYS: tuple[tuple[str, str, Literal["B", "N", "P"], Literal["shift"] | None], ...] = (
    (PREVIOUS, "Previous step", "B", None),
    (NEXT, "Next step", "N", None),
    (PLAY, "Play or pause", "P", None),
    (BACK, "Previous stage", "B", "shift"),
    (ON, "Next stage", "N", "shift"),
)
"""viser's canvas takes the arrows and W, A, S, D, Q, E."""


class StepsPanel:
    """Which step is on. Widgets only note requests; ``advance`` acts on them, on the session's page thread."""

    def __init__(self, gui: viser.GuiApi, changed: Callable[[object], None]) -> None:
        self._changed = changed
        self._lock = threading.Lock()
        self._moves: list[str] = []
        self._goal: str | int | None = None
        """Key, or number of a step from 1 on, that was asked for."""
        self._playing = False
        self._steps: tuple[StepHeading, ...] = ()
        self._index = 0
        titles: list[str] = ["-"]
        self._stages = gui.add_html("")
        self._slider = gui.add_slider("Timeline", 1, 2, 1, 1, marks=())
        self._buttons = gui.add_button_group("Keys B, N, P", (PREVIOUS, NEXT, PLAY))
        self.cause = gui.add_html("")
        """Just above what the step says: what a reader should not have to scroll to."""
        self._text = gui.add_html("")
        self.remark = gui.add_html("")
        """Just below it."""
        self._choice = gui.add_dropdown("Step", titles)
        self._pace = gui.add_dropdown("Pace", tuple(PACES), hint="How fast the steps play.")
        self._slider.on_update(self._slide)
        self._choice.on_update(self._pick)
        self._buttons.on_click(self._click)
        for button, label, hotkey, modifier in HOTKEYS:
            command: Any = gui.add_command(label, hotkey=hotkey, modifier=modifier)
            command.on_trigger(lambda event, button=button: self._press(button))

    def advance(self, steps: tuple[StepHeading, ...], asked: bool) -> tuple[int, float | None]:
        """Index of the step to show, and seconds to the next one if playing; ``asked`` is false for its alarm."""
        if steps != self._steps:
            known = self._steps
            self._index = find_step(steps, known[self._index].key) if known else opening_step(steps)
            self._steps = steps
        with self._lock:
            moves, self._moves = self._moves, []
            goal, self._goal = self._goal, None
            last = len(steps) - 1
            if goal is not None:
                self._index = min(goal - 1, last) if isinstance(goal, int) else find_step(steps, goal)
            if self._playing and not asked:
                moves.append(NEXT)
            for move in moves:
                self._index = moved(steps, self._index, move)
            if self._index == last and not asked:
                self._playing = False
            playing = self._playing
        return self._index, self._stay() if playing else None

    def _stay(self) -> float:
        """Seconds that the step at hand stays."""
        stages = [step.stage for step in self._steps]
        stage = stages[self._index]
        short = stages.count(stage) >= LONG_STAGE and stages[self._index + 1 : self._index + 2] == [stage]
        return PLAY_S * (SHORT if short else 1.0) / PACES[self._pace.value]

    def show(self, step: Step, playing: bool, tables: Sequence[Table]) -> None:
        """Put the step at hand, as it was painted, and its tables on the page."""
        titles = titles_of(self._steps)
        if self._choice.options != titles:
            self._choice.options = titles
            self._slider.max = max(2, len(titles))
        with self._lock:
            put(self._choice, titles[self._index])
            put(self._slider, self._index + 1)
        buttons = (PREVIOUS, NEXT, PAUSE if playing else PLAY)
        if self._buttons.options != buttons:
            self._buttons.options = buttons
        end = "first" if self._index == 0 else "last" if self._index == len(self._steps) - 1 else ""
        place = f"{self._index + 1}/{len(self._steps)}"
        texts = (
            (self._stages, stages_html(self._steps, self._index)),
            (self._text, step_html(step, linked, end, place) + "".join(table_html(table) for table in tables)),
        )
        for widget, html in texts:
            update_widget(widget, content=html)

    def go(self, key: str) -> None:
        """Go to the step of that key, or to the nearest there is."""
        self._ask_for(key)
        self._changed(None)

    def begin_at(self, key: str) -> None:
        """Show the step of that key first, unless another one is asked for; on the session's page thread."""
        with self._lock:
            self._goal = key if self._goal is None else self._goal

    def move(self, button: str) -> None:
        """Press "Previous", "Next" or "Play"; other names are ignored."""
        if button in (PREVIOUS, NEXT, PLAY):
            self._press(button)

    def _ask_for(self, goal: str | int) -> None:
        with self._lock:
            self._goal, self._moves, self._playing = goal, [], False

    # Showing a step sets the list and the slider too; only a choice made on the page counts.

    @at_once
    def _pick(self, event: viser.GuiEvent) -> None:
        if event.client is not None and event.target.value in self._choice.options:
            self._ask_for(self._choice.options.index(event.target.value) + 1)
            self._changed(event)

    @at_once
    def _slide(self, event: viser.GuiEvent) -> None:
        if event.client is not None:
            self._ask_for(max(1, int(event.target.value)))
            self._changed(event)

    @at_once
    def _click(self, event: viser.GuiEvent) -> None:
        self._press(event.target.value)

    def _press(self, button: str) -> None:
        with self._lock:
            if button in (PLAY, PAUSE):
                self._playing = not self._playing
                if self._playing and self._index == len(self._steps) - 1:
                    self._goal = 1
            else:
                self._playing = False
                self._moves.append(button)
        self._changed(None)


def titles_of(steps: Sequence[StepHeading]) -> tuple[str, ...]:
    """What the steps are called in the list."""
    return tuple(f"{k}/{len(steps)}  {step.title}" for k, step in enumerate(steps, 1))


def moved(steps: Sequence[StepHeading], index: int, move: str) -> int:
    """Index of the step to which a button leads from the step at ``index``."""
    starts = [k for k, step in enumerate(steps) if k == 0 or step.stage != steps[k - 1].stage]
    if move == BACK:
        return max((start for start in starts if start < index), default=0)
    if move == ON:
        return min((start for start in starts if start > index), default=len(steps) - 1)
    return min(max(0, index + (1 if move == NEXT else -1)), len(steps) - 1)


def find_step(steps: Sequence[StepHeading], key: str) -> int:
    """The step of that key; else the nearest of its kind; else the outcome.

    "sample-12" is of the kind of "sample-9", and "yaw-arcs-100" of that of "yaw-arcs-30" and "yaw-arcs", and rather
    than that of "yaw-clique". Of a kind, the last whose number is not above the one asked for is the nearest.
    """
    keys = [step.key for step in steps]
    if key in keys:
        return keys.index(key)
    parts = key.split("-")
    for length in range(len(parts) - 1, 0, -1):
        kind = [k for k, other in enumerate(keys) if other.split("-")[:length] == parts[:length]]
        if kind:
            wanted = _number(parts[length])
            below = [k for k in kind if _number(keys[k].split("-")[length : length + 1]) <= wanted]
            return below[-1] if below else kind[-1]
    return len(keys) - 1


def _number(parts: str | list[str]) -> float:
    """A part of a key as a number; infinite if it is not a number."""
    text = parts if isinstance(parts, str) else "".join(parts)
    return float(text) if text.isdecimal() else float("inf")


def stages_html(steps: Sequence[StepHeading], index: int) -> str:
    """The stages as bars, each as long as it has steps and filled as far as the step at hand; a press goes there.

    In a narrow panel the names of the others than that at hand are cut."""
    stages = list(dict.fromkeys(step.stage for step in steps))
    bars = []
    for stage in stages:
        own = [k for k, step in enumerate(steps) if step.stage == stage]
        share = min(max((index - own[0] + 1) / len(own), 0.0), 1.0)
        here = own[0] <= index <= own[-1]
        color = style.css(style.ESTIMATE)
        bar = (
            '<div style="height:5px;border-radius:3px;overflow:hidden;background:color-mix(in srgb, currentColor 18%, '
            f'transparent)"><div style="height:100%;width:{100 * share:.1f}%;background:{color}"></div></div>'
        )
        css = "font-weight:600" if here else "opacity:.65"
        where = f"{index - own[0] + 1} of {len(own)}" if here else f"{len(own)} step{'s' if len(own) > 1 else ''}"
        bars.append(
            f'<div data-touch="step:{escape(steps[own[0]].key)}" role="button" tabindex="0" title="{escape(stage)}: '
            f'{where}" style="flex:{len(own)} {0 if here else 1} auto;min-width:0;cursor:pointer;{css}">{bar}'
            '<div style="padding-top:.15em;white-space:nowrap;overflow:hidden">'
            f"{escape(stage)}</div></div>"
        )
    row = f'<div style="display:flex;gap:5px">{"".join(bars)}</div>'
    return box(row, "font-size:12px;padding-top:.4em;padding-bottom:.2em")
