"""Presets show what they say; what is copied from the page repeats its run to the last bit; undo finds the way back."""

import ast
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from playground import Playground
from playwright.sync_api import expect

from spherloc.estimators import estimate
from spherloc_viz.app.catalog import Catalog
from spherloc_viz.app.controls.presets import RECIPES, presets
from spherloc_viz.layers.outcome import outcome_table
from spherloc_viz.recording.content.data import read_recording
from spherloc_viz.recording.recorded_run import RecordedRun
from tests.waiting import LIMIT_S

OUTCOMES = {
    "A quiet start": "success",
    "Paper Fig. 6 at 90 %": "success",
    "RANSAC bad luck": "failure",
    "Coherent outliers": "failure",
    "Repeated facades": "failure",
    "Horizontal bearings": "failure",
    "Tilted car": "failure",
}
"""What the story of each preset promises."""


def go_to(tab: Playground, name: str) -> None:
    tab.page.get_by_role("tab", name=name, exact=True).click()


def wait_for_another_recording(tab: Playground, before: Path | None, folder: Path) -> Path:
    """Wait until the page has settled on a run that is recorded in another file; returns that file."""
    said = tab.page.get_by_text(re.compile(r"^Recorded as \S+\.rrd$"))
    found: list[Path] = []

    def is_another() -> bool:
        texts = said.all_inner_texts()
        found[:] = [folder / text.split()[-1] for text in texts]
        return bool(found) and found[0] != before and found[0].is_file()

    tab.until(is_another, "another run is recorded")
    return found[0]


def every_preset_shows_what_its_story_says(tab: Playground) -> None:
    catalog = Catalog(None)
    offered = {preset.title: preset for preset in presets(catalog)}
    assert list(offered) == list(OUTCOMES) == [recipe.title for recipe in RECIPES]
    for title, preset in offered.items():
        tab.choose("Preset", title)
        expect(tab.page.get_by_text(f"{preset.story} Estimator: {preset.estimator}.", exact=True)).to_be_visible()
        expect(tab.value("estimator")).to_have_text(preset.estimator)
        expect(tab.value("outcome")).to_have_text(OUTCOMES[title])
        trace = estimate(catalog.problem(preset.scene), preset.estimator, preset.options, preset.scene.seed)
        shown = dict(outcome_table(trace).rows)
        for name in ("inliers", "rotation error", "position error"):
            expect(tab.value(name)).to_have_text(shown[name])
        expect(tab.widget("Preset")).to_have_value(title)


def test_presets_end_where_a_hand_changes_them_and_show_what_their_stories_say(tab: Playground) -> None:
    def shows(preset: str, estimator: str, seed: str) -> None:
        expect(tab.value("estimator")).to_have_text(estimator)
        expect(tab.widget("Preset")).to_have_value(preset)
        expect(tab.entry("Seed")).to_have_value(seed)

    start = tab.value("rotation error").inner_text()
    tab.choose("Preset", "Horizontal bearings")
    shows("Horizontal bearings", "mc", "0")
    expect(tab.value("outcome")).to_have_text("failure")
    story = tab.page.get_by_text(re.compile("^All points are as high as the camera"))
    expect(story).to_be_visible()
    below = tab.widget("Scene").bounding_box()
    tab.choose("Estimator", "mc-exact (exact, certified)")
    shows("choose …", "mc-exact", "0")
    expect(tab.value("outcome")).to_have_text("success")
    expect(story).to_have_count(0)
    changed = tab.page.get_by_text(re.compile("^Changed from the preset Horizontal bearings: All points"))
    expect(changed).to_be_visible()
    assert tab.widget("Scene").bounding_box() == below, "what is below the story stays where it is"
    exact = tab.value("rotation error").inner_text()
    tab.press("New seed")
    shows("choose …", "mc-exact", "1")
    expect(tab.value("rotation error")).not_to_have_text(exact)
    tab.unfold("More of the scene")
    expect(tab.thumb("Height (m)")).to_have_attribute("aria-valuenow", "0.1")
    tab.press("Reset to the scene")
    expect(tab.thumb("Height (m)")).to_have_attribute("aria-valuenow", "10")
    shows("choose …", "mc-exact", "0")

    tab.press("Undo")
    expect(tab.thumb("Height (m)")).to_have_attribute("aria-valuenow", "0.1")
    shows("choose …", "mc-exact", "1")
    tab.press("Undo")
    shows("choose …", "mc-exact", "0")
    expect(tab.value("rotation error")).to_have_text(exact)
    tab.press("Undo")
    shows("Horizontal bearings", "mc", "0")
    expect(story).to_be_visible()
    tab.press("Undo")
    shows("choose …", "mc", "3")
    expect(tab.value("rotation error")).to_have_text(start)
    tab.press("Undo")
    tab.press("Redo")
    shows("Horizontal bearings", "mc", "0")
    expect(tab.value("outcome")).to_have_text("failure")
    every_preset_shows_what_its_story_says(tab)
    assert tab.errors == []


