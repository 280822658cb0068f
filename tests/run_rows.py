"""Rows of runs that never were, for tests of the index and of lists."""

from typing import Any

import numpy as np

from spherloc.diagnosis import Cause
from spherloc_viz.recording.run_row import RunRow

SCENES = ("scenes/a.toml", "scenes/street at night.toml", "synthetic: N 100", "")
WORDS = ("facade", "100 %", "a_b", "naïve", "ÄÖ", "o'clock", '"quoted"', "雪", "back\\slash", "x; DROP TABLE runs")


def some_row(file: str = "a.rrd", **changes: Any) -> RunRow:
    """A failed run of ``mc``, with these changes."""
    values: dict[str, Any] = {
        "file": file,
        "run_id": "1b2c",
        "created": "2026-01-02T03:04:05.678+00:00",
        "source": "command",
        "scene": "scenes/a.toml",
        "name": "a scene",
        "query": None,
        "estimator": "mc",
        "seed": 7,
        "options": '{"bound_px": 3.0, "gravity_sd_deg": "inf"}',
        "problem_key": "f00d",
        "outcome": "failure",
        "diagnosis": "ambiguous",
        "doubtful": True,
        "summary": "Two poses explain as many.",
        "message": "Pose found.",
        "correspondences": 52,
        "inliers": 13,
        "outlier_rate": 0.75,
        "rotation_error_deg": 12.5,
        "translation_error_m": 1.25,
        "time_ms": 14.0,
        "proven": None,
        "steps": 20,
        "key_step": 12,
        "size_bytes": 1000,
        "thumbnail": b"\x89PNG\r\n",
        "format_version": 2,
    }
    return RunRow(**values | changes)


def random_row(rng: np.random.Generator, number: int) -> RunRow:
    """A run with few different values of everything, so that many are equal, and with unknown ones."""

    def pick(values: Any) -> Any:
        return values[rng.integers(len(values))]

    def perhaps(value: float) -> float | None:
        return None if rng.random() < 0.2 else value

    words = [pick(WORDS) for _ in range(3)]
    return some_row(
        f"run-{number:04d}.rrd",
        run_id=f"{number:08x}",
        created=f"2026-01-{pick(range(1, 29)):02d}T00:00:0{pick(range(10))}.000+00:00",
        source=pick(("page", "command", "sweep", "gallery")),
        scene=pick(SCENES),
        name=words[0],
        query=pick((None, "0001.jpg")),
        estimator=pick(("mc", "ransac-2p")),
        problem_key=str(pick(range(5))),
        outcome=pick(("success", "failure", "unknown")),
        diagnosis=pick(("", *(cause.value for cause in Cause))),
        doubtful=pick((None, True, False)),
        summary=words[1],
        correspondences=int(pick((10, 100, 1000))),
        inliers=int(pick(range(10))),
        outlier_rate=perhaps(pick((0.0, 0.5, 0.9, 0.95))),
        rotation_error_deg=perhaps(float(rng.integers(5))),
        translation_error_m=perhaps(float(rng.uniform())),
        time_ms=float(rng.integers(100)),
        proven=pick((None, True, False)),
        labels=tuple(dict.fromkeys(pick(("wrong map", "wrong-map", "ÄÖ", "%")) for _ in range(rng.integers(3)))),
        note=words[2] if rng.random() < 0.3 else "",
        size_bytes=int(rng.integers(1, 10_000)),
        thumbnail=rng.bytes(int(rng.integers(20))),
    )
