"""What a user does on the page, and what the page then says and shows."""

import re
from collections.abc import Callable
from pathlib import Path

import pytest
from playground import SCENE, Playground, served
from playwright.sync_api import Browser, expect

from spherloc.estimators import estimate
from spherloc_viz.app.catalog import Catalog
from spherloc_viz.layers import steps
from spherloc_viz.recording.reader import read_recording

EXACT, MC, RANSAC = "mc-exact (exact, certified)", "mc (the paper's)", "ransac-2p (two points)"

pytestmark = [pytest.mark.browser, pytest.mark.timeout(280)]


def test_page_shows_a_localization_and_talks_to_nobody_else(tab: Playground, address: str) -> None:
    expect(tab.page).to_have_title("spherloc")
    expect(tab.value("outcome")).to_have_text("success")
    expect(tab.value("inliers")).to_have_text(re.compile(r"^(1[89]|2[0-2]) of 40$"))
    expect(tab.page.get_by_text("maximum clique", exact=True)).to_be_visible()
    assert tab.instances("/map/points") == 40 and tab.instances("/sphere/bearings") == 40
    for name in ("/sphere/surface", "/rays", "/cameras/estimate", "/cameras/truth"):
        tab.until(lambda name=name: bool((tab.node(name) or {}).get("visible")), f"{name} is shown")
    assert tab.hosts == {address.removeprefix("http://")}
    assert tab.errors == []


def test_outlier_slider_changes_the_numbers(tab: Playground) -> None:
    before = tab.value("inliers").inner_text()
    assert before != "40 of 40"
    tab.thumb("Outliers (%)").focus()
    tab.page.keyboard.press("Home")
    expect(tab.thumb("Outliers (%)")).to_have_attribute("aria-valuenow", "0")
    expect(tab.value("inliers")).to_have_text(re.compile(r"^(39|40) of 40$"))
    expect(tab.value("outcome")).to_have_text("success")
    tab.page.keyboard.press("End")
    expect(tab.value("inliers")).to_have_text(re.compile(r"^\d of 40$"))
    expect(tab.value("outcome")).not_to_have_text("success")
    assert tab.errors == []


def test_dragging_ends_at_what_the_slider_shows(tab: Playground) -> None:
    """Many changes in a row: none is lost, none queues up, and the page ends with the run of the last one."""
    thumb = tab.thumb("Outliers (%)")
    start, track = thumb.bounding_box(), tab.widget("Outliers (%)").bounding_box()
    assert start is not None and track is not None
    tab.page.mouse.move(start["x"] + start["width"] / 2, start["y"] + start["height"] / 2)
    tab.page.mouse.down()
    for share in (0.4, 0.3, 0.2, 0.1, 0.0):
        tab.page.mouse.move(track["x"] + share * track["width"], start["y"], steps=4)
    tab.page.mouse.up()
    expect(thumb).to_have_attribute("aria-valuenow", "0")
    expect(tab.value("inliers")).to_have_text(re.compile(r"^(39|40) of 40$"))


def test_every_step_of_both_estimators(tab: Playground) -> None:
    """Next walks from the matches to the outcome; the clique is found in the scene and nowhere else."""
    for estimator, label in (("ransac-2p", RANSAC), ("mc", MC)):
        tab.choose("Estimator", label)
        expect(tab.value("estimator")).to_have_text(estimator)
        titles = walk(tab)
        assert titles[0] == "The matches" and titles[-1] == "Outcome"
        assert ("The maximum clique of balls" in titles) == (estimator == "mc")
        assert any(title.startswith("Sample ") for title in titles) == (estimator == "ransac-2p")
    assert tab.errors == []


