"""Loads or compiles the numeric kernels before somebody waits for an answer.

A kernel is compiled for the types of its arguments, so that one is loaded here only if later calls have the same types.
That is why kernels pass constants to each other as ``np.int64(MOST_STEPS)``: to numba a constant of a module is a type
of its own, its value, for which the callee would be compiled again. And that is why arrays are given to a kernel with
the same layout, and writable or not, every time.
"""

from collections.abc import Callable, Iterable
from dataclasses import replace

from spherloc import kernel_cache, registry
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.datasets.synthetic import SyntheticScene
from spherloc.errors import InputError
from spherloc.estimators.base import estimate, options_type


def warm_up(announce: Callable[[str], None] | None = None, estimators: Iterable[str] | None = None) -> None:
    """Run estimators once on a tiny problem: two minutes after an installation, a fraction of a second later.

    ``estimators`` are the names of those that will be needed; all if it is None, and after an installation.
    ``announce`` is called with a sentence to show if it will be long, and for every extension that fails here, which
    hinders nothing else.
    """
    cold = kernel_cache.is_cold()
    if announce is not None and cold:
        how_often = "once after an installation"
        if kernel_cache.is_temporary():
            how_often = "at every start, since no folder to keep them can be written (NUMBA_CACHE_DIR names another)"
        announce(f"preparing the solvers, {how_often}: some two minutes …")
    scene = tiny_scene()
    names = tuple(dict.fromkeys(registry.names("estimators") if cold or estimators is None else estimators))
    for estimator in names:
        try:
            estimate(scene.problem(), estimator)
        except InputError as error:
            if not registry.extension_of("estimators", estimator):
                raise
            if announce is not None:
                announce(f"{error} The others work.")
    # With uncertain gravity, and enough matches to weigh them: the last step of all.
    uncertain = replace(scene, correspondences=40, noise_px=0.5, gravity_error_deg=0.5).problem()
    estimate(uncertain, "ransac-2p")
    if "auto" not in names and "mc-exact" not in names:
        return
    # So murky that the exact search has to use all that it has.
    murky = replace(scene, correspondences=12, outlier_rate=0.6, noise_px=10.0).problem()
    estimate(murky, "mc-exact", options_type("mc-exact")(bound_px=40.0))
    # With uncertain gravity it searches positions and tilts.
    estimate(uncertain, "mc-exact")


def tiny_scene() -> SyntheticScene:
    """The problem that every estimator has to take: 8 matches, 2 of them wrong."""
    camera = Equirectangular(width=2048, height=1024)  # sharp enough for every stage to have something to do
    return SyntheticScene("warm-up", camera, correspondences=8, outlier_rate=0.25, noise_px=0.1, seed=0)
