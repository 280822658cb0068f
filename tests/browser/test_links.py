"""The links with a token, in a browser: the presenter's, the audience's, and none."""

import re
from pathlib import Path

import pytest
from playground import SCENE, Playground, served
from playwright.sync_api import Browser, expect

from spherloc_viz.app.audience import ABOUT
from spherloc_viz.app.web.access import NO_TOKEN

pytestmark = pytest.mark.browser


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
        assert presenter.page.url == address + "/", "the token has left the address"
        presenter.choose("Estimator", "ransac-2p (two points)")
        expect(presenter.value("estimator")).to_have_text("ransac-2p")
        audience = Playground(browser, said[1])
        assert audience.page.url == address + "/"
        expect(audience.value("estimator")).to_have_text("ransac-2p")
        expect(audience.page.get_by_text(ABOUT)).to_be_visible()
        assert audience.page.get_by_role("tab", name="Recordings").count() == 0
        audience.press("Previous")
        expect(audience.step).not_to_have_value(presenter.step.input_value())
        for tab in (presenter, audience):
            tab.expect_quiet(address)
            tab.close()
