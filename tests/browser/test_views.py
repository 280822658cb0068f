"""What is seen of a run: steps, layers, views, themes; and what happens when things go wrong."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
from playground import PAINT, Playground
from playwright.sync_api import expect

from spherloc_viz.recording.content.data import read_recording

EXACT = "mc-exact (exact, certified)"
MIN_CONTRAST = 4.5
TABS = ("Yaw", "Charts", "Residuals", "Images", "Matches", "Play", "Compare", "Sweep", "Open", "Share")

READ_CONTRASTS = r"""() => {
    const channels = (text) => {
        const all = text.match(/-?[\d.]+(e-?\d+)?/g).map(Number), unit = text.startsWith("color(srgb") ? 1 : 255;
        return [all[0] / unit, all[1] / unit, all[2] / unit, all[3] ?? 1];
    };
    const over = (top, share, below) => below.map((value, k) => share * top[k] + (1 - share) * value);
    const light = (rgb) => rgb.map((v) => (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4))
        .reduce((sum, v, k) => sum + [0.2126, 0.7152, 0.0722][k] * v, 0);
    const found = [];
    for (const element of document.querySelectorAll("[data-ours] *, svg text")) {
        const words = [...element.childNodes].filter((n) => n.nodeType === 3).map((n) => n.data).join(" ").trim();
        const seen = element.checkVisibility({opacityProperty: true, visibilityProperty: true});
        if (!words || !seen || element.closest("title,style,[inert],[aria-disabled=true]")) continue;
        const line = [];
        for (let e = element; e; e = e.parentElement) line.unshift(e);
        let below = [1, 1, 1], share = 1;
        for (const e of line) {
            const css = getComputedStyle(e), color = channels(css.backgroundColor);
            share *= Number(css.opacity);
            below = over(color, color[3] * share, below);
        }
        const css = getComputedStyle(element), drawn = element instanceof SVGElement;
        // Words with an outline stand on the outline.
        if (drawn && css.paintOrder.startsWith("stroke")) below = channels(css.stroke).slice(0, 3);
        const own = channels(drawn ? css.fill : css.color);
        const both = [light(over(own, own[3] * share, below)), light(below)].sort((a, b) => b - a);
        found.push([words.slice(0, 60), (both[0] + 0.05) / (both[1] + 0.05)]);
    }
    return found;
}"""
SCROLL_PAST = """title => {
    let box = title.parentElement;
    const scrolls = () => box.scrollHeight > box.clientHeight + 1 && getComputedStyle(box).overflowY !== "visible";
    while (!scrolls()) box = box.parentElement;
    box.scrollTop = box.scrollHeight;
}"""
IS_ABOVE = """title => {
    let box = title.parentElement;
    while (box.scrollTop === 0) if (!(box = box.parentElement)) return false;
    return title.getBoundingClientRect().bottom <= box.getBoundingClientRect().top;
}"""
READ_TIPS = """name => {
    const {camera, canvas, nodeRefFromName} = window.__viserMutable, box = canvas.getBoundingClientRect();
    const node = nodeRefFromName[name], found = [];
    if (!node) return found;
    node.updateWorldMatrix(true, true);
    node.traverse(({geometry, matrixWorld}) => {
        if (geometry?.type !== "ConeGeometry") return;
        geometry.computeBoundingSphere();
        const tip = geometry.boundingSphere.center.clone().applyMatrix4(matrixWorld).project(camera);
        found.push([box.left + 0.5 * (1 + tip.x) * box.width, box.top + 0.5 * (1 - tip.y) * box.height]);
    });
    return found;
}"""
"""Where on the page the tips of a handle's arrows are."""
READ_PLACE = "name => JSON.stringify(window.__viserSceneTree.getState()[name].position)"
"""Where the page has put a handle; a drag changes it at once, whatever the server says."""
IS_CANVAS = "([x, y]) => document.elementFromPoint(x, y)?.tagName === 'CANVAS'"
MARK_OURS = """() => document.querySelectorAll("[style*='padding: 0px 0.8em'],[style*='padding:0 .8em']")
    .forEach((box) => box.setAttribute("data-ours", ""))"""


