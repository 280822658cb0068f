"""A pose that few matches give can be anywhere: where it is absurdly far from the map, words are told, not digits."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recording_samples import scene_problem

from spherloc.datasets import bundled_scenes, load_scene
from spherloc.datasets.map_scene import MapScene
from spherloc.diagnosis import diagnose
from spherloc.estimators import estimate
from spherloc.geometry import camera_centre, pose
from spherloc.localization import Localization
from spherloc.metrics import AWAY, BEYOND, extent_of, is_beyond, said_length
from spherloc.trace import Trace
from spherloc_viz.app.text import summary_of
from spherloc_viz.commands.run import as_text
from spherloc_viz.layers import paint, steps
from spherloc_viz.layers.outcome import outcome_table
from spherloc_viz.layers.where_taken import where_taken


@pytest.fixture(scope="module")
def street() -> MapScene:
    scene = load_scene(bundled_scenes()["street_fisheye"])
    assert isinstance(scene, MapScene)
    return scene


def moved(times: float) -> Trace:
    """A run whose pose is so many times the extent of its map away from the map's middle."""
    trace = estimate(scene_problem("mei_outliers_80"), "ransac-2p")
    points = trace.problem.points
    centre = np.median(points, axis=0) + np.array([times * extent_of(points), 0.0, 0.0])
    return replace(trace, cam_from_map=pose(np.eye(3), -centre))


def told(trace: Trace) -> str:
    """All that a run and the page say of a pose, but for the matrix of the pose itself."""
    text = as_text(Path("scene.toml"), trace, diagnose(trace), None).split("\n")
    rows = [value for row in outcome_table(trace).rows for value in row]
    caption = paint(trace, len(steps(trace)) - 1).step.caption
    return "\n".join([*(line for line in text if not line.startswith("    ")), *rows, *summary_of(trace)[1], caption])


def test_the_extent_leaves_out_strays(rng: np.random.Generator) -> None:
    points = rng.uniform(0.0, 1.0, (200, 3))
    points[:3] = 1e9
    assert 1.3 < extent_of(points) < np.sqrt(3.0)
    assert extent_of(points[:0]) == extent_of(points[:1]) == 0.0
    assert is_beyond(2e3, 1.0) and not is_beyond(900.0, 1.0) and not is_beyond(1e9, 0.0)
    assert said_length(900.0, 1.0, "900 m") == "900 m" and said_length(2e3, 1.0, "2 km") == BEYOND


def test_an_absurd_pose_is_told_in_words() -> None:
    words = told(moved(1e7))
    assert AWAY in repr(Localization(moved(1e7)))
    assert words.count(BEYOND) >= 4 and AWAY in words
    assert not any(digits in words for digits in ("e+0", "e+1", "000000 "))


def test_a_wrong_pose_in_reach_is_told_in_digits() -> None:
    assert BEYOND not in told(moved(20.0))


def test_where_an_absurd_pose_was_taken(street: MapScene) -> None:
    first = street.references[0].cam_from_map
    assert first is not None
    far = pose(np.eye(3), -(camera_centre(first) + np.array([1e8, 0.0, 0.0])))
    trace = replace(estimate(scene_problem("mei_outliers_80"), "ransac-2p"), cam_from_map=far)
    assert street.is_away(far) and where_taken(street, trace).startswith(f"Taken at {AWAY}.")
    near = camera_centre(first) + np.array([20.0 * street.extent_m, 0.0, 0.0])
    assert not street.is_away(pose(np.eye(3), -near))
    alone = tuple(replace(view, cam_from_map=None) for view in street.references)
    assert not replace(street, references=alone).is_away(far), "the extent of its map is not known"
