"""What a user does on the page, and what the page then says and shows."""

import re
from pathlib import Path

from playground import SCENE, SIZE, Playground
from playwright.sync_api import Browser, expect

from spherloc.estimators import estimate
from spherloc_viz.app.catalog import Catalog
from spherloc_viz.app.glossary import TERMS
from spherloc_viz.layers import paint, steps
from spherloc_viz.layers.primitives import Balls, Picture, Points, Segments, Step

EXACT, RANSAC = "mc-exact (exact, certified)", "ransac-2p (two points)"


def test_page_shows_a_localization_and_talks_to_nobody_else(tab: Playground, address: str) -> None:
    expect(tab.page).to_have_title("spherloc")
    expect(tab.value("outcome")).to_have_text("success")
    expect(tab.value("inliers")).to_have_text(re.compile(r"^(1[89]|2[0-2]) of 40$"))
    expect(tab.page.get_by_text("maximum clique", exact=True).first).to_be_visible()
    for name in ("/map/points", "/sphere/bearings"):
        tab.until(lambda name=name: tab.instances(name) == 40, f"{name} are drawn")
    for name in ("/sphere/surface", "/rays", "/cameras/estimate", "/cameras/truth"):
        tab.until(lambda name=name: bool((tab.node(name) or {}).get("visible")), f"{name} is shown")
    expect(tab.page.get_by_text("Diagnosing …")).to_have_count(0)
    expect(tab.page.get_by_text(re.compile("^Judged with"))).to_have_count(0)

    # What a control says stands beside its panel, and viser's own settings are not offered.
    expect(tab.page.locator(".tabler-icon-adjustments")).not_to_be_visible()
    tab.thumb("Noise (px)").hover()
    hint, label = tab.page.get_by_role("tooltip"), tab.page.locator("label", has_text="Noise (px)")
    expect(hint).to_be_visible()
    told, panel = hint.bounding_box(), label.bounding_box()
    assert told is not None and panel is not None and told["x"] + told["width"] < panel["x"]

    # The numbers follow the slider; a doubtful run is diagnosed and a good one is not.
    tab.slide("Outliers (%)", "End")
    expect(tab.value("inliers")).to_have_text(re.compile(r"^\d of 40$"))
    expect(tab.value("outcome")).not_to_have_text("success")
    expect(tab.page.get_by_text(re.compile("^Judged with"))).to_be_visible()
    tab.press("Previous")
    expect(tab.step).to_have_value(re.compile("Refinement"))
    box = tab.entry("Outliers (%)")
    box.press("ControlOrMeta+a")
    tab.page.keyboard.type("-5")
    box.press("Enter")
    expect(tab.page.get_by_text("The least is 0.")).to_be_visible()
    expect(tab.thumb("Outliers (%)")).to_have_attribute("aria-valuenow", "0")
    expect(tab.value("inliers")).to_have_text(re.compile(r"^(39|40) of 40$"))
    expect(tab.value("outcome")).to_have_text("success")
    expect(tab.page.get_by_text(re.compile("^Judged with"))).to_have_count(0)
    tab.expect_quiet(address)


def drawn_by(picture: Picture) -> dict[str, int]:
    """How many dots, lines and balls the canvas must show, with all layers on."""
    kinds = {Points: "positions", Segments: "points", Balls: "centers"}
    counts = {item.name: len(getattr(item, kinds[type(item)])) for item in picture.scene if type(item) in kinds}
    return {name: count for name, count in counts.items() if count}


def expect_step(tab: Playground, step: Step, picture: Picture, number: int, count: int) -> None:
    """The page says and draws what the core computes for this step."""
    expect(tab.step).to_have_value(f"{number}/{count}  {step.title}")
    # It may have been put back to the step before while a key was on its way, and the next key goes on from there.
    expect(tab.thumb("Timeline")).to_have_attribute("aria-valuenow", str(number))
    expect(tab.page.locator("div").get_by_text(step.title, exact=True).locator("visible=true").first).to_be_visible()
    # How long a run took is in the last caption, and differs.
    if number < count:
        expect(tab.page.get_by_text(step.caption, exact=True)).to_be_visible()
    tab.until(lambda: tab.drawn() == drawn_by(picture), f"the canvas shows {step.title}: {drawn_by(picture)}")


