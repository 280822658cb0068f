"""Walls between a viewer and what is to be seen: a grid of the cells that hold some of a mesh's surface."""

from functools import lru_cache
from io import BytesIO

import numpy as np
from numpy.typing import NDArray

from spherloc.types import FloatArray

CELLS = 160
"""Number of cells of the grid along the mesh's longest side."""
SAMPLES = 400_000
"""Number of points on the surface by which cells are marked."""
STEPS = 64
"""Number of samples along each line of sight."""
NEAR_SHARE, FAR = 0.08, 0.97
"""Part of each line of sight that is tested, as shares from the viewer: the mesh may touch what is to be seen."""
MAX_BYTES = 60 << 20
"""Largest mesh that is read; with a larger one, views are chosen without it."""


class Walls:
    """Cells of a grid, in the aligned map frame, that hold some of a mesh's surface."""

    def __init__(self, glb: bytes, aligned_from_map: FloatArray) -> None:
        """``glb`` is a binary glTF in the map frame, ``aligned_from_map`` (3, 3) a rotation."""
        self._turn = aligned_from_map
        self._low, self._cell_m, self._filled = _grid(glb)

    def blocked(self, position: FloatArray, targets: FloatArray) -> float:
        """Share of the targets (K, 3) that cannot be seen from a position (3,)."""
        along = np.linspace(NEAR_SHARE, FAR, STEPS)[:, None, None]
        places = (position + along * (targets - position)) @ self._turn  # back into the map frame
        cells = np.floor((places - self._low) / self._cell_m).astype(np.int64)
        within = np.all((cells >= 0) & (cells < self._filled.shape), axis=-1)
        x, y, z = np.moveaxis(np.where(within[..., None], cells, 0), -1, 0)
        return float(np.mean(np.any(within & self._filled[x, y, z], axis=0)))


@lru_cache(maxsize=2)
def _grid(glb: bytes) -> tuple[FloatArray, float, NDArray[np.bool_]]:
    """Lower corner (3,) and side of the cells, and which of them hold some of the surface."""
    import trimesh  # takes a second

    mesh = trimesh.load_mesh(BytesIO(glb), file_type="glb")
    low, high = np.asarray(mesh.bounds, dtype=np.float64)
    cell_m = float(np.max(high - low)) / CELLS
    filled = np.zeros(np.floor((high - low) / cell_m).astype(np.int64) + 1, np.bool_)
    places = np.asarray(trimesh.sample.sample_surface(mesh, SAMPLES, seed=0)[0])
    x, y, z = np.floor((places - low) / cell_m).astype(np.int64).T
    filled[x, y, z] = True
    return low, cell_m, filled
