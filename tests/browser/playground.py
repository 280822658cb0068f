"""The playground as a user meets it: a real server, a real Chromium, and what is on the page."""

import json
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
import pytest
from numpy.typing import NDArray
from playwright.sync_api import Browser, Error, Locator, Page, expect

from spherloc_viz.app.stage.views import START
from tests.installed import with_packages
from tests.needs import BROWSERS, NEEDS
from tests.waiting import LIMIT_S

SCENE = """
kind = "synthetic"
name = "small street"
[camera]
model = "equirectangular"
width = 2048
height = 1024
[simulation]
correspondences = 40
outlier_rate = 0.5
noise_px = 1.0
seed = 3
"""

FLAGS = (
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-gpu-compositing",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
)
SIZE = {"width": 1200, "height": 700}
SHARPNESS = 0.4
"""Pixels of the screen by those of the page: what is read is the same, and software draws a sixth of the pixels."""
PATIENCE_MS = 300_000
"""How long a page may take to show something, however busy the machine is."""
START_S = 600.0
"""How long a server may take to say where it is."""
BLIND = """for (const kind of [WebGLRenderingContext, WebGL2RenderingContext])
    for (const call of ["drawArrays", "drawElements", "drawArraysInstanced", "drawElementsInstanced"]) {
        const draw = kind.prototype[call];
        if (draw) kind.prototype[call] = function (...all) { if (window.canvasIsDrawn) draw.apply(this, all); };
    }"""
"""Makes the canvas draw nothing but while a test wants to see it. What tests read is in the page and in the scene's
nodes, and a frame in software takes most of a second, for which every click waits."""
ASIDE = """addEventListener("DOMContentLoaded", () => {
    const look = document.createElement("style");
    look.textContent = "[class*=Notifications-root], [class*=Notifications-root] * {pointer-events: none !important}";
    document.head.append(look);
})"""
"""Has clicks go through notes, of which viser's about drawing in software lies over a panel until it is closed."""
KNOWN = "localStorage.setItem('spherloc-introduction', 'seen')"
"""Makes the page believe that it was visited before: no introduction."""
PAINT = "() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(null))))"
"""Returns when the page has painted, which a busy machine does seldom."""
EMPTY = '<link rel="icon" href="data:,">'
"""A page that asks for nothing, not even its icon."""
AWAY = "/away"
"""Where a tab that no test uses waits: an empty page that the tests answer with, not the server."""
SELECTED = "#b024e4"
T = TypeVar("T")
expect.set_options(timeout=PATIENCE_MS)


def find_chromium() -> str:
    """Path of a Chromium; skips the test without one, but fails where one is required."""
    path = os.environ.get("SPHERLOC_CHROMIUM") or next(filter(None, map(shutil.which, BROWSERS)), None)
    if path is None:
        reason = NEEDS["chromium"].lack
        if os.environ.get("CI") or os.environ.get("SPHERLOC_REQUIRE_BROWSER"):
            pytest.fail(reason)
        pytest.skip(reason)
    return path


