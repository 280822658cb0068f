"""What a recording may hold, before it is believed: moderate sizes, and values of the types that we write."""

import io
import json
import warnings
from collections.abc import Mapping
from dataclasses import is_dataclass
from math import isfinite
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
import pyarrow as pa
from PIL import Image
from rerun.chunk import Chunk, RrdReader

from spherloc.errors import RecordingError, show
from spherloc_viz.recording.content.data import TYPES
from spherloc_viz.recording.content.names import ARRAYS, DATA, NUMBERS, PROPERTIES
from spherloc_viz.recording.content.properties import RUN_TYPES
from spherloc_viz.recording.recorded_run import RecordedRun
from spherloc_viz.recording.sandbox.row_checks import COUNT_LIMIT

PROBLEM = f"{DATA}/problem"
"""The row of the problem in formats 1 and 2."""
CATALOG = {NUMBERS: TYPES, PROPERTIES: RUN_TYPES}
"""Columns over which rerun's catalog asks questions: one file with other types would shut out the others."""
STORES_LIMIT = 16
CHUNKS_LIMIT = 100_000
CONTENT_LIMIT_BYTES = 256 << 20
"""Largest size of all chunks together, unpacked."""
SCALARS_LIMIT_BYTES = 4 << 20
"""Largest JSON of a row: names of many reference images take most of it."""
TEXT_LIMIT = 65_536
"""Characters of one text in it."""
ITEMS_LIMIT = 100_000
"""Values in it, all together."""
DEPTH_LIMIT = 9
IMAGE_LIMIT_BYTES = 16 << 20
IMAGE_LIMIT_PX = 8_192
"""A side; a small file can claim an image that fills the memory."""


def check_content(path: Path) -> None:
    """Read every chunk of a recording.

    Raises ``RecordingError``, in one sentence, for one that is too large, damaged, or of a type that we do not write;
    and whatever rerun and arrow raise.
    """
    reader = RrdReader(path)
    entries = [*reader.recordings(), *reader.blueprints()]
    if len(entries) > STORES_LIMIT:
        raise _too_many(path, "stores", len(entries), STORES_LIMIT)
    chunks = content_bytes = 0
    for entry in entries:
        store = reader.store(store=entry)
        chunks += len(store)
        if chunks > CHUNKS_LIMIT:
            raise _too_many(path, "chunks", chunks, CHUNKS_LIMIT)
        for chunk in store.stream():
            batch = chunk.to_record_batch()
            batch.validate(full=True)
            content_bytes += batch.nbytes
            if content_bytes > CONTENT_LIMIT_BYTES:
                raise _too_many(path, "bytes", content_bytes, CONTENT_LIMIT_BYTES)
            _check_columns(chunk, batch, path)
            if chunk.entity_path == DATA or chunk.entity_path.startswith(f"{DATA}/"):
                _check_rows(chunk, batch, path)


def _too_many(path: Path, what: str, count: int, limit: int) -> RecordingError:
    return RecordingError(f"{path}: has {count:,} {what}, of which {limit:,} are the most; record the run again.")


def _check_columns(chunk: Chunk, batch: pa.RecordBatch, path: Path) -> None:
    """Refuse columns of the catalog that have another type than ours."""
    known = CATALOG.get(chunk.entity_path, {})
    for name in known.keys() & set(batch.schema.names):
        found = batch.schema.field(name).type
        if not pa.types.is_list(found) or found.value_type != known[name]:
            what = f"{chunk.entity_path} has {name} of type {str(found)[:100]}"
            raise RecordingError(f"{path}: {what} instead of {known[name]}; record the run again.")


def _check_rows(chunk: Chunk, batch: pa.RecordBatch, path: Path) -> None:
    """Rows of arrays and of ``scalars``, see ``recording.content.data``."""
    what = f"{path}: {chunk.entity_path[:100]}"
    if batch.num_rows != 1:
        raise RecordingError(f"{what} has {batch.num_rows:,} rows instead of one; record the run again.")
    for name in batch.schema.names:
        column = batch.column(name)
        if not pa.types.is_list(column.type):
            continue
        values = column.flatten()
        if name == "scalars":
            told = _scalars(values, what)
            problem = told if chunk.entity_path == PROBLEM else told.get("problem") if isinstance(told, dict) else None
            if _most_rows(problem) > COUNT_LIMIT:
                raise _too_many(path, "correspondences", _most_rows(problem), COUNT_LIMIT)
            continue
        leaf = column.type.value_type
        while pa.types.is_fixed_size_list(leaf):
            leaf = leaf.value_type
        if not (pa.types.is_floating(leaf) or pa.types.is_integer(leaf) or pa.types.is_boolean(leaf)):
            raise RecordingError(f"{what} has {name[:100]!r} of type {str(leaf)[:100]}; give numbers.")
        # In format 1 an array has a column of its own.
        if chunk.entity_path == PROBLEM and name != ARRAYS and len(values) > COUNT_LIMIT:
            raise _too_many(path, "correspondences", len(values), COUNT_LIMIT)


def _most_rows(told: Any) -> int:
    """Largest number of rows of the arrays, by their shapes; 0 if there are none."""
    forms = told.get(ARRAYS, ()) if isinstance(told, dict) else ()
    return max((int(shape[0]) for _, _, shape in forms if shape), default=0)


