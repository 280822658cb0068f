"""Loads or compiles the numeric kernels before somebody waits for an answer."""

import os
from collections.abc import Callable
from pathlib import Path

from spherloc import registry
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.datasets.synthetic import SyntheticScene
from spherloc.estimators.base import estimate


def warm_up(announce: Callable[[str], None] | None = None) -> None:
    """Run every estimator once on a tiny problem: seconds after an installation, a fraction of one later.

    ``announce`` is called with a sentence to show if it will be seconds.
    """
    if announce is not None and not any(Path(os.environ["NUMBA_CACHE_DIR"]).rglob("*.nbi")):
        announce("preparing the solvers, once after an installation …")
    camera = Equirectangular(width=2048, height=1024)  # sharp enough for every stage to have something to do
    scene = SyntheticScene("warm-up", camera, correspondences=8, outlier_rate=0.25, noise_px=0.1, seed=0)
    for estimator in registry.names("estimators"):
        estimate(scene.problem(), estimator)
