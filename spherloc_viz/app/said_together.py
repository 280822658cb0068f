"""What the results of all queries of a scene, which are judged by each other, say of one that is solved by itself."""

from dataclasses import dataclass

import numpy as np

from spherloc.experiments.results import DOUBTFUL, LOCALIZED, QueryResult
from spherloc.geometry import camera_centre, rotation_angle
from spherloc.mapping.scenes.joint_outcome import tried_anew
from spherloc.types import FloatArray


@dataclass(frozen=True)
class SaidTogether:
    """What the results of all queries say of one, which a run of that one does not know."""

    status: str
    """What it is in the results of all queries: "localized" or "doubtful"."""
    why: str
    """The reason, a sentence or two."""


def said_together(row: QueryResult, pose: FloatArray | None, near: tuple[float, float]) -> SaidTogether | None:
    """What the results of all queries say of the one of that row, whose run by itself has this ``pose`` (3, 4).

    A doubt is told if the pose is the doubted one, to ``near`` (degrees, metres); that the query is localized around
    the pose that another one gives is told in any case. None if there is nothing to tell.
    """
    same = pose is not None and row.cam_from_map is not None and _is_near(pose, row.cam_from_map, near)
    if row.doubts and same:
        return SaidTogether(DOUBTFUL, " ".join(row.doubts))
    if row.status == LOCALIZED and tried_anew(row):
        return SaidTogether(LOCALIZED, row.remarks[-1])
    return None


def _is_near(pose: FloatArray, other: FloatArray, near: tuple[float, float]) -> bool:
    turned_deg = np.degrees(rotation_angle(pose[:, :3] @ other[:, :3].T))
    return bool(turned_deg <= near[0] and np.linalg.norm(camera_centre(pose) - camera_centre(other)) <= near[1])
