"""Gravity of single queries: the file, its bound and source on the way to a problem, and what is said of it."""

from dataclasses import replace

import numpy as np
import pytest

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.datasets import load_scene
from spherloc.datasets.map_scene import LIKE_REFERENCE, MapScene
from spherloc.datasets.query_gravity import read_gravity, read_gravity_file
from spherloc.diagnosis import Cause, diagnose
from spherloc.errors import InputError, ProblemError
from spherloc.estimators import default_options
from spherloc.experiments.results import LOCALIZED, QueryResult, json_line, row_of_json
from spherloc.experiments.sequence import localize_queries
from spherloc.frontend.gravity_from_lines import NOT_FOUND
from spherloc.frontend.view import Gravity, Matches, View
from spherloc.geometry import DOWN
from spherloc_viz.commands.run import as_record, as_text
from spherloc_viz.commands.sequence_text import gravity_by_source as summed_up
from spherloc_viz.commands.sequence_text import without_lines
from tests.datasets.test_image_folder import CAMERA, POSED, make_tree
from tests.tiny_scene import write_tiny_scene

HERE = "gravity.txt"


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    return load_scene(write_tiny_scene(tmp_path_factory.mktemp("tiny"))).problem()


def written(folder, text):
    path = folder / HERE
    path.write_text(text)
    return path


def test_rows_of_a_gravity_file(tmp_path):
    text = '# image gx gy gz sd_deg\na.jpg 0 9.81 0\n"my photo.png", 0, 3, 4, 0.5  \n\nsub/c.png 1 0 0 0 # exact\n'
    found = read_gravity_file(written(tmp_path, text))
    assert list(found) == ["a.jpg", "my photo.png", "sub/c.png"]
    np.testing.assert_allclose(found["my photo.png"].down, [0, 0.6, 0.8])
    assert found["a.jpg"].bound_rad is None and found["a.jpg"].sd_rad is None
    assert found["my photo.png"].sd_rad == pytest.approx(np.radians(0.5))
    assert found["my photo.png"].bound_rad == pytest.approx(np.radians(1.5))
    assert found["sub/c.png"].bound_rad == 0.0


@pytest.mark.parametrize("titles", ["image,gx,gy,gz,sd_deg", "name x y z", '"image","gx","gy","gz","sd"'])
def test_the_first_row_of_a_gravity_file_may_have_titles(tmp_path, titles):
    assert list(read_gravity_file(written(tmp_path, f"{titles}\na.jpg,0,1,0,0.5\n"))) == ["a.jpg"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("image,gy,gx,gz\na.jpg,0,1,0\n", "line 1: 'gy' is not a finite number"),
        ("a.jpg,0,1,0\nimage,gx,gy,gz\n", "line 2: 'gx' is not a finite number"),
        ("a.jpg 0 1\n", "line 1: is not a row image gx gy gz"),
        ("# c\na.jpg 0 1 0 1 1\n", "line 2: is not a row image gx gy gz"),
        ("#timestamp,wx,wy,wz,ax,ay,az\n1,0,0,0,0,9,0\n", "line 2: is not a row image gx gy gz [sd_deg]; give a name"),
        ("1,0,0,0,0,9,0\n", "three or four numbers; the log of an IMU needs camera_from_imu."),
        ("a.jpg 0 one 0\n", "line 1: 'one' is not a finite number"),
        ("a.jpg 0 nan 0\n", "line 1: 'nan' is not a finite number"),
        ("a.jpg 0 0 0\n", "line 1: its vector has the length 0;"),
        ("a.jpg 0 1 0 -1\n", "line 1: sd_deg is -1;"),
        ("a.jpg 0 1 0 90\n", "line 1: sd_deg is 90;"),
        ("a.jpg 0 1 0\na.jpg 0 1 0\n", "line 2: 'a.jpg' is there a second time"),
    ],
)
def test_a_wrong_row_is_named_with_its_line(tmp_path, text, said):
    with pytest.raises(InputError) as caught:
        read_gravity_file(written(tmp_path, text))
    assert said in str(caught.value) and HERE in str(caught.value)


