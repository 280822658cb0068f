"""Local features of an image, keypoints and descriptors, at its valid pixels; for a panorama, on virtual faces."""

import io
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import pi, tau
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.faces import Faces, panorama_faces
from spherloc.disk_cache import DAMAGED_NPZ, cache_folder, key_of, make_room_once, store, used
from spherloc.errors import InputError, show
from spherloc.files import read_file
from spherloc.frontend import trained
from spherloc.frontend.feature_kinds import KINDS, Descriptors, detect
from spherloc.frontend.view import View
from spherloc.images import MAX_BYTES
from spherloc.types import BoolArray, ByteArray, FloatArray

VERSION = 7
"""Number to be increased when the same options give other features, so that old files are not used."""


def feature_file(image: Path, usable: BoolArray, options: Any, panorama: bool) -> Path | None:
    """File of the features of an image: named by its content, its usable pixels (H, W) and the options.

    None if a file cannot be read; the error is raised where the file is needed.
    """
    contents = [_content(file) for file in (image, options.weights) if file is not None]
    if any(content is None for content in contents):
        return None
    said = (VERSION, cv2.__version__, options.method, options.most, panorama, usable.shape)
    return cache_folder("features") / f"{key_of(said, np.packbits(usable).tobytes(), *contents)}.npz"


def keep(path: Path, table: FloatArray, descriptors: Descriptors) -> None:
    """Store keypoints (N, 5) and descriptors (N, D)."""
    make_room_once(path.parent)
    content = io.BytesIO()
    np.savez(content, table=table, descriptors=descriptors)
    store(path, content.getvalue())


def fetch(path: Path) -> tuple[FloatArray, Descriptors] | None:
    """The keypoints and descriptors that ``keep`` stored; None if the file is missing or damaged."""
    content = _content(path)
    if content is None:
        return None
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            if archive.testzip() is not None:  # numpy would trust a damaged header
                return None
        with np.load(io.BytesIO(content), allow_pickle=False) as stored:
            table, descriptors = stored["table"], stored["descriptors"]
    except DAMAGED_NPZ:
        return None
    whole = table.dtype == np.float64 and descriptors.dtype in (np.float32, np.uint8) and descriptors.ndim == 2
    if not whole or table.shape != (len(descriptors), 5):
        return None
    used(path)
    return table, descriptors


def _content(path: Path) -> bytes | None:
    try:
        return read_file(path, MAX_BYTES)
    except OSError:
        return None


JOINED = {"sift+aliked": ("sift", "aliked")}
"""Kinds of features that are found each by itself and used together."""
JOINED_NUMBERS = 128
"""Most numbers of a descriptor of one of these kinds."""
METHODS = (*KINDS, *JOINED)
MAX_FEATURES = 50_000
ENOUGH = 4000
"""An image with fewer features gets weaker ones, too, up to this number."""
RIM_PX = 4.0
"""Features this close to unusable pixels (large ones also farther away) show the rim of the image and not the scene."""
MAX_PIXELS = 5_000_000
"""Largest number of pixels for detection; larger images are shrunk, as in COLMAP: SIFT needs 250 bytes a pixel."""
FACE_SHARPNESS = 1.4
"""Pixels at the centre of a panorama's face per pixel of the panorama: a third more right matches than 1.0 gives."""
SAME_FEATURE_PX = 1.0
"""Features of two faces that are closer than this, in pixels of the panorama's horizon, are the same one."""
MAX_FACE_PIXELS = 12_000_000
"""Largest number of pixels of all faces of a panorama together."""


