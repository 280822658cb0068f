"""Finds the pairs of correspondences that agree at one yaw, without computing their yaw arcs.

A pair agrees at a yaw that lies in one of its arcs (``spherloc.consensus.yaw_arcs``): |f| <= tau and depths that may be
positive, with the bounds of ``spherloc.consensus.pair_arcs``. At a fixed yaw all of these are products of bearings v
and turned points q, so that many pairs are matrix products: with the moments m = q x v, f = m_i . v_j + v_i . m_j
(Eq. 22: two rays meet if that is 0).
"""

from dataclasses import dataclass

import numpy as np

from spherloc.consensus.pair_sinusoids import chord
from spherloc.consensus.yaw_arcs import yaw_arcs
from spherloc.geometry import yaw_rotation
from spherloc.problem import AlignedProblem
from spherloc.types import BoolArray, FloatArray, IntArray

BLOCK = 24
"""Number of partners whose arcs with one match are computed in one call, which also computes those between partners."""


def agreement(
    aligned: AlignedProblem, bound_rad: FloatArray, yaw_rad: float, rows: IntArray, columns: IntArray
) -> BoolArray:
    """Mask (R, C): whether each pair of correspondences of ``aligned`` agrees at a yaw; false for one with itself.

    ``bound_rad`` (M,) bounds the angular error of each bearing. A pair that does not restrict yaw agrees at every yaw.
    """
    v, turned = aligned.bearings, aligned.points @ yaw_rotation(yaw_rad).T
    moments, along = np.cross(turned, v), np.einsum("ni,ni->n", v, turned)
    vi, vj = v[rows], v[columns]
    dot = vi @ vj.T
    sine2 = np.maximum(1.0 - dot * dot, 0.0)
    sine = np.sqrt(sine2)
    f = moments[rows] @ vj.T + vi @ moments[columns].T
    along_i = along[rows][:, None] - vi @ turned[columns].T
    along_j = turned[rows] @ vj.T - along[columns]
    chords, sines = chord(bound_rad), np.sin(bound_rad)
    with np.errstate(divide="ignore", invalid="ignore"):
        share_i, share_j = chords[rows][:, None] / sine, chords[columns] / sine
        depth_i, depth_j = (along_i - dot * along_j) / sine2, (dot * along_i - along_j) / sine2
        scale = 1.0 / (1.0 - share_i - share_j)
        most_i = scale * ((1.0 - share_j) * depth_i + share_j * depth_j)
        most_j = scale * ((1.0 - share_i) * depth_j + share_i * depth_i)
        tau = sine * (sines[rows][:, None] * most_i + sines[columns] * most_j)
        agrees = (np.abs(f) <= tau) & (most_i >= 0.0) & (most_j >= 0.0)
    agrees |= unbounded(aligned, bound_rad, rows, columns)
    return agrees & (rows[:, None] != columns)


def unbounded(aligned: AlignedProblem, bound_rad: FloatArray, rows: IntArray, columns: IntArray) -> BoolArray:
    """Mask (R, C): whether a pair does not restrict yaw, since its bearings or points are too close for the bounds."""
    dot = aligned.bearings[rows] @ aligned.bearings[columns].T
    chords = chord(bound_rad)
    close = np.sqrt(np.maximum(1.0 - dot * dot, 0.0)) <= chords[rows][:, None] + chords[columns]
    return close | (aligned.points[rows][:, None] == aligned.points[columns]).all(axis=2)


@dataclass(frozen=True, eq=False)
class PartnerArcs:
    """The yaw arcs of one correspondence with K others. A arcs."""

    count: int
    """Number of the others, K."""
    partners: IntArray
    """(A,) the other correspondence of each arc, 0 to K - 1."""
    middle_rad: FloatArray
    """(A,) middles of the arcs."""
    half_rad: FloatArray
    """(A,) half widths of the arcs."""

    def missed_rad(self, yaw_rad: float) -> FloatArray:
        """Distances (K,), rad, of a yaw from the nearest arc with each other one: 0 in an arc, inf without an arc."""
        missed = np.full(self.count, np.inf)
        off = np.abs((yaw_rad - self.middle_rad + np.pi) % (2.0 * np.pi) - np.pi)
        np.minimum.at(missed, self.partners, np.maximum(off - self.half_rad, 0.0))
        return missed


def partner_arcs(aligned: AlignedProblem, bound_rad: FloatArray, one: int, others: IntArray) -> PartnerArcs:
    """The arcs of the pairs of correspondence ``one`` with ``others`` (K,), indices in ``aligned``."""
    partners, ends = [np.empty(0, np.int64)], [np.empty((2, 0))]
    for start in range(0, len(others), BLOCK):
        places = np.append(one, others[start : start + BLOCK])
        bounds = bound_rad[places]
        bounds.setflags(write=False)  # compiled kernels are made for read-only arrays
        pairs, lo, hi = yaw_arcs(subset(aligned, places), bounds)
        own = pairs[:, 0] == 0
        partners.append(start + pairs[own, 1] - 1)
        ends.append(np.stack([lo[own], hi[own]]))
    lo, hi = np.concatenate(ends, axis=1)
    return PartnerArcs(len(others), np.concatenate(partners), 0.5 * (lo + hi), 0.5 * (hi - lo))


def subset(aligned: AlignedProblem, places: IntArray) -> AlignedProblem:
    """The problem with only the correspondences of these indices."""
    return AlignedProblem(
        index=aligned.index[places],
        count=aligned.count,
        bearings=aligned.bearings[places],
        points=aligned.points[places],
        pixel_from_bearing=aligned.pixel_from_bearing[places],
        radians_per_pixel=aligned.radians_per_pixel[places],
        camera_turn=aligned.camera_turn,
        map_turn=aligned.map_turn,
        gravity_bound_rad=aligned.gravity_bound_rad,
        gravity_sd_rad=aligned.gravity_sd_rad,
    )
