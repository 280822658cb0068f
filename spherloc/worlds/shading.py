"""Light on surfaces: Lambert's law for sun, sky and lamps, with shadows; haze; and the sky itself."""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from spherloc.types import FloatArray
from spherloc.worlds.conditions import LIGHTS, SNOW, Conditions, Light, recoloured
from spherloc.worlds.mesh import TexturedMesh
from spherloc.worlds.paint import noise
from spherloc.worlds.rays import Hits, RayScene
from spherloc.worlds.world import World

Colours = NDArray[np.float32]

GAMMA = 2.2
HAZE_M = 260.0
LAMP_COLOUR = np.array([1.0, 0.78, 0.48], np.float32)
INDOOR_LAMP = np.array([1.0, 0.93, 0.82], np.float32)
OFF_SURFACE_M = 2e-3
"""Rays that leave a surface start this far above it, beyond Embree's single precision."""


@dataclass(frozen=True, eq=False)
class Lighting:
    """Everything that colours depend on besides the rays."""

    world: World
    rays: RayScene
    """The world's own, or with occluders in it."""
    conditions: Conditions

    @property
    def light(self) -> Light:
        """With the sun where the conditions want it."""
        light, given = LIGHTS[self.conditions.light], self.conditions
        return replace(
            light,
            azimuth_deg=light.azimuth_deg if given.sun_azimuth_deg is None else given.sun_azimuth_deg,
            elevation_deg=light.elevation_deg if given.sun_elevation_deg is None else given.sun_elevation_deg,
        )

    def colours(self, origin: FloatArray, directions: FloatArray, hits: Hits, angle_rad: FloatArray) -> Colours:
        """Linear RGB (N, 3) of what rays (N, 3) from ``origin`` (3,) hit; ``angle_rad`` (N,) is a pixel's size."""
        result = np.empty((len(directions), 3), np.float32)
        seen = hits.face >= 0
        result[~seen] = self.sky(directions[~seen])
        hit = Hits(hits.face[seen], hits.weights[seen], hits.range_m[seen])
        result[seen] = self._surface(origin, directions[seen], hit, angle_rad[seen])
        return result

    def _surface(self, origin: FloatArray, directions: FloatArray, hits: Hits, angle_rad: FloatArray) -> Colours:
        mesh = self.rays.mesh
        places = origin + directions * hits.range_m[:, None]
        normals = self.rays.normals[hits.face]
        # Lit from the side that is looked at, so that thin things have two faces.
        facing = np.einsum("ij,ij->i", normals, directions)
        normals = np.where(facing[:, None] > 0, -normals, normals)
        corners = mesh.faces[hits.face]
        uv = np.einsum("ij,ijk->ik", hits.weights, mesh.uv[corners])
        tint = np.einsum("ij,ijk->ik", hits.weights, mesh.tint[corners])
        # On a slanted surface a pixel is longer than wide: the mean of both keeps near ground crisp, far ground calm.
        slant = np.sqrt(np.maximum(np.abs(facing), 0.05))
        texels = self.rays.texels_per_metre[hits.face] * hits.range_m * angle_rad / slant
        atlas = recoloured(self.world.atlas, self.conditions.season)
        level = np.log2(np.maximum(texels, 1e-6)).astype(np.float32)
        texture = atlas.sample(uv.astype(np.float32), mesh.tile[hits.face], level) / np.float32(255)
        base = texture[:, :3].astype(np.float32)
        if self.conditions.season == "winter" and not self.world.indoor:
            base = _snowed(base, places, normals)
        albedo = base**GAMMA * tint
        glow = texture[:, 3] * mesh.lit[hits.face]
        if self.world.indoor:
            # Lamps are always on; the view from a window is as bright as the day.
            behind_glass = (
                np.array([kind == "glass" for kind in atlas.kinds])[mesh.tile[hits.face]] & mesh.lit[hits.face]
            )
            albedo *= np.where(behind_glass, min(1.0, 1.8 * float(np.mean(self.light.sky))), 1.0)[:, None]
            return (albedo * (self._irradiance(places, normals) + (1.1 * glow)[:, None])).astype(np.float32)
        colour = albedo * self._irradiance(places, normals)
        glow *= self.light.lamps
        colour = colour + (1.5 * glow)[:, None] * (0.2 + base.mean(axis=1, keepdims=True)) * LAMP_COLOUR
        clear = np.exp(-hits.range_m / HAZE_M)[:, None]
        return (clear * colour + (1 - clear) * np.asarray(self.light.horizon)).astype(np.float32)

    def _irradiance(self, places: FloatArray, normals: FloatArray) -> Colours:
        light = self.light
        up = normals[:, 2:3]
        sky = np.asarray(light.sky, np.float32)
        if self.world.indoor:  # daylight is only what comes through windows, and white walls spread it
            sky = np.float32(1.1 * sky.mean()) * INDOOR_LAMP
        lit = sky * (0.85 + 0.15 * up if self.world.indoor else 0.62 + 0.38 * up)
        sun = np.asarray(light.sun, np.float32)
        if sun.any() and not self.world.indoor:
            azimuth, elevation = np.radians([light.azimuth_deg, light.elevation_deg])
            level = np.cos(elevation)
            towards = np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
            facing = normals @ towards
            chosen = np.flatnonzero(facing > 0)
            start = places[chosen] + OFF_SURFACE_M * normals[chosen]
            dark = self.rays.blocked(start, np.broadcast_to(towards, start.shape), 1e3)
            strength = np.zeros(len(places), np.float32)
            strength[chosen] = np.where(dark, 0.0, facing[chosen])
            # What the sun lights also lights the shade a little.
            lit = lit + strength[:, None] * sun + 0.10 * sun
        power = 1.0 if self.world.indoor else light.lamps
        if power > 0 and len(self.world.lamps):
            lit = lit + power * self._lamplight(places, normals)
        return lit.astype(np.float32)

    def _lamplight(self, places: FloatArray, normals: FloatArray) -> Colours:
        total = np.zeros(len(places), np.float32)
        reach = self.world.lamp_reach_m
        for lamp in self.world.lamps:
            way = lamp - places
            distance = np.linalg.norm(way, axis=1)
            facing = np.einsum("ij,ij->i", way, normals) / np.maximum(distance, 1e-6)
            chosen = np.flatnonzero((distance < reach) & (facing > 0))
            direction = way[chosen] / distance[chosen, None]
            start = places[chosen] + OFF_SURFACE_M * normals[chosen]
            dark = self.rays.blocked(start, direction, distance[chosen] - 0.3)
            fall = (1 - (distance[chosen] / reach) ** 2) ** 2 / (1 + (distance[chosen] / (0.25 * reach)) ** 2)
            total[chosen] += np.where(dark, 0.0, facing[chosen] * fall)
        return 1.3 * total[:, None] * (INDOOR_LAMP if self.world.indoor else LAMP_COLOUR)

    def sky(self, directions: FloatArray) -> Colours:
        """Linear RGB (N, 3) of the sky: from the horizon to the zenith, with clouds."""
        light = self.light
        height = np.clip(directions[:, 2], 0.0, 1.0)
        share = (height**0.55)[:, None]
        colour = (1 - share) * np.asarray(light.horizon) + share * np.asarray(light.zenith)
        at = directions[:, :2] / (height[:, None] + 0.12)
        clouds = _clouds(self.world.seed)
        size = clouds.shape[0]
        column, row = np.moveaxis((at * size * 0.11).astype(int) % size, -1, 0)
        cover = np.clip(1.6 * (clouds[row, column] + light.clouds - 0.45), 0, 1) * np.clip(height * 6, 0, 1)
        bright = 0.55 * np.asarray(light.sky) * 2 + 0.35 * np.asarray(light.sun)
        return (colour + (0.75 * cover[:, None]) * (bright - colour)).astype(np.float32)


def _snowed(base: Colours, places: FloatArray, normals: FloatArray) -> Colours:
    """Snow on what faces up, trodden thin in patches that stay in place."""
    pattern = _clouds(7)
    size = pattern.shape[0]
    column, row = np.moveaxis((places[:, :2] * 22).astype(int) % size, -1, 0)
    depth = np.clip((normals[:, 2] - 0.35) * 3, 0, 1) * np.clip(0.72 + 0.5 * pattern[row, column], 0, 1)
    return (base + depth[:, None] * (SNOW - base)).astype(np.float32)


@lru_cache(maxsize=4)
def _clouds(seed: int) -> NDArray[np.float32]:
    return noise(np.random.default_rng([seed, 41]), 1024, 1024, 8, 6)


RAYS = 24
STRENGTH = 0.6


def with_dark_corners(mesh: TexturedMesh, reach_m: float) -> TexturedMesh:
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
