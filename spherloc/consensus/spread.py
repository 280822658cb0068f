"""Whether the matches that agree with a pose lie all over a panorama, or on something in it that looks alike elsewhere.

A piece of furniture, a facade or a sign that stands at two places fixes a wrong pose well: its matches agree, nothing
else does. So a panorama's pose is doubted if nearly all matches that agree lie in a small part of the view, though
there are many matches in the rest of it of which hardly any agrees. Other images do not tell: at the edge of a map they
may look at it with a small part of their view.
"""

from dataclasses import dataclass

import numpy as np

from spherloc.cameras.base import Camera
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.problem import Problem
from spherloc.types import BoolArray, FloatArray

WITHIN = 0.9
"""Share of the matches that agree which the part of the view holds."""
MAX_RADIUS_DEG = 50.0
"""Largest angle from its middle to its rim of a part that is small."""
MIN_REST = 40
"""Least number of matches in the rest of the view that say something."""
MAX_RATIO = 0.15
"""``Spread.ratio`` below which hardly any match agrees in the rest of the view."""
MIN_AGREEING = 4
ROUNDING = 1e-12
"""Of a cosine: equal bearings are inside though their products are rounded in another way."""
MAX_CENTRES = 200
"""Largest number of directions that are tried as the middle of the part."""


@dataclass(frozen=True)
class Spread:
    """Where in the view the matches lie that agree with a pose."""

    radius_deg: float
    """Angle from the middle to the rim of the smallest part of the view with nine tenths of them."""
    inside: int
    """Number of matches in that part."""
    agreeing_inside: int
    """Number of those that agree."""
    rest: int
    """Number of matches elsewhere."""
    agreeing_rest: int
    """Number of those that agree."""

    @property
    def ratio(self) -> float:
        """Share of matches that agree in the rest of the view, divided by that in the part; inf without a rest."""
        return self.agreeing_rest * self.inside / (self.rest * self.agreeing_inside) if self.rest else np.inf

    @property
    def margin(self) -> float:
        """Natural logarithm of how far it is from the limit beyond which the pose is doubted, which it is below 0."""
        if self.rest == 0:
            return np.inf
        farthest = max(self.ratio / MAX_RATIO, self.radius_deg / MAX_RADIUS_DEG, MIN_REST / self.rest)
        return float(np.log(max(farthest, 1e-300)))

    @property
    def sentence(self) -> str:
        """What speaks against the pose."""
        return (
            f"Nearly all matches that agree lie within {self.radius_deg:.0f}° of one direction; elsewhere "
            f"{self.agreeing_rest} of {self.rest} do: something that looks alike may stand there."
        )


def spread_in(problem: Problem, agreeing: BoolArray) -> Spread | None:
    """``spread_of`` the ``agreeing`` (M,) usable correspondences of a problem whose matches are with images; None for
    others, as wrong matches of a simulation are wherever it puts them."""
    return spread_of(problem.camera, problem.aligned.bearings, agreeing) if problem.reference_images else None


def spread_of(camera: Camera, bearings: FloatArray, agreeing: BoolArray) -> Spread | None:
    """Where the ``agreeing`` (N,) ones among unit bearings (N, 3) lie in a panorama; None for another camera, and for
    fewer than ``MIN_AGREEING``."""
    chosen = bearings[agreeing]
    if not isinstance(camera, Equirectangular) or len(chosen) < MIN_AGREEING:
        return None
    centres = chosen[:: -(-len(chosen) // MAX_CENTRES)]
    cosines = np.quantile(centres @ chosen.T, 1.0 - WITHIN, axis=1, method="lower")
    best = int(cosines.argmax())
    inside = bearings @ centres[best] >= cosines[best] - ROUNDING
    return Spread(
        radius_deg=float(np.degrees(np.arccos(np.clip(cosines[best], -1.0, 1.0)))),
        inside=int(inside.sum()),
        agreeing_inside=int((inside & agreeing).sum()),
        rest=int((~inside).sum()),
        agreeing_rest=int((~inside & agreeing).sum()),
    )
