"""Gravity and positions of the images of a sequence in the ASL layout (EuRoC, TUM-VI), by IMU and ground truth."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spherloc.datasets.asl import IMU, AslCamera, asl_cameras, body_from, image_times
from spherloc.datasets.asl_layout import MAV, SENSOR, TABLE, AslSequence, asl_sequence
from spherloc.datasets.imu import down_at, read_imu
from spherloc.datasets.query_gravity import time_of
from spherloc.errors import CalibrationError, InputError, shorten
from spherloc.files import is_file
from spherloc.formats.text_rows import finite_numbers, rows
from spherloc.frontend.view import Gravity, View
from spherloc.mapping.advice import advice
from spherloc.mapping.alignment.positions import MAX_GAP_S, MIN_POSITIONS, Positions
from spherloc.mapping.alignment.stated_gravity import BOUND_RAD, StatedGravity, without_words
from spherloc.trajectory import NS_PER_S, Trajectory, pose_at, read_euroc
from spherloc.types import FloatArray

TRUTHS = ("state_groundtruth_estimate0", "mocap0", "vicon0", "leica0")
"""Folders of ground truth, of which the first one that can be used is."""


@dataclass(frozen=True, eq=False)
class SequenceData:
    """What a sequence tells of some of its images."""

    stated: StatedGravity | None = None
    positions: Positions | None = None
    remarks: tuple[str, ...] = ()
    """Which files are used, and why others are not, in sentences."""


def sequence_data(folder: Path, views: Sequence[View], *, gravity: bool = True, positions: bool = True) -> SequenceData:
    """Gravity and positions of ``views``, images of ``folder``, if that is a sequence and they are asked for.

    What cannot be read or tells nothing of the images is not used, as a remark says.
    """
    sequence = asl_sequence(folder)
    if sequence is None:
        return SequenceData()
    shots = shots_of_sequence(sequence, views)
    stated, about_gravity = _gravity(sequence, shots) if gravity else (None, [])
    places, about_positions = _positions(sequence, shots) if positions else (None, [])
    return SequenceData(stated, places, (*about_gravity, *about_positions))


@dataclass(frozen=True, eq=False)
class SequenceShot:
    """An image with its camera."""

    name: str
    camera: str
    time_ns: int | None
    """By the IMU's clock; None if it is not known."""
    calibrated: AslCamera | None
    """None without a calibration in the sequence."""

    @property
    def body_from_camera(self) -> FloatArray | None:
        """(4, 4), metres; None if no file says it."""
        return None if self.calibrated is None else self.calibrated.body_from_camera


def shots_of_sequence(sequence: AslSequence, views: Sequence[View]) -> list[SequenceShot]:
    """The images of a sequence, with their cameras; those of ``views`` that are not in it are left out."""
    cameras = asl_cameras(sequence).by_name
    names = {images.resolve(): name for name, images in sequence.cameras.items()}
    in_table = cache(lambda images: image_times(images).times_ns)
    folders = {folder: folder.resolve() for folder in {view.path.parent for view in views}}
    found = []
    for view in views:
        name = names.get(folders[view.path.parent])
        if name is None:
            continue
        own = cameras.get(name)
        shift_ns = 0 if own is None else round(own.shift_s * NS_PER_S)
        time_ns = time_of(view)
        if time_ns is None:
            time_ns = in_table(view.path.parent).get(view.path.name)
        found.append(SequenceShot(view.name, name, None if time_ns is None else time_ns + shift_ns, own))
    return found


def _gravity(sequence: AslSequence, shots: Sequence[SequenceShot]) -> tuple[StatedGravity | None, list[str]]:
    """Gravity by the log of the IMU, and remarks."""
    log = sequence.sensor(IMU) / TABLE
    if not is_file(log):
        return None, []
    loose = sorted({shot.camera for shot in shots if shot.body_from_camera is None})
    if len(loose) == len({shot.camera for shot in shots}):
        return None, [f"{log}: is not used, as no file says {_fixed(loose)}."]
    try:
        samples, body_from_imu = read_imu(log), body_from(sequence.sensor(IMU))
    except (CalibrationError, InputError) as error:
        return None, [f"{error} It is not used for gravity."]
    timed = [shot for shot in shots if shot.time_ns is not None and shot.body_from_camera is not None]
    down_imu = down_at(samples, np.array([shot.time_ns for shot in timed], np.int64))
    found = {}
    for shot, down in zip(timed, down_imu, strict=True):
        body_from_camera = shot.body_from_camera
        if body_from_camera is not None and np.isfinite(down).all():
            down = body_from_camera[:3, :3].T @ body_from_imu[:3, :3] @ down
            found[shot.name] = Gravity(down / np.linalg.norm(down), "the IMU", BOUND_RAD)
    if not found:
        none = f"{log}: is not used, as it has gravity of none of the {len(shots)} photographs"
        return None, [f"{none}: {_span(shots, samples.timestamps_ns)}."]
    files = {
        sequence.called(shot.calibrated.file) for shot in shots if shot.calibrated is not None and shot.name in found
    }
    places = f"how the cameras are fixed to the IMU is from {_and(sorted(files))}"
    remarks = [f"Gravity is from {sequence.called(log)}; {places}."]
    if loose:
        remarks.append(f"No file says {_fixed(loose)}.")
    remarks += without_words(log, [shot.name for shot in shots if shot.name not in found], len(shots))
    return StatedGravity(found, log, None, (), in_map_folder=True), remarks


