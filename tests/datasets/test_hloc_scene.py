"""Scenes of hloc's outputs: the whole way from the files to a pose, and what is said where they disagree."""

from pathlib import Path

import h5py
import numpy as np
import pytest
from hloc_samples import (
    FISHEYE,
    QUERY,
    REFERENCES,
    SCENE,
    make_world,
    matches_of,
    write_all,
    write_features,
    write_text,
)

from spherloc.datasets import hloc, load_scene
from spherloc.errors import InputError
from spherloc.estimators import default_options, estimate
from spherloc.experiments.configuration import configuration_of
from spherloc.metrics import evaluate
from tests.needs import real_data

ROOT = Path(__file__).resolve().parents[2]

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


@pytest.fixture
def world(tmp_path, rng):
    return make_world(tmp_path, rng)


@pytest.mark.parametrize("old", [False, True])
@pytest.mark.parametrize("turned", [False, True])
def test_localizes_from_the_files(world, rng, old, turned):
    """Both separators and both orders of a pair."""
    scene = load_scene(write_all(world, rng, old=old, turned=turned).scene)
    problem = scene.problem()
    assert np.allclose(problem.truth_cam_from_map, world.truth, atol=1e-12)
    assert 0.45 < problem.truth_inliers.mean() < 0.7  # a true match of three references counts once
    scores = evaluate(estimate(problem, "mc", seed=0))
    assert scores.rotation_error_deg < 0.1 and scores.translation_error_m < 0.02
    assert scores.precision > 0.98 and scores.recall > 0.98


def test_results_of_other_matches_are_of_another_configuration(world, rng):
    path = write_all(world, rng).scene

    def now():
        scene = load_scene(path)
        return configuration_of(scene, path, "mc", default_options("mc", scene.problem()), 0)

    before = now()
    assert not before.differences(now())
    with h5py.File(world.outputs / "matches.h5", "a") as file:
        file["another/pair/matches0"] = np.arange(4000, dtype=np.int16)
    assert before.differences(now()) == ["the scene file or its map is another one"]


def test_correspondences_are_those_of_the_files(world, rng):
    """Every one of the true matches is there once, with its own pixels, its own point and its reference."""
    write_text(world)
    write_features(world, dtype=np.float64)
    with h5py.File(world.outputs / "matches.h5", "w") as file:
        for name in REFERENCES:
            matches = matches_of(world, QUERY, name, rng, wrong=0.0)
            file[f"{QUERY.replace('/', '-')}/{name.replace('/', '-')}/matches0"] = matches.astype(np.int16)
    scene = load_scene(world.scene)
    found = scene.matcher(scene.query())
    keypoint = [int(np.argmin(np.linalg.norm(world.pixels[QUERY] - pixel, axis=1))) for pixel in found.pixels]
    assert np.abs(world.pixels[QUERY][keypoint] - found.pixels).max() < 1e-9
    point = world.point_of[QUERY][keypoint]
    assert np.array_equal(world.points[point], found.points)
    seen = set().union(*(set(world.point_of[name]) for name in REFERENCES)) & set(world.point_of[QUERY]) - {-1}
    assert sorted(point) == sorted(seen)
    for row, (reference, pixel) in enumerate(zip(found.reference_index, found.reference_pixels, strict=True)):
        name = found.references[reference].name
        own = np.flatnonzero(world.point_of[name] == point[row])
        assert len(own) == 1 and np.allclose(world.pixels[name][own[0]], pixel, atol=1e-9)
    counts = np.bincount(found.reference_index, minlength=3)
    assert counts[0] == counts.max() and found.remarks == ()


def test_half_floats_and_uncertainty_are_said(world, rng):
    write_all(world, rng)
    write_features(world, dtype=np.float16)
    with h5py.File(world.outputs / "feats.h5", "a") as file:
        file[QUERY]["keypoints"].attrs["uncertainty"] = 2.5
    scene = load_scene(world.scene)
    found = scene.matcher(scene.query())
    assert any("half floats, which are rounded to 1 px" in remark for remark in found.remarks)
    assert any("uncertain by 2.5 px" in remark for remark in found.remarks)
    assert evaluate(estimate(scene.problem(), "mc", seed=0)).translation_error_m < 0.05


