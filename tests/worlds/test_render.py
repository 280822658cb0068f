"""Pictures of the worlds: exact depth, the same place through every camera, honest conditions."""

import cv2
import numpy as np
import pytest
from world_cameras import TABLES, camera

from spherloc.errors import InputError
from spherloc.geometry import camera_centre, transform
from spherloc.worlds import WORLDS, Conditions, build_world
from spherloc.worlds.conditions import LIGHTS, SEASONS
from spherloc.worlds.render import draw

KINDS = sorted(WORLDS)


def pixels_of(cam):
    columns, rows = np.meshgrid(np.arange(cam.width) + 0.5, np.arange(cam.height) + 0.5)
    return np.column_stack([columns.ravel(), rows.ravel()])


def points_of(cam, cam_from_world, range_m):
    """World points (H * W, 3) of a picture's distances."""
    bearings, _ = cam.unproject(pixels_of(cam))
    return bearings @ cam_from_world[:, :3] * range_m.reshape(-1, 1) + camera_centre(cam_from_world)


def nearest_hit(mesh, origin, directions):
    """Möller and Trumbore's test of every ray with every triangle, in double precision."""
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    ranges = []
    for direction in directions:
        p = np.cross(direction, c - a)
        determinant = ((b - a) * p).sum(axis=1)
        with np.errstate(all="ignore"):
            u = ((origin - a) * p).sum(axis=1) / determinant
            q = np.cross(origin - a, b - a)
            v = q @ direction / determinant
            t = ((c - a) * q).sum(axis=1) / determinant
        ranges.append(np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-6), t, np.inf).min())
    return np.array(ranges)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("model", sorted(TABLES))
def test_distances_are_those_of_the_triangles(kind, model, rng):
    world, cam = build_world(kind), camera(model)
    place = world.route(1, offset_m=0.3, heading_deg=20, start=0.4, stop=0.4)[0]
    range_m = draw(world, cam, place).range_m.ravel()
    chosen = rng.choice(np.flatnonzero(~np.isnan(range_m)), 40, replace=False)
    bearings, _ = cam.unproject(pixels_of(cam)[chosen])
    exact = nearest_hit(world.mesh, camera_centre(place), bearings @ place[:, :3])
    found = range_m[chosen].astype(np.float64)
    hit = np.isfinite(exact) & np.isfinite(found)
    # A ray that meets an edge may see either side of it.
    with np.errstate(invalid="ignore"):
        off = np.where(hit, np.abs(found - exact), 0.0)
    agree = np.where(hit, off < 1e-5 * np.maximum(exact, 1), exact == found)
    assert agree.sum() >= 39
    assert hit.sum() >= 16


@pytest.mark.parametrize("model", sorted(TABLES))
def test_nan_exactly_where_the_camera_is_blind(model):
    cam = camera(model)
    world = build_world("apartment")
    picture = draw(world, cam, world.route(1, start=0.5)[0])
    seen = cam.unproject(pixels_of(cam))[1].reshape(cam.height, cam.width)
    assert (np.isnan(picture.range_m) == ~seen).all()
    assert not picture.image[~seen].any()
    assert np.isfinite(picture.range_m[seen]).mean() > 0.995  # rooms are closed


def test_the_ground_is_level_and_the_eye_at_its_height():
    world, cam = build_world("street"), camera("equirectangular")
    place = world.route(1, start=0.5)[0]
    assert camera_centre(place)[2] == pytest.approx(1.6)
    points = points_of(cam, place, draw(world, cam, place).range_m).reshape(cam.height, cam.width, 3)
    assert np.abs(points[-6:, :, 2]).max() < 0.01  # straight down: road and its markings


@pytest.mark.parametrize("kind", KINDS)
def test_one_place_through_two_cameras(kind):
    """A world point seen by the fisheye is where the panorama of another pose sees it, in the same colour."""
    world, fisheye, panorama = build_world(kind), camera("mei"), camera("equirectangular", width=512, height=256)
    first = world.route(1, start=0.5)[0]
    second = world.route(1, offset_m=0.05, heading_deg=70, start=0.505)[0]
    conditions = Conditions(light="overcast")
    here, there = (draw(world, c, p, conditions) for c, p in ((fisheye, first), (panorama, second)))
    points = points_of(fisheye, first, here.range_m)
    seen = np.isfinite(points).all(axis=1)
    in_second = transform(second, points[seen])
    spots = panorama.project(in_second)[0].astype(int)
    distance = np.linalg.norm(in_second, axis=1)
    same = np.abs(there.range_m[spots[:, 1], spots[:, 0]] / distance - 1) < 0.02
    assert same.mean() > 0.85
    colours = here.image.reshape(-1, 3)[seen][same].astype(int)
    difference = np.abs(colours - there.image[spots[:, 1], spots[:, 0]][same]).mean(axis=1)
    assert np.median(difference) < 8


def test_far_facades_are_calm():
    """A small picture is about the mean of a large one: what is finer than a pixel does not flicker."""
    world = build_world("campus")
    place = world.route(1, start=0.3)[0]
    small = draw(world, camera("equirectangular"), place).image
    large = draw(world, camera("equirectangular", width=768, height=384), place).image
    mean = cv2.resize(large, (192, 96), interpolation=cv2.INTER_AREA)
    difference = np.abs(small.astype(int) - mean).mean(axis=2)
    point_sampled = np.abs(large[2::4, 2::4].astype(int) - mean).mean()
    assert difference.mean() < 0.7 * point_sampled
    assert np.percentile(difference, 95) < 12


