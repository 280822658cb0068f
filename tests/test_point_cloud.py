"""The points of a map around a run: which are drawn, and where the references were taken."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from recording_samples import scene_problem

from spherloc.datasets import bundled_scenes, load_scene
from spherloc.datasets.map_scene import MapScene
from spherloc.estimators import estimate
from spherloc.geometry import camera_centre, pose, yaw_rotation
from spherloc_viz import style
from spherloc_viz.layers import paint, steps
from spherloc_viz.layers.frame import length_text
from spherloc_viz.layers.point_cloud import (
    FEW_RAYS,
    MAX_NAMED,
    MAX_POINTS,
    REFERENCES,
    WRONG_RAYS,
    cloud_items,
    with_few_rays,
)
from spherloc_viz.layers.primitives import Label, Points, Segments
from spherloc_viz.layers.where_taken import where_taken


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
    assert dots.photographs == tuple(view.name for view in scene.references)


def test_references_are_cameras_that_look_where_they_looked() -> None:
    scene, turn = replace(street(), cloud=np.eye(3)), yaw_rotation(0.7)
    items = {item.name: item for item in cloud_items(scene, turn)}
    bodies, dots = items["cloud/cameras"], items[REFERENCES]
    assert isinstance(bodies, Segments) and isinstance(dots, Points) and bodies.layer == dots.layer
    poses = [view.cam_from_map for view in scene.references if view.cam_from_map is not None]
    lines = bodies.points.reshape(len(poses), -1, 2, 3)
    np.testing.assert_allclose(lines[:, 0, 0], dots.positions, atol=1e-9)
    axes = (lines[:, :4, 1] - lines[:, :4, 0]).sum(axis=1)
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    np.testing.assert_allclose(axes @ turn, [pose[2, :3] for pose in poses], atol=1e-9)
    apart = np.linalg.norm(np.diff(dots.positions, axis=0), axis=1).min()
    assert np.linalg.norm(lines[:, :4, 1] - lines[:, :4, 0], axis=2).max() < apart, "one does not reach into the next"


def test_of_many_lines_to_inliers_an_even_sample_is_drawn_and_told() -> None:
    trace = estimate(scene_problem("mei_outliers_80"), "ransac-2p")
    all_rays = paint(trace, len(steps(trace)) - 1)
    (rays,) = (item for item in all_rays.scene if item.name == "rays")
    assert isinstance(rays, Segments) and 0 < len(rays.points) <= FEW_RAYS and with_few_rays(all_rays, 20) is all_rays
    repeated = np.repeat(rays.points, 9, axis=0)
    apart = repeated + 1e-3 * np.arange(len(repeated))[:, None, None]
    many = replace(rays, points=apart, colors=np.repeat(rays.colors, 9, axis=0))
    crowded = replace(all_rays, scene=tuple(many if item is rays else item for item in all_rays.scene))
    (few,) = (item for item in with_few_rays(crowded, 701).scene if item.name == "rays")
    assert isinstance(few, Segments) and len(few.points) == len(few.colors) == FEW_RAYS
    assert np.array_equal(few.points[[0, -1]], many.points[[0, -1]])
    assert f"{FEW_RAYS} of the 701 lines" in with_few_rays(crowded, 701).step.note
    wrong = replace(many, name=WRONG_RAYS, points=many.points[:, ::-1])  # each begins where a line ends
    others = tuple(item for item in crowded.scene if item.name != WRONG_RAYS)
    thinned = with_few_rays(replace(crowded, scene=(*others, wrong)), 701)
    (halves,) = (item for item in thinned.scene if item.name == WRONG_RAYS)
    assert isinstance(halves, Segments) and len(halves.points) == len(halves.colors) < len(many.points)
    assert {tuple(end) for end in halves.points[:, 0]} == {tuple(end) for end in few.points[:, 1]}


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


def test_where_a_query_was_taken_is_told_by_the_nearest_references() -> None:
    scene = street()
    problem = scene_problem("mei_outliers_80")
    centres = [camera_centre(view.cam_from_map) for view in scene.references if view.cam_from_map is not None]
    along = (centres[1] - centres[0]) / np.linalg.norm(centres[1] - centres[0])
    trace = estimate(problem, "ransac-2p")
    here = centres[0] + 0.25 * np.linalg.norm(centres[1] - centres[0]) * along
    at = replace(trace, cam_from_map=pose(np.eye(3), -here))
    apart_m = sorted(float(np.linalg.norm(centre - here)) for centre in centres)[:2]
    said = where_taken(scene, at)
    names = [view.name for view in scene.references[:2]]
    assert said.startswith(
        f"Taken {length_text(apart_m[0])} from {names[0]} and {length_text(apart_m[1])} from {names[1]}."
    )
    assert "Its truth is the pose that the map's files give it" in said
    aligned = replace(scene, truth_source="mocap0/data.csv, which was aligned with the map: 9 images fit it")
    assert where_taken(aligned, at).endswith("Its truth is that of mocap0/data.csv, which was aligned with the map.")
    blind = replace(at, problem=replace(problem, truth_cam_from_map=None, truth_inliers=None))
    assert where_taken(scene, blind) == said.partition(" Its truth")[0]
    assert where_taken(scene, replace(at, cam_from_map=None)) == ""
    own = replace(scene, references=tuple(replace(view, path=Path("own.png")) for view in scene.references[:1]))
    own = replace(own, references=(*own.references, *scene.references[1:]))
    said = where_taken(own, replace(blind, problem=replace(blind.problem, image=Path("own.png"))))
    assert said.startswith(f"Taken {length_text(apart_m[1])} from {names[1]} and ") and names[0] not in said
    assert said.endswith("It is an image of the map itself.")


def test_references_whose_names_are_times_are_told_apart() -> None:
    """Of such a name neither the beginning nor the end says which image it is."""
    scene = street()
    names = [f"cam3/data/17000000{number:02d}000000000.png" for number in range(len(scene.references))]
    references = [replace(view, name=name) for view, name in zip(scene.references, names, strict=True)]
    timed = replace(scene, references=tuple(references))
    trace = replace(estimate(scene_problem("mei_outliers_80"), "ransac-2p"), cam_from_map=references[0].cam_from_map)
    said = where_taken(timed, trace)
    assert references[0].name in said and references[1].name in said
    long = replace(references[0], name=f"{'a' * 50}.png")
    assert long.name not in where_taken(replace(timed, references=(long, *references[1:])), trace)
