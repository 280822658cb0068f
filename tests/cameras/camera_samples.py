"""Cameras that the camera tests share: real calibrations, inline or from the data folder beside the project."""

import tomllib
from pathlib import Path

import numpy as np
import yaml

from spherloc.cameras.base import Camera
from spherloc.cameras.double_sphere import DoubleSphere
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.eucm import Eucm
from spherloc.cameras.fisheye624 import Fisheye624
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.cameras.mei import Mei
from spherloc.cameras.ocam import Ocam
from spherloc.cameras.radial_poly import RadialPoly
from tests.needs import DATA, real_data

KITTI360_IMAGE_02 = Mei(
    width=1400,
    height=1400,
    fx=1336.3220825849971,
    fy=1335.7883350012958,
    cx=716.94323510126321 + 0.5,
    cy=705.76498308221585 + 0.5,
    xi=2.2134047507854890,
    distortion=(1.6798235660113681e-02, 1.6548773243373522, 4.2223943394772046e-04, 4.2462134260997584e-04),
)

# A 220-degree lens whose image circle (radius 1.92 * 300 px) fits into the image.
BEYOND_180 = KannalaBrandt(1200, 1200, 300.0, 301.0, 600.5, 598.0, (-0.02, 0.003, -0.0008, 0.00001))

INLINE: dict[str, Camera] = {
    "kitti360-image_02": KITTI360_IMAGE_02,
    "mei-pinhole": Mei(640, 480, 320.0, 322.0, 318.0, 243.0, 0.0, (0.0, 0.0, 0.0, 0.0)),
    "mei-xi-below-1": Mei(752, 480, 520.0, 518.0, 370.0, 245.0, 0.9, (-0.05, 0.02, 1e-3, -2e-3)),
    "mei-stereographic": Mei(1000, 1000, 260.0, 260.0, 500.0, 500.0, 1.0, (0.01, 0.0, 0.0, 1e-4)),
    "mei-negative-distortion": Mei(1000, 900, 800.0, 805.0, 510.0, 440.0, 1.4, (-0.35, -0.2, -2e-3, 1e-3)),
    "mei-negative-xi": Mei(640, 480, 300.0, 300.0, 320.0, 240.0, -0.2, (-0.05, 0.01, 1e-3, 1e-3)),
    "kb-beyond-180": BEYOND_180,
    "kb-equidistant": KannalaBrandt(900, 900, 120.0, 120.0, 450.0, 450.0, (0.0, 0.0, 0.0, 0.0)),
    "kb-aria-rgb": KannalaBrandt(
        1408,
        1408,
        611.8529287,
        611.8500556,
        715.7118008,
        716.4760432,
        (0.394091358527, -0.548741152556, 0.778500221599, -0.4553790203),
    ),
    "ds-tum-vi": DoubleSphere(
        512, 512, 158.28600034966977, 158.2743455478755, 255.46116578191653, 257.3894394501779, -0.17213086, 0.5931177
    ),
    "ds-euroc": DoubleSphere(752, 480, 348.11275, 347.11099, 366.312, 249.8556, -0.24425190195, 0.56574136736),
    "ds-infinite-image": DoubleSphere(800, 700, 260.0, 262.0, 410.0, 345.0, 0.35, 0.4),
    "ds-beyond-180": DoubleSphere(1000, 1000, 290.0, 290.0, 500.0, 500.0, 0.2, 0.7),
    "ds-far-centre": DoubleSphere(640, 480, 700.0, 705.0, 320.0, 240.0, 1.6, 0.55),
    "eucm-tum-vi": Eucm(
        512, 512, 191.14799836282189, 191.13150963902818, 255.4585771534443, 257.38154645599448, 0.62910608, 1.04180673
    ),
    "eucm-infinite-image": Eucm(640, 480, 300.0, 301.0, 318.0, 243.0, 0.3, 0.7),
    "eucm-beyond-180": Eucm(1000, 1000, 350.0, 350.0, 500.0, 500.0, 0.75, 1.2),
    "eucm-pinhole": Eucm(640, 480, 320.0, 322.0, 318.0, 243.0, 0.0, 1.0),
    "ocam-beyond-180": Ocam(
        848,
        800,
        424.214757,
        391.449324,
        (1.0, -0.000071, -0.000325, 0.999134),
        (289.5569, 0.0, -1.538894e-3, 3.140320e-6, -7.206996e-9),
    ),
    "radial-poly-woodscape": RadialPoly(
        *(1280, 966, 339.749, 339.749, 643.942, 479.907),
        (-31.988 / 339.749, 48.275 / 339.749, -7.201 / 339.749),
    ),
    "radial-poly-with-an-end": RadialPoly(1280, 966, 281.85, 280.0, 640.0, 483.0, (0.033, -0.0198, -0.0051)),
    "624-aria-rgb": Fisheye624(
        1408,
        1408,
        610.9410078676575,
        610.9410078676575,
        715.6148341104505,
        717.2147122529825,
        (
            *(0.4060356696288849, -0.489948419647729, 0.1745652818132035),
            *(1.132983686620576, -1.701635218233742, 0.6511555293441647),
            *(0.0006211469747214578, 1.932200015697112e-05),
            *(-1.485525650871087e-05, 0.0002601225712292815, -0.0006582109778598294, 3.761395141407565e-05),
        ),
    ),
    "624-strong-prism": Fisheye624(
        800, 600, 300.0, 305.0, 410.0, 295.0, (-0.02, 0.003, 0, 0, 0, 0, 0.01, -0.008, 0.02, -0.003, -0.015, 0.004)
    ),
    "panorama-2048x1024": Equirectangular(2048, 1024),
    "panorama-odd-size": Equirectangular(1919, 961),
}


