"""Rotations that agree, matches near epipolar planes, and pairs that are found by way of a third image."""

from itertools import combinations

import numpy as np
import pytest

from spherloc.geometry import pose, rotation_angle, so3_exp, transform
from spherloc.mapping.two_view.guided import guided_matches
from spherloc.mapping.two_view.rotations import agreeing
from spherloc.mapping.two_view.triangles import open_triangles, through


def unit(rows):
    return rows / np.linalg.norm(rows, axis=-1, keepdims=True)


def cameras(rng, count):
    """Poses (3, 4) of cameras in a room, turned anyhow."""
    return [pose(so3_exp(rng.normal(size=3)), rng.normal(size=3)) for _ in range(count)]


def relative(poses, i, j):
    turn = poses[j][:, :3] @ poses[i][:, :3].T
    return turn, unit(poses[j][:, 3] - turn @ poses[i][:, 3])


@pytest.mark.parametrize("wrong_matches", [80, 300])
def test_pairs_of_alike_places_disagree(rng, wrong_matches):
    """Two rooms of six images each, and a third of the pairs between them turned by anything, with many matches."""
    poses = cameras(rng, 12)
    rotations, matches, wrong = {}, {}, set()
    for i, j in combinations(range(12), 2):
        if abs(i - j) > 3:
            continue
        turn = so3_exp(np.radians(0.5) * rng.normal(size=3)) @ relative(poses, i, j)[0]
        rotations[i, j], matches[i, j] = turn, 100
        if (i < 6) != (j < 6) and (i + j) % 3 == 0:
            rotations[i, j], matches[i, j] = so3_exp([0.0, 0.8 + 0.1 * i, 0.0]) @ turn, wrong_matches
            wrong.add((i, j))
    assert wrong and agreeing(rotations, matches) == rotations.keys() - wrong


def test_pairs_in_no_loop_are_kept(rng):
    poses = cameras(rng, 4)
    rotations = {(i, i + 1): relative(poses, i, i + 1)[0] for i in range(3)}
    assert agreeing(rotations, dict.fromkeys(rotations, 20)) == rotations.keys()
    assert agreeing({}, {}) == set()


def test_matches_near_the_planes(rng):
    """Of features that all look alike in threes, those on the same plane are told apart."""
    poses = cameras(rng, 2)
    points = rng.normal(size=(300, 3)) * 4.0
    rays = tuple(unit(transform(one, points)) for one in poses)
    looks = np.repeat(unit(rng.normal(size=(100, 32))), 3, axis=0)
    words = tuple(unit(looks + 0.02 * rng.normal(size=looks.shape)).astype(np.float32) for _ in range(2))
    turn, direction = relative(poses, 0, 1)
    found = guided_matches(rays, words, turn, direction, np.radians(0.3))
    right = found[:, 0] == found[:, 1]
    assert right.sum() > 200 and right.mean() > 0.97
    assert len(np.unique(found[:, 1])) == len(found)
    assert len(guided_matches(rays, words, turn, -direction, np.radians(0.3))) < 30  # all would be behind
    none = np.empty((0, 3)), np.empty((0, 32), np.float32)
    assert len(guided_matches((none[0], rays[1]), (none[1], words[1]), turn, direction, 0.01)) == 0


def test_a_pair_by_way_of_an_image_between(rng):
    """Ten right matches of a hundred; without any there is no pose."""
    poses = cameras(rng, 3)
    known = {(0, 1): relative(poses, 0, 1), (1, 2): relative(poses, 1, 2)}
    assert open_triangles(known) == {(0, 2): [1]} and open_triangles({**known, (0, 2): known[0, 1]}) == {}
    points = rng.normal(size=(100, 3)) * 4.0
    first, second = (unit(transform(poses[place], points)) for place in (0, 2))
    turn, direction = relative(poses, 0, 2)
    wrong = np.roll(second, 7, axis=0)
    mixed = np.concatenate([second[:10], wrong[10:]])
    found = through(known, (0, 2), [1], (first, mixed), np.radians(0.5))
    assert found is not None
    assert rotation_angle(found[0] @ turn.T) < 1e-6 and found[1] @ direction > np.cos(np.radians(5.0))
    assert through(known, (0, 2), [1], (first, wrong), np.radians(0.5)) is None
    backwards = {(0, 1): known[0, 1], (0, 2): relative(poses, 0, 2)}
    middle = unit(transform(poses[1], points))
    found = through(backwards, (1, 2), [0], (middle, second), np.radians(0.5))
    assert found is not None and found[1] @ relative(poses, 1, 2)[1] > np.cos(np.radians(5.0))
