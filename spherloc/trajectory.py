"""Trajectories: timed poses of a body (a camera, an IMU), read from TUM, EuRoC and Newer College files.

Times are whole nanoseconds: a double of seconds since 1970 resolves no more than a quarter of a microsecond.
"""

import os
from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from math import hypot, isfinite
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from spherloc.errors import InputError, reason, show
from spherloc.files import open_file, reading
from spherloc.types import FloatArray

NS_PER_S = 1_000_000_000

MAX_FILE_BYTES = 1 << 30
"""Largest file, 1 GiB: more than a day of poses at 100 Hz."""
_MAX_LINE_BYTES = 4096
_LARGEST_NS = 2**62
"""Largest time, about 146 years: beyond any clock, and differences still fit into 64 bits."""
_LARGEST_M = 1e9
"""Largest coordinate of a position, 25 times around the Earth: beyond it a double does not resolve millimetres."""
_LENGTH_TOLERANCE = 0.05
"""Largest difference of a quaternion's length from 1: with two digits it is this large, with wrong columns larger."""


@dataclass(frozen=True)
class Trajectory:
    """Poses of a body at strictly growing times."""

    timestamps_ns: NDArray[np.int64]
    """(K,) nanoseconds, growing."""
    map_from_body: FloatArray
    """(K, 3, 4) poses [R | t] in metres: p_map = R p_body + t."""

    def __post_init__(self) -> None:
        times, poses = np.asarray(self.timestamps_ns), np.asarray(self.map_from_body, dtype=np.float64)
        if times.ndim != 1 or times.dtype.kind not in "iu":
            raise InputError("timestamps_ns must be whole nanoseconds of shape (K,): give an array of integers.")
        if poses.shape != (len(times), 3, 4) or not np.isfinite(poses).all():
            raise InputError(f"map_from_body must be finite and of shape ({len(times)}, 3, 4): give one pose a time.")
        if (np.diff(times) <= 0).any():
            raise InputError("timestamps_ns must grow: sort the poses by time and leave out doubled ones.")
        object.__setattr__(self, "timestamps_ns", times.astype(np.int64, copy=False))
        object.__setattr__(self, "map_from_body", poses)

    def __len__(self) -> int:
        return len(self.timestamps_ns)

    @property
    def timestamps_s(self) -> FloatArray:
        """(K,) seconds, rounded to a double."""
        return self.timestamps_ns / NS_PER_S


