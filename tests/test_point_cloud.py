"""The points of a map around a run: which are drawn, and where the references were taken."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from spherloc.datasets import bundled_scenes, load_scene
from spherloc.datasets.map_scene import MapScene
from spherloc.geometry import camera_centre, yaw_rotation
from spherloc_viz import style
from spherloc_viz.layers.point_cloud import MAX_NAMED, MAX_POINTS, REFERENCES, cloud_items
from spherloc_viz.layers.primitives import Label, Points


def street() -> MapScene:
    scene = load_scene(Path(bundled_scenes()["street_fisheye"]))
    assert isinstance(scene, MapScene)
    return scene


def test_points_far_away_are_left_out_and_references_stand_where_they_were_taken(rng: np.random.Generator) -> None:
    inside = rng.uniform(-5.0, 5.0, (3 * MAX_POINTS, 3))
    scene = replace(street(), cloud=np.concatenate([inside, rng.uniform(400.0, 900.0, (50, 3))]))
    turn = yaw_rotation(0.7)
    items = {item.name: item for item in cloud_items(scene, turn)}
    points, dots = items["cloud/points"], items[REFERENCES]
    assert isinstance(points, Points) and isinstance(dots, Points) and points.layer in style.LAYERS
    assert len(points.positions) == MAX_POINTS and np.abs(points.positions).max() < 10.0
    assert points.ids is None, "a press picks matches, not points of the map"
    poses = [view.cam_from_map for view in scene.references if view.cam_from_map is not None]
    np.testing.assert_allclose(dots.positions @ turn, [camera_centre(pose) for pose in poses], atol=1e-9)


def test_few_references_are_named() -> None:
    scene = replace(street(), cloud=np.eye(3))
    few = replace(scene, references=scene.references[:MAX_NAMED])
    texts = [item.text for item in cloud_items(few, np.eye(3)) if isinstance(item, Label)]
    assert texts == [view.name for view in few.references]
    many = replace(scene, references=scene.references[: MAX_NAMED + 1])
    assert not any(isinstance(item, Label) for item in cloud_items(many, np.eye(3)))


def test_a_scene_with_a_mesh_or_without_points_has_none() -> None:
    assert cloud_items(street(), np.eye(3)) == ()
    assert cloud_items(replace(street(), cloud=np.empty((0, 3))), np.eye(3)) == ()
