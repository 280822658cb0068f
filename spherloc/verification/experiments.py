"""The paper's simulations (Sec. VI-A) as sweeps, and the methods that take part in them.

A method is named as in the paper where it does what is printed (``as_printed``, a bound of 8 px), and as the
estimator is called here where it is this project's own form of it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from spherloc.datasets import scene_path
from spherloc.datasets.variation import Variation
from spherloc.experiments.sweep_plan import Entrant, SweepPlan, planned

BOUND_PX = 8.0
"""The paper's bound of an inlier (Sec. VI-B)."""


def _printed(estimator: str, bound_px: float = BOUND_PX, **options: float) -> Entrant:
    return Entrant(estimator, (("as_printed", True), ("bound_px", bound_px), *options.items()))


def _own(estimator: str, **options: float) -> Entrant:
    return Entrant(estimator, tuple(options.items()))


PAPERS_VIEW_DEG = 120.0
"""Field of view of the paper's rectified images, which it does not print: what wide rectified images keep."""
WIDE_VIEWS: Mapping[str, float] = {"174°": 174.0, "sphere": 360.0}
"""Fields of view, degrees, in which the pinhole solvers are run as their authors would, with samples by P3P."""
PINHOLE_SOLVERS: Mapping[str, str] = {"EPnP": "ransac-epnp", "EPro": "ransac-epropnp", "oDLT": "ransac-odlt"}
WIDE_SOLVERS: Mapping[str, tuple[str, float]] = {
    f"{name} {how}": (estimator, view_deg)
    for how, view_deg in WIDE_VIEWS.items()
    for name, estimator in PINHOLE_SOLVERS.items()
}
"""Estimator and field of view, degrees, by the method's name."""


def wide(name: str, iterations: int) -> Entrant:
    """One of ``WIDE_SOLVERS`` with ``iterations`` samples by P3P."""
    estimator, view_deg = WIDE_SOLVERS[name]
    return _printed(estimator, iterations=iterations, view_deg=view_deg)


def rectified(estimator: str, iterations: int) -> Entrant:
    """The paper's R+* methods: on rectified images, with samples by EPnP as in OpenCV's RANSAC."""
    changes = (("as_printed", True), ("bound_px", BOUND_PX), ("iterations", iterations))
    return Entrant(estimator, (*changes, ("view_deg", PAPERS_VIEW_DEG), ("sampler", "epnp")))


ALIKE: Mapping[str, tuple[str, dict[str, float]]] = {
    "2P": ("ransac-2p", {}),
    "P3P": ("ransac-p3p", {}),
    "MLPnP": ("ransac-mlpnp", {"covariances": True}),
    "SVD": ("ransac-svd", {}),
    "EPnP": ("ransac-epnp", {"view_deg": 360.0}),
    "EPro-PnP": ("ransac-epropnp", {"view_deg": 360.0}),
    "oDLT": ("ransac-odlt", {"view_deg": 360.0}),
}
"""Methods under equal terms, see ``_alike``."""


def _alike(estimator: str, **options: float) -> Entrant:
    """99.9 % confidence of a clean sample, at most 10,000 samples, local optimization, Algorithm 1's last step."""
    return _printed(estimator, iterations=10_000, confidence=0.999, local_optimization=True, **options)


METHODS: Mapping[str, Entrant] = {
    "MC": _printed("mc"),
    "MC 3px": _printed("mc", 3.0),
    "2P100": _printed("ransac-2p", iterations=100),
    "2P1k": _printed("ransac-2p", iterations=1000),
    "2P10k": _printed("ransac-2p", iterations=10_000),
    "SVD100": _printed("ransac-svd", iterations=100),
    "SVD10k": _printed("ransac-svd", iterations=10_000),
    "ML100": _printed("ransac-mlpnp", iterations=100, covariances=False),
    "ML1k": _printed("ransac-mlpnp", iterations=1000, covariances=False),
    "ML10k": _printed("ransac-mlpnp", iterations=10_000, covariances=False),
    "ML1k cov": _printed("ransac-mlpnp", iterations=1000, covariances=True),
    "ML10k cov": _printed("ransac-mlpnp", iterations=10_000, covariances=True),
    "P3P100": _printed("ransac-p3p", iterations=100),
    "P3P1k": _printed("ransac-p3p", iterations=1000),
    "P3P10k": _printed("ransac-p3p", iterations=10_000),
    "R+EPnP": rectified("ransac-epnp", 10_000),
    "R+EPro": rectified("ransac-epropnp", 10_000),
    "R+oDLT": rectified("ransac-odlt", 10_000),
    **{
        f"{name}, {words}": wide(name, iterations)
        for words, iterations in (("1k", 1000), ("10k", 10_000))
        for name in WIDE_SOLVERS
    },
    **{f"{name}, alike": _alike(estimator, **options) for name, (estimator, options) in ALIKE.items()},
    "mc": _own("mc"),
    "mc 8px": _own("mc", bound_px=BOUND_PX),
    "mc-exact": _own("mc-exact"),
    "mc-exact 8px": _own("mc-exact", bound_px=BOUND_PX),
    "ransac-2p 100": _own("ransac-2p", iterations=100),
    "ransac-2p 1k": _own("ransac-2p", iterations=1000),
    "ransac-2p 10k": _own("ransac-2p", iterations=10_000),
    "ransac-svd 100": _own("ransac-svd", iterations=100),
    "ransac-mlpnp 100": _own("ransac-mlpnp", iterations=100),
}
"""Every method by its name on the page. EPro-PnP is its solver alone: the weights that its network learns are not
public for these matches, so all weights are equal."""

