"""Pairs of images: a pose that neither clouds nor wind hide, which is sure, and which pairs LightGlue matches."""

import numpy as np
import pycolmap
import pytest

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.errors import InputError
from spherloc.frontend.features import Features, _joined
from spherloc.frontend.matching import MatchOptions
from spherloc.frontend.view import Gravity
from spherloc.geometry import DOWN, pose, rotation_angle, so3_exp, transform, yaw_rotation
from spherloc.mapping.two_view.pairs import SURE, ImagePairs, relative
from spherloc.mapping.two_view.telling import below_sky, far_rotation, unmoved

CAMERA = Equirectangular(2048, 1024)
FISHEYE = KannalaBrandt(800, 800, 250.0, 250.0, 400.0, 400.0, (0.0,) * 4)
BOUND = np.radians(0.5)
LEVEL = (DOWN, DOWN)


def unit(rows):
    return rows / np.linalg.norm(rows, axis=-1, keepdims=True)


def around(rng, count, lowest_deg, highest_deg):
    """Bearings (count, 3) in all directions, between two elevations."""
    yaw, up = rng.uniform(-np.pi, np.pi, count), np.radians(rng.uniform(lowest_deg, highest_deg, count))
    return np.column_stack([np.cos(up) * np.sin(yaw), -np.sin(up), np.cos(up) * np.cos(yaw)])


def street(rng, near, sky, wind_deg=0.0, wrong=40):
    """Bearings in two level panoramas two metres apart of ``near`` things, of ``sky``, which drifts across the way, and
    of ``wrong`` matches below the horizon; and the second camera's pose in the first's frame."""
    second = pose(yaw_rotation(0.7), yaw_rotation(0.7) @ [0.0, 0.0, -2.0])
    things = around(rng, near, -40.0, 10.0) * rng.uniform(3.0, 15.0, (near, 1))
    clouds = around(rng, sky, 20.0, 60.0)
    drift = clouds + np.radians(wind_deg) * np.array([1.0, 0.0, 0.0])
    here = unit(np.concatenate([things, clouds, around(rng, wrong, -40.0, 10.0)]))
    there = [transform(second, things), drift @ second[:, :3].T, around(rng, wrong, -40.0, 10.0)]
    return here, unit(np.concatenate(there)), second


def two_images(rng, here, there, parts=1, matching=None, promising=(), words=None, camera=CAMERA, fixed=None):
    """``ImagePairs`` of two images whose feature number i is at the bearing number i of each, in as many kinds."""
    words = rng.normal(size=(len(here), 128)).astype(np.float32) if words is None else words
    ones = np.ones(len(here))

    def image(rays):
        pixels, _ = camera.project(rays)
        kinds = [
            Features(pixels.copy(), 3.0 * ones, 0.0 * ones, ones.copy(), words.copy(), kind, (2048, 1024))
            for kind in ("sift", "aliked")[:parts]
        ]
        return _joined(kinds, "sift+aliked") if parts > 1 else kinds[0]

    every = np.arange(parts * len(here))
    gravity = [Gravity(DOWN, np.radians(0.5))] * 2
    features = [image(here), image(there)]
    known = {} if fixed is None else {(0, 1): (fixed[:, :3], unit(fixed[:, 3]))}
    matching = matching or MatchOptions()
    return ImagePairs(pycolmap, [camera] * 2, features, [every] * 2, gravity, matching, promising, known)


def test_far_matches_turn_alike(rng):
    here, there, second = street(rng, 150, 100)
    turn = far_rotation(here, there, BOUND)
    assert turn is not None and rotation_angle(turn @ second[:, :3].T) < 1e-3
    far = unmoved(here, there, turn, BOUND)
    assert far[150:250].all() and far[:150].mean() < 0.1 and far[250:].mean() < 0.05
    assert far_rotation(here[:1], there[:1], BOUND) is None and far_rotation(here[:0], there[:0], BOUND) is None
    assert far_rotation(np.repeat(here[:1], 9, axis=0), np.repeat(there[:1], 9, axis=0), BOUND) is None


