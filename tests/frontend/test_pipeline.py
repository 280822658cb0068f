"""The whole front end on pictures of rooms whose geometry is known: real features, real matching, exact truth."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from textured_rooms import FISHEYE, MEI, PANORAMA, room_view, standing, wallpaper

from spherloc.datasets.map_scene import MapScene
from spherloc.diagnosis import Cause, diagnose
from spherloc.errors import InputError, ProblemError
from spherloc.estimators import estimate
from spherloc.frontend.features import FeatureOptions, extract
from spherloc.frontend.lifting import DepthLift, SfmLift
from spherloc.frontend.pipeline import frontend_options, image_matcher
from spherloc.frontend.triangulation import TriangulationLift
from spherloc.frontend.view import View
from spherloc.geometry import camera_centre, rotation_angle

CAMERAS = {"panorama": PANORAMA, "fisheye": FISHEYE, "mei": MEI}
DOWN = np.array([0.0, 1.0, 0.0])


@pytest.fixture(autouse=True, scope="module")
def _own_cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SPHERLOC_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("rooms")


@pytest.fixture(scope="module")
def references(folder) -> dict[str, View]:
    walls = wallpaper(1)
    return {name: room_view(folder, f"r_{name}", CAMERAS[name], standing(0.0, 0.0, 0.0), walls) for name in CAMERAS}


@pytest.fixture(scope="module")
def queries(folder) -> dict[str, View]:
    walls = wallpaper(1)
    return {name: room_view(folder, f"q_{name}", CAMERAS[name], standing(0.4, 0.3, 0.3), walls) for name in CAMERAS}


def matcher(references, table=None, pairs=None):
    return image_matcher(tuple(references), {"max_features": 700} | (table or {}), "scene.toml", Path(), pairs)


def map_scene(references, queries, table=None):
    references = tuple(references)
    return MapScene("rooms", "scene.toml", tuple(queries), references, matcher(references, table), DOWN)


@pytest.mark.parametrize("of_query", CAMERAS)
@pytest.mark.parametrize("of_reference", CAMERAS)
def test_a_query_is_localized_against_a_reference_of_any_other_model(references, queries, of_reference, of_query):
    query = queries[of_query]
    problem = map_scene([references[of_reference]], [query]).problem()
    assert len(problem) > 40 and problem.truth_inliers is not None
    assert problem.truth_inliers.mean() > 0.5
    pose, truth = estimate(problem, "ransac-2p").cam_from_map, query.cam_from_map
    assert pose is not None and truth is not None
    assert np.degrees(rotation_angle(pose[:, :3] @ truth[:, :3].T)) < 0.3
    assert np.linalg.norm(camera_centre(pose) - camera_centre(truth)) < 0.03


def test_the_outlier_rate_is_about_right(references, queries):
    """And exactly that share of wrong matches is what the truth labels; the guess is rough by its nature."""
    for name in CAMERAS:
        problem = map_scene(references.values(), [queries[name]]).problem()
        assert problem.truth_inliers is not None and problem.estimated_outlier_rate is not None
        assert abs(problem.estimated_outlier_rate - (1 - problem.truth_inliers.mean())) < 0.15


def test_references_are_ranked_by_their_correspondences(references, queries):
    matches = matcher(references.values())(queries["fisheye"])
    counts = np.bincount(matches.reference_index, minlength=len(matches.references))
    assert matches.references[0].camera.model == "kannala_brandt"
    assert counts[0] == counts.max()
    for place, view in enumerate(matches.references):
        mine = matches.reference_index == place
        points, has = view.lift(matches.reference_pixels[mine])  # pyright: ignore[reportOptionalCall]
        assert has.all() and np.array_equal(points, matches.points[mine])


def twin(view, folder, name, shift_m=0.0):
    """The same picture in another file; its points are moved."""
    path = folder / f"{name}.png"
    path.write_bytes(view.path.read_bytes())

    def lift(pixels):
        points, has = view.lift(pixels)
        return points + shift_m, has

    return replace(view, name=name, path=path, lift=lift)


def test_the_same_point_from_two_references_counts_once(references, queries, folder):
    one = references["fisheye"]
    alone = matcher([one])(queries["fisheye"])
    both = matcher([one, twin(one, folder, "twin", 0.001)])(queries["fisheye"])
    assert np.array_equal(both.pixels, alone.pixels) and np.array_equal(both.points, alone.points)
    assert both.estimated_outlier_rate is not None and alone.estimated_outlier_rate is not None


def test_different_points_from_two_references_are_rivals(references, queries, folder):
    one = references["fisheye"]
    alone = matcher([one])(queries["fisheye"])
    both = matcher([one, twin(one, folder, "alternative", 0.5)])(queries["fisheye"])
    assert len(both.pixels) == 2 * len(alone.pixels)
    assert np.array_equal(both.points[: len(alone.points)] + 0.5, both.points[len(alone.points) :])


def test_an_image_is_not_matched_with_itself(references):
    one = references["panorama"]
    matches = matcher(references.values())(one)
    assert len(matches.pixels) and one not in matches.references


def broken(folder, name, content):
    path = folder / name
    path.write_bytes(content)
    return View(name, FISHEYE, path, standing(0, 0, 0), lift=SfmLift(np.zeros((1, 2)), np.zeros((1, 3))))


def test_references_that_cannot_be_used_are_remarked_and_skipped(references, queries, folder):
    good = references["fisheye"]

    def no_depth():
        raise InputError("depth/7.png: no such file; correct the path.")

    bad = [
        broken(folder, "cut.png", good.path.read_bytes()[:3000]),
        broken(folder, "none.png", b""),
        replace(good, name="small", camera=replace(FISHEYE, width=200), path=good.path),
        replace(
            good,
            name="deep",
            path=twin(good, folder, "deep").path,
            lift=DepthLift(no_depth, FISHEYE, np.eye(3, 4), "z"),
        ),
        replace(good, name="flat", path=twin(good, folder, "flat").path, lift=None),
    ]
    alone = matcher([good])(queries["fisheye"])
    matches = matcher([*bad, good], {"references": 6})(queries["fisheye"])
    assert np.array_equal(matches.points, alone.points)
    assert matches.references == (good,)
    for view, reason in zip(bad, ("damaged", "damaged", "200", "no such file", "depth, lidar"), strict=True):
        assert any(view.name in remark and reason in remark for remark in matches.remarks), (view.name, matches.remarks)


def test_a_map_with_hardly_a_point_is_told_from_a_wrong_reference(references, queries, folder):
    """The right reference matches, but eight of its features have points; of another room none matches rightly."""
    right = references["fisheye"]
    wrong = room_view(folder, "elsewhere", FISHEYE, standing(0.0, 0.0, 0.0), wallpaper(2))
    causes = []
    for reference in (right, wrong):
        pixels = extract(reference, FeatureOptions(max_features=700)).pixels
        lifted = reference.lift(pixels)[1]
        few = np.flatnonzero(lifted)[slice(8) if reference is right else slice(None, None, 2)]
        sparse = replace(reference, lift=SfmLift(pixels[few], reference.lift(pixels[few])[0]))
        problem = map_scene([sparse], [queries["fisheye"]]).problem()
        trace = estimate(problem, "ransac-2p")
        causes.append([diagnose(trace, use_truth).cause for use_truth in (True, False)])
        if reference is right:
            assert problem.verified_without_point > 10 * len(problem), (problem.verified_without_point, len(problem))
            assert any("agree with the motion between two images" in remark for remark in problem.remarks)
        else:
            assert problem.verified_without_point == 0
    assert causes[0] == [Cause.MAP_TOO_SPARSE] * 2 and Cause.MAP_TOO_SPARSE not in causes[1], causes


def test_nothing_usable_gives_no_matches_and_one_sentence(queries, folder):
    references = [broken(folder, "a.png", b"no image"), broken(folder, "b.png", b"")]
    matches = matcher(references)(queries["mei"])
    assert matches.pixels.shape == (0, 2) and matches.points.shape == (0, 3) and len(matches.remarks) == 2
    with pytest.raises(ProblemError, match="0 usable of 0 correspondences"):
        map_scene(references, [queries["mei"]]).problem()


def test_pictures_without_features_give_no_matches_and_say_so(references, folder):
    path = folder / "fog.png"
    cv2.imwrite(str(path), np.full((290, 300), 90, np.uint8))
    fog = View("fog", FISHEYE, path, lift=references["fisheye"].lift)
    with pytest.raises(ProblemError, match="fog has no features, and so no matches"):
        matcher(references.values())(fog)
    assert len(matcher([fog])(references["fisheye"]).pixels) == 0
    assert len(matcher([fog, *references.values()], {"references": 1})(references["fisheye"]).references) == 1


def test_a_query_that_cannot_be_read_is_an_error(references, folder):
    with pytest.raises(InputError, match=r"gone\.png"):
        matcher(references.values())(View("gone", FISHEYE, folder / "gone.png"))


@pytest.fixture(scope="module")
def many(folder):
    """Four references in each of three rooms with wallpapers of their own."""
    return tuple(
        room_view(folder, f"room{room}_{place}", FISHEYE, standing(0.2 * place, -0.2, 0.4 * place), wallpaper(room))
        for place in range(4)
        for room in (1, 2, 3)
    )


@pytest.mark.parametrize("features", ["sift", "orb"])
def test_retrieval_finds_the_room(many, folder, features):
    find = matcher(many, {"references": 3, "features": features})
    for room in (1, 2, 3):
        query = room_view(folder, f"lost{room}", PANORAMA, standing(0.3, 0.0, 0.2), wallpaper(room))
        found = [view.name for view in find(query).references]
        assert len(found) == 3 and all(name.startswith(f"room{room}_") for name in found)


def test_unreadable_references_are_counted_once_by_retrieval(many, queries, folder):
    bad = [broken(folder, f"bad{number}.png", b"") for number in range(3)]
    matches = matcher([*bad, *many], {"references": 2})(queries["fisheye"])
    assert {view.name[:5] for view in matches.references} == {"room1"}
    assert sum("3 of 15 references were skipped, the first is bad0.png" in remark for remark in matches.remarks) == 1


def test_preparing_is_reported_and_spares_the_first_query_the_work(many, queries):
    prepared, plain = matcher(many), matcher(many)
    reports = []
    prepared.prepare(lambda done, count: reports.append((done, count)))
    assert reports == [(done, len(many)) for done in range(1, len(many) + 1)]
    prepared.prepare(lambda done, count: reports.append("again"))
    assert "again" not in reports
    query = next(iter(queries.values()))
    assert np.array_equal(prepared(query).points, plain(query).points)


def test_little_to_choose_from_needs_no_preparing(references):
    reports = []
    matcher(tuple(references.values())[:2], {"references": 2}).prepare(lambda *told: reports.append(told))
    assert reports == []


def test_pairs_take_the_place_of_retrieval(many, queries):
    query = queries["fisheye"]
    find = matcher(many, {"references": 2}, {query.name: ("room1_3", "gone", "room1_0", "room1_1")})
    matches = find(query)
    assert {view.name for view in matches.references} == {"room1_3", "room1_0"}
    assert any("1 of the 4 references" in remark and "'gone'" in remark for remark in matches.remarks)


def test_a_query_without_pairs_is_retrieved_and_that_is_said(many, queries):
    query = queries["fisheye"]
    matches = matcher(many, {"references": 2}, {"another": ("room3_1",)})(query)
    assert {view.name[:5] for view in matches.references} == {"room1"}
    assert any("not in the list of pairs" in remark for remark in matches.remarks)


def test_triangulated_points_are_on_the_walls(many, folder):
    """Two posed images without depth give the third one its points, and these are where its depth says."""
    view, others = many[0], (many[3], many[6])
    gone = replace(many[9], name="gone", path=folder / "gone.png")
    lift = TriangulationLift(view, (gone, *others), FeatureOptions(max_features=1000))
    pixels = extract(view, lift.features).pixels
    points, has = lift(pixels)
    truth, _ = view.lift(pixels)
    error = np.linalg.norm(points - truth, axis=1)[has]
    assert has.sum() > 100 and np.median(error) < 0.05
    assert len(lift.remarks) == 1 and "gone.png" in lift.remarks[0]
    matches = matcher([replace(view, lift=lift)])(others[0])
    assert len(matches.pixels) > 100 and any("gone.png" in remark for remark in matches.remarks)
    with pytest.raises(InputError, match="no other image can be used"):
        TriangulationLift(view, (gone,), FeatureOptions(max_features=1000))(pixels)


WRONG_TABLES = [
    ({"feature": "sift"}, "unknown key 'feature'"),
    ({"features": "surfs"}, "features 'surfs' are unknown"),
    ({"features": 3}, "features 3 are unknown"),
    ({"features": ["sift"]}, "are unknown"),
    ({"max_features": 0}, "max_features is 0"),
    ({"max_features": True}, "max_features is True"),
    ({"ratio": 1.5}, "ratio of matching is 1.5"),
    ({"ratio": "low"}, "ratio of matching is 'low'"),
    ({"matching": "magic"}, "matching 'magic' is unknown"),
    ({"matching": ["nearest"]}, "is unknown"),
    ({"matching": "lightglue"}, "weights"),
    ({"matching": "lightglue", "ratio": 0.8, "matching_weights": "w.onnx"}, "LightGlue has no ratio"),
    ({"features": "aliked"}, "weights"),
    ({"features": "aliked", "feature_weights": "gone.onnx"}, "is not a file"),
    ({"features": "aliked", "feature_weights": 5}, "feature_weights is 5"),
    ({"references": 0}, "references is 0"),
    ({"references": 2.5}, "references is 2.5"),
]


@pytest.mark.parametrize("table, says", WRONG_TABLES, ids=[str(table) for table, _ in WRONG_TABLES])
def test_wrong_options_are_refused_in_one_sentence(table, says, tmp_path):
    (tmp_path / "w.onnx").write_bytes(b"")
    with pytest.raises(InputError) as caught:
        frontend_options(table, "my.toml", tmp_path)
    assert says in str(caught.value) and str(caught.value).startswith("my.toml [frontend]: ")


def test_options_reach_the_parts(tmp_path):
    (tmp_path / "d.onnx").write_bytes(b"x")
    table = {"features": "disk", "feature_weights": "d.onnx", "max_features": 700, "ratio": 0.9, "references": 7}
    options = frontend_options(table, "my.toml", tmp_path)
    assert (options.features.method, options.features.weights) == ("disk", tmp_path / "d.onnx")
    assert (options.features.max_features, options.matching.ratio, options.references) == (700, 0.9, 7)
    assert frontend_options({}, "my.toml", tmp_path).features.method == "sift"
