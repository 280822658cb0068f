"""A lesson as a reader and a teacher use it: the text moves the scene, and tells the numbers of its run."""

import re
from pathlib import Path

from playground import BLIND, PATIENCE_MS, SHARPNESS, SIZE
from playwright.sync_api import Browser, expect

from spherloc_viz.app.lesson_file import exported
from spherloc_viz.lessons import lesson_named

LATE = """if (self !== top) {
    const every = setInterval;
    let moved = false;
    addEventListener("hashchange", () => { moved = true; });
    setInterval = (call, ms) => every(() => { if (moved || !`${call}`.includes("[data-address]")) call(); }, ms);
}"""
"""Has the scene's page follow its address (link.js) only after the lesson has changed it, as a busy machine does."""


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
    assert "outlier_rate%3D0.9" in frame.url and "step=outcome" in frame.url
    expect(cost.locator(".open a")).to_have_attribute("href", re.compile("outlier_rate%3D0.9"))

    # A remote control turns the pages although the slider has the focus.
    slider.press("PageDown")
    expect(page.locator("#moment-2")).to_have_class(re.compile("now"))
    expect(slider).to_have_value("0.9")

    # Who goes on before the scene is there sees the scene of where they are.
    page.add_init_script(LATE)
    page.goto(f"{address}/learn/failures")
    page.keyboard.press("PageDown")
    expect(page.locator("#moment-1 [data-number=matches]")).to_have_text("60")
    for _ in range(4):
        page.keyboard.press("PageDown")

    # A link says the same state whatever link was pressed before it.
    luck = page.locator("#moment-5")
    luck.locator(".right button").click()
    luck.get_by_role("link", name="Seed 0").click()
    shown = luck.locator(".open a")
    expect(shown).to_have_attribute("href", re.compile("seed=0.*iterations%3D200"))
    luck.get_by_role("link", name="1,000 samples").click()
    expect(shown).to_have_attribute("href", re.compile("seed=3.*iterations%3D1000"))
    assert errors == []
    context.close()


def test_the_teachers_notes_follow_in_a_window_of_their_own(browser: Browser, address: str) -> None:
    context = browser.new_context(viewport=SIZE, reduced_motion="reduce")  # pyright: ignore[reportArgumentType]
    context.add_init_script(BLIND)
    page = context.new_page()
    page.set_default_timeout(PATIENCE_MS)
    page.goto(f"{address}/learn/ransac")
    with context.expect_page() as opened:
        page.keyboard.press("n")
    notes = opened.value
    notes.set_default_timeout(PATIENCE_MS)
    expect(notes.locator(".where")).to_have_text(re.compile("^1 of"))
    expect(page.locator(".notes").first).to_be_hidden()

    # A remote control that is pointed at the notes turns the lesson's pages.
    notes.keyboard.press("PageDown")
    cost = page.locator("#moment-1")
    expect(cost).to_have_class(re.compile("now"))
    expect(notes.locator(".now")).to_have_attribute("data-place", "1")
    cost.locator(".wrong button").first.click()
    expect(notes.locator(".now .votes")).to_have_text("votes: 1, 0, 0")
    expect(cost.locator(".after")).to_be_hidden()
    notes.locator(".now [data-press=reveal]").click()
    expect(cost.locator(".after")).to_be_visible()
    notes.close()
    expect(page.locator("body")).not_to_have_class(re.compile("voting"))
    context.close()


def test_an_exported_lesson_is_read_without_a_server(browser: Browser, tmp_path: Path) -> None:
    path = tmp_path / "lesson.html"
    path.write_text(exported(lesson_named("yaw-arcs"), lambda words: None), encoding="utf-8")
    context = browser.new_context(viewport=SIZE, reduced_motion="reduce")  # pyright: ignore[reportArgumentType]
    context.add_init_script(BLIND)
    page = context.new_page()
    page.set_default_timeout(PATIENCE_MS)
    errors: list[str] = []
    asked: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    page.on("request", lambda request: asked.append(request.url))
    page.on("websocket", lambda socket: asked.append(socket.url))
    page.goto(path.as_uri())
    arcs = """() => Object.keys(document.querySelector(".scene iframe:not(.coming)")?.contentWindow.__viserSceneTree
        ?.getState() ?? {}).filter(name => name.startsWith("/ring"))"""
    expect(page.locator("body")).not_to_have_class(re.compile("opening"))
    first = page.evaluate(arcs)
    assert first

    page.keyboard.press("PageDown")
    second = page.locator("#moment-1")
    expect(second).to_have_class(re.compile("now"))
    expect(second.locator(".after")).to_be_hidden()
    second.locator(".right button").click()
    expect(second.locator("[data-number=pairs_at_yaw]")).to_have_text("218")
    expect(page.locator(".scene iframe")).to_have_count(1)
    page.wait_for_function(f"before => ({arcs})().join() !== before", arg=",".join(first))

    # A scene that is left and wanted again while it is made is made once: a second one would take the first away.
    page.keyboard.press("PageDown")
    expect(page.locator("#moment-2")).to_have_class(re.compile("now"))
    expect(page.locator("body")).not_to_have_class(re.compile("waiting"))
    most = page.evaluate("""() => new Promise(done => {
        const box = document.querySelector(".scene");
        const press = (moment, answer) => document.querySelector(`#moment-${moment} .${answer} button`).click();
        let most = 0;
        new MutationObserver(() => { most = Math.max(most, box.children.length); }).observe(box, { childList: true });
        press(2, "right");
        setTimeout(() => { press(1, "wrong"); press(2, "right"); setTimeout(() => done(most), 400); }, 300);
    })""")
    assert most == 2, "the scene before and the one that is made"
    expect(page.locator("body")).not_to_have_class(re.compile("waiting"))
    expect(page.locator(".scene iframe")).to_have_count(1)
    own = path.as_uri()
    assert [url for url in asked if not url.startswith((own, "data:", "blob:", "about:"))] == []
    assert errors == []
    context.close()
