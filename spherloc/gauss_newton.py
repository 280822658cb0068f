"""Damped Gauss-Newton on the sphere: pose, gravity prior and their normal equations, compiled.

The cost is sum rho(|P v'|^2 / noise_px^2) + |tilt|^2 / gravity_sd_rad^2: v' is the unit vector towards R p + t, P the
pseudo-inverse of the unprojection's Jacobian at the measured pixel (``Problem.pixel_from_bearing``), and tilt the
horizontal rotation vector from +y to the map's down direction in the camera, R e_y. All frames are gravity-aligned.

The pose is moved as (R, m), m = R c + t being the middle c of the chosen points in the camera frame: a step (w, d)
makes (Exp(w) R, m + d). It turns about the middle, which keeps rotation and translation from trading against each other
when the points are far away or the map's origin is.
"""

from typing import NamedTuple

import numpy as np

from spherloc.kernel_cache import kernel
from spherloc.small_arrays import copy_matrix, copy_vector, moved_point, write_pose, write_translation_to
from spherloc.types import FloatArray

ROBUST_NONE, ROBUST_HUBER, ROBUST_CAUCHY = 0, 1, 2
HUBER_WIDTH, CAUCHY_WIDTH = 1.345, 2.3849
"""In standard deviations of the noise: the usual constants, 95 % efficient for a normal residual."""
MIN_FOR_SIX_DOF = 4
"""Three points leave up to four poses and two leave a curve, so fewer keep their tilt if gravity is unknown."""
MIN_GRAVITY_SD_RAD = 1e-9
"""A prior sharper than this is exact: its residual would be rounding."""
RANK_TOLERANCE = 1e-12
"""Least pivot of normal equations whose columns have length 1."""
GAIN_TOLERANCE = 1e-9
"""Relative fall of the cost at which a minimum is reached: the step was 1e-3 of the noise's effect or less, and the
next would be a hundred times shorter."""
RESIDUAL_TOLERANCE = 1e-10
"""Root mean square residual, in standard deviations, that is nothing but rounding."""
MIN_DAMPING, MAX_DAMPING = 1e-3, 1e4
"""Damping of the normal equations, relative to their diagonal: what a failed step starts with and what ends the fit."""


class AlignedMatches(NamedTuple):
    """M matches as the kernels take them, in gravity-aligned frames."""

    bearings: FloatArray
    """(M, 3) measured unit vectors, camera frame."""
    points: FloatArray
    """(M, 3) map points, m."""
    pixel_jacobian: FloatArray
    """(M, 2, 3) px per unit of the unit vector towards the point: ``AlignedProblem.pixel_from_bearing``."""


class Noise(NamedTuple):
    """Standard deviations that weigh residuals."""

    sd_px: float
    """Of a residual, px."""
    gravity_sd_rad: float
    """Of each of the two tilts of the known gravity, rad: 0 where it is exact, inf where it is unknown."""


class CostModel(NamedTuple):
    """Which cost is minimised, and over what."""

    noise: Noise
    """Weights of pixels and gravity."""
    robust: int | np.int64
    """One of ``ROBUST_*``."""
    dof: int
    """6, or 4 where the tilt stays as it is."""


class NormalEquations(NamedTuple):
    """Quadratic model of the cost for a step (w, d) at zero."""

    hessian: FloatArray
    """J^T J (6, 6)."""
    gradient: FloatArray
    """J^T r (6,)."""


@kernel()
def empty_equations():
    """``NormalEquations`` to be written."""
    return NormalEquations(np.empty((6, 6)), np.empty(6))


@kernel()
def polish(matches, chosen, rotation, translation, noise, robust, most_steps):
    """Minimise the cost over the chosen ``matches``; return the accepted steps. The pose is changed in place.

    ``chosen`` (M,) bool, ``rotation`` (3, 3), ``translation`` (3,) m, ``noise`` a ``Noise``, ``robust`` one of
    ``ROBUST_*``, ``most_steps`` the steps at most. A gravity of standard deviation 0 is 4 DoF: the rotation is
    projected to a pure yaw first. inf is 6 DoF without prior, or 4 DoF at the given tilt for fewer than
    ``MIN_FOR_SIX_DOF``. Fewer than two chosen leave the pose. The cost never rises (after the projection), and no NaN
    is written. Chosen points must lie in front of their bearings.
    """
    return polish_path(matches, chosen, rotation, translation, noise, robust, most_steps, np.empty((0, 3, 4)))


