"""What a page asks for, and what it got."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spherloc.trace import Trace
from spherloc_viz.app.catalog import SceneRequest


@dataclass(frozen=True)
class RunRequest:
    """All that a run depends on."""

    scene: SceneRequest
    estimator: str
    """Registered name."""
    options: Any
    """The estimator's options dataclass."""


@dataclass(frozen=True, eq=False)
class Run:
    """A request fulfilled."""

    request: RunRequest
    trace: Trace
    kept: NDArray[np.int64]
    """(N,) number that each correspondence of the problem has where nothing is hidden."""
