"""Cells of poses: how every camera pose is in one of finitely many boxes, and what is proven about a box.

**Poses.** A pose within the gravity bound gamma is R = R_x(a) R_z(c) R_y(yaw) with a camera position C. As
R_z(c) e_y = (-sin c, cos c, 0) and R_x(a) turns that to (-sin c, cos a cos c, sin a cos c), R e_y is within gamma of
e_y exactly if cos a cos c >= cos gamma, so that |a|, |c| <= gamma. And every such pose has this form: a and c follow
from R e_y (gamma < 90 degrees), and what then is left of R keeps e_y.

**Positions.** With a middle m and a scale D let q_i = (p_i - m) / D and C = m + D c / s, so that p_i is seen along
w_i = s q_i - c. Chart 0 has s = 1 and |c|_inf <= 1: a cube. Chart 1 + 2 f (2 + 2 f) has c_f = 1 (-1), the other two in
[-1, 1], and s from 0 to 1 in the place of c_f: all positions outside the cube, and at s = 0 those infinitely far away,
where all directions merge. So the seven charts are boxes of three parameters each that hold every position, and w_i is
linear in the parameters.

**Cells.** A cell is a chart and a box of (three parameters, yaw, a, c). In it w_i moves from its middle by at most
delta_i = |h_c| + h_s |q_i|: h_c are the half sides of the cell's parts of c, h_s that of s. With d_i = |w_i| in the
middle, the direction w_i / |w_i| turns by at most asin(delta_i / d_i), and T = R_x(a) R_z(c) by at most
psi = |(h_a, h_c)|: T(middle)^T T is a product of turns by h_a and h_c about orthogonal axes, cos(psi / 2) =
cos(h_a / 2) cos(h_c / 2). Over all tilts, from no tilt, cos(psi / 2) >= (1 + sqrt(cos gamma)) / 2: the product of
cos^2(a / 2) cos^2(c / 2) = (1 + cos a)(1 + cos c) / 4 is least where cos a = cos c.

**The residual** of a correspondence is r = W g, g = R u, u = w / |w|; it is explained if |r| <= tau and v . g > 0.
Along a straight line of parameters from the middle u moves by e = delta / (d - delta) at most, for w' = D with part p
across and q along w makes |u'| = p / |w|, and |u''| = p sqrt(p^2 + 4 q^2) / |w|^2, which is largest,
(2 / sqrt 3) |D|^2 / |w|^2, at p^2 = 2/3 |D|^2. A tilt turns all directions, t = h_a + h_c; yaw moves u by h_yaw times
its horizontal length only, at most y = h_yaw (l + asin(delta / d)), l being that length in the middle. Each of these
speeds enters g' once and g'' twice, so that

    |g''| <= t^2 + 2 t y + h_yaw y + 2 (t + h_yaw) e + (2 / sqrt 3) e^2,

the third term for the acceleration on a circle of yaw. Over the cell r differs from its linear form by at most
|W| / 2 times that (remainder) and, without any derivative, from r in the middle by at most
|W| (t + h_yaw l + asin(delta / d)). W is the matrix ``pixel_from_bearing`` and |W| its larger singular value,
``pixels_per_radian``.

**Rounding.** ``SLACK`` is added to every angle, and to delta what the coordinates' own rounding may be: some 10^5 times
the rounding of the few operations between them and a comparison.
"""

from typing import NamedTuple

import numpy as np

from spherloc.kernel_cache import kernel
from spherloc.problem import AlignedProblem
from spherloc.types import FloatArray

CHARTS = 7
YAW, TILT_A, TILT_C = 3, 4, 5
AXES = 6
"""Parameters of a cell: three of position, then these."""
SLACK = 1e-10
"""Rad, added to angles against rounding."""
COORDINATE_ROUNDING = 4e-16
"""Relative rounding of coordinates, with a reserve."""
SCALE_SHARE = 0.9
"""Share of the points that the scale looks at: a few far away must not make the cube large."""

