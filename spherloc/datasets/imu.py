"""The direction of gravity from an inertial measurement unit: reads its CSV logs and filters its two sensors.

An accelerometer measures gravity plus the motion's own acceleration, which for a walking person exceeds a metre per
second squared but averages out within seconds. The gyroscope says how the unit turned meanwhile: its turns are
accumulated into a frame that keeps its direction, in which the measured forces are averaged over time. Unlike a filter
that runs forward only, the window is symmetric, so that to first order a constant bias of the gyroscope cancels.
"""

import re
from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from spherloc.errors import InputError, show
from spherloc.formats.text_rows import finite_numbers, rows
from spherloc.trajectory import NS_PER_S
from spherloc.types import FloatArray

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

GRAVITY_M_S2 = 9.81
WINDOW_S = 3.0
"""Standard deviation of the averaging window: some ten steps of a walking person, and a gyroscope's bias of 0.01 rad/s
turns the average by no more than 1.5 degrees at the ends of a recording, where the window has one side only."""
MAX_GAP_S = 0.1
"""A longer gap separates the measurements: how the unit turned in it is not known."""
MIN_S = 1.0
"""Least duration of measurements without a gap from which a direction is computed."""
DISTURBED_M_S2 = 2.0
"""Forces that differ from gravity by this much weigh 0.6 of the others."""
NAME_RULE = "names like 1625133000_123456789.png (seconds_nanoseconds) or 1625133000123456789.png (nanoseconds)"
_SECONDS = re.compile(r"(?:.*\D)?(\d{9,10})_(\d{1,9})", re.ASCII)
_NANOSECONDS = re.compile(r"(?:.*\D)?(\d{18,19})", re.ASCII)
_DEVICE_NS = re.compile(r"(?:^|\D)(\d{12,17})$", re.ASCII)
_DECIMAL_S = re.compile(r"(?:^|[^\d.])(\d{1,10}\.\d{1,9})$", re.ASCII)
"""Times at the ends of names such as camera_87551170813262.png (ns) and 1311868164.363181.png (s)."""
_COLUMNS = "counter,sec,nsec,wx,wy,wz,ax,ay,az or timestamp_ns,wx,wy,wz,ax,ay,az"
_LARGEST_S = 2**33
_LARGEST_RATE_RAD_S = 1000.0
_LARGEST_FORCE_M_S2 = 10_000.0


@dataclass(frozen=True, eq=False)
class ImuSamples:
    """Inertial measurements at growing times, in the unit's own frame."""

    timestamps_ns: NDArray[np.int64]
    """(K,) times, growing."""
    rates_rad_s: FloatArray
    """(K, 3) angular rates of the gyroscope."""
    forces_m_s2: FloatArray
    """(K, 3) specific forces of the accelerometer: acceleration minus gravity, so that they point up at rest."""