def test_panorama_has_no_seam():
    world, cam = build_world("campus"), camera("equirectangular")
    conditions = Conditions(light="overcast", motion_blur_px=6, defocus_px=1)
    image = draw(world, cam, world.route(1)[0], conditions).image.astype(int)
    step = np.abs(np.diff(image, axis=1)).mean(axis=(0, 2))
    assert np.abs(image[:, 0] - image[:, -1]).mean() < 2 * np.median(step) + 1


@pytest.mark.parametrize("kind", KINDS)
def test_same_seed_same_picture(kind):
    conditions = Conditions(occluders=5, noise=6.0, light="dusk", season="autumn")
    place = build_world(kind).route(1, start=0.6)[0]
    first = draw(build_world(kind), camera("mei"), place, conditions, seed=3)
    again = draw(WORLDS[kind](0), camera("mei"), place, conditions, seed=3)
    other = draw(build_world(kind), camera("mei"), place, conditions, seed=4)
    assert (first.image == again.image).all()
    np.testing.assert_array_equal(first.range_m, again.range_m)
    assert (first.image != other.image).any()
    assert not np.array_equal(first.range_m, other.range_m, equal_nan=True)


@pytest.mark.parametrize("kind", KINDS)
def test_occluders_change_only_what_is_behind_them(kind):
    world, cam = build_world(kind), camera("equirectangular", width=256, height=128)
    place = world.route(1, start=0.45)[0]
    light = "overcast"  # no shadows of the sun
    free = draw(world, cam, place, Conditions(light=light))
    full = draw(world, cam, place, Conditions(light=light, occluders=12), seed=1)
    nearer = full.range_m < free.range_m - 1e-4
    assert 0.002 < nearer.mean() < 0.5
    assert (full.range_m <= free.range_m).all()
    around = cv2.dilate(nearer.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    changed = (full.image != free.image).any(axis=2)
    if not world.indoor:  # where lamps are on, things throw shadows
        assert (changed & ~around).mean() < 1e-3  # an arm thinner than a pixel beside an edge of the world
    assert changed[nearer].mean() > 0.9


def test_nothing_stands_in_the_camera():
    for kind in KINDS:
        world, cam = build_world(kind), camera("equirectangular")
        for seed, place in enumerate(world.route(3, start=0.1, stop=0.9)):
            assert np.nanmin(draw(world, cam, place, Conditions(occluders=20), seed).range_m) > 0.3


def test_lights_and_seasons():
    world, cam = build_world("campus"), camera("equirectangular")
    place = world.route(1, start=0.5)[0]
    means = {light: draw(world, cam, place, Conditions(light=light)).image.mean() for light in LIGHTS}
    assert means["night"] < means["dusk"] < means["day"]
    seasons = {season: draw(world, cam, place, Conditions(season=season)).image.astype(int) for season in SEASONS}
    ground = {season: image[60:].mean() for season, image in seasons.items()}
    assert ground["winter"] > 1.3 * ground["summer"]
    assert len({image.tobytes() for image in seasons.values()}) == len(SEASONS)


def test_the_sun_can_be_moved():
    world, cam = build_world("street"), camera("equirectangular")
    place = world.route(1, start=0.5)[0]
    left = draw(world, cam, place, Conditions(sun_azimuth_deg=90, sun_elevation_deg=35)).image[30:48]
    right = draw(world, cam, place, Conditions(sun_azimuth_deg=-90, sun_elevation_deg=35)).image[30:48]
    middle = cam.width // 2
    # The sun from the left (+y) lights the houses on the right.
    assert left[:, middle:].mean() > right[:, middle:].mean() + 5
    assert right[:, :middle].mean() > left[:, :middle].mean() + 5


def test_noise_exposure_and_blur():
    world, cam = build_world("apartment"), camera("equirectangular")
    place = world.route(1, start=0.5)[0]

    def picture(**conditions):
        return draw(world, cam, place, Conditions(**conditions)).image.astype(float)

    clean = picture()
    inner = (clean > 30) & (clean < 220)
    assert (picture(noise=5.0) - clean)[inner].std() == pytest.approx(5.0, rel=0.05)
    assert picture(exposure_stops=1.0).mean() > clean.mean() + 20
    edges = np.abs(np.diff(clean, axis=1)).mean()
    assert np.abs(np.diff(picture(motion_blur_px=7), axis=1)).mean() < 0.6 * edges
    assert np.abs(np.diff(picture(defocus_px=2), axis=1)).mean() < 0.6 * edges


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"light": "noon"}, "there are day"),
        ({"season": "monsoon"}, "there are summer"),
        ({"occluders": 2.5}, "whole number"),
        ({"occluders": True}, "whole number"),
        ({"noise": float("nan")}, "from 0 to 80"),
        ({"motion_blur_px": -1}, "from 0 to 40"),
        ({"sun_elevation_deg": "high"}, "from 2 to 90"),
        ({"light": ["day"]}, "there are day"),
    ],
)
def test_impossible_conditions(changes, words):
    with pytest.raises(InputError, match=words) as caught:
        Conditions(**changes)
    assert str(caught.value).count(".") <= 2 and "\n" not in str(caught.value)