def at(number: int | str = r"\d+", title: str = "") -> re.Pattern[str]:
    """What the list of steps says at a step."""
    return re.compile(rf"^{number}/\d+  .*{title}")


def test_slider_stages_buttons_and_keys_step(tab: Playground, address: str) -> None:
    tab.slide("Timeline", "End")
    expect(tab.step).to_have_value(at(title="Outcome"))
    outcome = tab.still(tab.drawn, "the outcome is drawn")
    tab.touch("step:balls-pair").click()
    expect(tab.step).to_have_value(at(title="One pair, one ball"))
    tab.until(lambda: tab.drawn() != outcome, "another step draws something else")
    tab.until(lambda: tab.instances("/balls") > 0 and tab.instances("/uncertainty") == 0, "balls are drawn")
    number = tab.step_number()
    expect(tab.thumb("Timeline")).to_have_attribute("aria-valuenow", str(number))

    tab.thumb("Timeline").focus()
    tab.page.keyboard.press("ArrowRight")
    expect(tab.step).to_have_value(at(number + 1))
    tab.page.keyboard.press("Home")
    expect(tab.step).to_have_value(at(1, "The matches"))
    tab.until(lambda: tab.drawn().get("sphere/bearings", 0) == 0 or tab.instances("/balls") == 0, "no balls are left")

    tab.page.mouse.click(420, 650)
    tab.page.keyboard.press("n")
    expect(tab.step).to_have_value(at(2))
    expect(tab.thumb("Timeline")).to_have_attribute("aria-valuenow", "2")
    tab.page.keyboard.press("b")
    expect(tab.step).to_have_value(at(1))
    tab.page.keyboard.press("Shift+N")
    expect(tab.step).to_have_value(at(title="One pair of matches"))
    tab.page.keyboard.press("Shift+B")
    expect(tab.step).to_have_value(at(1))

    # The list of steps stands below what the step says, which a person has to scroll past.
    tab.step.scroll_into_view_if_needed()
    tab.page.locator(".step-title").evaluate(SCROLL_PAST)
    expect(tab.page.locator(".step-title")).not_to_be_in_viewport()
    tab.page.keyboard.press("n")
    expect(tab.page.locator(".step-title")).to_be_in_viewport()
    tab.page.keyboard.press("b")
    expect(tab.step).to_have_value(at(1))
    expect(tab.page.locator(".step-title")).to_have_text("The matches")

    tab.choose("Pace", "4×")
    tab.press("Play")
    tab.until(lambda: tab.step_number() >= 3, "it plays")
    tab.press("Pause")
    expect(tab.page.get_by_role("button", name="Play", exact=True)).to_be_visible()
    tab.slide("Timeline", "End")
    expect(tab.step).to_have_value(at(title="Outcome"))
    tab.until(lambda: tab.drawn() == outcome, "the outcome is drawn as before")

    # Another problem is read from its beginning, though the step has the same name.
    title = tab.page.locator(".step-title")

    def scrolled_past() -> bool:
        """Past the title for good: the page may just have brought the new step's into view."""
        title.evaluate(SCROLL_PAST)
        tab.page.wait_for_timeout(500)
        return bool(title.evaluate(IS_ABOVE))

    tab.until(scrolled_past, "the panel is scrolled past the title")
    tab.choose("Preset", "Tilted car")
    expect(tab.page.locator(".step-title")).to_be_in_viewport()
    expect(tab.step).to_have_value(at(title="Outcome"))
    tab.expect_quiet(address)


