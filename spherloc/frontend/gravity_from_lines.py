"""Gravity from the image itself: the direction in which its vertical edges meet.

An edge and the camera's centre span a plane, which cuts the unit sphere in a great circle with the normal n. All planes
of vertical edges contain the vertical v, so that n . v = 0 for each. Edges are found by LSD (von Gioi et al. 2010) on
virtual pinhole faces, on which they are straight whatever the lens. v is searched on a grid of directions around the
expected direction of gravity, so that horizontal edges are not taken for vertical ones, and refined by least squares.
Edges one above the other count as one, since those of a door frame, for instance, lean together. v is accepted if more
edges meet there than chance explains (a contrario, Desolneux et al. 2000).
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from spherloc.cameras.base import Camera, in_image
from spherloc.errors import InputError, shorten
from spherloc.frontend.view import Gravity, View
from spherloc.geometry import DOWN, align_to_down, tangent_basis
from spherloc.images import grey
from spherloc.types import BoolArray, ByteArray, FloatArray

SOURCE = "lines of the image"
NOT_FOUND = "gravity cannot be found from its lines, since"
"""What an error says before the reason."""

FACE_DEG = 100.0
"""Field of view of a face: neighbouring faces overlap by ten degrees, in which an edge is seen in both."""
MAX_FOCAL_PX = 330.0
"""Largest focal length of a face; larger images are shrunk first, since LSD is slow and long edges need no more."""
RIM_PX = 4
"""Edges that end this close to pixels that the camera does not see are edges of the image and not of the scene."""
MIN_LENGTH_RAD = np.radians(2.5)
MAX_LINES = 800
"""Largest number of edges that are used: the longest ones."""
END_SD_PX = 0.4
"""Standard deviation of the ends of an edge, at right angles to it, pixels of a face."""
MAX_END_SD_RAD = np.radians(2.5)
"""Largest standard deviation of an edge's direction by that of its ends; shorter edges are left out."""

WITHIN_DEG = 45.0
"""Largest angle between v and the expected direction: farther away, horizontal edges meet."""
GRID_DEG = 1.5
GATE_RAD = np.radians(1.5)
"""Edges whose planes miss a direction of the grid by less than this vote for it."""
LEAN_SD_RAD = float(np.radians(0.4))
"""Standard deviation by which upright edges lean, errors of the calibration included."""
LEANS_RAD = np.radians([0.4, 0.6, 0.8, 1.1, 1.5, 2.0, 2.7, 3.6, 4.8, 6.4, 8.5, 11.0])
"""Standard deviations of the leaning that are tried."""
MAX_LEAN_RAD = float(np.radians(0.7))
"""From this leaning on the edges do not meet in one direction, and the bound comes from a fit with a wider gate."""
LEAN_REACH = float(np.sin(np.radians(25.0)))
LEAN_STEPS = 6
MAX_OFF = 0.06
"""Largest |n . v| of an edge that counts as vertical."""
POLE = 0.95
"""Largest squared cosine between v and an edge's middle: an edge nearer to the vertical has no information."""
GROUP_RAD = np.radians(3.0)
"""Edges whose azimuths, or planes, differ by less count as one."""

MAX_NFA = 1e-2
"""Largest NFA: number of directions in which as many edges would meet by chance."""
MIN_GROUPS = 5
RIVAL_DEG, RIVAL_SHARE = 12.0, 0.75
"""Another direction at least this far away must have fewer votes than this share of the best direction's."""
MIN_SD_RAD, MAX_SD_RAD = np.radians(0.1), np.radians(1.5)
BOUND_SD = 3.0
"""Number of standard deviations that make the bound."""


@dataclass(frozen=True, eq=False)
class Lines:
    """L edges in the camera frame."""

    normals: FloatArray
    """(L, 3) unit normals of their planes."""
    middles: FloatArray
    """(L, 3) unit vectors to their middles."""
    lengths_rad: FloatArray
    """(L,) angles between their ends."""
    end_sd_rad: float
    """Standard deviation of an end across the edge."""

    def __len__(self) -> int:
        return len(self.normals)

    def among(self, chosen: BoolArray) -> "Lines":
        """The edges of a mask (L,)."""
        return Lines(self.normals[chosen], self.middles[chosen], self.lengths_rad[chosen], self.end_sd_rad)

    def variance(self, along: FloatArray) -> FloatArray:
        """(..., L) variance of n . v by the errors of the ends, where (middle . v)^2 is ``along`` (..., L).

        Errors that shift an edge turn n towards the edge's middle; errors that rotate it turn n along the edge.
        """
        moving = 0.5 * self.end_sd_rad**2
        turning = 0.5 * (self.end_sd_rad / np.sin(0.5 * self.lengths_rad)) ** 2
        return moving * along + turning * (1.0 - along)