def test_keys_of_the_section_are_checked(tmp_path):
    scene = str(tmp_path / "scene.toml")
    for table, said in (
        ({"query": "north"}, "give one of 'reference', 'lines', 'tags', 'level', 'truth'"),
        ({"file": "none.txt"}, "no such file"),
        ({"files": "a"}, "unknown key 'files'"),
    ):
        with pytest.raises(InputError, match=said):
            read_gravity(table, scene, 3.0)


def test_a_file_gives_queries_of_a_folder_their_gravity(tmp_path):
    written(tmp_path, "a.jpg 0 0.8 0.6 0.1\nnone.jpg 0 1 0\n")
    scene = load_scene(make_tree(tmp_path, CAMERA + POSED + f'[gravity]\nmap = [0, 1, 0]\nfile = "{HERE}"\n'))
    assert isinstance(scene, MapScene)
    first, second = scene.queries
    assert first.gravity is not None and second.gravity is None
    np.testing.assert_allclose(first.gravity.down, [0, 0.8, 0.6])
    assert any("1 of 2 rows" in remark and "none.jpg" in remark for remark in scene.remarks)
    assert any("1 of 2 queries have no row" in remark and "b.png" in remark for remark in scene.remarks)


def test_a_log_of_an_imu_gives_queries_gravity_by_the_times_in_their_names(tmp_path):
    """A unit at rest, turned against the camera, whose x axis points up; one image is from after the log."""
    rows = "".join(f"{10**18 + n * 10**7},0,0,0,9.81,0,0\n" for n in range(300))
    (tmp_path / "imu.csv").write_text(rows)
    turn = [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]
    settings = read_gravity({"imu": "imu.csv", "camera_from_imu": turn}, str(tmp_path / "s.toml"), 3.0)
    times = (10**18 + 10**9, 10**18 + 10**10)
    views = [View(f"{time}.png", Equirectangular(64, 32), tmp_path / "q.png") for time in times]
    (inside, after), remarks = settings.of_queries(views, DOWN)
    assert inside.gravity is not None and inside.gravity.source == "the IMU" and inside.gravity.bound_rad is None
    np.testing.assert_allclose(inside.gravity.down, [0, 1, 0], atol=1e-12)
    assert after.gravity is None and "1 of 2 queries have no gravity from" in remarks[0]
    said = "its time, 1000000010.000 s, is outside of the log, from 1000000000.000 to 1000000002.990 s; give times on"
    assert said in remarks[0]
    _, (remark,) = settings.of_queries([View("a.png", Equirectangular(64, 32), tmp_path / "q.png")], DOWN)
    assert "the first is a.png: it has no time, which its name may tell: names like 1625133000_" in remark
    (tmp_path / "imu.csv").write_text("".join(rows.splitlines(keepends=True)[:50]))
    settings = read_gravity({"imu": "imu.csv", "camera_from_imu": turn}, str(tmp_path / "s.toml"), 3.0)
    _, (remark,) = settings.of_queries([replace(views[0], name=f"{10**18 + 10**8}.png")], DOWN)
    assert "at its time, 1000000000.100 s, the log has less than 1 s of measurements without a gap" in remark
    for table, said in (
        ({"imu": "imu.csv"}, "key 'camera_from_imu' is missing"),
        ({"imu": "imu.csv", "camera_from_imu": [[1, 0, 0]] * 3}, "is not a rotation"),
    ):
        with pytest.raises(InputError, match=said):
            read_gravity(table, str(tmp_path / "s.toml"), 3.0)


def test_what_the_scene_asks_for_replaces_what_the_loader_has(tmp_path, problem):
    own = Gravity(DOWN, "the IMU")
    view = View("a.jpg", problem.camera, tmp_path / "a.jpg", problem.truth_cam_from_map, own)
    written(tmp_path, "a.jpg 1 0 0\n")
    for table, source in (
        ({}, "the IMU"),
        ({"query": "lines"}, None),
        ({"query": "level"}, "the image's own up"),
        ({"query": "truth"}, "the true pose"),
        ({"query": "lines", "file": HERE}, "the gravity file"),
    ):
        (found,), _ = read_gravity(table, str(tmp_path / "s.toml"), 3.0).of_queries([view], problem.gravity_map)
        assert (None if found.gravity is None else found.gravity.source) == source
    both = CAMERA + POSED + '[gravity]\nmap = [0, 1, 0]\ncamera = [0, 1, 0]\nquery = "lines"\n'
    with pytest.raises(InputError, match="has both 'camera' and 'query'; keep one"):
        load_scene(make_tree(tmp_path, both))


