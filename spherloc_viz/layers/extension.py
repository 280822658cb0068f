"""Stages of estimators that other packages register, and the layers that draw them.

A stage that nothing draws, or whose drawing fails, becomes a step that says so in a sentence.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from spherloc import registry
from spherloc.errors import InputError, reason, shorten, show
from spherloc.trace import Stage
from spherloc_viz import style
from spherloc_viz.layers.frame import Frame, Plan, RunView
from spherloc_viz.layers.primitives import (
    Balls,
    Chart,
    Curve,
    Focus,
    Graph,
    Label,
    Mesh,
    Points,
    SceneItem,
    Segments,
    Table,
)

UNKNOWN = "Stage"
"""Name of a stage that no layer names."""

ARRAYS: dict[type, tuple[tuple[str, tuple[int | str, ...], str], ...]] = {
    Points: (("positions", ("N", 3), "f"), ("colors", ("N", 3), "u")),
    Segments: (("points", ("N", 2, 3), "f"), ("colors", ("N", 3), "u")),
    Balls: (("centers", ("N", 3), "f"), ("radii_m", ("N",), "f"), ("colors", ("N", 3), "u")),
    Mesh: (("vertices", ("N", 3), "f"), ("faces", ("F", 3), "i")),
    Label: (("position", (3,), "f"),),
    Curve: (("x", ("K",), "f"), ("y", ("K",), "f")),
    Focus: (("points", ("K", 3), "f"),),
}
"""Field, shape and numpy's kind of the arrays of each drawable class; equal letters mean equal lengths."""
_KINDS = {"f": "fiu", "u": "u", "i": "iu", "b": "b"}
_WORDS = {"f": "numbers", "u": "uint8", "i": "whole numbers", "b": "truth values"}


@dataclass(frozen=True)
class Layer:
    """Draws one class of stages, on the page and in recordings alike; registered by entry point in the group
    ``spherloc.layers``, under the stage's ``kind``."""

    stage: type[Stage]
    """The class of the stages that it draws."""
    title: str
    """Name of the stage for users, a word or two, such as "Samples"."""
    plans: Callable[[RunView, Any], list[Plan]]
    """The steps of such a stage of a run, in their order. Keys begin with the stage's kind, such as "guess-3"."""


def layer_of(kind: str) -> Layer:
    """The layer registered for stages of that kind.

    Raises ``InputError`` if there is none, or if it cannot be imported or is not a ``Layer`` of that kind.
    """
    found = registry.lookup("layers", kind)
    what = registry.title("layers", kind)
    if not (isinstance(found, Layer) and isinstance(found.title, str) and callable(found.plans)):
        raise InputError(f"{what} is {show(found)}, no Layer with title and plans; tell its authors.")
    if not (isinstance(found.stage, type) and issubclass(found.stage, Stage)):
        raise InputError(f"{what} draws {show(found.stage)}, not a class of Stage; tell its authors.")
    if found.stage.kind != kind:
        raise InputError(f"{what} draws stages of the kind {show(found.stage.kind)}; both must have one name.")
    return found


def is_extension(view: RunView) -> bool:
    """Whether the run's estimator is not spherloc's own."""
    return bool(registry.extension_of("estimators", view.trace.estimator))


def named_plans(view: RunView, stage: Stage, taken: Collection[str]) -> tuple[str, list[Plan]]:
    """Name and steps of a stage of an extension; ``taken`` are the kinds of spherloc's own stages, which layers of
    extensions do not draw."""
    kind = str(stage.kind)
    if kind in taken or kind not in registry.names("layers"):
        return UNKNOWN, unknown(view, stage)
    try:
        layer = layer_of(kind)
    except InputError as error:
        return UNKNOWN, [_sentence_step(view, stage, str(error))]
    title = shorten(layer.title)
    if type(stage) is not layer.stage:
        what = f"{type(stage).__module__}.{type(stage).__name__}"
        return UNKNOWN, [
            _sentence_step(view, stage, f"{registry.title('layers', kind)} draws another class than {what}.")
        ]
    return title, guarded_plans(view, stage, lambda: whole_plans(layer.plans(view, stage), kind))


def unknown(view: RunView, stage: Stage) -> list[Plan]:
    """One step that says what is not drawn."""
    kind = shorten(str(stage.kind))
    return [Plan(f"stage-{kind}", f"Stage {kind}", lambda: _said(view, f"The stage {kind} has no drawing here."))]


def guarded_plans(view: RunView, stage: Stage, plans: Callable[[], list[Plan]]) -> list[Plan]:
    """The result of ``plans``; if an extension's stage cannot be drawn, a step that says why."""
    if not is_extension(view):
        return plans()
    try:
        found = plans()
    except Exception as error:  # the numbers of others
        return [_sentence_step(view, stage, _failure(stage, error))]
    return [
        replace(
            plan,
            draw=_guarded(view, stage, plan.draw),
            untold=None if plan.untold is None else _guarded(view, stage, plan.untold),
        )
        for plan in found
    ]


def _sentence_step(view: RunView, stage: Stage, sentence: str) -> Plan:
    sentence = sentence[:1].upper() + sentence[1:]
    return Plan(f"stage-{shorten(str(stage.kind))}", "Not drawn", lambda: _said(view, sentence))