def rotation_from_wxyz(wxyz: FloatArray) -> FloatArray:
    """Rotations (..., 3, 3) of quaternions (..., 4), w first, of any length but zero.

    Raises ``InputError`` for a wrong shape, NaN, infinity and a quaternion of length zero.
    """
    q = np.asarray(wxyz, dtype=np.float64)
    largest = np.abs(q).max(axis=-1, keepdims=True) if q.ndim and q.shape[-1] == 4 else np.zeros(1)
    if not ((largest > 0.0) & np.isfinite(largest)).all():
        raise InputError(f"the quaternion {show(q.tolist())} is not a rotation: give four finite numbers, not all 0.")
    q = q / largest  # so that no square over- or underflows
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def wxyz_from_rotation(rotation: FloatArray) -> FloatArray:
    """Unit quaternions (..., 4), w first and not negative, of rotations (..., 3, 3)."""
    r = np.asarray(rotation, dtype=np.float64)
    xx, yy, zz = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    wx, wy, wz = r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]
    xy, xz, yz = r[..., 0, 1] + r[..., 1, 0], r[..., 0, 2] + r[..., 2, 0], r[..., 1, 2] + r[..., 2, 1]
    # Each row of 4 q q^T is the quaternion times one of its entries; the row of the largest entry loses no digits.
    outer = [
        [1.0 + xx + yy + zz, wx, wy, wz],
        [wx, 1.0 + xx - yy - zz, xy, xz],
        [wy, xy, 1.0 - xx + yy - zz, yz],
        [wz, xz, yz, 1.0 - xx - yy + zz],
    ]
    candidates = np.stack([np.stack(row, axis=-1) for row in outer], axis=-2)
    best = np.argmax(np.diagonal(candidates, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(candidates, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., :1] < 0.0, -q, q)


def pose_at(trajectory: Trajectory, timestamp_ns: int, max_gap_s: float) -> FloatArray | None:
    """``map_from_body`` (3, 4) at a time, between its two neighbours: straight in position, slerp in rotation.

    None before the first and after the last pose, and where the neighbours are more than ``max_gap_s`` apart. At the
    time of a pose it is that pose.
    """
    times, poses = trajectory.timestamps_ns, trajectory.map_from_body
    after = int(np.searchsorted(times, timestamp_ns))
    if after == len(times):
        return None
    if times[after] == timestamp_ns:
        return poses[after].copy()
    gap_ns = int(times[after]) - int(times[after - 1])
    if after == 0 or gap_ns > max_gap_s * NS_PER_S:
        return None
    share = (timestamp_ns - int(times[after - 1])) / gap_ns
    start, end = poses[after - 1], poses[after]
    rotation = rotation_from_wxyz(_slerp(wxyz_from_rotation(start[:, :3]), wxyz_from_rotation(end[:, :3]), share))
    return np.column_stack([rotation, start[:, 3] + share * (end[:, 3] - start[:, 3])])


def read_tum(path: str | Path, unit: Literal["s", "ns"] = "s") -> Trajectory:
    """A TUM trajectory: rows ``t tx ty tz qx qy qz qw``, separated by spaces or commas; ``unit`` is that of ``t``.

    Raises ``InputError``, one sentence with the file and the line, for any other file.
    """
    unit_ns = NS_PER_S if unit == "s" else 1
    return _read(Path(path), _Layout("t tx ty tz qx qy qz qw", (8,), lambda words: _nanoseconds(words[0], unit_ns)))


def read_euroc(path: str | Path) -> Trajectory:
    """A EuRoC ground truth: rows ``timestamp [ns], x, y, z, qw, qx, qy, qz``, and optionally velocity and two biases.

    Raises ``InputError``, one sentence with the file and the line, for any other file.
    """
    columns = "timestamp [ns], x, y, z, qw, qx, qy, qz"
    return _read(Path(path), _Layout(columns, (8, 17), lambda words: _nanoseconds(words[0], 1), w_first=True))


def read_newer_college(path: str | Path) -> Trajectory:
    """A Newer College ground truth: rows ``sec,nsec,x,y,z,qx,qy,qz,qw``.

    Raises ``InputError``, one sentence with the file and the line, for any other file.
    """
    columns = "sec,nsec,x,y,z,qx,qy,qz,qw"
    return _read(Path(path), _Layout(columns, (9,), _seconds_and_nanoseconds, time_columns=2))


def write_tum(path: str | Path, trajectory: Trajectory) -> None:
    """Write ``t tx ty tz qx qy qz qw``, seconds with nine decimals and numbers that read back as they are.

    Raises ``InputError`` if the file cannot be written.
    """
    rows = ["# timestamp tx ty tz qx qy qz qw"]
    quaternions = wxyz_from_rotation(trajectory.map_from_body[:, :, :3]).tolist()
    positions = trajectory.map_from_body[:, :, 3].tolist()
    for time_ns, position, (w, *xyz) in zip(trajectory.timestamps_ns.tolist(), positions, quaternions, strict=True):
        seconds, rest = divmod(abs(time_ns), NS_PER_S)
        time = f"{'-' if time_ns < 0 else ''}{seconds}.{rest:09d}"
        rows.append(" ".join([time, *map(repr, [*position, *xyz, w])]))
    try:
        Path(path).write_text("\n".join(rows) + "\n", encoding="ascii")
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); choose a writable place.") from None


def _slerp(start: FloatArray, end: FloatArray, share: float) -> FloatArray:
    """The quaternion (4,) at ``share`` (0 to 1) of the shorter rotation from ``start`` to ``end``, both of unit
    length."""
    if start @ end < 0.0:
        end = -end
    # Half the angle between them by the chord: exact for small angles, where the dot product is 1 to rounding.
    angle = 2.0 * np.arctan2(np.linalg.norm(end - start), np.linalg.norm(end + start))
    # sin(a x) / sin(a) by sinc, which is smooth at zero
    weights = np.array([1.0 - share, share])
    weights *= np.sinc(weights * angle / np.pi) / np.sinc(angle / np.pi)
    return weights[0] * start + weights[1] * end


