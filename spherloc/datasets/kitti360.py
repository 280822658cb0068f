"""KITTI-360: fisheye images of one drive, localized in another with poses and laser scans (Sec. VI-B.1).

``kind = "kitti360"`` with ``root`` (the dataset's folder), ``reference_sequence``, ``query_sequence`` (numbers) and
``camera`` ("image_02" or "image_03"). Optional: ``reference_frames`` and ``query_frames`` ([first, last], all by
default), ``reference_step`` and ``query_step`` (every n-th usable frame) and ``scans`` (how many neighbouring scans
make up the points of a reference, by default its own).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from spherloc.cameras.base import FloatArray
from spherloc.datasets import scene_file
from spherloc.datasets.kitti360_files import (
    MAX_FRAME,
    Drive,
    Rig,
    frames_in,
    read_poses,
    read_rig,
    read_scan,
    read_timestamps,
    scan_motion,
    unwrapped,
)
from spherloc.datasets.map_scene import MapScene
from spherloc.datasets.map_settings import OPTIONAL, REQUIRED, folder, needed_file, read_settings
from spherloc.errors import InputError, show
from spherloc.frontend.lifting import PointCloudLift
from spherloc.frontend.pipeline import image_matcher
from spherloc.frontend.view import View
from spherloc.geometry import transform

CAMERAS = ("image_02", "image_03")
THRESHOLDS = ((1.0, 0.5), (2.0, 1.0), (5.0, 2.0))
"""Table II."""
GRAVITY_BOUND_DEG = 2.0
"""Roll and pitch are the reference's: a car's differ by slopes and springs, about a degree on the same street."""
GRAVITY_MAP = np.array([0.0, 0.0, -1.0])
"""The world's z axis points up."""
MAX_SCANS = 99


def load(table: dict[str, Any], path: Path) -> MapScene:
    """Read a scene of ``kind = "kitti360"``; images and scans are read when they are needed.

    Raises ``InputError`` for a wrong key and for a missing or damaged file, which it names. Frames that lack an image,
    a pose or a scan are skipped, and the scene's remarks say how many.
    """
    where = str(path)
    own = {"root", "reference_sequence", "query_sequence", "camera"}
    choices = {"reference_frames", "reference_step", "query_frames", "query_step", "scans"}
    scene_file.check_keys(table, REQUIRED | own, OPTIONAL | choices, where)
    settings = read_settings(table, where, GRAVITY_BOUND_DEG, THRESHOLDS)
    if table["camera"] not in CAMERAS:
        raise InputError(f"{where}: camera is {show(table['camera'])}; give one of {', '.join(CAMERAS)}.")
    root = folder(table, "root", path)
    rig = read_rig(root, table["camera"], where)
    mapped, references = _recorded("reference", table, root, where)
    asked, queries = _recorded("query", table, root, where)
    scans, remark = _with_scans(mapped, references, where)
    both = set(scans) & set(queries) if mapped.drive == asked.drive else set()
    if both:
        raise InputError(f"{where}: frame {min(both)} is both query and reference; give other frames or sequences.")
    count = scene_file.integer({"scans": 1} | table, "scans", where, 1, MAX_SCANS)
    reference_views = tuple(
        mapped.view(frame, rig, PointCloudLift(partial(_points, mapped, rig, near), rig.camera, mapped.pose(frame, rig)))
        for frame, near in _neighbours(scans, mapped, count)
    )
    remarks = (*mapped.remarks, *remark, *asked.remarks)
    return MapScene(
        name=settings.name,
        where=where,
        queries=tuple(asked.view(frame, rig, None) for frame in queries),
        references=reference_views,
        matcher=image_matcher(reference_views, settings.frontend, where, path.parent),
        gravity_map=GRAVITY_MAP,
        gravity_bound_rad=settings.gravity_bound_rad,
        gravity_sd_rad=settings.gravity_sd_rad,
        bound_px=settings.bound_px,
        thresholds=settings.thresholds,
        remarks=remarks,
    )
