"""Rendered scenes: loaded at once, drawn when needed, localized by real matching."""

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from spherloc.datasets import bundled_scenes, load_scene, rendered
from spherloc.datasets.map_scene import MapScene
from spherloc.errors import InputError
from spherloc.estimators import estimate
from spherloc.frontend.pipeline import ImageMatcher
from spherloc.frontend.stored_matches import StoredMatches
from spherloc.geometry import camera_centre, rotation_angle

BUNDLED = {
    name: path for name, path in bundled_scenes().items() if tomllib.loads(path.read_text())["kind"] == "rendered"
}

SMALL = """
kind = "rendered"
name = "Small street"
provenance = "Made by code."
world = "street"
[camera]
model = "equirectangular"
width = 384
height = 192
[references]
count = 4
start = 0.40
stop = 0.52
[queries]
count = 2
start = 0.44
stop = 0.48
offset_m = 0.4
tilt_deg = 0.5
light = "morning"
occluders = 3
[frontend]
references = 2
"""


@pytest.fixture
def cache(monkeypatch, tmp_path):
    folder = tmp_path / "cache"
    monkeypatch.setenv("SPHERLOC_CACHE", str(folder))
    return folder


def scene_of(tmp_path, text=SMALL):
    path = tmp_path / "scene.toml"
    path.write_text(text)
    scene = load_scene(path)
    assert isinstance(scene, MapScene)
    return scene


def drawn(cache):
    return sorted(cache.glob("renders/*/*.png"))


def errors_of(trace):
    """(degrees, metres) of the estimated pose."""
    truth, found = trace.problem.truth_cam_from_map, trace.cam_from_map
    angle = np.degrees(rotation_angle(truth[:, :3].T @ found[:, :3]))
    return angle, np.linalg.norm(camera_centre(truth) - camera_centre(found))


def test_bundled_scenes_cover_worlds_cameras_and_conditions():
    tables = [tomllib.loads(path.read_text()) for path in BUNDLED.values()]
    assert len(tables) >= 6
    assert {table["world"] for table in tables} == {"street", "apartment", "campus"}
    assert {table["camera"]["model"] for table in tables} == {"mei", "kannala_brandt", "equirectangular"}
    assert {"dusk", "night"} <= {table["queries"].get("light") for table in tables}
    assert {"autumn", "winter"} <= {table["queries"].get("season") for table in tables}
    assert all(table["about"] for table in tables)


@pytest.mark.parametrize("name", sorted(BUNDLED))
def test_bundled_scenes_load_without_drawing(name, cache):
    scene = load_scene(BUNDLED[name])
    assert isinstance(scene, MapScene)
    assert not cache.exists()
    assert all(view.cam_from_map is not None for view in (*scene.queries, *scene.references))
    assert all(view.lift is not None for view in scene.references)
    assert scene.gravity_bound_rad > 0


def test_bundled_scenes_bring_their_matches(cache):
    """For all queries, at once; and for one of them they are those that are found."""
    for path in BUNDLED.values():
        scene = load_scene(path)
        assert isinstance(scene, MapScene)
        problems = [scene.stored_problem(view.name) for view in scene.queries]
        assert all(problem is not None and len(problem) > 50 for problem in problems), path
    assert not cache.exists(), "nothing was drawn"
    scene = load_scene(BUNDLED["campus_panorama"])
    assert isinstance(scene, MapScene) and isinstance(scene.matcher, StoredMatches)
    query, seeker = scene.queries[0], scene.matcher.matcher
    stored = scene.matcher(query)
    assert len(drawn(cache)) == 1, "only the query is drawn"
    assert isinstance(seeker, ImageMatcher)
    found = replace(seeker, references=stored.references[:1])(query)
    first = stored.reference_index == 0
    one = np.column_stack([stored.pixels[first], stored.points[first]])
    other = np.column_stack([found.pixels, found.points])
    # A few matches at a threshold depend on how a processor and a version of numpy or SciPy round.
    for some, all_ in ((one, other), (other, one)):
        near = cKDTree(all_).query(some)[0] < 1e-3
        assert near.mean() > 0.95, "python -m scripts.scene_matches makes them anew"


@pytest.mark.parametrize("change", ["another camera", "cut off", "no file"])
def test_matches_of_another_scene_are_not_taken(change, tmp_path):
    query = load_scene(BUNDLED["campus_panorama"]).queries[0]
    stored = load_scene(BUNDLED["campus_panorama"]).matcher
    path = tmp_path / "scene.npz"
    path.write_bytes(stored.path.read_bytes()[: 5000 if change == "cut off" else None])
    if change == "no file":
        path.unlink()
    key = "other" if change == "another camera" else stored.key
    assert StoredMatches(lambda view: "sought", stored.references, path, key)(query) == "sought"


