"""Reads hloc's files: features and matches in HDF5, and text lists of pairs, queries and results.

An image's name is its group in features.h5, nested at every "/". hloc's pixels have the centre of the top-left one at
(0, 0); here 0.5 is added. ``matches0`` of a pair of images has for each keypoint of the first its match in the second,
or -1. Nothing here follows links between files or opens a pickle.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spherloc.cameras.base import Camera
from spherloc.cameras.colmap_models import camera_from_colmap
from spherloc.errors import CalibrationError, InputError, reason, show
from spherloc.formats.text_rows import finite_numbers, pose_from_words, refuse_pickle, rows
from spherloc.registry import require
from spherloc.types import FloatArray, IntArray

MAX_BYTES = 1 << 28
"""Largest size of one array: 16 million keypoints."""
MAX_TOTAL_BYTES = 1 << 30
"""Largest size of all global descriptors together."""

_LARGEST_PX = 1e6
"""Largest coordinate of a keypoint, beyond any image; the comparison refuses NaN and infinity too."""


def read_queries(path: Path) -> tuple[dict[str, Camera], list[str]]:
    """Cameras by query from lines ``name MODEL width height parameters...``, and remarks on those skipped.

    Raises ``InputError`` with the line that is wrong.
    """
    cameras: dict[str, Camera] = {}
    named: set[str] = set()
    skipped = []
    what = "name MODEL width height parameters"
    for place, text in rows(path, what):
        name, *words = text.split()
        if name in named or len(words) < 3:
            fault = "is there twice; name it once" if name in named else f"has too few values; give {what}"
            raise InputError(f"{place}: the query {show(name)} {fault}.")
        named.add(name)
        width, height, *parameters = finite_numbers(words[1:], place)
        if not (width.is_integer() and height.is_integer()):
            raise InputError(f"{place}: an image of {width:g} x {height:g} pixels; give whole numbers.")
        try:
            cameras[name] = camera_from_colmap(words[0], int(width), int(height), tuple(parameters), place)
        except CalibrationError as error:
            skipped.append(str(error))
    remarks = [f"{len(skipped)} of {len(named)} queries are skipped for their cameras: {skipped[0]}"] if skipped else []
    return cameras, remarks


def read_pairs(path: Path) -> dict[str, tuple[str, ...]]:
    """References by query, the most similar one first, from lines ``query reference``.

    Raises ``InputError`` with the line that is wrong.
    """
    pairs: dict[str, dict[str, None]] = {}
    for place, text in rows(path, "a list of pairs"):
        names = text.split()
        if len(names) != 2:
            raise InputError(f"{place}: has {len(names)} names; give a pair, query reference.")
        pairs.setdefault(names[0], {})[names[1]] = None
    return {query: tuple(references) for query, references in pairs.items()}


def read_results(path: Path) -> dict[str, FloatArray]:
    """Poses ``cam_from_map`` (3, 4) by image from lines ``name qw qx qy qz tx ty tz``.

    Raises ``InputError`` with the line that is wrong.
    """
    poses: dict[str, FloatArray] = {}
    for place, text in rows(path, "name qw qx qy qz tx ty tz"):
        name, *words = text.split()
        if name in poses:
            raise InputError(f"{place}: {show(name)} has two poses; remove one line.")
        poses[name] = pose_from_words(words, place)
    return poses


@dataclass(frozen=True, eq=False)
class HlocKeypoints:
    """The keypoints of one image."""

    pixels: FloatArray
    """(N, 2), the centre of the top-left pixel at (0.5, 0.5)."""
    rounding_px: float
    """Step of the numbers in the file at its largest coordinate: 1 px and more for half floats beyond 1024 px."""
    uncertainty_px: float | None
    """hloc's uncertainty of a keypoint, from the smaller image in which it was found; None if the file has none."""
    image_size: tuple[int, int] | None
    """Width and height of the image in which they were found; None if the file does not say."""


@dataclass(frozen=True, eq=False)
class Hdf5:
    """An open file."""

    path: Path
    root: Any
    """The ``h5py.File``."""

    def array(self, names: Sequence[str], kinds: str, dimensions: int) -> NDArray | None:
        """The dataset at the end of groups and its name, or None if there is none.

        ``kinds`` are the kinds of numbers ("f", "iu") that it may hold. Raises ``InputError`` if it holds others, has
        another number of dimensions, is larger than ``MAX_BYTES`` or lies in another file.
        """
        place = f"{self.path}: {show('/'.join(names))}"
        with _guarded(place):
            dataset = self._find(names, place)
            if dataset is None:
                return None
            _check(dataset, kinds, dimensions, place)
            return dataset[()]

    def attribute(self, names: Sequence[str], name: str) -> float | None:
        """A number that is attached to a dataset; None if there is none or it is not a number."""
        place = f"{self.path}: {show('/'.join(names))}"
        with _guarded(place):
            dataset = self._find(names, place)
            if dataset is None or name not in dataset.attrs:
                return None
            kind = dataset.attrs.get_id(name)
            if kind.dtype.kind not in "fiu" or kind.shape not in ((), (1,)):
                return None
            number = float(np.ravel(dataset.attrs[name])[0])
            return number if np.isfinite(number) else None

    def _find(self, names: Sequence[str], place: str) -> Any:
        h5py = _h5py()
        node = self.root
        for part in (part for name in names for part in name.split("/") if part not in ("", ".")):
            link = node.get(part, getlink=True) if isinstance(node, h5py.Group) else None
            if link is None:
                return None
            if not isinstance(link, h5py.HardLink):
                raise InputError(f"{place} is a link, which is not followed; write the data themselves into the file.")
            node = node[part]
        return node


