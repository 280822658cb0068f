"""Runs to record, and the rows of a recording as rerun's own reader gives them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rerun.chunk import RrdReader

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.datasets import bundled_scenes, load_scene
from spherloc.estimators import estimate
from spherloc.geometry import so3_exp, yaw_of, yaw_rotation
from spherloc.problem import Problem
from spherloc.trace import Certificate, ConsensusStage, DecisionStage, RefinementStage, Trace

RUNS = (
    ("mei_outliers_80", "mc"),
    ("fisheye_outliers_80", "ransac-2p"),
    ("panorama_outliers_90", "mc"),
    ("mei_outliers_90", "mc-exact"),
)


def scene_problem(name: str) -> Problem:
    """The problem of a bundled scene."""
    return load_scene(bundled_scenes()[name]).problem(None)


def odd_problem(rng: np.random.Generator, turn: int) -> Problem:
    """A problem in which nothing is round: tilted gravity, and by turns no truth, an image, a pixel bound."""
    camera = Equirectangular(width=1000, height=500)
    pixels, points = rng.uniform((0, 0), (1000, 500), (9, 2)), rng.normal(size=(9, 3)) * 1e3
    rotation = so3_exp(rng.normal(size=3))
    known = bool(turn % 2)
    return Problem(
        name=f'“{turn}” / ../odd: "name"\n',
        camera=camera,
        pixels=pixels,
        points=points,
        gravity_camera=rotation[0],
        gravity_map=rotation[1],
        gravity_bound_rad=float(rng.uniform(0, 0.1)),
        gravity_sd_rad=(None, 0.0, 0.01, np.inf)[turn % 4],
        bound_px=float(rng.uniform(1, 9)) if turn % 3 else None,
        truth_cam_from_map=np.column_stack([rotation, rng.normal(size=3)]) if known else None,
        truth_inliers=rng.random(9) < 0.5 if known else None,
        image=Path("some folder/query ü.jpg") if known else None,
        scene="a | scene",
        reference_images=(Path("some folder/a.jpg"), Path("b.jpg")) if known else (),
        reference_index=rng.integers(0, 2, 9) if known else None,
        reference_pixels=np.where(rng.random((9, 1)) < 0.3, np.nan, rng.normal(size=(9, 2))) if known else None,
        estimated_outlier_rate=float(rng.random()) if known else None,
        remarks=("Two of “three” references were skipped.",) if known else (),
    )


def lost_run() -> Trace:
    """A run without a pose: all matches are of one map point, so that no pair fixes a yaw."""
    problem = scene_problem("mei_outliers_80")
    alone = np.tile(problem.points[:1], (len(problem), 1))
    trace = estimate(replace(problem, points=alone, truth_cam_from_map=None, truth_inliers=None), "mc")
    assert trace.cam_from_map is None
    return trace


def exact_run(**changes: Any) -> Trace:
    """A run by hand as "auto" and an exact estimator leave it, with its certificate; ``changes`` are of the stage.

    Its bound peaks where the best pose looks, and there is an alternative.
    """
    trace = estimate(scene_problem("mei_outliers_80"), "mc")
    pose, clique = trace.cam_from_map, np.flatnonzero(trace.inlier_mask)
    refinement = trace.stage(RefinementStage)
    assert pose is not None and refinement is not None
    alternative = np.column_stack([pose[:, :3] @ yaw_rotation(0.5), pose[:, 3] + [1.0, 0.0, 2.0]])
    yaw_rad = yaw_of(trace.problem.aligned.align_pose(pose)[:, :3])
    bound = np.full(1440, len(clique) - 3, np.int32)
    bound[int((yaw_rad + np.pi) / np.pi * 720)] = len(clique)
    stage = ConsensusStage(
        arcs=12_345,
        seed_support=len(clique) - 2,
        bound=bound,
        effort=678,
        finished=True,
        yaw_rad=yaw_rad,
        clique=clique.astype(np.int32),
        cam_from_map=np.array([pose, alternative]),
        support=np.array([len(clique), 6], np.int32),
    )
    decision = DecisionStage("mc-exact", "100 matches are few enough to compare all pairs.", 500, 0.2)
    certificate = Certificate(upper_bound=len(clique), lower_bound=len(clique), nfa=2e-9)
    stages = (decision, replace(stage, **changes), refinement)
    return replace(trace, estimator="auto", stages=stages, certificate=certificate)


class Recorded:
    """A recording as rerun's reader gives it: rows of every entity, the newest one at a step, which is an index."""

    def __init__(self, path: Path) -> None:
        self.rows: dict[str, list[tuple[int, dict[str, Any]]]] = {}
        reader = RrdReader(path)
        for chunk in reader.stream(store=reader.recordings()[0]):
            batch = chunk.to_record_batch()
            for index in range(batch.num_rows):
                row = {name: batch.column(name)[index] for name in batch.schema.names}
                # A component that a row does not change is null in it.
                row = {name: value for name, value in row.items() if value.is_valid}
                step = row["step"].as_py() - 1 if "step" in row else -1
                self.rows.setdefault(chunk.entity_path, []).append((step, row))

    def at(self, entity: str, step: int) -> dict[str, Any] | None:
        """The components of an entity that a viewer shows at a step, of each the newest; None if all are cleared."""
        shown: dict[str, Any] = {}
        for when, row in sorted(self.rows[entity], key=lambda item: item[0]):
            if when <= step:
                shown |= {name: value for name, value in row.items() if ":" in name or name == "correspondence"}
        return shown if any(len(value) for value in shown.values()) else None

    def array(self, entity: str, step: int, component: str) -> np.ndarray:
        """A component at a step as an array."""
        row = self.at(entity, step)
        assert row is not None
        return np.array(row[component].as_py())