def test_a_query_is_localized(cache, tmp_path):
    scene = scene_of(tmp_path)
    assert not drawn(cache)
    problem = scene.problem()
    assert 3 <= len(drawn(cache)) <= 5  # the query and its references
    assert problem.image is not None and problem.image.is_file()
    assert all(path.is_file() for path in problem.reference_images)
    assert problem.truth_inliers is not None and 20 < problem.truth_inliers.sum() < len(problem)
    angle, distance = errors_of(estimate(problem, "mc-exact"))
    assert angle < 1.0 and distance < 0.1
    again = scene_of(tmp_path).problem()
    np.testing.assert_array_equal(problem.pixels, again.pixels)
    np.testing.assert_array_equal(problem.points, again.points)


def test_drawn_again_if_the_cache_is_emptied(cache, tmp_path):
    scene = scene_of(tmp_path)
    first = scene.references[0].read()
    for file in cache.rglob("*.*"):
        file.unlink()
    assert (scene.references[0].read() == first).all()
    assert scene.references[0].path.is_file()


def test_points_of_a_reference_project_where_they_were_lifted(cache, tmp_path, rng):
    view = scene_of(tmp_path).references[1]
    pixels = rng.uniform((0, 60), (384, 150), (200, 2))
    assert view.lift is not None and view.cam_from_map is not None
    points, valid = view.lift(pixels)
    assert valid.mean() > 0.8
    in_camera = points[valid] @ view.cam_from_map[:, :3].T + view.cam_from_map[:, 3]
    np.testing.assert_allclose(view.camera.project(in_camera)[0], pixels[valid], atol=1e-3)


def test_gravity_is_off_by_no_more_than_is_said(tmp_path):
    scene = scene_of(tmp_path, SMALL.replace("count = 2", "count = 60"))
    bound = np.radians(0.5)
    assert scene.gravity_bound_rad == pytest.approx(bound)
    down = np.array([0.0, 1.0, 0.0])  # in a level reference
    level, *tilted = (np.asarray(view.cam_from_map)[:, :3] for view in (scene.references[0], *scene.queries))
    np.testing.assert_allclose(level @ scene.gravity_map, down, atol=1e-12)
    tilts = [np.arccos(np.clip(rotation @ scene.gravity_map @ down, -1, 1)) for rotation in tilted]
    assert 0.6 * bound < max(tilts) <= bound * 1.0001


def test_queries_and_references_have_their_own_occluders(tmp_path):
    scene = scene_of(tmp_path, SMALL.replace("stop = 0.52", "stop = 0.52\noccluders = 3"))
    assert len({view.path for view in (*scene.queries, *scene.references)}) == 6


def test_mesh_is_that_of_the_world(tmp_path):
    scene = scene_of(tmp_path)
    assert scene.mesh is not None and scene.mesh()[:4] == b"glTF"


@pytest.mark.parametrize(
    "old, new, words",
    [
        ('world = "street"', 'world = "moon"', "no world 'moon'; there are street"),
        ('world = "street"', "world = 3", "'world' must be a text"),
        ('provenance = "Made by code."', "", "'provenance' is missing"),
        ("occluders = 3", "occluder = 3", "unknown key 'occluder'"),
        ("occluders = 3", "occluders = 1000000", "occluders is 1000000"),
        ('light = "morning"', 'light = "noon"', "no light 'noon'"),
        ('light = "morning"', "light = 7", "no light 7"),
        ("count = 4", "count = 100000000", "from 1 to 500"),
        ("count = 4\n", "", "'count' is missing"),
        ("start = 0.44", "start = 1.5", "start is 1.5"),
        ("tilt_deg = 0.5", "tilt_deg = nan", "tilt_deg is nan"),
        ("[references]", "[references]\ntilt_deg = 1", "unknown key 'tilt_deg'"),
        ("width = 384\nheight = 192", "width = 38400\nheight = 19200", "give fewer"),
        ('world = "street"', 'world = "street"\nseed = -1', "seed is -1"),
        ("references = 2", "reference = 2", "unknown key 'reference'"),
        ('world = "street"', 'world = "street"\nqueries_ = 1', "unknown key 'queries_'"),
    ],
)
def test_what_is_wrong_is_said_in_one_sentence(tmp_path, old, new, words):
    assert old in SMALL
    with pytest.raises(InputError) as caught:
        scene_of(tmp_path, SMALL.replace(old, new, 1))
    message = str(caught.value)
    assert words in message and "scene.toml" in message and "\n" not in message


def test_example_of_the_loader_loads(tmp_path):
    scene = scene_of(tmp_path, rendered.EXAMPLE)
    assert (len(scene.references), len(scene.queries)) == (20, 5)
    assert Path(scene.where).name == "scene.toml"