def small_scene(tmp_path, problem, view, measured=None, bound_rad=0.05):
    """A scene of one query, whose matches are those of a simulated problem."""
    reference = View("reference", problem.camera, tmp_path / "r.png", problem.truth_cam_from_map)
    count = len(problem)
    matches = Matches(
        problem.pixels, problem.points, (reference,), np.zeros(count, np.int64), np.full((count, 2), np.nan)
    )
    query = replace(view, camera=problem.camera, cam_from_map=problem.truth_cam_from_map)
    scene = MapScene(
        "s",
        "s.toml",
        (query,),
        (reference,),
        lambda _: matches,
        problem.gravity_map,
        bound_rad,
        measured_gravity=measured,
    )
    return scene


def test_a_problem_has_the_bound_and_the_source_of_its_own_query(tmp_path, problem):
    down = problem.gravity_camera
    own = Gravity(down, "the IMU", 0.01, 0.002)
    for gravity, expected in (
        (own, (0.01, 0.002, "the IMU")),
        (Gravity(down, "the scene file"), (0.05, None, "the scene file")),
        (None, (0.05, None, "its most similar reference")),
    ):
        view = View("query", problem.camera, tmp_path / "q.png", gravity=gravity)
        scene = small_scene(tmp_path, problem, view)
        found = scene.problem()
        assert (found.gravity_bound_rad, found.gravity_sd_rad, found.gravity_source) == expected
        assert found.aligned.gravity_bound_rad == expected[0]
        assert found.gravity_error_rad == pytest.approx(0.0, abs=1e-7)
        row, _ = next(iter(localize_queries(scene, scene.queries, "mc", default_options("mc", found), 0)))
        assert row.gravity_source == expected[2] and row.gravity_bound_deg == pytest.approx(np.degrees(expected[0]))
        assert row_of_json(json_line(row), "here").gravity_source == expected[2]


def test_the_error_of_the_map_adds_to_a_gravity_that_does_not_follow_from_it(tmp_path, problem):
    view = View("query", problem.camera, tmp_path / "q.png")
    own = Gravity(problem.gravity_camera, "the IMU", 0.03, 0.01)
    for gravity, bound_rad, sd_rad in (
        (own, 0.09, np.hypot(0.01, 0.02)),
        (replace(own, by_map=True), 0.03, 0.01),
        (None, 0.05, None),
    ):
        scene = replace(small_scene(tmp_path, problem, replace(view, gravity=gravity)), gravity_map_bound_rad=0.06)
        found = scene.problem()
        assert found.gravity_bound_rad == pytest.approx(bound_rad)
        assert found.gravity_sd_rad == (None if sd_rad is None else pytest.approx(sd_rad))


def test_down_that_is_assumed_in_a_map_is_not_taken_for_certain(tmp_path):
    """The mean of the cameras' axes, where the scene does not say; a map that says has no error, or what it says."""
    for text, bound_deg in (
        ("", 5.0),
        ("[gravity]\nmap = [0, 1, 0]\n", 0.0),
        ("[gravity]\nmap = [0, 1, 0]\nmap_bound_deg = 2\n", 2.0),
    ):
        scene = load_scene(make_tree(tmp_path, CAMERA + POSED + text))
        assert isinstance(scene, MapScene) and scene.gravity_map_bound_rad == pytest.approx(np.radians(bound_deg))


def test_what_cannot_be_measured_comes_from_the_reference_and_is_said(tmp_path, problem):
    def refused(view, near):
        assert near is not None
        raise InputError(f"{view.name}: shows too few lines.")

    view = View("query", problem.camera, tmp_path / "q.png")
    found = small_scene(tmp_path, problem, view, refused).problem()
    assert found.gravity_source == "its most similar reference"
    assert found.remarks[-1] == "query: shows too few lines. Gravity is that of the most similar reference."


