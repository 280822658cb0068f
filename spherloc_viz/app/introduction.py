"""The introduction on a first visit: four moments of a run (``introduction.js`` shows them)."""

import json
from collections.abc import Sequence
from html import escape

from spherloc_viz.layers.primitives import StepHeading

Moment = tuple[tuple[str, ...], str, str]
"""Keys of the steps that show it, of which the first that a run has is taken; title; what it says."""

MOMENTS: tuple[Moment, ...] = (
    (
        ("bearings",),
        "Pixels become directions",
        "Each pixel of a fisheye or 360° image is a direction, a dot on the unit sphere, and is matched to a point of "
        "the map. Many matches are wrong. Where is the camera?",
    ),
    (
        ("yaw-clique", "consensus-bound", "samples-needed"),
        "Pairs vote on the yaw",
        "Gravity is known, so the yaw and the position are left. Any two matches allow only an arc of yaws on the "
        "ring; more arcs overlap where the camera really looks than at any other yaw.",
    ),
    (
        ("clique", "consensus-clique", "samples-drawn"),
        "Pairs vote on the position",
        "With the yaw known, any two matches allow only a ball of positions. The largest set of balls that all "
        "overlap, the maximum clique, holds the camera.",
    ),
    (
        ("outcome",),
        "The pose, and your turn",
        "Green matches agree with the pose, red ones do not, and View Sphere shows all of them: click a dot to ask why "
        "it was rejected. Walk through the steps with Next and Previous. Drag a slider of the settings: it is solved "
        "anew while you drag. Presets are simulations in which you choose how many matches are wrong.",
    ),
)
BY_SAMPLES = {
    "samples-needed": (
        "How many samples it takes",
        "Two matches fix a pose, but only right ones fix the right pose. The more matches are wrong, the more samples "
        "must be drawn until one is clean.",
    ),
    "samples-drawn": (
        "All matches vote on a sample",
        "RANSAC keeps the pose with which most matches agree. Whether a sample was clean, it cannot know.",
    ),
    "consensus-bound": (
        "A bound for every yaw",
        "Matches that one pose explains agree in pairs at its yaw. The ring shows how many can agree at most at each "
        "yaw: no pose explains more.",
    ),
    "consensus-clique": (
        "The largest set that agrees",
        "At its yaw all pairs of these matches agree, as the lines show. A larger set is looked for until there can be "
        "none.",
    ),
}
"""Title and words for estimators with other steps, by the key of the step."""
OPENING = ("yaw-clique", "consensus-bound")
"""Steps of which a page opens at the first that a run has, if it has any."""


def opening_step(steps: Sequence[StepHeading]) -> int:
    """Index of the step at which a page opens: that of the found yaw or, without one, the outcome."""
    keys = [step.key for step in steps]
    return next((keys.index(key) for key in OPENING if key in keys), len(keys) - 1)


def introduction_html(steps: Sequence[StepHeading], end: str) -> str:
    """What the page's script reads, put on the page once there is something to see; at its end the page goes to the
    step with the key ``end``."""
    keys = [step.key for step in steps]
    moments = []
    for wanted, title, words in MOMENTS:
        key = next((key for key in wanted if key in keys), keys[-1])
        title, words = BY_SAMPLES.get(key, (title, words))
        moments.append({"step": key, "title": title, "words": words})
    told = {"moments": moments, "end": end}
    return f'<div hidden data-introduction="{escape(json.dumps(told))}"></div>'
