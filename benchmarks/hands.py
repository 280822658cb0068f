"""Hands on several pages of a real browser, beside busy processes: what they type and drag must stay, and arrive.

    .venv/bin/python -m benchmarks.hands --pages 8 --changes 20000 --busy 8

On each page a script types into fields, drags sliders, ticks boxes and presses Undo, New seed and a preset, with the
events that a mouse and a keyboard make. After every change, whatever was typed, dragged or ticked last must still be
what the widget shows. From time to time the hand rests; then the command that the server offers to repeat the run must
say what the widgets show. Draw calls do nothing: software drawing would measure the processor.
"""

import argparse
import math
import os
import re
import shutil
import subprocess
import sys
import time
from contextlib import ExitStack
from html import unescape

from playwright.sync_api import Page, sync_playwright

from benchmarks.browser_frames import FLAGS, STUB
from benchmarks.playground import memory_mib, playground

REST_EVERY = 40
"""Changes."""
PATIENCE_S = 300.0
KNOWN = "localStorage.setItem('spherloc-introduction', 'seen');"
"""The page was visited before."""
LISTEN = """(() => {
    const Plain = window.Worker;
    window.said = new Map();
    window.sent = new Map();
    window.older = 0;
    window.Worker = class extends Plain {
        constructor(...words) {
            super(...words);
            this.addEventListener("message", ({data}) => {
                for (const {uuid, props, updates} of data?.messages ?? []) {
                    if (updates?.answers < sent.get(uuid)?.change) older += 1;
                    const content = updates?.content ?? props?.content;
                    if (content !== undefined) said.set(uuid, content);
                }
            });
        }
        postMessage(data, ...words) {
            if (data?.message?.type === "GuiUpdateMessage") sent.set(data.message.uuid, data.message.updates);
            super.postMessage(data, ...words);
        }
    };
})();"""
WORK = r"""(seed => {
    const LABELS = ["Points", "Noise (px)", "Outliers (%)", "Seed"], SLIDERS = LABELS.slice(0, 3);
    let state = seed;
    const random = () => {  // mulberry32
        state = (state + 0x6d2b79f5) | 0;
        let t = Math.imul(state ^ (state >>> 15), 1 | state);
        t = (t + Math.imul(t ^ (t >>> 7), 61 | t)) ^ t;
        return ((t ^ (t >>> 14)) >>> 0) / 4294967296;
    };
    const below = count => Math.floor(random() * count), pick = all => all[below(all.length)];
    const label = name => [...document.querySelectorAll("label")].find(one => one.textContent === name);
    const row = name => label(name).closest("[class*=Flex-root]");
    const field = name => row(name).querySelector("input:not([type=hidden])");
    const box = name => document.getElementById(label(name).htmlFor);
    const write = Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value").set;
    const wait = ms => new Promise(done => setTimeout(done, ms));
    const number = text => Number(text.replaceAll(",", ""));
    const shown = name => name === "Seed" ? field(name).value
        : name in boxes ? box(name).checked : number(field(name).value);
    const boxes = {"Follow steps": 0, "Drag the camera": 0, "Dark": 0};
    const wanted = {};
    const report = {changes: 0, rests: 0, mistakes: [], resting: false, done: false};

    function typed(name, text) {
        const input = field(name);
        input.focus();
        for (let k = 1; k <= text.length; k += 1) {
            write.call(input, text.slice(0, k));
            input.dispatchEvent(new InputEvent("input", {bubbles: true}));
            report.changes += 1;
        }
        input.blur();
        wanted[name] = name === "Seed" ? text : number(input.value);
    }
    async function dragged(name) {
        const track = document.getElementById(label(name).htmlFor), thumb = track.querySelector("[role=slider]");
        const bar = track.querySelector("[class*=Slider-track]"), place = bar.getBoundingClientRect();
        const at = share => ({bubbles: true, cancelable: true, button: 0, buttons: 1,
            clientX: place.left + share * place.width, clientY: place.top + place.height / 2});
        let share = random();
        bar.dispatchEvent(new PointerEvent("pointerdown", at(share)));
        bar.dispatchEvent(new MouseEvent("mousedown", at(share)));
        let before = thumb.getAttribute("aria-valuenow");
        for (let k = 0; k < 4 + below(8); k += 1) {
            share = Math.min(1, Math.max(0, share + 0.2 * (random() - 0.5)));
            document.dispatchEvent(new MouseEvent("mousemove", at(share)));
            await wait(pick([0, 5, 20, 60]));
            const now = thumb.getAttribute("aria-valuenow");
            report.changes += now !== before;
            before = now;
        }
        document.dispatchEvent(new MouseEvent("mouseup", at(share)));
        document.dispatchEvent(new PointerEvent("pointerup", at(share)));
        // A move counts in the next frame, and is sent 50 ms later at most.
        for (let k = 0; k < 3; k += 1) await new Promise(requestAnimationFrame);
        await wait(120);
        wanted[name] = sent.get(label(name).htmlFor).value;
    }
    function ticked() {
        for (const name of Object.keys(boxes)) {
            box(name).click();
            wanted[name] = box(name).checked;
            report.changes += 1;
        }
    }
    function pressed() {
        const button = pick(["Undo", "Redo", "New seed"]);
        [...document.querySelectorAll("button")].find(one => one.textContent === button).click();
        for (const name of button === "New seed" ? ["Seed"] : LABELS) delete wanted[name];
        report.changes += 1;
    }
    function values(name) {
        if (name === "Seed") return String(below(1e6));
        if (name === "Points") return String(10 + below(60));
        return name === "Noise (px)" ? (0.1 + below(49) / 10).toFixed(1) : String(below(95));
    }
    const wrong = () => Object.keys(wanted).filter(name => shown(name) !== wanted[name]);
    async function check(when) {
        if (wrong().length === 0) return;
        // What was just set is shown some frames later.
        for (let k = 0; k < 3; k += 1) await new Promise(requestAnimationFrame);
        const words = wrong().map(name => `${name} is ${shown(name)}, not ${wanted[name]}`);
        if (words.length) report.mistakes.push(`${when}, after ${report.changes}: ${words.join(", ")}`);
    }
    async function work(count, every) {
        let rest = every;
        while (report.changes < count) {
            const kind = random();
            if (kind < 0.4) { const name = pick(LABELS); typed(name, values(name)); }
            else if (kind < 0.7) await dragged(pick(SLIDERS));
            else if (kind < 0.85) ticked();
            else { pressed(); const name = pick(LABELS); typed(name, values(name)); }
            await wait(pick([0, 0, 10, 40, 100, 200]));
            await check("working");
            if (report.changes >= rest || report.changes >= count) {
                report.resting = true;
                while (report.resting) { await wait(50); await check("resting"); }
                rest = report.changes + every;
            }
        }
        report.done = true;
    }
    window.report = report;
    window.showing = () => Object.fromEntries(LABELS.map(name => [name, shown(name)]));
    window.work = work;
})"""