def _guarded(view: RunView, stage: Stage, drawn: Callable[[], Frame]) -> Callable[[], Frame]:
    def draw() -> Frame:
        try:
            return whole_frame(drawn(), len(view.points))
        except Exception as error:
            return _said(view, _failure(stage, error))

    return draw


def _failure(stage: Stage, error: Exception) -> str:
    kind = str(stage.kind)
    is_own = type(stage).__module__ == Stage.__module__
    by = "" if is_own or kind not in registry.names("layers") else registry.extension_of("layers", kind)
    drawn_by = f" by the layer of {by}" if by else ""
    return f"The stage {shorten(kind)} cannot be drawn{drawn_by} ({type(error).__name__}: {reason(error)})."


def _said(view: RunView, sentence: str) -> Frame:
    """A frame with a sentence and nothing else of its own."""
    trace = view.trace
    extension = registry.extension_of("estimators", trace.estimator)
    whose = f" It comes from the estimator {shorten(trace.estimator)}" + (f" of {extension}." if extension else ".")
    return Frame(
        sentence + whose,
        "",
        view.standing(np.eye(3)),
        view.colors(style.UNDECIDED),
        view.no_matches(),
    )


def whole_plans(found: Any, kind: str) -> list[Plan]:
    """The plans of a stage; raises ``InputError`` unless they are a list of plans with unique keys."""
    if not isinstance(found, list) or not all(isinstance(plan, Plan) for plan in found):
        raise InputError(f"plans() gives {show(found)}, no list of Plan")
    keys = [plan.key for plan in found]
    for key in keys:
        if not isinstance(key, str) or not key.startswith(kind) or keys.count(key) > 1:
            raise InputError(f"the key {show(key)} of a plan does not begin with {show(kind)}, or another one has it")
    for plan in found:
        draws = callable(plan.draw) and (plan.untold is None or callable(plan.untold))
        if not isinstance(plan.title, str) or not draws or not isinstance(plan.charts, Mapping):
            raise InputError(f"the plan {show(plan.key)} has a title, draw, untold or charts of a wrong type")
    return found


def whole_frame(frame: Any, count: int) -> Frame:
    """The frame of a run of ``count`` correspondences; raises ``InputError`` if it cannot be drawn."""
    if not isinstance(frame, Frame):
        raise InputError(f"draw() gives {show(frame)}, no Frame")
    for name, shape, kind in (("cam_from_map", (3, 4), "f"), ("colors", (count, 3), "u"), ("rays", (count,), "b")):
        _check_array("the frame", frame, name, shape, kind, {})
    if not all(isinstance(text, str) for text in (frame.caption, frame.equation, frame.note)):
        raise InputError("caption, equation or note of the frame is not a text")
    for item in frame.items:
        if not isinstance(item, SceneItem) or not isinstance(item.name, str) or item.layer not in style.LAYERS:
            raise InputError(f"{show(item)} is not a primitive in one of the layers {', '.join(style.LAYERS)}")
        _check_arrays(f"the primitive {shorten(item.name)}", item)
    for table in frame.tables:
        if not isinstance(table, Table) or any(len(row) != len(table.columns) for row in table.rows):
            raise InputError("a table is not a Table, or has a row of another length than its columns")
    if frame.focus is not None:
        _check_arrays("the focus", frame.focus)
    return frame


def whole_chart(chart: Any) -> Chart:
    """The chart; raises ``InputError`` if it cannot be drawn."""
    if not isinstance(chart, Chart) or not all(isinstance(curve, Curve) for curve in chart.curves):
        raise InputError(f"{show(chart)} is not a Chart of curves")
    for curve in chart.curves:
        _check_arrays(f"the curve {show(curve.label)}", curve)
    return chart


def whole_graph(graph: Any) -> Graph:
    """The graph; raises ``InputError`` if it is not a ``Graph`` that can be drawn."""
    if not isinstance(graph, Graph):
        raise InputError(f"{show(graph)} is not a Graph")
    return graph


def _check_arrays(what: str, item: Any) -> None:
    known: dict[str, int] = {}
    for name, shape, kind in ARRAYS.get(type(item), ()):
        _check_array(what, item, name, shape, kind, known)


def _check_array(
    what: str, item: Any, name: str, shape: tuple[int | str, ...], kind: str, known: dict[str, int]
) -> None:
    array = getattr(item, name)
    good = isinstance(array, np.ndarray) and array.ndim == len(shape) and array.dtype.kind in _KINDS[kind]
    if good and kind == "u":
        good = array.dtype == np.uint8
    if good:
        sizes = [known.setdefault(size, array.shape[axis]) if isinstance(size, str) else size
                 for axis, size in enumerate(shape)]  # fmt: skip
        good = array.shape == tuple(sizes)
    if not good:
        given = f"{array.dtype} of shape {array.shape}" if isinstance(array, np.ndarray) else show(array)
        wanted = f"({', '.join(map(str, shape))}{',' * (len(shape) == 1)})"
        raise InputError(f"{name} of {what} is {given}, not an array of {_WORDS[kind]} of shape {wanted}")
