"""True poses of queries by the ground truth of the sequence that the map is of."""

import tomllib

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spherloc.geometry import inverse_pose, pose, rotation_angle
from spherloc.mapping.alignment.true_poses import GroundTruth, aligned_truth, ground_truth, truth_words
from spherloc.mapping.images.photographs import Photographs, photographs
from spherloc.mapping.scenes.new_images import NewImages, new_images_of
from spherloc.mapping.scenes.scene_files import UNITS_METRES, MapHead, write_new_scene
from tests.datasets.asl_tree import euroc, tum_vi

SCALE, TURN, SHIFT = 1.3, Rotation.random(random_state=3).as_matrix(), np.array([4.0, -2.0, 7.0])
"""The similarity from the map to the ground truth."""


def in_map(truth_from_camera):
    """``cam_from_map`` (3, 4) of a camera in the ground truth."""
    centre = TURN.T @ (truth_from_camera[:3, 3] - SHIFT) / SCALE
    return inverse_pose(pose(TURN.T @ truth_from_camera[:3, :3], centre))


def mapped_and_others(folder):
    """The images of a sequence by the half: those of a map, and others."""
    views = photographs(folder, {}).views
    return views[::2], views[1::2]


def expected(tree, views):
    cameras = {view.name: ("cam1" if "cam1" in view.name else "cam0") for view in views}
    times = {view.name: int(view.path.stem) for view in views}
    return {
        name: in_map(tree.world_from_body[times[name]] @ tree.body_from_camera[camera])
        for name, camera in cameras.items()
    }


@pytest.mark.parametrize("write", [euroc, tum_vi])
def test_the_truth_is_aligned_with_the_map(tmp_path, rng, write):
    """Three of the map's images are far from their places, which does not matter. One query is later than the truth."""
    tree = write(tmp_path / "room", rng)
    table = next(path for path in tree.mav.glob("*0/data.csv") if "imu" not in str(path) and "cam" not in str(path))
    table.write_text("\n".join(table.read_text().splitlines()[:-1]))
    mapped, others = mapped_and_others(tree.folder)
    truth = ground_truth(tree.folder, others, mapped)
    poses = expected(tree, mapped)
    for name in list(poses)[:3]:
        poses[name] = poses[name] + np.array([[0, 0, 0, 5.0]])
    aligned, known = aligned_truth(truth, poses), expected(tree, others)
    late = {name for name in known if str(tree.times[-1]) in name}
    assert late and aligned.poses.keys() == known.keys() - late
    for name, found in aligned.poses.items():
        np.testing.assert_allclose(found, known[name], atol=1e-4)
    assert truth.source in aligned.said and "9 of " in aligned.said and "aligned with the map" in truth_words(aligned)
    new, _ = new_images_of(tree.mav / "cam1", Photographs(mapped, (), {view.name: view.camera for view in mapped}))
    assert {f"cam1/{name}" for name in new.truth.of_queries} <= {
        str(path.relative_to(tree.mav)) for path in tree.mav.glob("cam1/data/*")
    }
    np.testing.assert_allclose(
        aligned_truth(new.truth, poses).poses[f"data/{tree.times[1]}.png"],
        in_map(tree.world_from_body[tree.times[1]] @ tree.body_from_camera["cam1"]),
        atol=1e-4,
    )


def test_the_scene_has_them_and_says_what_they_are(tmp_path, rng):
    tree = euroc(tmp_path / "room", rng)
    mapped, others = mapped_and_others(tree.folder)
    truth = ground_truth(tree.folder, others, mapped)
    head, new = MapHead("m", "a", "..", UNITS_METRES, ("", "[gravity]")), NewImages(tree.folder, others, {}, truth)
    aligned = aligned_truth(truth, expected(tree, mapped))
    table = tomllib.loads(write_new_scene(head, tmp_path, new, others[0].camera, aligned).read_text())
    assert table["truth_source"] == aligned.said and sorted(table["truth"]) == sorted(view.name for view in others)
    np.testing.assert_allclose(table["truth"][others[0].name], expected(tree, others)[others[0].name], atol=1e-4)
    none = aligned_truth(GroundTruth(why_none="mocap0/data.csv has no rotations"), {})
    text = write_new_scene(head, tmp_path, new, others[0].camera, none).read_text()
    assert "truth" not in tomllib.loads(text) and "# No true poses: mocap0/data.csv has no rotations." in text


