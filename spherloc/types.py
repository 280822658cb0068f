"""Types of arrays that many modules use."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]
"""Indices of matches, and counts."""
IndexArray = NDArray[np.int32]
"""Indices of correspondences, pairs and nodes, as the kernels hold them."""
ByteArray = NDArray[np.uint8]
"""Images and colours."""