def test_steps_say_and_draw_what_the_core_computes(tab: Playground, tmp_path: Path, address: str) -> None:
    (tmp_path / "small.toml").write_text(SCENE)
    trace = estimate(Catalog(tmp_path / "small.toml").scenes["small street"].problem(), "mc", seed=3)
    count = len(steps(trace))
    tab.slide("Timeline", "Home")
    for number in range(1, count + 1):
        checked = number % 8 == 1 or number == count
        if checked:
            picture = paint(trace, number - 1)
            expect_step(tab, picture.step, picture, number, count)
        # A click waits for frames, and a key does not.
        if checked and number < count:
            tab.press("Next")
            expect(tab.thumb("Timeline")).to_have_attribute("aria-valuenow", str(number + 1))
        else:
            tab.slide("Timeline", "ArrowRight")
    the_exact_estimator_says_what_is_proven_and_options_change_a_run(tab)
    tab.expect_quiet(address)


def the_exact_estimator_says_what_is_proven_and_options_change_a_run(tab: Playground) -> None:
    tab.choose("Estimator", EXACT)
    expect(tab.value("estimator")).to_have_text("mc-exact")
    proven = re.compile(r"^Proven optimal: no pose explains more than (1[89]|2[0-2])$")
    expect(tab.value("certificate")).to_have_text(proven)
    expect(tab.value("NFA")).to_have_text(re.compile(r"e-\d+ sets of (1[89]|2[0-2]) matches expected"))
    expect(tab.page.get_by_text(re.compile("; proven optimal: no pose explains more than"))).to_be_visible()
    shown = {
        "What no pose can beat, at each yaw": "ring/bound",
        "The largest set that agrees": "pairs/clique",
        "The poses that were verified": "cameras/estimate",
    }
    for title, node in shown.items():
        tab.step.click()
        tab.page.get_by_role("option").filter(has_text=title).click()
        expect(tab.step).to_have_value(re.compile(title))
        tab.until(lambda node=node: node in tab.drawn(), f"{node} is shown")
    for text in ("explains", "off the truth"):
        expect(tab.page.locator("td").get_by_text(text, exact=True)).to_be_visible()

    tab.choose("Estimator", RANSAC)
    expect(tab.value("estimator")).to_have_text("ransac-2p")
    tab.until(lambda: tab.step_count() > 15, "a thousand samples make more")
    tab.type("Iterations", "1")
    expect(tab.page.get_by_text(re.compile(r"(no pose|failure|success)")).first).to_be_visible()
    tab.until(lambda: tab.step_count() < 15, "one sample makes few steps")


def test_gravity_can_be_off_and_scene_and_camera_be_changed(tab: Playground) -> None:
    tab.unfold("More of the scene")
    tab.thumb("Gravity error (deg)").focus()
    tab.page.keyboard.press("End")
    expect(tab.page.get_by_text("Changed from the scene: ")).to_be_visible()  # above the folder, which moves down
    tab.unfold("Refinement")
    tab.press("Previous")
    expect(tab.page.get_by_text(re.compile(r"which was trusted to 3° \(standard deviation\)"))).to_be_visible()
    tab.choose("Gravity sd (deg)", "unknown (6 DoF)")
    expect(tab.page.get_by_text(re.compile("from the given gravity, which was not used"))).to_be_visible()
    tab.choose("Gravity sd (deg)", "0: exact (4 DoF)")
    expect(tab.page.get_by_text("The given gravity is kept.")).to_be_visible()

    tab.choose("Scene", "MEI fisheye, 90 % outliers")
    expect(tab.value("inliers")).to_have_text(re.compile(r" of 100$"))
    expect(tab.thumb("Outliers (%)")).to_have_attribute("aria-valuenow", "90")
    tab.choose("Camera", "Kannala-Brandt, 512 × 512")
    tab.slide("Timeline", "Home")
    expect(tab.step).to_have_value(re.compile("^1/"))
    tab.press("Next")
    expect(tab.page.get_by_text(re.compile("The Kannala-Brandt camera turns each of its"))).to_be_visible()
    assert tab.errors == []