def _scalars(values: pa.Array, what: str) -> Any:
    """The JSON of a row; raises ``RecordingError`` or ``ValueError`` if it is too much, or none."""
    if not pa.types.is_string(values.type) or len(values) != 1:
        raise RecordingError(f"{what} has no text where its scalars belong; record the run again.")
    if values.nbytes > SCALARS_LIMIT_BYTES:
        raise RecordingError(f"{what} has {values.nbytes:,} bytes of text; {SCALARS_LIMIT_BYTES:,} are the most.")
    told = json.loads(values[0].as_py())
    if _items(told, 0) > ITEMS_LIMIT:
        raise RecordingError(f"{what} has more than {ITEMS_LIMIT:,} values; record the run again.")
    return told


def _items(value: Any, depth: int) -> int:
    """How many values it is made of. Raises ``ValueError`` for long texts, deep nesting and what JSON cannot say."""
    if depth > DEPTH_LIMIT:
        raise ValueError(f"values are nested more than {DEPTH_LIMIT} deep")
    if isinstance(value, dict):
        return sum(_items(key, depth + 1) + _items(item, depth + 1) for key, item in value.items())
    if isinstance(value, list):
        return 1 + sum(_items(item, depth + 1) for item in value)
    if isinstance(value, str):
        if len(value) > TEXT_LIMIT:
            raise ValueError(f"a text has {len(value):,} characters, of which {TEXT_LIMIT:,} are the most")
        value.encode()  # JSON can have halves of characters, which cannot be stored or sent
    if isinstance(value, float) and not isfinite(value):
        raise ValueError("a number is not finite")
    return 1


def check_run(run: RecordedRun, path: Path) -> None:
    """What ``read_recording`` leaves open. Raises ``RecordingError``, in one sentence, for what cannot be."""
    count, row = len(run.problem), run.row
    truth = run.problem.truth_inliers
    good = {
        "the pose": _is_pose_or_none(run.cam_from_map),
        "the inliers": _is_mask(run.inlier_mask, count),
        "the true inliers": truth is None or _is_mask(truth, count),
        "the message": isinstance(run.message, str),
        "the estimator": run.estimator == row.estimator,
        "the seed": type(run.seed) is int and run.seed == row.seed,
        "the options": _is_table(run.options, (bool, int, float, str, type(None))),
        "the options of the row": isinstance(json.loads(row.options), dict),
        "the versions": _is_table(run.versions, (str,)),
        "the timings": _is_table(run.timings_ms, (int, float)) and all(map(isfinite, run.timings_ms.values())),
        "the number of correspondences": row.correspondences == count,
        "the certificate": run.certificate is None or _fits(run.certificate, type(run.certificate)),
        "the origin": run.origin is None or _fits(run.origin, type(run.origin)),
        "the scene's text": run.scene_text is None or isinstance(run.scene_text, str),
        "the diagnosis": run.diagnosis is None or _fits(run.diagnosis, type(run.diagnosis)),
        "the other pose": run.diagnosis is None or _is_pose_or_none(run.diagnosis.alternative_cam_from_map),
        "the query image": run.query_image is None or _is_moderate_image(run.query_image),
    }
    wrong = [name for name, is_good in good.items() if not is_good]
    if wrong:
        raise RecordingError(f"{path}: has a wrong form in {', '.join(wrong)}; record the run again.")


def _fits(value: Any, hint: Any) -> bool:
    """Whether a value has a type such as fields of recorded dataclasses have, to the last item of it."""
    # Of a type alias, such as NDArray is from numpy 2.5 on, this is what it stands for.
    hint = getattr(get_origin(hint) or hint, "__value__", hint)
    kind, parts = get_origin(hint), get_args(hint)
    if kind in (Union, UnionType):
        return any(_fits(value, part) for part in parts)
    if kind is Literal:
        return isinstance(value, str) and value in parts
    if kind is tuple:
        items = parts[:1] * len(value) if isinstance(value, tuple) and parts[-1] is Ellipsis else parts
        return isinstance(value, tuple) and len(value) == len(items) and all(map(_fits, value, items))
    if isinstance(hint, type) and is_dataclass(hint):
        hints = get_type_hints(hint)
        return isinstance(value, hint) and all(_fits(getattr(value, name), own) for name, own in hints.items())
    if hint is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    return type(value) is int if hint is int else isinstance(value, kind or hint)


def _is_mask(mask: Any, count: int) -> bool:
    if not isinstance(mask, np.ndarray) or mask.shape != (count,) or mask.dtype != np.bool_:
        return False
    return int(mask.view(np.uint8).max(initial=0)) <= 1  # a byte of 2 would count twice


def _is_pose_or_none(pose: Any) -> bool:
    if pose is None:
        return True
    if not isinstance(pose, np.ndarray) or pose.shape != (3, 4) or pose.dtype != np.float64:
        return False
    return bool(np.isfinite(pose).all()) and np.allclose(pose[:, :3] @ pose[:, :3].T, np.eye(3), atol=1e-3)


def _is_table(table: Any, kinds: tuple[type, ...]) -> bool:
    return isinstance(table, Mapping) and all(isinstance(value, kinds) for value in table.values())


def _is_moderate_image(content: bytes) -> bool:
    """Whether it is a JPEG of moderate size; its pixels are not decoded."""
    if len(content) > IMAGE_LIMIT_BYTES:
        return False
    with warnings.catch_warnings():
        warnings.simplefilter("error", Image.DecompressionBombWarning)
        try:
            with Image.open(io.BytesIO(content), formats=["JPEG"]) as image:
                return max(image.size) <= IMAGE_LIMIT_PX
        except (
            OSError,
            ValueError,
            SyntaxError,
            Image.DecompressionBombError,
            Image.DecompressionBombWarning,
        ) as error:
            raise ValueError(f"the query image is not a JPEG ({show(str(error))})") from error