def test_balls_are_on_the_screen_at_every_step_that_one_walks_to(tab: Playground, address: str) -> None:
    """With Next, from a step that shows something else from somewhere else; and the view follows."""
    the_view_follows_who_walks_fast(tab)
    tab.touch("step:balls-pair").click()
    expect(tab.step).to_have_value(at(title="One pair, one ball"))
    box = tab.page.locator("canvas").first.bounding_box()
    assert box is not None
    for _ in range(4):
        number = tab.step_number()
        tab.press("Next")
        expect(tab.step).to_have_value(at(number + 1))

        def framed() -> bool:
            """Most of the balls' centres are within the canvas, and not all of them in one spot of it."""
            places = tab.dots("/balls/others-centres")
            low, high = np.array([box["x"], box["y"]]), np.array([box["x"] + box["width"], box["y"] + box["height"]])
            inside = np.all((places > low) & (places < high), axis=1)
            return bool(np.mean(inside) >= 0.4 and np.ptp(places[inside], axis=0).max() > 0.02 * box["height"])

        tab.until(framed, f"the balls of step {number + 1} are framed")

    graph = tab.page.get_by_text("Graph and matrix")
    expect(graph).to_be_visible()
    # A press counts also if the page draws the same anew while it lasts.
    question = tab.page.get_by_role("button", name="What is graph?")
    question.hover()
    tab.page.mouse.down()
    question.evaluate("one => { one.outerHTML = one.outerHTML; }")
    tab.page.mouse.up()
    expect(tab.page.get_by_role("dialog")).to_have_count(1)
    tab.page.keyboard.press("Escape")
    expect(tab.page.get_by_role("dialog")).to_have_count(0)
    node = tab.page.locator("circle[data-touch^='select:']").first
    numbers = sorted(map(int, str(node.get_attribute("data-touch")).removeprefix("select:").split(",")))
    node.click()
    tab.expect_card(*numbers)
    tab.until(lambda: sorted(tab.lit()) == numbers, "the matches of the node are lit on the map")
    tab.page.keyboard.press("Escape")
    tab.expect_card()
    # The same balls as a list: a row selects its ball, and a ball that is selected elsewhere is brought into view.
    tab.touch("graph-look:list").click()
    rows = tab.page.locator("tr[data-touch*=',']")
    first, last = rows.first, rows.last
    numbers = sorted(map(int, str(first.get_attribute("data-touch")).removeprefix("select:").split(",")))
    first.click()
    tab.expect_card(*numbers)
    tab.until(lambda: sorted(tab.lit()) == numbers, "the matches of the row are lit on the map")
    last.click()
    expect(last).to_be_in_viewport()
    numbers = sorted(map(int, str(last.get_attribute("data-touch")).removeprefix("select:").split(",")))
    tab.expect_card(*numbers)
    # A window over the page is what Escape closes first; what is selected stays, and the table of matches shows it.
    question.press("Enter")  # the page may just scroll the row into view, under a press of the mouse
    expect(tab.page.get_by_role("dialog")).to_have_count(1)
    tab.page.keyboard.press("Escape")
    expect(tab.page.get_by_role("dialog")).to_have_count(0)
    tab.expect_card(*numbers)
    tab.page.get_by_role("tab", name="Matches", exact=True).click()
    expect(tab.page.locator(f"tr[data-reveal='match-{numbers[0]}']")).to_be_in_viewport()
    tab.expect_card(*numbers)
    tab.page.get_by_role("tab", name="Graph", exact=True).click()
    tab.page.keyboard.press("Escape")
    tab.expect_card()
    tab.touch("graph-look:drawing").click()
    expect(node).to_be_visible()
    tab.touch("step:refinement-0").click()
    expect(tab.page.get_by_text("Residuals at the estimated pose")).to_be_visible()
    tab.tab("Matches")
    tab.touch("step:yaw-pair").click()
    expect(tab.step).to_have_value(at(title="One pair of matches"))
    expect(tab.row(0)).to_be_visible()
    tab.expect_quiet(address)


HURRY = """async () => {
    const go = (step) => dispatchEvent(new CustomEvent("spherloc-touch", {detail: `step:${step}`}));
    const tabs = () => [...document.querySelectorAll("[role=tab][aria-selected=true]")];
    const chosen = () => tabs().some((one) => one.textContent.trim() === "Residuals");
    go("outcome");
    while (!chosen()) await new Promise(requestAnimationFrame);
    go("clique");
}"""
"""Goes to a step, and on to another one as soon as the view of the first has come to the front."""