def read_imu(path: Path) -> ImuSamples:
    """Reads rows ``counter,sec,nsec,wx,wy,wz,ax,ay,az`` or, as in EuRoC, ``timestamp_ns,wx,wy,wz,ax,ay,az``.

    Rates are in rad/s, accelerations in m/s^2.

    Raises ``InputError``, one sentence with the file and the line, for any other file.
    """
    times, numbers = array("q"), array("d")
    lines = rows(path, f"lines of {_COLUMNS}")
    for place, text in lines:
        words = [word.strip() for word in text.split(",")]
        if len(words) not in (7, 9):
            if times and len(words) < 9 and next(lines, None) is None:
                raise InputError(f"{place}: is the last line and cut off; remove it, or copy the log again.")
            columns = f"{len(words)} column{'' if len(words) == 1 else 's'}"
            raise InputError(f"{place}: has {columns}, separated by commas; give {_COLUMNS}.")
        time_ns = _time_ns(words[:-6], place)
        measured = finite_numbers(words[-6:], place)
        if times and time_ns <= times[-1]:
            raise InputError(f"{place}: its time is not after that of the line before; sort the lines by time.")
        if max(map(abs, measured[:3])) > _LARGEST_RATE_RAD_S or max(map(abs, measured[3:])) > _LARGEST_FORCE_M_S2:
            raise InputError(f"{place}: no rate in rad/s or acceleration in m/s^2 is that large; check the columns.")
        times.append(time_ns)
        numbers.extend(measured)
    if not times:
        raise InputError(f"{path}: holds no measurement; give lines of {_COLUMNS}.")
    table = np.frombuffer(numbers, dtype=np.float64).reshape(-1, 6)
    typical = float(np.median(np.linalg.norm(table[:, 3:], axis=1)))
    if not typical:
        raise InputError(
            f"{path}: its accelerations are 0, and a gyroscope alone cannot tell where down is; give a log with those "
            "of the accelerometer."
        )
    if not 0.8 * GRAVITY_M_S2 <= typical <= 1.25 * GRAVITY_M_S2:
        raise InputError(
            f"{path}: the accelerometer's median is {typical:.3g}, not the {GRAVITY_M_S2} m/s^2 of gravity; "
            "check its unit and the order of the columns."
        )
    return ImuSamples(np.array(times, dtype=np.int64), table[:, :3], table[:, 3:])


def _time_ns(words: Sequence[str], place: str) -> int:
    """Time of a row, ns, from its columns ``timestamp_ns`` or ``counter,sec,nsec``."""
    if len(words) == 1:
        if not (words[0].isdecimal() and words[0].isascii() and len(words[0]) < 20):
            raise InputError(
                f"{place}: {show(words[0])} is not a time in whole nanoseconds; convert it, or check the columns."
            )
        return int(words[0])
    _, sec, nsec = finite_numbers(words, place)
    if not (0 <= sec <= _LARGEST_S and 0 <= nsec < NS_PER_S and sec == int(sec) and nsec == int(nsec)):
        raise InputError(f"{place}: sec {sec:g} and nsec {nsec:g} are not a time; check the order of the columns.")
    return int(sec) * NS_PER_S + int(nsec)


def timestamp_of(name: str) -> int | None:
    """Nanoseconds that an image's name ends with, as <seconds>_<nanoseconds> or as nanoseconds; None for other names.

    Something else may precede: infra1_1583836591_182590976.png. The nanoseconds need not have leading zeros.
    """
    stem = PurePosixPath(name).stem
    if match := _SECONDS.fullmatch(stem):
        return int(match[1]) * NS_PER_S + int(match[2])
    if match := _NANOSECONDS.fullmatch(stem):
        return int(match[1])
    return None


def time_in_name(name: str) -> int | None:
    """When an image was taken, ns, by its name and on any clock: one that starts with the device has few digits.

    None if its name holds no time.
    """
    time_ns = timestamp_of(name)
    if time_ns is not None:
        return time_ns
    stem = PurePosixPath(name).stem
    if match := _DEVICE_NS.search(stem):
        return int(match[1])
    if match := _DECIMAL_S.search(stem):
        return int(Decimal(match[1]) * NS_PER_S)
    return None


def down_at(samples: ImuSamples, timestamps_ns: NDArray[np.int64]) -> FloatArray:
    """Unit vectors (N, 3) pointing down in the unit's frame at the given times (N,).

    NaN before the first and after the last measurement, in gaps longer than ``MAX_GAP_S`` and where there are less
    than ``MIN_S`` of measurements between two gaps.
    """
    down = np.full((len(timestamps_ns), 3), np.nan)
    times_ns = samples.timestamps_ns
    cuts = np.flatnonzero(np.diff(times_ns) > MAX_GAP_S * NS_PER_S) + 1
    for first, end in zip([0, *cuts], [*cuts, len(times_ns)], strict=True):
        piece, first_ns, last_ns = slice(first, end), times_ns[first], times_ns[end - 1]
        asked = np.flatnonzero((timestamps_ns >= first_ns) & (timestamps_ns <= last_ns))
        if len(asked) and last_ns - first_ns >= MIN_S * NS_PER_S:
            times_s = (times_ns[piece] - first_ns) / NS_PER_S
            asked_s = (timestamps_ns[asked] - first_ns) / NS_PER_S
            down[asked] = _down(times_s, samples.rates_rad_s[piece], samples.forces_m_s2[piece], asked_s)
    return down