def test_damaged_pairs_are_skipped_and_counted(world, rng):
    """One pair has an index beyond the keypoints, one another length; the third one is enough."""
    write_all(world, rng)
    group = QUERY.replace("/", "-")
    with h5py.File(world.outputs / "matches.h5", "a") as file:
        file[f"{group}/db-1.jpg/matches0"][0] = 30_000
        del file[f"{group}/db-2.jpg/matches0"]
        file[f"{group}/db-2.jpg/matches0"] = np.zeros(3, np.int16)
    scene = load_scene(world.scene)
    found = scene.matcher(scene.query())
    assert [reference.name for reference in found.references] == ["db/sub/3.jpg"]
    (remark,) = found.remarks
    assert remark.startswith(f"2 of 3 pairs of {QUERY} are skipped: ") and "the keypoint 30000 of the" in remark


def test_features_of_another_run(world, rng):
    """The model's keypoints are not those of the features: no index can be trusted."""
    write_all(world, rng)
    world.pixels["db/1.jpg"] = world.pixels["db/1.jpg"][:-5]
    write_features(world)
    scene = load_scene(world.scene)
    found = scene.matcher(scene.query())
    assert "db/1.jpg" not in [reference.name for reference in found.references]
    assert "give the features that the model was made from" in found.remarks[0]


def test_pairs_that_were_not_matched(world, rng):
    write_all(world, rng)
    with h5py.File(world.outputs / "matches.h5", "a") as file:
        del file[QUERY.replace("/", "-")]["db-2.jpg"]
    (world.outputs / "pairs.txt").write_text(f"{QUERY} db/gone.jpg\n{QUERY} db/2.jpg\n{QUERY} db/1.jpg\n")
    scene = load_scene(world.scene)
    assert any(remark.startswith("1 of 3 pairs in ") and "db/gone.jpg" in remark for remark in scene.remarks)
    found = scene.matcher(scene.query())
    assert [reference.name for reference in found.references] == ["db/1.jpg"]
    assert found.remarks[0].startswith(f"1 of 2 pairs of {QUERY} are not in ")


def test_a_query_that_is_an_image_of_the_model_is_no_reference(world, rng):
    """Nor is it matched with points that only it and one reference saw: they fit its true pose by their making."""
    query, first, second = REFERENCES
    world.point_of[second][world.point_of[second] % 3 == 0] = -1
    write_all(world, rng)
    camera = f"{FISHEYE[0]} {FISHEYE[1]} {FISHEYE[2]} {' '.join(map(str, FISHEYE[3]))}"
    (world.folder / "queries.txt").write_text(f"{query} {camera}\n")
    with h5py.File(world.outputs / "matches.h5", "a") as file:
        for name in (first, second):
            matches = matches_of(world, query, name, rng, wrong=0.0)
            file[f"{query.replace('/', '-')}/{name.replace('/', '-')}/matches0"] = matches.astype(np.int16)
    (world.outputs / "pairs.txt").write_text(f"{query} {query}\n{query} {first}\n{query} {second}\n")
    scene = load_scene(world.scene)
    assert [view.name for view in scene.references] == [first, second]
    said = " ".join(scene.remarks)
    assert "Queries that are in the model, too: 1 image (db/1.jpg), not used as references." in said
    assert "1 of 3 pairs" in said and "points of the model left out: without the queries, no two images see" in said
    problem = scene.problem()
    seen = {name: set(world.point_of[name][world.point_of[name] >= 0]) for name in REFERENCES}
    stay = {
        index for index in range(len(world.points)) if index not in seen[query] or index in seen[first] & seen[second]
    }
    used = {int(np.argmin(np.linalg.norm(world.points - point, axis=1))) for point in problem.points}
    assert used and used <= stay and seen[query] & seen[first] - seen[second]
    (world.folder / "queries.txt").write_text("".join(f"{name} {camera}\n" for name in REFERENCES))
    with pytest.raises(InputError, match="all images of the model are queries"):
        load_scene(world.scene)


def test_query_without_keypoints_or_of_another_size(world, rng):
    write_all(world, rng)
    write_features(world, without=(QUERY,))
    scene = load_scene(world.scene)
    with pytest.raises(InputError, match=r"has no keypoints of 'query/night/IMG_1.jpg'"):
        scene.problem()
    write_features(world)
    with h5py.File(world.outputs / "feats.h5", "a") as file:
        file[QUERY]["image_size"][...] = (1601, 800)
    with pytest.raises(InputError, match="1601 x 800 pixels, but its camera has 1600 x 800"):
        scene.problem()