def the_view_follows_who_walks_fast(tab: Playground) -> None:
    """What the page itself has brought to the front is nobody's choice, also before it has seen it there."""
    tab.page.evaluate("dispatchEvent(new CustomEvent('spherloc-touch', {detail: 'step:yaw-clique'}))")
    expect(tab.page.get_by_role("tab", name="Yaw", exact=True)).to_have_attribute("aria-selected", "true")
    tab.page.evaluate(HURRY)
    expect(tab.page.get_by_role("tab", name="Graph", exact=True)).to_have_attribute("aria-selected", "true")
    expect(tab.page.get_by_text("Graph and matrix")).to_be_visible()


COUNT_MOVES = """() => {
    window.smoothMoves = 0;
    window.__viserMutable.cameraControl.addEventListener("transitionstart", () => window.smoothMoves++);
}"""


def test_layers_and_views(tab: Playground, address: str) -> None:
    tab.settle()
    seen = [tab.viewer]
    for name in ("Above", "Sphere", "From the camera", "Overview"):
        tab.press(name)
        tab.until(lambda: tab.viewer != seen[-1], f"the viewer moves to {name}")
        tab.settle()
        seen.append(tab.viewer)
    assert len(set(seen[1:])) == 4
    # Only who asked for less motion sees it jump.
    tab.page.evaluate(COUNT_MOVES)
    tab.page.emulate_media(reduced_motion="no-preference")
    for name, place in (("Above", seen[1]), ("Overview", seen[-1])):
        tab.press(name)
        tab.until(lambda place=place: np.allclose(tab.viewer, place, atol=0.1), f"the viewer moves to {name}")
    smooth = tab.page.evaluate("window.smoothMoves")
    assert smooth >= 2
    tab.page.emulate_media(reduced_motion="reduce")
    tab.press("Sphere")
    tab.until(lambda: np.allclose(tab.viewer, seen[2], atol=0.1), "the viewer jumps")
    assert tab.page.evaluate("window.smoothMoves") == smooth
    # A view that was asked for stays, however often the step is drawn again.
    tab.unfold("Layers")
    for name in ("From the camera", "Sphere"):
        tab.press(name)
        place = seen[1 + ("Above", "Sphere", "From the camera").index(name)]
        tab.until(lambda place=place: np.allclose(tab.viewer, place, atol=0.1), f"the viewer moves to {name}")
        for on in (False, True):
            tab.tick("Map", on)
            tab.until(lambda on=on: ("map/points" in tab.drawn()) == on, "the layer is switched")
            assert np.allclose(tab.still(lambda: tab.viewer, "the viewer stands still"), place, atol=0.1)
    tab.press("Overview")
    centre = tab.centre("/cameras/estimate")
    away = [sum((a - b) ** 2 for a, b in zip(place[:3], centre, strict=True)) ** 0.5 for place in seen]
    assert away[3] < 0.05 < min(away[1:3] + away[4:])

    shown = {"Map": "map/points", "Rays": "rays", "Cameras": "cameras/estimate"}
    # From inside, the camera is not drawn; the server hears later that the viewer has left it.
    tab.until(lambda: set(shown.values()) <= tab.drawn().keys(), "the camera is drawn again")
    for label, node in shown.items():
        before = tab.still(tab.drawn, "the picture is drawn")
        tab.tick(label, False)
        tab.until(lambda node=node: node not in tab.drawn(), f"{label} is hidden")
        assert tab.drawn()["sphere/bearings"] == 40
        tab.tick(label, True)
        tab.until(lambda before=before: tab.drawn() == before, f"{label} is back")

    # viser sends only the last of several changes within 50 ms; the page must not go on showing what was lost.
    boxes = [tab.widget(label).element_handle() for label in shown]
    tab.page.evaluate("boxes => boxes.forEach(box => box.click())", boxes)
    tab.until(lambda: not set(shown.values()) <= tab.drawn().keys(), "a layer is hidden")
    agree: Callable[[], bool] = lambda: all(  # noqa: E731
        tab.widget(label).is_checked() == (node in tab.drawn()) for label, node in shown.items()
    )
    tab.until(agree, "each layer is as its box says")
    # The outcome shows no balls: their view goes to the step that does, and frames them.
    tab.press("Balls")
    expect(tab.step).to_have_value(re.compile("The maximum clique of balls"))
    tab.until(lambda: "balls/clique" in tab.drawn(), "the balls are drawn")
    tab.expect_quiet(address)


