"""Scenes of kind "colmap": which images are queries, what is left out, where down is; and a real pair."""

import re
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from colmap_samples import EQUIRECTANGULAR, NO_POINT, OPENCV_FISHEYE, binary_files, mean_down, sample_model, write

from spherloc.datasets import load_scene
from spherloc.errors import InputError
from spherloc.geometry import camera_centre
from tests.needs import real_data

ROOT = Path(__file__).resolve().parents[2]


def scene_file(folder, queries="2", extra=""):
    """A scene whose model and images lie beside it."""
    path = folder / "scene.toml"
    head = 'kind = "colmap"\nname = "small"\nmodel = "sparse/0"\nimages = "images"\n'
    path.write_text(f"{head}queries = {queries}\n{extra}")
    return path


def make_tree(folder, sample):
    """Model and images; the loader only looks whether an image is there."""
    write(folder / "sparse" / "0", binary_files(sample))
    for image in sample.images:
        path = folder / "images" / image[3]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    return folder


@pytest.mark.parametrize(
    "queries, expected",
    [
        ("2", [1, 3, 5]),
        ("3", [2, 5]),
        ('["seq/004.jpg", "seq/000.jpg"]', [0, 4]),
        ('"seq/00[12].*"', [1, 2]),
    ],
)
def test_queries_are_no_references_and_have_their_pose_as_truth(queries, expected, rng, tmp_path):
    sample = sample_model(rng, images=6)
    scene = load_scene(scene_file(make_tree(tmp_path, sample), queries))
    names = [f"seq/{at:03}.jpg" for at in range(6)]
    assert [view.name for view in scene.queries] == [names[at] for at in expected]
    assert [view.name for view in scene.references] == [names[at] for at in range(6) if at not in expected]
    for view in (*scene.queries, *scene.references):
        np.testing.assert_allclose(view.cam_from_map, sample.image(view.name)[1], atol=1e-12)
        assert view.path == tmp_path / "images" / view.name


def test_observed_keypoints_lift_to_their_points(rng, tmp_path):
    sample = sample_model(rng)
    scene = load_scene(scene_file(make_tree(tmp_path, sample)))
    for view in scene.references:
        seen = sample.image(view.name)[4]
        pixels = np.array([item[:2] for item in seen])
        points, known = view.lift(pixels)
        assert known.tolist() == [item[2] != NO_POINT for item in seen]
        np.testing.assert_array_equal(points[known], [point[1] for point in sample.points])
        _, known = view.lift(np.array([[600.0, 310.0], [np.nan, 1.0]]))
        assert not known.any()


def test_down_is_that_of_the_upright_cameras_or_as_stated(rng, tmp_path):
    sample = sample_model(rng, images=6)
    path = scene_file(make_tree(tmp_path, sample), "3")
    scene = load_scene(path)
    references = replace(sample, images=[sample.image(view.name) for view in scene.references])
    np.testing.assert_allclose(scene.gravity_map, mean_down(references), atol=1e-12)
    assert scene.gravity_map[1] > 0.99
    assert any("mean +y axis of the reference cameras" in remark for remark in scene.remarks)
    assert scene.gravity_bound_rad == pytest.approx(np.radians(3.0))
    path = scene_file(tmp_path, "3", 'units = "metres"\n[gravity]\nmap = [0, 0, -2]\nbound_deg = 1.5\n')
    scene = load_scene(path)
    np.testing.assert_array_equal(scene.gravity_map, [0, 0, -1])
    assert scene.gravity_bound_rad == pytest.approx(np.radians(1.5)) and scene.remarks == ()


def test_a_scene_that_does_not_say_its_unit_has_a_remark(rng, tmp_path):
    """COLMAP knows no scale, so that metres are an assumption."""
    make_tree(tmp_path, sample_model(rng))
    assumed = "Lengths are told in metres, as if the model were to scale"
    scene = load_scene(scene_file(tmp_path))
    assert scene.metric and any(remark.startswith(assumed) for remark in scene.remarks)
    for units, metric in (("unknown", False), ("metres", True)):
        scene = load_scene(scene_file(tmp_path, "2", f'units = "{units}"\n'))
        assert scene.metric == metric and not any(assumed in remark for remark in scene.remarks)


