"""A recording, read back with rerun's own reader, is the trace and its pictures."""

import json
import os
import re
import subprocess
import sys
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun as rr
from recording_samples import RUNS, Recorded, exact_run, lost_run, odd_problem, scene_problem
from rerun.chunk import Chunk, LazyChunkStream, RrdReader

from spherloc.diagnosis import diagnose
from spherloc.errors import RecordingError
from spherloc.estimators import estimate
from spherloc.estimators.mc import McOptions
from spherloc.metrics import evaluate
from spherloc.problem import Problem
from spherloc.trace import Certificate, RefinementStage, Trace
from spherloc_viz.layers import paint, steps
from spherloc_viz.layers.key_step import key_step
from spherloc_viz.layers.outcome import outcome_table
from spherloc_viz.layers.primitives import Balls, Label, Mesh, Points, Segments, StepHeading, Textured
from spherloc_viz.recording.content import data
from spherloc_viz.recording.content.components import LEVEL_OPACITY
from spherloc_viz.recording.content.data import check_recording, read_recording
from spherloc_viz.recording.content.drawing import WORDS
from spherloc_viz.recording.content.names import APPLICATION_ID, FORMAT_VERSION
from spherloc_viz.recording.content.texts import legible
from spherloc_viz.recording.content.writer import recorded_steps, write_recording
from spherloc_viz.recording.origin import machine
from spherloc_viz.recording.rerun_program import rerun_command, rerun_environment
from tests.needs import needs
from tests.waiting import LIMIT_S


@pytest.fixture(scope="module", params=[*RUNS, "lost", "by hand"], ids=str)
def trace(request: pytest.FixtureRequest) -> Trace:
    made = {"lost": lost_run, "by hand": exact_run}
    if request.param in made:
        return made[request.param]()
    return estimate(scene_problem(request.param[0]), request.param[1], seed=3)