@contextmanager
def open_hdf5(path: Path) -> Iterator[Hdf5]:
    """A file opened for reading. Raises ``InputError`` if it is missing, a pickle or not HDF5."""
    refuse_pickle(path)
    h5py = _h5py()
    with _guarded(str(path)):
        file = h5py.File(path, "r", locking=False)
    with file:
        yield Hdf5(path, file)


def read_keypoints(file: Hdf5, name: str) -> HlocKeypoints | None:
    """The keypoints of an image, None if the file has none of it; raises ``InputError`` if they are damaged."""
    array = file.array((name, "keypoints"), "f", 2)
    if array is None:
        return None
    place = f"{file.path}: {show(name)}"
    pixels = array.astype(np.float64)
    if pixels.shape[1] < 2 or not (np.abs(pixels[:, :2]) <= _LARGEST_PX).all():
        raise InputError(f"{place}: its keypoints are not rows of two pixel coordinates; extract the features again.")
    size = file.array((name, "image_size"), "iuf", 1)
    if size is not None and (len(size) != 2 or not np.isfinite(size).all() or not (size > 0).all()):
        raise InputError(f"{place}: its image_size is not a width and a height; extract the features again.")
    return HlocKeypoints(
        pixels=pixels[:, :2] + 0.5,
        rounding_px=float(np.spacing(np.abs(array[:, :2]).max())) if array.size else 0.0,
        uncertainty_px=file.attribute((name, "keypoints"), "uncertainty"),
        image_size=None if size is None else (int(size[0]), int(size[1])),
    )


def read_matches(file: Hdf5, query: str, reference: str, counts: tuple[int, int]) -> IntArray | None:
    """Matches (M, 2) as indices of keypoints of the query and of the reference; None if the pair is not in the file.

    ``counts`` are their numbers of keypoints. hloc writes a pair in either order. Raises ``InputError`` where an
    index or a length disagrees with ``counts``.
    """
    for first, second, turned in ((query, reference, False), (reference, query, True)):
        a, b = first.replace("/", "-"), second.replace("/", "-")
        for names in ((a, b), (f"{a}_{b}",)):  # the second as written before hloc 1.2
            matches = file.array((*names, "matches0"), "i", 1)
            if matches is None:
                continue
            place = f"{file.path}: {show('/'.join(names))}"
            count_first, count_second = counts[::-1] if turned else counts
            if len(matches) != count_first:
                raise InputError(
                    f"{place}: has matches of {len(matches)} keypoints, but {show(first)} has {count_first}; "
                    "give the features and the model that were matched."
                )
            index = matches.astype(np.int64)
            if len(index) and (index.min() < -1 or index.max() >= count_second):
                raise InputError(
                    f"{place}: names the keypoint {index.min() if index.min() < -1 else index.max()} of the "
                    f"{count_second} of {show(second)}; give the features and the model that were matched."
                )
            known = np.flatnonzero(index >= 0)
            pairs = np.column_stack([known, index[known]])
            return pairs[:, ::-1] if turned else pairs
    return None


def read_global_descriptors(path: Path, names: Sequence[str]) -> NDArray[np.float32]:
    """Unit rows (N, D) that describe whole images; rows of images that the file does not have are NaN.

    Raises ``InputError`` for damaged ones, and for more than ``MAX_TOTAL_BYTES``.
    """
    found: dict[int, NDArray] = {}
    with open_hdf5(path) as file:
        for row, name in enumerate(names):
            array = file.array((name, "global_descriptor"), "f", 1)
            if array is None:
                continue
            with np.errstate(all="ignore"):
                length = np.linalg.norm(array.astype(np.float64))
            if not np.isfinite(length) or length == 0.0 or len(array) != len(next(iter(found.values()), array)):
                raise InputError(f"{path}: the descriptor of {show(name)} is damaged; extract it again.")
            if len(array) * len(names) * 4 > MAX_TOTAL_BYTES:
                raise InputError(
                    f"{path}: descriptors of {len(array)} numbers for {len(names)} images are more than "
                    f"{MAX_TOTAL_BYTES >> 20} MiB; give a list of pairs instead."
                )
            found[row] = (array / length).astype(np.float32)
    size = len(next(iter(found.values()))) if found else 1
    descriptors = np.full((len(names), size), np.nan, dtype=np.float32)
    for row, array in found.items():
        descriptors[row] = array
    return descriptors


def _h5py() -> Any:
    return require("h5py", "hloc", "reading hloc's HDF5 files")


@contextmanager
def _guarded(place: str) -> Iterator[None]:
    """One sentence for whatever h5py raises on a damaged file, which can be nearly any exception."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"{place}: no HDF5 data that can be read ({reason(error)}); write the file again.") from None


def _check(dataset: Any, kinds: str, dimensions: int, place: str) -> None:
    """Raise ``InputError`` for a dataset that must not be read."""
    if not isinstance(dataset, _h5py().Dataset):
        raise InputError(f"{place} is not an array of numbers; give a file that hloc wrote.")
    if dataset.external or dataset.is_virtual:
        raise InputError(f"{place} lies in another file, which is not followed; copy it into this one.")
    if dataset.dtype.kind not in kinds or len(dataset.shape or ()) != dimensions:
        raise InputError(
            f"{place} holds {show(str(dataset.dtype))} in {len(dataset.shape or ())} dimensions instead of numbers in "
            f"{dimensions}; give a file that hloc wrote."
        )
    largest = max(_bytes(dataset.shape, dataset.dtype), _bytes(dataset.chunks or (), dataset.dtype))
    if largest > MAX_BYTES:
        raise InputError(f"{place} claims {largest:,} bytes, more than {MAX_BYTES:,}; write the file again.")


def _bytes(shape: Sequence[int], dtype: np.dtype) -> int:
    count = dtype.itemsize
    for extent in shape:
        count *= int(extent)
    return count
