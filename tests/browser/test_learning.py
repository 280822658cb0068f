"""A lesson as a reader and a teacher use it: the text moves the scene, and tells the numbers of its run."""

import re

from playground import BLIND, PATIENCE_MS, SHARPNESS, SIZE
from playwright.sync_api import Browser, expect


def test_a_lesson_is_read(browser: Browser, address: str) -> None:
    context = browser.new_context(
        viewport=SIZE,  # pyright: ignore[reportArgumentType]
        device_scale_factor=SHARPNESS,
        reduced_motion="reduce",
    )
    context.add_init_script(BLIND)
    page = context.new_page()
    page.set_default_timeout(PATIENCE_MS)
    errors: list[str] = []
    page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(f"{address}/learn")
    page.get_by_role("link", name=re.compile("RANSAC")).click()

    first, cost = page.locator("#moment-0"), page.locator("#moment-1")
    expect(first.locator("[data-number=right]")).to_have_text("40")
    page.keyboard.press("PageDown")
    expect(cost).to_have_class(re.compile("now"))
    expect(cost.locator(".after")).to_be_hidden()

    # The teacher counts votes, and tells the answer then.
    page.keyboard.press("t")
    wrong = cost.locator(".wrong button").first
    wrong.click()
    expect(wrong.locator(".votes")).to_have_text("1")
    expect(cost.locator(".after")).to_be_hidden()
    cost.locator(".reveal").click()
    expect(cost.locator(".after")).to_be_visible()
    expect(cost.locator("[data-number=samples_needed]")).to_have_text("170")

    # Slider and scene follow each other.
    slider = cost.get_by_role("slider")
    expect(slider).to_have_value("0.8")
    slider.fill("0.9")
    expect(cost.locator("[data-number=samples_needed]")).to_have_text("688")
    frame = next(one for one in page.frames if one != page.main_frame)
    assert "outlier_rate%3D0.9" in frame.url and "step=samples-needed" in frame.url
    expect(cost.locator(".open a")).to_have_attribute("href", re.compile("outlier_rate%3D0.9"))
    assert errors == []
    context.close()