CAMERAS: Mapping[str, str] = {
    "MEI": "mei_outliers_80",
    "Kannala-Brandt": "fisheye_outliers_80",
    "equirectangular": "panorama_outliers_80",
}
"""The camera models of Sec. IV-B, and the bundled scene that each is taken from. The paper simulates the first."""
NORMAL = "MEI, normal draws"
"""The first camera, with coordinates drawn from a standard normal distribution, as Sec. VI-A says too."""
SCENES: Mapping[str, str] = CAMERAS | {NORMAL: "mei_normal_draws"}


@dataclass(frozen=True)
class Experiment:
    """A sweep for each of some cameras."""

    key: str
    """Name of the experiment, used in file names."""
    place: str
    """Its place in the paper."""
    over: str
    """The property that is varied, a key of ``AXES``."""
    values: tuple[float, ...]
    """Values of the property, ascending."""
    correspondences: int
    """Number of correspondences, N; not used if that is the varied property."""
    methods: tuple[str, ...]
    """Keys of ``METHODS``."""
    runs: int
    """Number of problems per point."""
    quick_values: tuple[float, ...]
    """The values that the quick form keeps."""
    quick_runs: int
    """Number of problems per point in the quick form."""
    variation: Variation
    """Other settings of the simulation."""
    cameras: tuple[str, ...] = tuple(CAMERAS)
    """Keys of ``SCENES``."""
    quick_leaves_out: tuple[str, ...] = ()
    """Methods that are too slow for the quick form."""

    def plan(self, camera: str, quick: bool = False) -> SweepPlan:
        """The sweep through a camera, a key of ``SCENES``. Raises ``InputError`` if it is impossible."""
        variation = self.variation
        if self.over != "correspondences":
            variation = replace(variation, correspondences=self.correspondences)
        return planned(
            scene_path(Path(SCENES[camera])),
            self.over,
            self.quick_values if quick else self.values,
            [METHODS[name] for name in self.taking_part(quick)],
            self.quick_runs if quick else self.runs,
            variation,
        )

    def taking_part(self, quick: bool = False) -> tuple[str, ...]:
        """The methods, keys of ``METHODS``."""
        return tuple(name for name in self.methods if not (quick and name in self.quick_leaves_out))


def _steps(first: float, last: float, step: float) -> tuple[float, ...]:
    return tuple(round(first + k * step, 10) for k in range(round((last - first) / step) + 1))


_SLOW = ("SVD10k", "ML10k", "ML10k cov", "R+EPnP", "R+EPro", "R+oDLT")
_CASE = ("MC", "2P1k", "2P10k", "SVD10k", "ML10k", "R+EPro", "R+EPnP", "R+oDLT", "mc", "mc-exact")

CASES: Mapping[str, tuple[int, int]] = {"case1": (13, 52), "case2": (9, 42), "case3": (28, 130)}
"""Table VI: right matches and all matches of its three experiments."""


_CASE_OWN = ("mc 8px", "mc-exact 8px", "ransac-2p 1k")
OWN = "-own"
"""Ending of the key of an experiment that repeats another one with this project's own forms of the methods."""
WIDE_VIEW = "-wide"
"""Ending of the key of an experiment that repeats another one with the baselines as their authors would run them."""
_CASE_WIDE = (*(f"{name}, 10k" for name in WIDE_SOLVERS), "ML10k cov", "P3P10k", "2P10k")


def _case(key: str, right: int, count: int, methods: tuple[str, ...] = _CASE) -> Experiment:
    return Experiment(
        key=key,
        place={_CASE: "Table VI", _CASE_OWN: "Table VI, own forms"}.get(methods, "Table VI, wide views"),
        over="correspondences",
        values=(float(count),),
        correspondences=count,
        methods=methods,
        runs=100,
        quick_values=(float(count),),
        quick_runs=5,
        cameras=("Kannala-Brandt",),
        variation=Variation(outlier_rate=(count - right) / count, noise_px=3.0),
        quick_leaves_out=_SLOW,
    )