@kernel()
def polish_path(matches, chosen, rotation, translation, noise, robust, most_steps, path):
    """As ``polish``; the pose after each accepted step is written to ``path`` (K, 3, 4) as far as that reaches.

    ``matches``, ``chosen``, ``rotation``, ``translation``, ``noise``, ``robust`` and ``most_steps`` are as there.
    """
    count, centre = middle_of(matches.points, chosen)
    if count < 2:
        return 0
    middle = moved_point(rotation, translation, centre)
    if noise.gravity_sd_rad < MIN_GRAVITY_SD_RAD:
        write_yaw(nearest_yaw(rotation), rotation)
        write_translation_to(middle, rotation, centre, translation)
    model = CostModel(noise, robust, degrees_of_freedom(count, noise.gravity_sd_rad))
    system, next_system, step = empty_equations(), empty_equations(), np.empty(6)
    turned, moved, factor = np.empty((3, 3)), np.empty(3), np.empty((6, 6))
    cost = normal_equations(matches, chosen, centre, rotation, middle, model, system)
    floor = count * RESIDUAL_TOLERANCE**2
    steps, damping = 0, 0.0
    while steps < most_steps and floor < cost < np.inf and damping <= MAX_DAMPING:
        lower = np.inf
        if solve(system, damping, factor, step):
            turn(step, rotation, turned)
            for k in range(3):
                moved[k] = middle[k] + step[3 + k]
            lower = normal_equations(matches, chosen, centre, turned, moved, model, next_system)
        if not lower < cost:
            expected = 0.0
            for k in range(6):
                expected -= system.gradient[k] * step[k]
            if lower < np.inf and expected <= GAIN_TOLERANCE * cost:
                break
            damping = max(MIN_DAMPING, 10.0 * damping)
            continue
        gain, cost = cost - lower, lower
        copy_matrix(turned, rotation)
        copy_vector(moved, middle)
        write_translation_to(middle, rotation, centre, translation)
        system, next_system = next_system, system
        damping = 0.1 * damping if damping > MIN_DAMPING else 0.0
        if steps < len(path):
            write_pose(rotation, translation, path[steps])
        steps += 1
        if gain <= GAIN_TOLERANCE * cost:
            break
    return steps


@kernel()
def degrees_of_freedom(count, gravity_sd_rad):
    """6, or 4 where the tilt stays as it is: gravity exact, or unknown with too few of ``count`` points to find it.

    ``gravity_sd_rad`` is its standard deviation, rad, inf if it is unknown.
    """
    unknown = gravity_sd_rad == np.inf and count < MIN_FOR_SIX_DOF
    return 4 if unknown or gravity_sd_rad < MIN_GRAVITY_SD_RAD else 6


@kernel()
def middle_of(points, chosen):
    """Number of the ``points`` (M, 3), m, that are ``chosen`` (M,), and their mean (3,), m."""
    count, x, y, z = 0, 0.0, 0.0, 0.0
    for k in range(len(points)):
        if chosen[k]:
            count, x, y, z = count + 1, x + points[k, 0], y + points[k, 1], z + points[k, 2]
    middle, divisor = np.empty(3), max(count, 1)
    middle[0], middle[1], middle[2] = x / divisor, y / divisor, z / divisor
    return count, middle


@kernel()
def nearest_yaw(rotation):
    """Yaw, rad, of the rotation about y closest to ``rotation`` (3, 3); see ``geometry.yaw_of``."""
    return np.arctan2(rotation[0, 2] - rotation[2, 0], rotation[0, 0] + rotation[2, 2])


@kernel()
def write_yaw(yaw, rotation):
    """Write the rotation by a yaw, rad, to ``rotation`` (3, 3), or to that of a pose (3, 4)."""
    c, s = np.cos(yaw), np.sin(yaw)
    rotation[0, 0], rotation[0, 1], rotation[0, 2] = c, 0.0, s
    rotation[1, 0], rotation[1, 1], rotation[1, 2] = 0.0, 1.0, 0.0
    rotation[2, 0], rotation[2, 1], rotation[2, 2] = -s, 0.0, c