def _positions(sequence: AslSequence, shots: Sequence[SequenceShot]) -> tuple[Positions | None, list[str]]:
    """Positions of the cameras by the first ground truth that has enough of them, and remarks."""
    remarks: list[str] = []
    for truth in readable_truths(sequence, remarks):
        found = {}
        for shot in shots:
            pose = truth.pose_at(shot)
            if pose is not None:
                camera = truth.camera_pose_at(shot)
                found[shot.name] = pose[:, 3] if camera is None else camera[:, 3]
        if len(found) < MIN_POSITIONS:
            few = f"it has a position at the time of {len(found)} of {len(shots)} images"
            span = _span(shots, truth.places.poses.timestamps_ns)
            remarks.append(f"{truth.table}: is not used for the scale, as {few}: {span}.")
            continue
        told = (
            f"The scale is from {sequence.called(truth.table)}, with positions of {len(found)} of {len(shots)} images"
        )
        remarks.append(f"{told}; {advice('other positions')}.")
        return Positions(found, f"the trajectory {truth.name}/{TABLE}"), remarks
    return None, remarks


@dataclass(frozen=True, eq=False)
class TimedPlaces:
    """A trajectory, and whether it has rotations."""

    poses: Trajectory
    turned: bool


@dataclass(frozen=True, eq=False)
class SensorTruth:
    """The ground truth of a sensor of a sequence."""

    name: str
    """Folder of the sensor."""
    table: Path
    places: TimedPlaces
    body_from_sensor: FloatArray
    """(4, 4), metres."""

    def pose_at(self, shot: SequenceShot) -> FloatArray | None:
        """``truth_from_sensor`` (3, 4) when an image was taken; None where it is not known."""
        return None if shot.time_ns is None else pose_at(self.places.poses, shot.time_ns, MAX_GAP_S)

    def camera_pose_at(self, shot: SequenceShot) -> FloatArray | None:
        """``truth_from_camera`` (3, 4) of an image; None where it is not known, as without rotations."""
        pose, body_from_camera = self.pose_at(shot), shot.body_from_camera
        if pose is None or body_from_camera is None or not self.places.turned:
            return None
        sensor_from_camera = np.linalg.inv(self.body_from_sensor) @ body_from_camera
        turn = pose[:, :3] @ sensor_from_camera[:3, :3]
        return np.column_stack([turn, pose[:, :3] @ sensor_from_camera[:3, 3] + pose[:, 3]])


def readable_truths(sequence: AslSequence, remarks: list[str]) -> Iterator[SensorTruth]:
    """The ground truths of a sequence, the best first; what is wrong with others is added to ``remarks``."""
    for name in TRUTHS:
        table = sequence.sensor(name) / TABLE
        if not is_file(table):
            continue
        try:
            yield SensorTruth(name, table, read_positions_or_poses(table), body_from(sequence.sensor(name)))
        except (CalibrationError, InputError) as error:
            remarks.append(f"{error} It is not used for the scale.")


def read_positions_or_poses(path: Path) -> TimedPlaces:
    """A ground truth: rows of EuRoC's poses, or ``timestamp [ns], x, y, z`` as a laser tracker measures.

    Raises ``InputError``, one sentence with the file and the line, for any other file.
    """
    first = next(iter(rows(path, "rows of positions")), None)
    if first is None or len(first[1].split(",")) != 4:
        return TimedPlaces(read_euroc(path), True)
    times, places = [], []
    for place, text in rows(path, "rows of positions"):
        words = [word.strip() for word in text.split(",")]
        if len(words) != 4 or not (words[0].isascii() and words[0].isdigit() and len(words[0]) < 20):
            raise InputError(f"{place}: is not a row of timestamp [ns], x, y, z.")
        times.append(int(words[0]))
        places.append(finite_numbers(words[1:], place))
    poses = np.tile(np.eye(3, 4), (len(times), 1, 1))
    poses[:, :, 3] = places
    try:
        return TimedPlaces(Trajectory(np.array(times, np.int64), poses), False)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _span(shots: Sequence[SequenceShot], times_ns: NDArray[np.int64]) -> str:
    """How the times of images and of a log lie to each other, in words."""
    known = [shot.time_ns for shot in shots if shot.time_ns is not None]
    if not known:
        return f"no time of them is known, by {TABLE} or by their names"
    return (
        f"the images are from {min(known) / NS_PER_S:.3f} to {max(known) / NS_PER_S:.3f} s, and it is from "
        f"{int(times_ns[0]) / NS_PER_S:.3f} to {int(times_ns[-1]) / NS_PER_S:.3f} s"
    )


def _and(words: Sequence[str]) -> str:
    *others, last = [shorten(word) for word in words]
    return f"{', '.join(others)} and {last}" if others else last


def _fixed(cameras: Sequence[str]) -> str:
    """What is not known of cameras, and where it could be."""
    are = "are" if len(cameras) > 1 else "is"
    return f"how {_and(cameras)} {are} fixed to the IMU: T_BS in {SENSOR}, or T_cam_imu in a Kalibr chain beside {MAV}"