def test_gravity_that_points_up_is_remarked_on(tmp_path, problem):
    up = Gravity(-problem.gravity_camera, "the gravity file", 0.01)
    found = small_scene(tmp_path, problem, View("query", problem.camera, tmp_path / "q.png", gravity=up)).problem()
    assert "180 degrees away" in found.remarks[-1] and "must point down" in found.remarks[-1]


def test_the_true_pose_as_a_source_is_exact_and_said(tmp_path, problem):
    settings = read_gravity({"query": "truth"}, "s.toml", 3.0)
    view = View("query", problem.camera, tmp_path / "q.png", problem.truth_cam_from_map)
    (known,), remarks = settings.of_queries(
        [view, replace(view, name="other", cam_from_map=None)][:1], problem.gravity_map
    )
    assert known.gravity is not None and known.gravity.bound_rad == 0.0 and "true poses" in remarks[0]
    np.testing.assert_allclose(known.gravity.down, problem.truth_cam_from_map[:, :3] @ problem.gravity_map)


def test_rows_of_older_results_are_read():
    row = json_line(row_of_json(OLD, "here"))
    assert '"gravity_source": null' in row


OLD = (
    '{"index": 0, "query": "a", "status": "failed", "timestamp_s": null, "references": null, "matches": null, '
    '"inliers": null, "estimated_outlier_rate": null, "true_outlier_rate": null, "rotation_error_deg": null, '
    '"translation_error_m": null, "registration_error_m": null, "precision": null, "recall": null, "f1": null, '
    '"matching_ms": null, "estimating_ms": null, "diagnosis": null, "recording": null, "message": "", "remarks": [], '
    '"cam_from_map": null, "truth_cam_from_map": null}'
)


def test_a_source_is_a_short_text(problem):
    for wrong in (3, "x" * 300):
        with pytest.raises(ProblemError, match="gravity_source"):
            replace(problem, gravity_source=wrong)


def test_runs_and_sequences_say_where_gravity_came_from(tmp_path, problem):
    view = View("query", problem.camera, tmp_path / "q.png", gravity=Gravity(problem.gravity_camera, "the IMU", 0.01))
    scene = small_scene(tmp_path, problem, view)
    row, trace = next(iter(localize_queries(scene, scene.queries, "mc", default_options("mc", scene.problem()), 0)))
    assert trace is not None
    told = as_text(tmp_path / "s.toml", trace, diagnose(trace), None)
    assert "  gravity from the IMU, within 0.57 deg; 0 deg off the truth\n" in told
    assert as_record(tmp_path, trace, diagnose(trace), None)["gravity_source"] == "the IMU"
    rows = [row, replace(row, gravity_bound_deg=2.0, gravity_error_deg=1.5), replace(row, gravity_source="lines")]
    assert list(summed_up(rows)) == [
        "gravity from the IMU in 2 queries, within 0.57 to 2 deg; off the truth by 0.75 deg in the median, 1.5 at most",
        "gravity from lines in 1 query, within 0.57 deg; off the truth by 0 deg in the median, 0 at most",
    ]
    why = "it has 3 straight edges, fewer than 5. Gravity is that of the most similar reference."
    remarks = ("It is dark.", f"q.png: {NOT_FOUND} {why}")
    without = [replace(row, query=f"{number}.png", remarks=remarks) for number in range(7)]
    said = list(without_lines([row, *without]))
    assert said[0] == f"no gravity from lines of 0.png: {why}" and len(said) == 6
    assert said[5] == "no gravity from lines of 2 more, see results.csv"


@pytest.mark.parametrize(
    ("source", "why"), [("lines of the image", "may be tilted"), (LIKE_REFERENCE, "held otherwise than the references")]
)
def test_a_gravity_that_most_queries_contradict_is_doubted(source, why):
    off = QueryResult(0, "a", LOCALIZED, gravity_source=source, gravity_bound_deg=1.0, diagnosis=Cause.GRAVITY_OFF)
    right, unknown = replace(off, diagnosis=Cause.OK), replace(off, status="doubtful")
    told = list(summed_up([*[off] * 4, *[right] * 4, *[unknown] * 9]))
    assert len(told) == 2 and told[1].startswith("in 4 of 8 localized ones the matches show") and why in told[1]
    for rows in ([off] * 3, [*[off] * 4, *[right] * 5], [unknown] * 9):
        assert len(list(summed_up(rows))) == 1
