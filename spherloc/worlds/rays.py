"""What rays hit, by Embree."""

from dataclasses import dataclass

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from spherloc.types import FloatArray
from spherloc.worlds.mesh import TexturedMesh


@dataclass(frozen=True, eq=False)
class Hits:
    """Of N rays."""

    face: NDArray[np.int32]
    """(N,) the first face that is hit, -1 for none."""
    weights: NDArray[np.float32]
    """(N, 3) barycentric coordinates of the place in it."""
    range_m: FloatArray
    """(N,) its distance, inf for none."""


class RayScene:
    """A mesh that rays are cast into."""

    def __init__(self, mesh: TexturedMesh) -> None:
        self.mesh = mesh
        self.normals = mesh.normals()
        self.texels_per_metre = mesh.texels_per_metre()
        # Embree reckons in single precision: vertices near the origin keep it exact to some micrometres.
        self.centre = mesh.vertices.mean(axis=0)
        self._scene = EmbreeScene(robust=True)
        self._triangles = TriangleMesh(
            self._scene, (mesh.vertices - self.centre).astype(np.float32), np.ascontiguousarray(mesh.faces, np.int32)
        )

    def cast(self, origins: FloatArray, directions: FloatArray) -> Hits:
        """First hits of rays from ``origins`` (N, 3) or (3,) along unit ``directions`` (N, 3).

        Embree says which face is hit, and the distance to that face's plane is reckoned anew in double precision.
        """
        found = self._run(origins, directions, output=True)
        face = found["primID"].astype(np.int32)
        hit = np.flatnonzero(face >= 0)
        normal = self.normals[face[hit]]
        corner = self.mesh.vertices[self.mesh.faces[face[hit], 0]]
        origin = np.broadcast_to(origins, directions.shape)[hit]
        along = np.einsum("ij,ij->i", normal, directions[hit])
        steep = np.abs(along) > 1e-6
        exact = np.einsum("ij,ij->i", normal, corner - origin) / np.where(steep, along, 1.0)
        rough = found["tfar"][hit].astype(np.float64)
        range_m = np.full(len(face), np.inf)
        # On a plane seen edge-on the quotient says nothing, and Embree's own distance is better.
        range_m[hit] = np.where(steep & (np.abs(exact - rough) < 1e-3 * (1 + rough)), exact, rough)
        u, v = found["u"], found["v"]
        return Hits(face, np.column_stack([1 - u - v, u, v]), range_m)

    def blocked(self, origins: FloatArray, directions: FloatArray, reach_m: FloatArray | float) -> NDArray[np.bool_]:
        """Which rays (N,) hit anything closer than ``reach_m`` ((N,) or a number)."""
        reach = np.full(len(directions), reach_m, np.float32)
        return self._run(origins, directions, dists=reach, query="OCCLUDED") >= 0

    def _run(self, origins: FloatArray, directions: FloatArray, **options: object):
        start = np.broadcast_to(origins - self.centre, directions.shape)
        # Embree's binding refuses read-only arrays, which broadcast ones are.
        return self._scene.run(start.astype(np.float32), directions.astype(np.float32), **options)