@pytest.mark.parametrize(
    "keys",
    [
        'kind = "colmap"\nmodel = "sparse/0"\nimages = "images"\nqueries = 2\n',
        'kind = "image-folder"\nimages = "images"\ncamera = {model = "equirectangular", width = 64, height = 32}\n'
        '[map]\nmodel = "sparse/0"\nimages = "images"\n',
        'kind = "hloc"\nmodel = "sparse/0"\nimages = "images"\nqueries = "queries.txt"\n',
    ],
)
def test_a_model_without_points_is_no_map(keys, rng, tmp_path):
    sample = sample_model(rng)
    images = [(*image[:4], [(u, v, NO_POINT) for u, v, _ in image[4]]) for image in sample.images]
    make_tree(tmp_path, replace(sample, images=images, points=[]))
    (tmp_path / "images" / "a.png").touch()
    (tmp_path / "scene.toml").write_text(f'name = "bare"\n{keys}')
    with pytest.raises(
        InputError, match=r"sparse.0: the COLMAP model has no points, .*; make them with colmap point_tr"
    ):
        load_scene(tmp_path / "scene.toml")


def test_cameras_that_are_not_upright_do_not_show_down(rng, tmp_path):
    sample = sample_model(rng)
    turned = np.diag([1.0, -1.0, -1.0])
    images = [
        (image[0], turned @ image[1] if at < 2 else image[1], *image[2:]) for at, image in enumerate(sample.images)
    ]
    path = scene_file(make_tree(tmp_path, replace(sample, images=images)), '["seq/003.jpg"]')
    with pytest.raises(InputError, match=r"not held upright.*add a section \[gravity\]"):
        load_scene(path)


def test_missing_images_and_unsupported_cameras_are_left_out_and_counted(rng, tmp_path):
    sample = sample_model(rng, images=9, models=(EQUIRECTANGULAR, OPENCV_FISHEYE, EQUIRECTANGULAR))
    field_of_view = 7  # COLMAP's FOV model, which has no counterpart here
    cameras = [(sample.cameras[0][0], field_of_view, 640, 320, (200.0, 200.0, 320.0, 160.0, 0.9)), *sample.cameras[1:]]
    make_tree(tmp_path, replace(sample, cameras=cameras))
    (tmp_path / "images" / "seq" / "001.jpg").unlink()
    scene = load_scene(scene_file(tmp_path, '["seq/001.jpg", "seq/002.jpg"]'))
    assert [view.name for view in scene.queries] == ["seq/002.jpg"]
    assert [view.name for view in scene.references] == [f"seq/{at:03}.jpg" for at in (4, 5, 7, 8)]
    remarks = " ".join(scene.remarks)
    assert "1 image (seq/001.jpg) of the model not found in" in remarks
    assert "3 images (seq/000.jpg, seq/003.jpg, seq/006.jpg) left out: " in remarks and "'FOV' is not supp" in remarks
    for image in sample.images:
        (tmp_path / "images" / image[3]).unlink(missing_ok=True)
    with pytest.raises(InputError, match=r"there is no query image; .*6 images .* not found"):
        load_scene(scene_file(tmp_path, "2", "[gravity]\nmap = [0, 1, 0]\n"))


@pytest.mark.parametrize(
    "queries, extra, words",
    [
        ("1", "", "queries is 1; give a pattern"),
        ("0.5", "", "queries is 0.5; give a pattern"),
        ("[]", "", "queries is"),
        ('["seq/999.jpg"]', "", r"1 query image \(seq/999.jpg\) not in the model"),
        ('"night/*"', "", "fits none of the 4 images"),
        ('"*"', "", "there is no reference image"),
        ("9", "", "fits none of the 4 images"),
        ("2", "every = 2", "unknown key 'every'"),
        ("2", "[gravity]\nmap = [0, 0, 0]", "map has the length 0"),
        ("2", "[gravity]\ncamera = [0, 1, 0]", "unknown key 'camera'"),
        ("2", "[gravity]\nmap = [0, 1]", "map must hold 3 finite numbers"),
        ("2", "[frontend]\nfeatures = 'magic'", "magic"),
    ],
)
def test_wrong_keys_and_values(queries, extra, words, rng, tmp_path):
    path = scene_file(make_tree(tmp_path, sample_model(rng)), queries, extra)
    with pytest.raises(InputError, match=words) as caught:
        load_scene(path)
    assert str(path) in str(caught.value)


