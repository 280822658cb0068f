"""How a recording opens: its layout lies in its own file, and the real viewer has no fault to find with it."""

import contextlib
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rerun as rr
from recording_samples import exact_run, lost_run, scene_problem
from rerun.chunk import Chunk, LazyChunkStream, RrdReader
from rerun.experimental import ViewerClient, ViewerState

from spherloc.estimators import estimate
from spherloc.trace import Trace, TranslationStage, YawStage
from spherloc_viz.layers import paint, steps
from spherloc_viz.layers.primitives import Chart, Curve, Picture
from spherloc_viz.recording.content.columns import Values, static_chunk
from spherloc_viz.recording.content.layout import append, layout_file, shown_in, split, xxh32
from spherloc_viz.recording.content.names import APPLICATION_ID, REVIEW_ENTITY
from spherloc_viz.recording.content.panels import MAX_EDGES, MAX_NODES, panel_chunks, panels_of
from spherloc_viz.recording.content.texts import legible
from spherloc_viz.recording.content.writer import write_recording
from spherloc_viz.recording.rerun_program import rerun_command, rerun_environment
from spherloc_viz.recording.run_row import RunRow
from tests.needs import require, vulkan
from tests.waiting import LIMIT_S, until


@pytest.fixture(scope="module")
def clique_run() -> Trace:
    """Its graph is small enough for the viewer's own."""
    return estimate(scene_problem("panorama_outliers_90"), "mc", seed=3)


@pytest.fixture(scope="module")
def sample_run() -> Trace:
    return estimate(scene_problem("fisheye_outliers_80"), "ransac-2p", seed=3)


def layout_of(path: Path) -> tuple[dict[str, Any], dict[str, str]]:
    """Components of the time panel, and the class of the view at every origin."""
    reader = RrdReader(path)
    (recording,), (layout,) = reader.recordings(), reader.blueprints()
    assert recording.application_id == layout.application_id == APPLICATION_ID
    panel: dict[str, Any] = {}
    views: dict[str, str] = {}
    for chunk in reader.store(store=layout).stream().to_chunks():
        batch = chunk.to_record_batch()
        row = {name: batch.column(name)[0].as_py() for name in batch.schema.names}
        if chunk.entity_path == "/time_panel":
            panel |= row
        if "ViewBlueprint:space_origin" in row:
            views[row["ViewBlueprint:space_origin"][0]] = row["ViewBlueprint:class_identifier"][0]
    return panel, views


def test_a_layout_is_whole_though_somebody_holds_the_frames_of_this_thread(sample_run: Trace) -> None:
    """As profilers and debuggers do: rerun's own way to save it completes the file when its stream is deleted."""
    shown = shown_in([paint(sample_run, step) for step in range(len(steps(sample_run)))], panels_of(sample_run))
    done = threading.Event()

    def hold_frames() -> None:
        while not done.is_set():
            frames = sys._current_frames()
            done.wait(0.01)
            del frames

    holder = threading.Thread(target=hold_frames)
    holder.start()
    try:
        for _ in range(12):
            layout_file.cache_clear()
            assert layout_file(shown).index
    finally:
        done.set()
        holder.join()