@dataclass(frozen=True)
class FeatureOptions:
    """Which features are detected."""

    method: str = "sift"
    """One of ``METHODS``; SIFT descriptors are root-normalised (RootSIFT)."""
    max_features: int | None = None
    """Number of features of each kind that are kept, the strongest; None takes that of the kind (``Kind.most``)."""
    weights: Path | None = None
    """ONNX file of the learned methods, ALIKED and DISK; ALIKED needs none if the extra ``learned`` is installed."""

    def __post_init__(self) -> None:
        if not isinstance(self.method, str) or self.method not in METHODS:
            raise InputError(f"The features {show(self.method)} are unknown; choose one of {', '.join(METHODS)}.")
        count, kinds = self.max_features, [KINDS[part] for part in self.parts]
        whole = isinstance(count, int) and not isinstance(count, bool)
        if count is not None and not (whole and 1 <= count <= MAX_FEATURES):
            raise InputError(f"max_features is {show(count)}; give a whole number from 1 to {MAX_FEATURES}.")
        if self.weights is None and any(kind.packaged for kind in kinds):
            trained.check_installed(self.method)
        if self.weights is None and any(kind.learned and not kind.packaged for kind in kinds):
            raise InputError(f"{self.method} features need a file of weights; give its ONNX file as weights.")
        if self.weights is not None and not any(kind.learned for kind in kinds):
            raise InputError(f"{self.method} features have no weights; leave weights out, or take aliked or disk.")

    @property
    def parts(self) -> tuple[str, ...]:
        """The kinds of features, more than one if they are joined."""
        return JOINED.get(self.method, (self.method,))

    @property
    def most(self) -> int:
        """Number of features that are kept; of joined ones, of all kinds together."""
        return sum(KINDS[part].most if self.max_features is None else self.max_features for part in self.parts)

    def part(self, kind: str) -> "FeatureOptions":
        """The options of one of the kinds."""
        return FeatureOptions(kind, self.max_features, self.weights if KINDS[kind].learned else None)


@dataclass(frozen=True, eq=False)
class Features:
    """Features of one image, the strongest of a kind first. Read-only arrays of N features."""

    pixels: FloatArray
    """(N, 2), the centre of the first pixel is (0.5, 0.5)."""
    sizes_px: FloatArray
    """(N,) diameter of the described neighbourhood."""
    angles_rad: FloatArray
    """(N,) orientation."""
    scores: FloatArray
    """(N,) the detector's own measure of strength."""
    descriptors: Descriptors
    """(N, D) float32, or uint8 that hold 8 bits each where ``method`` is binary (ORB, AKAZE)."""
    method: str
    image_size: tuple[int, int]
    """(width, height), px."""
    parts: tuple["Features", ...] = ()
    """Of joined kinds, the features of each, which follow one another here; otherwise empty."""

    def __post_init__(self) -> None:
        count = len(self.pixels)
        shapes = (self.sizes_px.shape, self.angles_rad.shape, self.scores.shape)
        if self.pixels.shape != (count, 2) or shapes != ((count,),) * 3 or len(self.descriptors) != count:
            raise ValueError("pixels, sizes, angles, scores and descriptors of features must be of one length")
        for array in (self.pixels, self.sizes_px, self.angles_rad, self.scores, self.descriptors):
            array.setflags(write=False)

    def __len__(self) -> int:
        return len(self.pixels)

    @property
    def strong(self) -> int:
        """Number of features, the first ones, that are no weaker ones, which only images with few features get."""
        return int(np.count_nonzero(self.scores >= KINDS[self.method].strong))


def extract(view: View, options: FeatureOptions | None = None) -> Features:
    """Features of an image, from the cache on disk if they were computed before.

    The same image always gives the same features in the same order. An image without any gives none. Raises
    ``InputError`` if the image, its mask or the weights cannot be read, or if this OpenCV lacks the method.
    """
    options = options or FeatureOptions()
    if len(options.parts) > 1:
        return _joined([extract(view, options.part(kind)) for kind in options.parts], options.method)
    usable = view.usable_pixels()
    panorama = view.camera if isinstance(view.camera, Equirectangular) else None
    path = feature_file(view.path, usable, options, panorama is not None)
    found = fetch(path) if path else None
    if found is None:
        image, allowed = view.read(), usable.astype(np.uint8)
        found = _found(image, allowed, options, panorama)
        few = replace(options, max_features=min(ENOUGH, options.most))
        if len(found[0]) < few.most and KINDS[options.method].weak is not None:
            found = _found(image, allowed, few, panorama, weak=True)
        if path:
            keep(path, *found)
    table, descriptors = found
    pixels, (sizes, angles, scores) = table[:, :2].copy(), table[:, 2:].T.copy()
    size = (view.camera.width, view.camera.height)
    return Features(pixels, sizes, angles, scores, descriptors, options.method, size)


