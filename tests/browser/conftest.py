"""One server and one browser for all tests of the page."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from playground import FLAGS, SCENE, Playground, find_chromium, served
from playwright.sync_api import Browser, sync_playwright


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark every test that uses a browser, so that ``-m "not browser"`` leaves all of them out."""
    for item in items:
        if isinstance(item, pytest.Function) and "browser" in item.fixturenames:
            item.add_marker(pytest.mark.browser)


@pytest.fixture(scope="session")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the server records."""
    return tmp_path_factory.mktemp("recordings")


@pytest.fixture(scope="session")
def address(tmp_path_factory: pytest.TempPathFactory, recordings: Path) -> Iterator[str]:
    """Address of a running playground with a small scene."""
    scene = tmp_path_factory.mktemp("scene") / "small.toml"
    scene.write_text(SCENE)
    with served(scene, "--recordings", recordings) as (found, _):
        yield found


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """A headless Chromium with WebGL in software. Not kept for the session: Playwright's event loop blocks others."""
    path = find_chromium()
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=path, headless=True, args=list(FLAGS))
        yield chromium
        chromium.close()


@pytest.fixture
def open_tab(browser: Browser, address: str) -> Iterator[Callable[[], Playground]]:
    """Opens tabs and closes them after the test."""
    tabs: list[Playground] = []

    def opened() -> Playground:
        tabs.append(Playground(browser, address))
        return tabs[-1]

    yield opened
    for tab in tabs:
        tab.close()


@pytest.fixture
def tab(open_tab: Callable[[], Playground]) -> Playground:
    """One open tab that shows its first run."""
    return open_tab()