@dataclass(frozen=True)
class _Layout:
    """Layout of a row: the time, three numbers of the position, four of the quaternion, optionally others."""

    columns: str
    """Names of the columns, for messages."""
    counts: tuple[int, ...]
    """Allowed numbers of columns."""
    time_ns: Callable[[list[str]], int]
    """The time of a row; raises ``InputError``."""
    time_columns: int = 1
    w_first: bool = False


def _read(path: Path, layout: _Layout) -> Trajectory:
    times, numbers = array("q"), array("d")
    count = 0
    for line, words in _rows(path):
        try:
            if len(words) not in layout.counts or len(words) != (count or len(words)):
                raise InputError(f"has {len(words)} columns; give {layout.columns} in every line.")
            time_ns = layout.time_ns(words)
            if times and time_ns <= times[-1]:
                raise InputError("its time is not after the one before; sort the lines and remove doubled ones.")
            numbers.extend(_pose(words[layout.time_columns : layout.time_columns + 7]))
        except InputError as error:
            raise InputError(f"{path}, line {line}: {error}") from None
        times.append(time_ns)
        count = len(words)
    if not times:
        raise InputError(f"{path}: holds no pose; give lines of {layout.columns}.")
    rows = np.frombuffer(numbers, dtype=np.float64).reshape(-1, 7)
    quaternions = rows[:, 3:] if layout.w_first else rows[:, [6, 3, 4, 5]]
    poses = np.concatenate([rotation_from_wxyz(quaternions), rows[:, :3, None]], axis=2)
    return Trajectory(np.array(times, dtype=np.int64), poses)


def _rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Line numbers and words of the lines that are neither empty nor comments."""
    with reading(path, "give the path of a trajectory"), open_file(path) as file:
        if os.fstat(file.fileno()).st_size > MAX_FILE_BYTES:
            raise InputError(f"{path}: larger than {MAX_FILE_BYTES >> 20} MiB, too large for a trajectory; split it.")
        for line, content in enumerate(iter(lambda: file.readline(_MAX_LINE_BYTES), b""), start=1):
            words = _words(content.removeprefix(b"\xef\xbb\xbf"), f"{path}, line {line}")
            if words:
                yield line, words


def _words(content: bytes, place: str) -> list[str]:
    """The words of a line between spaces and commas; none for an empty line and a comment."""
    if len(content) == _MAX_LINE_BYTES:
        raise InputError(f"{place}: is longer than {_MAX_LINE_BYTES} bytes; give one pose a line.")
    if content.lstrip().startswith(b"#"):
        return []
    # Python accepts underscores in numbers, these files do not.
    if not content.isascii() or b"_" in content:
        raise InputError(f"{place}: holds characters that are not part of a number; start comments with #.")
    return content.decode("ascii").replace(",", " ").split()


def _pose(words: list[str]) -> list[float]:
    """Position and quaternion, seven finite numbers."""
    try:
        numbers = [float(word) for word in words]
    except ValueError as error:
        raise InputError(f"{reason(error)}; give numbers, and start comments with #.") from None
    if not all(map(isfinite, numbers)):
        raise InputError("holds a number that is not finite; correct or remove the line.")
    if max(map(abs, numbers[:3])) > _LARGEST_M:
        raise InputError(f"the position is farther than {_LARGEST_M:g} m away; check the order of the columns.")
    length = hypot(*numbers[3:])
    if abs(length - 1.0) > _LENGTH_TOLERANCE:
        raise InputError(f"the quaternion has the length {length:.3g} instead of 1; check the order of the columns.")
    return numbers


def _nanoseconds(word: str, unit_ns: int) -> int:
    """A time in units of ``unit_ns``, exactly, as a whole number of nanoseconds."""
    try:
        time = Decimal(word)
    except InvalidOperation:
        raise InputError(f"the time is {show(word)}, not a number; correct it, and start comments with #.") from None
    largest = _LARGEST_NS // unit_ns
    if not time.is_finite() or not -largest <= time <= largest:
        hint = "seconds" if unit_ns == NS_PER_S else "nanoseconds"
        raise InputError(f"the time {show(word)} is not a time in {hint}; check its unit.")
    return round(time * unit_ns)


def _seconds_and_nanoseconds(words: list[str]) -> int:
    rest_ns = _nanoseconds(words[1], 1)
    if not 0 <= rest_ns < NS_PER_S:
        raise InputError(f"nsec is {show(words[1])}; give nanoseconds from 0 to 999999999.")
    return _nanoseconds(words[0], NS_PER_S) + rest_ns