@dataclass(frozen=True, eq=False)
class Vertical:
    """The direction in which vertical edges meet."""

    down: FloatArray
    """Unit vector (3,), camera frame."""
    sd_rad: float
    """Standard deviation of the worse of its two tilts."""
    groups: int
    """Number of edges that meet there; edges with about the same azimuth count as one."""


def gravity_from_lines(view: View, near: FloatArray | None = None) -> Gravity:
    """Gravity of an image; ``near`` (3,) is its expected direction, +y if None.

    Raises ``InputError`` if the image cannot be read or shows too few vertical edges.
    """
    usable = view.usable_pixels()
    return gravity_of_pixels(grey(view.read()), view.camera, usable, DOWN if near is None else near, view.name)


def why_not_found(sentence: str) -> str:
    """The reason in a sentence about gravity that lines did not give; empty in other sentences."""
    return sentence.partition(NOT_FOUND)[2].strip()


def gravity_of_pixels(image: ByteArray, camera: Camera, usable: BoolArray, near: FloatArray, name: str) -> Gravity:
    """``gravity_from_lines`` of a grey image (H, W) called ``name``, with its ``usable`` pixels (H, W).

    ``near`` (3,) is the expected direction. Raises ``InputError``, which names the image, for too few vertical edges.
    """
    return gravity_of_lines(image_lines(image, camera, usable), near, name)


def gravity_of_lines(lines: Lines, near: FloatArray, name: str) -> Gravity:
    """Gravity by the edges of an image called ``name``; ``near`` (3,) is the expected direction.

    Raises ``InputError``, which names the image, for too few vertical edges.
    """
    try:
        found = vertical(lines, near)
    except InputError as error:
        raise InputError(f"{shorten(name)}: {NOT_FOUND} {error}") from None
    return Gravity(found.down, SOURCE, BOUND_SD * found.sd_rad, found.sd_rad)


def vertical(lines: Lines, near: FloatArray) -> Vertical:
    """The vertical of some edges, less than ``WITHIN_DEG`` from the unit vector ``near`` (3,).

    Raises ``InputError``, a part of a sentence, where there is too little evidence.
    """
    if len(lines) < MIN_GROUPS:
        raise InputError(f"it has {len(lines)} straight edges, fewer than {MIN_GROUPS}.")
    grid = _grid(near)
    votes = _votes(lines, grid)
    down = grid[votes.argmax()]
    for gate_rad in (2.0 * GATE_RAD, *[GATE_RAD] * 8):
        down = _fit(lines, down, gate_rad).down
    found = _fit(lines, down, GATE_RAD)
    found = replace(found, sd_rad=max(found.sd_rad, _sd_of_leaning(lines, found.down)))
    nearer = int(np.count_nonzero(grid @ near >= down @ near))
    rival = votes[grid @ down < np.cos(np.radians(RIVAL_DEG))].max(initial=0.0)
    if nearer == len(grid):
        raise InputError(f"its edges meet {WITHIN_DEG:g} degrees or more from where down was expected.")
    if found.groups < MIN_GROUPS:
        raise InputError(f"it has {found.groups} separate vertical edges, fewer than {MIN_GROUPS}.")
    # Directions are tried from the expected one outwards: the nearer v is to it, the fewer tests count in the NFA.
    if _nfa(lines, down, nearer + 1) > MAX_NFA:
        raise InputError("no more of its edges meet in one direction than chance explains.")
    if rival > RIVAL_SHARE * votes.max():
        raise InputError("about as many of its edges meet in another direction.")
    if found.sd_rad > MAX_SD_RAD:
        raise InputError(
            f"its vertical edges fix it to {np.degrees(found.sd_rad):.1f} degrees (1 sd), and "
            f"{np.degrees(MAX_SD_RAD):.1f} or less are needed."
        )
    return Vertical(found.down, max(found.sd_rad, float(MIN_SD_RAD)), found.groups)