def offered(page: Page) -> dict[str, float | str] | None:
    """What the script that repeats the run says of the values; None if there is none yet."""
    for html in page.evaluate("() => [...said.values()]"):
        text = unescape(re.sub("<[^>]*>", "", html))
        seed = re.search(r"seed=(\d+)\)", text)
        if seed is None or "load_scene" not in text:
            continue
        found = dict(re.findall(r"(correspondences|noise_px|outlier_rate)=([\d.e-]+)", text.split("problem.scene")[0]))
        return {
            "Points": float(found.get("correspondences", 100)),
            "Noise (px)": float(found.get("noise_px", 1.0)),
            "Outliers (%)": round(100.0 * float(found.get("outlier_rate", 0.9)), 6),
            "Seed": seed[1],
        }
    return None


def same(one: dict[str, float | str], other: dict[str, float | str] | None) -> bool:
    """Whether all values agree."""
    return other is not None and all(
        value == other[name] if isinstance(value, str) else math.isclose(value, float(other[name]), abs_tol=1e-9)
        for name, value in one.items()
    )


def hands(pages: int, changes: int, busy: int, minutes: float) -> int:
    """Run it and print what was seen; returns the mistakes."""
    path = os.environ.get("SPHERLOC_CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
    if path is None:
        raise SystemExit("no Chromium found; install one or set SPHERLOC_CHROMIUM to its path.")
    each, end_s = math.ceil(changes / pages), time.monotonic() + 60.0 * minutes
    mistakes: list[str] = []
    reads = 0
    with ExitStack() as stack:
        for _ in range(busy):
            process = subprocess.Popen([sys.executable, "-c", "while True: pass"])
            stack.callback(process.wait)
            stack.callback(process.kill)
        address, server = stack.enter_context(playground())
        playwright = stack.enter_context(sync_playwright())
        browser = playwright.chromium.launch(executable_path=path, args=FLAGS)
        stack.callback(browser.close)
        opened: list[Page] = []
        for number in range(pages):
            page = browser.new_context(viewport={"width": 1200, "height": 700}).new_page()
            page.set_default_timeout(1000 * PATIENCE_S)
            page.add_init_script(STUB + LISTEN + KNOWN)
            page.goto(address)
            page.get_by_text("success", exact=True).or_(page.get_by_text("failure", exact=True)).first.wait_for()
            page.get_by_text("Layers", exact=True).first.click()
            page.locator("label", has_text="Follow steps").wait_for()
            page.evaluate(f"{WORK}({number + 1})")
            opened.append(page)
        for page in opened:
            page.evaluate("([count, every]) => { work(count, every); }", [each, REST_EVERY])
        waiting = {page: time.monotonic() for page in opened}
        while waiting and time.monotonic() < end_s:
            for number, page in enumerate(opened):
                if page not in waiting:
                    continue
                report = page.evaluate("() => report")
                if report["done"]:
                    del waiting[page]
                elif not report["resting"]:
                    waiting[page] = time.monotonic()
                elif same(page.evaluate("() => showing()"), offered(page)):
                    reads += 1
                    page.evaluate("() => { report.resting = false; }")
                elif time.monotonic() - waiting[page] > PATIENCE_S:
                    mistakes.append(f"page {number}: shows {page.evaluate('() => showing()')}, not {offered(page)}")
                    page.evaluate("() => { report.resting = false; }")
            time.sleep(0.1)
        reports = [page.evaluate("() => report") for page in opened]
        older = sum(page.evaluate("() => older") for page in opened)
        memory = memory_mib(server.pid)
    for number, report in enumerate(reports):
        mistakes += [f"page {number}: {mistake}" for mistake in report["mistakes"]]
    done = sum(report["changes"] for report in reports)
    print(f"{pages} pages, {busy} busy processes: {done} changes, {reads} read back, {len(mistakes)} mistakes")
    print(f"values of the server that were older than what a hand had set, and were dropped: {older}")
    print(f"memory of the server: {memory:.0f} MiB")
    for mistake in mistakes[:20]:
        print(mistake)
    return len(mistakes)


def main() -> None:
    """Read the command line."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("--pages", type=int, default=8)
    words.add_argument("--changes", type=int, default=20_000)
    words.add_argument("--busy", type=int, default=0, help="processes that keep the machine busy meanwhile")
    words.add_argument("--minutes", type=float, default=30.0, help="the most that it may take")
    given = words.parse_args()
    sys.exit(hands(given.pages, given.changes, given.busy, given.minutes) > 0)


if __name__ == "__main__":
    main()
