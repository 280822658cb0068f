"""The widgets that choose an estimator and its options, made from the fields of its options dataclass."""

import math
from collections.abc import Callable, Mapping
from typing import Any

import viser

from spherloc import registry
from spherloc.errors import InputError, show
from spherloc.estimators import default_options, options_type
from spherloc.problem import Problem
from spherloc.ranges import check_option
from spherloc_viz.app.text import OPTIONS, status_html
from spherloc_viz.app.web.viser_internals import put, update_widget
from spherloc_viz.options import NONE, OptionField, option_fields, usable_estimators

ABOUT: Mapping[str, str] = {
    "mc-exact": "exact, certified",
    "mc": "the paper's",
    "ransac-2p": "two points",
    "auto": "chooses itself",
}
"""Those that are offered first, in this order, and a word about each; others follow in alphabetical order."""
START = "mc"
"""The estimator that a page starts with."""
SLIDERS: Mapping[str, tuple[str, float, float, float]] = {
    "bound_px": (OPTIONS["bound_px"], 0.5, 20.0, 0.5),
    "noise_px": (OPTIONS["noise_px"], 0.1, 5.0, 0.1),
    "max_balls": ("Max. balls", 10, 1000, 10),
}
"""Label, least, most and step of options that are best dragged."""
PRESETS: Mapping[str, tuple[str, Mapping[str, float | None]]] = {
    "confidence": ("Confidence", {"draw them all": None, "0.9": 0.9, "0.99": 0.99, "0.999": 0.999, "0.9999": 0.9999}),
    "gravity_sd_deg": (
        OPTIONS["gravity_sd_deg"],
        {
            "as the problem states": None,
            "0: exact (4 DoF)": 0.0,
            "0.1": 0.1,
            "0.5": 0.5,
            "1": 1.0,
            "unknown (6 DoF)": math.inf,
        },
    ),
}
"""Label of options that are best chosen from a few values, and what they are called."""
UNITS = {"px": "px", "deg": "deg", "ms": "ms", "s": "s", "m": "m"}


class Option:
    """The widget of one option."""

    def __init__(self, gui: viser.GuiApi, field: OptionField) -> None:
        self.field = field
        self._values: Mapping[str, Any] | None = None
        label, hint, value = _label(field.name), field.doc, field.default
        if field.name in SLIDERS:
            label, least, most, step = SLIDERS[field.name]
            self.widget: Any = gui.add_slider(label, least, most, step, value, hint=hint)
        elif field.name in PRESETS:
            label, self._values = PRESETS[field.name]
        elif field.choices:
            self._values = {choice.replace("_", " "): choice for choice in field.choices}
        elif field.kind is bool and not field.optional:
            self.widget = gui.add_checkbox(label, value, hint=hint)
        elif field.optional or not math.isfinite(value):
            self.widget = gui.add_text(label, _typed(value), hint=f"{hint} {_range(field)}")
        else:
            self.widget = gui.add_number(label, value, min=0, hint=hint)
        if self._values is not None:
            if value not in self._values.values():
                self._values = {_typed(value): value, **self._values}
            start = _name(self._values, value)
            self.widget = gui.add_dropdown(label, tuple(self._values), initial_value=start, hint=hint)

    def read(self) -> Any:
        """The option's value; raises ``InputError`` if the typed text is not a number that solvers can use."""
        value = self.widget.value
        if self._values is not None:
            return self._values[value]
        if isinstance(value, str):
            return self.field.parse(value or NONE)
        check_option(self.field.name, value)
        return value

    def write(self, value: Any) -> None:
        """Show a value; a dropdown or a slider is widened for one that it does not offer."""
        if self._values is not None:
            if value not in self._values.values():
                self._values = {_typed(value): value, **self._values}
                self.widget.options = tuple(self._values)
            value = _name(self._values, value)
        elif isinstance(self.widget, viser.GuiSliderHandle):
            self.widget.min, self.widget.max = min(self.widget.min, value), max(self.widget.max, value)
        elif isinstance(self.widget.value, str):
            value = _typed(value)
        put(self.widget, value)


