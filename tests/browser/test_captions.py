"""A step with few words: in large type for a lecture, and below the canvas of a phone."""

import re

import numpy as np
from playground import SIZE, Playground
from playwright.sync_api import Browser, expect

TYPE_PX = "one => parseFloat(getComputedStyle(one).fontSize)"
PART = "[style*='min-height: 50px']"
HEIGHT_PX = f"() => document.querySelector('[data-view]').closest(\"{PART}\").getBoundingClientRect().height"
WIDTH_PX = "() => document.querySelector('[data-view]').closest(\"[style*='left: 0px']\").getBoundingClientRect().width"


def test_the_projector_view_says_each_step_in_large_type(browser: Browser, address: str) -> None:
    tab = Playground(browser, address)
    captions = tab.page.get_by_role("region", name="What the step says")
    expect(captions).to_have_count(0)
    before = tab.page.evaluate(WIDTH_PX)
    tab.page.locator(".projector-toggle").click()
    expect(captions).to_contain_text("Outcome")
    assert captions.locator(".step-title").evaluate(TYPE_PX) > captions.evaluate(TYPE_PX) >= 28.0
    tab.until(lambda: tab.page.evaluate(WIDTH_PX) > before, "the view beside the canvas is wide")
    tab.until(lambda: tab.page.evaluate(HEIGHT_PX) > 0.9 * SIZE["height"], "and has its column for itself")
    expect(tab.page.get_by_role("tab", name="Play", exact=True)).to_have_count(0)

    captions.get_by_role("button", name="Previous step").click()
    expect(captions).not_to_contain_text("Outcome")
    expect(tab.page.get_by_text("Residuals at the estimated pose")).to_be_visible()
    tab.page.keyboard.press("n")
    expect(captions).to_contain_text("Outcome")
    count = tab.page.evaluate("() => document.querySelector('[data-place]').dataset.place.split('/')[1]")
    expect(captions.locator(".row")).to_contain_text(f"{count}/{count}")
    box, room = captions.bounding_box(), tab.page.viewport_size
    assert box is not None and room is not None and box["y"] > 0 and box["y"] + box["height"] <= room["height"] + 1

    # What is said of a failure is said there too.
    tab.page.keyboard.press("l")
    expect(captions).to_have_count(0)
    expect(tab.page.get_by_role("tab", name="Play", exact=True)).to_be_visible()
    tab.until(lambda: tab.page.evaluate("document.activeElement === document.body"), "no frame of a focus stays")
    tab.slide("Outliers (%)", "End")
    expect(tab.page.get_by_text(re.compile("^Judged with"))).to_be_visible()
    tab.page.keyboard.press("l")
    cause = str(tab.page.locator(".diagnosis-words > div").first.inner_text())
    expect(captions).to_contain_text(cause)
    tab.page.keyboard.press("l")
    expect(captions).to_have_count(0)
    # The key is known also where a box was ticked last.
    tab.widget("Dark").focus()
    tab.page.keyboard.press("l")
    expect(captions).to_contain_text("Outcome")
    tab.page.mouse.click(*tab.lonely_dots()[0][1:])
    expect(tab.page.locator(".match-words").first).to_be_visible()
    tab.page.keyboard.press("Escape")
    expect(tab.page.locator(".match-words")).to_have_count(0)
    expect(captions).to_have_count(1)
    tab.page.keyboard.press("Escape")
    expect(captions).to_have_count(0)
    tab.until(lambda: abs(tab.page.evaluate(WIDTH_PX) - before) < 2, "the view beside the canvas is as it was")

    # A class predicts, and then sees.
    tab.tick("Hide answers", True)
    tab.page.keyboard.press("l")
    expect(captions).to_contain_text("Answers are hidden")
    captions.get_by_role("button", name="Show the outcome").click()
    expect(captions).to_contain_text("The truth is hidden")
    tab.expect_quiet(address)
    tab.close()


def tap(tab: Playground, x: float, y: float) -> None:
    """Touch the page with a finger; a mouse is not the same, since what is under a finger captures it."""
    fingers = tab.page.context.new_cdp_session(tab.page)
    fingers.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": [{"x": x, "y": y}]})
    fingers.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    fingers.detach()