def _joined(parts: Sequence[Features], method: str) -> Features:
    """Features of several kinds as one. Each kind has numbers of its own in the descriptors, zeros elsewhere, so that
    two kinds are never near each other."""
    descriptors = np.zeros((sum(map(len, parts)), JOINED_NUMBERS * len(parts)), np.float32)
    row = 0
    for place, part in enumerate(parts):
        numbers = part.descriptors.shape[1]
        if numbers > JOINED_NUMBERS:
            raise InputError(
                f"{part.method} features of {numbers} numbers cannot be joined with others; take the published weights."
            )
        column = JOINED_NUMBERS * place
        descriptors[row : row + len(part), column : column + numbers] = part.descriptors
        row += len(part)
    pixels, sizes, angles, scores = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("pixels", "sizes_px", "angles_rad", "scores")
    )
    return Features(pixels, sizes, angles, scores, descriptors, method, parts[0].image_size, tuple(parts))


def _found(
    image: ByteArray, usable: ByteArray, options: FeatureOptions, panorama: Equirectangular | None, weak: bool = False
) -> tuple[FloatArray, Descriptors]:
    """Keypoints (N, 5) and descriptors of an image in its own pixels, the strongest first, with ``weak`` also those
    that its kind otherwise leaves out."""
    if panorama is None:
        return _on_image(image, usable, options, weak)
    return _on_faces(image, usable, options, panorama, weak)


def _on_image(
    image: ByteArray, usable: ByteArray, options: FeatureOptions, weak: bool
) -> tuple[FloatArray, Descriptors]:
    """Keypoints (N, 5) and descriptors of an image in its own pixels, the strongest first."""
    height, width = image.shape[:2]
    shrink = min(1.0, (MAX_PIXELS / (width * height)) ** 0.5)
    if shrink < 1.0:
        small = (max(1, round(width * shrink)), max(1, round(height * shrink)))
        image = np.asarray(cv2.resize(image, small, interpolation=cv2.INTER_AREA), np.uint8)
        usable = np.asarray(cv2.resize(usable, small, interpolation=cv2.INTER_NEAREST), np.uint8)
    rows, columns = usable.shape
    table, descriptors = _detected(image, usable, np.ones(usable.shape, bool), options, weak)
    table[:, :3] *= width / columns, height / rows, width / columns
    return _strongest(table, descriptors, options)


def _on_faces(
    image: ByteArray, usable: ByteArray, options: FeatureOptions, panorama: Equirectangular, weak: bool
) -> tuple[FloatArray, Descriptors]:
    """Keypoints (N, 5) and descriptors of a panorama in its own pixels, the strongest first.

    They are found on flat faces, since a panorama stretches things near its poles and cuts things at its seam.
    """
    faces = panorama_faces(panorama, FACE_SHARPNESS, MAX_FACE_PIXELS)
    tables, parts = [], []
    for face in range(len(faces)):
        table, descriptors = _detected(*faces.cut(face, image, usable), options, weak, on_face=True)
        tables.append(_on_panorama(table, faces, face))
        parts.append(descriptors)
    table = np.concatenate(tables)
    descriptors = np.concatenate([part for part in parts if len(part)] or parts[:1])
    face_of = np.repeat(np.arange(len(faces)), [len(one) for one in tables])
    kept = _once(table, face_of, panorama)
    return _strongest(table[kept], descriptors[kept], options)


