"""Milliseconds from a key on a slider to the painted frame, in a real Chromium whose draw calls do nothing.

Software drawing would measure this machine's processor instead of the page.
"""

import os
import shutil

import numpy as np
from playwright.sync_api import sync_playwright

FLAGS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")
STUB = """
for (const kind of [WebGLRenderingContext, WebGL2RenderingContext])
    for (const name of ["drawArrays", "drawElements", "drawArraysInstanced", "drawElementsInstanced"])
        if (kind.prototype[name]) kind.prototype[name] = () => undefined;
"""
MEASURE = """async thumb => {
    const outcome = [...document.querySelectorAll("td")].find(cell => cell.textContent === "solved in").closest("div");
    const place = outcome.parentElement;
    thumb.focus();
    const start = performance.now();
    const changed = new Promise(done => {
        const watcher = new MutationObserver(() => { watcher.disconnect(); done(); });
        watcher.observe(place, {childList: true, subtree: true, characterData: true});
    });
    thumb.dispatchEvent(new KeyboardEvent("keydown", {key: "ArrowRight", code: "ArrowRight", bubbles: true}));
    await changed;
    // The frame that this change is painted in has ended when the next one begins.
    await new Promise(requestAnimationFrame);
    await new Promise(requestAnimationFrame);
    return performance.now() - start;
}"""


def painted_frames(address: str, moves: int) -> np.ndarray:
    """Milliseconds (moves,) at N = 200, 95 % outliers, mc-exact."""
    path = os.environ.get("SPHERLOC_CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
    if path is None:
        raise SystemExit("no Chromium found; install one or set SPHERLOC_CHROMIUM to its path.")
    with sync_playwright() as playwright, playwright.chromium.launch(executable_path=path, args=FLAGS) as browser:
        page = browser.new_page(viewport={"width": 1280, "height": 720})
        page.add_init_script("localStorage.setItem('spherloc-introduction', 'seen')")
        page.add_init_script(STUB)
        page.goto(address)
        page.get_by_text("success", exact=True).or_(page.get_by_text("failure", exact=True)).first.wait_for()

        def entry(label: str):
            name = page.locator("label", has_text=label).first
            return name.locator("xpath=ancestor::*[contains(@class, 'Flex-root')][1]").locator("input[type=text]")

        for label, value in (("Points", "200"), ("Outliers (%)", "95"), ("Noise (px)", "0.5")):
            entry(label).fill(value)
            entry(label).press("Enter")
            page.wait_for_timeout(1500)
        name = page.locator("label", has_text="Noise (px)").first
        thumb = page.locator(f"[id='{name.get_attribute('for')}'] [role=slider]")
        found = []
        for _ in range(moves):
            page.wait_for_timeout(400)
            found.append(thumb.evaluate(MEASURE))
    return np.array(found)
