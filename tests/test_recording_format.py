"""What a recording holds beside the problem and the pictures, how much it takes, and other versions of the format."""

import gc
import json
from dataclasses import asdict, fields, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from recording_samples import RUNS, Recorded, exact_run, lost_run, scene_problem

from spherloc.datasets.variation import Variation
from spherloc.diagnosis import Cause, diagnose
from spherloc.errors import RecordingError
from spherloc.estimators import estimate
from spherloc.geometry import yaw_rotation
from spherloc.metrics import rotation_error_deg, translation_error_m
from spherloc.problem import Problem
from spherloc.trace import RansacStage, Trace
from spherloc_viz import style
from spherloc_viz.layers import paint, steps
from spherloc_viz.layers.key_step import key_step, step_pose
from spherloc_viz.recording.content.components import HEIGHT_PX, LONGEST_PX, MATCHES, WIDTH_PX, thumbnail
from spherloc_viz.recording.content.data import MAX_SCENE_BYTES, read_recording, read_run_row, scene_text
from spherloc_viz.recording.content.head import read_head
from spherloc_viz.recording.content.names import FORMAT_VERSION, NUMBERS
from spherloc_viz.recording.content.writer import recorded_steps, write_recording
from spherloc_viz.recording.origin import Origin
from spherloc_viz.recording.review_file import write_review
from spherloc_viz.recording.run_summary import MAX_CHARACTERS, problem_key
from tests.needs import needs

FORMAT_1, FORMAT_2, FORMAT_3 = (Path(__file__).parent / "data" / f"format_{version}.rrd" for version in (1, 2, 3))
"""Written by the first version of the format: 24 matches, ransac-2p, seed 5."""


@pytest.fixture(scope="module")
def trace() -> Trace:
    return estimate(scene_problem("mei_outliers_80"), "mc", seed=3)


def failed(trace: Trace) -> Trace:
    """The same run with a pose that is a metre off."""
    assert trace.cam_from_map is not None
    return replace(trace, cam_from_map=trace.cam_from_map + np.eye(3, 4, 3))


# ---------------------------------------------------------------------------------------------- where it came from


def test_where_a_run_came_from_comes_back(trace: Trace, tmp_path: Path) -> None:
    scene = tmp_path / "a scene ü.toml"
    scene.write_text('kind = "synthetic"  # <b>\n')
    variation = Variation(correspondences=50, true_camera=(1.0, 2.0, 3.0, 4.0), spoiled=(3, 1), hidden=(7,))
    origin = Origin("gallery", str(scene), 4, "query 1.jpg", variation, "A <title>", "Two\nlines | of *story*.")
    row = write_recording(trace, tmp_path / "run.rrd", origin)
    run = read_recording(tmp_path / "run.rrd")
    assert run.origin == origin and run.scene_text == scene.read_text()
    assert (row.source, row.query, row.title) == ("gallery", "query 1.jpg", "A <title>")
    text = Recorded(tmp_path / "run.rrd").array("/outcome", -1, "TextDocument:text")[0]
    assert text.startswith("# A \\<title\\>\n\nTwo lines \\| of \\*story\\*.")


def test_a_run_from_nowhere(trace: Trace, tmp_path: Path) -> None:
    write_recording(trace, tmp_path / "run.rrd")
    run = read_recording(tmp_path / "run.rrd")
    assert run.origin == Origin() and run.scene_text is None and run.row.source == "unknown"


def test_only_scene_files_of_moderate_size_are_kept(tmp_path: Path) -> None:
    exact, large, other = tmp_path / "a.toml", tmp_path / "b.toml", tmp_path / "c.txt"
    exact.write_bytes(b"#" * MAX_SCENE_BYTES)
    large.write_bytes(b"#" * (MAX_SCENE_BYTES + 1))
    other.write_text("secret")
    binary = tmp_path / "d.toml"
    binary.write_bytes(b"\xff\xfe\x00")
    assert scene_text(str(exact)) == "#" * MAX_SCENE_BYTES
    for path in (large, other, binary, tmp_path, tmp_path / "missing.toml"):
        assert scene_text(str(path)) is None
    assert scene_text(None) is None and scene_text("a\0b.toml") is None


# ---------------------------------------------------------------------------------------------- diagnosis and row