PHASE_METHODS = ("ransac-2p 1k", "mc", "mc-exact")
"""Methods of the experiments on which method to choose, from the fastest to the most robust."""
PHASE_COUNTS = (20, 50, 100, 200, 500, 1000)
PHASE_GRAVITY_DEG: Mapping[float, tuple[int, ...]] = {0.0: PHASE_COUNTS, 1.0: PHASE_COUNTS[:4]}
"""Standard deviations of the known roll and pitch, degrees, and the numbers of matches that are run with each."""


def phase_key(count: int, gravity_deg: float) -> str:
    """Key of the experiment with ``count`` matches and the standard deviation ``gravity_deg`` of roll and pitch."""
    return f"phase-{count}-{gravity_deg:g}deg"


def _phase(count: int, gravity_deg: float) -> Experiment:
    return Experiment(
        key=phase_key(count, gravity_deg),
        place="VI-C.3, when to choose which",
        over="outlier_rate",
        values=(0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.925, 0.95, 0.97, 0.98, 0.99),
        correspondences=count,
        methods=PHASE_METHODS,
        runs=30,
        quick_values=(0.8, 0.95),
        quick_runs=2,
        variation=Variation(noise_px=1.0, gravity_error_deg=gravity_deg),
        cameras=("MEI",),
    )


_FIG6 = Experiment(
    key="fig6",
    place="Fig. 6",
    over="outlier_rate",
    values=_steps(0.0, 0.9, 0.1),
    correspondences=100,
    methods=(
        *("MC", "MC 3px", "2P100", "2P1k", "SVD100", "ML100", "ML1k"),
        *("mc", "mc-exact", "ransac-2p 100", "ransac-2p 1k"),
    ),
    runs=100,
    quick_values=(0.3, 0.5, 0.8, 0.9),
    quick_runs=8,
    variation=Variation(noise_px=1.0),
)
_FIG7 = replace(
    _FIG6,
    key="fig7",
    place="Fig. 7",
    values=_steps(0.9, 0.95, 0.01),
    correspondences=200,
    methods=(
        *("MC", "MC 3px", "2P1k", "2P10k", "SVD10k", "ML10k"),
        *("mc", "mc-exact", "ransac-2p 1k", "ransac-2p 10k"),
    ),
    quick_values=(0.9, 0.95),
    quick_leaves_out=_SLOW,
)


def _beside(
    figure: Experiment,
    key: str,
    words: str,
    methods: tuple[str, ...],
    quick_values: tuple[float, ...] = (0.9, 0.95),
    quick_runs: int = 5,
    camera: str = "MEI",
) -> Experiment:
    """The sweep of a figure with other methods or another camera."""
    return replace(
        figure,
        key=key,
        place=f"{figure.place}, {words}",
        methods=methods,
        quick_values=quick_values,
        quick_runs=quick_runs,
        quick_leaves_out=(),
        cameras=(camera,),
    )


_NORMAL_6 = ("MC", "MC 3px", "2P100", "2P1k", "mc", "mc-exact")
_NORMAL_7 = ("MC", "MC 3px", "2P1k", "2P10k", "mc", "mc-exact")
_WIDE_6 = (*(f"{name}, 1k" for name in WIDE_SOLVERS), "ML1k cov", "P3P1k", "2P1k")

EXPERIMENTS: Sequence[Experiment] = (
    Experiment(
        key="fig5",
        place="Fig. 5",
        over="noise_px",
        values=_steps(0, 10, 1),
        correspondences=100,
        methods=(
            *("MC", "MC 3px", "2P100", "SVD100", "ML100"),
            *("mc 8px", "mc-exact 8px", "ransac-2p 100", "ransac-svd 100", "ransac-mlpnp 100"),
        ),
        runs=100,
        quick_values=(0.0, 1.0, 4.0),
        quick_runs=5,
        variation=Variation(outlier_rate=0.0),
    ),
    _FIG6,
    _FIG7,
    _beside(_FIG6, "fig6-normal", "with normal draws", _NORMAL_6, (0.5, 0.9), camera=NORMAL),
    _beside(_FIG7, "fig7-normal", "with normal draws", _NORMAL_7, camera=NORMAL),
    _beside(_FIG6, "p3p-fig6", "beside P3P", ("P3P100", "P3P1k"), (0.5, 0.8)),
    _beside(_FIG7, "p3p-fig7", "beside P3P", ("P3P1k", "P3P10k")),
    *(_case(key, right, count) for key, (right, count) in CASES.items()),
    *(_case(key + OWN, right, count, _CASE_OWN) for key, (right, count) in CASES.items()),
    *(_case(key + WIDE_VIEW, right, count, _CASE_WIDE) for key, (right, count) in CASES.items()),
    _beside(_FIG6, "wide-fig6", "baselines with wide views", _WIDE_6, (0.5,), 3),
    _beside(_FIG6, "alike", "under equal terms", tuple(f"{name}, alike" for name in ALIKE), (0.5,), 3),
    *(_phase(count, gravity) for gravity, counts in PHASE_GRAVITY_DEG.items() for count in counts),
)
"""All experiments in the order in which they are run: those that the page needs most come first."""
