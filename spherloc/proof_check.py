"""Checks a proof of ``spherloc run --proof FILE`` with nothing but numpy: ``python -m spherloc.proof_check FILE``.

The claim: no pose whose tilt is within the gravity bound explains more than ``claim`` of the matches. A match is
explained by p_cam = R p + t if v . g > 0 and |W g| <= bound_px, g = p_cam / |p_cam|. The proof is a list of cells that
together hold every pose, and a bound for each of them; the geometry is derived in ``spherloc/consensus/pose_cells.py``:

    R = R_x(a) R_z(c) R_y(yaw),   cos a cos c >= cos(gravity bound),   C = middle + scale c / s,   w = s q - c

In chart 0 s = 1 and c is in [-1, 1]^3. In chart 1 + 2 f (2 + 2 f) c_f = 1 (-1), and s, from 0 to 1, has its place.
"""

import sys
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Arrays = dict[str, NDArray[Any]]

SLACK = 1e-12
"""Tolerance for rounding, rad."""
NO_TILT, STABBED, LINEAR = 0, 1, 2


UNREADABLE = (
    *(OSError, EOFError, ValueError, KeyError, IndexError, TypeError, MemoryError, zipfile.BadZipFile, zlib.error),
    np.linalg.LinAlgError,
)
"""Exceptions that reading a file that is not a proof may raise."""


class Refused(Exception):  # noqa: N818
    """The proof does not hold; the message says why."""


def check(path: Path) -> str:
    """The proven statement as a sentence; raises ``Refused`` if the proof does not hold."""
    try:
        with np.load(path, allow_pickle=False) as file:
            proof: Arrays = {name: file[name] for name in file.files}
        return _check(proof)
    except UNREADABLE as error:
        reason = error if isinstance(error, OSError) or zipfile.is_zipfile(path) else "it is no NPZ file"
        raise Refused(f"{path}: not a proof that can be read ({reason}).") from None


