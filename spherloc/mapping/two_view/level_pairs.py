"""Relative pose of two level cameras from three matches, for pairs of images of which few matches are right.

Gravity in both images leaves a yaw and a direction of travel. With bearings a and c of a match in the level frames of
the two cameras (y down), c x R(yaw) a is a normal of the plane that both rays and the direction t span:

    n_i(yaw) . t = 0,   n_i = c_i x R(yaw) a_i,   det[n_1 n_2 n_3](yaw) = 0 for three matches,

whose roots are found where the determinant changes its sign. Samples of three need a tenth of the trials that samples
of five would, if a fifth of the matches is right, and a hundredth at a tenth (Fraundorfer, Tanskanen, Pollefeys
2010).
"""

from dataclasses import dataclass
from math import log10

import numpy as np
from scipy.special import gammaln

from spherloc.geometry import align_to_down
from spherloc.kernel_cache import kernel
from spherloc.types import BoolArray, FloatArray

SAMPLES = 4000
CONFIDENCE = 0.999
STEPS = 36
"""Yaws at which the determinant is looked at; two roots within one step are missed."""
_SECANTS = 4
SAMPLE = 5
"""Matches that fix a relative pose."""


@dataclass(frozen=True, eq=False)
class LevelPair:
    """Of two images, how the second stands to the first."""

    rotation: FloatArray
    """(3, 3), second from first, camera frames."""
    direction: FloatArray
    """Unit vector (3,), second camera's frame: the translation without its length."""
    fits: BoolArray
    """(M,) matches that fit it."""


