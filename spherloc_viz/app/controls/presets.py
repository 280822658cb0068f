"""Named states of the page, each of which shows one thing."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from spherloc.datasets import bundled_scenes
from spherloc.datasets.variation import Variation
from spherloc.estimators import options_type
from spherloc_viz.app.catalog import Catalog, SceneRequest


@dataclass(frozen=True)
class Preset:
    """A state of the page with a story."""

    title: str
    """A few words."""
    story: str
    """What is seen and what to try, in one sentence."""
    scene: SceneRequest
    estimator: str
    """Registered name."""
    options: Any
    """The estimator's options dataclass."""
    fails: bool
    """Whether the run's pose is wrong."""


@dataclass(frozen=True)
class _Recipe:
    """A preset before its scene is found in a catalog."""

    title: str
    story: str
    scene: str
    """Stem of a bundled scene file."""
    seed: int
    variation: Variation = field(default_factory=Variation)
    estimator: str = "mc-exact"
    options: Mapping[str, Any] = field(default_factory=dict)
    fails: bool = True


RECIPES = (
    _Recipe(
        "A quiet start",
        "Sixty matches of a panorama, 30 % of them wrong: raise the outliers and watch the certificate.",
        "panorama_outliers_80",
        0,
        Variation(correspondences=60, noise_px=0.5, outlier_rate=0.3),
        fails=False,
    ),
    _Recipe(
        "Paper Fig. 6 at 90 %",
        "The paper's fisheye, 100 matches and 10 of them right: maximum consensus finds the pose, as for 498 of 500 "
        "seeds.",
        "mei_outliers_90",
        0,
        estimator="mc",
        fails=False,
    ),
    _Recipe(
        "RANSAC bad luck",
        "90 % of the matches are wrong, and none of RANSAC's 100 samples is a pair of right ones: take another seed or "
        "1000 iterations.",
        "mei_outliers_90",
        2,
        estimator="ransac-2p",
        options={"iterations": 100},
    ),
    _Recipe(
        "Coherent outliers",
        "The wrong matches agree with one wrong pose and outnumber the right ones, so the proven optimum is wrong: "
        "lower the outliers below 50 %.",
        "mei_outliers_80",
        0,
        Variation(outlier_rate=0.6, outlier_kind="coherent"),
    ),
    _Recipe(
        "Repeated facades",
        "Wrong matches land on copies of a facade that repeats every 2 m, and the pose is just one step off: lower "
        "the outliers to 60 %.",
        "panorama_outliers_80",
        0,
        Variation(outlier_kind="repeated"),
    ),
    _Recipe(
        "Horizontal bearings",
        "All points are as high as the camera, so hardly any pair of matches says anything about yaw and counting "
        "pairs fails: choose mc-exact, which counts matches.",
        "panorama_outliers_80",
        0,
        Variation(cloud_height_m=0.1),
        estimator="mc",
    ),
    _Recipe(
        "Tilted car",
        "Roll and pitch are off by 1.4° and the refinement is told to believe them, so the pose is off as well: set "
        "Gravity sd, under Refinement, to what the problem states, and it mends both.",
        "mei_outliers_80",
        1,
        Variation(outlier_rate=0.5, gravity_error_deg=1.0),
        options={"gravity_sd_deg": 0.0},
    ),
)


def presets(catalog: Catalog) -> tuple[Preset, ...]:
    """Those whose scene the catalog has, in the order in which they are offered."""
    labels = {catalog.path(label): label for label in catalog.scenes}
    paths = {stem: path.resolve() for stem, path in bundled_scenes().items()}
    return tuple(
        Preset(
            recipe.title,
            recipe.story,
            SceneRequest(labels[paths[recipe.scene]], recipe.seed, None, recipe.variation),
            recipe.estimator,
            options_type(recipe.estimator)(**recipe.options),
            recipe.fails,
        )
        for recipe in RECIPES
        if paths.get(recipe.scene) in labels
    )