@pytest.fixture
def sharing_tab(open_tab: Callable[[], Playground]) -> Playground:
    """A tab whose clipboard the test may read."""
    tab = open_tab()
    tab.page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    return tab


def copied(tab: Playground, what: str) -> str:
    """Press "copy" beside a piece of code; returns what is on the clipboard then."""
    tab.page.evaluate("navigator.clipboard.writeText('nothing')")
    tab.page.get_by_role("button", name=f"Copy as {what}").click()
    clipboard = "navigator.clipboard.readText()"
    tab.until(lambda: tab.page.evaluate(clipboard) != "nothing", f"the {what} is copied")
    return tab.page.evaluate(clipboard)


def repeated(python: str, command: str, folder: Path) -> tuple[np.ndarray, RecordedRun]:
    """Run both where the server runs: the pose that the script prints, and the run that the command records."""
    (folder / "copied.py").write_text(python)
    programs = Path(sys.executable).parent
    environment = os.environ | {"PATH": f"{programs}{os.pathsep}{os.environ['PATH']}"}
    one = subprocess.Popen(
        [sys.executable, folder / "copied.py"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    other = subprocess.run(
        ["bash", "-c", f"{command} --recordings '{folder}'"],
        env=environment,
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
    )
    said, complaint = one.communicate(timeout=LIMIT_S)
    assert one.returncode == 0, complaint
    assert other.returncode == 0, other.stderr
    (recording,) = folder.glob("*.rrd")
    return np.array(ast.literal_eval(said.splitlines()[-1])), read_recording(recording)


def check_repeats(tab: Playground, run: RecordedRun, folder: Path) -> str:
    """What the page copies repeats this run to the last bit; returns the command."""
    folder.mkdir()
    go_to(tab, "Share")
    python, command = copied(tab, "Python"), copied(tab, "Command")
    pose, again = repeated(python, command, folder)
    assert run.cam_from_map is not None and again.cam_from_map is not None
    assert pose.tobytes() == run.cam_from_map.tobytes(), python
    assert again.cam_from_map.tobytes() == run.cam_from_map.tobytes(), command
    assert (again.estimator, again.options, again.seed) == (run.estimator, run.options, run.seed)
    assert again.problem.pixels.tobytes() == run.problem.pixels.tobytes()
    go_to(tab, "Play")
    return command


def test_what_is_copied_repeats_the_run_to_the_last_bit(
    sharing_tab: Playground, recordings: Path, tmp_path: Path
) -> None:
    tab = sharing_tab
    path = wait_for_another_recording(tab, None, recordings)
    # Of 40 matches 49 % are as many as 50 %: the same problem, whose run is not recorded twice.
    for label, key, times in (("Outliers (%)", "ArrowLeft", 3), ("Noise (px)", "ArrowRight", 1)):
        tab.thumb(label).focus()
        for _ in range(times):
            tab.page.keyboard.press(key)
        path = wait_for_another_recording(tab, path, recordings)
    run = read_recording(path)
    assert tab.value("inliers").inner_text() == f"{int(run.inlier_mask.sum())} of 40"

    tab.choose("Estimator", "ransac-2p (two points)")
    expect(tab.value("estimator")).to_have_text("ransac-2p")
    tab.entry("Iterations").fill("321")
    tab.entry("Iterations").press("Enter")
    tab.choose("Confidence", "0.9")
    tab.unfold("More of the scene")
    tab.choose("Camera", "Kannala-Brandt, 512 × 512")
    go_to(tab, "Matches")
    inlier, hidden = np.flatnonzero(run.inlier_mask)[:2].tolist()
    outlier = int(np.flatnonzero(~run.inlier_mask)[0])
    for action, number in (("Make wrong", inlier), ("Make right", outlier), ("Hide", hidden)):
        tab.page.locator(f"tr[data-touch='select:{number}']").click()
        expect(tab.page.get_by_text(f"Match {number}", exact=True)).to_be_visible()
        tab.press(action)
    expect(tab.page.get_by_text(re.compile("^Matches by hand: 1 made wrong, 1 made right, 1 hidden"))).to_be_visible()
    expect(tab.value("inliers")).to_have_text(re.compile(" of 39$"))
    asked = {"iterations": 321, "confidence": 0.9}
    while not (asked.items() <= run.options.items() and len(run.problem) == 39):
        path = wait_for_another_recording(tab, path, recordings)
        run = read_recording(path)
    command = check_repeats(tab, run, tmp_path / "by hand")
    assert "outlier_rate=0.47" in command and "noise_px=1.1" in command
    assert f"--spoil {inlier} --mend {outlier} --hide {hidden}" in command and "iterations=321" in command
    assert tab.errors == []
