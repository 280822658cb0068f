"""Which images of a recording are mapped: the sharpest of each stretch of a video or of an image sequence."""

import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import pairwise
from math import log
from pathlib import Path, PurePosixPath

import cv2
import numpy as np

from spherloc.datasets.given_path import VIDEOS, known_as
from spherloc.errors import InputError
from spherloc.files import is_file, is_image, write_whole
from spherloc.images import grey, read_reduced
from spherloc.mapping.advice import advice
from spherloc.mapping.parallel import Tell, as_completed
from spherloc.mapping.rig import SHARE_TOGETHER, Key, camera_and_key, taken_together
from spherloc.trajectory import NS_PER_S
from spherloc.types import ByteArray

MAX_IMAGES = 500
"""Largest number of images of a map: the features of each take 4 MB."""
FRAMES = 40
"""Number of images of a camera that are chosen if the user gives none."""
FFMPEG_LEVEL = "OPENCV_FFMPEG_LOGLEVEL"
"""Environment variable of OpenCV: how much FFmpeg prints."""
MAX_WHOLE, MAX_STEP_S = 100, 0.5
"""A camera that took more than ``MAX_WHOLE`` images, by the times in their names one every ``MAX_STEP_S`` seconds or
more often (median), recorded a sequence, of which images are chosen."""
WHOLE = 0.9
"""Smallest share of the frames that a whole video has of those that it says to have, which may be an estimate."""
SHARPNESS_PX = 512
"""Images are scaled to this longer side before their sharpness is compared."""
MAX_COMPARED = 20
"""Largest number of images of a stretch of an image sequence whose sharpness is compared, spread over it."""
GOLDEN = 0.618034
"""They are this share of the stretch apart, modulo its length: no rhythm of steps and shakes is in step with that."""


@dataclass(frozen=True)
class ImageFolder:
    """A folder with images of one camera, or all images of a map."""

    inside: str
    """Its path in the folder of the map; empty for that itself."""
    camera: str
    """The name of the camera; empty for the folder of the map itself."""
    names: tuple[str, ...]
    """Names of its images, and of its other files."""
    times_ns: Mapping[str, int] = field(default_factory=dict)
    """When its images were taken, as a table says, by name."""

    def name_of(self, image: str) -> str:
        """The name of an image in the map."""
        return (PurePosixPath(self.inside) / image).as_posix()


@dataclass(frozen=True)
class FrameChoice:
    """How images are chosen where there are many."""

    frames: int | None = None
    """Number of images of a camera; None for ``FRAMES`` where there are too many."""
    mapped: frozenset[Path] = frozenset()
    """Resolved paths of the images of the map in which others are to be localized; these are not chosen."""
    tell: Tell = lambda *_: None


_Moment = tuple[str, ...]
"""Names of the images that cameras took together."""


