"""Success rates of the estimators on the paper's simulation (Sec. VI-A), as a Markdown table.

.venv/bin/python benchmarks/success.py [SEEDS]
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from spherloc import registry
from spherloc.datasets import bundled_scenes
from spherloc.datasets.scene_file import load_scene
from spherloc.datasets.synthetic import SyntheticScene
from spherloc.estimators import estimate
from spherloc.metrics import evaluate
from spherloc.warm_up import warm_up

RATES = (0.0, 0.5, 0.8, 0.9)
CAMERAS = ("mei", "fisheye", "panorama")


def cell(scene: SyntheticScene, estimator: str, seeds: int) -> str:
    """Success in percent and median time of one estimator on one kind of scene."""
    traces = [estimate(scene.problem(seed), estimator, seed=seed) for seed in range(seeds)]
    success = 100 * np.mean([bool(evaluate(trace).success) for trace in traces])
    return f"{success:.0f} % / {np.median([trace.timings_ms['total'] for trace in traces]):.1f} ms"


def main(seeds: int) -> None:
    """Print the table."""
    warm_up()
    print("| camera | estimator | " + " | ".join(f"{100 * rate:.0f} % outliers" for rate in RATES) + " |")
    print("|---" * (len(RATES) + 2) + "|")
    for camera in CAMERAS:
        scene = load_scene(Path(bundled_scenes()[f"{camera}_outliers_80"]))
        assert isinstance(scene, SyntheticScene)
        for estimator in registry.names("estimators"):
            cells = [cell(replace(scene, outlier_rate=rate), estimator, seeds) for rate in RATES]
            print(f"| {camera} | `{estimator}` | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100)