Q, Q_NORM, BEARING, LEVEL, SINE, COSINE, LEVEL_COSINE, BOUND_RAD = 0, 3, 4, 7, 8, 9, 10, 11
JACOBIAN, BOUND_PX, PX_PER_RAD, WIDTH = 12, 18, 19, 20
"""Columns of ``PackedMatches.rows``; q, bearing and pixel Jacobian are 3, 3 and 6 columns."""
S, C, HALF_S, HALF_C, HALF_C_NORM, HALF_C_FLAT, ANGLES, HALF_ANGLES, CELL_SIZE = 0, 1, 4, 5, 8, 9, 10, 13, 16
"""Where the numbers of a cell are in an array (CELL_SIZE,), see ``place_cell``; c and the angles are 3 numbers each."""


class PackedMatches(NamedTuple):
    """What the search looks at, M correspondences."""

    rows: FloatArray
    """(M, WIDTH): q, |q|, bearing v, its horizontal length l, sine and cosine of the angle that tau allows, l times the
    cosine of asin(sine / l), that angle, W by rows, tau (px), |W| (px/rad)."""
    rounding: float
    """What coordinates q may be off by rounding."""
    least_cosine: float
    """cos gamma."""
    widest_turn: float
    """Largest turn psi of a tilt within the gravity bound, from no tilt."""
    middle: FloatArray
    """m (3,), metres."""
    scale: float
    """D, metres."""


def pack_matches(aligned: AlignedProblem, bound_px: float) -> PackedMatches:
    """The correspondences with the noise bound alone (the tilt of a cell is what gravity's bound allows)."""
    points = aligned.points
    middle = np.median(points, axis=0)
    reach = np.abs(points - middle).max(axis=1)
    scale = 2.0 * float(np.quantile(reach, SCALE_SHARE))
    if not scale > 0.0:
        scale = max(2.0 * float(reach.max()), 1e-9 * max(1.0, float(np.abs(middle).max())))
    rows = np.empty((len(points), WIDTH))
    rows[:, Q : Q + 3] = (points - middle) / scale
    rows[:, Q_NORM] = np.linalg.norm(rows[:, Q : Q + 3], axis=1)
    rows[:, BEARING : BEARING + 3] = aligned.bearings
    rows[:, JACOBIAN : JACOBIAN + 6] = aligned.pixel_from_bearing.reshape(-1, 6)
    rows[:, BOUND_PX] = bound_px
    rows[:, PX_PER_RAD] = aligned.pixels_per_radian
    angle = np.arcsin(np.minimum(1.0, bound_px * aligned.radians_per_pixel)) + SLACK
    level, sine = np.hypot(aligned.bearings[:, 0], aligned.bearings[:, 2]), np.sin(angle)
    rows[:, BOUND_RAD], rows[:, LEVEL], rows[:, SINE], rows[:, COSINE] = angle, level, sine, np.cos(angle)
    rows[:, LEVEL_COSINE] = np.sqrt(np.maximum(level - sine, 0.0) * (level + sine))
    gamma = aligned.gravity_bound_rad
    return PackedMatches(
        rows=rows,
        rounding=COORDINATE_ROUNDING * (float(np.abs(points).max()) + float(np.abs(middle).max())) / scale + 1e-15,
        least_cosine=float(np.cos(gamma)),
        widest_turn=float(2.0 * np.arccos(0.5 * (1.0 + np.sqrt(np.cos(gamma))))) + SLACK if gamma > 0.0 else 0.0,
        middle=middle,
        scale=scale,
    )