def _grid(near: FloatArray) -> FloatArray:
    """Unit vectors (G, 3) about ``GRID_DEG`` apart, at most ``WITHIN_DEG`` from ``near`` (3,): a Fibonacci lattice."""
    cap = 1.0 - np.cos(np.radians(WITHIN_DEG))
    count = int(2 * np.pi * cap / np.radians(GRID_DEG) ** 2)
    height = 1.0 - cap * (np.arange(count) + 0.5) / count
    turn = np.arange(count) * np.pi * (3.0 - np.sqrt(5.0))
    radius = np.sqrt(1.0 - height**2)
    return np.column_stack([radius * np.cos(turn), height, radius * np.sin(turn)]) @ align_to_down(near)


def _votes(lines: Lines, directions: FloatArray) -> FloatArray:
    """Votes (G,) for directions (G, 3): the lengths of the edges that point towards them."""
    off = (directions @ lines.normals.T) ** 2
    along = (directions @ lines.middles.T) ** 2
    # Every edge right overhead points there, so an edge counts by its distance from the direction.
    weight = np.minimum(lines.lengths_rad, 0.5) * (1.0 - along)
    return (weight * np.maximum(0.0, 1.0 - off / (GATE_RAD**2 + 4.0 * lines.variance(along)))).sum(axis=1)


def _sd_of_leaning(lines: Lines, down: FloatArray) -> float:
    """Standard deviation, rad, of the direction ``down`` (3,) if the things in view lean; 0 if they do not.

    Trees and old houses lean: their edges do not meet in one direction. Some do by chance, and a narrow gate hides the
    others. A fit with a wide gate then gives another direction; the difference shows the uncertainty.
    """
    lean_rad, wide = _lean_sd(lines, down), down
    if lean_rad <= MAX_LEAN_RAD:
        return 0.0
    for _ in range(LEAN_STEPS):
        found = _fit(lines, wide, 2.5 * lean_rad, lean_rad)
        wide, lean_rad = found.down, _lean_sd(lines, found.down)
    apart = float(np.arccos(np.clip(wide @ down, -1.0, 1.0)))
    return float(np.hypot(found.sd_rad, apart / 2.0))


def _lean_sd(lines: Lines, down: FloatArray) -> float:
    """Standard deviation, rad, by which things lean about ``down`` (3,): the most likely of ``LEANS_RAD``.

    The model of the edges up to ``LEAN_REACH`` from it: a part has n . v about 0, with this standard deviation and that
    of the ends, and the rest is uniform. Edges of about one azimuth count as one.
    """
    along, off = (lines.middles @ down) ** 2, lines.normals @ down
    variance = lines.variance(along)
    near = (np.abs(off) < LEAN_REACH) & (variance < MAX_END_SD_RAD**2) & (along < 0.75)
    if not near.any():
        return float(LEANS_RAD[0])
    off, variance = off[near], variance[near]
    across = tangent_basis(down[None])[0]
    azimuth = np.arctan2(*(lines.middles[near] @ across.T).T)
    group = np.unique((azimuth / GROUP_RAD).round().astype(int), return_inverse=True)[1].ravel()
    weight = 1.0 / np.bincount(group)[group]
    anywhere = 0.5 / LEAN_REACH
    wide = variance + LEANS_RAD[:, None] ** 2
    upright = np.exp(-0.5 * off**2 / wide) / np.sqrt(2 * np.pi * wide)
    share = np.full((len(LEANS_RAD), 1), 0.5)
    for _ in range(30):  # expectation maximisation
        total = share * upright + (1.0 - share) * anywhere
        share = ((share * upright / total) @ weight / weight.sum()).clip(0.02, 0.98)[:, None]
    return float(LEANS_RAD[(np.log(total) @ weight).argmax()])


