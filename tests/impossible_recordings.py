"""Recordings whose numbers and texts cannot be, as changes to a good one."""

import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow as pa
from hostile_recordings import Change, packed, packed_as_format_1, unpacked

PROBLEM, RUN, RUN_PROPERTY, YAW = "/data/problem", "/data/run", "/__properties/run", "/data/stages/yaw"


def values(**own: Any) -> Change:
    """A row with some of its values changed."""

    def change(row: Mapping[str, Any]) -> Mapping[str, Any]:
        before, arrays = unpacked(row)
        assert own.keys() <= before.keys()
        return packed(before | own, arrays)

    return change


def arrays(**own: Any) -> Change:
    """A row with some of its arrays changed."""

    def change(row: Mapping[str, Any]) -> Mapping[str, Any]:
        before, all_arrays = unpacked(row)
        assert own.keys() <= all_arrays.keys()
        return packed(before, all_arrays | own)

    return change


def old_arrays(**own: Any) -> Change:
    """The same in format 1, where an array has a column and a type of its own."""

    def change(row: Mapping[str, Any]) -> Mapping[str, Any]:
        before, all_arrays = unpacked(row)
        return packed_as_format_1(before, all_arrays | own)

    return change


def form(name: Any, kind: Any, shape: Any) -> Change:
    """A row that says this of its first array."""

    def change(row: Mapping[str, Any]) -> Mapping[str, Any]:
        told = json.loads(row["scalars"][0].values[0].as_py())
        told["arrays"][0] = [name, kind, shape]
        return {**row, "scalars": pa.array([[json.dumps(told)]])}

    return change


def text(content: str) -> Change:
    return lambda row: {**row, "scalars": pa.array([[content]])}


def properties(**own: Any) -> Change:
    return lambda row: {**row, **{name: pa.array([[value]]) for name, value in own.items()}}


def camera(**own: Any) -> Change:
    return values(camera={"model": "equirectangular", "width": 100, "height": 50} | own)


def variation(**own: Any) -> Change:
    return lambda row: values(variation=unpacked(row)[0]["variation"] | own)(row)


RUNS_ENDED = pa.RunEndEncodedArray.from_arrays(pa.array([10**9], pa.int32()), pa.array([1.0]))