@pytest.mark.parametrize("name", ["right", "wrong", "lost"])
def test_the_diagnosis_comes_back(name: str, trace: Trace, tmp_path: Path) -> None:
    run = {"right": trace, "wrong": failed(trace), "lost": lost_run()}[name]
    told = diagnose(run)
    row = write_recording(run, tmp_path / "run.rrd", diagnosis=told)
    again = read_recording(tmp_path / "run.rrd").diagnosis
    assert again is not None
    for item in fields(told):
        value, recorded = getattr(told, item.name), getattr(again, item.name)
        if isinstance(value, np.ndarray):
            assert recorded.tobytes() == value.tobytes() and recorded.shape == value.shape
        else:
            assert type(recorded) is type(value) and recorded == value
    assert (row.diagnosis, row.doubtful, row.summary) == (told.cause.value, told.doubtful, told.summary)
    text = Recorded(tmp_path / "run.rrd").array("/outcome", -1, "TextDocument:text")[0].replace("\\", "")
    assert all(sentence in text for sentence in (told.summary, *told.evidence, told.advice))


def test_a_given_diagnosis_is_not_made_again(trace: Trace, tmp_path: Path) -> None:
    told = replace(diagnose(trace), cause=Cause.AMBIGUOUS, summary="Said by hand.")
    row = write_recording(trace, tmp_path / "run.rrd", diagnosis=told)
    assert (row.diagnosis, row.summary) == ("ambiguous", "Said by hand.")


@pytest.mark.parametrize("run", [*RUNS[:2], "lost", "by hand"], ids=str)
def test_the_row_that_is_returned_is_the_row_that_is_read(run: object, tmp_path: Path) -> None:
    made = {"lost": lost_run, "by hand": exact_run}
    trace = made[run]() if isinstance(run, str) else estimate(scene_problem(run[0]), run[1], seed=3)  # type: ignore[index]
    path = tmp_path / "a run.rrd"
    row = write_recording(trace, path, Origin("sweep"))
    assert read_run_row(path) == read_recording(path).row == row == read_head(path)
    assert (row.file, row.size_bytes, row.format_version) == ("a run.rrd", path.stat().st_size, FORMAT_VERSION)
    assert row.steps == len(steps(trace)) and 0 <= row.key_step < row.steps
    labels = trace.problem.truth_inliers
    assert row.outlier_rate == (None if labels is None else 1.0 - labels.mean())
    assert row.proven == (None if trace.certificate is None else trace.certificate.proven)
    assert json.loads(row.options) == asdict(trace.options)


