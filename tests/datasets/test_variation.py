"""What a variation changes and what it leaves alone; and what a sentence says where it cannot be."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spherloc.cameras.base import in_image
from spherloc.datasets import load_scene
from spherloc.datasets.correspondences import CorrespondencesScene
from spherloc.datasets.variation import KEYS, Variation, parse_variation, settings_of
from spherloc.errors import InputError
from spherloc.geometry import transform
from tests.datasets.scene_texts import write
from tests.datasets.test_rendered import SMALL

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

COUNT = 40
NUMBERS = st.sets(st.integers(0, COUNT - 1), max_size=8)


@pytest.fixture(scope="module")
def scene(scene_of):
    return scene_of("fisheye", correspondences=COUNT, outlier_rate=0.5)


def measured(scene, seed=0, **changes):
    """The same matches as a measured scene."""
    return CorrespondencesScene(replace(scene.problem(seed), **changes))


def same(one, two):
    names = ("pixels", "points", "truth_inliers", "truth_cam_from_map", "gravity_camera")
    return all(np.array_equal(getattr(one, name), getattr(two, name)) for name in names)


def off_deg(problem, numbers):
    """Angle between measured and true bearings of matches, degrees."""
    numbers = list(numbers)
    true = transform(problem.truth_cam_from_map, problem.points[numbers])
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    return np.degrees(np.arccos(np.clip(np.sum(true * problem.bearings[numbers], axis=1), -1, 1)))


def test_the_defaults_change_nothing(scene):
    assert same(Variation().problem(scene), scene.problem()) and same(Variation().problem(scene, 5), scene.problem(5))
    problem = scene.problem()
    assert Variation().edit(problem, 0) is problem and Variation() == Variation().spoil([]) and not Variation().edited
    assert {Variation(spoiled=(3, 1, 3)): 1}[Variation(spoiled=(1, 3))] == 1


def test_a_simulation_is_changed_as_its_scene_would_be(scene):
    changes = {
        "correspondences": 30,
        "noise_px": 2.0,
        "outlier_rate": 0.2,
        "outlier_kind": "coherent",
        "field_of_view_deg": 150.0,
        "cloud_height_m": 4.0,
        "gravity_error_deg": 0.5,
        "true_camera": (30.0, 1.0, 0.0, 2.0),
    }
    assert same(Variation(**changes).problem(scene, 3), replace(scene, **changes).problem(3))


def test_another_camera_sees_the_same_simulation(scene, tmp_path, scene_of):
    other = scene_of("mei").camera
    path = tmp_path / "camera.toml"

    def write(camera):
        rows = [f"{key} = {list(value) if isinstance(value, tuple) else repr(value)}" for key, value in camera.items()]
        path.write_text("[camera]\n" + "\n".join(rows).replace("'", '"'))

    write(other.to_dict())
    problem = Variation(camera=str(path)).problem(scene)
    assert problem.camera == other and same(problem, replace(scene, camera=other).problem())
    write(other.to_dict() | {"fx": 1000.5})  # a file that was changed is read again
    assert Variation(camera=str(path)).problem(scene).camera.fx == 1000.5
    with pytest.raises(InputError, match=r"gone\.toml"):
        Variation(camera=str(tmp_path / "gone.toml")).problem(scene)


@settings(max_examples=40)
@given(spoiled=NUMBERS, mended=NUMBERS, hidden=NUMBERS, seed=st.integers(0, 3))
def test_edits_touch_the_named_matches_only(scene, spoiled, mended, hidden, seed):
    variation = Variation().spoil(spoiled).mend(mended).hide(hidden)
    before, after = scene.problem(seed), variation.problem(scene, seed)
    kept = variation.kept(COUNT)
    assert list(kept) == [number for number in range(COUNT) if number not in hidden] and len(after) == len(kept)
    np.testing.assert_array_equal(after.points, before.points[kept])
    touched = np.isin(kept, [*spoiled, *mended])
    np.testing.assert_array_equal(after.pixels[~touched], before.pixels[kept][~touched])
    np.testing.assert_array_equal(after.truth_inliers[~touched], before.truth_inliers[kept][~touched])
    right, wrong = np.isin(kept, list(mended)), np.isin(kept, list(spoiled - mended))
    assert after.truth_inliers[right].all() and not after.truth_inliers[wrong].any()
    assert (off_deg(after, np.flatnonzero(right)) < 1e-5).all()
    assert (off_deg(after, np.flatnonzero(wrong)) >= 9.999).all()
    assert after.usable.all() and in_image(after.camera, after.pixels).all()
    assert same(after, variation.problem(scene, seed)), "the same seed gives the same problem"


@settings(max_examples=30)
@given(first=NUMBERS, then=NUMBERS)
def test_the_last_word_about_a_match_counts(scene, first, then):
    assert Variation().spoil(first).mend(first) == Variation().mend(first)
    assert Variation().mend(first).spoil(first) == Variation().spoil(first)
    both = Variation().spoil(first).mend(then)
    assert set(both.spoiled) == first - then and set(both.mended) == then
    assert both.without_edits() == Variation() and both.edited == bool(first or then)


def test_a_spoiled_pixel_follows_from_seed_and_number(scene):
    alone, among = Variation(spoiled=(7,)), Variation(spoiled=(2, 7, 30), hidden=(1, 3))
    np.testing.assert_array_equal(among.problem(scene, 1).pixels[5], alone.problem(scene, 1).pixels[7])
    assert not np.array_equal(alone.problem(scene, 1).pixels[7], alone.problem(scene, 2).pixels[7])
    two = Variation(spoiled=(7, 8)).problem(scene, 1).pixels
    assert not np.array_equal(two[7], two[8])


def test_a_spoiled_pixel_stays_where_the_problem_has_its_matches(scene):
    """Not outside a field of view that was made narrower."""
    narrow = replace(scene, field_of_view_deg=80.0)
    problem = Variation(spoiled=tuple(range(COUNT))).problem(narrow)
    assert np.degrees(np.arccos(problem.bearings[:, 2])).max() <= 40.001
    assert len(np.unique(problem.pixels.round(3), axis=0)) == COUNT


def test_measured_matches_are_edited_too(scene):
    problem = Variation(spoiled=(3,), mended=(4,), hidden=(0,)).problem(measured(scene))
    assert len(problem) == COUNT - 1 and not problem.truth_inliers[2] and problem.truth_inliers[3]
    assert any("changed by hand: 1 spoiled, 1 mended, 1 hidden" in remark for remark in problem.remarks)
    unknown = measured(scene, truth_inliers=None, truth_cam_from_map=None)
    spoiled = Variation(spoiled=(3,)).problem(unknown)
    assert spoiled.truth_inliers is None
    angle = np.degrees(np.arccos(spoiled.bearings[3] @ unknown.measured.bearings[3]))
    assert angle >= 9.999, "without truth it is taken away from where it was"


def test_what_belongs_to_a_match_goes_with_it(scene, tmp_path):
    rows = {"reference_index": np.arange(COUNT) % 2, "reference_pixels": np.arange(2.0 * COUNT).reshape(-1, 2)}
    images = (tmp_path / "a.png", tmp_path / "b.png")
    problem = Variation(hidden=(0, 5)).problem(measured(scene, reference_images=images, **rows))
    kept = Variation(hidden=(0, 5)).kept(COUNT)
    np.testing.assert_array_equal(problem.reference_index, rows["reference_index"][kept])
    np.testing.assert_array_equal(problem.reference_pixels, rows["reference_pixels"][kept])


@pytest.mark.parametrize(
    ("variation", "sentence"),
    [
        ({"spoiled": (COUNT,)}, rf"no match {COUNT}: the problem has {COUNT}, numbered from 0 to {COUNT - 1}\."),
        ({"mended": (99,)}, "no match 99"),
        ({"hidden": (3, 99)}, "no match 99"),
        ({"hidden": range(COUNT - 1)}, "1 usable of 1 correspondences"),
        ({"noise_px": -1.0}, "noise_px is -1"),
        ({"outlier_rate": float("nan")}, "outlier_rate is nan"),
        ({"correspondences": 10**9}, "correspondences is 1000000000"),
        ({"outlier_kind": "evil"}, "outlier_kind is 'evil'; give one of random, coherent, repeated"),
        ({"field_of_view_deg": 1.0}, "field_of_view_deg is 1.0; give a number from 10 to 360"),
        ({"true_camera": (0.0, 1e9, 0.0, 0.0)}, "true_camera is .* give its yaw"),
        ({"true_camera": (0.0, float("nan"), 0.0, 0.0)}, "true_camera is .* give its yaw"),
        ({"true_camera": (0.0, 1.0)}, "true_camera is .* give its yaw"),
        ({"true_camera": (0.0, 0.0, 90.0, 0.0), "cloud_height_m": 0.1}, "no points are visible to the camera for 40"),
    ],
)
def test_what_cannot_be_is_a_sentence(scene, variation, sentence):
    with pytest.raises(InputError, match=sentence):
        Variation(**variation).problem(scene)


def test_what_a_scene_does_not_have_is_a_sentence(scene):
    without = measured(scene, truth_cam_from_map=None)
    for name, value in {"camera": "x.toml", "noise_px": 1.0, "true_camera": (0, 0, 0, 0)}.items():
        with pytest.raises(InputError, match=f"{name} can be changed in synthetic scenes only"):
            Variation(**{name: value}).problem(without)
    with pytest.raises(InputError, match=r"match 3 cannot be mended: the true pose of .* is not known"):
        Variation(mended=(3,)).problem(without)
    for one in (scene, without):
        with pytest.raises(InputError, match="no query images"):
            Variation().problem(one, query="a.png")
    unseen = measured(scene).measured.points.copy()
    unseen[3] = -1e3 * scene.problem().truth_cam_from_map[2, :3]
    with pytest.raises(InputError, match="match 3 cannot be mended: the camera does not see its point"):
        Variation(mended=(2, 3)).problem(measured(scene, points=unseen))


def test_contradictions_and_negative_numbers_are_sentences():
    with pytest.raises(InputError, match="match 3 is both to be spoiled and to be mended"):
        Variation(spoiled=(1, 3), mended=(3,))
    with pytest.raises(InputError, match="hidden names the match -1"):
        Variation(hidden=(-1,))


FINITE = st.floats(-1e6, 1e6)
CHANGES = st.fixed_dictionaries(
    {},
    optional={
        "camera": st.text(st.characters(codec="utf-8", categories=("L", "N", "P", "S")), min_size=1),
        "correspondences": st.integers(2, 10_000),
        "noise_px": FINITE,
        "outlier_rate": FINITE,
        "outlier_kind": st.sampled_from(["random", "coherent", "repeated"]),
        "field_of_view_deg": FINITE,
        "cloud_height_m": FINITE,
        "gravity_error_deg": FINITE,
        "true_camera": st.tuples(FINITE, FINITE, FINITE, FINITE),
    },
)


@settings(max_examples=60)
@given(CHANGES)
def test_what_is_typed_is_what_is_meant(changes):
    assert parse_variation(settings_of(Variation(**changes))) == Variation(**changes)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["noise=1"], "setting 'noise=1' is unknown; give KEY=VALUE with camera, correspondences,"),
        (["noise_px"], "setting 'noise_px' is unknown"),
        (["spoiled=1"], "setting 'spoiled=1' is unknown"),
        (["noise_px=1", "noise_px=2"], "setting noise_px is given twice"),
        (["noise_px=loud"], "setting noise_px is 'loud'; give a number"),
        (["correspondences=7.5"], "setting correspondences is '7.5'; give a whole number"),
        (["outlier_kind=bad"], "setting outlier_kind is 'bad'; give random, coherent or repeated"),
        (["true_camera=1,2,3"], "setting true_camera is '1,2,3'; give yaw,x,y,z"),
        (["camera="], "setting camera is ''; give the path"),
    ],
)
def test_what_is_mistyped_is_a_sentence(words, sentence):
    with pytest.raises(InputError, match=sentence):
        parse_variation(words)


@given(st.lists(st.text(max_size=30), max_size=3), st.text(max_size=12))
def test_whatever_is_typed_is_understood_or_a_sentence(words, numbers):
    for key in ("", *KEYS):
        try:
            parse_variation([f"{key}={word}" if key else word for word in words], numbers, None, numbers)
        except InputError as error:
            assert str(error).endswith(".")


def test_lists_of_matches(scene):
    assert parse_variation([], "3,5", "7", "1, 2") == Variation(spoiled=(3, 5), mended=(7,), hidden=(1, 2))
    for text in ("", "3;5", "3,x", "1.5"):
        with pytest.raises(InputError, match=r"spoil is .*; give the numbers of matches with commas"):
            parse_variation([], spoil=text)


def test_a_query_image_is_edited(tmp_path):
    """A rendered scene: its matches are spoiled and hidden, but it has no simulation."""
    images = load_scene(write(tmp_path, SMALL))
    whole = images.problem(query="query_001")
    variation = Variation(spoiled=(2,), hidden=(0, 1))
    edited = variation.problem(images, 4, "query_001")
    assert len(edited) == len(whole) - 2 and not edited.truth_inliers[0]
    np.testing.assert_array_equal(edited.reference_index, whole.reference_index[2:])
    with pytest.raises(InputError, match="outlier_rate can be changed in synthetic scenes only"):
        Variation(outlier_rate=0.5).problem(images)
