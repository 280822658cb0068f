"""Estimator core for visual localization with fisheye and 360-degree cameras."""

import importlib
from importlib.metadata import version
from typing import Any

__version__ = version("spherloc")

EXPORTS = {
    "localize": "localization",
    "localize_bearings": "localization",
    "Localization": "localization",
    "estimate_absolute_pose": "localization",
    "gravity_from_image": "localization",
    "estimate": "estimators",
    "options_type": "estimators",
    "diagnose": "diagnosis",
    "evaluate": "metrics",
    "load_scene": "datasets",
    "bundled_scenes": "datasets",
    "load_camera": "cameras.calibration",
    "DoubleSphere": "cameras.double_sphere",
    "Equirectangular": "cameras.equirectangular",
    "Eucm": "cameras.eucm",
    "Fisheye624": "cameras.fisheye624",
    "KannalaBrandt": "cameras.kannala_brandt",
    "Mei": "cameras.mei",
    "Ocam": "cameras.ocam",
    "RadialPoly": "cameras.radial_poly",
    "Problem": "problem",
    "Trace": "trace",
    "CalibrationError": "errors",
    "InputError": "errors",
    "ProblemError": "errors",
    "RecordingError": "errors",
    "SpherlocError": "errors",
}
"""Public names of the package and their modules, which are imported at the first use, since the solvers take a second.
``__init__.pyi`` lists them for type checkers."""


def __getattr__(name: str) -> Any:
    if name not in EXPORTS:
        raise AttributeError(f"module 'spherloc' has no attribute {name!r}")
    found = getattr(importlib.import_module(f"spherloc.{EXPORTS[name]}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *EXPORTS})