def test_a_phone_shows_the_canvas_and_what_the_step_says(browser: Browser, address: str) -> None:
    tab = Playground(browser, address)
    tab.page.set_viewport_size({"width": 390, "height": 844})
    tab.until(lambda: "step=outcome" in tab.page.evaluate("location.hash"), "the address holds the step")
    tab.page.reload()
    captions = tab.page.get_by_role("region", name="What the step says")
    expect(captions).to_contain_text("Outcome")
    bottom = "() => document.querySelector('#root').getBoundingClientRect().bottom"
    canvas, box = tab.page.evaluate(bottom), captions.bounding_box()
    assert box is not None and box["y"] >= canvas - 1, "the canvas ends where the caption begins"
    onward = captions.get_by_role("button", name="Next step")
    expect(onward).to_be_disabled()
    tap(tab, *tab.lonely_dots()[0][1:])
    expect(captions).to_contain_text(re.compile(r"Match \d+"))
    captions.get_by_role("button", name="Deselect").click()
    expect(captions).not_to_contain_text("Match")

    captions.get_by_role("button", name="Previous step").click()
    expect(captions).not_to_contain_text("Outcome")
    expect(onward).to_be_enabled()

    captions.get_by_role("button", name="The view of the step: Residuals").click()
    expect(tab.page.get_by_text("Residuals at the estimated pose")).to_be_visible()
    expect(tab.page.get_by_role("tab", name="Play", exact=True)).not_to_be_visible()
    title, graph = captions.locator(".step-title"), tab.page.get_by_text("Graph and matrix")
    for _ in range(30):  # before the refinement are the steps of the balls
        before = title.inner_text() + captions.locator(".place").inner_text()
        captions.get_by_role("button", name="Previous step").click()
        tab.until(lambda was=before: title.inner_text() + captions.locator(".place").inner_text() != was, "it steps")
        if "ball" in title.inner_text():
            break
    expect(graph).to_be_visible()
    captions.get_by_role("button", name="What the step says").click()
    expect(graph).not_to_be_visible()

    settings = tab.page.get_by_text(re.compile("^spherloc$"))
    settings.click()
    expect(tab.page.get_by_role("tab", name="Play", exact=True)).to_be_visible()
    expect(captions).to_have_count(0)

    def is_above_the_settings() -> bool:
        title = settings.bounding_box()
        return title is not None and tab.page.evaluate(bottom) <= min(title["y"], 0.5 * 844)

    tab.until(is_above_the_settings, "the canvas ends where the settings begin")
    settings.click()
    expect(captions).not_to_contain_text("Outcome")
    tab.until(lambda: tab.page.evaluate(bottom) > 0.6 * 844, "the canvas has its place again")
    tab.page.set_viewport_size(SIZE)
    tab.expect_quiet(address)
    tab.close()


def test_a_sharp_screen_and_a_zoomed_window_have_room_for_the_canvas(browser: Browser, address: str) -> None:
    """A screen with several pixels for each of the page's is not taken for a larger one."""
    tab = Playground(browser, address, new=True, sharpness=2.5)
    tab.until(lambda: abs(tab.page.evaluate(WIDTH_PX) - 384) < 8, "the panel is as wide as on any screen")
    expect(tab.page.get_by_role("tab", name="Play", exact=True)).to_be_visible()

    tab.until(lambda: "step=bearings" in tab.page.evaluate("location.hash"), "the address holds the step")
    tab.page.set_viewport_size({"width": 911, "height": 512})
    tab.page.reload()
    expect(tab.page.locator(".step-title").first).to_have_text("Bearings on the unit sphere")
    expect(tab.page.get_by_role("tab", name="Play", exact=True)).to_have_count(0)
    room = "() => document.querySelector('canvas').clientWidth"
    tab.until(lambda: tab.page.evaluate(room) > 450, "the canvas has the room of the settings")
    for size, panel_px, settings in (((2600, 1000), 654, 1), ((911, 512), 344, 0)):
        tab.page.set_viewport_size({"width": size[0], "height": size[1]})
        tab.until(lambda px=panel_px: abs(tab.page.evaluate(WIDTH_PX) - px) < 8, "the panels follow the window")
        expect(tab.page.get_by_role("tab", name="Play", exact=True)).to_have_count(settings)
    tab.until(lambda: tab.page.evaluate(room) > 450, "the settings are folded again")
    tab.page.keyboard.press("n")
    expect(tab.page).to_have_url(re.compile("step=(?!bearings)"))  # told though the settings are folded
    tab.page.keyboard.press("b")
    expect(tab.page).to_have_url(re.compile("step=bearings"))
    tab.page.get_by_label("Collapse panel area").click()
    expect(tab.page.locator("[data-ready]")).to_have_count(0)
    over = "() => getComputedStyle(document.documentElement, '::after').content"
    assert tab.page.evaluate(over) == "none", "nothing over the canvas says that the page is opening"
    for _ in range(2):
        tab.page.get_by_label("Expand column").first.click()
    expect(tab.page.get_by_role("tab", name="Play", exact=True)).to_be_visible()

    tab.page.set_viewport_size({"width": 390, "height": 844})
    tab.page.reload()
    expect(tab.page.get_by_role("region", name="What the step says")).to_contain_text("Bearings on the unit sphere")
    tab.until(lambda: np.ptp(tab.dots("/sphere/bearings")[:, 0]) > 0.5 * 390, "the sphere fills a phone's canvas")
    tab.expect_quiet(address)
    tab.page.context.close()