@kernel()
def levelled(cam_from_map, centre):
    """The level pose (3, 4) nearest to ``cam_from_map`` (3, 4) that leaves the point ``centre`` (3,), m, in place."""
    level, tilt = np.empty((3, 4)), np.empty((3, 3))
    write_yaw(nearest_yaw(cam_from_map), level)
    for a in range(3):
        for b in range(3):
            tilt[a, b] = cam_from_map[a, b] - level[a, b]
    moved = tilt @ centre
    for k in range(3):
        level[k, 3] = cam_from_map[k, 3] + moved[k]
    return level


@kernel()
def turn(step, rotation, turned):
    """Write Exp(w) R to ``turned`` (3, 3), w = ``step[:3]`` in rad, R = ``rotation`` (3, 3).

    By Rodrigues' formula, exact to rounding at zero.
    """
    wx, wy, wz = step[0], step[1], step[2]
    angle = np.sqrt(wx * wx + wy * wy + wz * wz)
    first, second = 1.0, 0.5
    if angle > 1e-8:
        half = np.sin(0.5 * angle) / angle
        first, second = np.sin(angle) / angle, 2.0 * half * half
    for k in range(3):
        x, y, z = rotation[0, k], rotation[1, k], rotation[2, k]
        dx, dy, dz = wy * z - wz * y, wz * x - wx * z, wx * y - wy * x
        turned[0, k] = x + first * dx + second * (wy * dz - wz * dy)
        turned[1, k] = y + first * dy + second * (wz * dx - wx * dz)
        turned[2, k] = z + first * dz + second * (wx * dy - wy * dx)


@kernel()
def robust_weight(square, robust):
    """rho(s) and its derivative, s = ``square`` a squared residual in units of the noise's variance.

    ``robust`` is one of ``ROBUST_*``.
    """
    if robust == ROBUST_HUBER and square > HUBER_WIDTH * HUBER_WIDTH:
        norm = np.sqrt(square)
        return HUBER_WIDTH * (2.0 * norm - HUBER_WIDTH), HUBER_WIDTH / norm
    if robust == ROBUST_CAUCHY:
        share = square / (CAUCHY_WIDTH * CAUCHY_WIDTH)
        return CAUCHY_WIDTH * CAUCHY_WIDTH * np.log1p(share), 1.0 / (1.0 + share)
    return square, 1.0


