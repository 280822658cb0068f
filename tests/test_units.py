"""A map whose scale is unknown: no length of it is told in metres, whoever tells it."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from spherloc.datasets import bundled_scenes, load_scene
from spherloc.datasets.map_scene import MapScene
from spherloc.diagnosis import diagnose
from spherloc.errors import InputError, ProblemError
from spherloc.estimators import estimate, options_type
from spherloc.experiments.configuration import configuration_of, read_configuration
from spherloc.outcome import judge
from spherloc_viz.app.text import summary_html
from spherloc_viz.commands.run import as_text
from spherloc_viz.layers import paint, steps
from spherloc_viz.layers.comparison import Entry, comparison_table
from spherloc_viz.layers.explanation import explain
from spherloc_viz.layers.outcome import outcome_table
from spherloc_viz.layers.primitives import Label
from spherloc_viz.recording.content.data import read_recording
from spherloc_viz.recording.origin import Origin
from spherloc_viz.recording.storage.store import RecordingStore

Options = options_type("mc")
METRES = re.compile(r"\d\)? ?(km|m|cm|mm)\b(?!s)")
"""A number with a unit of length."""


@pytest.mark.parametrize("estimator", ["mc", "mc-exact", "ransac-2p", "ransac-svd"])
@pytest.mark.parametrize("outlier_rate", [0.5, 0.97])
def test_nothing_on_the_page_is_in_metres(estimator, outlier_rate, scene_of):
    scene = replace(scene_of("mei"), outlier_rate=outlier_rate)
    trace = estimate(replace(scene.problem(1), metric=False), estimator)
    told = [summary_html(trace), as_text(Path("s.toml"), trace, diagnose(trace), None), str(judge(trace).reasons)]
    told += [str(diagnose(trace)), str(outcome_table(trace)), str(comparison_table([Entry(trace)]))]
    for number in range(len(steps(trace))):
        picture = paint(trace, number)
        told += [picture.step.caption, picture.step.note, str(picture.tables)]
        told += [item.text for item in picture.scene if isinstance(item, Label)]
    told += [str(explain(trace, number)) for number in range(0, 100, 7)]
    found = [match.group(0) for text in told for match in [METRES.search(text)] if match]
    assert found == []
    assert any("units" in text for text in told)


def scene_with(tmp_path: Path, units: str) -> MapScene:
    path = tmp_path / "scene.toml"
    path.write_text(units + "\n" + bundled_scenes()["street_fisheye"].read_text())
    scene = load_scene(path)
    assert isinstance(scene, MapScene)
    return scene


def test_a_scene_file_says_that_units_are_unknown(tmp_path: Path) -> None:
    assert not scene_with(tmp_path, 'units = "unknown"').metric
    assert scene_with(tmp_path, 'units = "metres"').metric
    with pytest.raises(InputError, match=r"units is 'feet'; give one of metres, unknown\."):
        scene_with(tmp_path, 'units = "feet"')


def test_units_go_with_the_problem_and_into_the_table_of_a_sequence(tmp_path: Path, scene_of) -> None:
    scene = load_scene(bundled_scenes()["street_fisheye"])
    assert isinstance(scene, MapScene)
    assert not replace(scene, metric=False).problem().metric
    setting = configuration_of(replace(scene, metric=False), bundled_scenes()["street_fisheye"], "mc", Options(), 0)
    (tmp_path / "configuration.json").write_text(setting.json_text())
    read = read_configuration(tmp_path / "configuration.json")
    assert (read.metric, read.unit, read.length(0.0314)) == (False, "units", "0.0314 units")
    assert replace(read, metric=True).length(0.0314) == "3.14 cm"
    old = json.loads(setting.json_text())
    del old["metric"]
    (tmp_path / "configuration.json").write_text(json.dumps(old))
    assert read_configuration(tmp_path / "configuration.json").metric


def test_a_recording_keeps_them(tmp_path: Path, scene_of) -> None:
    trace = estimate(replace(scene_of("mei").problem(), metric=False), "mc")
    with RecordingStore(tmp_path, print) as store:
        path = store.record(trace, Origin("command", None, 0, None))
    assert not read_recording(path).problem.metric


def test_metric_is_true_or_false(scene_of) -> None:
    with pytest.raises(ProblemError, match=r"metric is 1; give true or false\."):
        replace(scene_of("mei").problem(), metric=1)


@pytest.mark.parametrize(("outlier_rate", "verdict"), [(0.5, "Localized"), (0.99, "Doubtful")])
def test_without_the_truth_the_headline_is_what_the_run_is_judged_as(scene_of, outlier_rate, verdict):
    problem = replace(scene_of("mei"), outlier_rate=outlier_rate).problem(1)
    trace = estimate(replace(problem, truth_cam_from_map=None, truth_inliers=None), "mc")
    assert "Pose found, truth unknown" in summary_html(trace)
    judge(trace)
    assert f">{verdict}</b>" in summary_html(trace) and "truth unknown" in summary_html(trace)
    assert paint(trace, len(steps(trace)) - 1).step.equation == "", "limits that nothing is compared with"