def test_one_place_stays_one_place(rng):
    """Wrong matches beside those that all turned alike make no way between two images taken from one place."""
    rays, second = around(rng, 300, -60.0, 60.0), yaw_rotation(0.7)
    there = unit(rays @ second.T + 0.003 * rng.normal(size=rays.shape))
    wrong = around(rng, 60, -40.0, 10.0), around(rng, 60, -40.0, 10.0)
    pair = two_images(rng, np.concatenate([rays, wrong[0]]), np.concatenate([there, wrong[1]]))
    _, geometry = pair.compare(0, 1)
    assert geometry is not None and pair.same_place(geometry)


def test_a_calibration_tells_a_pose_that_few_matches_fit(rng):
    """Too few to find one among so many wrong ones; a pose that they do not fit is not taken."""
    here, there, second = street(rng, 18, 0, wrong=800)
    assert two_images(rng, here, there).compare(0, 1)[1] is None
    pair = two_images(rng, here, there, fixed=second)
    matches, geometry = pair.compare(0, 1)
    assert geometry is not None and pair.is_as_fixed((0, 1), geometry)
    assert pair.sureness(0, 1, matches, geometry) == np.inf
    assert len(set(geometry.inlier_matches[:, 0].tolist()) & set(range(18))) >= 15
    wrong = pose(yaw_rotation(0.9), second[:, 3])
    assert two_images(rng, here, there, fixed=wrong).compare(0, 1)[1] is None
    here, there, second = street(rng, 150, 0)
    pair = two_images(rng, here, there, fixed=wrong)
    matches, geometry = pair.compare(0, 1)
    assert geometry is not None and not pair.is_as_fixed((0, 1), geometry)
    assert rotation_angle(relative(geometry)[0] @ second[:, :3].T) < np.radians(0.7), "as the matches have it"


def test_what_is_high_in_either_image_may_be_sky(rng):
    here = around(rng, 50, -80.0, 14.0)
    high = around(rng, 50, 16.0, 80.0)
    assert below_sky(here, here, LEVEL).all()
    assert not below_sky(high, here, LEVEL).any() and not below_sky(here, high, LEVEL).any()
    tilt = so3_exp([0.0, 0.0, 0.6])
    assert below_sky(here @ tilt.T, here, (tilt @ DOWN, DOWN)).all()


@pytest.mark.parametrize("wind_deg", [0.0, 4.0])
def test_clouds_do_not_hide_the_way(rng, wind_deg):
    """Four times as many matches are of clouds, and fit any direction, or that of the wind."""
    here, there, second = street(rng, 60, 240, wind_deg)
    _, geometry = two_images(rng, here, there).compare(0, 1)
    assert geometry is not None
    turn, way = relative(geometry)
    assert rotation_angle(turn @ second[:, :3].T) < np.radians(0.7)
    assert way @ unit(second[:, 3]) > np.cos(np.radians(4.0))


def test_a_pose_of_drifting_clouds_is_none(rng):
    """Nothing below them matches, so that nothing shows where the camera went."""
    here, there, _ = street(rng, 0, 240, wind_deg=4.0, wrong=60)
    _, geometry = two_images(rng, here, there).compare(0, 1)
    assert geometry is None


def test_matches_that_fit_without_a_pose_are_no_pose(rng, monkeypatch):
    """COLMAP says of some degenerate matches that they fit, but gives no pose."""
    here, there, _ = street(rng, 150, 100)
    pair = two_images(rng, here, there)
    without = pycolmap.TwoViewGeometry()
    without.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
    without.inlier_matches = np.tile(np.arange(len(here), dtype=np.uint32)[:, None], 2)
    monkeypatch.setattr(pair, "_estimated", lambda *_: without)
    _, geometry = pair.compare(0, 1)
    assert geometry is None


