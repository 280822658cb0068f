"""Matches that are stored beside a scene file, so that features need not be matched anew on every machine."""

import io
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from spherloc.disk_cache import DAMAGED_NPZ, key_of
from spherloc.files import read_file
from spherloc.frontend.view import Matcher, Matches, NeedsPreparing, Report, View

SUFFIX = ".npz"
"""Ending of the name of the file beside a scene file."""
MAX_BYTES = 20_000_000
VERSION = 4
"""Number to be increased when pictures, features or matching change, so that old stored matches are not used."""


def key_of_table(table: Mapping[str, Any]) -> str:
    """Hash of those parts of a scene file's ``table`` that decide on the matches."""
    told = {"name", "about", "provenance", "thresholds", "gravity", "options"}
    return key_of(VERSION, json.dumps({key: table[key] for key in table.keys() - told}, sort_keys=True))


@dataclass(frozen=True, eq=False)
class StoredMatches:
    """Reads matches from a file; matches of queries that are not in it, or of another scene, come from a matcher."""

    matcher: Matcher
    references: tuple[View, ...]
    path: Path
    key: str
    """See ``key_of_table``."""

    def __call__(self, query: View) -> Matches:
        """See ``Matcher``."""
        stored = self.stored(query)
        if stored is None:
            return self.matcher(query)
        query.make_file()
        return stored

    def stored(self, query: View) -> Matches | None:
        """The matches of a query whose picture may not be drawn yet; None if they are not stored."""
        return self._by_query.get(query.name)

    def prepare(self, report: Report) -> None:
        """Prepare the matcher, unless the matches of all queries are stored."""
        if not self._by_query and isinstance(self.matcher, NeedsPreparing):
            self.matcher.prepare(report)

    @cached_property
    def _by_query(self) -> Mapping[str, Matches]:
        """Stored matches by query; empty if the file is missing, damaged, or of another scene."""
        views = {view.name: view for view in self.references}
        try:
            with np.load(io.BytesIO(read_file(self.path, MAX_BYTES)), allow_pickle=False) as file:
                told = json.loads(str(file["told"]))
                if told["key"] != self.key:
                    return {}
                columns = {name: file[name] for name in ("pixels", "points", "reference_index", "reference_pixels")}
            found, start = {}, 0
            for one in told["queries"]:
                rows = slice(start, start := start + one["count"])
                found[one["name"]] = Matches(
                    references=tuple(views[name] for name in one["references"]),
                    estimated_outlier_rate=one["outlier_rate"],
                    remarks=tuple(one["remarks"]),
                    verified_without_point=one.get("verified_without_point", 0),
                    **{name: np.asarray(column[rows], _TYPES[name]) for name, column in columns.items()},
                )
            return found
        except (*DAMAGED_NPZ, TypeError):
            return {}


_TYPES = {"pixels": "f8", "points": "f8", "reference_index": "i8", "reference_pixels": "f8"}


def write_matches(path: Path, key: str, found: Iterable[tuple[str, Matches]]) -> None:
    """Store the matches of queries, by their names; pixels are kept in single precision where that loses nothing."""
    queries, columns = [], {name: [] for name in _TYPES}
    for name, matches in found:
        queries.append(
            {
                "name": name,
                "count": len(matches.pixels),
                "references": [view.name for view in matches.references],
                "outlier_rate": matches.estimated_outlier_rate,
                "remarks": list(matches.remarks),
                "verified_without_point": matches.verified_without_point,
            }
        )
        for column, rows in columns.items():
            rows.append(_small(getattr(matches, column)))
    content: dict[str, Any] = {name: np.concatenate(rows) for name, rows in columns.items()}
    np.savez_compressed(path, told=np.array(json.dumps({"key": key, "queries": queries})), **content)


def _small(values: np.ndarray) -> np.ndarray:
    for kind in (np.uint8, np.float32):
        if np.array_equal(values, values.astype(kind), equal_nan=values.dtype.kind == "f"):
            return values.astype(kind)
    return values
