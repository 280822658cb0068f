"""Radial distortion shared by the fisheye models: where it stops being invertible, and a first guess of its inverse."""

from collections.abc import Callable, Sequence

import numpy as np

from spherloc.types import FloatArray

RIM_MARGIN = 1e-6
"""Share of a validity limit given up, under a thousandth of a pixel: at the limit itself nothing can be inverted."""

_REAL_ROOT = 1e-7
"""Two real roots that coincide come out as a complex pair this close (about sqrt(eps)) to the real axis."""


def first_positive_root(coefficients: Sequence[float]) -> float:
    """Smallest t > 0 with 1 + c1 t + c2 t^2 + ... = 0, or inf; ``coefficients`` are c1, c2, ...

    Solved for 1/t: that polynomial has the leading coefficient 1, so that vanishing coefficients cannot blow up. A
    coefficient that overflowed gives 0.
    """
    if not np.isfinite(coefficients).all():
        return 0.0
    reciprocal = np.roots(np.trim_zeros(np.concatenate([[1.0], coefficients]), "b"))
    real = reciprocal.real[np.abs(reciprocal.imag) <= _REAL_ROOT * np.abs(reciprocal)]
    largest = float(real.max(initial=0.0))
    return 1.0 / largest if largest > 0.0 else np.inf


class InverseTable:
    """Piecewise linear inverse of an increasing function: a starting point for Newton's method."""

    def __init__(self, function: Callable[[FloatArray], FloatArray], nodes: FloatArray) -> None:
        self._nodes = nodes
        self._values = function(nodes)
        self.end = float(self._values[-1])
        """Value at the last node: the end of what can be inverted."""

    def __call__(self, values: FloatArray) -> FloatArray:
        """Approximate arguments (N,) that give ``values`` (N,); the last node beyond ``end``."""
        return np.interp(values, self._values, self._nodes)