def test_the_exact_estimator_says_what_is_proven_and_shows_its_steps(tab: Playground) -> None:
    tab.choose("Estimator", EXACT)
    expect(tab.value("estimator")).to_have_text("mc-exact")
    proven = re.compile(r"^Proven optimal: no pose explains more than (1[89]|2[0-2])$")
    expect(tab.value("certificate")).to_have_text(proven)
    expect(tab.value("expected false sets")).to_have_text(re.compile(r"e-\d+ of (1[89]|2[0-2]) matches$"))
    expect(tab.page.get_by_text(re.compile("; proven optimal: no pose explains more than"))).to_be_visible()
    titles = walk(tab)
    assert titles[2:5] == [
        "What no pose can beat, at each yaw",
        "The largest set that agrees",
        "The poses that were verified",
    ]
    for number, node in ((3, "/ring/bars"), (4, "/pairs/clique"), (5, "/cameras/estimate")):
        tab.choose("Step", f"{number}/{len(titles)}  {titles[number - 1]}")
        tab.until(lambda node=node: bool((tab.node(node) or {}).get("visible")), f"{node} is shown")
    for text in ("off the truth", "best pose", "first guess"):
        expect(tab.page.get_by_text(text, exact=True)).to_be_visible()
    assert tab.errors == []


def test_a_doubtful_run_is_diagnosed_and_a_good_one_is_not(tab: Playground) -> None:
    expect(tab.page.get_by_text("Diagnosing …")).to_have_count(0)
    expect(tab.page.get_by_text(re.compile("^Judged with"))).to_have_count(0)
    tab.thumb("Outliers (%)").focus()
    tab.page.keyboard.press("End")
    expect(tab.value("outcome")).not_to_have_text("success")
    expect(tab.page.get_by_text(re.compile("^Judged with"))).to_be_visible()
    tab.press("Previous")
    expect(tab.step).to_have_value(re.compile("Refinement"))
    tab.thumb("Outliers (%)").focus()
    tab.page.keyboard.press("Home")
    expect(tab.value("outcome")).to_have_text("success")
    expect(tab.page.get_by_text(re.compile("^Judged with"))).to_have_count(0)
    assert tab.errors == []


def test_gravity_can_be_off_and_the_estimator_told(tab: Playground) -> None:
    tab.thumb("Gravity error (deg)").focus()
    tab.page.keyboard.press("End")
    tab.page.get_by_text("Refinement", exact=True).click()
    tab.press("Previous")
    expect(tab.page.get_by_text(re.compile(r"which was trusted to 2° \(standard deviation\)"))).to_be_visible()
    tab.choose("Gravity sd (deg)", "unknown (6 DoF)")
    expect(tab.page.get_by_text(re.compile("from the given gravity, which was not used"))).to_be_visible()
    tab.choose("Gravity sd (deg)", "0: exact (4 DoF)")
    expect(tab.page.get_by_text("The given gravity is kept.")).to_be_visible()
    assert tab.errors == []


def walk(tab: Playground) -> list[str]:
    """Go to the first step and then Next to the last; returns the titles met."""
    count = rewind(tab)
    titles = [look(tab)]
    for number in range(2, count + 1):
        tab.press("Next")
        expect(tab.step).to_have_value(re.compile(rf"^{number}/{count} "))
        titles.append(look(tab))
    return titles


def rewind(tab: Playground) -> int:
    """Go to the first step; returns how many there are."""
    count = int(tab.step.input_value().split("/")[1].split()[0])
    for _ in range(count - 1):
        tab.press("Previous")
    expect(tab.step).to_have_value(re.compile(rf"^1/{count} "))
    return count


def look(tab: Playground) -> str:
    """Title of the step at hand, once its heading and the canvas agree with it."""
    title = tab.step.input_value().split(maxsplit=1)[1]
    expect(tab.page.locator("div").get_by_text(title, exact=True).first).to_be_visible()
    clique = title == "The maximum clique of balls"
    tab.until(lambda: (tab.instances("/balls/clique") > 2) == clique, f"clique drawn is {clique} at '{title}'")
    ring = title in ("Yaw arcs of all pairs", "The yaw most arcs share")
    tab.until(lambda: bool((tab.node("/ring/arcs") or {}).get("visible")) == ring, f"ring drawn is {ring} at '{title}'")
    return title


def test_captions_are_those_of_the_run(tab: Playground, tmp_path: Path) -> None:
    """What the page says is what the core computes for the same scene and seed."""
    (tmp_path / "small.toml").write_text(SCENE)
    catalog = Catalog(tmp_path / "small.toml")
    trace = estimate(catalog.scenes["small street"].problem(), "mc", seed=3)
    for step in reversed(steps(trace)[:-1]):
        tab.press("Previous")
        expect(tab.page.get_by_text(step.caption, exact=True)).to_be_visible()


