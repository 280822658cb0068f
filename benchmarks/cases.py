"""The rows of the table: which problems, which methods, how many of each."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from benchmarks.machine import ROOT
from benchmarks.methods import baseline_names
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.datasets import load_scene
from spherloc.datasets.synthetic import SyntheticScene
from spherloc.metrics import SUCCESS_DEG, SUCCESS_M
from spherloc.problem import Problem

PEERS = (
    "PoseLib rig",
    "PoseLib fisheye",
    "PoseLib up2p",
    "pycolmap rig",
    "pycolmap panorama",
    "OpenCV USAC",
    "SupeRANSAC",
)
PLAIN = "ransac-2p"
ADAPTIVE = "ransac-2p to 99.9 %"

RATES = (0.0, 0.2, 0.4, 0.6, 0.8, 0.9, 0.95)
"""Of the pictures of success and time."""
SIZES = (50, 100, 200, 500, 1000, 2000, 5000)
"""Of the picture of growth, at 90 % outliers."""

FRONT_CAMERA = KannalaBrandt(
    width=850, height=850, fx=375.0, fy=375.0, cx=425.0, cy=425.0, distortion=(0.0, 0.0, 0.0, 0.0)
)
"""An equidistant lens of 184 degrees from corner to corner: peers that see only the front half lose hardly a point.
The other simulated camera sees 37 % of its points behind the image plane."""

PEER_BUDGET_S = 20.0
OUR_BUDGET_S = 150.0


GOALS = {
    **{(f"n100-{rate}", "mc-exact"): "100 % in 3 ms" for rate in (0, 20, 40, 60, 80, 90)},
    ("n200-95", "mc-exact"): "99.5 % in 8 ms",
    ("n200-97", "mc-exact"): "95 % in 8 ms",
    ("n1000-99", "mc-exact"): "99 % in 150 ms",
    ("n5000-90", "mc-exact"): "100 % in 5 s",
    ("gravity", "mc-exact"): "99 %",
    **{(f"aria-{image}", "mc-exact"): "100 % in 0.5 s" for image in ("rgb", "slam-left", "slam-right")},
    ("n100-90", PLAIN): "2 ms",
    ("n200-90", ADAPTIVE): "100 % in 2 ms",
    ("n1000-90", ADAPTIVE): "100 % in 5 ms",
    ("n5000-90", ADAPTIVE): "100 % in 20 ms",
}
"""What we want of a row, by case and method."""


@dataclass(frozen=True, eq=False)
class Case:
    """One row: problems by seed, and how many of them each method gets."""

    name: str
    """For ``--case``."""
    title: str
    """For people."""
    problem: Callable[[int], Problem]
    """The problem of a seed."""
    counts: dict[str, int]
    """Problems a method."""
    success_deg: float = SUCCESS_DEG
    """Largest rotation error of a success."""
    success_m: float = SUCCESS_M
    """Largest error of the camera's position of a success."""
    facts: dict[str, float] = field(default_factory=dict)
    """N and outlier rate, for the pictures."""


def _counts(exact: int, **more: int) -> dict[str, int]:
    """Peers and our RANSACs take 100 problems; ``mc``, slower and measured elsewhere too, 30."""
    return {"mc-exact": exact, ADAPTIVE: 100, **dict.fromkeys(PEERS, 100), "mc": 30, **more}


def simulated(size: int, rate: float, **changes: Any) -> Callable[[int], Problem]:
    """The paper's simulation (Sec. VI-A): visible points of KITTI-360's fisheye, 1 px noise; with ``changes``."""
    scene = load_scene(ROOT / "scenes" / "mei_outliers_80.toml")
    assert isinstance(scene, SyntheticScene)
    return replace(scene, correspondences=size, outlier_rate=rate, noise_px=1.0, **changes).problem


def _outliers(size: int, rate: float, counts: dict[str, int]) -> Case:
    name = f"n{size}-{round(100 * rate)}"
    facts = {"correspondences": size, "outlier_rate": rate}
    return Case(name, f"N={size}, {100 * rate:.0f} % outliers", simulated(size, rate), counts, facts=facts)


def simulated_cases() -> list[Case]:
    """Everything on the paper's simulation."""
    cases = []
    for rate in RATES:
        more = {PLAIN: 100, "mc": 100, **dict.fromkeys(baseline_names(), 30)}
        cases.append(_outliers(100, rate, _counts(1000 if rate == 0.9 else 200, **more)))
    for size in (size for size in SIZES if size != 100):
        cases.append(_outliers(size, 0.9, _counts(100, **({"mc": 0} if size > 2000 else {}))))
    cases += [_outliers(200, rate, _counts(1000)) for rate in (0.95, 0.97)]
    cases.append(_outliers(1000, 0.99, _counts(200)))
    gravity = simulated(200, 0.9, gravity_error_deg=0.5)
    cases.append(Case("gravity", "N=200, 90 % outliers, gravity off by 0.5 deg (1 sigma)", gravity, _counts(1000)))
    for size, rate in ((100, 0.9), (200, 0.95)):
        title = f"N={size}, {100 * rate:.0f} % outliers, all in front of the camera"
        problem = simulated(size, rate, camera=FRONT_CAMERA)
        cases.append(Case(f"front-n{size}-{round(100 * rate)}", title, problem, _counts(200)))
    return cases


ARIA = {"rgb": (0.3, 0.02), "slam_left": (0.3, 0.02), "slam_right": (1.0, 0.03)}
"""Real images, and the errors (degrees, metres) up to which their pose counts as right."""


ARIA_GEN2 = (1.0, 0.1)
"""The same of the queries of Aria Gen 2, in a folder beside the others."""


def aria_cases(folder: Path) -> list[Case]:
    """The real problems; a seed changes only the random draws of the methods. Empty if they are not there."""
    cases = []
    for image, (degrees, metres) in ARIA.items():
        path = folder / f"{image}.toml"
        if not path.is_file():
            continue
        scene = load_scene(path)
        counts = {"mc-exact": 100, ADAPTIVE: 100, **dict.fromkeys(PEERS, 100), "mc": 3}
        title = f"real image {image}, {len(scene.problem())} matches"
        cases.append(Case(f"aria-{image.replace('_', '-')}", title, scene.problem, counts, degrees, metres))
    scenes = [load_scene(path) for path in sorted((folder.parent / "aria_gen2").glob("*.toml"))]
    if scenes:
        title = f"{len(scenes)} real queries of Aria Gen 2, gravity known to 3 degrees"
        methods = ("mc-exact", ADAPTIVE, "auto", "mc", PLAIN, *PEERS)
        counts = dict.fromkeys(methods, 5 * len(scenes)) | {"mc": len(scenes)}
        cases.append(
            Case("aria-gen2", title, lambda seed: scenes[seed % len(scenes)].problem(seed), counts, *ARIA_GEN2)
        )
    return cases