def chosen(
    root: Path, folders: Sequence[ImageFolder], choice: FrameChoice
) -> tuple[tuple[ImageFolder, ...], tuple[str, ...]]:
    """The folders with those images alone that are mapped (or localized), and a remark on the others.

    All are, unless they are more than ``MAX_IMAGES`` or a recorded sequence, or ``choice`` says how many. Then the
    sharpest of each of that many stretches is taken, of equal numbers of images, and of cameras that took their images
    together those of the same times.
    """
    images = [one.name_of(name) for one in folders for name in one.names if is_image(name)]
    names = images
    if choice.mapped:
        names = [name for name in images if (root / name).resolve() not in choice.mapped] or images
    asked = choice.frames is not None and (not choice.mapped or len(names) < len(images))
    cameras = _cameras(folders, set(names))
    many = len(images) > MAX_IMAGES or any(_is_recorded(keys) for keys in cameras.values())
    if not many and not asked:
        return tuple(folders), ()
    count = choice.frames or min(FRAMES, max(1, MAX_IMAGES // len(cameras)))
    moments = _moments(cameras)
    if all(len(some) <= count for some in moments):
        taken = names
    else:
        paths = {name: root / name for name in names}
        stretches = [stretch for some in moments for stretch in _stretches(some, count)]
        best: dict[int, _Moment] = {}
        for place, moment in as_completed(lambda k: _sharpest_moment(stretches[k], paths), range(len(stretches))):
            best[place] = moment
            choice.tell("stretches of the sequence searched for sharp images", len(best), len(stretches))
        taken = [name for moment in best.values() for name in moment]
    if len(taken) == len(images):
        return tuple(folders), ()
    keep = set(taken)
    left = tuple(
        replace(one, names=tuple(name for name in one.names if not is_image(name) or one.name_of(name) in keep))
        for one in folders
    )
    return left, (_about(len(taken), len(images), cameras, moments, choice),)


def _cameras(folders: Sequence[ImageFolder], names: Collection[str]) -> dict[str, dict[str, Key]]:
    """By camera, the key of each image by name, in their order."""
    found: dict[str, dict[str, Key]] = {}
    for folder in folders:
        keys: dict[str, dict[str, Key]] = {}
        for own in filter(is_image, folder.names):
            if (name := folder.name_of(own)) in names:
                camera, key = camera_and_key(name, folder.times_ns.get(own))
                keys.setdefault(folder.camera or camera, {})[name] = key
        if not folder.camera and len(taken_together(keys)) < SHARE_TOGETHER * sum(map(len, keys.values())):
            keys = {"": {name: key for some in keys.values() for name, key in some.items()}}  # of one camera
        found |= keys
    return {camera: _in_order(keys) for camera, keys in found.items()}


def _in_order(keys: Mapping[str, Key]) -> dict[str, Key]:
    """By time or, where that is not known, by name."""
    times = all(key.is_time for key in keys.values())
    return dict(sorted(keys.items(), key=lambda item: (item[1].number if times else 0.0, item[0])))


def _is_recorded(keys: Mapping[str, Key]) -> bool:
    """Whether a camera recorded a sequence, by the times of its images."""
    if len(keys) <= MAX_WHOLE or not all(key.is_time for key in keys.values()):
        return False
    step_ns = np.median(np.diff([key.number for key in keys.values()]))
    return bool(0.0 < step_ns <= MAX_STEP_S * NS_PER_S)


def _moments(cameras: Mapping[str, Mapping[str, Key]]) -> list[list[_Moment]]:
    """The moments at which images were taken, in their order: those of all cameras that took them together, and those
    of each other one."""
    shots = taken_together(cameras)
    together: dict[int, list[str]] = {}
    for name, (_, step) in shots.items():
        together.setdefault(step, []).append(name)
    found = [[tuple(together[step]) for step in sorted(together)]] if together else []
    joined = {camera for camera, _ in shots.values()}
    return found + [[(name,) for name in keys] for camera, keys in cameras.items() if camera not in joined]


def _stretches(moments: Sequence[_Moment], count: int) -> Iterator[list[_Moment]]:
    """The moments in ``count`` stretches of equal numbers, or one a moment if there are fewer; of each stretch those of
    the most cameras, and ``MAX_COMPARED`` of these at most."""
    edges = np.linspace(0, len(moments), min(count, len(moments)) + 1).round().astype(int).tolist()
    for first, end in pairwise(edges):
        most = max(len(moment) for moment in moments[first:end])
        full = [moment for moment in moments[first:end] if len(moment) == most]
        if len(full) > MAX_COMPARED:
            full = [full[int((k * GOLDEN) % 1.0 * len(full))] for k in range(1, MAX_COMPARED + 1)]
        yield full


def _sharpest_moment(stretch: Sequence[_Moment], paths: Mapping[str, Path]) -> _Moment:
    """The moment whose images are the sharpest, by the product; damaged ones are chosen last."""
    if len(stretch) == 1:
        return stretch[0]
    return max(stretch, key=lambda moment: sum(_log_sharpness(paths[name]) for name in moment))


def _log_sharpness(path: Path) -> float:
    try:
        return log(_sharpness(read_reduced(path, SHARPNESS_PX)) + 1e-9)
    except InputError:
        return -1e9


def _about(
    taken: int, there: int, cameras: Mapping[str, object], moments: Sequence[Sequence[_Moment]], choice: FrameChoice
) -> str:
    """Which images are taken, and how to take more."""
    together = any(len(moment) > 1 for some in moments for moment in some)
    which = f", of {len(cameras)} cameras at the same times" if together else ""
    more = advice("more images")
    if choice.mapped:
        sharpest = "the sharpest of each stretch that are not in the map"
        return f"{taken:,} of {there:,} images are localized{which}, {sharpest}; {more}."
    return f"{taken:,} of {there:,} images are mapped{which}, the sharpest of each stretch; {more}."


def frames_of(video: Path, folder: Path, count: int, advance: Callable[[str], None]) -> list[str]:
    """Write ``count`` frames of a video, or all if it has no more, into ``folder``, which is made, and return a remark
    if it ends early.

    The video is divided into equal pieces, of which the sharpest frame each is written. ``advance`` is called after
    each frame with its file name. Existing frames are not written again. Raises ``InputError`` if the video cannot be
    read or the folder cannot be written.
    """
    other = "" if video.suffix.lower() in VIDEOS else known_as(video)
    if not is_file(video):
        raise InputError(other or f"{video}: is not a file; give a video.")
    with _without_lines_of_ffmpeg():
        reader = cv2.VideoCapture(str(video))
    total = int(reader.get(cv2.CAP_PROP_FRAME_COUNT)) if reader.isOpened() else 0
    if total <= 0:
        cannot = f"{video}: OpenCV cannot read it as a video; convert it, to MP4 with H.264 for instance."
        raise InputError(other or cannot)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror}); give another folder.") from None
    written = read = 0
    for number, frame, end in _sharpest(reader, min(count, total), total):
        name = f"frame_{number:06d}.jpg"
        path = folder / name
        if not is_file(path):
            done, content = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, 95])
            try:
                write_whole(path, content.tobytes() if done else b"")
            except OSError as error:
                raise InputError(f"{path}: cannot be written ({error.strerror}); give another folder.") from None
        written, read = written + 1, end
        advance(name)
    if not written:
        raise InputError(f"{video}: OpenCV can read none of its {total:,} frames; copy it again, or convert it.")
    if read >= WHOLE * total:
        return []
    return [
        f"{video}: only the first {read:,} of its {total:,} frames can be read, of which {written:,} were taken; copy "
        "it again, or convert it, to have frames of the rest."
    ]


