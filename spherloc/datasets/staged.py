"""Scenes that are staged group by group: a simulation has one kind of outliers and one cloud of points, real failures
have several at once."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np

from spherloc.cameras.base import Camera
from spherloc.datasets.failures import PLACES, CaseMaker, Cloud
from spherloc.errors import InputError, show
from spherloc.geometry import pose, yaw_rotation
from spherloc.problem import Problem
from spherloc.types import FloatArray

GroupKind = Literal["right", "agreeing", "near", "doubled", "random"]
GROUP_KINDS: tuple[str, ...] = get_args(GroupKind)
CUBE = "cube"
MAX_MATCHES = 2_000
NEAR_M = 0.5
NEAR_YAW_DEG = 5.0
"""Distance and difference in yaw between the true pose and the one that "near" matches agree with."""


@dataclass(frozen=True)
class Group:
    """Correspondences of one sort."""

    kind: GroupKind
    """"right"; "agreeing": all with one wrong pose, a new one for each group; "near": all with one pose half a metre
    beside the true one, as where a fence's bars are mistaken for the next ones; "doubled": each point is matched twice,
    right and by one wrong pose; "random": any pixel with any point."""
    count: int
    """Number of map points; in a "doubled" group there are twice as many matches."""
    place: str = CUBE
    """Where their points are: all over the "cube", or, for right and random ones only, a key of ``PLACES``."""

    def __post_init__(self) -> None:
        if self.kind not in GROUP_KINDS:
            raise InputError(f"a group's kind is {show(self.kind)}; give one of {', '.join(GROUP_KINDS)}.")
        if not 1 <= self.count <= MAX_MATCHES:
            raise InputError(f"a group's count is {self.count}; give a whole number from 1 to {MAX_MATCHES:,}.")
        if self.place != CUBE and (self.place not in PLACES or self.kind not in ("right", "random")):
            known = f'"{CUBE}" or, for right and random ones, one of {", ".join(PLACES)}'
            raise InputError(f"a group's place is {show(self.place)}; give {known}.")


@dataclass(frozen=True)
class StagedScene:
    """A problem of groups of correspondences; it follows from its fields alone."""

    name: str
    """Name that users see."""
    camera: Camera
    """The camera that really took the image; the calibration may differ from it, see ``focal_off``."""
    groups: tuple[Group, ...]
    """Groups with a place come first, since they may turn the camera; the matches are shuffled."""
    seed: int = 0
    """Seed of every random draw."""
    noise_px: float = 1.0
    """Standard deviation of the pixel noise, px."""
    gravity_off_deg: float = 0.0
    """Angle by which the known gravity is off, to a random side, degrees."""
    gravity_bound_deg: float = 0.0
    """Stated bound on that angle, degrees."""
    focal_off: float = 0.0
    """Relative error of the calibration's focal length: 0.02 is two percent too long."""

    def __post_init__(self) -> None:
        limits = {"seed": (0, 2**63 - 1), "noise_px": (0, 100), "gravity_off_deg": (0, 90)}
        limits |= {"gravity_bound_deg": (0, 89), "focal_off": (-0.5, 1.0)}
        for key, (lowest, highest) in limits.items():
            value = getattr(self, key)
            if not lowest <= value <= highest:
                raise InputError(f"{self.name}: {key} is {value}; give a number from {lowest:g} to {highest:g}.")
        if self.focal_off and not hasattr(self.camera, "fx"):
            raise InputError(f"{self.name}: a camera of model {self.camera.model} has no focal length to be wrong.")

    def problem(self, seed: int | None = None) -> Problem:
        """The problem; ``seed`` changes nothing, as with measured ones: it may be the estimator's seed."""
        make = CaseMaker(np.random.default_rng([self.seed, *map(ord, "staged")]))
        make.camera, make.noise_px = self.camera, self.noise_px
        for group in self.groups:
            _add(make, group)
        bound = float(np.radians(self.gravity_bound_deg))
        gravity = make.tilted(float(np.radians(self.gravity_off_deg)))
        problem = make.case("", gravity_camera=gravity, gravity_bound_rad=bound).problem
        return replace(problem, name=self.name, camera=self._calibrated(), scene=f"staged: {_words(self.groups)}")

    def _calibrated(self) -> Camera:
        """The camera with the focal length of the wrong calibration."""
        if not self.focal_off:
            return self.camera
        camera: Any = self.camera  # ``__post_init__`` wants one with focal lengths
        longer = 1.0 + self.focal_off
        return replace(camera, fx=camera.fx * longer, fy=camera.fy * longer)


def _add(make: CaseMaker, group: Group) -> None:
    cloud: Cloud | None = None if group.place == CUBE else PLACES[group.place](make)
    if group.kind == "right":
        make.right(group.count, cloud)
    elif group.kind == "random":
        make.random(group.count, cloud)
    elif group.kind == "near":
        make.agreeing(group.count, _beside(make))
    else:
        make.coherent(group.count, doubled=group.count if group.kind == "doubled" else 0)


def _beside(make: CaseMaker) -> FloatArray:
    """A level pose (3, 4) near the true one."""
    side = make.between(-np.pi, np.pi)
    shift = NEAR_M * np.array([np.cos(side), 0.0, np.sin(side)])
    turn = yaw_rotation(float(np.radians(NEAR_YAW_DEG)) * make.rng.choice([-1.0, 1.0]))
    return pose(turn @ make.truth[:, :3], turn @ (make.truth[:, 3] + shift))


def _words(groups: Sequence[Group]) -> str:
    """The groups in a line."""
    parts = [f"{group.count} {group.kind}" + ("" if group.place == CUBE else f" ({group.place})") for group in groups]
    return ", ".join(parts)