def test_a_dragged_slider_and_widgets_that_change_at_once_show_what_was_solved(
    tab: Playground, address: str, recordings: Path
) -> None:
    thumb = tab.thumb("Points")
    place = lambda: (thumb.bounding_box(), tab.widget("Points").bounding_box())  # noqa: E731
    start, track = tab.still(place, "the slider stands still")
    assert start is not None and track is not None
    tab.page.mouse.move(start["x"] + start["width"] / 2, start["y"] + start["height"] / 2)
    tab.page.mouse.down()
    for share in (0.1, 0.6, 0.2, 0.5, 0.15, 0.31):
        tab.page.mouse.move(track["x"] + share * track["width"], start["y"], steps=4)
    tab.page.mouse.up()
    shown = tab.still(lambda: int(thumb.get_attribute("aria-valuenow") or 0), "the slider rests")
    assert 100 < shown < 220
    expect(tab.value("inliers")).to_have_text(re.compile(rf" of {shown}$"))
    tab.until(lambda: tab.instances("/map/points") == shown, "the canvas has as many points")
    expect(tab.entry("Points")).to_have_value(str(shown))
    expect(thumb).to_have_attribute("aria-valuenow", str(shown))

    names = ("Noise (px)", "Outliers (%)", "Points")
    thumbs = [tab.thumb(name).element_handle() for name in names]
    script = """thumbs => thumbs.forEach(
        thumb => thumb.dispatchEvent(new KeyboardEvent("keydown", {key: "End", code: "End", bubbles: true})))"""
    tab.page.evaluate(script, thumbs)
    tab.until(lambda: tab.instances("/map/points") == 500, "the last of the changes has been heard of")
    said = tab.page.get_by_text(re.compile(r"Recorded as \S+\.rrd"))

    def recorded_as_shown() -> bool:
        path = next((recordings / text.split()[-1] for text in said.all_inner_texts()), None)
        noise, outliers, points = (float(tab.entry(name).input_value()) for name in names)
        scene = f"synthetic: N {points:g}, outliers {outliers / 100:g}, noise {noise:g} px, seed 3"
        return path is not None and path.is_file() and read_recording(path).problem.scene == scene

    tab.until(recorded_as_shown, "what is recorded is what the boxes say")
    tab.expect_quiet(address)


def drag(tab: Playground, handle: str) -> None:
    """Pull one of a handle's arrows a little, as often as it takes to get hold of it."""

    def pulled() -> bool:
        tab.until(lambda: bool(tab.page.evaluate(READ_TIPS, handle)), "the handle has arrows")
        tips = tab.still(lambda: tab.page.evaluate(READ_TIPS, handle), "the handle stands still")
        place = tab.page.evaluate(READ_PLACE, handle)
        x, y = next(tip for tip in reversed(tips) if tab.page.evaluate(IS_CANVAS, tip))
        tab.page.mouse.move(x, y)
        tab.page.evaluate(PAINT)
        tab.page.mouse.down()
        for share in (0.25, 0.5, 0.75, 1.0):
            tab.page.mouse.move(x + 15 * share, y + 20 * share)
            tab.page.evaluate(PAINT)
        tab.page.mouse.up()
        return tab.page.evaluate(READ_PLACE, handle) != place

    tab.until(pulled, "the handle is pulled")