def _check(proof: Arrays) -> str:
    bearings, points, weights = proof["bearings"], proof["points"], proof["pixel_from_bearing"]
    claim, limit, count = int(proof["claim"]), float(proof["gravity_bound_rad"]), len(proof["points"])
    bound_px, scale = float(proof["bound_px"]), float(proof["scale"])
    lower, upper, chart, rule = proof["lower"], proof["upper"], proof["chart"], proof["rule"]
    finite = all(np.isfinite(array).all() for array in proof.values())
    cells = len(chart)
    fits = lower.shape == upper.shape == (cells, 6) and rule.shape == proof["bound"].shape == (cells,)
    fits &= bearings.shape == points.shape == (count, 3) and weights.shape == (count, 2, 3)
    if not (finite and fits and scale > 0.0 and bound_px > 0.0 and 0.0 <= limit < np.pi / 2):
        raise Refused("arrays are missing, not finite, or of wrong sizes.")
    stretch = np.linalg.svd(weights, compute_uv=False)
    along = np.abs(np.einsum("nij,nj->n", weights, bearings)).max(initial=0.0)
    if np.abs(np.linalg.norm(bearings, axis=1) - 1.0).max(initial=0.0) > 1e-9 or along > 1e-6 * stretch.max(
        initial=1.0
    ):
        raise Refused("a bearing is not a unit vector, or its residual does not vanish in its own direction.")
    if int(proof["found"]) > max(1, max((_explained(proof, pose) for pose in proof["cam_from_map"]), default=1)):
        raise Refused("the pose explains fewer matches than the file says, or its tilt is beyond the gravity bound.")
    for k in range(7):
        ends = np.array([[-1.0] * 3 + [-np.pi] + [-limit] * 2, [1.0] * 3 + [np.pi] + [limit] * 2])
        if k:
            ends[0, (k - 1) // 2] = 0.0
        mine = chart == k
        _cover(ends[0], ends[1], lower[mine], upper[mine])
    matches = {
        "q": (points - proof["middle"]) / scale,
        "rounding": 3e-16 * (1.0 + (np.abs(points).max() + np.abs(proof["middle"]).max()) / scale),
        "v": bearings,
        "weights": weights,
        "px_per_rad": stretch[:, 0],
        # |W g| <= bound_px allows at most this angle between g and v.
        "angle": np.arcsin(np.minimum(1.0, bound_px / stretch[:, 1])) + SLACK,
        "bound_px": np.array(bound_px),
        "limit": np.array(limit),
    }
    for k in range(cells):
        here = _bound(matches, int(chart[k]), lower[k], upper[k], int(rule[k]))
        if not here <= proof["bound"][k] <= claim:
            raise Refused(f"cell {k} is bounded by {here}; the file says {proof['bound'][k]}, and {claim} in all.")
    found = int(proof["found"])
    gap = "and one explains as many" if found == claim else f"and one explains {found}"
    return f"{cells:,} cells hold every pose: none explains more than {claim} of {count:,} matches, {gap}."


def _explained(proof: Arrays, pose: NDArray[Any]) -> int:
    """Number of matches that a pose (3, 4) explains; 0 if it is not a pose or its tilt is beyond the gravity bound."""
    rotation = pose[:, :3]
    proper = np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-9 and np.linalg.det(rotation) > 0.0
    if not proper or rotation[1, 1] < np.cos(float(proof["gravity_bound_rad"])) - 1e-12:
        return 0
    rays = proof["points"] @ rotation.T + pose[:, 3]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    residual = np.linalg.norm(np.einsum("nij,nj->ni", proof["pixel_from_bearing"], rays), axis=1)
    ahead = np.einsum("ni,ni->n", rays, proof["bearings"]) > 0.0
    return int(np.count_nonzero(ahead & (residual <= float(proof["bound_px"]))))


def _cover(first: NDArray[Any], last: NDArray[Any], lower: NDArray[Any], upper: NDArray[Any]) -> None:
    """Refuse cells that do not cover the whole box: the box is divided at places where no cell is cut, until each part
    is a single cell."""
    waiting = [(first, last, np.arange(len(lower)))]
    while waiting:
        first, last, mine = waiting.pop()
        if np.any((lower[mine] <= first).all(axis=1) & (upper[mine] >= last).all(axis=1)):
            continue
        best = None
        for axis in np.flatnonzero(first < last) if len(mine) > 1 else ():
            order = mine[np.argsort(lower[mine, axis], kind="stable")]
            ends = np.maximum.accumulate(upper[order, axis])
            cuts = np.flatnonzero(ends[:-1] <= lower[order[1:], axis])
            cuts = cuts[(first[axis] < ends[cuts]) & (ends[cuts] < last[axis])]
            if len(cuts):
                cut = cuts[np.argmin(np.abs(cuts - len(mine) // 2))]
                if best is None or abs(cut - len(mine) // 2) < best[0]:
                    best = abs(cut - len(mine) // 2), axis, float(ends[cut]), order[: cut + 1], order[cut + 1 :]
        if best is None:
            raise Refused("the cells leave out some poses.")
        _, axis, at, low, high = best
        left, right = last.copy(), first.copy()
        left[axis] = right[axis] = at
        waiting += [(first, left, low), (right, last, high)]


def _bound(matches: Arrays, chart: int, lower: NDArray[Any], upper: NDArray[Any], rule: int) -> int:
    """Upper bound on the number of matches that a pose of a cell explains."""
    least = np.maximum(np.maximum(lower[4:], -upper[4:]), 0.0)
    limit = float(matches["limit"])
    if rule == NO_TILT:
        return 0 if np.prod(np.cos(least)) < np.cos(limit) else len(matches["q"])
    middle = 0.5 * (lower + upper)
    half = np.maximum(upper - middle, middle - lower)
    c, half_c, s, half_s = middle[:3].copy(), half[:3].copy(), 1.0, 0.0
    if chart:
        f = (chart - 1) // 2
        s, half_s, c[f], half_c[f] = c[f], half_c[f], (1.0 if chart % 2 else -1.0), 0.0
    yaw, a, b = middle[3:]
    tilt = _turn_x(a) @ _turn_z(b)
    w = s * matches["q"] - c
    more = half_s * np.linalg.norm(matches["q"], axis=1) + float(matches["rounding"])
    delta, distance = np.linalg.norm(half_c) + more, np.linalg.norm(w, axis=1)
    if rule == STABBED:
        return _stab(matches, w, (np.hypot(half_c[0], half_c[2]) + more, half_c[1] + more), tilt, half, lower, upper)
    near = delta >= 0.998 * distance
    d, delta = np.where(near, 1.0, distance), np.where(near, 0.0, delta)
    rotation = tilt @ _turn_y(yaw)
    u, turn = w / d[:, None], float(half[4:].sum()) + SLACK  # the tilts'
    linear = matches["weights"] @ rotation
    r = np.einsum("nij,nj->ni", linear, u)
    size = np.linalg.norm(r, axis=1)
    axes = [(np.array([0.0, 1.0, 0.0]), half[3]), (rotation[0], half[4]), (rotation.T @ _turn_x(a)[:, 2], half[5])]
    moves = [h * np.einsum("nij,nj->ni", linear, np.cross(axis, u)) for axis, h in axes]
    ways = [(np.tile(np.eye(3)[k], (len(w), 1)), half_c[k]) for k in range(3)] + [(matches["q"], half_s)]
    for way, h in ways:
        across = way - u * np.einsum("ni,ni->n", way, u)[:, None]
        moves.append(h * np.einsum("nij,nj->ni", linear, across) / d[:, None])
    ratio = delta / d
    e, px = ratio / (1.0 - ratio), matches["px_per_rad"]
    level = np.hypot(u[:, 0], u[:, 2])
    alpha = turn + half[3] * level + np.arcsin(ratio)
    by_yaw = half[3] * np.minimum(level + np.arcsin(ratio), 1.0)
    second = turn**2 + (2.0 * turn + half[3]) * by_yaw + 2.0 * (turn + half[3]) * e + 2.0 / np.sqrt(3.0) * e**2
    rest = px * (0.5 * second + SLACK)
    radial = r / np.maximum(size, 1e-300)[:, None]
    reach = sum(np.abs(np.einsum("ni,ni->n", move, radial)) for move in moves) + rest
    out = size - np.minimum(np.where(size > 0.0, reach, np.inf), px * alpha) > matches["bound_px"]
    along = np.einsum("ni,ni->n", u @ rotation.T, matches["v"])
    out |= (along <= -alpha) | ((along <= 0.0) & (alpha + matches["angle"] < np.pi / 2))
    return int(np.count_nonzero(near | ~out))


def _stab(matches: Arrays, w: NDArray[Any], reach: Any, tilt: Any, half: Any, lower: Any, upper: Any) -> int:
    """Largest number of yaw intervals that cover one yaw of the cell."""
    widest = 2.0 * np.arccos(min(1.0, 0.5 * (1.0 + np.sqrt(np.cos(float(matches["limit"]))))))
    middle = 0.5 * (lower + upper)
    psi = min(float(np.hypot(half[4], half[5])), widest + abs(middle[4]) + abs(middle[5]))
    v = matches["v"] @ tilt
    angle = matches["angle"] + psi + SLACK
    elevation, level = np.arctan2(v[:, 1], np.hypot(v[:, 0], v[:, 2])), np.hypot(v[:, 0], v[:, 2])
    flat, height = np.hypot(w[:, 0], w[:, 2]), w[:, 1]
    near, far = np.maximum(flat - reach[0], 0.0), flat + reach[0]
    top, bottom = height + reach[1], height - reach[1]
    highest, lowest = np.arctan2(top, np.where(top > 0, near, far)), np.arctan2(bottom, np.where(bottom > 0, far, near))
    possible = (highest >= elevation - angle - SLACK) & (lowest <= elevation + angle + SLACK)
    free = possible & ((angle + np.abs(elevation) >= np.pi / 2 - SLACK) | (reach[0] >= flat))
    some = possible & ~free
    width = np.arcsin(np.minimum(1.0, reach[0][some] / flat[some]))
    width += np.arcsin(np.minimum(1.0, np.sin(angle[some]) / level[some])) + SLACK
    centre = np.arctan2(w[some, 2], w[some, 0]) - np.arctan2(v[some, 2], v[some, 0])
    start = np.mod(centre - width - lower[3], 2.0 * np.pi)  # from the cell's first yaw
    span, end = float(upper[3] - lower[3]), start + 2.0 * width
    free_more = int(np.count_nonzero(2.0 * width >= 2.0 * np.pi))
    start, end = start[width < np.pi], end[width < np.pi]
    opens = np.concatenate([np.zeros(np.count_nonzero(end >= 2.0 * np.pi)), start[start <= span]])
    closes = np.concatenate([end[end >= 2.0 * np.pi] - 2.0 * np.pi, end[start <= span]])
    order = np.sort(opens)
    depth = np.searchsorted(order, order, side="right") - np.searchsorted(np.sort(closes), order, side="left")
    return int(np.count_nonzero(free)) + free_more + int(depth.max(initial=0))


def _turn_x(angle: float) -> NDArray[Any]:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def _turn_y(angle: float) -> NDArray[Any]:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def _turn_z(angle: float) -> NDArray[Any]:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


if __name__ == "__main__":
    try:
        print(check(Path(sys.argv[1])))
    except Refused as refused:
        print(f"refused: {refused}", file=sys.stderr)
        sys.exit(1)