def _fit(lines: Lines, start: FloatArray, gate_rad: float, lean_sd_rad: float = LEAN_SD_RAD) -> Vertical:
    """One step of weighted least squares from the direction ``start`` (3,), with edges up to ``gate_rad`` from it.

    ``lean_sd_rad`` is the standard deviation by which they lean.
    """
    along, off = (lines.middles @ start) ** 2, lines.normals @ start
    variance = lines.variance(along)
    wide = variance + gate_rad**2 / 4.0
    most_off = max(MAX_OFF, 2.5 * lean_sd_rad)
    near = (off**2 <= np.minimum(9.0 * wide, most_off**2)) & (variance < MAX_END_SD_RAD**2) & (along < POLE)
    used, along, off, variance, wide = lines.among(near), along[near], off[near], variance[near], wide[near]
    # Probability that an edge is vertical; n . v of others is uniform from -1 to 1, as of edges on the floor below.
    prior = 0.5 * (1.0 - along) ** 2
    density = prior * np.exp(-0.5 * off**2 / wide) / np.sqrt(2 * np.pi * wide)
    known = density / (density + 0.5 * (1.0 - prior)) / variance
    across = tangent_basis(start[None])[0]
    azimuth = np.arctan2(*(used.middles @ across.T).T)
    group = np.unique((azimuth / GROUP_RAD).round().astype(int), return_inverse=True)[1].ravel()
    total = np.bincount(group, known)
    information = 1.0 / (lean_sd_rad**2 + 1.0 / total)
    group_off = np.bincount(group, known * off) / total
    robust = 1.0 / (1.0 + group_off**2 * information / 4.0)  # Cauchy's weights
    weight = known * (information * robust / total)[group]
    scatter = np.einsum("l,li,lj->ij", weight, used.normals, used.normals)
    down = np.linalg.eigh(scatter)[1][:, 0]
    chi2 = float((robust * information * group_off**2).sum() / max(1.0, robust.sum() - 2.0))
    least = float(np.linalg.eigvalsh(across @ scatter @ across.T)[0])
    sd_rad = np.sqrt(max(1.0, chi2) / least) if least > 0.0 else np.inf
    return Vertical(down if down @ start > 0.0 else -down, float(sd_rad), len(total))


def _nfa(lines: Lines, down: FloatArray, tests: int) -> float:
    """NFA: how many of ``tests`` directions would by chance have as many edges as ``down`` (3,).

    If an edge is turned at random about its middle m, |n . v| is at most t with probability (2 / pi) asin(t / |m x v|).
    Edges of about the same plane count as one.
    """
    from scipy.special import gammainc  # probability that a Poisson variable reaches a number; a slow import

    along = (lines.middles @ down) ** 2
    variance = lines.variance(along)
    clear = (variance < MAX_END_SD_RAD**2) & (along < 0.75)
    normals, along = lines.normals[clear], along[clear]
    reach = np.minimum(2.0 * np.sqrt(variance[clear] + LEAN_SD_RAD**2), MAX_OFF)
    chance = 2 / np.pi * np.arcsin(np.minimum(1.0, reach / np.sqrt(1.0 - along)))
    near = np.abs(normals @ down) <= reach
    cells = np.round(normals * np.where(normals[:, :1] < 0.0, -1.0, 1.0) / GROUP_RAD).astype(int)
    plane = np.unique(cells, axis=0, return_inverse=True)[1].ravel()
    expected = float((chance / np.bincount(plane)[plane]).sum())
    seen = len(np.unique(plane[near]))
    return tests * float(gammainc(seen, expected)) if seen else float(tests)


def image_lines(image: ByteArray, camera: Camera, usable: BoolArray) -> Lines:
    """The longest straight edges of a grey image (H, W) within its ``usable`` pixels (H, W)."""
    sharpness = _focal_px(camera)
    focal_px = min(MAX_FOCAL_PX, sharpness)
    if focal_px < 0.75 * sharpness:
        image = np.asarray(
            cv2.resize(image, None, fx=focal_px / sharpness, fy=focal_px / sharpness, interpolation=cv2.INTER_AREA),
            np.uint8,
        )
    detector = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD)
    ends = [np.empty((0, 2, 3))]
    for face in _faces(camera, focal_px):
        drawn, allowed = face.cut(image), face.cut(usable.astype(np.uint8)) * face.seen
        found = detector.detect(drawn)[0]
        if found is None:
            continue
        pairs = found.reshape(-1, 2, 2).astype(np.float64)
        allowed = cv2.erode(allowed, np.ones((2 * RIM_PX + 1, 2 * RIM_PX + 1), np.uint8))
        places = np.concatenate([pairs, pairs.mean(axis=1, keepdims=True)], axis=1).round().astype(int)
        columns, rows = np.moveaxis(places.clip(0, len(allowed) - 1), 2, 0)
        ends.append(face.rays(pairs[(allowed[rows, columns] > 0).all(axis=1)] + 0.5))
    first, second = np.moveaxis(np.concatenate(ends), 1, 0)
    normals, middles = np.cross(first, second), first + second
    sine = np.linalg.norm(normals, axis=1)
    lengths = np.arctan2(sine, (first * second).sum(axis=1))
    order = np.argsort(-lengths, kind="stable")[:MAX_LINES]
    order = order[lengths[order] >= MIN_LENGTH_RAD]
    return Lines(
        normals[order] / sine[order, None],
        middles[order] / np.linalg.norm(middles[order], axis=1, keepdims=True),
        lengths[order],
        END_SD_PX / focal_px,
    )