def the_true_camera_can_be_dragged(tab: Playground) -> None:
    tab.slide("Timeline", "End")
    expect(tab.step).to_have_value(at(title="Outcome"))
    tab.press("Overview")
    tab.settle()
    place = tab.value("camera position").inner_text()
    assert not (tab.node("/true camera level") or {"visible": True})["visible"]
    tab.unfold("More of the scene")
    tab.page.get_by_text("Drag the camera", exact=True).click()
    tab.until(lambda: bool((tab.node("/true camera level") or {}).get("visible")), "the handle is there")
    drag(tab, "/true camera level")
    expect(tab.page.get_by_text(re.compile("The true camera was moved: yaw"))).to_be_visible()
    expect(tab.value("camera position")).not_to_have_text(place)
    expect(tab.value("outcome")).to_have_text("success")
    tab.press("Undo")
    expect(tab.value("camera position")).to_have_text(place)
    expect(tab.page.get_by_text(re.compile("The true camera was moved: yaw"))).to_have_count(0)


def test_the_true_camera_can_be_dragged_and_mistakes_are_sentences(tab: Playground, address: str) -> None:
    the_true_camera_can_be_dragged(tab)

    def mistake(label: str, wrong: str, sentence: str, right: str, mended: Callable[[], None]) -> None:
        tab.type(label, wrong)
        note = tab.page.locator("[class*=Notification-root]").filter(has_text=sentence)
        expect(note).to_be_visible()
        assert note.inner_text().endswith(".") and note.inner_text().count(". ") == 0
        expect(tab.value("outcome")).to_have_text("success")
        expect(stale).to_be_visible()
        tab.type(label, right)
        mended()
        expect(stale).to_have_count(0)
        expect(note).to_have_count(0)

    stale = tab.page.get_by_text("These settings cannot be run; what is shown is the run before them.")
    error = tab.value("rotation error").inner_text()
    changed = lambda: expect(tab.value("rotation error")).not_to_have_text(error)  # noqa: E731
    mistake("Seed", "soon", "The seed 'soon' is not a whole number", "8", changed)
    tab.choose("Estimator", EXACT)
    expect(tab.value("estimator")).to_have_text("mc-exact")
    mistake("Effort", "0", "Option effort is 0", "2", lambda: None)
    # A slider's box keeps within its ends, and is never left without a number.
    for typed, taken in (("500", "99"), ("ten", "99"), ("", "99"), ("40", "40")):
        tab.type("Outliers (%)", typed)
        expect(tab.entry("Outliers (%)")).to_have_value(taken)
    tab.expect_quiet(address)


def test_dark_and_light_can_be_read(tab: Playground, address: str) -> None:
    """All words of ours, not those of viser's own widgets, stand out from what is behind them."""
    tab.tab("Matches")
    tab.row(3).click()
    tab.expect_card(3)
    backgrounds = []
    for theme in ("dark", "light"):
        if theme == "light":
            tab.page.get_by_text("Dark", exact=True).click()
            tab.until(lambda: background(tab) != backgrounds[0], "the page turns light")
        backgrounds.append(tab.still(lambda: background(tab), "the theme is there"))
        faint: dict[str, float] = {}
        for name in TABS:
            tab.tab(name)
            contrasts = read_contrasts(tab)
            faint |= {f"{name}: {words}": round(ratio, 2) for words, ratio in contrasts if ratio < MIN_CONTRAST}
        assert not faint, theme
        tab.tab("Play")
    assert sum(backgrounds[0]) < 200 and sum(backgrounds[1]) > 700
    tab.expect_quiet(address)


def read_contrasts(tab: Playground) -> list[tuple[str, float]]:
    """Words of ours on the page and their contrasts, once all are there and nothing fades in any more."""

    def read() -> list[tuple[str, float]]:
        tab.page.evaluate(MARK_OURS)
        return tab.page.evaluate(READ_CONTRASTS)

    tab.until(lambda: len(read()) > 30, "the words are there")
    return tab.still(read, "the words stand still")


def background(tab: Playground) -> tuple[int, ...]:
    text = tab.page.evaluate("() => getComputedStyle(document.body).backgroundColor")
    return tuple(map(int, re.findall(r"\d+", text)[:3]))