class EstimatorControls:
    """A choice of estimators, and the options of the chosen one."""

    def __init__(self, gui: viser.GuiApi, changed: Callable[[object], None]) -> None:
        self._names = estimator_labels(usable_estimators())
        start = _name(self._names, START)
        self._estimator = gui.add_dropdown("Estimator", tuple(self._names), initial_value=start)
        self._estimator.on_update(changed)
        self._remark = gui.add_html("")
        """Says so where another estimator came with another bound."""
        self._unlisted: dict[str, Any] = {}
        """Options of estimators that no list offers, such as a given pose; opened runs bring them."""
        self._folders: dict[str, viser.GuiFolderHandle] = {}
        self._options: dict[str, dict[str, Option]] = {}
        for label, name in self._names.items():
            fields = option_fields(options_type(name))
            with gui.add_folder(None, visible=label == start) as folder:
                options = {field.name: Option(gui, field) for field in fields if not field.shared}
                with gui.add_folder("Refinement", expand_by_default=False):
                    options |= {field.name: Option(gui, field) for field in fields if field.shared}
            self._folders[name], self._options[name] = folder, options
            for option in options.values():
                option.widget.on_update(changed)

    def read(self) -> tuple[str, Any]:
        """The chosen estimator and its options; shows the widgets of these options only.

        Raises ``InputError`` for invalid options.
        """
        chosen = self._names[self._estimator.value]
        self._show(chosen)
        if chosen in self._unlisted:
            return chosen, self._unlisted[chosen]
        values = {name: option.read() for name, option in self._options[chosen].items()}
        return chosen, options_type(chosen)(**values)

    def write(self, name: str, options: Any) -> None:
        """Choose an estimator and show its options.

        Raises ``InputError`` if there is none of that name.
        """
        if ("estimators", name) in registry.UNLISTED:
            self._offer(name, options)
            return
        if name not in self._folders:
            raise InputError(f"unknown estimator {show(name)}: choose one of {', '.join(self._folders)}.")
        for key, option in self._options[name].items():
            option.write(getattr(options, key))
        put(self._estimator, _name(self._names, name))
        self._show(name)

    def _offer(self, name: str, options: Any) -> None:
        """Choose an estimator that no list offers, with options that no widget shows."""
        self._unlisted[name] = options
        if name not in self._names.values():
            self._names |= {name: name}
            self._estimator.options = tuple(self._names)
        put(self._estimator, _name(self._names, name))
        self._show(name)

    def _show(self, chosen: str) -> None:
        """Show the options of that estimator only, and say so if its bound is another one than that shown before."""
        before = next((name for name, folder in self._folders.items() if folder.visible), chosen)
        if chosen != before:
            old_px, new_px = (self._bound_px(name) for name in (before, chosen))
            differ = None not in (old_px, new_px) and old_px != new_px
            sentence = f"Bound now {new_px:g} px, not {old_px:g} px: each estimator has its own." if differ else ""
            update_widget(self._remark, content=status_html(sentence) if sentence else "")
        for name, folder in self._folders.items():
            if folder.visible != (name == chosen):
                folder.visible = name == chosen

    def _bound_px(self, name: str) -> float | None:
        """The bound that the widgets of an estimator show; None if no list offers it."""
        return self._options[name]["bound_px"].read() if name in self._options else None

    def follow_problem(self, problem: Problem) -> None:
        """Set every estimator's pixel bound to what the problem states, or to the estimator's default."""
        for name, options in self._options.items():
            options["bound_px"].write(default_options(name, problem).bound_px)


def estimator_labels(names: tuple[str, ...]) -> dict[str, str]:
    """Labels of registered estimators, in the order in which they are offered, and their names."""
    order = sorted(names, key=lambda name: list(ABOUT).index(name) if name in ABOUT else len(ABOUT))
    return {f"{name} ({ABOUT[name]})" if name in ABOUT else name: name for name in order}


def _name(values: Mapping[str, Any], wanted: Any) -> str:
    """What a value is called; the first one if it is none of them."""
    return next((name for name, value in values.items() if value == wanted), next(iter(values)))


def _typed(value: Any) -> str:
    """A number as it is typed, with all its digits."""
    if value is None or isinstance(value, str):
        return NONE if value is None else value
    return f"{value:g}" if float(f"{value:g}") == value else repr(value)


def _range(field: OptionField) -> str:
    return f"A number, or {NONE}." if field.optional else "A number, or inf."


def _label(name: str) -> str:
    """ "time_budget_ms" as "Time budget (ms)"."""
    if name == "as_printed":
        return "As in the paper"
    words, _, unit = name.rpartition("_")
    text, suffix = (words, f" ({UNITS[unit]})") if unit in UNITS and words else (name, "")
    return text.replace("_", " ").capitalize() + suffix