@kernel()
def normal_equations(matches, chosen, centre, rotation, middle, model, system):
    """The cost at (R, m); write the ``NormalEquations`` of the step (w, d) at zero to ``system``.

    R is ``rotation`` (3, 3), m is ``middle`` (3,), m, where R takes ``centre`` (3,), m, ``model`` a ``CostModel``. Only
    the ``chosen`` (M,) matches count; inf if the point of one of them lies at the camera's centre. ``dof`` of 4 leaves
    w_x and w_z out: theirs are the rows of a unit matrix, so that a step does not change them.
    """
    points, pixel_jacobian = matches.points, matches.pixel_jacobian
    hessian, gradient, robust = system.hessian, system.gradient, model.robust
    r00, r01, r02 = rotation[0, 0], rotation[0, 1], rotation[0, 2]
    r10, r11, r12 = rotation[1, 0], rotation[1, 1], rotation[1, 2]
    r20, r21, r22 = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    precision = (1.0 / model.noise.sd_px) ** 2
    h00 = h01 = h02 = h03 = h04 = h05 = h11 = h12 = h13 = h14 = h15 = 0.0
    h22 = h23 = h24 = h25 = h33 = h34 = h35 = h44 = h45 = h55 = 0.0
    g0 = g1 = g2 = g3 = g4 = g5 = cost = 0.0
    for k in range(len(points)):
        if not chosen[k]:
            continue
        px, py, pz = points[k, 0] - centre[0], points[k, 1] - centre[1], points[k, 2] - centre[2]
        ax, ay, az = r00 * px + r01 * py + r02 * pz, r10 * px + r11 * py + r12 * pz, r20 * px + r21 * py + r22 * pz
        x, y, z = ax + middle[0], ay + middle[1], az + middle[2]
        square = x * x + y * y + z * z
        if not square > 0.0:
            return np.inf
        inverse = 1.0 / np.sqrt(square)
        x, y, z = x * inverse, y * inverse, z * inverse
        u0, u1, u2 = pixel_jacobian[k, 0, 0], pixel_jacobian[k, 0, 1], pixel_jacobian[k, 0, 2]
        v0, v1, v2 = pixel_jacobian[k, 1, 0], pixel_jacobian[k, 1, 1], pixel_jacobian[k, 1, 2]
        ru, rv = u0 * x + u1 * y + u2 * z, v0 * x + v1 * y + v2 * z
        loss, weight = robust_weight((ru * ru + rv * rv) * precision, robust)
        cost += loss
        # By the ray, J = (P - P v' v'^T) / |ray|; a turn moves the ray by w x arm: J^T times K = skew(arm). With
        # A = J^T J the blocks are A, K A and K A K^T, which is fewer products than all six columns' would be.
        u0, u1, u2, v0, v1, v2 = u0 - ru * x, u1 - ru * y, u2 - ru * z, v0 - rv * x, v1 - rv * y, v2 - rv * z
        scale = weight * inverse * inverse
        a33, a34, a35 = scale * (u0 * u0 + v0 * v0), scale * (u0 * u1 + v0 * v1), scale * (u0 * u2 + v0 * v2)
        a44, a45, a55 = scale * (u1 * u1 + v1 * v1), scale * (u1 * u2 + v1 * v2), scale * (u2 * u2 + v2 * v2)
        m03, m04, m05 = ay * a35 - az * a34, ay * a45 - az * a44, ay * a55 - az * a45
        m13, m14, m15 = az * a33 - ax * a35, az * a34 - ax * a45, az * a35 - ax * a55
        m23, m24, m25 = ax * a34 - ay * a33, ax * a44 - ay * a34, ax * a45 - ay * a35
        h33, h34, h35, h44, h45, h55 = h33 + a33, h34 + a34, h35 + a35, h44 + a44, h45 + a45, h55 + a55
        h03, h04, h05, h13, h14, h15 = h03 + m03, h04 + m04, h05 + m05, h13 + m13, h14 + m14, h15 + m15
        h23, h24, h25 = h23 + m23, h24 + m24, h25 + m25
        h00, h01, h02 = h00 + ay * m05 - az * m04, h01 + az * m03 - ax * m05, h02 + ax * m04 - ay * m03
        h11, h12, h22 = h11 + az * m13 - ax * m15, h12 + ax * m14 - ay * m13, h22 + ax * m24 - ay * m23
        scale = weight * inverse
        b0, b1, b2 = scale * (u0 * ru + v0 * rv), scale * (u1 * ru + v1 * rv), scale * (u2 * ru + v2 * rv)
        g0, g1, g2 = g0 + ay * b2 - az * b1, g1 + az * b0 - ax * b2, g2 + ax * b1 - ay * b0
        g3, g4, g5 = g3 + b0, g4 + b1, g5 + b2
    hessian[0, 0], hessian[0, 1], hessian[0, 2], hessian[0, 3], hessian[0, 4], hessian[0, 5] = (
        h00,
        h01,
        h02,
        h03,
        h04,
        h05,
    )
    hessian[1, 1], hessian[1, 2], hessian[1, 3], hessian[1, 4], hessian[1, 5] = h11, h12, h13, h14, h15
    hessian[2, 2], hessian[2, 3], hessian[2, 4], hessian[2, 5] = h22, h23, h24, h25
    hessian[3, 3], hessian[3, 4], hessian[3, 5] = h33, h34, h35
    hessian[4, 4], hessian[4, 5], hessian[5, 5] = h44, h45, h55
    gradient[0], gradient[1], gradient[2], gradient[3], gradient[4], gradient[5] = g0, g1, g2, g3, g4, g5
    for a in range(6):
        gradient[a] *= precision
        for b in range(a, 6):
            hessian[a, b] *= precision
            hessian[b, a] = hessian[a, b]
    if model.dof == 4:
        for k in range(0, 3, 2):
            for a in range(6):
                hessian[k, a] = hessian[a, k] = 0.0
            hessian[k, k], gradient[k] = 1.0, 0.0
        return cost
    return cost + add_gravity(rotation, model.noise.gravity_sd_rad, system)


