"""Keeps what gave a map its scale, so that the map has the same units when it is made again."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from spherloc.errors import InputError, reason
from spherloc.files import read_file, write_whole
from spherloc.mapping.alignment.positions import Positions
from spherloc.mapping.request import ScaleMeasurement

FILE = "scale.json"
MAX_BYTES = 1_000_000


def kept_scale(folder: Path) -> ScaleMeasurement:
    """What gave the map in a folder its scale; nothing if none was given or there is no map.

    Raises ``InputError`` if the file is damaged.
    """
    path = folder / FILE
    try:
        table = json.loads(read_file(path, MAX_BYTES).decode())
        return _read(table)
    except (FileNotFoundError, NotADirectoryError):
        return ScaleMeasurement()
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise InputError(f"{path}: cannot be read ({reason(error)}); remove it, and give the scale again.") from None


def _read(table: Mapping[str, Any]) -> ScaleMeasurement:
    if "camera_height_m" in table:
        return ScaleMeasurement(camera_height_m=float(table["camera_height_m"]))
    if "distance" in table:
        first, second, metres = table["distance"]
        return ScaleMeasurement(distance=(str(first), str(second), float(metres)))
    places = {str(name): np.array(place, np.float64).reshape(3) for name, place in table["positions"].items()}
    return ScaleMeasurement(positions=Positions(places, str(table["source"]), bool(table["horizontal"])))


def keep_scale(folder: Path, measured: ScaleMeasurement) -> None:
    """Write what gave a map its scale; nothing is written if nothing did. Raises ``OSError``."""
    table: dict[str, Any] = {}
    if measured.camera_height_m is not None:
        table = {"camera_height_m": measured.camera_height_m}
    elif measured.distance is not None:
        table = {"distance": measured.distance}
    elif measured.positions is not None:
        places = {name: place.tolist() for name, place in measured.positions.by_name.items()}
        table = {"positions": places, "source": measured.positions.source, "horizontal": measured.positions.horizontal}
    if table:
        write_whole(folder / FILE, json.dumps(table, indent=1).encode())
