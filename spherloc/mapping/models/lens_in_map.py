"""Asks a map about the lens that its photographs told: whether its points and poses fit another lens better.

The lens was fitted to pairs of images. A map says more: many images see a point, and one motion moves them all. So the
lens is freed in a last bundle adjustment. Matches that do not fit a wrong lens are not in its map, though they would
show that it is wrong: so the points are triangulated anew with the lens that was found, and all is adjusted again,
until the lens stays as it is.
"""

import copy
from dataclasses import dataclass
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.errors import CalibrationError
from spherloc.mapping.images.lens_fit import RadialLens
from spherloc.mapping.models.colmap_options import pipeline_options
from spherloc.mapping.models.model import Reconstruction, registered
from spherloc.mapping.parallel import Tell
from spherloc.registry import require
from spherloc.types import FloatArray

ROUNDS = 8
"""Largest number of times that all is adjusted."""
STILL_RAD = float(np.radians(0.03))
"""A lens stays as it is if no direction changes by more."""
MIN_IMAGES = 8
"""Smaller maps are not asked."""
LOSS_PX = 1.0
"""Bound of the robust loss."""
MAX_STEPS = 100
"""Largest number of steps of an adjustment."""
QUANTILES = (0.1, 0.3, 0.5, 0.7, 0.9)
"""Radii at which two lenses are compared, as quantiles of those of the points' pixels."""
BOUND_SD = 5.0
"""Directions are within so many standard deviations: pixels of a point are off together, also with the true lens."""
STAGE = "adjustments of the lens to the map"
"""What progress is called."""
_STEPS = np.array([1e-2, 1e-2, 1e-2, 1e-5, 1e-5])
"""Differences of the parameters of a lens by which their covariance becomes that of directions."""


@dataclass(frozen=True)
class LensInMap:
    """The lens that a map fits best, and how well the map fixes it."""

    camera: KannalaBrandt
    moved_rad: float
    """Largest angle by which it gives a pixel another direction than the map's lens, within the field of the points."""
    sd_rad: float
    """Largest standard deviation of such a direction by the noise of the points' pixels."""

    @property
    def bound_rad(self) -> float:
        """How far such a direction may be off."""
        return BOUND_SD * self.sd_rad


def lens_in_map(made: Reconstruction, tell: Tell) -> LensInMap | None:
    """The lens of two radial terms that a map of one camera fits best; the map itself stays as it is.

    None if the map is small or of several cameras, if its camera is no such lens, or if no lens can be told.
    """
    pycolmap = require("pycolmap", "colmap", "making a map")
    numbers = {image.camera_id for image in registered(made.model)}
    if len(made.poses) < MIN_IMAGES or len(numbers) != 1:
        return None
    (number,) = numbers
    model = copy.deepcopy(made.model)
    values = np.array(model.camera(number).params)
    if model.camera(number).model.name != "OPENCV_FISHEYE" or values[0] != values[1] or values[6:].any():
        return None
    first = now = RadialLens(*(float(value) for value in values[[0, 2, 3, 4, 5]]))
    radii = np.quantile(_radii(model, first), QUANTILES)
    for done in range(1, ROUNDS + 1):
        before = now
        now, covariance = _adjusted(pycolmap, model, number, before)
        tell(STAGE, done, ROUNDS)
        if not np.abs(now.angles(radii) - before.angles(radii)).max() > STILL_RAD:
            break
        model = _triangulated(pycolmap, model, number, now, str(made.database))
    tell(STAGE, ROUNDS, ROUNDS)
    camera = model.camera(number)
    try:
        k = now.k1, now.k2, 0.0, 0.0
        found = KannalaBrandt(camera.width, camera.height, now.f, now.f, now.cx, now.cy, k)
    except CalibrationError:
        return None
    if covariance is None:
        return None
    slopes = _slopes(now, radii)
    sd_rad = np.sqrt(np.einsum("ni,ij,nj->n", slopes, covariance, slopes))
    moved = np.abs(now.angles(radii) - first.angles(radii))
    return LensInMap(found, float(moved.max()), float(sd_rad.max()))


def _radii(model: Any, lens: RadialLens) -> FloatArray:
    """Distances (N,) of the pixels of points from the principal point."""
    seen = [point.xy for image in registered(model) for point in image.points2D if point.has_point3D()]
    return np.linalg.norm(np.array(seen).reshape(-1, 2) - (lens.cx, lens.cy), axis=1)


def _adjusted(pycolmap: Any, model: Any, number: int, lens: RadialLens) -> tuple[RadialLens, FloatArray | None]:
    """The lens after poses, points and it were adjusted in the model, and the covariance (5, 5) of its parameters in
    their order there; None if nothing fixes them."""
    camera = model.camera(number)
    camera.model = pycolmap.CameraModelId.RADIAL_FISHEYE
    camera.params = [lens.f, lens.cx, lens.cy, lens.k1, lens.k2]
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = True
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.loss_function_scale = LOSS_PX
    options.ceres.solver_options.num_threads = 1  # with more threads every run gives another lens
    options.ceres.solver_options.max_num_iterations = MAX_STEPS
    options.ceres.solver_options.function_tolerance = 1e-6
    config = pycolmap.BundleAdjustmentConfig()
    for image in model.reg_image_ids():
        config.add_image(image)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    adjuster.solve()
    asked = pycolmap.BACovarianceOptions()
    asked.params = pycolmap.BACovarianceOptionsParams.ALL
    found = pycolmap.estimate_ba_covariance(asked, model, adjuster)
    covariance = None if found is None else found.get_other_params_cov(camera.params)
    return RadialLens(*(float(value) for value in camera.params)), covariance


def _triangulated(pycolmap: Any, model: Any, number: int, lens: RadialLens, database: str) -> Any:
    """The model with its points triangulated anew."""
    camera = model.camera(number)
    camera.model = pycolmap.CameraModelId.OPENCV_FISHEYE  # as the database has it
    camera.params = [lens.f, lens.f, lens.cx, lens.cy, lens.k1, lens.k2, 0.0, 0.0]
    options = pipeline_options(pycolmap)
    with TemporaryDirectory() as folder:  # COLMAP writes nothing there, but asks for it
        return pycolmap.triangulate_points(model, database, folder, folder, True, options, False)


def _slopes(lens: RadialLens, radii: FloatArray) -> FloatArray:
    """(N, 5) how the angles to the optical axis of such radii change with f, cx, cy, k1 and k2."""
    values = np.array([lens.f, lens.cx, lens.cy, lens.k1, lens.k2])
    steps = np.diag(_STEPS)
    return np.column_stack(
        [(RadialLens(*(values + step)).angles(radii) - lens.angles(radii)) / step.sum() for step in steps]
    )
