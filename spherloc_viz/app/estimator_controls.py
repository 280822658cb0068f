"""The widgets that choose an estimator and its options, made from the fields of its options dataclass."""

import ast
import dataclasses
import inspect
import textwrap
from collections.abc import Callable
from typing import Any

import viser

from spherloc import registry
from spherloc.estimators import default_options, options_type
from spherloc.problem import Problem

SLIDERS: dict[str, tuple[str, float, float, float]] = {
    "bound_px": ("Bound (px)", 0.5, 20.0, 0.5),
    "max_balls": ("Most balls", 10, 1000, 10),
}
"""Label, least, most and step of options that are best dragged; others become boxes to type in."""
NO_CONFIDENCE = "draw them all"
CONFIDENCES = (NO_CONFIDENCE, "0.9", "0.99", "0.999", "0.9999")


class EstimatorControls:
    """A choice of estimators, and the options of the chosen one."""

    def __init__(self, gui: viser.GuiApi, changed: Callable[[object], None]) -> None:
        names = registry.names("estimators")
        self._estimator = gui.add_dropdown("Estimator", names)
        self._estimator.on_update(changed)
        self._folders: dict[str, viser.GuiFolderHandle] = {}
        self._options: dict[str, dict[str, Any]] = {}
        for name in names:
            with gui.add_folder(None, visible=name == self._estimator.value) as folder:
                widgets = _widgets(gui, options_type(name))
            self._folders[name], self._options[name] = folder, widgets
            for widget in widgets.values():
                widget.on_update(changed)

    @property
    def widgets(self) -> tuple:
        """All of them."""
        return (self._estimator, *(widget for group in self._options.values() for widget in group.values()))

    def read(self) -> tuple[str, Any]:
        """The chosen estimator and its options; shows the widgets of these options only.

        Raises ``InputError`` for options that cannot be.
        """
        chosen = self._estimator.value
        for name, folder in self._folders.items():
            folder.visible = name == chosen
        values = {name: _option(widget.value) for name, widget in self._options[chosen].items()}
        return chosen, options_type(chosen)(**values)

    def follow_problem(self, problem: Problem) -> None:
        """Set every estimator's pixel bound to what the problem states, or to the estimator's default."""
        for name, widgets in self._options.items():
            if "bound_px" in widgets:
                widgets["bound_px"].value = default_options(name, problem).bound_px


def _option(value: Any) -> Any:
    if value == NO_CONFIDENCE:
        return None
    return float(value) if isinstance(value, str) else value


def _widgets(gui: viser.GuiApi, kind: type) -> dict[str, Any]:
    """One widget for every field of an options dataclass that is a number."""
    hints = field_docs(kind)
    out: dict[str, Any] = {}
    for field in dataclasses.fields(kind):
        name, hint = field.name, hints.get(field.name)
        value: Any = field.default
        if name in SLIDERS:
            label, least, most, step = SLIDERS[name]
            out[name] = gui.add_slider(label, least, most, step, value, hint=hint)
        elif name == "confidence":
            start = NO_CONFIDENCE if value is None else str(value)
            out[name] = gui.add_dropdown("Confidence", CONFIDENCES, initial_value=start, hint=hint)
        elif isinstance(value, bool):
            out[name] = gui.add_checkbox(_label(name), value, hint=hint)
        elif isinstance(value, int | float):
            out[name] = gui.add_number(_label(name), value, min=0, hint=hint)
    return out


def _label(name: str) -> str:
    return name.replace("_", " ").capitalize()


def field_docs(kind: type) -> dict[str, str]:
    """The docstring under each field of a dataclass, which Python itself does not keep."""
    body = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0]
    assert isinstance(body, ast.ClassDef)
    docs: dict[str, str] = {}
    for field, text in zip(body.body, body.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(text, ast.Expr):
            docs[field.target.id] = " ".join(str(ast.literal_eval(text.value)).split())
    return docs
