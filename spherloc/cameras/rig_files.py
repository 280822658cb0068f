"""How the cameras of a calibration file are fixed to each other: Kalibr, Basalt, a JSON of cameras by name, and
WoodScape's JSONs, which have one camera each and the same body."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from spherloc.cameras._checks import located
from spherloc.cameras._files import numbers_of, parse_json, parse_yaml, read_text, table_of
from spherloc.cameras.json_files import named_cameras
from spherloc.cameras.tool_files import KalibrCamera, basalt_names, chain_tables, kalibr_chain, rigid
from spherloc.cameras.woodscape_files import is_woodscape, rigid_of, vehicle_from_camera, woodscape_name
from spherloc.errors import CalibrationError
from spherloc.types import FloatArray

BODY_FROM_CAMERA = ("T_device_camera", "T_body_camera", "T_imu_cam", "T_BS")
"""Keys of such a transform in a JSON of cameras by name: the body is a device, such as glasses, or an IMU."""


@dataclass(frozen=True, eq=False)
class RigCalibration:
    """How cameras are fixed to a body: an IMU, a device, a car or one of the cameras."""

    body_from_camera: Mapping[str, FloatArray] = field(default_factory=dict)
    """(4, 4), metres, by the name of the camera in the file; of those of which the file states it."""
    of_imu: bool = False
    """Whether the body is the IMU."""
    shifts_s: Mapping[str, float] = field(default_factory=dict)
    """What is added to a camera's time to get the same moment by the IMU's clock, by name, where the file states it."""


def read_rig(path: Path) -> RigCalibration:
    """How the cameras of a file are fixed to each other; none of them if it is of a kind that does not say so.

    Raises ``CalibrationError``, naming the file and the camera, if it cannot be read or states no rigid transform.
    """
    with located(str(path)):
        text = read_text(path)
        if not text.lstrip().startswith("{"):
            return _of_chain(text)
        document = parse_json(text)
        if is_woodscape(document):
            placed = vehicle_from_camera(document)
            return RigCalibration({} if placed is None else {woodscape_name(document): placed})
        names = basalt_names(document)
        if names:
            return _of_basalt(document, names)
        found = {}
        for name, table in named_cameras(document).items():
            with located(name):
                transforms = (rigid(table, key) for key in BODY_FROM_CAMERA)
                stated = next((one for one in transforms if one is not None), None)
                if stated is not None:
                    found[name] = stated
        return RigCalibration(found)


def _of_chain(text: str) -> RigCalibration:
    """The cameras of a Kalibr chain, fixed to the IMU or, without one, to the first of them."""
    try:
        document = parse_yaml(text)
    except CalibrationError:  # a TOML, or the text of another tool
        return RigCalibration()
    if not chain_tables(document):
        return RigCalibration()
    chain = kalibr_chain(document)
    from_imu = _along(chain, None)
    of_first = _along(chain, np.eye(4)) if not from_imu and len(chain) > 1 else {}
    found = {name: np.asarray(np.linalg.inv(there), np.float64) for name, there in (from_imu or of_first).items()}
    return RigCalibration(found, bool(from_imu), {name: one.timeshift_s for name, one in chain.items()})


def _along(chain: Mapping[str, KalibrCamera], first: FloatArray | None) -> dict[str, FloatArray]:
    """Transforms (4, 4) from the IMU to the cameras that state it, or that follow one of which it is known; with
    ``first`` (4, 4), those from a body to which the first camera is fixed so."""
    found: dict[str, FloatArray] = {}
    before: FloatArray | None = None
    for number, (name, one) in enumerate(chain.items()):
        here = one.cam_from_imu
        if here is None and number == 0:
            here = first
        elif here is None and before is not None and one.cam_from_previous is not None:
            here = one.cam_from_previous @ before
        if here is not None:
            found[name] = here
        before = here
    return found


def _of_basalt(document: Any, names: tuple[str, ...]) -> RigCalibration:
    """The cameras of a Basalt JSON, whose ``T_imu_cam`` is a position and a quaternion each."""
    stated = table_of(document["value0"]).get("T_imu_cam")
    if stated is None:
        return RigCalibration()
    if not isinstance(stated, list) or len(stated) != len(names):
        raise CalibrationError(f"key 'T_imu_cam' must be a list with an entry a camera, {len(names)}.")
    found = {}
    for name, entry in zip(names, stated, strict=True):
        with located(f"T_imu_cam of {name}"):
            px, py, pz, *quaternion = numbers_of(table_of(entry), "px", "py", "pz", "qx", "qy", "qz", "qw")
            found[name] = rigid_of(tuple(quaternion), (px, py, pz))
    return RigCalibration(found, True)