def why_unknown(samples: ImuSamples, time_ns: int | None) -> str:
    """Why ``down_at`` gives nothing at a time, with what to do: "its time, 12.0 s, is outside of the log, ...".

    ``time_ns`` is None for an image without a time.
    """
    if time_ns is None:
        return f"it has no time, which its name may tell: {NAME_RULE}"
    first_ns, last_ns = samples.timestamps_ns[0], samples.timestamps_ns[-1]
    if not first_ns <= time_ns <= last_ns:
        return (
            f"its time, {_seconds(time_ns)} s, is outside of the log, from {_seconds(first_ns)} to {_seconds(last_ns)} "
            "s; give times on the clock of the log"
        )
    return (
        f"at its time, {_seconds(time_ns)} s, the log has less than {MIN_S:g} s of measurements without a gap; give a "
        "log without gaps"
    )


def _seconds(time_ns: int | np.int64) -> str:
    return f"{int(time_ns) / NS_PER_S:.3f}"


def _down(times_s: FloatArray, rates_rad_s: FloatArray, forces_m_s2: FloatArray, asked_s: FloatArray) -> FloatArray:
    """Down (N, 3) in the unit's frame at times (N,) within one piece (K,) without gaps."""
    from scipy.signal import fftconvolve  # its import takes most of a second
    from scipy.spatial.transform import Rotation

    steps_s = np.diff(times_s)
    turns = Rotation.from_rotvec(steps_s[:, None] * (rates_rad_s[1:] + rates_rad_s[:-1]) / 2.0)
    steady_from_unit = _accumulated(np.vstack([[0.0, 0.0, 0.0, 1.0], turns.as_quat()]))
    # The window counts samples, so each is weighted by the time around it.
    spans_s = np.gradient(times_s)
    disturbance = (np.linalg.norm(forces_m_s2, axis=1) - GRAVITY_M_S2) / DISTURBED_M_S2
    weights = spans_s / (1.0 + disturbance**2)
    width = min(WINDOW_S / float(np.median(steps_s)), float(len(times_s)))
    reach = int(3.0 * width)
    window = np.exp(-0.5 * (np.arange(-reach, reach + 1) / width) ** 2)
    forces = weights[:, None] * steady_from_unit.apply(forces_m_s2)
    # A sum instead of an average: only its direction is asked for, at the ends of the piece too.
    up = fftconvolve(np.pad(forces, ((reach, reach), (0, 0))), window[:, None], mode="valid", axes=0)
    at = np.minimum(np.searchsorted(times_s, asked_s, side="right") - 1, len(times_s) - 1)
    since_s = asked_s - times_s[at]
    unit_at = Rotation.from_quat(steady_from_unit.as_quat()[at]) * Rotation.from_rotvec(
        since_s[:, None] * rates_rad_s[at]
    )
    down = unit_at.inv().apply(-up[at])
    length = np.linalg.norm(down, axis=1, keepdims=True)
    return down / np.where(length > 0.0, length, np.nan)


def _accumulated(quaternions: FloatArray) -> "Rotation":
    """Products of the first k rotations, for every k: pairs, then pairs of pairs, so that numpy does the work."""
    from scipy.spatial.transform import Rotation

    product = Rotation.from_quat(quaternions)
    reach = 1
    while reach < len(quaternions):
        longer = product[:-reach] * product[reach:]
        product = Rotation.concatenate([product[:reach], longer])
        reach *= 2
    return product
