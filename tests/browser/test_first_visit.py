"""Who comes for the first time is shown around, once; words tell what they mean."""

import re

from playground import Playground
from playwright.sync_api import Browser, expect


def test_the_introduction_is_shown_once_and_can_be_skipped(browser: Browser, address: str) -> None:
    tab = Playground(browser, address, new=True)
    card = tab.page.get_by_role("dialog", name="Introduction")
    expect(card).to_be_visible()
    expect(card).to_contain_text("Pixels become directions")
    expect(tab.step).to_have_value(re.compile("Bearings on the unit sphere"))
    card.get_by_role("button", name="Next").click()
    expect(tab.step).to_have_value(re.compile("The yaw most arcs share"))
    card.get_by_role("button", name="Next").click()
    expect(tab.step).to_have_value(re.compile("The maximum clique of balls"))
    card.get_by_role("button", name="Skip").click()
    expect(card).to_have_count(0)
    expect(tab.step).to_have_value(re.compile("The yaw most arcs share"))

    tab.page.reload()
    expect(tab.value("outcome")).not_to_be_empty()
    tab.page.wait_for_function("() => document.querySelector('[data-introduction]') !== null")
    tab.still(lambda: card.count(), "nothing more comes")
    expect(card).to_have_count(0)

    tab.page.locator(".term", has_text=re.compile("^maximum clique$")).first.click()
    window = tab.page.get_by_role("dialog").filter(has_text="What the words mean")
    expect(window).to_contain_text("The largest clique there is.")
    window.get_by_role("button", name="Show the introduction again").click()
    expect(card).to_contain_text("1 of 4")
    tab.page.keyboard.press("Escape")
    expect(card).to_have_count(0)
    tab.expect_quiet(address)
    tab.close()
