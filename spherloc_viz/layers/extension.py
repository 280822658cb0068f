"""Stages of estimators that other packages register: those that nothing here draws, or whose drawing fails."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from spherloc import registry
from spherloc.errors import reason, shorten
from spherloc.trace import Stage
from spherloc_viz import style
from spherloc_viz.layers.frame import Frame, Plan, RunView

UNKNOWN = "Stage"
"""What a stage is called that has no name here."""


def is_extension(view: RunView) -> bool:
    """Whether the run's estimator is not spherloc's own."""
    return bool(registry.extension_of("estimators", view.trace.estimator))


def unknown(view: RunView, stage: Stage) -> list[Plan]:
    """One stop that says what is not drawn."""
    kind = shorten(str(stage.kind))
    return [Plan(f"stage-{kind}", f"Stage {kind}", lambda: _said(view, f"The stage {kind} has no drawing here."))]


def guarded_plans(view: RunView, stage: Stage, plans: Callable[[], list[Plan]]) -> list[Plan]:
    """What ``plans`` gives; for an extension, a stage that cannot be drawn becomes a stop that says why."""
    if not is_extension(view):
        return plans()
    try:
        found = plans()
    except Exception as error:  # the numbers of others
        sentence = _failure(stage, error)
        return [Plan(f"stage-{shorten(str(stage.kind))}", "Not drawn", lambda: _said(view, sentence))]
    return [replace(plan, draw=_guarded(view, stage, plan)) for plan in found]


def _guarded(view: RunView, stage: Stage, plan: Plan) -> Callable[[], Frame]:
    def draw() -> Frame:
        try:
            return plan.draw()
        except Exception as error:
            return _said(view, _failure(stage, error))

    return draw


def _failure(stage: Stage, error: Exception) -> str:
    return f"The stage {shorten(str(stage.kind))} cannot be drawn ({type(error).__name__}: {reason(error)})."


def _said(view: RunView, sentence: str) -> Frame:
    """A frame that shows nothing of its own."""
    trace = view.trace
    extension = registry.extension_of("estimators", trace.estimator)
    whose = f" It comes from the estimator {shorten(trace.estimator)}" + (f" of {extension}." if extension else ".")
    return Frame(
        sentence + whose,
        "",
        view.standing(np.eye(3)),
        view.colors(style.UNDECIDED),
        view.nobody(),
    )