def seen_by_some(sample, rng):
    """The sample with each keypoint's point taken away with a probability of one half."""
    images = [
        (*image[:4], [(*pixel, p if rng.random() < 0.5 else NO_POINT) for *pixel, p in image[4]])
        for image in sample.images
    ]
    sees = {image[0]: {item[2] for item in image[4]} for image in images}
    points = [(*point[:3], [item for item in point[3] if point[0] in sees[item[0]]]) for point in sample.points]
    return replace(sample, images=images, points=points)


def widest_deg(sample, point, names):
    """Largest angle between two rays to a point from the images of these names that observe it; 0 without two."""
    seeing = [image for image in sample.images if image[3] in names and any(p == point[0] for *_, p in image[4])]
    rays = [point[1] - camera_centre(image[1]) for image in seeing]
    angles = [np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b) for a, b in combinations(rays, 2)]
    return np.degrees(max(angles, default=0.0))


def lifted(view, sample):
    """Ids of the points that the keypoints of a reference lift to."""
    points, known = view.lift(np.array([item[:2] for item in sample.image(view.name)[4]]))
    ids = {tuple(point[1]): point[0] for point in sample.points}
    return {ids[tuple(point)] for point in points[known]}


def test_points_that_only_queries_made_possible_are_left_out(rng, tmp_path):
    """Against all pairs of rays; what no query sees stays, also at an angle of nothing."""
    sample = seen_by_some(sample_model(rng, images=5, points=80), rng)
    distances = rng.uniform(200, 300, len(sample.points))  # rays to half of the points are 0 to 2 degrees apart
    points = [
        (*p[:1], p[1] / np.linalg.norm(p[1]) * (distance if at % 2 else 5.0), *p[2:])
        for at, (p, distance) in enumerate(zip(sample.points, distances, strict=True))
    ]
    sample = replace(sample, points=points)
    queries = ["seq/001.jpg", "seq/003.jpg"]
    scene = load_scene(scene_file(make_tree(tmp_path, sample), str(queries).replace("'", '"')))
    names = {view.name for view in scene.references}
    observed = {item[2] for name in queries for item in sample.image(name)[4]} - {NO_POINT}
    angles = {point[0]: widest_deg(sample, point, names) for point in points if point[0] in observed}
    gone = observed - set().union(*(lifted(view, sample) for view in scene.references))
    alone = {point for point, angle in angles.items() if angle < 1.5 / np.sqrt(3.0)}
    assert len(alone) > 10 and alone <= gone <= {point for point, angle in angles.items() if angle < 1.5}
    assert len(observed - gone) > 10
    for view in scene.references:
        assert lifted(view, sample) == {item[2] for item in sample.image(view.name)[4]} - {NO_POINT} - gone
    left_out = int(re.search(r"(\d+) of 80 points of the model left out: ", " ".join(scene.remarks))[1])
    assert left_out == len(gone)


def test_two_references_at_one_place_are_one(rng, tmp_path):
    """As the virtual faces of a panorama are: both rays are the same, and the query alone gave the range."""
    sample = sample_model(rng, images=4)
    first, second, third, query = sample.images
    turned = np.diag([-1.0, 1.0, -1.0]) @ first[1]
    few = [(*pixel, p if p < 110 else NO_POINT) for *pixel, p in third[4]]
    points = [(*p[:3], [item for item in p[3] if item[0] != third[0] or p[0] < 110]) for p in sample.points]
    images = [first, (second[0], turned, *second[2:]), (*third[:4], few), query]
    sample = replace(sample, images=images, points=points)
    scene = load_scene(scene_file(make_tree(tmp_path, sample), '["seq/003.jpg"]', "[gravity]\nmap = [0, 1, 0]\n"))
    assert lifted(scene.references[0], sample) == set(range(100, 110))


def test_a_real_model_of_two_images_has_no_point_without_one_of_them(tmp_path):
    folder = real_data("stella_equirect_pair")
    path = tmp_path / "pair.toml"
    path.write_text(
        f'kind = "colmap"\nname = "pair"\nmodel = "{folder / "colmap_equirect" / "0"}"\n'
        f'images = "{folder}"\nqueries = ["equirectangular_image_002.jpg"]\n'
    )
    with pytest.raises(InputError, match=r"pair.toml: no point of the model can be used: .*name fewer queries, or"):
        load_scene(path)
