"""What a list of runs shows about a run without opening its pictures: the properties of its recording."""

import json
from collections.abc import Iterator
from dataclasses import asdict
from datetime import datetime
from typing import Any

import pyarrow as pa
import rerun as rr
from rerun.chunk import Chunk

from spherloc.metrics import Metrics
from spherloc.trace import Trace
from spherloc_viz.options import json_text

FORMAT_VERSION = 1
"""Of what is recorded and how. A reader refuses others."""


def outcome(metrics: Metrics) -> str:
    """Success or failure by the limits of Sec. VI, or unknown where there is no truth to compare with."""
    return {True: "success", False: "failure", None: "unknown"}[metrics.success]


def property_chunks(trace: Trace, metrics: Metrics, created: datetime) -> Iterator[Chunk]:
    """The property ``run``, and the name and time that the Rerun viewer shows for the recording.

    Unknown values are absent, so that a query finds nulls. In ``options``, which is JSON, infinity is the text "inf".
    """
    certificate = trace.certificate
    proven: dict[str, Any] = {}
    if certificate is not None:
        proven = {
            "upper_bound": certificate.upper_bound,
            "lower_bound": certificate.lower_bound,
            "proven": certificate.proven,
            "chance_sets": certificate.chance_sets,
        }
    values: dict[str, Any] = {
        "format_version": FORMAT_VERSION,
        "created": created.isoformat(timespec="milliseconds"),
        "scene": trace.problem.scene,
        "name": trace.problem.name,
        "estimator": trace.estimator,
        "seed": trace.seed,
        "options": json_text(asdict(trace.options)),
        "outcome": outcome(metrics),
        "message": trace.message,
        "rotation_error_deg": metrics.rotation_error_deg,
        "translation_error_m": metrics.translation_error_m,
        "inliers": int(trace.inlier_mask.sum()),
        "correspondences": len(trace.problem),
        "time_ms": trace.timings_ms.get("total"),
        "versions": json.dumps(dict(trace.versions)),
        **proven,
    }
    known = {name: value for name, value in values.items() if value is not None}
    yield Chunk.from_property("run", rr.AnyValues(**known))
    name = f"{trace.problem.name}, {trace.estimator}, seed {trace.seed}"
    info = rr.archetypes.RecordingInfo.columns(name=[name], start_time=[int(created.timestamp() * 1e9)])
    yield Chunk.from_columns("/__properties", [], info)


def read_properties(chunk: Chunk) -> dict[str, Any]:
    """The values of a chunk of ``property_chunks`` by name."""
    batch = chunk.to_record_batch()
    names = [name for name in batch.schema.names if pa.types.is_list(batch.column(name).type)]
    return {name: batch.column(name)[0].values[0].as_py() for name in names}
