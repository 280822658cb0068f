"""The page for those who see little, or use a keyboard or a screen reader: WCAG 2.1, levels A and AA."""

import re

from axe_playwright_python.sync_playwright import Axe
from playground import Playground
from playwright.sync_api import Browser, expect

RULES = {"runOnly": ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa"], "resultTypes": ["violations"], "preload": False}
SMALL = """() => [...document.querySelectorAll("body *")]
    .filter(one => one.getClientRects().length && !one.closest("style,script"))
    .filter(one => [...one.childNodes].some(part => part.nodeType === Node.TEXT_NODE && part.textContent.trim()))
    .filter(one => parseFloat(getComputedStyle(one).fontSize) < 11.99).map(one => one.outerHTML.slice(0, 200))"""
"""Words of less than 12 px."""
MOVING = "() => document.getAnimations().some(one => one instanceof CSSTransition && one.playState === 'running')"


def faults(tab: Playground) -> list[str]:
    """All that is wrong now; of viser's own parts too, none of which is left out."""
    tab.until(lambda: not tab.page.evaluate(MOVING), "nothing fades in any more")
    wrong: list[str] = []
    for _ in range(10):  # names are given some times a second, so what came just now may be without
        found = Axe().run(tab.page, options=RULES).response["violations"]
        wrong = [f"{one['id']}: {node['html'][:200]}" for one in found for node in one["nodes"]]
        wrong += tab.page.evaluate(SMALL)
        if not wrong:
            break
        tab.page.wait_for_timeout(300)
    return wrong


def test_every_state_of_the_page_is_accessible(browser: Browser, address: str) -> None:
    tab = Playground(browser, address, new=True)
    introduction = tab.page.get_by_role("dialog", name="Introduction")
    expect(introduction).to_be_visible()
    named(tab)
    assert faults(tab) == []
    introduction.get_by_role("button", name="Skip").click()
    tab.slide("Timeline", "End")
    expect(tab.step).to_have_value(re.compile("Outcome$"))

    # The keyboard reaches matches, and reads their card.
    tab.tab("Matches")
    tab.row(5).focus()
    tab.page.keyboard.press("Enter")
    tab.expect_card(5)
    tab.tab("Compare")
    tab.press("Compare")
    expect(tab.page.get_by_text("The yaw that each found")).to_be_visible()
    named(tab)
    assert faults(tab) == []
    tab.touch("deselect:").click()

    tab.tab("Play")
    tab.tick("Dark", False)
    expect(tab.page.locator("html[data-mantine-color-scheme=light]")).to_have_count(1)
    tab.tab("Recordings")
    tab.page.locator("[data-touch^='run-open:']").locator("visible=true").first.click()
    expect(tab.page.locator(".review-card").locator("visible=true")).to_be_visible()
    tab.tab("Residuals")
    assert faults(tab) == []
    tab.tab("Play")
    tab.tick("Hide answers", True)
    tab.slide("Timeline", "Home")
    expect(tab.step).to_have_value(re.compile("^1/"))
    for name in ("Sweep", "Share", "Open"):
        tab.tab(name)
        assert faults(tab) == []
    tab.page.keyboard.press("l")
    expect(tab.page.get_by_role("region", name="What the step says")).to_be_visible()
    assert faults(tab) == []
    tab.page.keyboard.press("l")
    tab.close()


def named(tab: Playground) -> None:
    """Wait until names are given, which is done some times a second."""
    expect(tab.page.get_by_role("slider", name="Timeline")).to_have_count(1)