@dataclass(frozen=True, eq=False)
class _Face:
    """A square pinhole image of S x S pixels."""

    face_from_camera: FloatArray
    """Rotation (3, 3); the face looks along its own +z."""
    focal_px: float
    places: NDArray[np.float32]
    """(S, S, 2) places of its pixels in the image, as shares of its width and height; 0 where the camera cannot see."""
    seen: ByteArray
    """(S, S) 1 where the camera can see, else 0."""

    def cut(self, image: ByteArray) -> ByteArray:
        """The face (S, S) of a grey image (H, W) of any size."""
        height, width = image.shape
        # OpenCV's first pixel has its centre at 0.
        u, v = (self.places[..., k] * np.float32(size) - np.float32(0.5) for k, size in enumerate((width, height)))
        # A panorama continues at its other side; other images have a border there, where no edge is kept.
        return np.asarray(cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP), np.uint8)

    def rays(self, pixels: FloatArray) -> FloatArray:
        """Unit vectors (..., 3), camera frame, of pixels (..., 2)."""
        return _rays(pixels, len(self.places), self.focal_px, self.face_from_camera)


def _rays(pixels: FloatArray, size: int, focal_px: float, face_from_camera: FloatArray) -> FloatArray:
    flat = (pixels - 0.5 * size) / focal_px
    rays = np.concatenate([flat, np.ones((*flat.shape[:-1], 1))], axis=-1) @ face_from_camera
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


_AXES = ((0, 0, 1), (1, 0, 0), (0, 0, -1), (-1, 0, 0), (0, -1, 0), (0, 1, 0))
"""Axes of the faces of a cube."""


@lru_cache(maxsize=8)
def _faces(camera: Camera, focal_px: float) -> tuple[_Face, ...]:
    """The faces of which the camera sees a part."""
    size = int(np.ceil(2 * np.tan(np.radians(FACE_DEG / 2)) * focal_px))
    at = np.arange(size, dtype=np.float64) + 0.5
    centres = np.stack(np.meshgrid(at, at), axis=-1)
    faces = []
    for axis in np.array(_AXES, dtype=np.float64):
        right = np.cross([0.0, 1.0, 0.0], axis) if axis[1] == 0.0 else np.array([1.0, 0.0, 0.0])
        face_from_camera = np.stack([right, np.cross(axis, right), axis])
        pixels, seen = camera.project(_rays(centres, size, focal_px, face_from_camera).reshape(-1, 3))
        seen &= in_image(camera, pixels)
        if seen.any():
            parts = np.where(seen[:, None], pixels / [camera.width, camera.height], 0.0).astype(np.float32)
            shape = (size, size)
            faces.append(
                _Face(face_from_camera, focal_px, parts.reshape(*shape, 2), seen.astype(np.uint8).reshape(shape))
            )
    return tuple(faces)


def _focal_px(camera: Camera) -> float:
    """Pixels per radian on the camera's +z axis, or in the middle of its image if it does not see along the axis."""
    pixels, seen = camera.project(np.array([[0.0, 0.0, 1.0]]))
    middle = pixels if seen[0] else np.array([[0.5 * camera.width, 0.5 * camera.height]])
    stretch = np.linalg.norm(camera.unprojection_jacobian(middle), ord=2, axis=(1, 2))[0]
    if not np.isfinite(stretch):
        raise InputError("the camera sees nothing in the middle of its image; check its calibration.")
    return float(1.0 / stretch)