HASTE = """(() => {
    const looks = [], given = window.setInterval;
    window.setInterval = (look, ms) => (looks.push(look), given(look, ms));
    addEventListener("resize", () => looks.forEach((look) => look()), true);
})()"""
"""Has the page look at itself as soon as the window gets another size, before its panels have followed."""


def test_the_introduction_is_shown_once_and_can_be_skipped(browser: Browser, address: str) -> None:
    tab = Playground(browser, address, new=True)
    card = tab.page.get_by_role("dialog", name="Introduction")
    expect(card).to_be_visible()
    expect(card).to_contain_text("Pixels become directions")
    expect(tab.step).to_have_value(re.compile("Bearings on the unit sphere"))
    card.get_by_role("button", name="Continue").click()
    expect(tab.step).to_have_value(re.compile("The yaw most arcs share"))
    card.get_by_role("button", name="Continue").click()
    expect(tab.step).to_have_value(re.compile("The maximum clique of balls"))
    card.get_by_role("button", name="Back").click()
    expect(tab.step).to_have_value(re.compile("The yaw most arcs share"))
    tab.page.keyboard.press("ArrowRight")
    expect(card).to_contain_text("3 of 4")
    tab.page.keyboard.press("b")
    expect(card).to_contain_text("2 of 4")
    tab.page.keyboard.press("n")
    expect(card).to_contain_text("3 of 4")
    card.get_by_role("button", name="Skip").click()
    expect(card).to_have_count(0)
    expect(tab.step).to_have_value(re.compile("The yaw most arcs share"))

    expect(tab.page).to_have_url(re.compile("step=yaw-clique"))  # it follows when the page rests
    tab.page.add_init_script(HASTE)
    tab.page.reload()
    expect(tab.value("outcome")).not_to_be_empty()
    tab.page.wait_for_function("() => document.querySelector('[data-introduction]') !== null")
    tab.still(lambda: card.count(), "nothing more comes")
    expect(card).to_have_count(0)

    term = tab.page.locator(".term", has_text=re.compile("^maximum clique$")).first
    window = tab.page.get_by_role("dialog", name="What the words mean")
    before = tab.step.input_value()
    for close in (
        lambda: window.get_by_role("button", name="Close").click(),
        lambda: tab.page.keyboard.press("Escape"),
        lambda: tab.page.mouse.click(5, 5),
    ):
        term.click()
        words = window.locator("p")
        expect(words.first).to_contain_text("maximum clique: The largest clique there is.")
        assert words.count() == len(TERMS) == len(set(words.all_text_contents()))
        tab.page.keyboard.press("n")
        close()
        expect(window).to_have_count(0)
    assert tab.step.input_value() == before
    tab.page.get_by_role("button", name="What is estimator?").first.press("Enter")
    expect(window.locator("p").first).to_contain_text("estimator: ")
    window.get_by_role("button", name="Show the introduction again").click()
    expect(window).to_have_count(0)
    expect(card).to_contain_text("1 of 4")
    tab.page.set_viewport_size({"width": 390, "height": 844})
    canvas = tab.page.locator("canvas").first

    def shares_a_phone() -> bool:
        """The canvas takes what is above the card."""
        above, below = canvas.bounding_box(), card.bounding_box()
        return bool(above and below) and 0 <= below["y"] - above["y"] - above["height"] < 40 and above["height"] > 420

    tab.until(shares_a_phone, "the canvas of a phone ends above the card")
    tab.page.set_viewport_size(SIZE)  # pyright: ignore[reportArgumentType]
    for number in ("2 of 4", "3 of 4", "4 of 4"):
        card.get_by_role("button", name="Continue").click()
        expect(card).to_contain_text(number)
    expect(tab.step).to_have_value(re.compile("Outcome"))
    tab.press("Previous")  # whoever goes on with the page needs the last card no more
    expect(card).to_have_count(0)
    expect(tab.step).to_have_value(re.compile("Refinement"))
    tab.expect_quiet(address)
    tab.close()