def test_truth_names(world, rng):
    """Whole names, names without folders, and a name that may be either of two queries."""
    write_all(world, rng)
    panorama = "EQUIRECTANGULAR 1600 800 1600 800"
    other = "query/day/IMG_1.jpg"
    (world.folder / "images" / other).parent.mkdir()
    (world.folder / "images" / other).write_bytes(b"")
    (world.folder / "queries.txt").write_text(f"{QUERY} {panorama}\n{other} {panorama}\n")
    with pytest.raises(InputError, match=r"may be 'query/night/IMG_1.jpg' or 'query/day/IMG_1.jpg'"):
        load_scene(world.scene)
    (world.outputs / "truth.txt").write_text("day/IMG_1.jpg 1 0 0 0 1 2 3\nnobody.jpg 1 0 0 0 1 2 3\n")
    scene = load_scene(world.scene)
    assert scene.query(QUERY).cam_from_map is None
    assert np.array_equal(scene.query(other).cam_from_map[:, 3], [1.0, 2.0, 3.0])
    assert any(remark.startswith("1 of 2 queries have no pose in ") for remark in scene.remarks)
    assert any(remark.startswith("1 of 2 poses in ") for remark in scene.remarks)
    assert any(remark.startswith("1 of 2 queries have no pair in ") for remark in scene.remarks)


@pytest.mark.parametrize(
    ("removed", "added", "said"),
    [
        ("features", "", "'matches' needs 'features' as well"),
        ("matches", "", "'features' needs 'matches' as well"),
        ("pairs", "", "key 'pairs' is missing"),
        ("", "[frontend]\nratio = 0.7", "'matches' and 'frontend' say the same"),
        ("", 'global_features = "g.h5"', "'pairs' and 'global_features' say the same"),
        ("queries", "", "key 'queries' is missing"),
        ("", "surprise = 1", "unknown key 'surprise'"),
        ("", "[gravity]\ndown = [0, 1, 0]", "unknown key 'down'"),
    ],
)
def test_wrong_keys(world, rng, removed, added, said):
    write_all(world, rng)
    lines = [line for line in SCENE.splitlines() if not removed or not line.startswith(f"{removed} ")]
    world.scene.write_text("\n".join([*lines, added]))
    with pytest.raises(InputError, match=said):
        load_scene(world.scene)


def test_the_example_of_a_scene(world, rng):
    """What users are shown can be loaded."""
    write_all(world, rng)
    own = hloc.EXAMPLE
    for shown, real in (("queries_with_intrinsics", "queries"), ("pairs-netvlad", "pairs"), ("results", "truth")):
        own = own.replace(shown, real)
    world.scene.write_text(own)
    assert load_scene(world.scene).gravity_bound_rad == pytest.approx(np.radians(5.0))


@pytest.mark.parametrize("name", ["queries.txt", "outputs/pairs.txt", "outputs/feats.h5", "outputs/truth.txt"])
def test_missing_files_are_named(world, rng, name):
    write_all(world, rng)
    (world.folder / name).unlink()
    with pytest.raises(InputError, match=f"{name}: no such file"):
        load_scene(world.scene)


STELLA = """
kind = "hloc"
name = "panorama pair"
model = "{model}"
images = "{data}"
queries = "queries.txt"
truth = "truth.txt"
{more}

[frontend]
max_features = 4000
"""


@pytest.mark.parametrize("more", ['pairs = "pairs.txt"', 'global_features = "global.h5"'])
def test_own_matching_of_real_panoramas(tmp_path, rng, more):
    """Without hloc's matches the project finds its own, of the pairs or of what global descriptors retrieve."""
    data = real_data("stella_equirect_pair")
    query, reference = "equirectangular_image_002.jpg", "equirectangular_image_001.jpg"
    rows = (data / "colmap_equirect" / "0" / "images.txt").read_text().splitlines()
    words = next(row.split() for row in rows if row.endswith(query))
    (tmp_path / "queries.txt").write_text(f"{query} EQUIRECTANGULAR 1920 960 1920 960\n")
    (tmp_path / "pairs.txt").write_text(f"{query} {reference}\n")
    (tmp_path / "truth.txt").write_text(f"{query} {' '.join(words[1:8])}\n")
    with h5py.File(tmp_path / "global.h5", "w") as file:
        for name in (query, reference):
            file[f"{name}/global_descriptor"] = rng.normal(size=16).astype(np.float16)
    # The model has the query by another name, whose image is not there: it is no query of its own map.
    model = tmp_path / "model"
    model.mkdir()
    for file in ("cameras.txt", "images.txt", "points3D.txt"):
        text = (data / "colmap_equirect" / "0" / file).read_text()
        (model / file).write_text(text.replace(query, "absent.jpg"))
    (tmp_path / "scene.toml").write_text(STELLA.format(data=data, model=model, more=more))
    scene = load_scene(tmp_path / "scene.toml")
    problem = scene.problem()
    assert problem.reference_images == (data / reference,)
    assert evaluate(estimate(problem, "mc", seed=0)).rotation_error_deg < 0.5