@pytest.mark.parametrize(
    ("camera", "right", "alike", "unsure"),
    [
        (FISHEYE, 45, 0, False),
        (FISHEYE, 45, 400, True),
        (FISHEYE, 150, 400, False),
        (CAMERA, 70, 0, False),
        (CAMERA, 70, 400, True),
        (CAMERA, 300, 400, False),
    ],
)
def test_a_pose_is_sure_if_no_other_direction_has_nearly_as_many_matches(rng, camera, right, alike, unsure):
    """Floors and wallpaper, where each feature has many like it, match whatever the direction is."""
    count, second = right + alike, pose(yaw_rotation(0.3), [0.5, 0.0, 0.2])
    things = rng.uniform([-4.0, -3.0, 2.0], [4.0, 3.0, 6.0], (count, 3))
    there = np.concatenate([transform(second, things[:right]), rng.uniform([-4, -3, 2], [4, 3, 6], (alike, 3))])
    words = rng.normal(size=(count, 128)).astype(np.float32)
    words[right:] = rng.normal(size=128) + 0.2 * rng.normal(size=(alike, 128))
    pair = two_images(rng, things, there, words=words, camera=camera)
    geometry = pair._estimated(0, 1, np.tile(np.arange(right, dtype=np.uint32)[:, None], 2))
    matches = np.tile(np.arange(count, dtype=np.uint32)[:, None], 2)
    assert rotation_angle(relative(geometry)[0] @ second[:, :3].T) < np.radians(0.2)
    assert bool(pair.sureness(0, 1, matches, geometry) < SURE) is unsure


@pytest.mark.parametrize(
    ("right", "widest_deg", "alike", "sure"),
    [
        (60, 35.0, 0, True),
        (60, 35.0, 300, False),
        (60, 110.0, 300, True),
        (30, 110.0, 2400, False),
        (180, 110.0, 2400, True),
    ],
)
def test_panoramas_that_fit_in_a_part_of_the_view_need_a_higher_peak(rng, right, widest_deg, alike, sure):
    """A floor has many features like each other, which match whatever the direction is, and fills a part of the view;
    where matches fit all around, the same peak is enough, and many of them are enough in any case."""
    second = pose(yaw_rotation(0.3), [0.5, 0.0, 0.2])
    up = np.arccos(rng.uniform(np.cos(np.radians(widest_deg)), 1.0, right + alike))
    turn = rng.uniform(-np.pi, np.pi, right + alike)
    things = np.column_stack([np.sin(up) * np.cos(turn), np.sin(up) * np.sin(turn), np.cos(up)])
    things *= rng.uniform(1.0, 4.0, (right + alike, 1))
    there = transform(second, np.concatenate([things[:right], rng.permutation(things[right:])]))
    words = rng.normal(size=(right + alike, 128)).astype(np.float32)
    words[right:] = rng.normal(size=128) + 0.2 * rng.normal(size=(alike, 128))
    pair = two_images(rng, things, there, words=words)
    matches = np.tile(np.arange(right, dtype=np.uint32)[:, None], 2)
    geometry = pair._estimated(0, 1, matches)
    assert bool(pair.sureness(0, 1, matches, geometry) >= SURE) is sure


def test_lightglue_matches_promising_pairs_only(rng, tmp_path):
    """Of others, the features of the first kind are matched by nearest neighbours."""
    here, there, second = street(rng, 100, 0)
    lightglue = MatchOptions("lightglue", weights=tmp_path / "none.onnx")
    pairs, geometry = two_images(rng, here, there, 2, lightglue).compare(0, 1)
    assert pairs.max() < len(here) and rotation_angle(relative(geometry)[0] @ second[:, :3].T) < np.radians(0.7)
    with pytest.raises(InputError, match=r"none\.onnx"):
        two_images(rng, here, there, 2, lightglue, {(0, 1)}).compare(0, 1)