def _once(table: FloatArray, face_of: NDArray[np.int64], panorama: Equirectangular) -> BoolArray:
    """Mask (N,) that leaves out the weaker one where the same feature was found on two faces; ``face_of`` is (N,)."""
    from scipy.spatial import KDTree  # its import takes a quarter of a second, and only panoramas need it

    kept = np.ones(len(table), bool)
    if len(table) == 0:
        return kept
    bearings, _ = panorama.unproject(table[:, :2])
    pairs = KDTree(bearings).query_pairs(SAME_FEATURE_PX * tau / panorama.width, output_type="ndarray")
    first, second = pairs.T
    growth = np.abs(np.log(table[first, 2] / table[second, 2]))
    turned = np.abs((table[first, 3] - table[second, 3] + pi) % tau - pi)
    same = (face_of[first] != face_of[second]) & (growth < 0.3) & (turned < 0.3)
    weaker = np.where(table[first, 4] < table[second, 4], first, second)
    kept[weaker[same]] = False
    return kept


def _on_panorama(table: FloatArray, faces: Faces, face: int) -> FloatArray:
    """Keypoints (N, 5) of a face in the panorama's pixels, with size and orientation by a step of one face pixel."""
    moved = table.copy()
    turn = np.column_stack([np.cos(table[:, 3]), np.sin(table[:, 3])])
    moved[:, :2], _ = faces.panorama.project(faces.bearings(face, table[:, :2]))
    ends, _ = faces.panorama.project(faces.bearings(face, table[:, :2] + turn))  # a step of one pixel of the face
    width = faces.panorama.width
    step = ends - moved[:, :2]
    step[:, 0] = (step[:, 0] + width / 2) % width - width / 2
    moved[:, 2] *= width / (tau * faces.focal_px)
    moved[:, 3] = np.arctan2(step[:, 1], step[:, 0])
    return moved


def _detected(
    image: ByteArray,
    usable: ByteArray,
    wanted: BoolArray,
    options: FeatureOptions,
    weak: bool,
    on_face: bool = False,
) -> tuple[FloatArray, Descriptors]:
    """Keypoints (N, 5) and descriptors of a flat image, with masks (H, W) of the usable and of the wanted pixels."""
    kind = KINDS[options.method]
    room = _room_px(usable)
    mask = (wanted & (room > RIM_PX)).astype(np.uint8)
    table, descriptors = detect(options.method, image, mask, options.most, options.weights, on_face, weak)
    kept = _usable_rows(table, descriptors, np.where(wanted, room, np.float32(0.0)), kind.reach)
    return table[kept], descriptors[kept]


def _strongest(table: FloatArray, descriptors: Descriptors, options: FeatureOptions) -> tuple[FloatArray, Descriptors]:
    order = np.lexsort([*table.T[[2, 3, 0, 1]], -table[:, 4]])[: options.most]
    return table[order], np.ascontiguousarray(descriptors[order])


def _room_px(usable: ByteArray) -> NDArray[np.float32]:
    """Distances (H, W) to the nearest unusable pixel, px; the border of the image does not count as one."""
    if usable.all():
        return np.full(usable.shape, np.inf, np.float32)
    return np.asarray(cv2.distanceTransform(usable, cv2.DIST_L2, cv2.DIST_MASK_PRECISE), np.float32)


def _usable_rows(table: FloatArray, descriptors: Descriptors, room_px: NDArray[np.float32], reach: float) -> BoolArray:
    """Mask (N,) of the features that are finite, in the image, and far enough from unusable pixels."""
    finite = np.isfinite(table).all(axis=1) & np.isfinite(descriptors).all(axis=1)
    rows, columns = room_px.shape
    u, v = np.floor(np.where(finite, table[:, :2].T, 0.0)).clip(-1, max(rows, columns)).astype(np.int64)
    inside = finite & (u >= 0) & (u < columns) & (v >= 0) & (v < rows)
    u, v = np.where(inside, u, 0), np.where(inside, v, 0)
    return inside & (room_px[v, u] > RIM_PX + reach * np.where(finite, table[:, 2], 0.0))