def level_pair(
    first: FloatArray, second: FloatArray, down: tuple[FloatArray, FloatArray], bound_rad: float
) -> LevelPair | None:
    """The relative pose that most matches fit to ``bound_rad``; None if no sample of three has one.

    ``first`` and ``second`` (M, 3) are unit bearings of matches, the best first, ``down`` the unit vectors (3,) that
    point down in the images.
    """
    count = len(first)
    if count < 3:
        return None
    levels = [align_to_down(one) for one in down]
    a, c = (np.ascontiguousarray(rays @ turn.T) for rays, turn in zip((first, second), levels, strict=True))
    rng = np.random.default_rng([count, 3])
    # The first of a sample comes from the better half: descriptors say which that is.
    samples = np.column_stack(
        [rng.integers(0, max(3, count // 2), SAMPLES), rng.integers(0, count, SAMPLES), rng.integers(0, count, SAMPLES)]
    )
    best, yaw, direction = _search(a, c, samples, bound_rad, np.log(1.0 - CONFIDENCE))
    if best < 3:
        return None
    turn = levels[1].T @ _yaw(yaw) @ levels[0]
    travel = levels[1].T @ direction
    return LevelPair(turn, travel, fitting(first, second, turn, travel, bound_rad))


def fitting(
    first: FloatArray, second: FloatArray, rotation: FloatArray, direction: FloatArray, bound_rad: float
) -> BoolArray:
    """(M,) matches whose bearings (M, 3) are within ``bound_rad`` of their epipolar planes and in front of both.

    ``rotation`` (3, 3) and the unit ``direction`` (3,) are those of the second camera from the first.
    """
    turned = np.ascontiguousarray(first @ rotation.T)
    found = np.empty(len(first), np.bool_)
    _fitting(turned, np.ascontiguousarray(second), np.ascontiguousarray(direction), np.sin(bound_rad), found)
    return found


def chance_of_fit(
    first: FloatArray, second: FloatArray, rotation: FloatArray, direction: FloatArray, bound_rad: float
) -> float:
    """Share of all pairings of bearings (M, 3) that fit as matches do: what a wrong match does by chance."""
    turned = np.ascontiguousarray(first @ rotation.T)
    fit = _all_fitting(turned, np.ascontiguousarray(second), np.ascontiguousarray(direction), np.sin(bound_rad))
    return (fit + 1.0) / (len(first) * len(second) + 1.0)


def log10_nfa(matches: int, fit: int, chance: float, sample: int = SAMPLE) -> float:
    """Logarithm of the number of poses that ``fit`` of wrong ``matches`` would fit, each with the ``chance``.

    Each ``sample`` of the matches has a pose; 0 is for a pose that does not come from them.
    """
    if fit <= sample:
        return float("inf")

    def choose(n: int, k: int) -> float:
        return float(gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1)) / np.log(10.0)

    return log10(matches) + choose(matches, fit) + choose(fit, sample) + (fit - sample) * log10(chance)


def _yaw(angle: float) -> FloatArray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


@kernel()
def _normal(a, c, cosine, sine, out):
    """Write c x R a to ``out`` (3,).

    ``a`` and ``c`` (3,) are level bearings, ``cosine`` and ``sine`` those of the yaw of R.
    """
    x, y, z = a[0] * cosine + a[2] * sine, a[1], a[2] * cosine - a[0] * sine
    out[0] = c[1] * z - c[2] * y
    out[1] = c[2] * x - c[0] * z
    out[2] = c[0] * y - c[1] * x


@kernel()
def _determinant(a, c, sample, yaw, normals):
    """The determinant of the ``normals`` (3, 3), which are written, of three matches at a ``yaw``, rad.

    ``a`` and ``c`` (N, 3) are level bearings, ``sample`` (3,) the numbers of the matches.
    """
    cosine, sine = np.cos(yaw), np.sin(yaw)
    for k in range(3):
        _normal(a[sample[k]], c[sample[k]], cosine, sine, normals[k])
    n = normals
    return (
        n[0, 0] * (n[1, 1] * n[2, 2] - n[1, 2] * n[2, 1])
        - n[0, 1] * (n[1, 0] * n[2, 2] - n[1, 2] * n[2, 0])
        + n[0, 2] * (n[1, 0] * n[2, 1] - n[1, 1] * n[2, 0])
    )


@kernel()
def _fits(r, c, t, sine_bound):
    """Whether bearings ``r`` (turned into the second camera) and ``c`` (3,) fit the unit direction ``t`` (3,).

    ``sine_bound`` is the sine of the bound on each one's error.
    """
    n0, n1, n2 = c[1] * r[2] - c[2] * r[1], c[2] * r[0] - c[0] * r[2], c[0] * r[1] - c[1] * r[0]
    p0, p1, p2 = t[1] * r[2] - t[2] * r[1], t[2] * r[0] - t[0] * r[2], t[0] * r[1] - t[1] * r[0]
    q0, q1, q2 = t[1] * c[2] - t[2] * c[1], t[2] * c[0] - t[0] * c[2], t[0] * c[1] - t[1] * c[0]
    off = n0 * t[0] + n1 * t[1] + n2 * t[2]
    least = min(p0 * p0 + p1 * p1 + p2 * p2, q0 * q0 + q1 * q1 + q2 * q2)
    if off * off > sine_bound * sine_bound * least:
        return False
    # Depths are positive, or so far away that noise decides.
    noise = sine_bound * np.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
    return p0 * n0 + p1 * n1 + p2 * n2 > -noise and q0 * n0 + q1 * n1 + q2 * n2 > -noise


@kernel()
def _fitting(turned, second, direction, sine_bound, found):
    """Write to ``found`` (N,) which of the bearings ``turned`` and ``second`` (N, 3) fit ``direction``, see ``_fits``.

    ``sine_bound`` is as there.
    """
    for i in range(len(turned)):
        found[i] = _fits(turned[i], second[i], direction, sine_bound)


@kernel()
def _all_fitting(turned, second, direction, sine_bound):
    """How many of all pairings of bearings ``turned`` and ``second`` (N, 3) fit ``direction``, see ``_fits``.

    ``sine_bound`` is as there.
    """
    count = 0
    for i in range(len(turned)):
        for j in range(len(second)):
            if _fits(turned[i], second[j], direction, sine_bound):
                count += 1
    return count


@kernel()
def _search(a, c, samples, bound_rad, log_miss):
    """Most matches that fit, and the yaw, rad, and direction (3,) that they fit.

    ``a`` and ``c`` (N, 3) are level bearings, ``samples`` (S, 3) the numbers of the matches that are tried together,
    ``bound_rad`` the bound on a bearing's error, ``log_miss`` the logarithm of 1 - confidence.
    """
    count, sine_bound = len(a), np.sin(bound_rad)
    normals, turned, t, best_t = np.empty((3, 3)), np.empty(3), np.empty(3), np.zeros(3)
    best, best_yaw, needed = 0, 0.0, float(len(samples))
    step = 2.0 * np.pi / STEPS
    for s in range(len(samples)):
        if s >= needed:
            break
        sample = samples[s]
        if sample[0] == sample[1] or sample[0] == sample[2] or sample[1] == sample[2]:
            continue
        before = _determinant(a, c, sample, 0.0, normals)
        for k in range(STEPS):
            low, high = k * step, (k + 1) * step
            after = _determinant(a, c, sample, high, normals)
            start = before
            before = after
            if start * after >= 0.0:
                continue
            end = after
            yaw = low
            for _ in range(_SECANTS):
                yaw = low - start * (high - low) / (end - start)
                value = _determinant(a, c, sample, yaw, normals)
                if value * start > 0.0:
                    low, start = yaw, value
                else:
                    high, end = yaw, value
            if not _direction(normals, t):
                continue
            cosine, sine = np.cos(yaw), np.sin(yaw)
            if not _in_front(a, c, sample, cosine, sine, normals, t):
                continue
            fit = 0
            for i in range(count):
                if fit + count - i <= best:
                    break
                turned[0] = a[i, 0] * cosine + a[i, 2] * sine
                turned[1] = a[i, 1]
                turned[2] = a[i, 2] * cosine - a[i, 0] * sine
                if _fits(turned, c[i], t, sine_bound):
                    fit += 1
            if fit > best:
                best, best_yaw = fit, yaw
                for j in range(3):
                    best_t[j] = t[j]
                share = min(0.999, fit / count)
                needed = log_miss / np.log(1.0 - share**3)
    return best, best_yaw, best_t


@kernel()
def _direction(normals, t):
    """Write the unit vector ``t`` (3,) perpendicular to the ``normals`` (3, 3); False if they are nearly parallel."""
    longest = 1e-6
    found = False
    for k in range(3):
        m, n = normals[k], normals[(k + 1) % 3]
        x, y, z = m[1] * n[2] - m[2] * n[1], m[2] * n[0] - m[0] * n[2], m[0] * n[1] - m[1] * n[0]
        length = np.sqrt(x * x + y * y + z * z)
        if length > longest:
            longest, found = length, True
            t[0], t[1], t[2] = x / length, y / length, z / length
    return found


@kernel()
def _in_front(a, c, sample, cosine, sine, normals, t):
    """Turn ``t`` (3,) round if that puts all three points in front of both cameras; False if neither does.

    ``a``, ``c``, ``sample``, ``cosine``, ``sine`` and ``normals`` are as in ``_determinant`` and ``_normal``.
    """
    for turn in range(2):
        right = True
        for k in range(3):
            i = sample[k]
            r0, r1, r2 = a[i, 0] * cosine + a[i, 2] * sine, a[i, 1], a[i, 2] * cosine - a[i, 0] * sine
            n, q = normals[k], c[i]
            first = (t[1] * r2 - t[2] * r1) * n[0] + (t[2] * r0 - t[0] * r2) * n[1] + (t[0] * r1 - t[1] * r0) * n[2]
            second = (
                (t[1] * q[2] - t[2] * q[1]) * n[0]
                + (t[2] * q[0] - t[0] * q[2]) * n[1]
                + (t[0] * q[1] - t[1] * q[0]) * n[2]
            )
            if first <= 0.0 or second <= 0.0:
                right = False
                break
        if right:
            return True
        if turn == 0:
            for j in range(3):
                t[j] = -t[j]
    return False