def _load(name: str) -> Camera:
    """A Kannala-Brandt calibration of the data folder, read without the project's own loader."""
    path = DATA / name
    if path.suffix == ".toml":
        table = tomllib.loads(path.read_text())["camera"]
        return KannalaBrandt(**{key: value for key, value in table.items() if key != "model"})
    text = path.read_text().removeprefix("%YAML:1.0")
    document = yaml.safe_load(text)
    if "image" in document:
        table, (width, height) = document["parameter"], document["image"].values()
    else:
        table = document["Camera"]
        width, height = table["cols"], table["rows"]
    lens = tuple(table[key] for key in ("k1", "k2", "k3", "k4"))
    return KannalaBrandt(width, height, table["fx"], table["fy"], table["cx"] + 0.5, table["cy"] + 0.5, lens)


SHARED = (
    "aria_adt_fisheye/rgb.toml",
    "aria_adt_fisheye/slam_left.toml",
    "aria_adt_fisheye/slam_right.toml",
    "formats_real/adapter_euroc_KB.yml",
    "formats_real/stella_fisheye.yaml",
    "formats_real/stella_tum_vi_mono.yaml",
)

EVERY = (*INLINE, *SHARED)


def sample(name: str) -> Camera:
    """The camera ``name`` of ``EVERY``; skips the test where the data are absent."""
    if name in INLINE:
        return INLINE[name]
    require_shared(name)
    return _load(name)


def require_shared(name: str) -> Path:
    """The path of a file of the data folder; skips the test where the data are absent."""
    folder, file = name.split("/", 1)
    return real_data(folder) / file


def pixel_grid(camera: Camera, step: float = 3.0) -> np.ndarray:
    """Pixels (N, 2) all over the image, its borders and its corners included."""
    u = np.append(np.arange(0.0, camera.width, step), camera.width)
    v = np.append(np.arange(0.0, camera.height, step), camera.height)
    return np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)


def random_directions(seed: int, count: int) -> np.ndarray:
    """Points (N, 3) in all directions, 0.1 to 100 m away."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True) * 10.0 ** rng.uniform(-1, 2, size=(count, 1))


def angle_rad(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angle between rows of (N, 3), exact for small angles."""
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1))


def check_invertible(camera: Camera, seed: int, more: np.ndarray | None = None, bound_px: float = 1e-6) -> None:
    """Pixels in and around an image of 800 x 700, and directions, are found again exactly where the camera says that
    they are seen, and the image is nowhere mirrored, as it would be beyond a fold. All of ``more`` (N, 3) are seen."""
    pixels = np.random.default_rng(seed).uniform([-200, -200], [1000, 900], size=(300, 2))
    bearings, seen = camera.unproject(pixels)
    again, valid = camera.project(bearings)
    np.testing.assert_array_equal(valid, seen)
    assert np.abs(again - pixels)[seen].max(initial=0.0) < bound_px
    np.testing.assert_allclose(np.linalg.norm(bearings[seen], axis=1), 1.0, atol=1e-12)
    points = np.vstack([random_directions(seed, 300), np.empty((0, 3)) if more is None else more])
    pixels, valid = camera.project(points)
    assert valid[300:].all()
    bearings, seen = camera.unproject(pixels)
    np.testing.assert_array_equal(seen, valid)
    assert angle_rad(bearings[seen], points[seen]).max(initial=0.0) < 1e-5
    jacobian = camera.unprojection_jacobian(pixels)
    np.testing.assert_array_equal(np.isfinite(jacobian).all(axis=(1, 2)), seen)
    orientation = np.sum(np.cross(jacobian[:, :, 0], jacobian[:, :, 1]) * bearings, axis=1)
    assert (orientation[seen] > 0).all()