@pytest.fixture(scope="module")
def path(trace: Trace, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(trace, tmp_path_factory.mktemp("recordings") / "new folder" / "run.rrd")


def written(trace: Trace, path: Path) -> Path:
    write_recording(trace, path)
    return path


@pytest.fixture(scope="module")
def recorded(path: Path) -> Recorded:
    return Recorded(path)


def shown_steps(trace: Trace) -> list[int]:
    """The steps that a lean recording of a run shows."""
    return recorded_steps(steps(trace), key_step(trace, diagnose(trace)))


def assert_same_bits(one: Problem, two: Problem) -> None:
    for item in fields(Problem):
        a, b = getattr(one, item.name), getattr(two, item.name)
        if isinstance(a, np.ndarray):
            assert isinstance(b, np.ndarray) and a.dtype == b.dtype and a.shape == b.shape, item.name
            assert a.tobytes() == b.tobytes(), item.name
        else:
            assert type(a) is type(b) and a == b, item.name


# ---------------------------------------------------------------------------------------------- numbers


def test_the_problem_comes_back_bit_for_bit(trace: Trace, path: Path) -> None:
    again = read_recording(path).problem
    assert_same_bits(trace.problem, again)
    assert again.bearings.tobytes() == trace.problem.bearings.tobytes()
    assert not again.points.flags.writeable


@pytest.mark.parametrize("turn", range(6))
def test_odd_problems_come_back_bit_for_bit(tmp_path: Path, rng: np.random.Generator, turn: int) -> None:
    problem = odd_problem(rng, turn)
    again = read_recording(written(estimate(problem, "ransac-2p"), tmp_path / "odd.rrd"))
    assert_same_bits(problem, again.problem)
    assert again.properties["name"] == problem.name and again.properties["scene"] == problem.scene


@pytest.mark.parametrize("trace", [*RUNS, "lost"], indirect=True, ids=str, scope="module")
def test_the_same_run_follows_from_what_is_recorded(trace: Trace, path: Path) -> None:
    run = read_recording(path)
    again = estimate(run.problem, run.estimator, type(trace.options)(**run.options), run.seed)
    assert np.array_equal(again.inlier_mask, trace.inlier_mask)
    assert (again.cam_from_map is None) == (trace.cam_from_map is None)
    if again.cam_from_map is not None and trace.cam_from_map is not None:
        assert again.cam_from_map.tobytes() == trace.cam_from_map.tobytes()


def test_the_result_comes_back(trace: Trace, path: Path) -> None:
    run = read_recording(path)
    assert (run.estimator, run.seed, run.message) == (trace.estimator, trace.seed, trace.message)
    assert run.options == asdict(trace.options)
    assert run.certificate == trace.certificate
    assert run.versions == {**trace.versions, "machine": machine()} and run.timings_ms == dict(trace.timings_ms)
    assert run.inlier_mask.dtype == bool and np.array_equal(run.inlier_mask, trace.inlier_mask)
    if trace.cam_from_map is None:
        assert run.cam_from_map is None
    else:
        assert run.cam_from_map is not None and run.cam_from_map.tobytes() == trace.cam_from_map.tobytes()


def test_stages_come_back_but_for_large_arrays(trace: Trace, path: Path) -> None:
    run = read_recording(path)
    assert list(run.stages) == [stage.kind for stage in trace.stages]
    for stage in trace.stages:
        for name, value in run.stages[stage.kind].items():
            original = getattr(stage, name)
            if isinstance(original, np.ndarray):
                assert value.dtype == original.dtype and value.shape == original.shape
                assert value.tobytes() == original.tobytes()
            else:
                assert value == (list(original) if isinstance(original, tuple) else original)
    refinement = trace.stage(RefinementStage)
    if refinement is not None:
        assert set(run.stages["refinement"]) == {item.name for item in fields(refinement)}


def test_properties_say_what_a_list_of_runs_shows(trace: Trace, path: Path) -> None:
    properties, metrics = read_recording(path).properties, evaluate(trace)
    assert properties["estimator"] == trace.estimator and properties["seed"] == trace.seed
    assert json.loads(properties["options"]) == asdict(trace.options)
    assert json.loads(properties["versions"]) == dict(trace.versions)
    assert properties["inliers"] == np.count_nonzero(trace.inlier_mask)
    assert properties["correspondences"] == len(trace.problem)
    assert properties["message"] == trace.message
    assert properties["created"].endswith("+00:00")
    assert properties.get("rotation_error_deg") == metrics.rotation_error_deg
    assert properties.get("translation_error_m") == metrics.translation_error_m
    assert properties["outcome"] == {True: "success", False: "failure", None: "unknown"}[metrics.success]


def test_properties_say_what_is_proven(trace: Trace, path: Path) -> None:
    properties, certificate = read_recording(path).properties, trace.certificate
    names = {"upper_bound": "upper_bound", "lower_bound": "lower_bound", "proven": "proven", "chance_sets": "nfa"}
    if certificate is None:
        assert not set(names) & set(properties), "absent, so that a query finds nulls"
    else:
        for name, field in names.items():
            assert properties[name] == getattr(certificate, field)
            assert type(properties[name]) is type(getattr(certificate, field))


def refuse(word: str) -> None:
    raise AssertionError(f"{word} is no JSON")


def test_infinity_comes_back_and_is_never_written_as_what_json_does_not_know(tmp_path: Path) -> None:
    options = McOptions(gravity_sd_deg=np.inf)
    problem = replace(scene_problem("mei_outliers_80"), gravity_sd_rad=np.inf)
    certificate = Certificate(20, 20, np.inf)
    trace = replace(estimate(problem, "mc", options), certificate=certificate)
    path = written(trace, tmp_path / "run.rrd")
    run = read_recording(path)
    assert run.options == asdict(options) and run.problem.gravity_sd_rad == np.inf and run.certificate == certificate
    assert run.properties["chance_sets"] == np.inf
    assert json.loads(run.properties["options"], parse_constant=refuse)["gravity_sd_deg"] == "inf"
    texts = [row["scalars"].as_py()[0] for rows in Recorded(path).rows.values() for _, row in rows if "scalars" in row]
    (text,) = texts
    assert len(json.loads(text, parse_constant=refuse)) == 4 + len(trace.stages)


def test_recordings_older_than_certificates_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    problem_row, run_row = data._problem_row, data._run_row

    def without(row: dict[str, Any], *names: str) -> dict[str, Any]:
        return {name: value for name, value in row.items() if name not in names}

    monkeypatch.setattr(data, "_problem_row", lambda problem: without(problem_row(problem), "gravity_sd_rad"))
    monkeypatch.setattr(data, "_run_row", lambda trace: without(run_row(trace), "certificate"))
    trace = estimate(scene_problem("mei_outliers_80"), "mc")
    run = read_recording(written(trace, tmp_path / "old.rrd"))
    assert run.certificate is None
    assert_same_bits(run.problem, trace.problem)


def test_a_wrong_pose_is_a_failure(tmp_path: Path) -> None:
    trace = estimate(scene_problem("mei_outliers_80"), "mc")
    assert trace.cam_from_map is not None
    moved = replace(trace, cam_from_map=trace.cam_from_map + np.eye(3, 4, 3))
    properties = read_recording(written(moved, tmp_path / "run.rrd")).properties
    assert properties["outcome"] == "failure"
    assert properties["translation_error_m"] == pytest.approx(1.0, abs=0.1)


# ---------------------------------------------------------------------------------------------- pictures


def rgba(colors: object, opacity: float = 1.0) -> np.ndarray:
    rgb = np.atleast_2d(np.asarray(colors, dtype=np.int64))
    return rgb[:, 0] * 2**24 + rgb[:, 1] * 2**16 + rgb[:, 2] * 2**8 + round(255 * opacity)


def test_every_step_shows_what_the_layers_paint(trace: Trace, recorded: Recorded) -> None:
    known = {entity for entity in recorded.rows if entity.startswith("/scene/")}
    for step in shown_steps(trace):
        scene = paint(trace, step).scene
        assert_words(recorded, step, [item for item in scene if isinstance(item, Label)])
        shown = {WORDS}
        for item in scene:
            if isinstance(item, Textured | Label):
                continue
            entity = rr.new_entity_path(["scene", *item.name.split("/")])
            shown.add(entity)
            assert_shows(recorded, entity, step, item)
        for entity in known - shown:
            assert recorded.at(entity, step) is None, f"{entity} is still there at step {step}"


def assert_words(recorded: Recorded, step: int, labels: list[Label]) -> None:
    """All labels are one entity."""
    if not labels:
        assert recorded.at(WORDS, step) is None
        return
    assert_near(recorded.array(WORDS, step, "Points3D:positions"), np.stack([label.position for label in labels]))
    assert recorded.array(WORDS, step, "Points3D:labels").tolist() == [label.text for label in labels]


def assert_shows(recorded: Recorded, entity: str, step: int, item: object) -> None:
    match item:
        case Points() | Segments() | Balls() if not len(item.colors):
            assert recorded.at(entity, step) is None or not len(recorded.array(entity, step, _places(item)))
        case Points():
            assert_near(recorded.array(entity, step, "Points3D:positions"), item.positions)
            assert (recorded.array(entity, step, "Points3D:colors") == rgba(item.colors)).all()
            assert recorded.array(entity, step, "Points3D:radii") == np.float32(item.radius_m)
            if item.ids is not None:
                assert np.array_equal(recorded.array(entity, step, "correspondence"), item.ids)
        case Segments():
            assert_near(recorded.array(entity, step, "LineStrips3D:strips"), item.points)
            assert (recorded.array(entity, step, "LineStrips3D:colors") == rgba(item.colors)).all()
            assert recorded.array(entity, step, "LineStrips3D:radii") == np.float32(-item.width_px / 2)
        case Balls():
            sizes = np.repeat(np.asarray(item.radii_m, np.float32)[:, None], 3, axis=1)
            assert_near(recorded.array(entity, step, "Ellipsoids3D:centers"), item.centers)
            assert_near(recorded.array(entity, step, "Ellipsoids3D:half_sizes"), sizes)
            assert (recorded.array(entity, step, "Ellipsoids3D:colors") == rgba(item.colors, item.opacity)).all()
        case Mesh():
            assert_near(recorded.array(entity, step, "Mesh3D:vertex_positions"), item.vertices)
            assert np.array_equal(recorded.array(entity, step, "Mesh3D:triangle_indices"), item.faces)
            assert recorded.array(entity, step, "Mesh3D:albedo_factor") == rgba(item.color, item.opacity)
        case _:
            raise AssertionError(f"the test knows no {type(item).__name__}")


def assert_near(recorded: np.ndarray, painted: np.ndarray) -> None:
    """Equal but for rounding to 24 bits."""
    assert recorded.shape == painted.shape and np.abs(recorded - painted).max() <= 2e-6 * np.abs(painted).max()


def _places(item: object) -> str:
    names: dict[type, str] = {
        Points: "Points3D:positions",
        Segments: "LineStrips3D:strips",
        Balls: "Ellipsoids3D:half_sizes",
    }
    return names[type(item)]


def test_every_step_shows_the_charts(trace: Trace, recorded: Recorded) -> None:
    known = {e for e in recorded.rows if e.startswith("/charts/") and not e.startswith("/charts/residuals/")}
    for step in shown_steps(trace):
        shown = set()
        for chart in paint(trace, step).charts:
            for curve in chart.curves:
                entity = f"/charts/{chart.name}/{curve.label.replace(' ', '_')}"
                shown.add(entity)
                heights = recorded.array(entity, step, "BarChart:values").tolist()[0]["buffer"]
                left = np.array(recorded.array(entity, step, "BarChart:abscissa").tolist()[0]["buffer"])
                widths = recorded.array(entity, step, "BarChart:widths")
                if curve.kind == "level":
                    assert (heights, left, widths) == (curve.y[0], curve.x[0], curve.x[1] - curve.x[0])
                    assert recorded.array(entity, step, "BarChart:color") == rgba(curve.color, LEVEL_OPACITY)
                    continue
                assert np.array_equal(heights, curve.y)
                assert recorded.array(entity, step, "BarChart:color") == rgba(curve.color)
                if curve.kind == "step":
                    assert np.array_equal(left, curve.x)
                    assert np.allclose(left[:-1] + widths[:-1], curve.x[1:], rtol=1e-6)
                else:
                    assert np.allclose(left + widths / 2, curve.x, rtol=1e-6, atol=1e-6)
        for entity in known - shown:
            assert recorded.at(entity, step) is None


def test_every_step_shows_its_words(trace: Trace, recorded: Recorded) -> None:
    for index in shown_steps(trace):
        text, step = unescaped(recorded.array("/step", index, "TextDocument:text")[0]), paint(trace, index).step
        for part in (step.title, step.caption, *step.equation.splitlines(), step.note):
            assert legible(" ".join(part.split())) in text
    outcome = unescaped(recorded.array("/outcome", -1, "TextDocument:text")[0])
    assert trace.message in outcome
    for table in (*paint(trace, len(steps(trace)) - 1).tables, outcome_table(trace)):
        for row in table.rows:
            assert all(legible(str(cell)) in outcome for cell in row)


def unescaped(markdown: str) -> str:
    return markdown.replace("\\", "")


def test_words_cannot_become_markup(tmp_path: Path) -> None:
    trace = estimate(scene_problem("mei_outliers_80"), "mc")
    evil = "![x](http://example.org/a.png) <b>| # `code` | $x$"
    path = written(replace(trace, message=evil), tmp_path / "run.rrd")
    text = Recorded(path).array("/outcome", -1, "TextDocument:text")[0]
    line = next(line for line in text.splitlines() if "example" in line)
    assert not re.search(r"(?<!\\)[][`<>|#$!]", line)
    assert unescaped(line) == evil


def test_what_a_stage_came_to_and_the_key_step_are_recorded() -> None:
    keys = [
        "problem",
        "gravity",
        *(f"yaw-arcs-{k}" for k in (10, 30, 100, 300)),
        "yaw-arcs",
        "yaw-candidate-1",
        "yaw-candidate-2",
    ]
    keys += [name for k in range(1, 9) for name in (f"sample-{k}-pose", f"sample-{k}")] + ["outcome"]
    kept = [
        keys[index] for index in recorded_steps([StepHeading(key, key) for key in keys], keys.index("yaw-arcs-100"))
    ]
    samples = [f"sample-{k}" for k in range(1, 9)]
    assert kept == ["problem", "yaw-arcs-100", "yaw-arcs", *samples, "outcome"]


def test_colours_change_without_their_places(trace: Trace, recorded: Recorded) -> None:
    rows = recorded.rows["/scene/map/points"]
    moved = [when for when, row in rows if "Points3D:positions" in row]
    colored = [when for when, row in rows if "Points3D:colors" in row]
    assert moved == [0] and len(colored) > 1


def test_identical_primitives_are_written_once(trace: Trace, recorded: Recorded) -> None:
    rows = recorded.rows.get("/scene/cameras/truth", [])
    truth = [when for when, row in rows if "LineStrips3D:strips" in row]
    assert truth == ([] if trace.problem.truth_cam_from_map is None else [0])


# ---------------------------------------------------------------------------------------------- file


def test_rerun_finds_no_fault_with_the_file(path: Path) -> None:
    command = [*rerun_command(), "rrd", "verify", str(path)]
    done = subprocess.run(
        command, capture_output=True, text=True, env=rerun_environment(), timeout=LIMIT_S, check=False
    )
    assert done.returncode == 0, done.stderr


def test_two_recordings_of_a_run_have_ids_of_their_own(trace: Trace, path: Path, tmp_path: Path) -> None:
    other = written(trace, tmp_path / "other.rrd")
    ids = {RrdReader(file).recordings()[0].recording_id for file in (path, other)}
    assert len(ids) == 2


def test_a_recording_is_small(path: Path) -> None:
    assert path.stat().st_size < 1_000_000


# ---------------------------------------------------------------------------------------------- errors


def one_sentence(error: pytest.ExceptionInfo[RecordingError], path: Path) -> str:
    message = str(error.value)
    assert message.startswith(str(path)) and "\n" not in message and message.endswith(".")
    return message


@pytest.mark.parametrize("keep", [0, 12, 0.1, 0.5, 0.9, 0.999])
def test_a_cut_file_is_refused(path: Path, tmp_path: Path, keep: float) -> None:
    content = path.read_bytes()
    cut = tmp_path / "cut.rrd"
    cut.write_bytes(content[: keep if isinstance(keep, int) else int(keep * len(content))])
    with pytest.raises(RecordingError) as error:
        read_recording(cut)
    one_sentence(error, cut)


def test_what_is_no_recording_is_refused(tmp_path: Path) -> None:
    text = tmp_path / "notes.rrd"
    text.write_text("hello\n" * 100)
    for path, said in ((tmp_path / "missing.rrd", "no such file"), (text, "not a whole")):
        for read in (read_recording, check_recording):
            with pytest.raises(RecordingError) as error:
                read(path)
            assert said in one_sentence(error, path)
    with pytest.raises(RecordingError, match=rf"is a folder of 1 recording; list them with: spherloc runs {tmp_path}$"):
        read_recording(tmp_path)


def write_foreign(path: Path, application: str, *chunks: Chunk) -> Path:
    dot = Chunk.from_columns("/dot", [], rr.Points3D.columns(positions=[[1, 2, 3]]))
    LazyChunkStream.from_iter([dot, *chunks]).write_rrd(path, application_id=application, recording_id="1")
    return path


def test_recordings_of_other_programs_and_versions_are_refused(tmp_path: Path) -> None:
    foreign = write_foreign(tmp_path / "foreign.rrd", "other")
    with pytest.raises(RecordingError, match="another program"):
        check_recording(foreign)
    bare = write_foreign(tmp_path / "bare.rrd", APPLICATION_ID)
    with pytest.raises(RecordingError, match="part of the run is missing"):
        read_recording(bare)
    later = Chunk.from_property("run", rr.AnyValues(format_version=FORMAT_VERSION + 1))
    with pytest.raises(RecordingError, match=rf"format {FORMAT_VERSION + 1}.*install the one that wrote it"):
        read_recording(write_foreign(tmp_path / "later.rrd", APPLICATION_ID, later))


def test_a_folder_that_cannot_be_had_is_one_sentence(trace: Trace, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    path = tmp_path / "file" / "run.rrd"
    with pytest.raises(RecordingError) as error:
        write_recording(trace, path)
    one_sentence(error, path)
    assert [file.name for file in tmp_path.iterdir()] == ["file"]


FULL_DISK = """
import resource, signal, sys
from pathlib import Path
from recording_samples import scene_problem
from spherloc.diagnosis import diagnose
from spherloc.errors import RecordingError
from spherloc.estimators import estimate
from spherloc_viz.recording.content.writer import recorded_steps, write_recording

path, limit = Path(sys.argv[1]), int(sys.argv[2])
trace = estimate(scene_problem("mei_outliers_80"), "mc")
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
if sys.argv[3] == "warm":
    write_recording(trace, path)
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
for attempt in range(2):
    try:
        write_recording(trace, path)
        print("written")
    except RecordingError as error:
        print(error)
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
"""


@needs("file size limit")
@pytest.mark.parametrize(("limit", "before"), [(1_000, "cold"), (100_000, "warm")])
def test_a_full_disk_is_one_sentence_and_leaves_what_was_there(tmp_path: Path, limit: int, before: str) -> None:
    path = tmp_path / "run.rrd"
    done = subprocess.run(
        [sys.executable, "-c", FULL_DISK, str(path), str(limit), before],
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
        # Python would leave the first half of compiled modules behind.
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parent), "PYTHONDONTWRITEBYTECODE": "1"},
    )
    first, second = done.stdout.strip().splitlines()
    assert first.startswith(f"{path}: the run cannot be recorded") and "File too large" in first
    assert second == "written", "room again"
    assert [file.name for file in tmp_path.iterdir()] == ["run.rrd"]
    check_recording(path)
