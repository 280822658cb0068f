"""A recorded run opened again: its live scene where that is still the same, else the recorded problem, and why."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from recording_samples import scene_problem

from spherloc.datasets import load_scene
from spherloc.datasets.variation import Variation
from spherloc.errors import RecordingError
from spherloc.estimators import estimate, options_type
from spherloc.trace import Trace
from spherloc_viz.app.catalog import Catalog, SceneRequest
from spherloc_viz.recording.content.data import read_recording
from spherloc_viz.recording.content.writer import write_recording
from spherloc_viz.recording.origin import Origin
from spherloc_viz.recording.recorded_run import RecordedRun
from spherloc_viz.recording.replay import RecordedScene, Reopened, compare, reopen
from tests.datasets.test_rendered import SMALL

ROOT = Path(__file__).resolve().parents[1]
SCENES = ROOT / "scenes"
MEI = SCENES / "mei_outliers_80.toml"
EDITED = Variation(
    camera=str(SCENES / "fisheye_outliers_90.toml"), noise_px=0.1 + 0.2, spoiled=(3,), mended=(7,), hidden=(1, 2)
)


def record(folder: Path, origin: Origin | None, variation: Variation = EDITED, seed: int = 9) -> tuple[Path, Trace]:
    options = options_type("ransac-2p")(iterations=60, gravity_sd_deg=float("inf"))
    trace = estimate(variation.problem(load_scene(MEI), seed), "ransac-2p", options, seed)
    path = folder / "run.rrd"
    write_recording(trace, path, origin)
    return path, trace


def solved(opened: Reopened) -> Trace:
    """As a page would."""
    catalog = Catalog(None)
    label = catalog.add(opened.scene, opened.path, opened.label)
    problem = catalog.problem(SceneRequest(label, opened.seed, opened.query, opened.variation))
    return estimate(problem, opened.estimator, opened.options, opened.seed)


def test_an_unchanged_scene_is_opened_live_with_every_change(tmp_path: Path) -> None:
    path, _ = record(tmp_path, Origin("page", str(MEI), 9, None, EDITED))
    run = read_recording(path)
    opened = reopen(run, path, [tmp_path, SCENES])
    assert opened.live and opened.sentence == "" and opened.path == MEI and opened.label == load_scene(MEI).name
    assert (opened.seed, opened.query, opened.variation, opened.estimator) == (9, None, EDITED, "ransac-2p")
    assert opened.options == options_type("ransac-2p")(iterations=60, gravity_sd_deg=float("inf"))
    assert compare(run, solved(opened)) == []


def test_the_scenes_own_seed_is_the_one_that_was_used(tmp_path: Path) -> None:
    path, _ = record(tmp_path, Origin("gallery", str(MEI)), Variation(), seed=0)
    assert reopen(read_recording(path), path, [SCENES]).live


@pytest.mark.parametrize(
    ("origin", "said"),
    [
        (None, "The recording does not say which scene file it came from"),
        ({"scene_path": None}, "The recording does not say which scene file it came from"),
        ({"scene_path": str(SCENES / "run.rrd")}, "The run was of the problem of another recording"),
        ({"scene_seed": 8}, "was drawn with the seed 8 and solved with 9"),
        ({"scene_path": "/etc/passwd"}, "passwd lies outside the folders that pages may open scenes from"),
        ({"scene_path": str(SCENES / ".." / "pyproject.toml")}, "pyproject.toml lies outside"),
        ({"scene_path": str(SCENES / "gone.toml")}, "gone.toml is no longer there"),
        ({"scene_path": str(SCENES)}, "scenes is no longer there"),
        ({"scene_path": "a\0b"}, "is not a path"),
        ({"variation": replace(EDITED, camera="/etc/passwd")}, "passwd lies outside"),
        ({"variation": replace(EDITED, noise_px=0.31)}, "gives another problem by now (pixels)"),
        ({"variation": replace(EDITED, hidden=(1,))}, "gives another problem by now (pixels, points"),
        ({"variation": replace(EDITED, hidden=(1, 500))}, "cannot be opened as it was (there is no match 500"),
        ({"variation": replace(EDITED, camera=None)}, "gives another problem by now (camera, "),
        ({"scene_path": str(SCENES / "street_fisheye.toml")}, "cannot be opened as it was ("),
        ({"query": "a.jpg"}, "has no query images to choose from"),
    ],
)
def test_else_the_recorded_problem_is_and_it_says_why(tmp_path: Path, origin: dict[str, Any] | None, said: str) -> None:
    path, trace = record(tmp_path, Origin("page", str(MEI), 9, None, EDITED))
    run = read_recording(path)
    assert run.origin is not None
    run = replace(run, origin=None if origin is None else replace(run.origin, **origin))
    opened = reopen(run, path, [SCENES])
    assert not opened.live and said in opened.sentence
    assert opened.sentence.endswith(", so the recorded problem is opened instead.") and "\n" not in opened.sentence
    assert isinstance(opened.scene, RecordedScene) and opened.path == path
    assert opened.label == f"{trace.problem.name} (recorded)"
    assert opened.variation == Variation() and opened.query is None and opened.seed == 9
    assert compare(run, solved(opened)) == []


def test_links_count_as_what_they_point_to(tmp_path: Path) -> None:
    inside, outside = tmp_path / "inside", tmp_path / "outside"
    inside.mkdir()
    outside.mkdir()
    (outside / "mei.toml").write_bytes(MEI.read_bytes())
    (inside / "link.toml").symlink_to(outside / "mei.toml")
    (inside / "loop.toml").symlink_to(inside / "loop.toml")
    path, _ = record(tmp_path, Origin("page", str(inside / "link.toml"), 9, None, EDITED))
    run = read_recording(path)
    assert "lies outside" in reopen(run, path, [inside, SCENES]).sentence
    assert reopen(run, path, [outside, SCENES]).live
    assert run.origin is not None
    looped = replace(run, origin=replace(run.origin, scene_path=str(inside / "loop.toml")))
    assert not reopen(looped, path, [inside, SCENES]).live


def test_a_scene_of_images_is_opened_with_its_query(tmp_path: Path) -> None:
    path = tmp_path / "street.toml"
    path.write_text(SMALL)
    scene = load_scene(path)
    query = scene.queries[-1].name  # type: ignore[attr-defined]
    variation = Variation(hidden=(0,))
    trace = estimate(variation.problem(scene, 3, query), "mc", None, 3)
    write_recording(trace, tmp_path / "run.rrd", Origin("sequence", str(path), 3, query, variation))
    run = read_recording(tmp_path / "run.rrd")
    opened = reopen(run, tmp_path / "run.rrd", [tmp_path])
    assert opened.live and opened.query == query and compare(run, solved(opened)) == []
    assert run.origin is not None
    gone = replace(run, origin=replace(run.origin, query="gone"))
    assert "no query image 'gone'" in reopen(gone, tmp_path / "run.rrd", [tmp_path]).sentence


def test_what_this_spherloc_cannot_solve_is_an_error(tmp_path: Path) -> None:
    trace = estimate(scene_problem("mei_outliers_80"), "mc")
    write_recording(trace, tmp_path / "run.rrd")
    run: RecordedRun = read_recording(tmp_path / "run.rrd")
    with pytest.raises(RecordingError, match="unknown estimator 'gone'"):
        reopen(replace(run, estimator="gone"), tmp_path / "run.rrd", [SCENES])
    with pytest.raises(RecordingError, match="has no option 'magic' here"):
        reopen(replace(run, options={"magic": 1}), tmp_path / "run.rrd", [SCENES])