IMPOSSIBLE: dict[str, dict[str, Change]] = {
    "no problem": {PROBLEM: lambda row: None},
    "no properties": {RUN_PROPERTY: lambda row: None},
    "no pixels": {PROBLEM: form("other", "<f8", [100, 2])},
    "no arrays": {PROBLEM: lambda row: {"scalars": row["scalars"]}},
    "pixels that are objects": {PROBLEM: form("pixels", "|O8", [100, 2])},
    "pixels of no type": {PROBLEM: form("pixels", "__import__('os')", [100, 2])},
    "pixels of a type that is a table": {PROBLEM: form("pixels", {"names": ["a"], "formats": ["O"]}, [100, 2])},
    "pixels of 10^9 rows": {PROBLEM: form("pixels", "<f8", [10**9, 2])},
    "pixels of 10^30 rows": {PROBLEM: form("pixels", "<f8", [10**30, 2])},
    "pixels of -1 rows": {PROBLEM: form("pixels", "<f8", [-1, 2])},
    "pixels of half a row": {PROBLEM: form("pixels", "<f8", [0.5, 2])},
    "pixels of a shape that is a word": {PROBLEM: form("pixels", "<f8", "100")},
    "pixels whose name is a list": {PROBLEM: form(["pixels"], "<f8", [100, 2])},
    "pixels (N, 3)": {PROBLEM: arrays(pixels=np.zeros((100, 3)))},
    "no pixel": {PROBLEM: arrays(pixels=np.zeros((0, 2)))},
    "pixels that are not finite": {PROBLEM: arrays(pixels=np.full((100, 2), np.nan))},
    "points that are not finite": {PROBLEM: arrays(points=np.full((100, 3), np.inf))},
    "pixels that are words": {PROBLEM: old_arrays(pixels=pa.array(["a"] * 100))},
    "pixels that are nothing, 50 million times": {PROBLEM: old_arrays(pixels=pa.nulls(50_000_000))},
    "a stage of nothing, 50 million times": {YAW: old_arrays(overlap=pa.nulls(50_000_000))},
    "a stage of one number, 10^9 times": {YAW: old_arrays(overlap=RUNS_ENDED)},
    "more than a million correspondences": {
        PROBLEM: arrays(pixels=np.ones((1_000_001, 2)), points=np.ones((1_000_001, 3)))
    },
    "inliers that are neither true nor false": {RUN: arrays(inlier_mask=np.full(100, 2, np.uint8).view(bool))},
    "gravity of length 7": {PROBLEM: arrays(gravity_camera=np.array([7.0, 0.0, 0.0]))},
    "a pose that is no rotation": {RUN: arrays(cam_from_map=np.ones((3, 4)))},
    "a pose that is not finite": {RUN: arrays(cam_from_map=np.full((3, 4), np.nan))},
    "a pose of a wrong shape": {RUN: arrays(cam_from_map=np.ones(12))},
    "inliers of a wrong shape": {RUN: arrays(inlier_mask=np.ones(7, bool))},
    "inliers of a wrong type": {RUN: arrays(inlier_mask=np.ones(100))},
    "a camera with absurd sides": {PROBLEM: camera(width=10**9, height=10**9)},
    "a camera with endless sides": {PROBLEM: camera(width={"number": "inf"})},
    "a camera of no kind": {PROBLEM: camera(model="__import__('os')")},
    "a camera that is a word": {PROBLEM: values(camera="mei")},
    "an endless bound": {PROBLEM: values(bound_px={"number": "inf"})},
    "a bound that is a word": {PROBLEM: values(bound_px="3")},
    "a name of 10 MB": {PROBLEM: values(name="x" * 10_000_000)},
    "a name of 100 kB": {PROBLEM: values(name="x" * 100_000)},
    "a name with half a character": {PROBLEM: values(name="\ud800")},
    "a million reference images": {PROBLEM: values(reference_images=["a"] * 500_000)},
    "lists nested a million times": {PROBLEM: text("[" * 1_000_000 + "]" * 1_000_000)},
    "tables nested ten times": {PROBLEM: values(remarks=[[[[[[[[[["deep"]]]]]]]]]])},
    "a number of 100,000 digits": {PROBLEM: text('{"name": ' + "9" * 100_000 + "}")},
    "JSON with NaN": {PROBLEM: text('{"name": NaN}')},
    "no JSON": {PROBLEM: text("hello")},
    "JSON of a list": {PROBLEM: text("[]")},
    "a seed that is a word": {RUN: values(seed="one")},
    "an option that is a table": {RUN: values(options={"bound_px": {"a": 1}})},
    "options that are a list": {RUN: values(options=[1, 2])},
    "another estimator than the row": {RUN: values(estimator="ransac-2p")},
    "a source that there is not": {"/data/origin": values(source="evil")},
    "a title that is a list": {"/data/origin": values(title=["<b>"])},
    "a query that is a number": {"/data/origin": values(query=7)},
    "a change of the noise to a word": {"/data/origin": variation(noise_px="much")},
    "a change of match 'a'": {"/data/origin": variation(spoiled=["a"])},
    "a true camera of three numbers": {"/data/origin": variation(true_camera=[1.0, 2.0, 3.0])},
    "a kind of outliers that there is not": {"/data/origin": variation(outlier_kind="evil")},
    "another cause than there is": {"/data/diagnosis": values(cause="<script>")},
    "evidence that is no text": {"/data/diagnosis": values(evidence=[1, 2])},
    "a field that no run has": {RUN: text('{"arrays": [], "values": {"__class__": "Path"}}')},
    "a later format": {RUN_PROPERTY: properties(format_version=99)},
    "a format that is a word": {RUN_PROPERTY: properties(format_version="2")},
    "-1 inliers": {RUN_PROPERTY: properties(inliers=-1)},
    "more inliers than correspondences": {RUN_PROPERTY: properties(inliers=101)},
    "other correspondences than the problem": {RUN_PROPERTY: properties(correspondences=10**9)},
    "a time that is not finite": {RUN_PROPERTY: properties(time_ms=float("nan"))},
    "an error below nothing": {RUN_PROPERTY: properties(rotation_error_deg=-1.0)},
    "150 % outliers": {RUN_PROPERTY: properties(outlier_rate=1.5)},
    "a key step that there is not": {RUN_PROPERTY: properties(decisive_step=10**6)},
    "a cause that there is not": {RUN_PROPERTY: properties(diagnosis="<script>alert(1)</script>")},
    "an outcome that there is not": {RUN_PROPERTY: properties(outcome="' OR 1=1 --")},
    "a date that is none": {RUN_PROPERTY: properties(created="<b>today</b>")},
    "a date in another order": {RUN_PROPERTY: properties(created="20260101T120000Z")},
    "an outlier rate that is a whole number": {RUN_PROPERTY: properties(outlier_rate=1)},
    "steps whose numbers are texts": {"/numbers": lambda row: {"agreeing": pa.array([["3"]])}},
    "an estimator with a path": {RUN_PROPERTY: properties(estimator="../../etc")},
    "options that are no JSON": {RUN_PROPERTY: properties(options="{")},
    "a thumbnail that claims 60,000 pixels a side": {
        "/__properties/thumbnail": lambda row: {**row, "EncodedImage:blob": huge_png(row)}
    },
}


def huge_png(row: Mapping[str, Any]) -> pa.Array:
    content = np.array(row["EncodedImage:blob"][0].values[0].as_py(), np.uint8)
    content[16:24] = np.frombuffer(struct.pack(">II", 60_000, 60_000), np.uint8)
    return pa.array([[content]], pa.list_(pa.list_(pa.uint8())))
