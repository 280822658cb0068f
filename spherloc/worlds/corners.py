"""Darkens corners: light from all around reaches a place the less, the more of it is walled in."""

from dataclasses import replace

import numpy as np

from spherloc.worlds.mesh import Mesh
from spherloc.worlds.rays import RayScene

RAYS = 24
STRENGTH = 0.6


def with_dark_corners(mesh: Mesh, reach_m: float) -> Mesh:
    """The mesh with its tints darkened by what stands within ``reach_m`` of each vertex."""
    rng = np.random.default_rng(5)
    rays = RayScene(mesh)
    # A vertex looks out from just inside its face: at the very corner it would lie in the neighbouring wall.
    face_of = np.zeros(len(mesh.vertices), np.int64)
    face_of[mesh.faces] = np.arange(len(mesh.faces))[:, None]
    middle = mesh.vertices[mesh.faces].mean(axis=1)[face_of]
    normal = rays.normals[face_of]
    start = mesh.vertices + 0.06 * (middle - mesh.vertices) + 0.01 * normal
    blocked = np.zeros(len(start))
    for _ in range(RAYS):
        way = rng.standard_normal(start.shape)
        # The normal plus a random unit vector: directions that a matt surface gathers light from.
        way = normal + 0.98 * way / np.linalg.norm(way, axis=1, keepdims=True)
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        blocked += rays.blocked(start, way, reach_m)
    dark = (1 - STRENGTH * blocked / RAYS).astype(np.float32)
    return replace(mesh, tint=mesh.tint * dark[:, None])