@contextmanager
def served(*words: str | Path, packages: Path | None = None) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """``spherloc play`` with these words on a free port: its address and process, ended with Ctrl-C.

    ``packages`` is a folder with installed packages that it finds besides its own.
    """
    program = Path(sys.executable).with_name("spherloc")
    server = subprocess.Popen(
        [program, "play", *map(str, words), "--port", "0"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=with_packages(packages) if packages else None,
    )
    assert server.stdout is not None
    # Its first start on a machine compiles the solvers, which is no test's time.
    too_late = threading.Timer(START_S, server.kill)
    too_late.start()
    try:
        line = server.stdout.readline()
        too_late.cancel()
        match = re.fullmatch(r"spherloc playground: (http://127\.0\.0\.1:\d+(/\?token=[\w-]+)?)\n", line)
        assert match, line or server.communicate(timeout=10)
        yield match[1], server
    finally:
        too_late.cancel()
        server.send_signal(signal.SIGINT)
        try:
            server.communicate(timeout=LIMIT_S)
        except subprocess.TimeoutExpired:
            server.kill()
            raise


def blind_page(browser: Browser) -> Page:
    """A page in a context of its own, whose canvas draws nothing."""
    context = browser.new_context(viewport=SIZE, reduced_motion="reduce")  # pyright: ignore[reportArgumentType]
    context.add_init_script(BLIND)
    return context.new_page()


_spare_pages: WeakKeyDictionary[Browser, list[Page]] = WeakKeyDictionary()
"""Pages of each browser that no test uses, all with the usual scripts."""


class Playground:
    """One tab."""

    def __init__(self, browser: Browser, address: str, new: bool = False, sharpness: float = SHARPNESS) -> None:
        """Open the page, wait for its first run and go to the run's last step; ``new`` is a browser that has never been
        here: it stays where the page opens, on a screen of that ``sharpness``."""
        self._spare = None if new else _spare_pages.setdefault(browser, [])
        if self._spare:
            self.page = self._spare.pop()
        else:
            context = browser.new_context(
                viewport=SIZE,  # pyright: ignore[reportArgumentType]
                device_scale_factor=sharpness,
                reduced_motion="reduce",
            )
            context.add_init_script(ASIDE)
            if not new:
                context.add_init_script(KNOWN)
            context.add_init_script(BLIND)
            self.page = context.new_page()
            self.page.set_default_timeout(PATIENCE_MS)
        self.errors: list[str] = []
        self.hosts: set[str] = set()
        self._listeners: tuple[tuple[Any, Callable[[Any], None]], ...] = (
            ("console", lambda message: self.errors.append(message.text) if message.type == "error" else None),
            ("pageerror", lambda error: self.errors.append(str(error))),
            ("request", lambda request: self._note_host(request.url)),
            ("websocket", lambda socket: self._note_host(socket.url)),
        )
        for event, listener in self._listeners:
            self.page.on(event, listener)
        self._address = address.partition("/?")[0]
        self.page.goto(address)
        expect(self.value("outcome")).not_to_be_empty()
        if not new:
            self.slide("Timeline", "End")
            expect(self.step).to_have_value(re.compile("Outcome$"))
            self.page.evaluate("document.activeElement.blur()")

    def expect_quiet(self, address: str) -> None:
        """No errors on the console, and no word to any other server."""
        assert self.errors == [], self.errors
        assert self.hosts == {address.removeprefix("http://")}

    def _note_host(self, url: str) -> None:
        if not url.startswith("data:"):
            self.hosts.add(url.split("/")[2])

    def close(self) -> None:
        """Leave the page, as closing it does. Another test may go on with the tab: a new one costs twice the time.

        It waits at an empty page of the same address, since elsewhere it would lose its process."""
        if self._spare is None or self.page.is_closed():
            self.page.context.close()
            return
        self.page.evaluate("() => { localStorage.clear(); sessionStorage.clear() }")
        try:
            self.page.route(f"**{AWAY}", lambda route: route.fulfill(content_type="text/html", body=EMPTY))
            self.page.goto(f"{self._address}{AWAY}")
            self.page.unroute(f"**{AWAY}")
        except Error:  # the server is gone
            self.page.context.close()
            return
        for event, listener in self._listeners:
            self.page.remove_listener(event, listener)
        self.page.context.clear_cookies()
        self.page.context.clear_permissions()
        self.page.mouse.move(0, 0)
        self._spare.append(self.page)

    def draw_canvas(self, on: bool) -> None:
        """Have the canvas really drawn, which is slow, or no longer."""
        self.page.evaluate("on => { window.canvasIsDrawn = on; }", on)

    def value(self, name: str) -> Locator:
        """The cell of the outcome table beside a name."""
        return self.page.locator(f"//tr[td[1][normalize-space()='{name}']]/td[2]")

    def widget(self, label: str) -> Locator:
        """The element that a widget's label is for."""
        name = self.page.locator("label", has_text=re.compile(rf"^{re.escape(label)}$"))
        return self.page.locator(f"[id='{name.get_attribute('for')}']")

    def entry(self, label: str) -> Locator:
        """The box that is typed into."""
        name = self.page.locator("label", has_text=re.compile(rf"^{re.escape(label)}$"))
        return name.locator("xpath=ancestor::*[contains(@class, 'Flex-root')][1]").locator("input:not([type='hidden'])")

    def thumb(self, label: str) -> Locator:
        """The part of a slider that is dragged."""
        return self.widget(label).get_by_role("slider")

    def tick(self, label: str, on: bool) -> None:
        """Set a checkbox, which shows its new state some frames after the click."""
        box = self.widget(label)
        if box.is_checked() != on:
            box.click()
        expect(box).to_be_checked(checked=on)

    def choose(self, label: str, option: str) -> None:
        """Choose from a list."""
        self.widget(label).click()
        chosen = self.page.get_by_role("option", name=option, exact=True)
        expect(chosen).to_be_visible()
        # Not by the mouse: the open list may move between the choice of a place and the press there.
        chosen.dispatch_event("click")

    def type(self, label: str, text: str) -> None:
        """Type into a box and press Enter."""
        box = self.entry(label)
        box.fill(text)
        box.press("Enter")

    def slide(self, label: str, key: str) -> None:
        """Press a key on a slider: Home, End or an arrow."""
        self.thumb(label).focus()
        self.page.keyboard.press(key)

    def press(self, button: str) -> None:
        """Click a button."""
        self.page.get_by_role("button", name=button, exact=True).click()

    def unfold(self, folder: str) -> None:
        """Open a folder once it stands still, and wait until it is open: what is pressed while something above it grows
        moves away under the pointer."""
        titles = self.page.locator("[class*=Paper-root] > [class*=Paper-root]")
        title = titles.filter(has_text=re.compile(rf"^{re.escape(folder)}$")).locator("visible=true")
        self.still(title.bounding_box, f"the folder {folder} stands still")
        title.click()
        self.page.evaluate(PAINT)
        moving = (
            "() => document.getAnimations().some(one => one instanceof CSSTransition && one.playState === 'running')"
        )
        self.until(lambda: not self.page.evaluate(moving), f"the folder {folder} is open")

    def tab(self, name: str) -> None:
        """Open a tab."""
        self.page.get_by_role("tab", name=name, exact=True).click()

    def touch(self, action: str) -> Locator:
        """What can be seen and reports this ("ACTION:ARGUMENT") when it is pressed."""
        return self.page.locator(f"[data-touch='{action}']").locator("visible=true")

    def row(self, number: int) -> Locator:
        """The row of a match in the table, if the page of the table that is open has it."""
        return self.page.locator(f"tr[data-touch='select:{number}']")

    @property
    def step(self) -> Locator:
        """The list of steps, whose value names the step at hand."""
        return self.widget("Step")

    def node(self, name: str) -> dict[str, Any] | None:
        """A node of the canvas: how many bytes each of its arrays has, and whether it is visible; None if absent."""
        script = """name => {
            const node = window.__viserSceneTree.getState()[name];
            if (!node) return null;
            const props = node.message.props, sizes = {};
            for (const key in props) if (props[key] && props[key].byteLength) sizes[key] = props[key].byteLength;
            return JSON.stringify({visible: node.effectiveVisibility, ...sizes});
        }"""
        found = self.page.evaluate(script, name)
        return None if found is None else json.loads(found)

    def instances(self, name: str) -> int:
        """How many visible balls or dots a batched node and those below it show; 0 if it is absent."""
        script = """name => Object.entries(window.__viserSceneTree.getState())
            .filter(([path, node]) => (path === name || path.startsWith(name + '/')) && node.effectiveVisibility)
            .reduce((sum, [path, node]) => sum + (node.message?.props?.batched_positions?.byteLength ?? 0) / 12, 0)"""
        return round(self.page.evaluate(script, name))

    def dots(self, name: str) -> NDArray[np.float64]:
        """Where on the page (N, 2) the balls or dots of a batched node are seen."""
        self._until_built(name)
        script = """name => {
            const {camera, canvas, nodeRefFromName} = window.__viserMutable, box = canvas.getBoundingClientRect();
            const all = window.__viserSceneTree.getState()[name].message.props.batched_positions;
            const node = nodeRefFromName[name];
            node.updateWorldMatrix(true, false);
            camera.updateMatrixWorld();
            return Array.from({length: all.length / 3}, (_, k) => {
                const at = camera.position.clone().set(...all.slice(3 * k, 3 * k + 3));
                at.applyMatrix4(node.matrixWorld).project(camera);
                return [box.left + 0.5 * (1 + at.x) * box.width, box.top + 0.5 * (1 - at.y) * box.height];
            });
        }"""
        return np.array(self.page.evaluate(script, name))

    def centre(self, name: str) -> tuple[float, ...]:
        """The first end of the first of a node's lines, where ``viewer`` is measured."""
        self._until_built(name)
        script = """name => {
            const {camera, nodeRefFromName} = window.__viserMutable, node = nodeRefFromName[name];
            const all = window.__viserSceneTree.getState()[name].message.props.points;
            node.updateWorldMatrix(true, false);
            return camera.position.clone().set(...all.slice(0, 3)).applyMatrix4(node.matrixWorld).toArray();
        }"""
        return tuple(self.page.evaluate(script, name))

    def lonely_dots(self, *others: str) -> list[tuple[int, float, float]]:
        """Numbers and places of the map's dots that can be clicked: nothing lies above them, no other dot is near.

        ``others`` are more nodes whose dots must not be near.
        """
        self.settle()
        places = self.dots("/map/points")
        all_places = np.vstack([places, *(self.dots(name) for name in ("/sphere/bearings", *others))])
        apart = np.linalg.norm(places[:, None] - all_places[None], axis=2)
        apart[np.arange(len(places)), np.arange(len(places))] = np.inf
        free = "at => at.map(([x, y]) => document.elementFromPoint(x, y)?.tagName === 'CANVAS')"
        on_canvas = np.array(self.page.evaluate(free, places.tolist()))
        found = np.flatnonzero(on_canvas & (apart.min(axis=1) > 20.0))
        return [(int(k), float(places[k, 0]), float(places[k, 1])) for k in found]

    def settle(self) -> None:
        """Close what lies above the canvas, and wait until the viewer stands still, at a view of ours."""
        close = "() => document.querySelectorAll('[class*=Notification-closeButton]').forEach(button => button.click())"
        self.page.evaluate(close)
        away = float(np.linalg.norm(START))
        self.until(lambda: abs(math.hypot(*self.viewer[:3]) - away) > 0.01, "the first view is set")
        self.still(lambda: self.viewer, "the viewer stands still")

    def still(self, read: Callable[[], T], what: str) -> T:
        """Wait until something stays the same while the page paints several frames; returns it."""
        seen: list[T] = []

        def same() -> bool:
            self.page.evaluate(PAINT)
            seen.append(read())
            return len(seen) > 3 and all(one == seen[-1] for one in seen[-4:-1])

        self.until(same, what)
        return seen[-1]

    def _until_built(self, name: str) -> None:
        """Wait until a node that the page has heard of stands on the canvas."""
        there = "name => Boolean(window.__viserMutable.nodeRefFromName[name])"
        self.until(lambda: self.page.evaluate(there, name), f"{name} is built")

    @property
    def viewer(self) -> tuple[float, ...]:
        """Where the viewer stands and looks: a place and a direction, to compare with others."""
        script = "() => { const c = window.__viserMutable.camera; return [...c.position.toArray(), ...c.quaternion] }"
        return tuple(round(number, 3) for number in self.page.evaluate(script))

    def carded(self) -> list[int]:
        """Numbers of the matches that the selection card is about; empty if there is no card."""
        one = self.page.get_by_text(re.compile(r"^Match \d+$")).locator("visible=true").all_inner_texts()
        many = self.value("numbers").locator("visible=true").all_inner_texts()
        return [int(number) for number in re.findall(r"\d+", " ".join(one + many))]

    def expect_card(self, *numbers: int) -> None:
        """Wait until the card is about these matches, or gone."""
        self.until(lambda: self.carded() == list(numbers), f"the card is about {numbers or 'nothing'}")

    def lit(self) -> list[int]:
        """Numbers of the matches whose dots have a rim on the canvas, if none is hidden."""
        script = """() => {
            const nodes = window.__viserSceneTree.getState(), rims = nodes["/selection/map/points"];
            if (!rims?.effectiveVisibility) return [];
            const key = (all, k) => all.slice(3 * k, 3 * k + 3).join();
            const dots = nodes["/map/points"].message.props.batched_positions, found = new Map();
            for (let k = 0; k < dots.length / 3; k++) found.set(key(dots, k), k);
            const marked = rims.message.props.batched_positions;
            return Array.from({length: marked.length / 3}, (_, k) => found.get(key(marked, k)) ?? -1);
        }"""
        return sorted(self.page.evaluate(script))

    def drawn(self) -> dict[str, int]:
        """How many dots, balls or lines each visible node of the canvas shows; balls in shells count together."""
        script = """() => Object.entries(window.__viserSceneTree.getState())
            .filter(([path, node]) => node.effectiveVisibility)
            .map(([path, node]) => [path, node.message?.props ?? {}])
            .map(([path, {batched_positions, points, colors}]) => [path.replace(/^\\/(.*?)(\\/\\d+)?$/, "$1"),
                (batched_positions?.length ?? 0) / 3 + (points && colors ? points.length / 6 : 0)])
            .filter(([path, count]) => count > 0)"""
        counts: dict[str, int] = {}
        for name, count in self.page.evaluate(script):
            counts[name] = counts.get(name, 0) + round(count)
        return counts

    def step_number(self) -> int:
        """Which step is at hand, from 1."""
        return self._steps()[0]

    def step_count(self) -> int:
        """How many steps there are."""
        return self._steps()[1]

    def _steps(self) -> tuple[int, int]:
        """The step at hand and the number of steps, as soon as the list of steps says so: while it changes it is empty
        for a moment."""
        found: list[tuple[str, str]] = []

        def is_said() -> bool:
            found[:] = re.findall(r"^(\d+)/(\d+)  ", self.step.input_value())
            return bool(found)

        self.until(is_said, "the list of steps has a value")
        return int(found[0][0]), int(found[0][1])

    def until(self, condition: Callable[[], bool], what: str, patience_s: float = PATIENCE_MS / 1000) -> None:
        """Wait until something is so on the page."""
        end = time.monotonic() + patience_s
        while not condition():
            assert time.monotonic() < end, f"waited in vain until {what}"
            self.page.wait_for_timeout(50)