def test_labels_and_note_are_part_of_the_row(trace: Trace, tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    row = write_recording(trace, path)
    write_review(path, ["seam", "look again"], "Two lines\nof note.")
    assert read_run_row(path) == replace(row, labels=("seam", "look again"), note="Two lines\nof note.")
    path.with_name("run.review.rrd").write_bytes(b"damaged")
    assert read_run_row(path) == row


def test_long_names_are_cut_in_the_row_and_whole_in_the_problem(trace: Trace, tmp_path: Path) -> None:
    long = "<x>" * MAX_CHARACTERS
    named = replace(trace, problem=replace(trace.problem, name=long, scene=long), message=long)
    row = write_recording(named, tmp_path / "run.rrd")
    assert all(len(text) == MAX_CHARACTERS for text in (row.name, row.scene, row.message))
    assert read_recording(tmp_path / "run.rrd").problem.name == long


def test_equal_problems_have_equal_keys(trace: Trace) -> None:
    problem = trace.problem
    same = replace(problem, name="other", scene="other", truth_cam_from_map=None, truth_inliers=None)
    assert problem_key(same) == problem_key(problem)
    moved = problem.points.copy()
    moved[0, 0] = np.nextafter(moved[0, 0], np.inf)
    changes = ({"points": moved}, {"bound_px": 9.0}, {"gravity_bound_rad": 0.01}, {"gravity_sd_rad": 0.5})
    others = [replace(problem, **change) for change in changes]
    assert len({problem_key(item) for item in (problem, *others)}) == 5


# ---------------------------------------------------------------------------------------------- numbers a step


@pytest.mark.parametrize("run", RUNS, ids=str)
def test_every_recorded_step_has_its_numbers(run: tuple[str, str], tmp_path: Path) -> None:
    trace = estimate(scene_problem(run[0]), run[1], seed=3)
    row = write_recording(trace, tmp_path / "run.rrd")
    rows = dict(Recorded(tmp_path / "run.rrd").rows[NUMBERS])
    assert list(rows) == recorded_steps(steps(trace), row.key_step)
    truth = trace.problem.truth_cam_from_map
    assert truth is not None
    for index, numbers in rows.items():
        heading, picture = steps(trace)[index], paint(trace, index)
        found = {name: value.as_py()[0] for name, value in numbers.items() if name in ("stage", "key", "agreeing")}
        colors = next(item for item in picture.scene if item.name == "map/points").colors  # type: ignore[union-attr]
        marked = sum(tuple(color) in (style.INLIER, style.CLIQUE) for color in colors.tolist())
        assert found == {"stage": heading.stage, "key": heading.key, "agreeing": marked}
        pose = step_pose(trace, heading.key)
        assert ("rotation_error_deg" in numbers) == ("translation_error_m" in numbers) == (pose is not None)
        if pose is not None:
            assert numbers["rotation_error_deg"].as_py() == [rotation_error_deg(truth, pose)]
            assert numbers["translation_error_m"].as_py() == [translation_error_m(truth, pose)]
    last = rows[row.steps - 1]
    assert last["agreeing"].as_py() == [row.inliers]
    assert last["translation_error_m"].as_py() == [row.translation_error_m]


@pytest.mark.parametrize("run", RUNS, ids=str)
def test_a_step_has_a_pose_exactly_where_its_picture_has_an_estimate(run: tuple[str, str]) -> None:
    trace = estimate(scene_problem(run[0]), run[1], seed=3)
    for index, heading in enumerate(steps(trace)):
        drawn = next((item for item in paint(trace, index).scene if item.name == "cameras/estimate"), None)
        pose = step_pose(trace, heading.key)
        assert (pose is None) == (drawn is None), heading.key
        if pose is not None:
            aligned = trace.problem.aligned.align_pose(pose)
            apex = drawn.points[0, 0]  # type: ignore[union-attr]
            assert np.allclose(apex, -aligned[:, :3].T @ aligned[:, 3], atol=1e-9), heading.key


# ---------------------------------------------------------------------------------------------- the key step


def key_of(trace: Trace) -> str:
    return steps(trace)[key_step(trace, diagnose(trace))].key


def test_a_right_run_was_decided_where_its_consensus_was_found(trace: Trace) -> None:
    assert key_of(trace) == "clique"
    sampled = estimate(scene_problem("fisheye_outliers_80"), "ransac-2p", seed=3)
    stage = sampled.stage(RansacStage)
    assert stage is not None and key_of(sampled) == f"sample-{len(stage.improved_at)}"
    assert key_of(exact_run()) == "consensus-pose-1"


def test_a_run_without_a_pose_was_decided_by_its_end() -> None:
    assert key_of(lost_run()) == "outcome"


def wrongly_seen(problem: Problem, share: float) -> Problem:
    """Most matches are those of a camera that is turned by 60 degrees and 2 m away."""
    assert problem.truth_cam_from_map is not None
    points = problem.points.copy()
    wrong = np.arange(len(points)) < share * len(points)
    turn = yaw_rotation(np.radians(60.0))
    up = problem.aligned.map_turn
    points[wrong] = (points[wrong] @ up.T @ turn.T + [2.0, 0.0, 0.0]) @ up
    return replace(problem, points=points, truth_inliers=~wrong)


def test_a_wrong_yaw_is_where_a_run_went_wrong(rng: np.random.Generator) -> None:
    clean = Variation(outlier_rate=0.0, correspondences=60).problem(_scene("mei_outliers_80"))
    problem = wrongly_seen(clean, 0.7)
    for estimator, key in (("mc", "yaw-clique"), ("mc-exact", "consensus-poses")):
        trace = estimate(problem, estimator)
        assert diagnose(trace).cause is Cause.FALSE_CONSENSUS
        assert key_of(trace) == key


def _scene(name: str):
    from spherloc.datasets import bundled_scenes, load_scene

    return load_scene(bundled_scenes()[name])


def test_wrong_gravity_is_where_a_run_went_wrong() -> None:
    clean = Variation(outlier_rate=0.2, correspondences=80).problem(_scene("mei_outliers_80"))
    tilt = np.radians(6.0)
    turned = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    trace = estimate(replace(clean, gravity_camera=turned @ clean.gravity_camera), "mc")
    assert diagnose(trace).cause is Cause.GRAVITY_OFF
    assert key_of(trace) == "gravity"


# ---------------------------------------------------------------------------------------------- pictures


def test_a_thumbnail_shows_matches_and_cameras(trace: Trace) -> None:
    for run in (trace, failed(trace), lost_run()):
        content = thumbnail(run)
        image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None and image.shape == (HEIGHT_PX, WIDTH_PX, 3) and len(content) < 3_000
        colors = {tuple(color) for color in image[:, :, ::-1].reshape(-1, 3).tolist()}
        assert style.OUTLIER in colors
        assert (style.INLIER in colors) == bool(run.inlier_mask.any())
        assert (style.ESTIMATE in colors) == (run.cam_from_map is not None)
    both = cv2.imdecode(np.frombuffer(thumbnail(failed(trace)), np.uint8), cv2.IMREAD_COLOR)
    assert both is not None
    assert style.TRUTH in {tuple(color) for color in both[:, :, ::-1].reshape(-1, 3).tolist()}


def test_the_query_image_is_recorded_small_with_its_matches(trace: Trace, tmp_path: Path) -> None:
    camera, photo = trace.problem.camera, tmp_path / "query ü.png"
    grey = np.full((camera.height, camera.width, 3), 90, np.uint8)
    grey[:, : camera.width // 2] = 200
    cv2.imwrite(str(photo), grey)
    with_image = replace(trace, problem=replace(trace.problem, image=photo))
    row = write_recording(with_image, tmp_path / "run.rrd")
    assert row.query == photo.name and row.size_bytes < 1_000_000
    content = read_recording(tmp_path / "run.rrd").query_image
    assert content is not None and content[:2] == b"\xff\xd8"
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None and max(image.shape) == LONGEST_PX
    assert np.allclose(image[::50, ::50, 0], np.where(np.arange(0, image.shape[1], 50) < image.shape[1] / 2, 200, 90))
    recorded = Recorded(tmp_path / "run.rrd")
    scale = image.shape[1] / camera.width
    for step in (0, row.key_step, row.steps - 1):
        places = recorded.array(MATCHES, step, "Points2D:positions")
        assert np.allclose(places, scale * trace.problem.pixels, atol=0.01)
        assert np.array_equal(
            recorded.array(MATCHES, step, "Points2D:colors"),
            recorded.array("/scene/map/points", step, "Points3D:colors"),
        )


def test_noise_is_pressed_until_it_is_small(trace: Trace, tmp_path: Path, rng: np.random.Generator) -> None:
    camera, photo = trace.problem.camera, tmp_path / "noise.png"
    cv2.imwrite(str(photo), rng.integers(0, 255, (camera.height, camera.width, 3), np.uint8))
    with_image = replace(trace, problem=replace(trace.problem, image=photo))
    assert write_recording(with_image, tmp_path / "run.rrd").size_bytes < 1_100_000


def test_a_missing_image_is_said(trace: Trace, tmp_path: Path) -> None:
    gone = replace(trace, problem=replace(trace.problem, image=tmp_path / "gone <i>.jpg"))
    write_recording(gone, tmp_path / "run.rrd")
    run = read_recording(tmp_path / "run.rrd")
    assert run.query_image is None and run.problem.image == tmp_path / "gone <i>.jpg"
    recorded = Recorded(tmp_path / "run.rrd")
    text = recorded.array("/outcome", -1, "TextDocument:text")[0]
    assert "cannot be read any more" in text and "gone \\<i\\>.jpg" in text
    assert recorded.at("/query/frame", -1) is not None


# ---------------------------------------------------------------------------------------------- size, versions, memory


def test_a_full_recording_keeps_every_array_and_step(trace: Trace, tmp_path: Path) -> None:
    write_recording(trace, tmp_path / "lean.rrd")
    write_recording(trace, tmp_path / "full.rrd", full=True)
    lean, full = read_recording(tmp_path / "lean.rrd"), read_recording(tmp_path / "full.rrd")
    left_out = 0
    for stage in trace.stages:
        for item in fields(stage):
            value, kept = getattr(stage, item.name), full.stages[stage.kind][item.name]
            if isinstance(value, np.ndarray):
                assert kept.dtype == value.dtype and kept.shape == value.shape and kept.tobytes() == value.tobytes()
            left_out += item.name not in lean.stages[stage.kind]
    assert left_out > 0
    assert list(dict(Recorded(tmp_path / "full.rrd").rows[NUMBERS])) == list(range(len(steps(trace))))


@pytest.mark.parametrize(("scene", "estimator"), RUNS, ids=str)
def test_two_hundred_matches_take_less_than_a_megabyte(scene: str, estimator: str, tmp_path: Path) -> None:
    problem = Variation(correspondences=200).problem(_scene(scene))
    assert write_recording(estimate(problem, estimator), tmp_path / "run.rrd").size_bytes < 1_000_000


def test_a_file_of_format_1_still_opens() -> None:
    run, row = read_recording(FORMAT_1), read_run_row(FORMAT_1)
    assert (run.origin, run.scene_text, run.diagnosis, run.query_image) == (None, None, None, None)
    assert row == run.row and (row.format_version, row.source, row.diagnosis, row.thumbnail) == (1, "unknown", "", b"")
    assert (row.estimator, row.seed, row.outcome) == ("ransac-2p", 5, "success")
    assert (row.correspondences, row.inliers) == (24, 5)
    problem = Variation(correspondences=24).problem(_scene("mei_outliers_80"))
    assert run.problem.pixels.tobytes() == problem.pixels.tobytes()
    assert problem_key(run.problem) == problem_key(problem)
    again = estimate(run.problem, run.estimator, None, run.seed)
    assert again.cam_from_map is not None and run.cam_from_map is not None
    assert np.allclose(again.cam_from_map, run.cam_from_map, atol=1e-6)
    assert set(run.stages) == {"ransac", "refinement"}
    assert run.stages["ransac"]["cam_from_map"].shape[1:] == (3, 4)


@pytest.mark.parametrize(("version", "path"), [(2, FORMAT_2), (3, FORMAT_3)])
def test_files_of_later_formats_still_open(version: int, path: Path) -> None:
    run, row = read_recording(path), read_run_row(path)
    variation, title = Variation(correspondences=24), f"As in format {version}"
    assert row == run.row and (row.format_version, row.source, row.title) == (version, "command", title)
    assert run.origin == Origin("command", variation=variation, title=title)
    assert run.diagnosis is not None and run.diagnosis.cause is Cause.OK and run.diagnosis.evidence
    problem = variation.problem(_scene("mei_outliers_80"))
    assert run.problem.pixels.tobytes() == problem.pixels.tobytes() and problem_key(run.problem) == row.problem_key
    assert set(run.stages) == {"ransac", "refinement"} and run.stages["refinement"]["covariance"].shape == (6, 6)
    assert row.thumbnail.startswith(b"\x89PNG") and run.inlier_mask.sum() == row.inliers == 5


def test_a_changed_byte_is_noticed_or_harmless(trace: Trace, tmp_path: Path, rng: np.random.Generator) -> None:
    path, spoiled = tmp_path / "run.rrd", tmp_path / "spoiled.rrd"
    row = write_recording(trace, path)
    content = path.read_bytes()
    for place in rng.integers(0, len(content), 40).tolist():
        spoiled.write_bytes(content[:place] + bytes([content[place] ^ 0x41]) + content[place + 1 :])
        try:
            found = read_run_row(spoiled)
        except RecordingError as error:
            assert str(error).startswith(str(spoiled)) and "\n" not in str(error)
        else:
            assert found.estimator == row.estimator


@needs("/proc")
def test_many_runs_take_no_more_threads_or_memory(tmp_path: Path) -> None:
    tasks, status = Path("/proc/self/task"), Path("/proc/self/statm")
    problem = Variation(correspondences=12).problem(_scene("mei_outliers_80"))
    trace = estimate(problem, "ransac-2p")
    told = diagnose(trace)

    def used() -> tuple[int, int]:
        gc.collect()
        return len(list(tasks.iterdir())), int(status.read_text().split()[1]) * 4096

    def write(count: int) -> None:
        for _ in range(count):
            write_recording(trace, tmp_path / "run.rrd", diagnosis=told)

    write(20)  # after which layouts, pools of memory and threads are there
    threads, memory = used()
    write(100)
    more_threads, more_memory = used()
    assert more_threads <= threads + 1
    assert more_memory - memory < 20e6, "100 runs of 0.3 MB each"