def test_options_of_the_estimator_change_the_run(tab: Playground) -> None:
    tab.choose("Estimator", RANSAC)
    expect(tab.value("estimator")).to_have_text("ransac-2p")
    tab.entry("Iterations").fill("1")
    tab.entry("Iterations").press("Enter")
    expect(tab.page.get_by_text(re.compile(r"(no pose|failure|success)")).first).to_be_visible()
    tab.until(lambda: tab.step.input_value().split("/")[1].startswith(("4 ", "5 ", "3 ")), "one sample makes few steps")


def test_scene_and_camera_can_be_changed(tab: Playground) -> None:
    tab.choose("Scene", "MEI fisheye, 90 % outliers")
    expect(tab.value("inliers")).to_have_text(re.compile(r" of 100$"))
    expect(tab.thumb("Outliers (%)")).to_have_attribute("aria-valuenow", "90")
    tab.choose("Camera", "kannala brandt, 512 × 512")
    rewind(tab)
    tab.press("Next")
    expect(tab.page.get_by_text(re.compile("The kannala brandt camera turns each of its"))).to_be_visible()


def test_tabs_have_their_own_state(open_tab: Callable[[], Playground]) -> None:
    first, second = open_tab(), open_tab()
    untouched = second.value("inliers").inner_text(), second.value("rotation error").inner_text()
    first.choose("Estimator", RANSAC)
    first.thumb("Outliers (%)").focus()
    first.page.keyboard.press("Home")
    expect(first.value("inliers")).to_have_text(re.compile(r"^(39|40) of 40$"))
    second.press("Previous")
    expect(second.step).to_have_value(re.compile("Refinement"))
    assert first.step.input_value().endswith("Outcome")
    assert (second.value("inliers").inner_text(), second.value("rotation error").inner_text()) == untouched
    expect(second.value("estimator")).to_have_text("mc")


def test_a_wrong_seed_is_a_sentence_and_the_page_stays_usable(tab: Playground) -> None:
    seed = tab.entry("Seed")
    seed.fill("-7")
    seed.press("Enter")
    expect(tab.page.get_by_text(re.compile("seed '-7' is no whole number")).first).to_be_visible()
    expect(tab.value("outcome")).to_have_text("success")
    before = tab.value("rotation error").inner_text()
    seed.fill("8")
    seed.press("Enter")
    expect(tab.value("rotation error")).not_to_have_text(before)
    expect(tab.page.get_by_text(re.compile("seed '-7' is no whole number"))).to_have_count(0)


def test_layers_switch_off(tab: Playground) -> None:
    assert tab.instances("/map/points") == 40
    tab.page.get_by_text("Layers", exact=True).click()
    tab.widget("Map").uncheck()
    tab.until(lambda: tab.instances("/map/points") == 0, "the map is hidden")
    assert tab.instances("/sphere/bearings") == 40
    tab.widget("Map").check()
    tab.until(lambda: tab.instances("/map/points") == 40, "the map is back")


def test_a_settled_run_is_recorded(tab: Playground, recordings: Path) -> None:
    seed = tab.entry("Seed")
    seed.fill("4711")
    seed.press("Enter")
    said = tab.page.get_by_text(re.compile(r"Recorded as \S+_4711_\S+\.rrd"))
    expect(said).to_be_visible()
    path = recordings / said.inner_text().split()[-1]
    tab.until(path.is_file, "the recording is written")
    run = read_recording(path)
    assert run.problem.name == "small street" and "seed 4711" in str(run.properties["scene"])
    inliers = tab.value("inliers").inner_text()
    assert inliers == f"{int(run.inlier_mask.sum())} of {len(run.problem)}"


def test_hotkeys_step(tab: Playground) -> None:
    tab.page.mouse.click(600, 620)
    tab.page.keyboard.press("b")
    expect(tab.step).to_have_value(re.compile("Refinement"))
    tab.page.keyboard.press("n")
    expect(tab.step).to_have_value(re.compile("Outcome"))


def test_ctrl_c_ends_at_once_with_a_tab_open(browser: Browser, tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(SCENE)
    with served(tmp_path / "small.toml", "--no-record") as (address, server):
        tab = Playground(browser, address)
        expect(tab.page.get_by_text("Runs are not recorded.")).to_be_visible()
    assert server.returncode in (0, 130)
    tab.close()
