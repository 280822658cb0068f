"""COLMAP's options for cameras that are calibrated."""

from typing import Any

ANY_DISTORTION = 1e9
"""COLMAP triangulates nothing in images of a camera with a distortion above 1, since it takes that for a calibration
that went wrong; the lens of real glasses has one of -1.7."""


def pipeline_options(pycolmap: Any) -> Any:
    """``IncrementalPipelineOptions`` that give the same map every time, which takes one thread, that keep points seen
    by two images, and that take any distortion for right and leave cameras as they are."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = 1, 0
    options.max_extra_param = ANY_DISTORTION
    options.ba_refine_focal_length = options.ba_refine_extra_params = options.extract_colors = False
    options.triangulation.ignore_two_view_tracks = False
    return options
