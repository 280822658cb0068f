"""Scenes of kind "colmap": which images are queries, what is left out, where down is; and the real panorama pair."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from colmap_samples import EQUIRECTANGULAR, NO_POINT, OPENCV_FISHEYE, binary_files, mean_down, sample_model, write

from spherloc.datasets import load_scene
from spherloc.errors import InputError
from spherloc.estimators.base import estimate
from spherloc.metrics import rotation_error_deg, translation_error_m
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
    path = scene_file(tmp_path, "3", "[gravity]\nmap = [0, 0, -2]\nbound_deg = 1.5\n")
    scene = load_scene(path)
    np.testing.assert_array_equal(scene.gravity_map, [0, 0, -1])
    assert scene.gravity_bound_rad == pytest.approx(np.radians(1.5)) and scene.remarks == ()


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


@pytest.fixture(scope="module")
def stella(tmp_path_factory):
    """The real pair: image 002 against the model with image 001 as its only reference."""
    folder = real_data("stella_equirect_pair")
    path = tmp_path_factory.mktemp("stella") / "pair.toml"
    path.write_text(
        f'kind = "colmap"\nname = "pair"\nmodel = "{folder / "colmap_equirect" / "0"}"\n'
        f'images = "{folder}"\nqueries = ["equirectangular_image_002.jpg"]\n'
    )
    scene = load_scene(path)
    assert [view.name for view in scene.references] == ["equirectangular_image_001.jpg"]
    return scene.problem()


@pytest.mark.parametrize("estimator", ["mc-exact", "ransac-2p"])
def test_the_real_panorama_is_localized_by_own_matches(stella, estimator):
    """The pair's relative position has no unit: it is scaled so that the cameras are 9 apart."""
    assert len(stella) > 150 and stella.truth_inliers.mean() > 0.8
    trace = estimate(stella, estimator)
    assert rotation_error_deg(stella.truth_cam_from_map, trace.cam_from_map) < 0.5
    assert translation_error_m(stella.truth_cam_from_map, trace.cam_from_map) < 0.1
