"""Links in a browser: those with a token, and those that bring back what a page shows."""

import re
from collections.abc import Callable
from pathlib import Path
from urllib.parse import unquote

import numpy as np
from playground import SCENE, Playground, served
from playwright.sync_api import Browser, expect

from spherloc_viz.app.audience import ABOUT
from spherloc_viz.app.web.access import NO_TOKEN


def test_each_link_opens_its_own_page(browser: Browser, tmp_path: Path) -> None:
    scene = tmp_path / "small.toml"
    scene.write_text(SCENE)
    with served(scene, "--no-record", "--token") as (link, server):
        assert server.stdout is not None
        said = re.fullmatch(r"for an audience, which can only look: (\S+)\n", server.stdout.readline())
        assert said is not None and said[1] != link
        address = link.split("/?")[0]

        stranger = browser.new_context().new_page()
        answer = stranger.goto(address)
        assert answer is not None and answer.status == 403
        expect(stranger.locator("body")).to_have_text(NO_TOKEN)

        presenter = Playground(browser, link)
        assert presenter.page.url.split("#")[0] == address + "/", "the token has left the address"
        presenter.choose("Estimator", "ransac-2p (two points)")
        expect(presenter.value("estimator")).to_have_text("ransac-2p")
        audience = Playground(browser, said[1])
        assert audience.page.url == address + "/"
        expect(audience.value("estimator")).to_have_text("ransac-2p")
        expect(audience.page.get_by_text(ABOUT)).to_be_visible()
        assert audience.page.get_by_role("tab", name="Recordings").count() == 0
        audience.press("Previous")
        expect(audience.step).not_to_have_value(presenter.step.input_value())
        expect(presenter.page.get_by_text("Runs are not recorded.")).to_be_visible()
        for tab in (presenter, audience):
            tab.expect_quiet(address)
    assert server.returncode in (0, 130), "Ctrl-C ends it with tabs open"
    for tab in (presenter, audience):
        tab.close()


SHOWN = ("estimator", "outcome", "inliers", "rotation error", "position error")


def shown(tab: Playground) -> tuple[str, ...]:
    return (*(tab.value(name).inner_text() for name in SHOWN), tab.step.input_value(), str(tab.carded()))


def test_a_reload_and_a_link_bring_back_what_is_shown(
    tab: Playground, open_tab: Callable[[], Playground], browser: Browser, address: str
) -> None:
    expect(tab.page).to_have_url(re.compile("#v=1&scene=small.street&seed=3&.*step=outcome$"))
    tab.slide("Outliers (%)", "ArrowLeft")
    tab.choose("Estimator", "ransac-2p (two points)")
    expect(tab.value("estimator")).to_have_text("ransac-2p")
    tab.type("Iterations", "321")
    tab.press("New seed")
    tab.slide("Timeline", "Home")
    tab.press("Next")
    expect(tab.step).to_have_value(re.compile("^2/"))
    tab.tab("Matches")
    tab.row(7).click()
    tab.expect_card(7)
    sorted_by = tab.page.locator("[data-touch='match-sort:px']")
    sorted_by.click()
    tab.tab("Sweep")
    shared = "set=outlier_rate%3D0.49&estimator=ransac-2p&option=iterations%3D321&step=bearings&select=7&tab=Matches"
    wanted = f"{shared}&side=Sweep"
    expect(tab.page).to_have_url(re.compile("&seed=4&" + wanted + "&table=all%2Cpx$"))
    link, before = tab.page.url, shown(tab)
    tab.page.reload()
    tab.expect_card(7)
    expect(tab.value("estimator")).to_have_text("ransac-2p")
    assert tab.still(lambda: (shown(tab), tab.page.url), "the page stays") == (before, link)
    for name in ("Matches", "Sweep"):
        expect(tab.page.get_by_role("tab", name=name)).to_have_attribute("aria-selected", "true")
    expect(sorted_by).to_have_text("px ▴")
    tab.press("Undo")  # nothing was shown before the link
    assert tab.still(lambda: shown(tab), "the page stays") == before

    # In another browser, and in a page that shows something else; what is wrong is said, and the rest is opened.
    other = open_tab()
    other.page.goto(link.replace("v=1", "v=2") + "&theme=light&colour=red")
    other.expect_card(7)
    assert shown(other) == before
    expect(other.page.get_by_role("tab", name="Sweep")).to_have_attribute("aria-selected", "true")
    expect(other.page).to_have_url(re.compile(wanted + "&theme=light&table=all%2Cpx$"))
    said = other.page.get_by_text(re.compile("The link is of version '2'.* says 'colour', which this version"))
    expect(said.first).to_be_visible()
    assert tab.page.url == link, "also long after the reload"
    for page in (tab, other):
        page.expect_quiet(address)


def is_followed_to_its_end_though_something_is_changed_meanwhile(tab: Playground) -> None:
    slow = "#v=1&scene=small+street&seed=3&estimator=ransac-2p&option=iterations%3D9000000&step=sample-1"
    tab.page.evaluate("link => location.replace(link)", slow)
    expect(tab.page.get_by_role("button", name="Cancel", exact=True).first).to_be_visible()
    tab.type("Iterations", "321")
    expect(tab.page).to_have_url(re.compile("estimator=ransac-2p&option=iterations%3D321&step=sample-1$"))


def told_place(link: str) -> list[float]:
    """Where a link says that the viewer stands, as ``Playground.viewer`` measures it; infinite if it does not."""
    found = re.search(r"&view=([^&]*)", link)
    x, y, z = map(float, unquote(found[1]).split(",")[:3]) if found else (np.inf,) * 3
    return [-z, -y, -x]


def test_a_link_brings_back_where_one_stands(tab: Playground) -> None:
    tab.settle()
    room = tab.page.locator("canvas").last.bounding_box()
    assert room is not None
    before = tab.viewer
    tab.page.mouse.move(room["x"] + 0.5 * room["width"], room["y"] + 0.7 * room["height"])
    tab.page.mouse.down()
    tab.page.mouse.move(room["x"] + 0.7 * room["width"], room["y"] + 0.6 * room["height"], steps=4)
    tab.page.mouse.up()
    tab.until(lambda: not np.allclose(tab.viewer, before, atol=0.1), "the viewer has moved")
    tab.still(lambda: tab.viewer, "the viewer stands still")
    # Read anew each time: on a slow page a viewer that is still on its way seems to stand.
    tab.until(
        lambda: np.allclose(told_place(tab.page.url), tab.viewer[:3], atol=2e-3), "the address says where one stands"
    )
    stood, link = tab.viewer, tab.page.url
    tab.page.reload()
    expect(tab.value("outcome")).not_to_be_empty()
    tab.until(lambda: np.allclose(tab.viewer, stood, atol=2e-3), "the viewer stands there again")
    assert tab.still(lambda: tab.page.url, "the address stays") == link
    tab.page.locator("[data-touch^='step:yaw']").locator("visible=true").first.click()
    expect(tab.page).to_have_url(re.compile("step=yaw[^&]*$"))
    tab.page.goto(re.sub("view=[^&]*", "view=here", link))
    expect(tab.page.get_by_text(re.compile("^View is 'here'; give a place")).first).to_be_visible()
    is_followed_to_its_end_though_something_is_changed_meanwhile(tab)