@contextmanager
def _without_lines_of_ffmpeg() -> Iterator[None]:
    """Where a first video is opened, keep FFmpeg from printing lines of its own, unless the user's environment sets how
    much it prints."""
    if FFMPEG_LEVEL in os.environ:
        yield
        return
    os.environ[FFMPEG_LEVEL] = "-8"  # FFmpeg's AV_LOG_QUIET; OpenCV reads it once
    try:
        yield
    finally:
        os.environ.pop(FFMPEG_LEVEL, None)


def _sharpest(reader: cv2.VideoCapture, pieces: int, total: int) -> Iterator[tuple[int, ByteArray, int]]:
    """Number and pixels of the sharpest frame of each piece, ``pieces`` of ``total`` frames, and how many were read
    until then."""
    best: tuple[float, int, ByteArray] | None = None
    number = piece = 0
    while True:
        there, frame = reader.read()
        before, piece = piece, number * pieces // total
        if best is not None and (not there or piece != before):
            yield best[1], best[2], number
            best = None
        if not there:
            return
        sharpness = _sharpness(np.asarray(frame, np.uint8))
        if best is None or sharpness > best[0]:
            best = sharpness, number, np.asarray(frame, np.uint8)
        number += 1


def _sharpness(frame: ByteArray) -> float:
    """Variance of the Laplacian at ``SHARPNESS_PX``."""
    scale = min(1.0, SHARPNESS_PX / max(frame.shape[:2]))
    small = cv2.resize(grey(frame), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(small, cv2.CV_32F).var())
