"""Fits of a level pose: yaw and camera position, by Gauss-Newton on weighted residuals in pixels.

A level pose is ``here``, five numbers: cos and sin of the yaw and the camera position in the aligned map frame,
metres. A step is four: a yaw, and a shift of the camera in its own axes.
"""

import numba
import numpy as np

LEAST_PIVOT = 1e-10
"""Of normal equations, relative to the diagonal, below which the pose is not determined."""


@numba.njit(cache=True, nogil=True)
def place(yaw, translation, here):
    """Write the level pose of a yaw and a translation (3,)."""
    c, s = np.cos(yaw), np.sin(yaw)
    here[0], here[1] = c, s
    here[2] = s * translation[2] - c * translation[0]
    here[3] = -translation[1]
    here[4] = -s * translation[0] - c * translation[2]


@numba.njit(cache=True, nogil=True)
def translation_of(here, translation):
    """Write the translation (3,) of a level pose."""
    c, s, x, y, z = here
    translation[0], translation[1], translation[2] = -(c * x + s * z), -y, s * x - c * z


@numba.njit(cache=True, nogil=True, inline="always")
def ray(point, here):
    """The unit vector to a point in camera axes, and its distance."""
    dx, dy, dz = point[0] - here[2], point[1] - here[3], point[2] - here[4]
    distance = max(np.sqrt(dx * dx + dy * dy + dz * dz), 1e-12)
    return (here[0] * dx + here[1] * dz) / distance, dy / distance, (here[0] * dz - here[1] * dx) / distance, distance


@numba.njit(cache=True, nogil=True, inline="always")
def slope_of(weight, gx, gy, gz, distance):
    """A residual, one of two, of a ray, and its derivative by the four numbers of a step."""
    wx, wy, wz = weight[0], weight[1], weight[2]
    r = wx * gx + wy * gy + wz * gz
    return r, wx * gz - wz * gx, (r * gx - wx) / distance, (r * gy - wy) / distance, (r * gz - wz) / distance


@numba.njit(cache=True, nogil=True, inline="always")
def accumulate(normal, slope, used, r, by_yaw, by_x, by_y, by_z):
    """Add a weighted residual to the normal equations (lower triangle)."""
    row = (by_yaw, by_x, by_y, by_z)
    for a in range(4):
        slope[a] += used * row[a] * r
        for b in range(a + 1):
            normal[a, b] += used * row[a] * row[b]


@numba.njit(cache=True, nogil=True)
def fit(points, weights, heavy, here, steps):
    """Move ``here`` by Gauss-Newton steps on the residuals (M, 2) weighted by ``heavy`` (M,); stop if degenerate."""
    normal, slope, step = np.empty((4, 4)), np.empty(4), np.empty(4)
    for _ in range(steps):
        normal[:] = 0.0
        slope[:] = 0.0
        for k in range(len(points)):
            if heavy[k] == 0.0:
                continue
            gx, gy, gz, distance = ray(points[k], here)
            for axis in range(2):
                r, by_yaw, by_x, by_y, by_z = slope_of(weights[k, axis], gx, gy, gz, distance)
                accumulate(normal, slope, heavy[k], r, by_yaw, by_x, by_y, by_z)
        if solve_step(normal, slope, step) < 0.0:
            return
        move(here, step)


@numba.njit(cache=True, nogil=True)
def solve_step(normal, slope, step):
    """Write the step of the normal equations, which become their Cholesky factor; return the fall of the cost, or -1.

    -1 means that they are degenerate.
    """
    fall = 0.0
    for a in range(4):
        pivot = normal[a, a]
        for b in range(a):
            for d in range(b):
                normal[a, b] -= normal[a, d] * normal[b, d]
            normal[a, b] /= normal[b, b]
            normal[a, a] -= normal[a, b] ** 2
        if not normal[a, a] > LEAST_PIVOT * pivot:
            return -1.0
        normal[a, a] = np.sqrt(normal[a, a])
        step[a] = -slope[a]
        for b in range(a):
            step[a] -= normal[a, b] * step[b]
        step[a] /= normal[a, a]
        fall += step[a] ** 2
    for a in range(3, -1, -1):
        for b in range(a + 1, 4):
            step[a] -= normal[b, a] * step[b]
        step[a] /= normal[a, a]
    return fall


@numba.njit(cache=True, nogil=True)
def move(here, step):
    """Turn and move a level pose by a step."""
    c, s = here[0], here[1]
    here[2] += c * step[1] - s * step[3]
    here[3] += step[2]
    here[4] += s * step[1] + c * step[3]
    here[0], here[1] = c * np.cos(step[0]) - s * np.sin(step[0]), s * np.cos(step[0]) + c * np.sin(step[0])