@pytest.mark.parametrize("name", ["clique_run", "sample_run", "lost", "exact"])
def test_a_file_opens_paused_at_the_steps_with_a_view_of_everything(
    name: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    trace = {"lost": lost_run, "exact": exact_run}.get(name, lambda: request.getfixturevalue(name))()
    path = tmp_path / "run.rrd"
    write_recording(trace, path)
    panel, views = layout_of(path)
    assert "TimePanelBlueprint:timeline" not in panel, "a named one is reported as missing while the file loads"
    assert panel["TimePanelBlueprint:play_state"] == [1], "paused"
    pictures = [paint(trace, step) for step in range(len(steps(trace)))]
    charts = {f"/charts/{chart.name}" for picture in pictures for chart in picture.charts}
    tables = {rr.new_entity_path(["tables", t.name]) for picture in pictures[:-1] for t in picture.tables}
    expected = {"/", "/step", "/outcome", "/query", REVIEW_ENTITY} | charts | tables
    expected |= {"/charts/residuals"} if trace.cam_from_map is not None else set()
    yaw, translation = trace.stage(YawStage), trace.stage(TranslationStage)
    expected |= {"/arcs"} if yaw is not None and len(yaw.pairs) else set()
    expected |= {"/graph"} if translation is not None and len(translation.pairs) else set()
    assert set(views) == expected
    if name == "clique_run":
        assert views["/graph"] == "Graph"
    reader = RrdReader(path)
    entities = {chunk.entity_path for chunk in reader.store(store=reader.recordings()[0]).stream().to_chunks()}
    for origin in expected - {"/", REVIEW_ENTITY}:
        assert any(entity == origin or entity.startswith(f"{origin}/") for entity in entities), f"{origin} is empty"


def test_a_graph_beyond_the_viewers_limits_is_lines(clique_run: Trace) -> None:
    stage = clique_run.stage(TranslationStage)
    assert stage is not None
    small = panels_of(clique_run)
    count = len(stage.pairs)
    assert count <= MAX_NODES and len(stage.edges) <= MAX_EDGES and small.graph and not small.large_graph
    first, second = np.triu_indices(count, 1)
    dense = replace(stage, edges=np.column_stack([first, second]).astype(np.int32))
    stages = tuple(dense if item is stage else item for item in clique_run.stages)
    trace = replace(clique_run, stages=stages)
    panels = panels_of(trace)
    assert len(first) > MAX_EDGES and panels.large_graph and not panels.graph
    chunks = {chunk.entity_path: chunk.to_record_batch() for chunk in panel_chunks(trace, panels)}
    assert len(chunks["/graph/overlaps"].column("LineStrips2D:strips")[0]) == MAX_EDGES
    assert len(chunks["/graph/balls"].column("Points2D:positions")[0]) == count


# ---------------------------------------------------------------------------------------------- two stores in a file


def test_checksums_are_those_of_the_hash() -> None:
    seen = {
        b"": 0x02CC5D05,
        b"a": 0x550D7456,
        b"abc": 0x32D153FF,
        b"Nobody inspects the spammish repetition": 0xE2293B2F,
    }
    for content, value in seen.items():
        assert xxh32(np.frombuffer(content, np.uint8), 0) == value


@pytest.mark.parametrize("count", [1, 40])
def test_stores_that_are_joined_are_whole(tmp_path: Path, clique_run: Trace, count: int) -> None:
    layout = layout_file(shown_in([paint(clique_run, 0)], panels_of(clique_run)))
    path = tmp_path / "run.rrd"
    numbers = [Values(rr.ComponentDescriptor("number"), rr.components.ScalarBatch([7.0]).as_arrow_array(), [1])]
    chunks = [static_chunk(f"/at/{k}", numbers) for k in range(count)]
    LazyChunkStream.from_iter(chunks).write_rrd(path, application_id=APPLICATION_ID, recording_id="id")
    assert append(path, layout) == path.stat().st_size
    reader = RrdReader(path)
    (recording,), (view,) = reader.recordings(), reader.blueprints()
    found = reader.store(store=recording).stream().filter(content=["/at/**"]).to_chunks()
    assert {chunk.entity_path for chunk in found} == {f"/at/{k}" for k in range(count)}
    assert all(chunk.to_record_batch().column("number")[0].as_py() == [7.0] for chunk in found)
    assert len(reader.store(store=view).stream().to_chunks()) > 5
    command = [*rerun_command(), "rrd", "verify", str(path)]
    done = subprocess.run(
        command, capture_output=True, text=True, env=rerun_environment(), timeout=LIMIT_S, check=False
    )
    assert done.returncode == 0, done.stderr


def test_a_file_in_another_form_is_refused(tmp_path: Path, clique_run: Trace) -> None:
    path = tmp_path / "run.rrd"
    dot = Chunk.from_columns("/dot", [], rr.Points3D.columns(positions=[[1, 2, 3]]))
    LazyChunkStream.from_iter([dot]).write_rrd(path, application_id=APPLICATION_ID, recording_id="id")
    content = path.read_bytes()
    start = struct.unpack_from("<Q", content, len(content) - 32)[0]
    spoiled = content[: start + 5] + bytes([content[start + 5] ^ 1]) + content[start + 6 :]
    layout = layout_file(shown_in([paint(clique_run, 0)], panels_of(clique_run)))
    for wrong in (content[:-1], spoiled, content[:50], b""):
        path.write_bytes(wrong)
        with pytest.raises(ValueError, match="rerun wrote"):
            split(wrong)
        with pytest.raises(ValueError, match="rerun wrote"):
            append(path, layout)
        assert path.read_bytes() == wrong


# ---------------------------------------------------------------------------------------------- the viewer


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def viewer(monkeypatch: pytest.MonkeyPatch) -> Iterator[ViewerClient]:
    """rerun's viewer without a window."""
    require("vulkan")
    for name, value in {"CI": "true", "TELEMETRY_ENABLED": "false", **(vulkan() or {})}.items():
        monkeypatch.setenv(name, value)
    client = ViewerClient.spawn(headless=True, port=free_port(), executable_path=rerun_command()[0])
    yield client
    client.quit()


def photograph(viewer: ViewerClient) -> np.ndarray | None:
    """What the viewer shows; None if that takes it longer than it allows itself."""
    with contextlib.suppress(TimeoutError):
        return cv2.imdecode(np.frombuffer(viewer.take_screenshot(max_size=480), np.uint8), cv2.IMREAD_COLOR)


def opened(viewer: ViewerClient, row: RunRow) -> ViewerState | None:
    """What the viewer shows once it has the whole run."""
    state = viewer.get_state()
    here = str(state.active_recording).endswith(row.run_id) and not state.loading
    return state if here and state.views else None


def image_run(trace: Trace, folder: Path) -> Trace:
    """The run with an image in which every match has a grey patch."""
    camera, path = trace.problem.camera, folder / "query ü.jpg"
    image = np.zeros((camera.height, camera.width, 3), np.uint8)
    for x, y in trace.problem.pixels.astype(int).tolist():
        cv2.circle(image, (x, y), 9, (128, 128, 128), -1)
    cv2.imwrite(str(path), image)
    return replace(trace, problem=replace(trace.problem, image=path))


@pytest.mark.parametrize("name", ["sample_run", "exact", "image"])
def test_the_viewer_has_no_fault_to_find(
    name: str, request: pytest.FixtureRequest, tmp_path: Path, viewer: ViewerClient
) -> None:
    if name == "image":
        trace = image_run(request.getfixturevalue("clique_run"), tmp_path)
    else:
        trace = exact_run() if name == "exact" else request.getfixturevalue(name)
    path = tmp_path / "run.rrd"
    trace = replace(trace, message="A message: 新しい ᵀ ∈ \U0001f4f7", problem=replace(trace.problem, name="地図"))
    row = write_recording(trace, path)
    viewer.open(str(path))
    state = until(lambda: opened(viewer, row))
    assert state is not None
    recording = next(found for found in state.recordings if found.store_id == state.active_recording)
    assert recording.current_timeline == "step"
    _, views = layout_of(path)
    assert {view.origin for view in state.views} == set(views)
    # The fourth step has a letter that the viewer's font lacks, and the name of the problem has others.
    for step in (4, row.key_step + 1, row.steps):
        viewer.set_time(timeline="step", sequence=step)
        (picture,) = until(lambda: () if (taken := photograph(viewer)) is None else (taken,))
        assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 100, "a picture, not a blank"
        faults = [(view.name, report) for view in viewer.get_state().views for report in view.reports]
        assert faults == []


@pytest.mark.parametrize("estimator", ["mc", "mc-exact", "ransac-2p"])
def test_every_word_can_be_drawn(estimator: str, tmp_path: Path) -> None:
    trace = estimate(scene_problem("mei_outliers_90"), estimator)
    path = tmp_path / "run.rrd"
    write_recording(replace(trace, message="新 ᵀ \u202e"), path, full=True)
    words = [text for row in texts_of(path) for text in row]
    assert len(words) > len(steps(trace))
    for text in words:
        assert legible(text) == text
    assert any("A_cam^T" in text.replace("\\", "") for text in words) and any("? ^T ?" in text for text in words)


def texts_of(path: Path) -> Iterator[list[str]]:
    """Everything that the viewer writes, with the names of its views."""
    reader = RrdReader(path)
    for entry in (*reader.recordings(), *reader.blueprints()):
        for chunk in reader.store(store=entry).stream().to_chunks():
            batch = chunk.to_record_batch()
            for name in batch.schema.names:
                if name.endswith((":text", ":labels", ":display_name", "RecordingInfo:name")):
                    yield from (row for row in batch.column(name).to_pylist() if row)


def test_letters_that_the_viewer_lacks_are_replaced() -> None:
    assert legible("θ ≤ 3°, R^T, naïve, Жук ±½ ‖x‖²") == "θ ≤ 3°, R^T, naïve, Жук ±½ ‖x‖²"
    assert legible("新\t\ud800\x00") == "????"


def test_layouts_are_shared(clique_run: Trace) -> None:
    pictures: list[Picture] = [paint(clique_run, index) for index in (0, 8)]
    panels = panels_of(clique_run)
    assert layout_file(shown_in(pictures, panels)) is layout_file(shown_in(list(pictures), panels))


@pytest.mark.parametrize("peak", [10.0, 90.0])
def test_a_legend_does_not_stand_before_the_peak(clique_run: Trace, peak: float) -> None:
    x = np.arange(100.0)
    curves = (
        Curve("arcs", x, np.exp(-np.abs(x - peak)), (1, 2, 3), "step"),
        Curve("truth", np.array([100.0 - peak]), np.array([2.0]), (1, 2, 3), "marker"),
    )
    chart = Chart("yaw", "Arcs", "yaw", "arcs", curves)
    picture = replace(paint(clique_run, 0), draw_charts=lambda: (chart,))
    assert shown_in([picture], panels_of(clique_run)).charts == (("yaw", "Arcs: arcs over yaw", peak > 50.0),)