def truth_of(centres, turns, queries=1):
    """A ground truth (the last ``queries`` are such), and the poses of the map that are right for it."""
    found = {f"{k}": pose(turn, centre) for k, (centre, turn) in enumerate(zip(centres, turns, strict=True))}
    names = list(found)
    truth = GroundTruth(
        {name: found[name] for name in names[:-queries]}, {name: found[name] for name in names[-queries:]}, "t.csv"
    )
    return truth, {name: in_map(one) for name, one in found.items()}


def test_images_along_a_line_are_turned_by_their_rotations(rng):
    """Positions on a line leave the rotation about it open."""
    line = np.outer(np.arange(12.0), [1.0, 2.0, -1.0]) + 1e-3 * rng.normal(size=(12, 3))
    turns = Rotation.random(12, random_state=1).as_matrix()
    truth, poses = truth_of([*line, [3.0, 9.0, 2.0]], [*turns, np.eye(3)])
    noisy = {name: np.column_stack([one[:, :3], one[:, 3] + 2e-3 * rng.normal(size=3)]) for name, one in poses.items()}
    found = aligned_truth(truth, noisy).poses["12"]
    assert rotation_angle(found[:, :3] @ poses["12"][:, :3].T) < np.radians(0.1)
    np.testing.assert_allclose(inverse_pose(found)[:, 3], inverse_pose(poses["12"])[:, 3], atol=0.02)


def test_a_map_that_fits_badly_has_no_true_poses(rng):
    truth, poses = truth_of(10.0 * rng.normal(size=(20, 3)), Rotation.random(20, random_state=2).as_matrix())
    assert aligned_truth(truth, poses).poses
    moved = {name: one + np.column_stack([np.zeros((3, 3)), rng.normal(size=3)]) for name, one in poses.items()}
    turned = Rotation.from_euler("x", 4.0, degrees=True).as_matrix()
    turned = {name: turned @ one for name, one in poses.items()}
    for wrong in (moved, turned):
        aligned = aligned_truth(truth, wrong)
        assert not aligned.poses and "t.csv fits the map badly: " in aligned.said
    aligned = aligned_truth(truth, {name: poses[name] for name in ("1", "2", "3")})
    assert not aligned.poses and "could not be aligned with the map: only 3 images" in aligned.said
    assert truth_words(aligned).startswith("True poses are not known: t.csv could")


def test_why_there_is_none(tmp_path, rng):
    """Another sequence may have another frame, and a laser tracker measures no rotations."""
    tree, other = euroc(tmp_path / "room", rng), euroc(tmp_path / "hall", rng)
    mapped, others = mapped_and_others(tree.folder)
    elsewhere = photographs(other.folder, {}).views
    assert "may have another frame" in aligned_truth(ground_truth(other.folder, elsewhere, mapped), {}).said
    (tree.mav / "leica0").mkdir()
    rows = [f"{time}, {k}.5, 2.0, 3.0" for k, time in enumerate(tree.times)]
    (tree.mav / "leica0" / "data.csv").write_text("\n".join(rows))
    best = tree.mav / "state_groundtruth_estimate0" / "data.csv"
    assert ground_truth(tree.folder, others, mapped).source == "mav0/state_groundtruth_estimate0/data.csv"
    best.write_text(best.read_text().replace("15205303", "14005303"))
    assert "estimate0/data.csv is of other times" in ground_truth(tree.folder, others, mapped).why_none
    best.unlink()
    assert ground_truth(tree.folder, others, mapped).why_none == "mav0/leica0/data.csv has no rotations"
    (tree.mav / "leica0" / "data.csv").unlink()
    assert ground_truth(tree.folder, others, mapped) is None and ground_truth(tmp_path, others, mapped) is None