def whole_domain(gravity_bound_rad: float) -> tuple[FloatArray, FloatArray]:
    """Lower and upper ends (7, 6) of the boxes of the seven charts: together they hold every pose."""
    lower, upper = np.full((CHARTS, AXES), -1.0), np.full((CHARTS, AXES), 1.0)
    for chart in range(1, CHARTS):
        lower[chart, (chart - 1) // 2] = 0.0
    lower[:, YAW], upper[:, YAW] = -np.pi, np.pi
    lower[:, TILT_A:], upper[:, TILT_A:] = -gravity_bound_rad, gravity_bound_rad
    return lower, upper


def pose_of(matches: PackedMatches, chart: int, at: FloatArray) -> FloatArray:
    """The pose (3, 4) between the aligned frames of a chart's parameters (6,)."""
    turn = np.empty((3, 3))
    rotation_of(at[YAW], at[TILT_A], at[TILT_C], turn)
    scale, c = _homogeneous(chart, at)
    centre = matches.middle + matches.scale * c / scale
    return np.column_stack([turn, -turn @ centre])


def parameters_of(matches: PackedMatches, cam_from_map: FloatArray) -> tuple[int, FloatArray]:
    """Chart and parameters (6,) of a pose (3, 4) between the aligned frames."""
    rotation = cam_from_map[:, :3]
    at = np.zeros(AXES)
    down = rotation[:, 1]
    at[TILT_A], at[TILT_C] = np.arctan2(down[2], down[1]), -np.arcsin(np.clip(down[0], -1.0, 1.0))
    tilt = np.empty((3, 3))
    rotation_of(0.0, at[TILT_A], at[TILT_C], tilt)
    level = tilt.T @ rotation
    at[YAW] = np.arctan2(level[0, 2] - level[2, 0], level[0, 0] + level[2, 2])
    c = (-rotation.T @ cam_from_map[:, 3] - matches.middle) / matches.scale
    axis = int(np.argmax(np.abs(c)))
    if abs(c[axis]) <= 1.0:
        at[:3] = c
        return 0, at
    at[:3] = c / abs(c[axis])
    at[axis] = 1.0 / abs(c[axis])
    return 1 + 2 * axis + (1 if c[axis] < 0.0 else 0), at


def _homogeneous(chart: int, at: FloatArray) -> tuple[float, FloatArray]:
    """s and c (3,) of a chart's parameters."""
    c = at[:3].copy()
    if chart == 0:
        return 1.0, c
    axis = (chart - 1) // 2
    scale = float(c[axis])
    c[axis] = 1.0 if chart % 2 else -1.0
    return scale, c


@kernel()
def rotation_of(yaw, a, c, out):
    """Write R_x(a) R_z(c) R_y(yaw) to ``out`` (3, 3); angles in rad."""
    cy, sy, ca, sa, cc, sc = np.cos(yaw), np.sin(yaw), np.cos(a), np.sin(a), np.cos(c), np.sin(c)
    out[0, 0], out[0, 1], out[0, 2] = cc * cy, -sc, cc * sy
    out[1, 0], out[1, 1], out[1, 2] = ca * sc * cy + sa * sy, ca * cc, ca * sc * sy - sa * cy
    out[2, 0], out[2, 1], out[2, 2] = sa * sc * cy - ca * sy, sa * cc, sa * sc * sy + ca * cy


@kernel()
def has_tilt(matches, lower, upper):
    """Whether some tilt of a cell is within the gravity bound of ``matches``, ``PackedMatches``.

    The cell's ends are ``lower`` (6,) and ``upper`` (6,).
    """
    a = max(lower[TILT_A], -upper[TILT_A], 0.0)
    c = max(lower[TILT_C], -upper[TILT_C], 0.0)
    return np.cos(a) * np.cos(c) >= matches.least_cosine - 1e-15


@kernel()
def place_cell(chart, lower, upper, cell):
    """Write what bounds need of a cell of a chart, ends ``lower`` (6,) and ``upper`` (6,), to ``cell`` (CELL_SIZE,).

    Middle of s, of c (3,), half sides of s, of c (3,), |h_c| and its horizontal part, then middles and half sides of
    yaw, a, c, rad.
    """
    axis = (chart - 1) // 2 if chart > 0 else -1
    cell[S], cell[HALF_S] = 1.0, 0.0
    for k in range(3):
        middle = 0.5 * (lower[k] + upper[k])
        half = max(upper[k] - middle, middle - lower[k])
        if k == axis:
            cell[S], cell[HALF_S] = middle, half
            cell[C + k], cell[HALF_C + k] = (1.0 if chart % 2 == 1 else -1.0), 0.0
        else:
            cell[C + k], cell[HALF_C + k] = middle, half
    flat = cell[HALF_C] * cell[HALF_C] + cell[HALF_C + 2] * cell[HALF_C + 2]
    cell[HALF_C_NORM], cell[HALF_C_FLAT] = np.sqrt(flat + cell[HALF_C + 1] * cell[HALF_C + 1]), np.sqrt(flat)
    for k in range(3):
        middle = 0.5 * (lower[3 + k] + upper[3 + k])
        cell[ANGLES + k] = middle
        cell[HALF_ANGLES + k] = max(upper[3 + k] - middle, middle - lower[3 + k])