@kernel()
def tilt_of(rotation):
    """Angle, rad, between the map's down direction, R e_y, and the camera's +y; of a rotation (3, 3) or pose (3, 4)."""
    return np.arctan2(np.hypot(rotation[0, 1], rotation[2, 1]), rotation[1, 1])


@kernel()
def add_gravity(rotation, gravity_sd_rad, system):
    """Cost of the gravity prior at ``rotation`` (3, 3); add its J^T J and J^T r to ``system``, ``NormalEquations``.

    ``gravity_sd_rad`` is the prior's standard deviation. The residual is the tilt's angle times the horizontal
    direction u of R e_y = (u sin, cos), not its sine, which would fold beyond 90 degrees.
    """
    if gravity_sd_rad == np.inf:
        return 0.0
    hessian, gradient = system.hessian, system.gradient
    gx, gy, gz = rotation[0, 1], rotation[1, 1], rotation[2, 1]
    sine = np.sqrt(gx * gx + gz * gz)
    angle = tilt_of(rotation)
    # Level, any direction will do, and upside down none is better.
    ux, uz, stretch = (gx / sine, gz / sine, min(angle / sine, 1e6)) if sine > 0.0 else (1.0, 0.0, 1.0)
    by_x, by_y, by_z = (0.0, gz, -gy), (-gz, 0.0, gx), (gy, -gx, 0.0)  # of w x R e_y
    row = np.empty(3)
    for axis in range(2):
        u, by = (ux, by_x) if axis == 0 else (uz, by_z)
        for a in range(3):
            outward = ux * by_x[a] + uz * by_z[a]
            by_angle = gy * outward - sine * by_y[a]
            row[a] = (u * by_angle + stretch * (by[a] - u * outward)) / gravity_sd_rad
        residual = angle * u / gravity_sd_rad
        for a in range(3):
            gradient[a] += row[a] * residual
            for b in range(3):
                hessian[a, b] += row[a] * row[b]
    return (angle / gravity_sd_rad) ** 2


@kernel()
def factorise(hessian, damping, factor):
    """Write L of S H S + damping I = L L^T, S scaling the columns to length 1; False if there is no full rank.

    H is ``hessian`` (6, 6); L goes to ``factor`` (6, 6), above whose diagonal nothing is written.
    """
    for a in range(6):
        for b in range(a + 1):
            total = hessian[a, b] * scale_of(hessian, a) * scale_of(hessian, b)
            if a == b:
                total += damping
            for k in range(b):
                total -= factor[a, k] * factor[b, k]
            if a > b:
                factor[a, b] = total / factor[b, b]
            elif total > RANK_TOLERANCE:
                factor[a, a] = np.sqrt(total)
            else:
                return False
    return True


@kernel()
def scale_of(hessian, k):
    """What scales column ``k`` of the normal equations ``hessian`` (6, 6) to length 1."""
    return 1.0 / np.sqrt(hessian[k, k]) if hessian[k, k] > 0.0 else 1.0


@kernel()
def solve(system, damping, factor, step):
    """Write the damped ``step`` (6,), -(H + damping diag H)^-1 g, rad and m; False if H has no full rank.

    H and g are those of ``system``, ``NormalEquations``; ``factor`` (6, 6) is written, see ``factorise``.
    """
    hessian, gradient = system.hessian, system.gradient
    if not factorise(hessian, damping, factor):
        return False
    for a in range(6):
        total = -gradient[a] * scale_of(hessian, a)
        for k in range(a):
            total -= factor[a, k] * step[k]
        step[a] = total / factor[a, a]
    for a in range(5, -1, -1):
        total = step[a]
        for k in range(a + 1, 6):
            total -= factor[k, a] * step[k]
        step[a] = total / factor[a, a]
    for a in range(6):
        step[a] *= scale_of(hessian, a)
    return True
