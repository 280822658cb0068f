"""The sessions of the paper's Tables II to V on the datasets themselves: scene files for a folder of a dataset."""

import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from spherloc.errors import InputError
from spherloc.experiments.sweep_plan import Entrant
from spherloc.files import is_folder, names_in, read_file
from spherloc.verification.experiments import METHODS, WIDE_SOLVERS, rectified, wide

MAX_BYTES = 1_000_000
"""Largest size of the file of the printed tables."""


@dataclass(frozen=True)
class DatasetSession:
    """A session of a dataset: query images and references, as a scene file describes them."""

    name: str
    """Its name in the paper's tables."""
    scene: str
    """Text of the scene file (TOML)."""


@dataclass(frozen=True)
class Dataset:
    """A dataset, and the methods and sessions for which the paper uses it."""

    key: str
    """Its kind in scene files, and its name in options of the command."""
    title: str
    """Name that users see."""
    methods: tuple[str, ...]
    """Keys of ``TABLE_METHODS``."""
    sessions: Callable[[Path], Sequence[DatasetSession]]
    """Gives the sessions in a folder that holds the dataset; raises ``InputError`` if there are none."""


TABLE_METHODS: Mapping[str, Entrant] = {
    **{name: METHODS[name] for name in ("MC", "2P100", "2P1k", "SVD100", "ML100")},
    "R+EPro": rectified("ransac-epropnp", 100),
    "R+EPnP": rectified("ransac-epnp", 100),
    "R+oDLT": rectified("ransac-odlt", 100),
    **{name: wide(name, 100) for name in WIDE_SOLVERS},
    **{name: METHODS[name] for name in ("mc", "mc-exact", "ransac-2p 1k")},
}
"""Methods of Tables II to V; R+* with 100 iterations, as noted under Table IV; below them the same
solvers with wide views, 100 samples by P3P."""
_FEW = ("MC", "2P100", "2P1k", "SVD100", "ML100", "mc", "mc-exact", "ransac-2p 1k")


def iterations(entrant: Entrant) -> str:
    """Number of samples that a method draws, as the tables print it; empty for a method that draws none."""
    options = dict(entrant.changes)
    if "iterations" in options:
        return f"{options['iterations']:,}"
    return "1,000" if entrant.estimator.startswith("ransac") else "none"


def _kitti360(folder: Path) -> list[DatasetSession]:
    """Sequence 5 is the reference, 4 and 6 are the queries (Sec. VI-B.1)."""
    text = """\
kind = "kitti360"
name = "KITTI-360, {name}"
root = {root}
reference_sequence = 5
query_sequence = {query}
camera = "image_02"
thresholds = [[1.0, 0.5], [2.0, 1.0], [5.0, 2.0]]
"""
    drives = {"seq1": 4, "seq2": 6}
    there = {
        name: query
        for name, query in drives.items()
        if is_folder(folder / "data_2d_raw" / f"2013_05_28_drive_{query:04d}_sync")
    }
    return [
        DatasetSession(name, text.format(name=name, root=_quoted(folder), query=query)) for name, query in there.items()
    ]


def _newer_college(folder: Path) -> list[DatasetSession]:
    """The paper names the sessions but not their references: quad-medium and math-easy are used."""
    text = """\
kind = "newer-college"
name = "Newer College, {name}"
root = {root}
calibration = "calibration/camchain.yaml"
camera = "cam0"
query_images = "{name}/cam0"
query_ground_truth = "gt-nc-{name}.csv"
query_imu = "{name}/imu.csv"
reference_images = "{reference}/cam0"
reference_ground_truth = "gt-nc-{reference}.csv"
model = "{reference}/colmap"
query_step = 10
thresholds = [[2.0, 0.25], [5.0, 0.5], [8.0, 1.0]]
"""
    references = {
        "quad-easy": "quad-medium",
        "quad-hard": "quad-medium",
        "math-medium": "math-easy",
        "math-hard": "math-easy",
    }
    there = {name: reference for name, reference in references.items() if is_folder(folder / name)}
    return [
        DatasetSession(name, text.format(name=name, root=_quoted(folder), reference=reference))
        for name, reference in there.items()
    ]


def _matterport360(folder: Path) -> list[DatasetSession]:
    """Each building is a session: the paper does not print how it divides 18 buildings into 7 sessions."""
    text = """\
kind = "matterport360"
name = "Matterport360, {name}"
root = {root}
queries = ["*5_rgb.png"]
depth = "ray"
trust_poses = false
"""
    there = sorted(name for name in names_in(folder) if is_folder(folder / name))
    buildings = [name for name in there if any(image.endswith("_rgb.png") for image in names_in(folder / name))]
    return [DatasetSession(name, text.format(name=name, root=_quoted(folder / name))) for name in buildings]


def _quoted(path: Path) -> str:
    """A path as a TOML string."""
    text = str(path.resolve()).replace("\\", "\\\\").replace('"', '\\"')
    return f'"{text}"'


DATASETS: Sequence[Dataset] = (
    Dataset("kitti360", "KITTI-360", _FEW, _kitti360),
    Dataset("newer-college", "Newer College", tuple(TABLE_METHODS), _newer_college),
    Dataset("matterport360", "Matterport360", _FEW, _matterport360),
)


def sessions_of(dataset: Dataset, folder: Path) -> Sequence[DatasetSession]:
    """The sessions of a dataset's folder. Raises ``InputError`` if it is not a folder or holds none."""
    if not is_folder(folder):
        raise InputError(f"{folder}: no such folder; give the folder of {dataset.title}.")
    found = dataset.sessions(folder)
    if not found:
        raise InputError(
            f"{folder}: holds no session of {dataset.title} that the paper uses; spherloc scenes {dataset.key} shows "
            "how its folders are named."
        )
    return found


def printed_tables() -> dict[str, dict[str, Any]]:
    """The paper's Tables I to VI by key: title, columns and rows, and the dataset if the table is about one."""
    return tomllib.loads(read_file(Path(__file__).parent / "tables.toml", MAX_BYTES).decode())
