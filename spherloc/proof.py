"""Writes the proof of a run's certificate, that no pose explains more matches, to a file that ``proof_check``
verifies."""

from pathlib import Path

import numpy as np

from spherloc.bounds import bounds_of
from spherloc.consensus.pose_cells import AXES, CHARTS, pack_matches, whole_domain
from spherloc.consensus.positions import SWITCH_RAD
from spherloc.consensus.proof_cells import prove_cells
from spherloc.consensus.stabbing import scratch_for
from spherloc.consensus.yaw_bins import BINS
from spherloc.errors import InputError
from spherloc.trace import ConsensusStage, Trace
from spherloc.watch import Watch

MAX_CELLS = 2_000_000
MAX_FOR_PROOF = 5000
"""Largest number of correspondences for which a proof is written: the checker tests all of them in every cell."""


def write_proof(trace: Trace, path: Path, watch: Watch | None = None) -> int:
    """Write the proof of a run's upper bound to an .npz file; returns its number of cells.

    Raises ``InputError`` for a run without certificate, with more than ``MAX_FOR_PROOF`` usable correspondences, or
    whose bound does not follow from cells.
    """
    problem, certificate, stage = trace.problem, trace.certificate, trace.stage(ConsensusStage)
    if certificate is None or stage is None:
        raise InputError(f"{trace.estimator} proves nothing; run mc-exact to have a proof.")
    aligned = problem.aligned
    count = len(aligned.bearings)
    if count > MAX_FOR_PROOF:
        raise InputError(f"a proof has up to {MAX_FOR_PROOF:,} correspondences, not {count:,}; thin them.")
    watch = watch or Watch()
    bound_px = bounds_of(aligned, trace.options.bound_px).noise_px
    matches, claim = pack_matches(aligned, bound_px), certificate.upper_bound
    room = (np.empty((MAX_CELLS, AXES)), np.empty((MAX_CELLS, AXES)), np.empty((MAX_CELLS, 2), np.int64))
    memory = (scratch_for(count), np.full(BINS, count, np.int32))
    lowers, uppers = whole_domain(aligned.gravity_bound_rad)
    parts, used = [], 0
    for chart in range(CHARTS):
        rest = (room[0][used:], room[1][used:], room[2][used:])
        made = prove_cells(matches, chart, (lowers[chart], uppers[chart]), claim, SWITCH_RAD, memory, rest, watch.board)
        watch.check()
        if made == -1:
            raise InputError(f"the proof of at most {claim} needs more than {MAX_CELLS:,} cells; none is written.")
        if made < 0:
            raise InputError(
                f"that no pose explains more than {claim} follows from pairs of correspondences, or to within rounding "
                "only, and not from cells; no proof is written."
            )
        parts.append(np.full(made, chart, np.int8))
        used += made
    poses = [aligned.align_pose(pose) for pose in stage.cam_from_map[:1]]
    with path.open("wb") as file:
        np.savez_compressed(
            file,
            bearings=aligned.bearings,
            points=aligned.points,
            pixel_from_bearing=aligned.pixel_from_bearing,
            bound_px=bound_px,
            gravity_bound_rad=aligned.gravity_bound_rad,
            middle=matches.middle,
            scale=matches.scale,
            claim=claim,
            found=int(stage.support[0]) if poses else 1,
            cam_from_map=np.array(poses).reshape(-1, 3, 4),
            chart=np.concatenate(parts),
            lower=room[0][:used],
            upper=room[1][:used],
            rule=room[2][:used, 0].astype(np.int8),
            bound=room[2][:used, 1].astype(np.int32),
        )
    return used
